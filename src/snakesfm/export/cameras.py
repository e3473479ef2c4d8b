"""What a user should know of the cameras of an exported model, a sentence each."""

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from snakesfm.arrays import Array
from snakesfm.bundle.focal_pairs import STRETCHED_MODELS
from snakesfm.export.nerfstudio import camera_warnings
from snakesfm.export.undistorted import FlatCamera
from snakesfm.geometry.camera import Camera
from snakesfm.geometry.lens_fit import MAX_MISFIT, fit_lenses
from snakesfm.geometry.poses import to_camera

OTHER_LENS = (
    "camera {camera} ({model}): reprojection errors grow with distance from the principal point, so this "
    "model does not describe the lens; try another index_images.camera_model (RADIAL, OPENCV) or other "
    "intrinsics."
)

OTHER_GIVEN_LENS = (
    "camera {camera} ({model}): reprojection errors grow with distance from the principal point, so the "
    "given intrinsics do not describe the lens; intrinsics=refine starts from them and refines them."
)

RESET_CAMERA = (
    "camera {camera} ({model}): its {value} was implausible in the last pass of bundle adjustment, so it "
    "was reset and kept fixed; try an index_images.camera_model with fewer parameters, or other intrinsics."
)

FAR_PRINCIPAL_POINT = (
    "camera {camera} ({model}): its principal point seems to lie {value:.1%} of the longer side away from "
    "where it is assumed, but reprojection errors hardly fall there, so it was left; if the images were "
    "cropped, give cameras=, or raise adjust_bundle.max_principal_point_offset."
)

MIXED_FOCALS = (
    "camera {camera} ({model}): its images seem to differ in focal length by {value:.0%}, as by zoom or "
    "of several cameras whose EXIF is lost: put those of each into a folder and set "
    "index_images={{camera_sharing: per_folder}}, or per_image if you cannot tell them apart."
)

STRETCHED = (
    "camera {camera} ({model}): its pixels are not square (fx / fy = {value:.2f}), as of frames of "
    "anamorphic video or images stretched to a size; images in their true proportions give better models."
)

CUT_PICTURE = (
    "camera {camera} ({model}): undistorted/ shows only {value:.0%} of its images, because no flat image "
    "holds a view of about 180 degrees: use images/ and sparse/0 with software for fisheye lenses."
)

OFF_MIDDLE = (
    "camera {camera} ({model}): its principal point is off the middle, where Inria's 3DGS takes it to be: "
    "{value:.0%} of the pixels were cut off in undistorted/."
)

# of each kind: every image of a collection may have a camera of its own
MOST_CAMERAS = 5
MORE_CAMERAS = "{count} more cameras have the problem of the warning before this one."

# of a picture, what is left of it without distortion: normal lenses keep 0.8 and more
LEAST_UNDISTORTED = 0.5
# of its pixels, what may be cropped without a word
MOST_CROPPED = 0.05
# more of them add nothing about a lens
OBSERVATIONS_OF_LENSES = 500_000


def adjusted_warnings(
    cameras: Mapping[int, Camera], resets: Array, offsets: Array, spreads: Array
) -> list[str]:
    """What other tools cannot do with cameras, given by rows, and what bundle adjustment could not.

    Parameters
    ----------
    cameras : those in use, by their rows.
    resets, offsets, spreads : (C,) what the adjustment says of all cameras, see its artifact.
    """
    by_kind: dict[str, list[str]] = {}
    for row, camera in cameras.items():
        for kind, line in camera_warnings(camera, row + 1).items():
            by_kind.setdefault(kind, []).append(line)
    warnings = [line for lines in by_kind.values() for line in _some_cameras(lines)]
    warnings += _sentences(RESET_CAMERA, cameras, {row: resets[row] for row in cameras if resets[row]})
    for sentence, values in ((FAR_PRINCIPAL_POINT, offsets), (MIXED_FOCALS, spreads)):
        known = {row: values[row] for row in cameras if np.isfinite(values[row])}
        warnings += _sentences(sentence, cameras, known)
    return warnings


def _sentences(sentence: str, cameras: Mapping[int, Camera], values: Mapping[int, Any]) -> list[str]:
    """A sentence per camera, by its row, that has a value."""
    return _some_cameras(
        [
            sentence.format(camera=row + 1, model=cameras[row].model, value=value)
            for row, value in values.items()
        ]
    )


def _some_cameras(lines: list[str]) -> list[str]:
    """Of warnings of one kind, a sentence per camera, the first, and of how many more they are true."""
    more = len(lines) - MOST_CAMERAS
    return lines if more < 2 else [*lines[:MOST_CAMERAS], MORE_CAMERAS.format(count=more)]


def lens_warnings(
    cameras: Sequence[Camera],
    camera_ids: Array,
    rotations: Array,
    translations: Array,
    points: Array,
    offsets: Array,
    image_ids: Array,
    keypoints: Array,
    held: Collection[int],
) -> list[str]:
    """A sentence per camera whose lens is not of its model; the parameters of those ``held`` were given.

    The others as of :func:`snakesfm.export.colmap.build_reconstruction`.
    """
    some = slice(None, None, -(-len(image_ids) // OBSERVATIONS_OF_LENSES) or 1)
    images = image_ids[some]
    observed = points[np.repeat(np.arange(len(points)), np.diff(offsets))[some]]
    in_camera = to_camera(rotations[images], translations[images], observed)
    by_row = dict(enumerate(cameras))
    fits = fit_lenses(by_row, camera_ids[images], images, in_camera, keypoints[some])
    misfits = {row: fit.misfit for row, fit in fits.items() if fit.misfit > MAX_MISFIT}
    given = {row: misfit for row, misfit in misfits.items() if row in held}
    others = {row: misfit for row, misfit in misfits.items() if row not in held}
    return _sentences(OTHER_GIVEN_LENS, by_row, given) + _sentences(OTHER_LENS, by_row, others)


def stretched_warnings(cameras: Mapping[int, Camera], former: Sequence[str]) -> list[str]:
    """A sentence per camera, given by its row, that bundle adjustment gave a second focal length."""
    ratios = {
        row: camera.params[0] / camera.params[1]
        for row, camera in cameras.items()
        if camera.model == STRETCHED_MODELS.get(former[row])
    }
    return _sentences(STRETCHED, cameras, ratios)


def flat_warnings(cameras: Mapping[int, Camera], flats: Mapping[int, FlatCamera]) -> list[str]:
    """A sentence per camera, given by its row, of whose pictures without distortion much is missing."""
    little = {row: flat.shown for row, flat in flats.items() if flat.shown < LEAST_UNDISTORTED}
    cropped = {row: flat.cropped for row, flat in flats.items() if flat.cropped > MOST_CROPPED}
    return _sentences(CUT_PICTURE, cameras, little) + _sentences(OFF_MIDDLE, cameras, cropped)
