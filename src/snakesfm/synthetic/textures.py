"""Procedural textures: images full of distinct detail that no two surfaces share."""

import cv2
import numpy as np

from snakesfm.arrays import Array

Color = tuple[float, float, float]


def clouds(rng: np.random.Generator, height: int, width: int, coarsest: int = 4) -> Array:
    """Smooth noise (height, width) float32 with mean 0 and deviation 1: octaves of resized white noise."""
    total = np.zeros((height, width), dtype=np.float32)
    cells, weight = coarsest, 1.0
    while cells < max(height, width):
        rows = max(2, round(cells * height / max(height, width)))
        columns = max(2, round(cells * width / max(height, width)))
        noise = rng.standard_normal((rows, columns)).astype(np.float32)
        total += weight * cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)
        cells, weight = cells * 2, weight * 0.72
    result: Array = (total - total.mean()) / total.std()
    return result


def plaster(rng: np.random.Generator, height: int, width: int, color: Color) -> Array:
    """A stained wall (height, width, 3) float32 in 0..255."""
    base = np.full((height, width, 3), color, dtype=np.float32)
    base += 11.0 * clouds(rng, height, width, 5)[..., None]
    stains = np.clip(clouds(rng, height, width, 9) - 0.9, 0.0, 1.5)
    return base - stains[..., None] * np.array([34.0, 40.0, 46.0], dtype=np.float32)


def bricks(
    rng: np.random.Generator, height: int, width: int, color: Color, brick: tuple[int, int]
) -> Array:
    """Courses of bricks (height, width, 3), each of its own tone; ``brick`` is height and width."""
    image = np.full((height, width, 3), (168.0, 160.0, 150.0), dtype=np.float32)
    for row, top in enumerate(range(0, height, brick[0])):
        start = -int(rng.integers(0, brick[1])) if row % 2 else 0
        while start < width:
            length = int(brick[1] * rng.uniform(0.75, 1.25))
            tone = rng.normal(0.0, 20.0) + rng.normal(0.0, 7.0, 3)
            image[top + 1 : top + brick[0] - 1, max(start + 1, 0) : max(start + length - 1, 0)] = (
                color + tone
            )
            start += length
    return image + 9.0 * clouds(rng, height, width, 12)[..., None]


def stones(rng: np.random.Generator, height: int, width: int, color: Color, size: float) -> Array:
    """Irregular stones with dark joints (height, width, 3): a jittered grid's Voronoi cells."""
    rows, columns = np.mgrid[size / 2 : height : size, size / 2 : width : size]
    seeds = (
        np.stack([rows.ravel(), columns.ravel()], axis=1) + rng.uniform(-0.4, 0.4, (rows.size, 2)) * size
    )
    marks = np.full((height, width), 255, dtype=np.uint8)
    places = np.clip(seeds.astype(int), 0, [height - 1, width - 1])
    marks[places[:, 0], places[:, 1]] = 0
    _, labels = cv2.distanceTransformWithLabels(
        marks, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    tones = rng.normal(0.0, 20.0, (int(labels.max()) + 1, 1)) + rng.normal(
        0.0, 6.0, (int(labels.max()) + 1, 3)
    )
    image = (np.asarray(color) + tones).astype(np.float32)[labels]
    edges = cv2.morphologyEx(labels.astype(np.float32), cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0
    joints = cv2.GaussianBlur(edges.astype(np.float32), (0, 0), max(size / 22.0, 0.8))
    image -= 70.0 * np.minimum(joints, 1.0)[..., None]
    result: Array = image + 10.0 * clouds(rng, height, width, 8)[..., None]
    return result


def planks(rng: np.random.Generator, height: int, width: int, color: Color, board: int) -> Array:
    """Vertical boards (height, width, 3) with grain and nails."""
    image = np.empty((height, width, 3), dtype=np.float32)
    grain = cv2.resize(
        rng.standard_normal((max(height // 40, 2), width)).astype(np.float32), (width, height)
    )
    image[:] = np.asarray(color) + 9.0 * grain[..., None] + 8.0 * clouds(rng, height, width, 6)[..., None]
    left = 0
    while left < width:
        right = left + int(board * rng.uniform(0.8, 1.2))
        image[:, left:right] += rng.normal(0.0, 16.0)
        image[:, max(right - 2, 0) : right] -= 55.0
        for row in rng.integers(0, height, 3):
            cv2.circle(image, ((left + right) // 2, int(row)), 2, (45.0, 42.0, 40.0), -1)
        left = right
    return image


def poster(rng: np.random.Generator, height: int, width: int) -> Array:
    """A picture of random discs, boxes, triangles and arcs (height, width, 3)."""
    image = np.empty((height, width, 3), dtype=np.uint8)
    image[:] = rng.integers(120, 240, 3)
    for _ in range(26):
        color = tuple(rng.integers(15, 250, 3).tolist())
        x, y = int(rng.integers(0, width)), int(rng.integers(0, height))
        size = int(rng.uniform(0.05, 0.22) * min(height, width)) + 2
        kind = int(rng.integers(0, 4))
        if kind == 0:
            cv2.circle(image, (x, y), size, color, -1, cv2.LINE_AA)
        elif kind == 1:
            cv2.rectangle(image, (x, y), (x + 2 * size, y + size), color, -1)
        elif kind == 2:
            corners = rng.integers(-size, size + 1, (3, 2)) * 2 + (x, y)
            cv2.fillPoly(image, [corners.astype(np.int32)], color, cv2.LINE_AA)
        else:
            start = int(rng.integers(0, 360))
            cv2.ellipse(image, (x, y), (size, size), 0, start, start + 250, color, 4, cv2.LINE_AA)
    return image + 4.0 * clouds(rng, height, width, 6)[..., None]


def add_windows(rng: np.random.Generator, wall: Array, columns: int, rows: int) -> None:
    """Draw shuttered windows, and one door, into a wall (H,W,3) in place."""
    height, width = wall.shape[:2]
    door = int(rng.integers(0, columns))
    for row in range(rows):
        for column in range(columns):
            is_door = row == rows - 1 and column == door
            w = int(width / columns * rng.uniform(0.3, 0.42))
            h = int(height / rows * (0.78 if is_door else rng.uniform(0.45, 0.58)))
            x = int(width * (column + 0.5) / columns - w / 2 + rng.uniform(-0.03, 0.03) * width)
            y = height - h if is_door else int(height * (row + 0.5) / rows - h / 2)
            frame = tuple(rng.uniform(60.0, 220.0, 3).tolist())
            cv2.rectangle(wall, (x - 5, y - 5), (x + w + 5, y + h + 5), frame, -1)
            inside = planks(rng, h, w, (96.0, 70.0, 52.0), max(w // 5, 6)) if is_door else _panes(rng, h, w)
            wall[y : y + h, x : x + w] = inside[: height - y]


def _panes(rng: np.random.Generator, height: int, width: int) -> Array:
    glass = np.empty((height, width, 3), dtype=np.float32)
    glass[:] = np.array([46.0, 58.0, 74.0]) + rng.normal(0.0, 8.0, 3)
    glass += 22.0 * clouds(rng, height, width, 3)[..., None]
    bar = tuple(rng.uniform(170.0, 235.0, 3).tolist())
    middle = width // 2 + int(rng.integers(-3, 4))
    cv2.line(glass, (middle, 0), (middle, height), bar, 4)
    for share in (0.33, 0.66):
        row = int(height * (share + rng.uniform(-0.06, 0.06)))
        cv2.line(glass, (0, row), (width, row), bar, 3)
    return glass
