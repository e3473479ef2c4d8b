"""The demo scene: a small town square that a camera walks around, back to where it began."""

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from snakesfm.arrays import Array
from snakesfm.geometry.camera import Camera
from snakesfm.geometry.poses import translation_of
from snakesfm.geometry.rotations import exp_so3
from snakesfm.seeding import derive_seed
from snakesfm.synthetic import textures
from snakesfm.synthetic.raster import Face, Texture, View

SUN = np.array([-0.45, 0.55, -0.70]) / np.linalg.norm([-0.45, 0.55, -0.70])
AMBIENT = 0.62
TEXELS_PER_METRE = 110
SQUARE_M = 30.0
MEADOW_M = 160.0
WALL_COLORS = (
    (214.0, 190.0, 150.0),
    (196.0, 120.0, 96.0),
    (176.0, 182.0, 190.0),
    (222.0, 206.0, 176.0),
    (160.0, 176.0, 150.0),
    (206.0, 160.0, 130.0),
)


@dataclass(frozen=True)
class DemoOptions:
    """The demo's images: how many around the full ring, their size and the lens."""

    image_count: int = 24
    width: int = 640
    height: int = 480
    focal_35mm: float = 28.4
    radius_m: float = 8.6
    seed: int = 0

    @property
    def camera(self) -> Camera:
        """The exact pinhole; focal lengths compare to 35 mm film by the diagonals."""
        focal = self.focal_35mm * math.hypot(self.width, self.height) / math.hypot(36.0, 24.0)
        return Camera("PINHOLE", self.width, self.height, (focal, focal, self.width / 2, self.height / 2))


def build_scene(seed: int) -> list[Face]:
    """The faces of the square; equal seeds give equal scenes."""
    builder = _Builder(seed)
    builder.box("tower", (0.0, 0.0), (2.3, 2.1, 4.6), 0.35, roof_m=1.7)
    builder.box("annex", (1.9, -1.0), (1.5, 1.8, 2.3), 0.35, roof_m=0.8)
    builder.box("kiosk", (-2.4, 1.5), (1.4, 1.2, 1.9), -0.5)
    builder.box("crate", (-1.5, -2.5), (1.0, 1.0, 1.0), 0.9)
    builder.box("small crate", (-2.5, -2.1), (0.7, 0.8, 0.6), 0.2)
    builder.box("plinth", (1.2, 2.7), (1.3, 0.9, 0.8), -0.2)
    for number, angle in enumerate((0.6, 2.0, 3.6, 5.1)):
        place = (4.0 * np.cos(angle), 4.0 * np.sin(angle))
        builder.column(f"column {number}", place, 0.28, 2.6 + 0.25 * number)
    house_angles = np.linspace(0.0, 2.0 * np.pi, 11)[:-1]
    for number, angle in enumerate(house_angles):
        rng = builder.rng("house place", str(number))
        distance = 14.0 + rng.uniform(-0.6, 1.6)
        size = (rng.uniform(4.6, 6.6), rng.uniform(3.4, 4.6), rng.uniform(3.0, 5.4))
        place = (distance * np.cos(angle + 0.12), distance * np.sin(angle + 0.12))
        yaw = angle + np.pi / 2 + rng.uniform(-0.25, 0.25)
        builder.box(f"house {number}", place, size, yaw, roof_m=rng.uniform(1.2, 2.2))
    builder.ground()
    return builder.faces


def camera_path(options: DemoOptions) -> list[View]:
    """A walk around the square, looking at its middle: a full ring, so the last image joins the first."""
    rng = np.random.default_rng(derive_seed(options.seed, "demo", "camera path"))
    views = []
    for angle in np.linspace(0.0, 2.0 * np.pi, options.image_count, endpoint=False):
        radius = options.radius_m + rng.uniform(-0.4, 0.4)
        center = np.array([radius * np.cos(angle), radius * np.sin(angle), 1.75 + rng.uniform(-0.2, 0.25)])
        target = np.array([0.0, 0.0, 2.0]) + rng.uniform(-0.35, 0.35, 3)
        rotation = look_at(center, target, np.radians(rng.uniform(-1.5, 1.5)))
        views.append(View(options.camera, rotation, translation_of(rotation, center)))
    return views


def sky(view: View, samples: int) -> Array:
    """A cloudless sky (H*samples, W*samples, 3) float32: a gradient by the elevation of the ray."""
    height, width = view.camera.height * samples, view.camera.width * samples
    columns, rows = np.meshgrid((np.arange(width) + 0.5) / samples, (np.arange(height) + 0.5) / samples)
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(view.matrix).T
    elevation = (rays @ view.rotation[:, 2]) / np.linalg.norm(rays, axis=-1)
    share = np.clip(elevation / 0.6, 0.0, 1.0)[..., None] ** 0.7
    haze, zenith = np.array([226.0, 232.0, 236.0]), np.array([92.0, 146.0, 208.0])
    gradient: Array = (haze + share * (zenith - haze)).astype(np.float32)
    return gradient


