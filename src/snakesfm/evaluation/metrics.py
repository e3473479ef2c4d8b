"""The metrics of a model: against reference poses, and those that need no reference."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from snakesfm.arrays import Array
from snakesfm.evaluation.alignment import align_poses
from snakesfm.evaluation.pose_errors import (
    FAILED_DEG,
    chordal_angle_deg,
    compared_images,
    pose_auc,
    relative_pose_errors,
)
from snakesfm.geometry.poses import center_of, has_pose
from snakesfm.geometry.rotations import angle_between
from snakesfm.image_names import match_names

Metrics = dict[str, float | int | None]

FEW_PRESENT = (
    "only {present} of the {count} images of the reference were found by their names, and the others count "
    "as not registered: call images as the reference does."
)


@dataclass(frozen=True)
class Poses:
    """Named cam_from_world poses: names, rotations (n,3,3), translations (n,3); NaN if not registered."""

    names: Sequence[str]
    rotations: Array
    translations: Array

    @property
    def registered(self) -> Array:
        """Which images have a pose, (n,) bool."""
        return has_pose(self.rotations, self.translations)

    @property
    def centers(self) -> Array:
        """The cameras' positions in the world, (n,3)."""
        return center_of(self.rotations, self.translations)


@dataclass(frozen=True)
class PoseEvaluation:
    """Metrics of a model's poses, and the errors of every scored image.

    ``names`` are those of the scored reference images, and ``model_names`` what the model calls them, or
    the same where it lacks them; ``rotation_deg``, ``position`` (reference units) and ``direction_deg``
    (angle between the position vectors from the reference's origin) are NaN where the image is not
    registered.
    """

    metrics: Metrics
    names: list[str] = field(default_factory=list)
    model_names: list[str] = field(default_factory=list)
    rotation_deg: Array = field(default_factory=lambda: np.zeros(0))
    position: Array = field(default_factory=lambda: np.zeros(0))
    direction_deg: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def few_present(self) -> str:
        """What to say where the model lacks more than half of the reference's images, else empty."""
        present, count = self.metrics["reference_images_present"], len(self.names)
        return FEW_PRESENT.format(present=present, count=count) if 2 * (present or 0) < count else ""

    def per_image(self) -> dict[str, dict[str, float | str | None]]:
        """The errors of every scored image by its name in the model, None where it is not registered."""
        columns = {
            "rotation_error_deg": self.rotation_deg.tolist(),
            "translation_angle_deg": self.direction_deg.tolist(),
            "position_error": self.position.tolist(),
        }
        return {
            name: {"reference_name": self.names[k]}
            | {key: None if values[k] != values[k] else values[k] for key, values in columns.items()}
            for k, name in enumerate(self.model_names)
        }


def evaluate_poses(
    model: Poses,
    reference: Poses,
    relative_thresholds_deg: Sequence[float],
    global_thresholds_deg: Sequence[float],
    min_baseline_ratio: float,
) -> PoseEvaluation:
    """Compare a model's poses to reference poses.

    Images are matched by name; those that the reference lacks (or has without a pose) are not scored, and
    scored images that the model lacks count as errors of 180 degrees. Where it has images, but none of the
    reference's, names are not comparable, and there is no AUC.

    Parameters
    ----------
    model, reference : named cam_from_world poses.
    relative_thresholds_deg : AUC of max(rotation, translation direction) over all ordered pairs (GLOMAP),
        or over a sample of four million of them beyond 2,000 images.
    global_thresholds_deg : AUC of max(rotation, angle between the position vectors from the origin) over
        all images after Sim(3) alignment (the Pose AUC of GTSfM; it depends on the reference's origin).
    min_baseline_ratio : pairs closer than this share of the reference's extent have no direction.
    """
    known = reference.registered
    names = [name for name, is_known in zip(reference.names, known, strict=True) if is_known]
    truth = Poses(names, reference.rotations[known], reference.translations[known])
    rows = match_names(model.names, names)
    found, present = _in_order(model, names, rows), int(np.count_nonzero(rows >= 0))
    scored = found.registered
    extent = float(np.linalg.norm(np.ptp(truth.centers, axis=0))) if len(names) else 0.0
    min_baseline = min_baseline_ratio * extent
    scale, rotation_deg, position, direction_deg = _aligned_errors(found, truth, min_baseline)

    metrics: Metrics = {
        "reference_images": len(names),
        "reference_images_present": present,
        "reference_images_registered": int(scored.sum()),
    }
    metrics |= _relative_metrics(found, truth, min_baseline, relative_thresholds_deg)
    pose_errors = np.where(scored, np.maximum(rotation_deg, direction_deg), FAILED_DEG)
    metrics |= _auc_columns("pose_auc", pose_errors, global_thresholds_deg)
    if len(model.names) and not present:
        metrics |= dict.fromkeys((name for name in metrics if "_auc_" in name), None)
    metrics |= _distribution("rotation_error_deg", rotation_deg[scored])
    metrics |= _distribution("translation_angle_deg", direction_deg[scored])
    metrics |= _distribution("position_error", position[scored])
    relative_position = 100.0 * position[scored] / extent if extent > 0 else np.zeros(0)
    metrics |= _distribution("position_error_percent", relative_position)
    metrics["reference_extent"] = extent
    metrics["alignment_scale"] = scale
    model_names = [model.names[row] if row >= 0 else name for row, name in zip(rows, names, strict=True)]
    return PoseEvaluation(metrics, names, model_names, rotation_deg, position, direction_deg)


