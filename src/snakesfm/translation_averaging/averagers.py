"""The interchangeable methods: each computes camera centres up to a similarity."""

import math
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from snakesfm.arrays import Array
from snakesfm.translation_averaging.landmarks import cover_cameras, edge_angles_rad
from snakesfm.translation_averaging.problem import PositioningProblem
from snakesfm.translation_averaging.scale_chain import chain_centers
from snakesfm.view_graph.components import label_components

LARGEST_SCALE_GAP = 10.0
LEAST_SHARE_AT_ONE_SCALE = 0.9


class TranslationAverager(Protocol):
    """Positions cameras of known rotation."""

    def position(self, problem: PositioningProblem, seed: int) -> Array:
        """Centres (N,3) in the frame of the rotations, up to scale and shift; NaN where there is none.

        The problem is connected, has at least three images, and the rays that are to take part.
        """


@dataclass(frozen=True)
class ScaleChain:
    """Baselines compared through shared landmarks, then linear; see :mod:`scale_chain`.

    Draws nothing at random. Where too few landmarks are shared to link most cameras, ``fallback`` is used
    instead, but for cameras in parts that nothing ties to the largest: it would give those any scale.
    """

    sigma_rad: float
    max_relative_sigma: float
    fallback: TranslationAverager

    def position(self, problem: PositioningProblem, seed: int) -> Array:
        """See :class:`TranslationAverager`."""
        centers, apart = self.link(problem)
        if centers is None:
            return np.where(apart[:, None], np.nan, self.fallback.position(problem, seed))
        return centers

    def link(self, problem: PositioningProblem) -> tuple[Array | None, Array]:
        """Centres (N,3), or None where the landmarks link fewer than half of the cameras.

        Also which cameras (N,) bool have scales of their own.
        """
        centers, apart = chain_centers(problem, 1.5 * self.sigma_rad, self.max_relative_sigma)
        few = 2 * np.isfinite(centers[:, 0]).sum() < len(problem.images())
        return (None if few else centers), apart


@dataclass(frozen=True)
class TranslationRecovery:
    """gtsam's TranslationRecovery on camera-camera and camera-landmark directions with a Huber loss.

    With the outlier rejection of 1DSfM (Wilson and Snavely, ECCV 2014; ``mfas``), or by the residuals of a
    first solution (``residual``). It starts at random places. Directions alone may agree with parts of the
    scene at scales of their own; where landmarks say otherwise, ``chain`` is used instead, if there is one.
    Of the rays about ``rays_per_camera`` take part, but for the chain.
    """

    rays_per_camera: int
    sigma: float
    reject_outliers: Literal["mfas", "residual", "none"]
    residual_rad: float
    mfas_projections: int
    mfas_weight: float
    chain: ScaleChain | None

    def position(self, problem: PositioningProblem, seed: int) -> Array:
        """See :class:`TranslationAverager`."""
        from snakesfm.translation_averaging.recovery import mfas_weights, recover_translations

        whole, problem = problem, with_rays(problem, self.rays_per_camera)
        if self.reject_outliers == "mfas" and len(problem.pairs):
            keep = mfas_weights(problem, self.mfas_projections, seed) < self.mfas_weight
            problem = problem.select_edges(keep)
        centers = recover_translations(problem, self.sigma, seed)
        if self.reject_outliers == "residual":
            keep = ~(edge_angles_rad(problem, centers) > self.residual_rad)
            if not keep.all():
                centers = recover_translations(problem.select_edges(keep), self.sigma, seed)
        if self.chain is None:
            return centers
        chained, apart = self.chain.link(whole)
        if chained is None:
            return np.where(apart[:, None], np.nan, centers)
        share = share_at_one_scale(whole.pairs, centers, chained)
        if share >= LEAST_SHARE_AT_ONE_SCALE:
            return centers
        print(
            f"translation_recovery left groups of cameras at different scales, the largest with "
            f"{share:.0%} of them: scale_chain positions the cameras instead"
        )
        return chained


@dataclass(frozen=True)
class GlobalPositioning:
    """pycolmap's global positioning (Pan et al., "Global Structure-from-Motion Revisited", ECCV 2024)."""

    loss_scale: float

    def position(self, problem: PositioningProblem, seed: int) -> Array:
        """See :class:`TranslationAverager`."""
        from snakesfm.translation_averaging.positioning import position_globally

        return position_globally(problem, self.loss_scale, seed)


def with_rays(problem: PositioningProblem, rays_per_camera: int) -> PositioningProblem:
    """The problem with the tracks that give each camera about ``rays_per_camera`` rays."""
    return problem.select_rays(
        cover_cameras(problem.ray_images, problem.ray_tracks, problem.image_count, rays_per_camera)
    )


def share_at_one_scale(pairs: Array, centers: Array, others: Array) -> float:
    """Share of the cameras whose baselines have the same scale to each other in two results.

    That of the largest set that edges tie whose lengths in both differ by the usual factor, give or take
    ``LARGEST_SCALE_GAP``; of the cameras that have a centre in both.

    Parameters
    ----------
    pairs : (E,2) edges.
    centers, others : (N,3), NaN where there is none.
    """
    both = np.isfinite(centers[:, 0]) & np.isfinite(others[:, 0])
    edges = pairs[both[pairs].all(axis=1)]
    if not len(edges):
        return 1.0
    lengths = [np.linalg.norm(c[edges[:, 1]] - c[edges[:, 0]], axis=1) for c in (centers, others)]
    gaps = np.subtract(*np.log(np.maximum(lengths, 1e-300)))
    alike = np.abs(gaps - np.median(gaps)) < math.log(LARGEST_SCALE_GAP)
    labels = label_components(len(centers), edges[alike])
    return float(np.bincount(labels[both]).max() / both.sum())
