"""Settings of the rounds of bundle adjustment, and records of their results."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from snakesfm.bundle.interface import Loss, Solver
from snakesfm.bundle.wild_cameras import WildCause


@dataclass(frozen=True)
class RoundSettings:
    """What is done in and between the rounds: the options of adjust_bundle that have these names, and more.

    Parameters
    ----------
    widen_lenses : whether cameras may get a wider model.
    patient : whether cheap passes take more steps than the solver is told.
    seed : of what is drawn.
    """

    solver: Solver
    thresholds_px: tuple[float, ...]
    loss_scale_px: float | Literal["auto"]
    loss_scale_sigmas: float
    early_loss_share: float
    last_loss: Loss
    outlier_sigmas: float
    refine_principal_points: bool
    max_principal_point_gap: float
    min_principal_point_offset: float
    max_principal_point_offset: float
    max_focal_change: float
    max_guessed_focal_change: float
    max_distortion: float
    complete_tracks: bool
    complete_error_px: float
    register_images: bool
    register_min_inliers: int
    register_min_ratio: float
    register_error_px: float
    min_angle_deg: float
    min_track_length: int
    sparse_observations: int
    min_observations: int
    select_above_images: int
    early_observations: int
    final_observations: int
    widen_lenses: bool
    patient: bool
    seed: int


@dataclass(frozen=True)
class RoundRecord:
    """What one round did: robust costs before and after, and the model's size and mean error after it.

    Where nothing was adjusted, the costs are that of the pass before. ``wild`` tells by the camera's id
    what was not plausible of cameras that were reset, and ``held`` the same of those that are held since.
    ``far`` tells by the camera's id how far from where it is left the principal point seems to be, as a
    share of the longer side, where that was not believed; ``mixed`` likewise by how much the images of a
    camera differ in focal length.
    """

    name: str
    costs: tuple[float, float]
    counts: tuple[int, int, int]
    error_px: float
    wild: Mapping[int, WildCause]
    held: Mapping[int, WildCause]
    far: Mapping[int, float]
    mixed: Mapping[int, float]
