"""Bundle adjustment by Ceres, through pycolmap."""

from snakesfm.bundle.interface import SolverSettings
from snakesfm.geometry.colmap_binding import pycolmap

INNER_TOLERANCE = 0.1
FACTORED_IMAGES = 5000
"""Images up to which the reduced camera system is factored; a larger one may fill up where most images see
the same."""
LOSSES = {
    "huber": pycolmap.LossFunctionType.HUBER,
    "cauchy": pycolmap.LossFunctionType.CAUCHY,
    "squared": pycolmap.LossFunctionType.TRIVIAL,
}


def adjust_ceres(reconstruction: pycolmap.Reconstruction, settings: SolverSettings) -> tuple[float, float]:
    """One pass of Ceres' Levenberg-Marquardt with a Schur complement.

    Gauge: the first camera and one coordinate of a second one are held.
    """
    images = reconstruction.reg_image_ids()
    if len(images) < 2 or reconstruction.num_points3D() == 0:
        return 0.0, 0.0
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in sorted(images):
        config.add_image(image_id)
    for camera_id in sorted(settings.constant_cameras):
        config.set_constant_cam_intrinsics(camera_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    adjuster = pycolmap.create_default_bundle_adjuster(_options(settings), config, reconstruction)
    summary = adjuster.solve().ceres_summary
    return float(summary.initial_cost), float(summary.final_cost)


def _options(settings: SolverSettings) -> pycolmap.BundleAdjustmentOptions:
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = settings.refine_focal
    options.refine_extra_params = settings.refine_distortion
    options.refine_principal_point = settings.refine_principal_points
    ceres = options.ceres
    ceres.use_gpu = False
    ceres.max_num_images_direct_sparse_cpu_solver = FACTORED_IMAGES
    ceres.loss_function_type = LOSSES[settings.loss]
    ceres.loss_function_scale = settings.loss_scale_px
    solver = ceres.solver_options
    solver.max_num_iterations = settings.max_iterations
    solver.function_tolerance = settings.function_tolerance
    # on several threads sums are added in any order, so results would differ from run to run
    solver.num_threads = 1
    # a robust loss needs few iterations if points follow the cameras; Ceres ends this where it gains little
    solver.use_inner_iterations = settings.inner_iterations
    solver.inner_iteration_tolerance = INNER_TOLERANCE
    return options
