"""Simulated keypoints of the images of a survey, without rendering them."""

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np

from snakesfm.arrays import Array
from snakesfm.features.keypoints import KeypointSet
from snakesfm.synthetic.surveys import Survey

DESCRIPTOR_SIZE = 128
DESCRIPTOR_NORM = 512.0
ATOMS = 4096
NEAR_M = 1.0


@dataclass(frozen=True)
class DetectorModel:
    """How a detector errs; the defaults resemble SIFT on sharp photographs.

    Parameters
    ----------
    noise_px : typical standard deviation per axis of a keypoint; keypoints differ by a factor of 1.4.
    displaced : share of keypoints that lie 3 to 10 pixels from where they should.
    clutter : share of keypoints that show nothing that another image shows.
    sizes_px : diameters that are found.
    descriptor_noise : typical standard deviation of a descriptor's entries, of a length of 512.
    max_keypoints : the strongest are kept.
    """

    noise_px: float = 0.5
    displaced: float = 0.02
    clutter: float = 0.15
    sizes_px: tuple[float, float] = (1.6, 64.0)
    descriptor_noise: float = 12.0
    max_keypoints: int = 5000


@dataclass(frozen=True)
class Sighting:
    """Keypoints of one image with the truth about them.

    Parameters
    ----------
    keypoints : (K); descriptors (K,128) uint8, or (K,0) where none were asked for.
    colors : (K,3) uint8.
    landmarks : (K,) int64, id of the landmark that the keypoint shows, -1 for clutter.
    appearance : (K,) uint64, of the landmark; of clutter, unique.
    """

    keypoints: KeypointSet
    colors: Array
    landmarks: Array
    appearance: Array


def sight(
    survey: Survey, image: int, seed: int, model: DetectorModel | None = None, descriptors: bool = True
) -> Sighting:
    """What the detector finds in an image.

    The result depends on the arguments alone, and that of one image not on the others, so that images can
    be made in any order and by any number of processes.
    """
    model = model or DetectorModel()
    rng = np.random.default_rng((seed, 5, image))
    landmarks, pixels, sizes = _visible(survey, image, model)
    found = rng.random(len(pixels)) < landmarks.repeatability
    landmarks, pixels, sizes = landmarks.take(found), pixels[found], sizes[found]
    count = len(pixels)
    spread = model.noise_px * np.exp(rng.normal(0.0, 0.35, (count, 1)))
    pixels = pixels + rng.normal(0.0, 1.0, (count, 2)) * spread
    displaced = rng.random(count) < model.displaced
    angle = rng.uniform(0.0, 2 * np.pi, count)
    shift = rng.uniform(3.0, 10.0, count)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    pixels[displaced] += shift[displaced]

    extra = int(count * model.clutter / (1.0 - model.clutter))
    frame = np.array([survey.camera.width, survey.camera.height], dtype=np.float64)
    pixels = np.concatenate([pixels, rng.random((extra, 2)) * frame])
    sizes = np.concatenate([sizes, rng.choice(sizes, extra) if extra else sizes[:0]])
    ids = np.concatenate([landmarks.ids, np.full(extra, -1)])
    appearance = np.concatenate([landmarks.appearance, rng.integers(0, 1 << 63, extra, dtype=np.uint64)])
    scores = np.concatenate([landmarks.repeatability, rng.beta(1.2, 1.8, extra)])
    scores = scores * rng.uniform(0.7, 1.3, len(scores))
    order = np.argsort(-scores, kind="stable")[: model.max_keypoints]
    order = order[np.all((pixels[order] > 0.0) & (pixels[order] < frame), axis=1)]
    appearance = appearance[order]
    described = np.zeros((len(order), 0), np.uint8)
    if descriptors:
        described = _observed_descriptors(appearance, model.descriptor_noise, rng)
    return Sighting(
        KeypointSet(
            pixels[order].astype(np.float32),
            described,
            scores[order].astype(np.float32),
            sizes[order].astype(np.float32),
            rng.uniform(-np.pi, np.pi, len(order)).astype(np.float32),
        ),
        colors=(appearance[:, None] >> np.array([8, 16, 24], np.uint64)).astype(np.uint8),
        landmarks=ids[order],
        appearance=appearance,
    )


