"""The interface of bundle adjustment solvers."""

from dataclasses import dataclass
from typing import Any, Literal, Protocol

Loss = Literal["huber", "cauchy", "squared"]
Solver = Literal["ceres", "gtsam"]


@dataclass(frozen=True)
class SolverSettings:
    """How one pass is solved.

    Parameters
    ----------
    loss, loss_scale_px : robust loss on the norm of each reprojection error, and where it sets in.
    constant_cameras : ids of cameras whose intrinsics are held.
    refine_focal, refine_distortion, refine_principal_points : which intrinsics of the others are free;
        gtsam holds principal points.
    max_iterations, function_tolerance : when the solver stops.
    inner_iterations : Ceres adjusts points and cameras by turns after each step: fewer, but dearer ones.
    """

    loss: Loss = "cauchy"
    loss_scale_px: float = 0.5
    constant_cameras: frozenset[int] = frozenset()
    refine_focal: bool = True
    refine_distortion: bool = True
    refine_principal_points: bool = False
    max_iterations: int = 100
    function_tolerance: float = 1e-6
    inner_iterations: bool = True


class BundleAdjuster(Protocol):
    """Adjusts the registered images, the points and the cameras of a ``pycolmap.Reconstruction`` in place.

    Returns the robust cost, half the sum of the losses in px^2, before and after.
    """

    def __call__(self, reconstruction: Any, settings: SolverSettings) -> tuple[float, float]:
        """Solve one pass."""
        ...


def bundle_adjuster(solver: Solver) -> BundleAdjuster:
    """The solver of a name."""
    if solver == "gtsam":
        from snakesfm.bundle.gtsam_solver import adjust_gtsam

        return adjust_gtsam
    from snakesfm.bundle.ceres import adjust_ceres

    return adjust_ceres