def sample_points(faces: list[Face], count: int, seed: int) -> Array:
    """World points (count,3) spread over the faces by area, the meadow left out."""
    rng = np.random.default_rng(derive_seed(seed, "demo", "points"))
    solid = [face for face in faces if np.linalg.norm(face.right) < MEADOW_M]
    areas = np.array([face.area for face in solid])
    chosen = np.sort(rng.choice(len(solid), count, p=areas / areas.sum()))
    a, b = rng.uniform(0.0, 1.0, (2, count))
    for k, number in enumerate(chosen):
        if solid[number].triangle:
            a[k] = 0.5 + (a[k] - 0.5) * b[k]
    origins, rights, downs = (
        np.array([getattr(solid[number], name) for number in chosen])
        for name in ("origin", "right", "down")
    )
    points: Array = origins + a[:, None] * rights + b[:, None] * downs
    return points


def look_at(center: Array, target: Array, roll_rad: float) -> Array:
    """cam_from_world rotation of a camera at ``center`` that looks at ``target``, with z up."""
    forward = (target - center) / np.linalg.norm(target - center)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation: Array = exp_so3(np.array([0.0, 0.0, roll_rad])) @ np.array(
        [right, np.cross(forward, right), forward]
    )
    return rotation


class _Builder:
    """Collects the faces of solids, and their outlines for the shadows on the ground."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.faces: list[Face] = []
        self.outlines: list[Array] = []

    def rng(self, *names: str) -> np.random.Generator:
        return np.random.default_rng(derive_seed(self.seed, "demo", *names))

    def quad(
        self, top_left: Array, top_right: Array, bottom_left: Array, texture: Texture, **more: Any
    ) -> None:
        right, down = top_right - top_left, bottom_left - top_left
        inward = np.cross(right, down)
        facing = max(float(SUN @ inward) / float(np.linalg.norm(inward)), 0.0)
        light = AMBIENT + (1.0 - AMBIENT) * facing
        self.faces.append(Face(top_left, right, down, texture, light=light, **more))

    def box(
        self,
        name: str,
        place: tuple[float, float],
        size: tuple[float, float, float],
        yaw_rad: float,
        roof_m: float = 0.0,
    ) -> None:
        """A block on the ground, with a flat top or a gable roof of height ``roof_m``."""
        turn = exp_so3(np.array([0.0, 0.0, yaw_rad]))
        half = np.array([size[0] / 2, size[1] / 2])
        signs = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
        foot = np.column_stack([signs * half, np.zeros(4)]) @ turn.T + (*place, 0.0)
        top = foot + np.array([0.0, 0.0, size[2]])
        for side in range(4):
            left, right = side, (side + 1) % 4
            texture = self._wall(name, side, size[side % 2], size[2])
            self.quad(top[left], top[right], foot[left], texture)
        if roof_m:
            self._gable_roof(name, top, roof_m)
        else:
            self.quad(top[3], top[2], top[0], self._wall(name, 4, size[0], size[1]))
        ridge = [(top[0] + top[3]) / 2 + (0, 0, roof_m), (top[1] + top[2]) / 2 + (0, 0, roof_m)]
        self.outlines.append(np.vstack([foot, top, ridge]))

    def _gable_roof(self, name: str, top: Array, roof_m: float) -> None:
        west, east = (top[0] + top[3]) / 2, (top[1] + top[2]) / 2
        up = np.array([0.0, 0.0, roof_m])
        ridge_west, ridge_east = west + up, east + up
        length = float(np.linalg.norm(east - west))
        slope = float(np.linalg.norm(ridge_west - top[0]))
        for side, (start, end, eaves) in enumerate(
            ((ridge_west, ridge_east, top[0]), (ridge_east, ridge_west, top[2]))
        ):
            rng = self.rng(name, "roof", str(side))
            shape = _texels(slope), _texels(length)
            color = (150.0 + 40.0 * rng.uniform(-1, 1), 84.0 + 24.0 * rng.uniform(-1, 1), 66.0)
            self.quad(start, end, eaves, Texture(textures.bricks(rng, *shape, color, (26, 22))))
        width = float(np.linalg.norm(top[0] - top[3]))
        for side, (left, right) in enumerate(((3, 0), (1, 2))):
            rng = self.rng(name, "gable", str(side))
            image = textures.planks(rng, _texels(roof_m), _texels(width), (142.0, 112.0, 84.0), 24)
            self.quad(top[left] + up, top[right] + up, top[left], Texture(image), triangle=True)

    def _wall(self, name: str, side: int, width_m: float, height_m: float) -> Texture:
        rng = self.rng(name, "wall", str(side))
        kind = int(rng.integers(0, 4))
        color = WALL_COLORS[int(rng.integers(0, len(WALL_COLORS)))]
        height, width = _texels(height_m), _texels(width_m)
        if "crate" in name:
            image = textures.planks(rng, height, width, (176.0, 136.0, 92.0), max(width // 6, 10))
        elif kind == 0:
            image = textures.bricks(rng, height, width, color, (14, 36))
        elif kind == 1:
            image = textures.stones(rng, height, width, color, 34.0)
        else:
            image = textures.plaster(rng, height, width, color)
        if height_m > 1.5:
            textures.add_windows(rng, image, max(1, round(width_m / 1.5)), max(1, round(height_m / 2.1)))
        for _ in range(1 + int(width_m * height_m / 7.0)):
            h, w = int(height * rng.uniform(0.14, 0.24)), int(width * rng.uniform(0.12, 0.22))
            y, x = int(rng.integers(0, height - h)), int(rng.integers(0, width - w))
            image[y : y + h, x : x + w] = textures.poster(rng, h, w)
        return Texture(image)

    def column(self, name: str, place: tuple[float, float], radius_m: float, height_m: float) -> None:
        """A round column: a prism of 14 sides under one texture."""
        sides = 14
        rng = self.rng(name)
        around = 2 * np.pi * radius_m
        shape = _texels(height_m), _texels(around)
        color = WALL_COLORS[int(rng.integers(0, len(WALL_COLORS)))]
        texture = Texture(textures.stones(rng, *shape, color, 26.0))
        angles = np.linspace(0.0, 2 * np.pi, sides + 1)
        foot = np.column_stack([radius_m * np.cos(angles), radius_m * np.sin(angles), np.zeros(sides + 1)])
        foot += (*place, 0.0)
        top = foot + np.array([0.0, 0.0, height_m])
        for side in range(sides):
            window = (side / sides, 0.0, (side + 1) / sides, 1.0)
            self.quad(top[side], top[side + 1], foot[side], texture, window=window)
        self.outlines.append(np.vstack([foot, top]))

    def ground(self) -> None:
        """The paved square with the shadows of all solids, and the meadow around it."""
        rng = self.rng("ground")
        texels = int(SQUARE_M * 72)
        paving = textures.stones(rng, texels, texels, (150.0, 144.0, 134.0), 30.0)
        paving += 12.0 * textures.clouds(rng, texels, texels, 6)[..., None]
        for _ in range(20):
            size = int(rng.integers(60, 120))
            x, y = rng.integers(0, texels - size, 2)
            paving[y : y + size, x : x + size] = 0.5 * paving[
                y : y + size, x : x + size
            ] + 0.5 * textures.poster(rng, size, size)
        paving *= self._shadows(texels)[..., None]
        meadow = np.empty((1024, 1024, 3), dtype=np.float32)
        meadow[:] = (104.0, 128.0, 74.0)
        meadow += 22.0 * textures.clouds(rng, 1024, 1024, 24)[..., None]
        self._floor(SQUARE_M, 0.0, Texture(paving))
        self._floor(MEADOW_M, -0.04, Texture(meadow))

    def _floor(self, side_m: float, height_m: float, texture: Texture) -> None:
        half = side_m / 2
        corners = np.array([(-half, half, height_m), (half, half, height_m), (-half, -half, height_m)])
        self.quad(corners[0], corners[1], corners[2], texture)

    def _shadows(self, texels: int) -> Array:
        mask = np.zeros((texels, texels), dtype=np.uint8)
        scale = texels / SQUARE_M
        for outline in self.outlines:
            cast = outline[:, :2] - outline[:, 2:] / SUN[2] * SUN[:2]
            pixels = np.column_stack([cast[:, 0] + SQUARE_M / 2, SQUARE_M / 2 - cast[:, 1]]) * scale
            hull = cv2.convexHull(pixels.astype(np.int32))
            cv2.fillConvexPoly(mask, hull, 255, cv2.LINE_AA)
        soft = cv2.GaussianBlur(mask, (0, 0), 3.0).astype(np.float32) / 255.0
        shadows: Array = 1.0 - 0.42 * soft
        return shadows


def _texels(metres: float) -> int:
    return max(8, int(metres * TEXELS_PER_METRE))