@dataclass(frozen=True)
class DistinctLooks:
    """Keypoints of an image that no other of its keypoints looks like: the ratio test refuses the rest.

    Parameters
    ----------
    looks : (U,) uint64 appearances, ascending.
    rows : (U,) the keypoint of each.
    """

    looks: Array
    rows: Array

    @classmethod
    def of(cls, appearance: Array) -> "DistinctLooks":
        """Those of an image's keypoints with appearances (K,) uint64."""
        looks, rows, counts = np.unique(appearance, return_index=True, return_counts=True)
        return cls(looks[counts == 1], rows[counts == 1])


def match_looks(
    first: DistinctLooks, second: DistinctLooks, recall: float, rng: np.random.Generator
) -> Array:
    """Rows (M,2) int32 that mutual nearest neighbours and a ratio test would match, ascending in ``first``.

    What looks alike in both images is matched, right or wrong.

    Parameters
    ----------
    first, second : of the two images.
    recall : share of such pairs that the noise of the descriptors leaves.
    rng : decides which.
    """
    if len(second.looks) == 0:
        return np.zeros((0, 2), np.int32)
    at = np.minimum(np.searchsorted(second.looks, first.looks), len(second.looks) - 1)
    alike = np.flatnonzero(second.looks[at] == first.looks)
    alike = alike[rng.random(len(alike)) < recall]
    matches = np.stack([first.rows[alike], second.rows[at[alike]]], axis=1)
    return np.asarray(matches[np.argsort(matches[:, 0])].astype(np.int32))


def _visible(survey: Survey, image: int, model: DetectorModel) -> tuple[Any, Array, Array]:
    """Landmarks that the image shows large enough, their exact pixels, and diameters in pixels."""
    landmarks = survey.near(image)
    rays = landmarks.points - survey.centers[image]
    in_camera = rays @ survey.rotations[image].T
    focal, _, center_x, center_y = survey.camera.params
    depth = np.maximum(in_camera[:, 2], NEAR_M)
    pixels = focal * in_camera[:, :2] / depth[:, None] + (center_x, center_y)
    distance = np.linalg.norm(rays, axis=1)
    cosine = -np.einsum("li,li->l", rays, landmarks.normals) / np.maximum(distance, NEAR_M)
    sizes = focal * landmarks.sizes * np.sqrt(np.clip(cosine, 0.0, 1.0)) / depth
    seen = (in_camera[:, 2] > NEAR_M) & (cosine > survey.min_cosine)
    seen &= (sizes >= model.sizes_px[0]) & (sizes < model.sizes_px[1])
    seen &= np.all((pixels > 0.0) & (pixels < (survey.camera.width, survey.camera.height)), axis=1)
    rows = np.flatnonzero(seen)
    rows = rows[~survey.hidden(image, landmarks.points[rows])]
    return landmarks.take(rows), pixels[rows], sizes[rows]


@functools.cache
def _atoms() -> Array:
    """(ATOMS,128) float32 unit vectors with few large entries, like roots of SIFT histograms."""
    rng = np.random.default_rng(6)
    atoms = np.sqrt(rng.gamma(0.6, 1.0, (ATOMS, DESCRIPTOR_SIZE)).astype(np.float32))
    unit: Array = atoms / np.linalg.norm(atoms, axis=1, keepdims=True)
    return unit


def _observed_descriptors(appearance: Array, noise: float, rng: np.random.Generator) -> Array:
    """Noisy descriptors (K,128) uint8 of appearances (K): sums of two shifted atoms, which rarely recur."""
    atoms = _atoms()
    places = np.arange(DESCRIPTOR_SIZE, dtype=np.uint64)
    vectors = np.zeros((len(appearance), DESCRIPTOR_SIZE), np.float32)
    for offset in (np.uint64(0), np.uint64(20)):
        number = (appearance >> offset) % np.uint64(ATOMS)
        shift = (appearance >> (offset + np.uint64(12))) % np.uint64(DESCRIPTOR_SIZE)
        columns = (places + shift[:, None]) % np.uint64(DESCRIPTOR_SIZE)
        vectors += atoms[number[:, None].astype(np.int64), columns.astype(np.int64)]
    vectors *= DESCRIPTOR_NORM / np.linalg.norm(vectors, axis=1, keepdims=True)
    # some views of a landmark differ much more than others
    spread = noise * np.exp(rng.normal(0.0, 0.45, (len(vectors), 1))).astype(np.float32)
    vectors += rng.standard_normal(vectors.shape, dtype=np.float32) * spread
    np.maximum(vectors, 0.0, out=vectors)
    vectors *= DESCRIPTOR_NORM / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1.0)
    return np.asarray(np.minimum(np.rint(vectors), 255.0).astype(np.uint8))
