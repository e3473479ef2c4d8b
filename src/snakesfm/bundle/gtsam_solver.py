"""Bundle adjustment by gtsam: a factor graph and Levenberg-Marquardt."""

from typing import Any

import gtsam
import numpy as np

from snakesfm.bundle.interface import SolverSettings
from snakesfm.bundle.reading import read_tracks_and_pixels
from snakesfm.errors import ConfigError
from snakesfm.geometry.colmap_binding import pycolmap
from snakesfm.geometry.poses import to_rigid3d

TIGHT, FREE = 1e-6, 1e6
MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")


def adjust_gtsam(reconstruction: pycolmap.Reconstruction, settings: SolverSettings) -> tuple[float, float]:
    """One pass of gtsam's Levenberg-Marquardt over ``GeneralSFMFactor2``.

    One calibration key per camera; held intrinsics are replaced by a pinhole and undistorted observations.
    Gauge: a prior on the first pose and the distance to the image farthest from it.

    Raises
    ------
    ConfigError : a camera to be refined has a model that gtsam lacks.
    """
    images = sorted(reconstruction.reg_image_ids())
    if len(images) < 2 or reconstruction.num_points3D() == 0:
        return 0.0, 0.0
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    held = {c for c in reconstruction.cameras if _is_held(reconstruction.camera(c), c, settings)}
    for image_id in images:
        values.insert(_pose(image_id), _world_from_cam(reconstruction.image(image_id)))
    priors = gtsam.NonlinearFactorGraph()
    for camera_id in sorted({reconstruction.image(i).camera_id for i in images}):
        _add_calibration(reconstruction.camera(camera_id), camera_id, held, settings, priors, values)
    tracks, pixels = read_tracks_and_pixels(reconstruction)
    for row, point in enumerate(tracks.points):
        values.insert(_point(row), point)
    noise = _noise(settings)
    for point, image_row, pixel in zip(
        tracks.point_rows.tolist(), tracks.images.tolist(), pixels, strict=True
    ):
        camera_id = reconstruction.image(image_row + 1).camera_id
        camera = reconstruction.camera(camera_id)
        measured, factor = pixel, _factor(camera.model_name)
        if camera_id in held:
            undistorted = camera.cam_from_img(pixel)
            measured, factor = undistorted * camera.mean_focal_length(), gtsam.GeneralSFMFactor2Cal3_S2
        graph.add(factor(measured, noise, _pose(image_row + 1), _point(point), _calibration(camera_id)))
    before = float(graph.error(values))
    _fix_gauge(priors, values, images, settings)
    graph.push_back(priors)
    result = _optimize(graph, values, settings)
    _write_back(reconstruction, result, images, held)
    return before, float(graph.error(result) - priors.error(result))


def _pose(image_id: int) -> int:
    return int(gtsam.symbol("x", image_id))


def _point(row: int) -> int:
    return int(gtsam.symbol("p", row))


def _calibration(camera_id: int) -> int:
    return int(gtsam.symbol("k", camera_id))


def _is_held(camera: pycolmap.Camera, camera_id: int, settings: SolverSettings) -> bool:
    refined = settings.refine_focal or settings.refine_distortion
    return camera_id in settings.constant_cameras or not refined


def _world_from_cam(image: pycolmap.Image) -> Any:
    pose = image.cam_from_world().inverse()
    return gtsam.Pose3(gtsam.Rot3(pose.rotation.matrix()), np.array(pose.translation))


def _factor(model: str) -> Any:
    if model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"):
        return gtsam.GeneralSFMFactor2Cal3Bundler
    return gtsam.GeneralSFMFactor2Cal3DS2 if model == "OPENCV" else gtsam.GeneralSFMFactor2Cal3_S2


