"""Reconstruction problems with exact truth, from the observations on: no images are rendered.

Cameras with a limited field of view stand in one of four layouts and see oriented surface points; a track
is a bounded set of neighbouring cameras that see one point. Neighbours are about one unit apart.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from snakesfm.arrays import Array
from snakesfm.geometry.camera import Camera
from snakesfm.geometry.poses import translation_of
from snakesfm.geometry.rotations import exp_so3
from snakesfm.grouping import offsets_of
from snakesfm.synthetic.layouts import LAYOUTS

Layout = Literal["ring", "street", "area", "facade"]

DEFAULT_CAMERA = Camera("PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0))
NEAR_DEPTH = 0.2
MIN_COVARIANCE_RAD = 1e-4


@dataclass(frozen=True)
class SyntheticProblem:
    """A scene, what its cameras measured, and the truth.

    Camera frames are COLMAP's (x right, y down, z forward), pixels have (.5,.5) at the centre of the first
    pixel. N cameras, T points, L observations, E edges, M matches. Track k shows ``points[k]``.
    """

    cameras: tuple[Camera, ...]
    """Intrinsics (C)."""
    camera_ids: Array
    """(N) int32, row of the image's camera."""
    rotations: Array
    """(N,3,3) true cam_from_world rotations."""
    translations: Array
    """(N,3) true cam_from_world translations."""
    centers: Array
    """(N,3) true camera centres in the world."""
    points: Array
    """(T,3) true points in the world."""
    keypoints: tuple[Array, ...]
    """Per image (K,2) float32 original pixels, with noise and outliers, in random order."""
    keypoint_points: tuple[Array, ...]
    """Per image (K) int64, the point that the keypoint truly shows, -1 for an outlier."""
    track_offsets: Array
    """(T+1) int64, observations of track k are rows track_offsets[k]:track_offsets[k+1]."""
    track_image_ids: Array
    """(L) int32, ascending within a track."""
    track_keypoint_ids: Array
    """(L) int32."""
    track_outliers: Array
    """(L) bool, the observation is a random keypoint of the image."""
    pairs: Array
    """(E,2) int32, i < j, sorted."""
    edge_rotations: Array
    """(E,3,3) measured j_from_i rotations."""
    edge_translations: Array
    """(E,3) measured j_from_i unit translations."""
    edge_covariances: Array
    """(E,5,5) rad^2: left rotation increment (3), two tangents of the translation; true for inliers."""
    edge_inlier_counts: Array
    """(E) int32, right matches of the pair (of an outlier edge: as many as fit by chance)."""
    edge_angles_deg: Array
    """(E) float64, median triangulation angle of the pair's shared points."""
    edge_outliers: Array
    """(E) bool, rotation and translation of the edge are random."""
    match_offsets: Array
    """(E+1) int64, rows match_offsets[k]:match_offsets[k+1] belong to edge k."""
    matches: Array
    """(M,2) int32, keypoint row in image i and in image j."""
    match_outliers: Array
    """(M) bool, the two keypoints do not show one point."""

    @property
    def image_count(self) -> int:
        """Number of cameras N."""
        return len(self.rotations)

    @property
    def track_keypoints(self) -> Array:
        """(L,2) float32 measured pixels of the observations."""
        starts = offsets_of([len(k) for k in self.keypoints])
        flat = np.concatenate([np.zeros((0, 2), np.float32), *self.keypoints])
        return np.asarray(flat[starts[self.track_image_ids] + self.track_keypoint_ids])


def perturb_rotations(rotations: Array, noise_deg: float, seed: int = 0) -> Array:
    """Rotations (N,3,3) with Gaussian noise of ``noise_deg`` per axis, as an averaging would leave it."""
    rng = np.random.default_rng(seed)
    noise = rng.normal(0.0, np.radians(noise_deg), (len(rotations), 3))
    return np.asarray(exp_so3(noise) @ rotations)


