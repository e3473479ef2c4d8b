"""A set of photographs as large as cameras take them, with exact truth, for ``benchmarks.compare``.

    python -m benchmarks.large_photographs DATA [--images 24] [--width 4000] [--seed 0] [--fisheye DEGREES]

The image sets at hand are scaled to 760 pixels. DATA/courtyard_WIDTH holds a rendered courtyard instead:
three walls, a floor and four blocks, seen along an arc. Its surfaces are covered by leaves (discs, ellipses
and boxes) from the size of a pixel up to a metre, much like dead leaves, which have the statistics of
photographs (Lee, Mumford and Huang 2001): there is about as much to see at any size of the image.
With --fisheye the lens is an equidistant one, and the folder's name says so.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from snakesfm.arrays import Array
from snakesfm.geometry.camera import Camera
from snakesfm.geometry.poses import translation_of
from snakesfm.seeding import derive_seed
from snakesfm.synthetic.raster import Face, Texture, View
from snakesfm.synthetic.render_demo import write_scene
from snakesfm.synthetic.scene import look_at, sample_points

FOCAL_35MM = 28.0
BLUR_PX = 0.7
POINTS = 4000
# texels per metre and pixel of the image's width: one texel a pixel at the usual distance of 7 metres
TEXELS_PER_METRE = 0.12
LEAVES_PER_TEXEL = 1 / 45
LEAF_RADII = (1.2, 400.0)
# how far the order in which leaves fall departs from the largest first, in logarithms of the radius
DISORDER = 0.45
# beyond, the corners of an image look sideways, which no pinhole shows
MOST_DEGREES = 130.0
META = "reference_source: rendered\nknown_intrinsics: true\n"
# x, y of the middle, side and height of the blocks in metres
BLOCKS = ((-2.5, 1.5, 1.3, 1.6), (1.5, 2.5, 1.0, 2.4), (3.0, 0.5, 1.2, 1.0), (-0.5, 0.2, 0.8, 0.7))


def dead_leaves(rng: np.random.Generator, height: int, width: int) -> Array:
    """Leaves of all sizes, the smaller mostly on top, (height,width,3) uint8; small ones are the most."""
    count = int(height * width * LEAVES_PER_TEXEL)
    least, most = LEAF_RADII
    radii = least / np.sqrt(1.0 - rng.uniform(0.0, 1.0, count) * (1.0 - (least / most) ** 2))
    places = rng.uniform(0.0, (width, height), (count, 2))
    cells = (max(height // 300, 2), max(width // 300, 2), 3)
    tones = cv2.resize(
        rng.uniform(95.0, 165.0, cells).astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC
    )
    image = tones.astype(np.uint8)
    for leaf in np.argsort(rng.normal(0.0, DISORDER, count) - np.log(radii)):
        (x, y), radius = places[leaf], radii[leaf]
        tone = tones[int(y), int(x)] + rng.normal(0.0, 38.0) + rng.normal(0.0, 8.0, 3)
        color = np.clip(tone, 5.0, 250.0).tolist()
        size = (2.0 * radius, 2.0 * radius * rng.uniform(0.5, 1.0))
        leaf_box = ((x, y), size, rng.uniform(0.0, 180.0))
        if radius < 3.0:
            cv2.circle(image, (int(16 * x), int(16 * y)), int(16 * radius), color, -1, cv2.LINE_AA, 4)
        elif rng.random() < 0.5:
            cv2.ellipse(image, leaf_box, color, -1, cv2.LINE_AA)
        else:
            corners = (16 * cv2.boxPoints(leaf_box)).astype(np.int32)
            cv2.fillConvexPoly(image, corners, color, cv2.LINE_AA, 4)
    return image


def build_courtyard(seed: int, texels_per_metre: float) -> list[Face]:
    """Three walls about a floor with blocks on it; metres, z up."""
    rng = np.random.default_rng(derive_seed(seed, "courtyard", "leaves"))
    faces: list[Face] = []

    def quad(top_left: Any, top_right: Any, bottom_left: Any, light: float) -> None:
        origin = np.array(top_left, dtype=float)
        right, down = np.array(top_right) - origin, np.array(bottom_left) - origin
        height, width = (int(np.linalg.norm(side) * texels_per_metre) for side in (down, right))
        faces.append(Face(origin, right, down, Texture(dead_leaves(rng, height, width)), light=light))

    quad((-6, 5, 4.5), (6, 5, 4.5), (-6, 5, 0), 1.0)
    quad((-6, -3, 4), (-6, 5, 4), (-6, -3, 0), 0.85)
    quad((6, 5, 4), (6, -3, 4), (6, 5, 0), 0.8)
    quad((-6, 5, 0), (6, 5, 0), (-6, -3, 0), 0.9)
    for x, y, side, height in BLOCKS:
        west, east, south, north = x - side / 2, x + side / 2, y - side / 2, y + side / 2
        quad((west, south, height), (east, south, height), (west, south, 0), 0.95)
        quad((west, north, height), (west, south, height), (west, north, 0), 0.8)
        quad((east, south, height), (east, north, height), (east, south, 0), 0.75)
        quad((west, north, height), (east, north, height), (west, south, height), 1.0)
    return faces


def pinhole(width: int) -> Camera:
    """A camera of 3:2 without distortion."""
    height = width * 2 // 3
    focal = FOCAL_35MM / 36.0 * width
    return Camera("PINHOLE", width, height, (focal, focal, width / 2, height / 2))


def fisheye(width: int, degrees: float) -> tuple[Camera, Camera]:
    """An equidistant lens of 3:2 that sees so many degrees across, and a pinhole that sees as much."""
    height = width * 2 // 3
    focal = width / np.radians(degrees)
    lens = (focal, focal, width / 2, height / 2, 0.0, 0.0, 0.0, 0.0)
    side = 2 * int(focal * np.tan(np.hypot(width, height) / 2 / focal)) + 4
    square = (focal, focal, side / 2, side / 2)
    return Camera("OPENCV_FISHEYE", width, height, lens), Camera("PINHOLE", side, side, square)


def place_views(seed: int, count: int, camera: Camera) -> dict[str, View]:
    """Views along an arc in front of the courtyard, each turned a little."""
    rng = np.random.default_rng(derive_seed(seed, "courtyard", "views"))
    views = {}
    for number, along in enumerate(np.linspace(-0.5, 0.5, count)):
        offset = rng.uniform((-0.3, -0.8, -0.4), (0.3, 0.8, 0.8))
        center = np.array([8.0 * along, 2.0 * abs(along) - 6.0, 1.7]) + offset
        target = np.array([-along, 3.0, 1.4]) + rng.uniform(-1.0, 1.0, 3) * (1.5, 0.0, 0.4)
        rotation = look_at(center, target, np.radians(rng.uniform(-3.0, 3.0)))
        views[f"courtyard_{number:03d}.jpg"] = View(camera, rotation, translation_of(rotation, center))
    return views


def main(arguments: list[str]) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.large_photographs", description=__doc__)
    parser.add_argument("data", type=Path, help="folder that gets the set")
    parser.add_argument("--images", type=int, default=24)
    parser.add_argument("--width", type=int, default=4000, help="in pixels; the height is two thirds of it")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--fisheye", type=float, metavar="DEGREES", help=f"at most {MOST_DEGREES:.0f}")
    given = parser.parse_args(arguments)
    cv2.setNumThreads(1)
    bent = f"_fisheye_{given.fisheye:.0f}" if given.fisheye else ""
    folder = given.data / f"courtyard_{given.width}{bent}"
    if given.fisheye and not 10.0 <= given.fisheye <= MOST_DEGREES:
        sys.stderr.write(f"--fisheye is {given.fisheye:.0f}: give 10 to {MOST_DEGREES:.0f} degrees.\n")
        return 1
    if folder.exists():
        sys.stderr.write(f"{folder} is there already: remove it or name another folder.\n")
        return 1
    faces = build_courtyard(given.seed, given.width * TEXELS_PER_METRE)
    points = sample_points(faces, POINTS, given.seed)
    lens, camera = fisheye(given.width, given.fisheye) if given.fisheye else (None, pinhole(given.width))
    views = place_views(given.seed, given.images, camera)
    focal_35mm = 36.0 * (lens or camera).params[0] / given.width
    write_scene(folder, faces, views, points, given.seed, focal_35mm, samples=1, blur_px=BLUR_PX, lens=lens)
    (folder / "meta.yaml").write_text(META, "utf-8")
    sys.stdout.write(f"{given.images} images in {folder / 'images'}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
