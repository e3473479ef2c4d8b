"""pycolmap's global positioning."""

import numpy as np

from snakesfm.arrays import Array
from snakesfm.geometry.colmap_binding import pycolmap
from snakesfm.grouping import sum_by
from snakesfm.translation_averaging.problem import PositioningProblem

FOCAL_PX = 1000.0


def position_globally(problem: PositioningProblem, loss_scale: float, seed: int) -> Array:
    """Centres (N,3) from rays alone; NaN for images without rays.

    The rays are handed over as pixels of virtual cameras that look along the mean ray of their image.
    Cameras and landmarks begin at random places. Ceres adds up in several threads, so results of two runs
    differ: by 1e-10 of the extent where no ray is wrong, and where a tenth of them is by up to
    thousandths in scale and 3e-4 in shape, on a street by thousandths in both (30 to 600 cameras).
    """
    pycolmap.logging.minloglevel = 2
    images, rows = np.unique(problem.ray_images, return_inverse=True)
    rotations = _facing(problem.rays, rows, len(images))
    local = np.einsum("qij,qj->qi", rotations[rows], problem.rays)
    usable = local[:, 2] > 0.01
    problem, tracks = problem.select_rays(usable).number_tracks()
    local = local[usable]
    lengths = np.bincount(problem.ray_tracks, minlength=len(tracks))
    starts = np.cumsum(lengths) - lengths

    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        camera_id=1, model="PINHOLE", width=1, height=1, params=[FOCAL_PX, FOCAL_PX, 0.0, 0.0]
    )
    model.add_camera_with_trivial_rig(camera)
    order = np.argsort(problem.ray_images, kind="stable")
    bounds = np.searchsorted(problem.ray_images[order], images, side="left")
    ends = np.searchsorted(problem.ray_images[order], images, side="right")
    keypoint = np.empty(len(order), dtype=np.int64)
    pixels = local[:, :2] / local[:, 2:] * FOCAL_PX
    for row, image in enumerate(images.tolist()):
        mine = order[bounds[row] : ends[row]]
        keypoint[mine] = np.arange(len(mine))
        model.add_image_with_trivial_frame(
            pycolmap.Image(name=str(image), camera_id=1, image_id=image + 1, keypoints=pixels[mine])
        )
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotations[row]), np.zeros(3))
        frame = model.image(image + 1).frame
        frame.set_cam_from_world(1, pose)
        model.register_frame(frame.frame_id)
    for first, length in zip(starts.tolist(), lengths.tolist(), strict=True):
        elements = [
            pycolmap.TrackElement(int(problem.ray_images[q]) + 1, int(keypoint[q]))
            for q in range(first, first + length)
        ]
        model.add_point3D(np.zeros(3), pycolmap.Track(elements))

    options = pycolmap.GlobalPositionerOptions()
    options.use_gpu = False
    options.random_seed = seed
    options.loss_function_scale = loss_scale
    options.min_num_view_per_track = 2
    centers = np.full((problem.image_count, 3), np.nan)
    if pycolmap.run_global_positioning(options, pycolmap.PoseGraph(), model):
        for image in images.tolist():
            centers[image] = model.image(image + 1).projection_center()
    return centers


def _facing(rays: Array, rows: Array, count: int) -> Array:
    """Rotations (count,3,3) whose z axis is the mean ray of each image."""
    forward = sum_by(rays, rows, count)
    forward /= np.maximum(np.linalg.norm(forward, axis=1, keepdims=True), 1e-12)
    helper = np.eye(3)[np.argmin(np.abs(forward), axis=1)]
    right = np.cross(helper, forward)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return np.stack([right, np.cross(forward, right), forward], axis=1)