def make_problem(
    camera_count: int = 20,
    point_count: int = 1000,
    layout: Layout = "ring",
    noise_px: float = 0.5,
    outlier_ratio: float = 0.0,
    rotation_noise_deg: float = 0.3,
    pair_outlier_ratio: float = 0.0,
    *,
    translation_noise_deg: float | None = None,
    visibility_radius: float = 12.0,
    max_views: int = 10,
    min_shared: int = 15,
    occlusion: bool = True,
    camera: Camera = DEFAULT_CAMERA,
    seed: int = 0,
) -> SyntheticProblem:
    """Make a problem.

    Parameters
    ----------
    camera_count, point_count : cameras, and points tried; points with fewer than two views are left out.
    layout : ring around an object, street driven forwards, area flown over, facade passed sideways.
    noise_px : standard deviation of each keypoint coordinate.
    outlier_ratio : share of track observations that are random, and of matches that are on top of these.
    rotation_noise_deg : typical standard deviation per axis of an edge's rotation; edges differ by a factor
        of about two either way, as their covariances say.
    pair_outlier_ratio : share of edges with random geometry and random matches.
    translation_noise_deg : the same for the translation's direction; twice the rotation's if None.
    visibility_radius : longest distance from a camera to a point it sees, in spacings (not on a ring).
    max_views : longest track.
    min_shared : fewest shared points that make an edge.
    occlusion : points are seen from the front of their surface only.
    camera : intrinsics shared by all images.
    seed : of everything random; the truth does not depend on the noise parameters.
    """
    truth, observing, edging, matching = (
        np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(4)
    )
    scene = LAYOUTS[layout](camera_count, point_count, truth)
    radius = np.inf if layout == "ring" else visibility_radius
    image_ids, point_ids, pixels = _visible(
        scene.rotations, scene.centers, scene.points, scene.normals, camera, radius, occlusion
    )
    keep = _choose_views(image_ids, point_ids, scene.centers, max_views, truth)
    image_ids, point_ids, pixels = image_ids[keep], point_ids[keep], pixels[keep]
    seen, point_ids = np.unique(point_ids, return_inverse=True)
    order = np.lexsort((image_ids, point_ids))
    points = scene.points[seen]
    observed = _observe(
        image_ids[order],
        point_ids[order],
        pixels[order],
        camera_count,
        camera,
        noise_px,
        outlier_ratio,
        observing,
    )

    pairs, match_offsets, left, right = _shared_observations(
        observed.image_ids, observed.point_ids, camera_count, len(points), min_shared
    )
    bad_edges = edging.random(len(pairs)) < pair_outlier_ratio
    edge_of_match = np.repeat(np.arange(len(pairs)), np.diff(match_offsets))
    matches, false_match = _match(observed, left, right, outlier_ratio, bad_edges[edge_of_match], matching)
    right_counts = np.bincount(edge_of_match[~false_match], minlength=len(pairs))

    sigma = np.radians([rotation_noise_deg, 2.0 * rotation_noise_deg])
    if translation_noise_deg is not None:
        sigma[1] = np.radians(translation_noise_deg)
    rotations, directions, covariances = _measure_edges(
        scene.rotations, scene.centers, pairs, sigma, bad_edges, edging
    )
    chance_counts = np.minimum(
        np.diff(match_offsets), edging.integers(min_shared, 2 * min_shared, len(pairs))
    )
    return SyntheticProblem(
        cameras=(camera,),
        camera_ids=np.zeros(camera_count, dtype=np.int32),
        rotations=scene.rotations,
        translations=translation_of(scene.rotations, scene.centers),
        centers=scene.centers,
        points=points,
        keypoints=observed.keypoints,
        keypoint_points=observed.keypoint_points,
        track_offsets=np.searchsorted(observed.point_ids, np.arange(len(points) + 1)).astype(np.int64),
        track_image_ids=observed.image_ids.astype(np.int32),
        track_keypoint_ids=observed.keypoint_ids,
        track_outliers=observed.outliers,
        pairs=pairs,
        edge_rotations=rotations,
        edge_translations=directions,
        edge_covariances=covariances,
        edge_inlier_counts=np.where(bad_edges, chance_counts, right_counts).astype(np.int32),
        edge_angles_deg=_pair_angles_deg(
            points[observed.point_ids[left]], scene.centers, pairs, edge_of_match
        ),
        edge_outliers=bad_edges,
        match_offsets=match_offsets,
        matches=matches,
        match_outliers=false_match,
    )


@dataclass(frozen=True)
class _Observations:
    """Observations (L), sorted by point, then image, and the images' keypoints (N) that they are."""

    image_ids: Array
    point_ids: Array
    keypoint_ids: Array
    outliers: Array
    keypoints: tuple[Array, ...]
    keypoint_points: tuple[Array, ...]


