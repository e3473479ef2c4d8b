"""Surveys of any size: camera positions, and landmarks that are generated cell by cell as needed.

Nothing grows with the size of a survey but the list of cameras: the landmarks of a cell follow from the
seed and the cell's place alone.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Protocol

import numpy as np

from snakesfm.arrays import Array
from snakesfm.geometry.camera import Camera
from snakesfm.synthetic.layouts import look_at, wobble

Cell = tuple[int, int, int]
CELLS_KEPT = 2048
LANDMARKS_PER_CELL = 1 << 14
CELLS_PER_AXIS = 1 << 16
COMMON_LOOKS = 4000
COMMON_SHARE = 0.15


@dataclass(frozen=True)
class Landmarks:
    """Points on surfaces, (L) of them; world in metres, z up."""

    ids: Array
    """(L) int64, different for every landmark of a survey."""
    points: Array
    """(L,3) float64."""
    normals: Array
    """(L,3) float64, of the surface."""
    sizes: Array
    """(L) float64, diameter in metres of the patch that a detector responds to."""
    repeatability: Array
    """(L) float64 in 0 .. 1, how probably a camera that sees the landmark finds it."""
    appearance: Array
    """(L) uint64, landmarks of equal appearance have equal descriptors."""

    def take(self, rows: Array) -> "Landmarks":
        """Some of the landmarks."""
        return Landmarks(*(getattr(self, field.name)[rows] for field in fields(self)))

    @classmethod
    def join(cls, parts: "list[Landmarks]") -> "Landmarks":
        """All landmarks of one part or more."""
        columns = ([getattr(part, field.name) for part in parts] for field in fields(cls))
        return cls(*(np.concatenate(column) for column in columns))


class Survey(Protocol):
    """Cameras of a survey and the landmarks around them."""

    camera: Camera
    names: list[str]
    """N relative image names, sorted."""
    rotations: Array
    """(N,3,3) cam_from_world."""
    centers: Array
    """(N,3) in the world, metres."""
    reach_m: float
    """Half the side of the square around a camera, or the ground below it, where its landmarks lie."""
    depth_m: float
    """Typical distance of what a camera sees."""
    min_cosine: float
    """Cosine between a surface's normal and the ray to it below which nothing is found on it."""

    def neighbours(self) -> Array:
        """Pairs (P,2) of images that may see the same, i < j, sorted; all others see nothing in common."""

    def cell_origins(self, ids: Array) -> Array:
        """Corner (M,3) in the world of the cell of each landmark, NaN for the id -1."""

    def near(self, image: int) -> Landmarks:
        """All landmarks that a camera could see, and others."""

    def hidden(self, image: int, points: Array) -> Array:
        """Which points (L,3) something stands in front of, (L) bool."""


