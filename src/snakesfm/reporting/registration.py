"""Per image: what each stage kept of it, and why an image has no pose."""

from dataclasses import dataclass

import numpy as np

from snakesfm.arrays import Array


@dataclass(frozen=True)
class ImageCounts:
    """What each stage kept of every image.

    Parameters
    ----------
    pairs, accepted, kept : (N,) int64, its pairs that were matched, accepted, kept by averaging.
    components : (N,) int32, component of the filtered view graph, 0 the largest.
    rotated, positioned : (N,) bool, whether averaging gave it a rotation and a position.
    track_observations, point_observations, observations : (N,) int64, its keypoints in tracks, in
        triangulated points, and in the first model.
    models : (N,) int32, the model it is in, -1 none.
    mean_error_px : (N,) float64, mean reprojection error in the first model, NaN without observations.
    """

    pairs: Array
    accepted: Array
    kept: Array
    components: Array
    rotated: Array
    positioned: Array
    track_observations: Array
    point_observations: Array
    models: Array
    observations: Array
    mean_error_px: Array

    @property
    def registered(self) -> Array:
        """Which images are in the first model, (N,) bool."""
        return np.asarray(self.models == 0)


def count_by_image(ids: Array, count: int) -> Array:
    """How often each of ``count`` images occurs in ``ids``, (count,) int64."""
    return np.bincount(np.asarray(ids, dtype=np.int64).ravel(), minlength=count)


def mean_by_image(values: Array, image_ids: Array, count: int) -> Array:
    """Mean of the finite values of each image (count,), NaN where it has none."""
    finite = np.isfinite(values)
    totals = np.bincount(image_ids[finite], weights=values[finite], minlength=count)
    numbers = np.bincount(image_ids[finite], minlength=count)
    means: Array = np.divide(totals, numbers, out=np.full(count, np.nan), where=numbers > 0)
    return means


def reason_not_registered(
    image: int,
    counts: ImageCounts,
    duplicate_of: str,
    rejections: dict[str, int],
    edge_labels: dict[str, int],
) -> str:
    """One sentence on where an image without a pose was lost.

    Parameters
    ----------
    image : row of the index.
    duplicate_of : name of the first image with the same bytes, or "".
    rejections, edge_labels : how many of the image's pairs and edges were refused for which reason.
    """
    if counts.registered[image]:
        return ""
    if counts.models[image] > 0:
        size = int(np.sum(counts.models == counts.models[image]))
        return f"It is in a separate model of {size} images, in sparse/{counts.models[image]}."
    if duplicate_of:
        return f"It is an exact copy of {duplicate_of}, which is used instead."
    if counts.pairs[image] == 0:
        return "No pair with this image was selected and matched."
    if counts.accepted[image] == 0:
        return f"None of its {counts.pairs[image]} pairs was accepted: {_listed(rejections)}."
    if counts.kept[image] == 0:
        return f"All its {counts.accepted[image]} view-graph edges were refused: {_listed(edge_labels)}."
    # averaging may have joined the filter's components
    if counts.components[image] != 0 and not counts.positioned[image]:
        size = int(np.sum(counts.components == counts.components[image]))
        return f"It is in a component of {size} images that is not connected to the largest one."
    if not counts.rotated[image]:
        return "Rotation averaging found no rotation for it."
    if counts.track_observations[image] == 0:
        return "It is in no track."
    if not counts.positioned[image]:
        return "Averaging found no position for it, and its matches to points of the model gave none."
    if counts.point_observations[image] == 0:
        return "None of its tracks could be triangulated."
    return "Bundle adjustment dropped it: too few of its observations agreed with the model."


def _listed(reasons: dict[str, int]) -> str:
    parts = [f"{name.replace('_', ' ')} ({count})" for name, count in sorted(reasons.items()) if count]
    return ", ".join(parts) or "no reason recorded"