def _observe(
    image_ids: Array,
    point_ids: Array,
    pixels: Array,
    image_count: int,
    camera: Camera,
    noise_px: float,
    outlier_ratio: float,
    rng: np.random.Generator,
) -> _Observations:
    """Exact pixels (L,2) with noise and outliers, as each image's keypoints in random order."""
    size = np.array([camera.width, camera.height], dtype=np.float64)
    outliers = rng.random(len(image_ids)) < outlier_ratio
    measured = pixels + rng.normal(0.0, 1.0, pixels.shape) * noise_px
    measured = np.where(outliers[:, None], rng.random(pixels.shape) * size, measured)
    measured = np.clip(measured, 0.0, size).astype(np.float32)

    order = np.lexsort((rng.random(len(image_ids)), image_ids))
    starts = np.searchsorted(image_ids[order], np.arange(image_count + 1))
    keypoint_ids = np.empty(len(image_ids), dtype=np.int32)
    keypoint_ids[order] = np.arange(len(image_ids)) - starts[image_ids[order]]
    shown = np.where(outliers, -1, point_ids)
    return _Observations(
        image_ids,
        point_ids,
        keypoint_ids,
        outliers,
        keypoints=tuple(measured[order[a:b]] for a, b in pairwise(starts)),
        keypoint_points=tuple(shown[order[a:b]] for a, b in pairwise(starts)),
    )


