"""Which image pairs of a survey are matched, and the relative poses that would be estimated."""

from dataclasses import dataclass

import numpy as np

from snakesfm.arrays import Array
from snakesfm.geometry.rotations import exp_so3
from snakesfm.synthetic.surveys import LANDMARKS_PER_CELL, Survey

STRANGERS = 8
MIN_INLIERS = 15
MIN_SUPPORT = 10.0
ROTATION_SIGMAS = 3.6
DIRECTION_SIGMAS = 2.2
REFERENCE_INLIERS = 100.0
CHANCE = 0.002


@dataclass(frozen=True)
class SimulatedEdge:
    """Relative pose of two images as an estimation from their matches would give it.

    Parameters
    ----------
    rotation, translation : (3,3) and (3,) j_from_i, the translation of unit length.
    covariance : (5,5) rad^2, as in the artifact two_view_geometries.
    inliers : (M,) bool, matches that agree.
    angle_deg : typical angle between the rays to a point.
    is_true : the images see the same thing; otherwise it only looks the same.
    """

    rotation: Array
    translation: Array
    covariance: Array
    inliers: Array
    angle_deg: float
    is_true: bool


def candidate_pairs(survey: Survey, seed: int) -> tuple[Array, Array]:
    """Pairs (P,2) that pair selection may choose from, sorted, and which (P,) of them are near each other.

    Every image meets all that may see the same, and a few that do not.
    """
    near = survey.neighbours()
    count = len(survey.names)
    rng = np.random.default_rng((seed, 7))
    own = np.repeat(np.arange(count), STRANGERS)
    far = np.sort(np.stack([own, rng.integers(0, count, len(own))], axis=1), axis=1)
    far = far[far[:, 0] < far[:, 1]]
    keys = np.concatenate([near, far]) @ np.array([count, 1])
    unique, first = np.unique(keys, return_index=True)
    return np.stack(np.divmod(unique, count), axis=1), first < len(near)


def choose_partners(pairs: Array, near: Array, alike: Array, count: int, partners: int) -> Array:
    """Rows (S,) of the pairs that are matched: per image the ``partners`` most alike near ones, one far.

    Parameters
    ----------
    pairs, near : (P,2) and (P,) as :func:`candidate_pairs` gives them.
    alike : (P,) number of matches of each pair.
    count : number of images.
    partners : how many near images an image chooses; it may be chosen by more.
    """
    rows = np.tile(np.arange(len(pairs)), 2)
    images = np.concatenate([pairs[:, 0], pairs[:, 1]])
    chosen = np.zeros(len(pairs), dtype=bool)
    for group, most in ((near, partners), (~near, 1)):
        mine = group[rows]
        order = np.lexsort((rows[mine], -alike[rows[mine]], images[mine]))
        owners = images[mine][order]
        rank = np.arange(len(order)) - np.searchsorted(owners, np.arange(count))[owners]
        chosen[rows[mine][order[rank < most]]] = True
    return np.flatnonzero(chosen & (alike > 0))


def simulate_edge(
    survey: Survey, pair: tuple[int, int], landmarks: tuple[Array, Array], noise_px: float, seed: int
) -> SimulatedEdge | None:
    """The relative pose of two images, or None where their matches support none.

    Matches of equal landmarks give the true pose with noise. Where more of them show copies of one another,
    all moved alike, they give the pose that would be true if the copies were one and the same.

    Parameters
    ----------
    pair : rows i and j of the images.
    landmarks : (M,) int64 ids of what the matched keypoints show, in i and in j.
    noise_px : standard deviation of the keypoints.
    seed : of the noise.
    """
    moved = survey.cell_origins(landmarks[1]) - survey.cell_origins(landmarks[0])
    inside = (landmarks[0] % LANDMARKS_PER_CELL == landmarks[1] % LANDMARKS_PER_CELL) & np.isfinite(
        moved[:, 0]
    )
    moves, group, counts = np.unique(moved[inside], axis=0, return_inverse=True, return_counts=True)
    if len(counts) == 0 or counts.max() < MIN_INLIERS or counts.max() ** 2 < MIN_SUPPORT * len(moved):
        return None
    winner = int(np.argmax(counts))
    i, j = pair
    rng = np.random.default_rng((seed, 8, i, j))
    # some wrong matches agree with any pose
    inliers = rng.random(len(moved)) < CHANCE
    inliers[np.flatnonzero(inside)[group.ravel() == winner]] = True
    baseline = survey.centers[i] - (survey.centers[j] - moves[winner])
    distance = float(np.linalg.norm(baseline))
    angle = 2.0 * float(np.arctan2(distance, 2.0 * survey.depth_m))
    base = noise_px / survey.camera.params[0] * np.sqrt(REFERENCE_INLIERS / counts[winner])
    base *= float(np.exp(rng.normal(0.0, 0.5)))
    sigma_rotation = ROTATION_SIGMAS * base
    # a short baseline says little about its direction
    sigma_direction = min(DIRECTION_SIGMAS * base / max(angle, 1e-3), 1.0)
    rotation = exp_so3(rng.normal(0.0, sigma_rotation, 3)) @ (survey.rotations[j] @ survey.rotations[i].T)
    direction = survey.rotations[j] @ baseline / max(distance, 1e-9)
    turn = rng.normal(0.0, sigma_direction, 3)
    turn -= direction * (turn @ direction)
    return SimulatedEdge(
        rotation=np.asarray(rotation),
        translation=np.asarray(exp_so3(turn) @ direction),
        covariance=np.diag([sigma_rotation**2] * 3 + [sigma_direction**2] * 2),
        inliers=inliers,
        angle_deg=float(np.degrees(angle)),
        is_true=not moves[winner].any(),
    )
