"""Detection and reset of cameras whose intrinsics have become implausible."""

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from snakesfm.geometry.camera import Camera
from snakesfm.geometry.colmap_binding import pycolmap

WildCause = Literal["focal length", "distortion"]

USUAL_FOCAL_RATIO = 1.2
# where distortion is judged: enough for terms of high degree and for tangential ones
RADII_INSIDE, RADII_BEYOND, DIRECTIONS = 20, 4, 16


def usual_focal_px(camera: Camera) -> float:
    """The focal length of a lens that is neither wide nor long, for images of the camera's size."""
    return USUAL_FOCAL_RATIO * max(camera.width, camera.height)


def is_guessed(camera: Camera) -> bool:
    """Whether a focal length is neither given nor from EXIF."""
    return camera.source not in ("given", "exif")


def longest_focals_px(cameras: Sequence[Camera], max_guessed_focal_change: float) -> dict[int, float]:
    """The longest plausible focal length of each camera, by id, whose own is guessed."""
    return {
        row + 1: max_guessed_focal_change * usual_focal_px(camera)
        for row, camera in enumerate(cameras)
        if is_guessed(camera)
    }


def reset_wild_cameras(
    reconstruction: pycolmap.Reconstruction,
    cameras: Sequence[Camera],
    before: Mapping[int, Sequence[float]],
    max_focal_change: float,
    max_guessed_focal_change: float,
    max_distortion: float,
) -> dict[int, WildCause]:
    """Give cameras whose intrinsics left what is plausible former ones back.

    A wild focal length goes back to the first one, as it runs off over several passes. Wild distortion goes
    back to that before the pass, which the poses fit better, but for one that was wild, too.

    Parameters
    ----------
    reconstruction : changed in place.
    cameras : the intrinsics before any adjustment.
    before : parameters before the pass, by id.
    max_focal_change : factor up or down, of a focal length that was given or in EXIF.
    max_guessed_focal_change : factor of a usual focal length for all others; what matches tell of a long
        lens is several times too short.
    max_distortion : largest :func:`equivalent_distortion`; first intrinsics that have more may keep it.

    Returns
    -------
    What was wild, by the camera's id.
    """
    wild: dict[int, WildCause] = {}
    for row, start in enumerate(cameras):
        camera = reconstruction.camera(row + 1)
        focal = camera.mean_focal_length()
        if is_guessed(start):
            change, most = focal / usual_focal_px(start), max_guessed_focal_change
        else:
            change, most = focal / start.focal_px, max_focal_change
        if not 1 / most <= change <= most:
            wild[row + 1] = "focal length"
            camera.params = list(start.params)
            continue
        allowed = max(max_distortion, equivalent_distortion(start.to_pycolmap()))
        if equivalent_distortion(camera) > allowed:
            wild[row + 1] = "distortion"
            camera.params = list(before[row + 1])
            if equivalent_distortion(camera) > allowed:
                camera.params = list(start.params)
    return wild


def equivalent_distortion(camera: pycolmap.Camera) -> float:
    """How strong a camera's distortion is, as the coefficient of a SIMPLE_RADIAL camera that is as strong.

    Single terms of models with many tell nothing, as they make up for each other. So what counts is how
    far all of them together move a pixel of a disc around the principal point, at most, over its radius.
    The disc is as wide as the longer side of the image, but not wider than the view of a usual lens.

    Parameters
    ----------
    camera : of any model; its focal length is positive.

    Returns
    -------
    In a view narrower than that of a usual lens, the coefficient that does the same in the latter's:
    distortion counts in squared tangents, which are small in a narrow view. Infinite where the distortion
    folds in the disc, or out to the corners of the image where the disc is as wide as that.
    """
    terms = camera.extra_params_idxs()
    straight = np.array(camera.params)
    if not straight[terms].any():
        return 0.0
    straight[terms] = 0.0
    undistorted = pycolmap.Camera(
        model=camera.model, width=camera.width, height=camera.height, params=straight
    )
    size_px, usual_tangent = max(camera.width, camera.height), 0.5 / USUAL_FOCAL_RATIO
    radius_px = min(0.5 * size_px, usual_tangent * camera.mean_focal_length())
    corner_px = radius_px * np.hypot(camera.width, camera.height) / size_px
    inside = np.linspace(0.0, radius_px, RADII_INSIDE + 1)
    radii = np.r_[inside, np.linspace(radius_px, corner_px, RADII_BEYOND + 1)[1:]]
    angles = np.linspace(0.0, 2 * np.pi, DIRECTIONS, endpoint=False)
    outward = np.column_stack([np.cos(angles), np.sin(angles)])
    pixels = radii[:, None, None] * outward
    center = straight[camera.principal_point_idxs()]
    rays = np.asarray(undistorted.cam_from_img((center + pixels).reshape(-1, 2)))
    distorted = np.asarray(camera.img_from_cam(np.column_stack([rays, np.ones(len(rays))])))
    distorted = distorted.reshape(pixels.shape) - center
    if not (np.diff((distorted * outward).sum(axis=2), axis=0) > 0).all():
        return float("inf")
    moved_px = np.linalg.norm(distorted - pixels, axis=2)[: len(inside)]
    return float(moved_px.max() / radius_px / usual_tangent**2)
