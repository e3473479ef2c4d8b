"""Artifacts of index_images and calibrate_cameras."""

from dataclasses import dataclass
from typing import ClassVar

from snakesfm.arrays import Array
from snakesfm.artifacts.base import Artifact, column


@dataclass(frozen=True)
class ImageIndex(Artifact):
    """The images of a scene, in the order of their names, and the cameras that took them."""

    kind: ClassVar[str] = "image_index"
    format_version: ClassVar[int] = 3

    names: Array = column("(N)", "str", "POSIX path relative to the image folder, sorted")
    sizes: Array = column("(N,2)", "int32", "width and height in pixels as stored in the file")
    sha256: Array = column("(N)", "str", "SHA-256 of the file, hexadecimal")
    blocks: Array = column("(N)", "int32", "block that the image belongs to")
    camera_ids: Array = column("(N)", "int32", "row of the image's camera in the camera columns")
    orientations: Array = column("(N)", "int32", "EXIF orientation 1..8, not applied: pixels are as stored")
    focal_exif_px: Array = column(
        "(N)", "float64", "focal length from EXIF in pixels, NaN if none or cropped"
    )
    gps: Array = column("(N,3)", "float64", "EXIF latitude, longitude (deg), altitude (m), NaN if none")
    duplicate_of: Array = column("(N)", "int32", "first image with the same bytes, -1 if none")
    camera_models: Array = column("(C)", "str", "COLMAP camera model name")
    camera_sizes: Array = column("(C,2)", "int32", "width and height in pixels")
    camera_params: Array = column("(C,16)", "float64", "COLMAP parameters in pixels, padded with NaN")
    camera_sources: Array = column("(C)", "str", "where the focal length is from: given, exif, default")
    refused_names: Array = column("(R)", "str", "files that look like images but cannot be used")
    refused_reasons: Array = column("(R)", "str", "one sentence per refused file")
    warnings: Array = column("(W)", "str", "one sentence for each other problem found")


@dataclass(frozen=True)
class CalibratedCameras(Artifact):
    """Intrinsics of every camera of the index, before bundle adjustment."""

    kind: ClassVar[str] = "calibrated_cameras"
    format_version: ClassVar[int] = 3

    models: Array = column("(C)", "str", "COLMAP camera model name")
    sizes: Array = column("(C,2)", "int32", "width and height in pixels")
    params: Array = column("(C,16)", "float64", "COLMAP parameters in pixels, padded with NaN")
    sources: Array = column("(C)", "str", "where the focal length is from: given, exif, estimated, default")
    focal_sigma: Array = column(
        "(C)", "float64", "relative standard deviation of the focal length, NaN if unknown"
    )
    pair_counts: Array = column("(C)", "int32", "pairs whose fundamental matrix voted on the focal")
    overlay_cells: Array = column(
        "(S,4)",
        "int32",
        "width and height of images in detector pixels, column and row of a cell of 8 of these that an "
        "overlay covers",
    )
    warnings: Array = column("(W)", "str", "one sentence for each problem found")

    @property
    def camera_columns(self) -> tuple[Array, Array, Array, Array]:
        """The arguments of :func:`snakesfm.geometry.camera.cameras_from_columns`."""
        return self.models, self.sizes, self.params, self.sources
