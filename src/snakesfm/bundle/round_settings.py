"""What the rounds of bundle adjustment are told, and what they say of themselves."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from snakesfm.bundle.interface import Loss
from snakesfm.bundle.wild_cameras import WildCause


@dataclass(frozen=True)
class RoundSettings:
    """What is done in and between the rounds; see the options of adjust_bundle for each."""

    solver: Literal["ceres", "gtsam"] = "ceres"
    thresholds_px: tuple[float, ...] = (10.0, 5.0, 3.0)
    rotations_first: bool = False
    loss_scale_px: float | Literal["auto"] = "auto"
    loss_scale_sigmas: float = 3.5
    early_loss_share: float = 0.4
    last_loss: Loss = "huber"
    outlier_sigmas: float = 12.0
    distortion_from_round: int = 2
    widen_lenses: bool = False
    refine_principal_points: bool = True
    max_principal_point_gap: float = 0.003
    min_principal_point_offset: float = 0.004
    max_principal_point_offset: float = 0.02
    max_focal_change: float = 3.0
    max_guessed_focal_change: float = 15.0
    max_distortion: float = 1.0
    complete_tracks: bool = True
    complete_error_px: float = 4.0
    register_images: bool = True
    register_min_inliers: int = 15
    register_min_ratio: float = 0.25
    register_error_px: float = 6.0
    min_angle_deg: float = 1.0
    min_track_length: int = 3
    sparse_observations: int = 100
    min_observations: int = 10
    select_above_images: int = 500
    early_observations: int = 300
    final_observations: int = 0
    patient: bool = False
    seed: int = 0


@dataclass(frozen=True)
class RoundRecord:
    """What one round did: robust costs before and after, and the model's size and mean error after it.

    Where nothing was adjusted, the costs are that of the pass before. ``wild`` tells by the camera's id
    what was not plausible of cameras that were reset, and ``held`` the same of those that are held since.
    ``far`` tells by the camera's id how far from where it is left the principal point seems to be, as a
    share of the longer side, where that was not believed.
    """

    name: str
    costs: tuple[float, float]
    counts: tuple[int, int, int]
    error_px: float
    wild: Mapping[int, WildCause]
    held: Mapping[int, WildCause]
    far: Mapping[int, float]
