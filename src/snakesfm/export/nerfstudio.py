"""A model as nerfstudio's transforms.json."""

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np

from snakesfm.arrays import Array
from snakesfm.geometry.camera import WIDE_MODELS, Camera
from snakesfm.geometry.poses import center_of

PERSPECTIVE_TERMS = ("k1", "k2", "k3", "p1", "p2")
FISHEYE_TERMS = ("k1", "k2", "k3", "k4")
GRID = 25
ROUND_TRIP_PX = 0.5
FIT_PX = 0.5
# of the grid's pixels, a tenth: fewer tell no lens
LEAST_PIXELS = GRID**2 // 10


def transforms(
    names: Sequence[str],
    camera_ids: Array,
    cameras: Sequence[Camera],
    rotations: Array,
    translations: Array,
    registered: Array,
    masks: Mapping[str, str],
    is_placed: bool = False,
) -> dict[str, Any]:
    """The content of transforms.json.

    Poses are camera-to-world with OpenGL axes (x right, y up, z back) in the same world as the COLMAP model
    and points.ply: ``applied_transform`` is the identity, because readers disagree on whether it has been
    applied to the points. Intrinsics stand at the top if all registered images share a camera, else in
    every frame.

    Parameters
    ----------
    names, camera_ids, cameras : images of the index and their cameras, pixel centres at .5.
    rotations, translations : (N,3,3), (N,3) cam_from_world.
    registered : rows of the images that have a pose.
    masks : of each image by its name, as paths relative to ``masks/``; empty for none, as nerfstudio takes
        one for every image or no one.
    is_placed : whether z is up, so that nerfstudio is not to turn the world by the cameras' upper sides.
    """
    used = sorted({int(camera_ids[row]) for row in registered})
    intrinsics = {row: camera_intrinsics(cameras[row]) for row in used}
    kinds = sorted({content["camera_model"] for content in intrinsics.values()})
    content: dict[str, Any] = {"camera_model": kinds[0] if len(kinds) == 1 else "OPENCV"}
    if len(used) == 1:
        content |= intrinsics[used[0]]
    frames = []
    for row in sorted(registered.tolist(), key=lambda row: names[row]):
        frame: dict[str, Any] = {
            "file_path": f"images/{names[row]}",
            "transform_matrix": opengl_world_from_cam(rotations[row], translations[row]).tolist(),
            "colmap_im_id": row + 1,
        }
        if masks:
            frame["mask_path"] = f"masks/{masks[names[row]]}"
        if len(used) > 1:
            frame |= intrinsics[int(camera_ids[row])]
        frames.append(frame)
    content["frames"] = frames
    content["applied_transform"] = np.eye(4)[:3].tolist()
    content["ply_file_path"] = "points.ply"
    if is_placed:
        content["orientation_override"] = "none"
    return content


