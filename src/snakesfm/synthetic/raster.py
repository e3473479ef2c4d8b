"""A renderer of textured planes: exact perspective, occlusion by a depth buffer, anti-aliased."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from snakesfm.arrays import Array
from snakesfm.geometry.camera import Camera

NEAR = 0.05
MAX_LEVEL = 6
REMAP_WIDTH = 1024


class Texture:
    """An image (H,W,3) float32 in 0..255 with its pyramid of halved sizes."""

    def __init__(self, image: Array) -> None:
        self.levels = [np.clip(image, 0.0, 255.0).astype(np.float32)]
        while len(self.levels) <= MAX_LEVEL and min(self.levels[-1].shape[:2]) > 2:
            height, width = self.levels[-1].shape[:2]
            size = (max(width // 2, 1), max(height // 2, 1))
            self.levels.append(cv2.resize(self.levels[-1], size, interpolation=cv2.INTER_AREA))

    def sample(self, u: Array, v: Array, lod: Array) -> Array:
        """Trilinear samples (n,3) at u, v in 0..1 (n,) on the pyramid level ``lod`` (n,)."""
        lod = np.clip(lod, 0.0, len(self.levels) - 1.001)
        below = lod.astype(np.int32)
        result = np.empty((len(u), 3), dtype=np.float32)
        for level in np.unique(below).tolist():
            chosen = np.flatnonzero(below == level)
            finer = self._bilinear(level, u[chosen], v[chosen])
            coarser = self._bilinear(level + 1, u[chosen], v[chosen])
            share = (lod[chosen] - level)[:, None]
            result[chosen] = finer + share * (coarser - finer)
        return result

    def _bilinear(self, level: int, u: Array, v: Array) -> Array:
        image = self.levels[level]
        rows = -(-len(u) // REMAP_WIDTH)
        maps = np.zeros((2, rows * REMAP_WIDTH), dtype=np.float32)
        maps[0, : len(u)] = u * image.shape[1] - 0.5
        maps[1, : len(u)] = v * image.shape[0] - 0.5
        x, y = maps.reshape(2, rows, REMAP_WIDTH)
        sampled = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        flat: Array = sampled.reshape(-1, 3)[: len(u)]
        return flat


@dataclass(frozen=True)
class Face:
    """A textured parallelogram or triangle, seen from one side.

    Points are ``origin + a * right + b * down`` with a, b in 0..1; seen from the front, ``right`` points
    right and ``down`` points down in the texture. A triangle has its apex in the middle of the upper edge.
    """

    origin: Array
    right: Array
    down: Array
    texture: Texture
    window: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0)
    light: float = 1.0
    triangle: bool = False

    @cached_property
    def corners(self) -> Array:
        """The parallelogram's corners (4,3), in order around it."""
        right, down = self.right, self.down
        corners: Array = self.origin + np.array([0.0 * right, right, right + down, down])
        return corners

    @property
    def area(self) -> float:
        """In square units of the world."""
        area = float(np.linalg.norm(np.cross(self.right, self.down)))
        return area / 2 if self.triangle else area


@dataclass(frozen=True)
class View:
    """A pinhole camera with its cam_from_world pose."""

    camera: Camera
    rotation: Array
    translation: Array

    @property
    def matrix(self) -> Array:
        """The calibration matrix (3,3) in pixels."""
        matrix: Array = self.camera.to_pycolmap().calibration_matrix()
        return matrix

    def project(self, points: Array) -> tuple[Array, Array]:
        """Pixels (n,2) and depths (n,) of world points (n,3)."""
        local = points @ self.rotation.T + self.translation
        image = local @ self.matrix.T
        with np.errstate(divide="ignore", invalid="ignore"):
            return image[:, :2] / image[:, 2:], local[:, 2]


