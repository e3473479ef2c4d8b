"""Registration of images that averaging left out, by their matches to points of the model."""

from typing import Any

import cv2  # noqa: F401 - must be loaded before pycolmap, whose PNG library clashes otherwise
import numpy as np
import poselib
import pycolmap
from numpy.typing import NDArray

from snakesfm.bundle.model import observations_of
from snakesfm.geometry.poses import to_rigid3d

Array = NDArray[Any]


def register_left_out(
    reconstruction: pycolmap.Reconstruction,
    graph: pycolmap.CorrespondenceGraph,
    max_error_px: float,
    min_inliers: int,
    min_ratio: float,
    seed: int,
) -> list[int]:
    """Register the images that have enough matches to points, most matches first, in one pass.

    Absolute pose by LO-RANSAC over P3P with a final refinement (poselib). The inlier matches become
    observations.

    Parameters
    ----------
    reconstruction : changed in place.
    graph : inlier matches, also of the images that are left out.
    max_error_px : largest reprojection error of an inlier.
    min_inliers, min_ratio : what a pose must have to be accepted.
    seed : of RANSAC.

    Returns
    -------
    Rows of the images that were registered.
    """
    registered = set(reconstruction.reg_image_ids())
    left_out = sorted(set(reconstruction.images) - registered)
    if not left_out:
        return []
    point_of = _points_of_keypoints(reconstruction)
    found = {image: _matched_points(graph, image, point_of) for image in left_out}
    done = []
    for image_id in sorted(left_out, key=lambda image: (-len(found[image]), image)):
        if len(found[image_id]) < min_inliers:
            continue
        if _register(reconstruction, image_id, found[image_id], max_error_px, min_inliers, min_ratio, seed):
            done.append(image_id - 1)
    return done


def _points_of_keypoints(reconstruction: pycolmap.Reconstruction) -> dict[tuple[int, int], int]:
    ids = sorted(reconstruction.point3D_ids())
    _, points, images, rows = observations_of(reconstruction)
    return {
        (image + 1, row): ids[point]
        for point, image, row in zip(points.tolist(), images.tolist(), rows.tolist(), strict=True)
    }


def _matched_points(
    graph: pycolmap.CorrespondenceGraph, image_id: int, point_of: dict[tuple[int, int], int]
) -> Array:
    """Rows (keypoint, point id, votes): for each keypoint the point that most of its matches observe."""
    votes: dict[tuple[int, int], int] = {}
    for other in sorted({image for image, _ in point_of}):
        matches = graph.extract_matches_between_images(image_id, other)
        for mine, theirs in np.asarray(matches).reshape(-1, 2).tolist():
            point = point_of.get((other, theirs))
            if point is not None:
                votes[mine, point] = votes.get((mine, point), 0) + 1
    ranked = sorted((mine, -count, point) for (mine, point), count in votes.items())
    best: dict[int, tuple[int, int]] = {}
    for mine, count, point in ranked:
        best.setdefault(mine, (point, -count))
    # a point is seen once by an image: the keypoint with most votes keeps it
    owners: dict[int, tuple[int, int]] = {}
    for mine, (point, count) in best.items():
        if point not in owners or count > owners[point][1]:
            owners[point] = (mine, count)
    return np.array(
        sorted((mine, point, count) for point, (mine, count) in owners.items()), dtype=np.int64
    ).reshape(-1, 3)


def _register(
    reconstruction: pycolmap.Reconstruction,
    image_id: int,
    matched: Array,
    max_error_px: float,
    min_inliers: int,
    min_ratio: float,
    seed: int,
) -> bool:
    image = reconstruction.image(image_id)
    camera = reconstruction.camera(image.camera_id)
    pixels = np.array([image.point2D(int(row)).xy for row in matched[:, 0]])
    points = np.array([reconstruction.point3D(int(point)).xyz for point in matched[:, 1]])
    description = {
        "model": camera.model_name,
        "width": camera.width,
        "height": camera.height,
        "params": list(camera.params),
    }
    pose, info = poselib.estimate_absolute_pose(
        pixels,
        points,
        description,
        {"max_reproj_error": max_error_px, "seed": seed},
        {"loss_type": "CAUCHY", "loss_scale": 1.0},
    )
    inliers = np.asarray(info["inliers"], dtype=bool)
    if inliers.sum() < max(min_inliers, min_ratio * len(matched)):
        return False
    rigid = to_rigid3d(pose.R, pose.t)
    image.frame.set_cam_from_world(image.camera_id, rigid)
    reconstruction.register_frame(image.frame_id)
    for row, point, _ in matched[inliers].tolist():
        reconstruction.add_observation(point, pycolmap.TrackElement(image_id, row))
    return True
