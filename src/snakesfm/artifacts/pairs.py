"""Artifacts about pairs of images: select_pairs, match_pairs, estimate_two_view and the view graph."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from snakesfm.arrays import Array
from snakesfm.artifacts.base import Artifact, column

KINDS = ("general", "planar", "rotation_only")
REJECTIONS = (
    "",
    "too_few_matches",
    "estimation_failed",
    "too_few_inliers",
    "low_inlier_ratio",
    "indeterminate",
    "not_significant",
    "ambiguous",
)
EDGE_LABELS = (
    "kept",
    "cycle_min",
    "cycle_median",
    "component",
    "rotation_residual",
    "cycle_message",
    "cluster_vote",
)


def _numbered(names: Sequence[str]) -> str:
    """The names behind the codes that stand for them, for docs/artifacts.md."""
    return ", ".join(f"{code} {name}" for code, name in enumerate(names))


@dataclass(frozen=True)
class ImagePairs(Artifact):
    """Pairs of images that are to be matched, of one tile."""

    kind: ClassVar[str] = "image_pairs"

    pairs: Array = column("(P,2)", "int32", "rows (i, j) of the index, i < j, sorted")
    reasons: Array = column(
        "(P)", "str", "why: exhaustive, sequential, retrieved, listed, spatial; joined by +"
    )
    similarities: Array = column("(P)", "float32", "global similarity, NaN where not computed")
    likenesses: Array = column(
        "(P)",
        "float32",
        "preview score: sum of (1 - distance ratio)^2 over mutual nearest neighbours of the largest "
        "keypoints; NaN if not previewed",
    )


@dataclass(frozen=True)
class PairMatches(Artifact):
    """Putative keypoint matches of the pairs of one tile."""

    kind: ClassVar[str] = "pair_matches"

    pairs: Array = column("(P,2)", "int32", "rows (i, j) of the index, i < j, sorted")
    digests: Array = column("(P)", "str", "digest of both images' features, options and stage version")
    offsets: Array = column("(P+1)", "int64", "rows offsets[k]:offsets[k+1] belong to pair k")
    matches: Array = column("(M,2)", "int32", "keypoint row in image i and in image j")
    scores: Array = column("(M)", "float32", "match confidence, larger is better")


@dataclass(frozen=True)
class PairCoordinates(Artifact):
    """Matched positions of the pairs of one tile, as found without keypoints."""

    kind: ClassVar[str] = "pair_coordinates"

    pairs: Array = column("(P,2)", "int32", "rows (i, j) of the index, i < j, sorted")
    digests: Array = column("(P)", "str", "digest of both images, options and stage version")
    offsets: Array = column("(P+1)", "int64", "rows offsets[k]:offsets[k+1] belong to pair k")
    coordinates: Array = column("(M,4)", "float32", "x, y in image i and x, y in image j, original pixels")
    scores: Array = column("(M)", "float32", "match confidence, larger is better")


@dataclass(frozen=True)
class TwoViewGeometries(Artifact):
    """Relative poses, their covariances and the inlier matches of the pairs of one tile (or scene)."""

    kind: ClassVar[str] = "two_view_geometries"

    pairs: Array = column("(P,2)", "int32", "rows (i, j) of the index, i < j, sorted")
    digests: Array = column("(P)", "str", "digest of the pair's matches, cameras, options and version")
    rotations: Array = column("(P,3,3)", "float64", "j_from_i rotation; NaN where there is none")
    translations: Array = column("(P,3)", "float64", "j_from_i unit translation; NaN where there is none")
    covariances: Array = column(
        "(P,5,5)",
        "float64",
        "covariance (rad) of the left rotation increment (3) and of the translation's two tangents",
    )
    kinds: Array = column("(P)", "int8", "0 general, 1 planar, 2 rotation-only")
    rejections: Array = column("(P)", "int8", _numbered(("accepted", *REJECTIONS[1:])))
    match_counts: Array = column("(P)", "int32", "matches between distinct places whose rays are finite")
    inlier_counts: Array = column("(P)", "int32", "inlier matches")
    inlier_ratios: Array = column("(P)", "float64", "share of the matches that are inliers")
    triangulation_angles_deg: Array = column("(P)", "float64", "median angle between the inliers' rays")
    offsets: Array = column("(P+1)", "int64", "rows offsets[k]:offsets[k+1] belong to pair k")
    inliers: Array = column("(M,2)", "int32", "inlier matches: keypoint row in image i and in image j")


@dataclass(frozen=True)
class ViewGraph(Artifact):
    """Accepted two-view geometries of the scene as edges, with the label that a filter gave them."""

    kind: ClassVar[str] = "view_graph"

    pairs: Array = column("(E,2)", "int32", "rows (i, j) of the index, i < j, sorted")
    rotations: Array = column("(E,3,3)", "float64", "j_from_i rotation")
    translations: Array = column("(E,3)", "float64", "j_from_i unit translation")
    covariances: Array = column("(E,5,5)", "float64", "as in two_view_geometries")
    kinds: Array = column("(E)", "int8", "0 general, 1 planar, 2 rotation-only")
    inlier_counts: Array = column("(E)", "int32", "inlier matches")
    triangulation_angles_deg: Array = column("(E)", "float64", "median angle between the inliers' rays")
    labels: Array = column("(E)", "int8", f"what refused the edge: {_numbered(EDGE_LABELS)}")
    cycle_min_deg: Array = column("(E)", "float64", "smallest 3-cycle error of the edge, NaN if in none")
    cycle_median_deg: Array = column("(E)", "float64", "median 3-cycle error of the edge, NaN if in none")
    components: Array = column("(N)", "int32", "component of each image by kept edges, 0 the largest")