def render(faces: Sequence[Face], view: View, background: Array, samples: int = 2) -> tuple[Array, Array]:
    """Render faces over a background.

    Parameters
    ----------
    faces : any order; the nearest is seen.
    background : (H*samples, W*samples, 3) float32 in 0..255, RGB.
    samples : samples per pixel along each axis.

    Returns
    -------
    image : (H, W, 3) float32 in 0..255, RGB.
    inverse_depth : (H*samples, W*samples) float32 of the samples, 0 where the background is seen.
    """
    height, width = view.camera.height * samples, view.camera.width * samples
    inverse_depth = np.zeros((height, width), dtype=np.float32)
    owner = np.full((height, width), -1, dtype=np.int32)
    image_from_face = [_pixel_map(face, view) for face in faces]
    for number, face in enumerate(faces):
        inverse = image_from_face[number]
        box = None if inverse is None else _bounding_box(face, view, samples)
        if inverse is not None and box is not None:
            _draw_depth(face, inverse, box, samples, number, inverse_depth, owner)
    canvas = background.copy()
    flat = canvas.reshape(-1, 3)
    order = np.argsort(owner, axis=None, kind="stable")
    bounds = np.searchsorted(owner.ravel()[order], np.arange(len(faces) + 1))
    for number, face in enumerate(faces):
        pixels = order[bounds[number] : bounds[number + 1]]
        inverse = image_from_face[number]
        if len(pixels) and inverse is not None:
            flat[pixels] = _shade(face, inverse, pixels, width, samples)
    size = (view.camera.width, view.camera.height)
    return cv2.resize(canvas, size, interpolation=cv2.INTER_AREA), inverse_depth


def _pixel_map(face: Face, view: View) -> Array | None:
    """The matrix (3,3) from pixels (x, y, 1) to (a, b, 1) / depth; None where the back is seen."""
    local = np.column_stack([face.right, face.down, face.origin])
    local = view.rotation @ local
    local[:, 2] += view.translation
    if np.cross(local[:, 0], local[:, 1]) @ local[:, 2] <= 1e-9:
        return None
    inverse: Array = np.linalg.inv(view.matrix @ local)
    return inverse


def _bounding_box(face: Face, view: View, samples: int) -> tuple[int, int, int, int] | None:
    """Rows and columns of the samples that the face may cover, after clipping at the near plane."""
    local = face.corners @ view.rotation.T + view.translation
    clipped = []
    for start, end in zip(local, np.roll(local, -1, axis=0), strict=True):
        if start[2] >= NEAR:
            clipped.append(start)
        if (start[2] >= NEAR) != (end[2] >= NEAR):
            clipped.append(start + (NEAR - start[2]) / (end[2] - start[2]) * (end - start))
    if not clipped:
        return None
    image = np.array(clipped) @ view.matrix.T
    pixels = image[:, :2] / image[:, 2:] * samples
    limit = np.array([view.camera.width, view.camera.height]) * samples
    low = np.clip(np.floor(pixels.min(axis=0)), 0, limit).astype(int)
    high = np.clip(np.ceil(pixels.max(axis=0)), 0, limit).astype(int)
    return None if np.any(high <= low) else (low[1], high[1], low[0], high[0])


def _draw_depth(
    face: Face,
    inverse: Array,
    box: tuple[int, int, int, int],
    samples: int,
    number: int,
    inverse_depth: Array,
    owner: Array,
) -> None:
    x = ((np.arange(box[2], box[3]) + 0.5) / samples)[None]
    y = ((np.arange(box[0], box[1]) + 0.5) / samples)[:, None]
    rows = [(row[0] * x).astype(np.float32) + (row[1] * y + row[2]).astype(np.float32) for row in inverse]
    a, b, depth = rows
    area = (slice(box[0], box[1]), slice(box[2], box[3]))
    covered = (depth > inverse_depth[area]) & (b >= 0) & (b <= depth)
    covered &= (np.abs(a - 0.5 * depth) <= 0.5 * b) if face.triangle else ((a >= 0) & (a <= depth))
    np.copyto(inverse_depth[area], depth, where=covered)
    owner[area][covered] = number


def _shade(face: Face, inverse: Array, pixels: Array, width: int, samples: int) -> Array:
    x = (pixels % width + 0.5) / samples
    y = (pixels // width + 0.5) / samples
    a, b, depth = (row[0] * x + row[1] * y + row[2] for row in inverse)
    left, top, right, bottom = face.window
    u = left + a / depth * (right - left)
    v = top + b / depth * (bottom - top)
    height, columns = face.texture.levels[0].shape[:2]
    texels = height * columns * (right - left) * (bottom - top)
    footprint = abs(np.linalg.det(inverse)) / depth**3 * texels / samples**2
    shaded: Array = face.light * face.texture.sample(u, v, 0.5 * np.log2(np.maximum(footprint, 1e-9)))
    return shaded
