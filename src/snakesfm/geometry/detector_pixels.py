"""Pixels of the images as the detector saw them.

Keypoints are found in images that are scaled down and kept in original pixels, where they are as many times
less exact as the images are larger. Thresholds in pixels therefore count in detector pixels, and so do
residuals: else the same photographs in 12 megapixels would be judged four times as strictly, and in a
collection of several sizes the largest images would outweigh all others. Artifacts hold original pixels.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from snakesfm.arrays import Array
from snakesfm.geometry.camera import Camera
from snakesfm.geometry.detector_sides import LEAST_SIDE_PX, LONGER_SIDE, SHORTER_SIDE


def detector_scales(sizes: Array, settings: Mapping[str, Any]) -> Array:
    """How many original pixels a detector pixel of each image is wide, (N,) float64 of at least one.

    Parameters
    ----------
    sizes : (N,2) width and height in original pixels.
    settings : a job's: to which shorter or longer side images are scaled down; ones where neither is said.
    """
    sides = np.asarray(sizes, dtype=np.float64).reshape(-1, 2)
    scales: Array = np.ones(len(sides))
    if SHORTER_SIDE in settings:
        scales = np.maximum(1.0, sides.min(axis=1) / float(settings[SHORTER_SIDE]))
    elif LONGER_SIDE in settings:
        wanted = sides.max(axis=1) / float(settings[LONGER_SIDE])
        scales = np.maximum(1.0, np.minimum(wanted, sides.min(axis=1) / LEAST_SIDE_PX))
    return scales


def detector_sizes(sizes: Array, settings: Mapping[str, Any]) -> Array:
    """Sizes (N,2) of images in detector pixels, int32; arguments as for :func:`detector_scales`."""
    reduced: Array = np.rint(sizes / detector_scales(sizes, settings)[:, None]).astype(np.int32)
    return reduced


def reduce_keypoints(keypoints: Array, scale: float) -> Array:
    """Keypoints (K,2) of one image from original pixels to detector pixels, of the same dtype."""
    return keypoints if scale == 1.0 else keypoints / keypoints.dtype.type(scale)


def reduce_all_keypoints(
    keypoints: Sequence[Array], sizes: Array, settings: Mapping[str, Any]
) -> list[Array]:
    """Keypoints (K,2) of each image from original pixels to the detector pixels of a job's settings.

    Parameters
    ----------
    keypoints : of N images.
    sizes, settings : as for :func:`detector_scales`.
    """
    scales = detector_scales(sizes, settings).tolist()
    return [reduce_keypoints(found, scale) for found, scale in zip(keypoints, scales, strict=True)]


def reduce_cameras(cameras: Sequence[Camera], settings: Mapping[str, Any]) -> list[Camera]:
    """Cameras from original pixels to the detector pixels of a job's settings."""
    scales = _camera_scales(cameras, settings)
    return [camera.scaled(1.0 / scale) for camera, scale in zip(cameras, scales, strict=True)]


def restore_cameras(
    cameras: Sequence[Camera], originals: Sequence[Camera], settings: Mapping[str, Any]
) -> list[Camera]:
    """Cameras from detector pixels to original pixels; what did not change is the original again.

    Parameters
    ----------
    cameras : in detector pixels.
    originals : the same cameras as they were before :func:`reduce_cameras`.
    """
    return [
        original if camera == before else camera.scaled(scale, (original.width, original.height))
        for camera, before, original, scale in zip(
            cameras,
            reduce_cameras(originals, settings),
            originals,
            _camera_scales(originals, settings),
            strict=True,
        )
    ]


def _camera_scales(cameras: Sequence[Camera], settings: Mapping[str, Any]) -> list[float]:
    sizes = np.array([(camera.width, camera.height) for camera in cameras])
    scales: list[float] = detector_scales(sizes, settings).tolist()
    return scales