def _in_order(model: Poses, names: Sequence[str], rows: Array) -> Poses:
    """The model's poses of these images, in its ``rows``, NaN where it lacks one (-1)."""
    present = rows >= 0
    rotations = np.full((len(names), 3, 3), np.nan)
    translations = np.full((len(names), 3), np.nan)
    rotations[present] = model.rotations[rows[present]]
    translations[present] = model.translations[rows[present]]
    return Poses(names, rotations, translations)


def _relative_metrics(
    found: Poses, truth: Poses, min_baseline: float, thresholds_deg: Sequence[float]
) -> Metrics:
    """Errors of the poses of pairs; a pair with an image that is not registered counts in the AUC alone."""
    rotation_deg, direction_deg = relative_pose_errors(
        found.rotations, found.translations, truth.rotations, truth.translations, min_baseline
    )
    compared = compared_images(len(found.names))
    scored = found.registered
    valid = (scored[:, None] & scored[compared]).ravel()
    return {
        **_auc_columns("relative_pose_auc", np.maximum(rotation_deg, direction_deg), thresholds_deg),
        "relative_pairs": compared.size,
        **_distribution("relative_rotation_error_deg", rotation_deg[valid]),
        **_distribution("relative_translation_angle_deg", direction_deg[valid]),
    }


def _aligned_errors(
    found: Poses, truth: Poses, min_length: float
) -> tuple[float | None, Array, Array, Array]:
    """The scale of the Sim(3) alignment, and each image's errors in rotation, position and direction."""
    scored = found.registered
    rotation_deg, position, direction_deg = np.full((3, len(found.names)), np.nan)
    scale = None
    if scored.any():
        rotations, centers = found.rotations[scored], found.centers[scored]
        true_rotations, true_centers = truth.rotations[scored], truth.centers[scored]
        similarity = align_poses(rotations, centers, true_rotations, true_centers)
        scale = similarity.scale
        moved = similarity.transform_points(centers)
        rotation_deg[scored] = chordal_angle_deg(similarity.transform_rotations(rotations), true_rotations)
        position[scored] = np.linalg.norm(moved - true_centers, axis=1)
        direction_deg[scored] = _origin_angles(moved, true_centers, min_length)
    return scale, rotation_deg, position, direction_deg


def model_metrics(
    registered: Array, offsets: Array, errors_px: Array, measured: Array | None = None
) -> Metrics:
    """The columns that need no truth.

    Parameters
    ----------
    registered : (N,) bool, which images have a pose.
    offsets : (T+1,) int64, rows of the observations of each point.
    errors_px : (T,) float64, mean reprojection error of each point in pixels.
    measured : (T,) int64, of how many observations that is the mean; None means all.
    """
    lengths = np.diff(offsets)
    measured = lengths if measured is None else measured
    observations = int(lengths.sum())
    images = int(registered.sum())
    some, with_error = observations > 0, bool(measured.any())
    return {
        "images": len(registered),
        "registered_images": images,
        "points": len(lengths),
        "observations": observations,
        "track_length_mean": float(lengths.mean()) if some else None,
        "track_length_median": float(np.median(lengths)) if some else None,
        "observations_per_image": observations / images if images else None,
        "reprojection_error_px_mean": float(measured @ errors_px / measured.sum()) if with_error else None,
        "reprojection_error_px_median": float(np.median(errors_px[measured > 0])) if with_error else None,
    }


def _origin_angles(centers: Array, reference_centers: Array, min_length: float) -> Array:
    angles = np.degrees(angle_between(centers, reference_centers))
    angles[np.linalg.norm(reference_centers, axis=1) <= min_length] = 0.0
    return angles


def _auc_columns(name: str, errors_deg: Array, thresholds_deg: Sequence[float]) -> Metrics:
    areas = pose_auc(errors_deg, thresholds_deg)
    return {f"{name}_{threshold:g}deg": area for threshold, area in zip(thresholds_deg, areas, strict=True)}


def _distribution(name: str, values: Array) -> Metrics:
    if len(values) == 0:
        return {f"{name}_{part}": None for part in ("median", "mean", "p90", "max")}
    return {
        f"{name}_median": float(np.median(values)),
        f"{name}_mean": float(np.mean(values)),
        f"{name}_p90": float(np.percentile(values, 90)),
        f"{name}_max": float(np.max(values)),
    }