class AerialSurvey:
    """Photographs straight down from a grid of strips, 70 % overlap either way, over ground with buildings.

    Some cells of the ground are copies of one of a few patterns, as in a housing estate: they look the same
    and are not.

    Parameters
    ----------
    count : number N of images.
    seed : of everything random.
    copied : share of the cells that are copies.
    """

    camera = Camera("PINHOLE", 1600, 1200, (1400.0, 1400.0, 800.0, 600.0))
    reach_m, depth_m = 80.0, 100.0
    min_cosine = 0.5
    height_m = 100.0
    along_m, across_m = 25.0, 35.0
    cell_m = 20.0
    per_cell = 290
    patterns = 20

    def __init__(self, count: int, seed: int, copied: float = 0.03) -> None:
        self.seed = seed
        self.copied = copied
        rng = np.random.default_rng((seed, 1))
        columns = int(np.ceil(np.sqrt(count * self.across_m / self.along_m)))
        strip, place = np.divmod(np.arange(count), columns)
        place = np.where(strip % 2, columns - 1 - place, place)
        ground = np.stack([place * self.along_m, strip * self.across_m], axis=1)
        ground += rng.normal(0.0, 2.0, ground.shape)
        height = self.height_m + rng.normal(0.0, 2.0, (count, 1))
        self.centers = np.concatenate([ground, height], axis=1)
        heading = np.stack([1.0 - 2.0 * (strip % 2), np.zeros(count), np.zeros(count)], axis=1)
        self.rotations = wobble(look_at(self.centers, self.centers - [0.0, 0.0, 1.0], heading), 2.5, rng)
        self.names = [f"flight_{row:05d}.jpg" for row in range(count)]
        self._cell = functools.lru_cache(CELLS_KEPT)(self._make_cell)

    def near(self, image: int) -> Landmarks:
        """See :class:`Survey`."""
        axis = self.rotations[image, 2]
        center = self.centers[image, :2] + axis[:2] * self.height_m / -axis[2]
        low, high = (np.floor((center + side * self.reach_m) / self.cell_m).astype(int) for side in (-1, 1))
        return Landmarks.join(
            [self._cell((0, x, y)) for x in range(low[0], high[0] + 1) for y in range(low[1], high[1] + 1)]
        )

    def neighbours(self) -> Array:
        """See :class:`Survey`."""
        axes = self.rotations[:, 2]
        ground = self.centers[:, :2] + axes[:, :2] * self.height_m / -axes[:, 2:]
        return pairs_within(ground, 130.0)

    def cell_origins(self, ids: Array) -> Array:
        """See :class:`Survey`."""
        _, x, y = cells_of(ids)
        origins = np.stack([x * self.cell_m, y * self.cell_m, np.zeros(len(ids))], axis=1)
        return np.where(ids[:, None] < 0, np.nan, origins)

    def hidden(self, image: int, points: Array) -> Array:
        """Nothing is hidden from above."""
        return np.zeros(len(points), dtype=bool)

    def _make_cell(self, cell: Cell) -> Landmarks:
        rng = cell_generator(self.seed, cell)
        pattern = int(rng.integers(self.patterns)) if rng.random() < self.copied else -1
        if pattern >= 0:
            rng = np.random.default_rng((self.seed, 3, pattern))
        inside = rng.uniform(0.0, self.cell_m, (self.per_cell, 2))
        # four lots per cell, half of them with a building
        roofs = np.where(rng.random((2, 2)) < 0.5, rng.uniform(3.0, 20.0, (2, 2)), 0.0)
        lots = (inside // (self.cell_m / 2)).astype(int)
        spots = inside + np.array(cell[1:]) * self.cell_m
        relief = 6.0 * np.sin(spots[:, 0] / 57.0) * np.cos(spots[:, 1] / 71.0)
        height = relief + roofs[lots[:, 0], lots[:, 1]] + rng.normal(0.0, 0.3, self.per_cell)
        return make_landmarks(
            cell, np.column_stack([spots, height]), np.tile([0.0, 0.0, 1.0], (self.per_cell, 1)), 0.15, rng
        )


class StreetSurvey:
    """A car drives along all streets of a town of square blocks, with a camera to each of four sides.

    The pictures of one side hang together along a street; at the crossings, where the car comes by twice,
    the sides and the streets close to loops. Houses hide what lies behind them.

    Parameters
    ----------
    count : number N of images, at least 320.
    seed : of everything random.
    copied : share of the cells whose facades are copies of one of a few patterns.
    """

    camera = Camera("PINHOLE", 1200, 900, (780.0, 780.0, 600.0, 450.0))
    reach_m, depth_m = 30.0, 10.0
    min_cosine = 0.2
    pitch_m, half_width_m = 40.0, 6.0
    spacing_m = 2.0
    cell_m, facade_m = 10.0, 8.0
    per_cell = 16000
    patterns = 10
    sides = (("back", 180.0), ("front", 0.0), ("left", 90.0), ("right", -90.0))

    def __init__(self, count: int, seed: int, copied: float = 0.03) -> None:
        self.seed = seed
        self.copied = copied
        rng = np.random.default_rng((seed, 1))
        stops = -(-count // len(self.sides))
        blocks = max(1, int(np.sqrt(stops * self.spacing_m / (2.0 * self.pitch_m) + 0.25) - 0.5))
        street_m = blocks * self.pitch_m
        travelled = (np.arange(stops) + 0.5) * 2 * (blocks + 1) * street_m / stops
        street, along = np.divmod(travelled, street_m)
        axis, line = np.divmod(street.astype(int), blocks + 1)
        across = line * self.pitch_m + rng.normal(0.0, 0.2, stops)
        ground = np.where(axis[:, None] == 0, np.stack([along, across], 1), np.stack([across, along], 1))
        stands = np.column_stack([ground, 2.0 + rng.normal(0.0, 0.03, stops)])
        names, centers, rotations = [], [], []
        for number, (side, yaw_deg) in enumerate(self.sides):
            # so many images of each side that there are ``count`` in all
            kept = len(range(number, count, len(self.sides)))
            heading = np.radians(np.where(axis[:kept] == 0, 0.0, 90.0) + yaw_deg)
            forward = np.stack([np.cos(heading), np.sin(heading), np.zeros(kept)], axis=1)
            names += [f"{side}/drive_{row:05d}.jpg" for row in range(kept)]
            centers.append(stands[:kept])
            rotations.append(look_at(stands[:kept], stands[:kept] + forward, np.array([0.0, 0.0, 1.0])))
        self.names = names
        self.centers = np.concatenate(centers)
        self.rotations = wobble(np.concatenate(rotations), 2.0, rng)
        self._cell = functools.lru_cache(CELLS_KEPT // 16)(self._make_cell)

    def near(self, image: int) -> Landmarks:
        """See :class:`Survey`."""
        center, ahead = self.centers[image, :2], self.rotations[image, 2, :2]
        parts = []
        for axis in (0, 1):
            along, across = center[axis], center[1 - axis]
            near = round(across / self.pitch_m)
            for line in (near - 1, near, near + 1):
                if abs(line * self.pitch_m - across) > self.reach_m:
                    continue
                first, last = ((along + side * self.reach_m) // self.cell_m for side in (-1, 1))
                for stretch in range(int(first), int(last) + 1):
                    middle = np.array([(stretch + 0.5) * self.cell_m, line * self.pitch_m])
                    middle = middle if axis == 0 else middle[::-1]
                    if (middle - center) @ ahead > -self.cell_m:
                        parts.append(self._cell((axis + 1, stretch, line)))
        return Landmarks.join(parts)

    def neighbours(self) -> Array:
        """See :class:`Survey`; cameras that look apart by more than 75 degrees see little in common."""
        pairs = pairs_within(self.centers[:, :2], 25.0)
        axes = self.rotations[:, 2]
        aligned = np.einsum("pi,pi->p", axes[pairs[:, 0]], axes[pairs[:, 1]]) > 0.25
        return np.asarray(pairs[aligned])

    def cell_origins(self, ids: Array) -> Array:
        """See :class:`Survey`; streets across lie far away, as their copies are turned."""
        kind, along, line = cells_of(ids)
        corners = np.stack([along * self.cell_m, line * self.pitch_m, np.zeros(len(ids))], axis=1)
        across = kind == 2
        corners[across] = corners[across][:, [1, 0, 2]] + [0.0, 0.0, 1e6]
        return np.where(ids[:, None] < 0, np.nan, corners)

    def hidden(self, image: int, points: Array) -> Array:
        """Behind a house: part of the way to the point leads through one."""
        way = points[:, :2] - self.centers[image, :2]
        hidden = np.zeros(len(points), dtype=bool)
        for share in np.linspace(0.1, 0.97, 12):
            place = self.centers[image, :2] + share * way
            off = np.abs(place - self.pitch_m * np.rint(place / self.pitch_m))
            hidden |= (off > self.half_width_m).all(axis=1)
        return hidden

    def _make_cell(self, cell: Cell) -> Landmarks:
        axis, stretch, line = cell
        rng = cell_generator(self.seed, cell)
        pattern = int(rng.integers(self.patterns)) if rng.random() < self.copied else -1
        if pattern >= 0:
            rng = np.random.default_rng((self.seed, 4, pattern))
        count = self.per_cell
        side = rng.choice([-1.0, 1.0], count)
        on_road = rng.random(count) < 0.15
        inside = rng.uniform(0.0, self.cell_m, count)
        # facades have bays and ledges, every two metres another one
        bays = rng.uniform(-0.5, 0.5, (2, int(self.cell_m / 2)))
        depth = self.half_width_m + bays[(side > 0).astype(int), (inside / 2).astype(int)]
        across = np.where(on_road, rng.uniform(-5.0, 5.0, count), side * depth)
        height = np.where(on_road, 0.0, rng.uniform(0.0, self.facade_m, count))
        points = np.column_stack([inside + stretch * self.cell_m, across + line * self.pitch_m, height])
        normals = np.where(
            on_road[:, None],
            [0.0, 0.0, 1.0],
            np.column_stack([np.zeros(count), -side, np.zeros(count)]),
        )
        made = make_landmarks(cell, points, normals, 0.015, rng)
        off = np.abs(points[:, 0] - self.pitch_m * np.rint(points[:, 0] / self.pitch_m))
        made = made.take(np.flatnonzero(on_road | (off > self.half_width_m)))
        if axis == 2:
            made.points[:, :2] = made.points[:, 1::-1]
            made.normals[:, :2] = made.normals[:, 1::-1]
        return made


SURVEYS: dict[str, Callable[[int, int], Survey]] = {"aerial": AerialSurvey, "street": StreetSurvey}


def pairs_within(places: Array, radius: float) -> Array:
    """Pairs (P,2) int64 of places (N,2) no farther apart than ``radius``, i < j, sorted."""
    from scipy.spatial import cKDTree

    pairs = cKDTree(places).query_pairs(radius, output_type="ndarray").reshape(-1, 2)
    pairs = np.sort(pairs.astype(np.int64), axis=1)
    return np.asarray(pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))])


def cells_of(ids: Array) -> tuple[Array, Array, Array]:
    """Kind and place of the cells that landmarks (M) belong to."""
    key, y = np.divmod(ids // LANDMARKS_PER_CELL, CELLS_PER_AXIS)
    kind, x = np.divmod(key, CELLS_PER_AXIS)
    return kind, x - CELLS_PER_AXIS // 2, y - CELLS_PER_AXIS // 2


def cell_generator(seed: int, cell: Cell) -> np.random.Generator:
    """The generator of all that is random in a cell."""
    kind, x, y = cell
    return np.random.default_rng((seed, 2, kind, x + CELLS_PER_AXIS // 2, y + CELLS_PER_AXIS // 2))


def make_landmarks(
    cell: Cell, points: Array, normals: Array, least_size_m: float, rng: np.random.Generator
) -> Landmarks:
    """Landmarks of a cell at points (L,3) with normals (L,3); L is at most ``LANDMARKS_PER_CELL``.

    Their sizes follow a power law with as many landmarks per octave and image area at every distance, as
    natural images have them. Most are found seldom, few nearly always. Some look like ``COMMON_LOOKS``
    others, like leaves or window frames, the rest like nothing else.
    """
    kind, x, y = cell
    count = len(points)
    looks = rng.integers(0, 1 << 63, count, dtype=np.uint64)
    common = rng.integers(0, COMMON_LOOKS, count).astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    key = (kind * CELLS_PER_AXIS + x + CELLS_PER_AXIS // 2) * CELLS_PER_AXIS + y + CELLS_PER_AXIS // 2
    return Landmarks(
        ids=key * LANDMARKS_PER_CELL + np.arange(count),
        points=points,
        normals=normals,
        sizes=least_size_m / np.sqrt(rng.uniform(1e-3, 1.0, count)),
        repeatability=rng.beta(1.2, 1.8, count),
        appearance=np.where(rng.random(count) < COMMON_SHARE, common, looks),
    )
