"""A model as COLMAP's reconstruction object, which writes binary, text and PLY."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from snakesfm.arrays import Array
from snakesfm.geometry.camera import Camera
from snakesfm.geometry.colmap_binding import pycolmap
from snakesfm.geometry.colmap_writing import keypoints_of_observations, with_observations
from snakesfm.geometry.poses import has_pose, to_rigid3d
from snakesfm.grouping import rows_of_each


def build_reconstruction(
    names: Sequence[str],
    camera_ids: Array,
    cameras: Sequence[Camera],
    rotations: Array,
    translations: Array,
    points: Array,
    colors: Array,
    errors_px: Array,
    offsets: Array,
    image_ids: Array,
    keypoints: Array,
    all_keypoints: tuple[Array, Sequence[Array]] | None = None,
) -> pycolmap.Reconstruction:
    """A pycolmap reconstruction of the registered images.

    Ids are rows plus one: image k of the index is COLMAP image k + 1, so too for cameras and points.
    Cameras without a registered image are left out.

    Parameters
    ----------
    names : N image names, relative POSIX paths.
    camera_ids : (N,) int, row of each image's camera in ``cameras``.
    rotations, translations : (N,3,3), (N,3) cam_from_world; NaN where not registered.
    points, colors, errors_px : (T,3) float64, (T,3) uint8 RGB, (T,) mean reprojection error in pixels.
    offsets, image_ids, keypoints : (T+1,), (L,), (L,2): observations of the points, in original pixels.
    all_keypoints : the observation's row (L,) among the keypoints of its image, and per image all of these
        (K_i,2), which become its points2D; the points2D of None are the observations in the order of the
        points.

    Raises
    ------
    ValueError : a point is observed by an image that is not registered.
    ConfigError : the installed pycolmap has binary files of another layout.
    """
    registered = np.flatnonzero(has_pose(rotations, translations))
    if not np.isin(image_ids, registered).all():
        raise ValueError("points are observed by images without a pose")
    model = pycolmap.Reconstruction()
    for row in sorted({int(camera_ids[image]) for image in registered}):
        model.add_camera_with_trivial_rig(cameras[row].to_pycolmap(row + 1))
    for row in registered.tolist():
        image = pycolmap.Image(name=names[row], camera_id=int(camera_ids[row]) + 1, image_id=row + 1)
        model.add_image_with_trivial_frame(image, to_rigid3d(rotations[row], translations[row]))
    if all_keypoints is None:
        per_image, keypoint_ids = keypoints_of_observations(image_ids, keypoints, len(names))
    else:
        keypoint_ids, per_image = all_keypoints[0], list(all_keypoints[1])
        for image, mine in rows_of_each(image_ids):
            # what was observed was refined
            per_image[image] = np.array(per_image[image], np.float64)
            per_image[image][keypoint_ids[mine]] = keypoints[mine]
    return with_observations(model, per_image, points, offsets, image_ids, keypoint_ids, colors, errors_px)


def other_model_sizes(models: Array) -> list[int]:
    """Images of each model beside the first.

    Parameters
    ----------
    models : (N,) model of each image, 0 the first; -1 where it has no pose.
    """
    sizes: list[int] = np.bincount(models[models > 0])[1:].tolist()
    return sizes


def summarize(
    scene: str,
    names: Sequence[str],
    models: Array,
    offsets: Array,
    errors_px: Array,
    warnings: Sequence[str],
) -> Mapping[str, Any]:
    """What summary.json says of the first model.

    Parameters
    ----------
    models : (N,) model of each image, 0 the first; -1 where it has no pose.
    offsets, errors_px : (T+1,) and (T,): observations and mean reprojection error of the points.
    """
    lengths = np.diff(offsets)
    observations = int(lengths.sum())
    return {
        "scene": scene,
        "images": len(names),
        "registered_images": int(np.count_nonzero(models == 0)),
        "images_in_other_models": other_model_sizes(models),
        "not_registered": [names[row] for row in np.flatnonzero(models < 0).tolist()],
        "points": len(lengths),
        "observations": observations,
        "mean_track_length": observations / len(lengths) if len(lengths) else 0.0,
        "mean_reprojection_error_px": float(lengths @ errors_px) / observations if observations else 0.0,
        "warnings": list(warnings),
    }