def opengl_world_from_cam(rotation: Array, translation: Array) -> Array:
    """world_from_cam (4,4) with OpenGL's camera axes from a cam_from_world pose with OpenCV's."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation.T * np.array([1.0, -1.0, -1.0])
    matrix[:3, 3] = center_of(rotation, translation)
    return matrix


def camera_intrinsics(camera: Camera) -> dict[str, Any]:
    """Intrinsics in nerfstudio's names; distortion as OPENCV or OPENCV_FISHEYE.

    COLMAP models whose terms all have a name there are copied. Of the others the distortion is fitted
    together with the focal length, which is linear least squares over a grid of pixels; all terms are 0
    where that fails.
    """
    matrix = camera.to_pycolmap().calibration_matrix()
    content: dict[str, Any] = {
        "camera_model": "OPENCV_FISHEYE" if camera.is_fisheye else "OPENCV",
        "w": camera.width,
        "h": camera.height,
        "fl_x": float(matrix[0, 0]),
        "fl_y": float(matrix[1, 1]),
        "cx": float(matrix[0, 2]),
        "cy": float(matrix[1, 2]),
    }
    native = _native_terms(camera)
    if native is not None:
        return content | native
    fit = _fit_terms(camera)
    if fit is None:
        return content | dict.fromkeys(_term_names(camera), 0.0)
    scale, fitted, _ = fit
    content["fl_x"], content["fl_y"] = scale * content["fl_x"], scale * content["fl_y"]
    return content | dict(zip(_term_names(camera), fitted, strict=True))


def camera_warnings(camera: Camera, camera_id: int) -> dict[str, str]:
    """What a user of the exported camera should know, by kind: distortion that folds or is approximate."""
    warnings: dict[str, str] = {}
    *_, held = _rays_of_grid(camera)
    if not held.all():
        warnings["folds"] = (
            f"camera {camera_id} ({camera.model}): the distortion is not invertible in the whole image, "
            "so undistorted images will show folds near their corners."
        )
    if _native_terms(camera) is not None:
        return warnings
    fit = _fit_terms(camera)
    if fit is None:
        warnings["no distortion"] = (
            f"camera {camera_id} ({camera.model}): too little of the image is within the lens's field of "
            "view to fit its distortion, so transforms.json has none: check the intrinsics."
        )
    elif fit[2] > FIT_PX:
        warnings["approximate"] = (
            f"camera {camera_id} ({camera.model}): transforms.json approximates the distortion "
            f"to {fit[2]:.1f} px."
        )
    return warnings


def _term_names(camera: Camera) -> tuple[str, ...]:
    return FISHEYE_TERMS if camera.is_fisheye else PERSPECTIVE_TERMS


def _native_terms(camera: Camera) -> dict[str, float] | None:
    """The distortion terms under nerfstudio's names, None if one that is not zero has none."""
    if camera.model in WIDE_MODELS:
        return None
    names = [name.strip() for name in camera.to_pycolmap().params_info.split(",")]
    found = dict.fromkeys(_term_names(camera), 0.0)
    for name, value in zip(names, camera.params, strict=True):
        if name in {"f", "fx", "fy", "cx", "cy"}:
            continue
        name = "k1" if name == "k" else name
        if name in found and "THIN_PRISM" not in camera.model:
            found[name] = float(value)
        elif value != 0.0:
            return None
    return found


def _rays_of_grid(camera: Camera) -> tuple[Array, Array, Array]:
    """A grid of pixels (G,2), their rays (G,2) on the plane z = 1, and which of these lead back, (G,)."""
    columns, rows = np.meshgrid(
        np.linspace(0.5, camera.width - 0.5, GRID), np.linspace(0.5, camera.height - 0.5, GRID)
    )
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    rays = camera.normalize(pixels)
    again = np.asarray(camera.to_pycolmap().img_from_cam(np.column_stack([rays, np.ones(len(rays))])))
    return pixels, rays, np.linalg.norm(again - pixels, axis=1) < ROUND_TRIP_PX


@cache
def _fit_terms(camera: Camera) -> tuple[float, list[float], float] | None:
    """Focal scale and distortion terms fitted over a grid of pixels, and the largest error in pixels.

    Pixels that lie outside the lens have no say; None where too few are left, or a fit makes no lens.
    Kept, as both the intrinsics and the warnings are of it.
    """
    pixels, rays, held = _rays_of_grid(camera)
    if held.sum() < LEAST_PIXELS:
        return None
    matrix = camera.to_pycolmap().calibration_matrix()
    focal = matrix[[0, 1], [0, 1]]
    distorted = (pixels[held] - matrix[:2, 2]) / focal
    x, y = rays[held].T
    squared = x**2 + y**2
    if camera.is_fisheye:
        radius = np.sqrt(squared)
        theta = np.arctan(radius)
        ratio = np.divide(theta, radius, out=np.ones_like(theta), where=radius > 0)
        base = np.column_stack([x * ratio, y * ratio])
        columns = [base * (theta**power)[:, None] for power in (2, 4, 6, 8)]
    else:
        base = np.column_stack([x, y])
        columns = [base * (squared**power)[:, None] for power in (1, 2, 3)]
        columns.append(np.column_stack([2 * x * y, squared + 2 * y**2]))
        columns.append(np.column_stack([squared + 2 * x**2, 2 * x * y]))
    design = np.column_stack([(column * focal).ravel() for column in (base, *columns)])
    target = (distorted * focal).ravel()
    solution = np.linalg.lstsq(design, target, rcond=None)[0]
    residuals = (design @ solution - target).reshape(-1, 2)
    scale = float(solution[0])
    if scale <= 0:
        return None
    return scale, (solution[1:] / scale).tolist(), float(np.linalg.norm(residuals, axis=1).max())
