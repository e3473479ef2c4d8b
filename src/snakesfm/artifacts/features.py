"""Artifacts of extract_features, learn_vocabulary and describe_images."""

from dataclasses import dataclass
from typing import ClassVar

from snakesfm.arrays import Array
from snakesfm.artifacts.base import Artifact, column


@dataclass(frozen=True)
class LocalFeatures(Artifact):
    """Keypoints and descriptors of the images of one block, flat with row offsets; D = 0 where merged."""

    kind: ClassVar[str] = "local_features"
    format_version: ClassVar[int] = 2

    image_ids: Array = column("(n)", "int32", "row of the image in the index, ascending")
    names: Array = column("(n)", "str", "relative name of the image")
    digests: Array = column("(n)", "str", "digest of the image's pixels, options and stage version")
    sizes: Array = column("(n,2)", "int32", "width and height of the image in pixels")
    offsets: Array = column("(n+1)", "int64", "rows offsets[k]:offsets[k+1] belong to image k")
    keypoints: Array = column("(K,2)", "float32", "x, y in original pixels, first pixel's centre (.5,.5)")
    descriptors: Array = column(
        "(K,D)",
        "uint8|float16|float32",
        "SIFT: uint8, 512 x RootSIFT clipped to 255; learned: float16 of unit length; D = 0 without any",
    )
    scores: Array = column("(K)", "float32", "detector response, larger is stronger")
    scales: Array = column("(K)", "float32", "diameter in original pixels; SIFT: twice sigma; learned: 1")
    angles: Array = column("(K)", "float32", "orientation in radians")
    colors: Array = column("(K,3)", "uint8", "RGB of the image at the keypoint")


@dataclass(frozen=True)
class Vocabulary(Artifact):
    """Codebook of local descriptors learned on the scene."""

    kind: ClassVar[str] = "vocabulary"

    centers: Array = column("(W,D)", "float32", "cluster centres in descriptor space")


@dataclass(frozen=True)
class GlobalDescriptors(Artifact):
    """One vector per image of a block; the dot product of two is their similarity."""

    kind: ClassVar[str] = "global_descriptors"

    image_ids: Array = column("(n)", "int32", "row of the image in the index, ascending")
    descriptors: Array = column("(n,D)", "float32", "unit-length global descriptor")
