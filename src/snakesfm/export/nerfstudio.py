"""A model as nerfstudio's transforms.json."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snakesfm.geometry.camera import Camera
from snakesfm.geometry.poses import center_of

Array = NDArray[Any]
PERSPECTIVE_TERMS = ("k1", "k2", "k3", "p1", "p2")
FISHEYE_TERMS = ("k1", "k2", "k3", "k4")
GRID = 25
ROUND_TRIP_PX = 0.5
FIT_PX = 0.5


def is_fisheye(camera: Camera) -> bool:
    """Whether the camera's distortion is a function of the angle to the optical axis."""
    return "FISHEYE" in camera.model


def transforms(
    names: Sequence[str],
    camera_ids: Array,
    cameras: Sequence[Camera],
    rotations: Array,
    translations: Array,
    registered: Array,
    masks: Mapping[str, str],
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
    together with the focal length, which is linear least squares over a grid of pixels.
    """
    matrix = camera.to_pycolmap().calibration_matrix()
    content: dict[str, Any] = {
        "camera_model": "OPENCV_FISHEYE" if is_fisheye(camera) else "OPENCV",
        "w": camera.width,
        "h": camera.height,
        "fl_x": float(matrix[0, 0]),
        "fl_y": float(matrix[1, 1]),
        "cx": float(matrix[0, 2]),
        "cy": float(matrix[1, 2]),
    }
    terms = FISHEYE_TERMS if is_fisheye(camera) else PERSPECTIVE_TERMS
    native = _native_terms(camera, terms)
    if native is not None:
        return content | native
    scale, fitted, _ = _fit_terms(camera)
    content["fl_x"], content["fl_y"] = scale * content["fl_x"], scale * content["fl_y"]
    return content | dict(zip(terms, fitted, strict=True))


def camera_warnings(camera: Camera, camera_id: int) -> list[str]:
    """What a user of the exported camera should know: distortion that folds or is only approximate."""
    warnings = []
    pixels = _pixel_grid(camera)
    rays = camera.normalize(pixels)
    again = np.asarray(camera.to_pycolmap().img_from_cam(np.column_stack([rays, np.ones(len(rays))])))
    gap = np.linalg.norm(again - pixels, axis=1)
    if not np.all(gap < ROUND_TRIP_PX):
        warnings.append(
            f"camera {camera_id} ({camera.model}): the distortion is not invertible in the whole image, "
            "so tools that undistort will show folds near its corners."
        )
        return warnings
    terms = FISHEYE_TERMS if is_fisheye(camera) else PERSPECTIVE_TERMS
    if _native_terms(camera, terms) is None:
        error = _fit_terms(camera)[2]
        if error > FIT_PX:
            warnings.append(
                f"camera {camera_id} ({camera.model}): transforms.json approximates the distortion "
                f"to {error:.1f} px."
            )
    return warnings


def _native_terms(camera: Camera, terms: tuple[str, ...]) -> dict[str, float] | None:
    """The distortion terms under nerfstudio's names, None if one that is not zero has none."""
    names = [name.strip() for name in camera.to_pycolmap().params_info.split(",")]
    found = dict.fromkeys(terms, 0.0)
    for name, value in zip(names, camera.params, strict=True):
        if name in {"f", "fx", "fy", "cx", "cy"}:
            continue
        name = "k1" if name == "k" else name
        if name in found and "THIN_PRISM" not in camera.model and "DIVISION" not in camera.model:
            found[name] = float(value)
        elif value != 0.0 or camera.model == "FOV":
            return None
    return found


def _pixel_grid(camera: Camera) -> Array:
    columns, rows = np.meshgrid(
        np.linspace(0.5, camera.width - 0.5, GRID), np.linspace(0.5, camera.height - 0.5, GRID)
    )
    return np.column_stack([columns.ravel(), rows.ravel()])


def _fit_terms(camera: Camera) -> tuple[float, list[float], float]:
    """Focal scale and distortion terms fitted over a grid of pixels, and the largest error in pixels."""
    pixels = _pixel_grid(camera)
    rays = camera.normalize(pixels)
    # where distortion folds, pixels have none
    told = np.isfinite(rays).all(axis=1)
    pixels, (x, y) = pixels[told], rays[told].T
    matrix = camera.to_pycolmap().calibration_matrix()
    focal = matrix[[0, 1], [0, 1]]
    distorted = (pixels - matrix[:2, 2]) / focal
    squared = x**2 + y**2
    if is_fisheye(camera):
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
    return scale, (solution[1:] / scale).tolist(), float(np.linalg.norm(residuals, axis=1).max())