def _add_calibration(
    camera: pycolmap.Camera,
    camera_id: int,
    held: set[int],
    settings: SolverSettings,
    priors: Any,
    values: Any,
) -> None:
    """The calibration's value, and a prior that is tight on every parameter that is not refined."""
    key, p = _calibration(camera_id), [float(v) for v in camera.params]
    value: Any
    kind: Any
    focal = FREE if settings.refine_focal else TIGHT
    bent = FREE if settings.refine_distortion else TIGHT
    if camera_id in held:
        f = float(camera.mean_focal_length())
        value, kind = gtsam.Cal3_S2(f, f, 0.0, 0.0, 0.0), gtsam.PriorFactorCal3_S2
        sigmas = [TIGHT] * 5
    elif camera.model_name == "PINHOLE":
        value, kind = gtsam.Cal3_S2(p[0], p[1], 0.0, p[2], p[3]), gtsam.PriorFactorCal3_S2
        sigmas = [focal, focal, TIGHT, TIGHT, TIGHT]
    elif camera.model_name == "OPENCV":
        value = gtsam.Cal3DS2(p[0], p[1], 0.0, p[2], p[3], *p[4:8])
        kind, sigmas = gtsam.PriorFactorCal3DS2, [focal, focal, TIGHT, TIGHT, TIGHT, *[bent] * 4]
    elif camera.model_name in MODELS:
        k1, k2 = [*p[3:], 0.0, 0.0][:2]
        value, kind = gtsam.Cal3Bundler(p[0], k1, k2, p[1], p[2]), gtsam.PriorFactorCal3Bundler
        sigmas = [focal, *([bent] * (len(p) - 3)), TIGHT, TIGHT][:3]
    else:
        raise ConfigError(
            f"gtsam cannot refine cameras of model {camera.model_name}: "
            "set adjust_bundle.solver to 'ceres', or intrinsics to 'fixed'."
        )
    values.insert(key, value)
    priors.add(kind(key, value, gtsam.noiseModel.Diagonal.Sigmas(np.array(sigmas))))


def _noise(settings: SolverSettings) -> Any:
    unit = gtsam.noiseModel.Unit.Create(2)
    if settings.loss == "squared":
        return unit
    estimator = gtsam.noiseModel.mEstimator
    kind = estimator.Huber if settings.loss == "huber" else estimator.Cauchy
    return gtsam.noiseModel.Robust.Create(kind.Create(settings.loss_scale_px), unit)


def _fix_gauge(priors: Any, values: Any, images: list[int], settings: SolverSettings) -> None:
    centers = {i: values.atPose3(_pose(i)).translation() for i in images}
    spread = {i: float(np.linalg.norm(centers[i] - centers[images[0]])) for i in images}
    far = max(images, key=lambda i: (spread[i], -i))
    scale = max(spread[far], 1e-9)
    lock = gtsam.noiseModel.Isotropic.Sigma(6, TIGHT)
    priors.add(gtsam.PriorFactorPose3(_pose(images[0]), values.atPose3(_pose(images[0])), lock))
    along = gtsam.noiseModel.Isotropic.Sigma(1, TIGHT * scale)
    priors.add(gtsam.RangeFactorPose3(_pose(images[0]), _pose(far), scale, along))


def _optimize(graph: Any, values: Any, settings: SolverSettings) -> Any:
    params = gtsam.LevenbergMarquardtParams.CeresDefaults()
    params.setMaxIterations(settings.max_iterations)
    params.setRelativeErrorTol(settings.function_tolerance)
    return gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()


def _write_back(
    reconstruction: pycolmap.Reconstruction, result: Any, images: list[int], held: set[int]
) -> None:
    for image_id in images:
        pose = result.atPose3(_pose(image_id)).inverse()
        image = reconstruction.image(image_id)
        image.frame.set_cam_from_world(
            image.camera_id, to_rigid3d(pose.rotation().matrix(), pose.translation())
        )
    for row, key in enumerate(sorted(reconstruction.point3D_ids())):
        reconstruction.point3D(key).xyz = result.atPoint3(_point(row))
    for camera_id in sorted({reconstruction.image(i).camera_id for i in images} - held):
        camera = reconstruction.camera(camera_id)
        camera.params = _params(camera, result, camera_id)


def _params(camera: pycolmap.Camera, result: Any, camera_id: int) -> list[float]:
    key, old = _calibration(camera_id), [float(v) for v in camera.params]
    if camera.model_name == "PINHOLE":
        value = result.atCal3_S2(key)
        return [value.fx(), value.fy(), *old[2:]]
    if camera.model_name == "OPENCV":
        vector = result.atCal3DS2(key).vector()
        return [vector[0], vector[1], *old[2:4], *vector[5:9].tolist()]
    value = result.atCal3Bundler(key)
    return [value.fx(), old[1], old[2], *[value.k1(), value.k2()][: len(old) - 3]]