def _match(
    observed: _Observations,
    left: Array,
    right: Array,
    outlier_ratio: float,
    unrelated: Array,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """Matches (M,2) of observations, some with any keypoint of the other image, and which (M,) are false.

    Parameters
    ----------
    left, right : (M,) observations in image i and j of the points that a pair shares.
    unrelated : (M,) bool, the match is of a pair that has random matches only.
    """
    random_match = (rng.random(len(left)) < outlier_ratio) | unrelated
    matches = np.stack([observed.keypoint_ids[left], observed.keypoint_ids[right]], axis=1).astype(np.int32)
    counts = np.array([len(keypoints) for keypoints in observed.keypoints])
    matches[random_match, 1] = (
        rng.random(int(random_match.sum())) * counts[observed.image_ids[right[random_match]]]
    ).astype(np.int32)
    return matches, random_match | observed.outliers[left] | observed.outliers[right]


def _visible(
    rotations: Array,
    centers: Array,
    points: Array,
    normals: Array,
    camera: Camera,
    radius: float,
    occlusion: bool,
) -> tuple[Array, Array, Array]:
    """Image ids, point ids and exact pixels of everything that the cameras see."""
    model = camera.to_pycolmap()
    image_parts, point_parts, pixel_parts = [], [], []
    # The widest cone that holds the image spares the exact projection of most points.
    corners = camera.normalize(
        np.array([[0, 0], [camera.width, 0], [0, camera.height], [camera.width, camera.height]])
    )
    slope = float(np.linalg.norm(corners, axis=1).max())
    for image, (rotation, center) in enumerate(zip(rotations, centers, strict=True)):
        rays = points - center
        depth = rays @ rotation[2]
        squares = np.einsum("ij,ij->i", rays, rays)
        seen = (depth > NEAR_DEPTH) & (squares < radius**2) & (squares < (1.0 + slope**2) * depth**2)
        if occlusion:
            seen &= np.einsum("ij,ij->i", rays, normals) < -0.2 * np.sqrt(squares)
        ids = np.flatnonzero(seen)
        pixels = np.asarray(model.img_from_cam(rays[ids] @ rotation.T)).reshape(-1, 2)
        inside = np.all((pixels > 0.5) & (pixels < [camera.width - 0.5, camera.height - 0.5]), axis=1)
        ids, pixels = ids[inside], pixels[inside]
        image_parts.append(np.full(len(ids), image))
        point_parts.append(ids)
        pixel_parts.append(pixels)
    return (
        np.concatenate([np.zeros(0, np.int64), *image_parts]),
        np.concatenate([np.zeros(0, np.int64), *point_parts]),
        np.concatenate([np.zeros((0, 2)), *pixel_parts]),
    )


def _choose_views(
    image_ids: Array, point_ids: Array, centers: Array, max_views: int, rng: np.random.Generator
) -> Array:
    """Rows to keep: per point an anchor camera and the nearest others; most tracks are short."""
    order = np.lexsort((rng.random(len(point_ids)), point_ids))
    points, first, counts = np.unique(point_ids[order], return_index=True, return_counts=True)
    anchors = image_ids[order[first]]
    group = np.searchsorted(points, point_ids)
    distance = np.linalg.norm(centers[image_ids] - centers[anchors[group]], axis=1)
    distance *= rng.uniform(0.7, 1.3, len(distance))
    wanted = np.minimum(1 + rng.geometric(0.25, len(points)), max_views)
    order = np.lexsort((distance, group))
    starts = offsets_of(counts)[:-1]
    rank = np.arange(len(order)) - starts[group[order]]
    keep = (rank < wanted[group[order]]) & (counts[group[order]] >= 2)
    return np.asarray(np.sort(order[keep]))


def _shared_observations(
    image_ids: Array, point_ids: Array, image_count: int, point_count: int, min_shared: int
) -> tuple[Array, Array, Array, Array]:
    """Pairs of images with enough shared points, match offsets, and observation rows in i and in j.

    Observations come sorted by point, then image.
    """
    lengths = np.bincount(point_ids, minlength=point_count)
    position = np.arange(len(point_ids)) - offsets_of(lengths)[:-1][point_ids]
    lefts, rights = [], []
    for gap in range(1, int(lengths.max(initial=1))):
        rows = np.flatnonzero(position + gap < lengths[point_ids])
        lefts.append(rows)
        rights.append(rows + gap)
    left = np.concatenate([np.zeros(0, np.int64), *lefts])
    right = np.concatenate([np.zeros(0, np.int64), *rights])
    keys = image_ids[left] * image_count + image_ids[right]
    order = np.lexsort((left, keys))
    left, right, keys = left[order], right[order], keys[order]
    unique, inverse, counts = np.unique(keys, return_inverse=True, return_counts=True)
    enough = counts >= min_shared
    keep = enough[inverse]
    pairs = np.stack([unique[enough] // image_count, unique[enough] % image_count], axis=1).astype(np.int32)
    offsets = offsets_of(counts[enough])
    return pairs, offsets, left[keep], right[keep]


def _pair_angles_deg(points: Array, centers: Array, pairs: Array, edge_of_match: Array) -> Array:
    """Median triangulation angle of each pair, over its shared points."""
    rays = centers[pairs[edge_of_match]] - points[:, None]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    chord = np.linalg.norm(rays[:, 0] - rays[:, 1], axis=-1)
    angles = np.degrees(2.0 * np.arcsin(np.minimum(chord / 2.0, 1.0)))
    order = np.lexsort((angles, edge_of_match))
    counts = np.bincount(edge_of_match, minlength=len(pairs))
    middles = offsets_of(counts)[:-1] + counts // 2
    return np.asarray(angles[order][middles])


def _measure_edges(
    rotations: Array,
    centers: Array,
    pairs: Array,
    sigma_rad: Array,
    outliers: Array,
    rng: np.random.Generator,
) -> tuple[Array, Array, Array]:
    """Relative rotations, unit translations and covariances with noise that the covariances describe."""
    count = len(pairs)
    i, j = pairs[:, 0], pairs[:, 1]
    spread = np.exp(rng.normal(0.0, 0.5, count))
    relative = rotations[j] @ rotations[i].transpose(0, 2, 1)
    directions = np.einsum("eij,ej->ei", rotations[j], centers[i] - centers[j])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    relative = exp_so3(rng.normal(0.0, 1.0, (count, 3)) * spread[:, None] * sigma_rad[0]) @ relative
    noise = rng.normal(0.0, 1.0, (count, 3)) * spread[:, None] * sigma_rad[1]
    # Turning about an axis across the direction moves it by the angle, turning about itself not at all.
    noise -= directions * np.sum(noise * directions, axis=1, keepdims=True)
    directions = np.einsum("eij,ej->ei", exp_so3(noise), directions)
    wild = exp_so3(rng.normal(0.0, 1.0, (count, 3)) * 0.6) @ relative
    random_directions = rng.normal(0.0, 1.0, (count, 3))
    random_directions /= np.linalg.norm(random_directions, axis=1, keepdims=True)
    relative = np.where(outliers[:, None, None], wild, relative)
    directions = np.where(outliers[:, None], random_directions, directions)
    variances = (spread[:, None] * np.maximum(sigma_rad, MIN_COVARIANCE_RAD)[[0, 0, 0, 1, 1]]) ** 2
    return relative, directions, variances[:, :, None] * np.eye(5)
