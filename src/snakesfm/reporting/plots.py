"""Small inline pictures: a histogram and maps of cameras and points."""

import base64
import html
from collections.abc import Sequence

import cv2
import numpy as np

from snakesfm.arrays import Array
from snakesfm.geometry.poses import center_of, lower_sides

MAP_PX = 560
MARGIN = 0.05
# times the distance from the middle within which nine tenths of the cameras lie; real sets need 2.3
REACH = 3.0
# of fewer cameras none counts as far away: of three along a street one often is thrice as far as the next
LEAST_JUDGED = 6
MARK_PX = 11.0
# more cameras have smaller marks, which would else hide the points
FULL_SIZE_MARKS = 50
HISTOGRAM_SIZE = (560, 180)
# length of a mean of unit vectors that agree on a direction
LEAST_AGREED = 0.5


def error_histogram(errors_px: Array, bins: int = 40) -> str:
    """An SVG histogram of errors in pixels, its range cut at the 99th percentile."""
    errors = errors_px[np.isfinite(errors_px)]
    if len(errors) == 0:
        return ""
    width, height = HISTOGRAM_SIZE
    limit = max(float(np.percentile(errors, 99)), 1e-6)
    counts, edges = np.histogram(np.minimum(errors, limit), bins=bins, range=(0.0, limit))
    step = width / bins
    bars = []
    for k, count in enumerate(counts.tolist()):
        bar = count / counts.max() * (height - 24)
        title = f"{edges[k]:.3g} to {edges[k + 1]:.3g} px: {count}"
        bars.append(
            f'<rect class="bar" x="{k * step:.1f}" y="{height - 20 - bar:.1f}" width="{step - 1:.1f}" '
            f'height="{bar:.1f}"><title>{title}</title></rect>'
        )
    ticks = [
        f'<text x="{share * width:.0f}" y="{height - 4}" text-anchor="{anchor}">'
        f"{share * limit:.2g} px</text>"
        for share, anchor in (
            (0.0, "start"),
            (0.25, "middle"),
            (0.5, "middle"),
            (0.75, "middle"),
            (1.0, "end"),
        )
    ]
    return f'<svg viewBox="0 0 {width} {height}" class="plot">{"".join(bars)}{"".join(ticks)}</svg>'


def view_axes(rotations: Array, translations: Array, orientations: Array) -> Array:
    """Axes (3,3) of the maps as rows: east, north and up of a world of unknown orientation.

    Down is the mean of the photographs' lower sides if they agree, else (cameras looking down all around)
    the direction in which the centres spread least, on the side that the cameras look to.

    Parameters
    ----------
    rotations, translations : (n,3,3), (n,3) cam_from_world, finite, n >= 1.
    orientations : (n,) EXIF orientations 1..8.
    """
    down = lower_sides(rotations, orientations).mean(axis=0)
    centers = center_of(rotations, translations)
    spread = np.linalg.svd(centers - centers.mean(axis=0), full_matrices=True)[2]
    if np.linalg.norm(down) < LEAST_AGREED:
        down = spread[2] * (np.sign(rotations[:, 2].mean(axis=0) @ spread[2]) or 1.0)
    up = -down / np.linalg.norm(down)
    east = spread[0] - (spread[0] @ up) * up
    if np.linalg.norm(east) < 1e-6:
        east = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    east = east / np.linalg.norm(east)
    return np.array([east, np.cross(up, east), up])


def map_box(centers: Array, points: Array) -> tuple[Array, Array]:
    """The lowest and highest of each axis that a map shows: cameras far away from all others are outside.

    Parameters
    ----------
    centers, points : (n,k) and (T,k) along the map's axes, n >= 1.
    """
    low, high = centers.min(axis=0), centers.max(axis=0)
    if len(centers) >= LEAST_JUDGED:
        middle = np.median(centers, axis=0)
        distances = np.linalg.norm(centers - middle, axis=1)
        # a value of the set: one between two would follow the farthest camera of a few
        reach = REACH * float(np.quantile(distances, 0.9, method="lower"))
        low, high = np.maximum(low, middle - reach), np.minimum(high, middle + reach)
    if len(points):
        low = np.minimum(low, np.percentile(points, 2, axis=0))
        high = np.maximum(high, np.percentile(points, 98, axis=0))
    return low, high


def scene_map(
    names: Sequence[str],
    rotations: Array,
    translations: Array,
    points: Array,
    colors: Array,
    axes: Array,
) -> tuple[str, int]:
    """Points as a picture and cameras as triangles that name their image, seen along ``axes[2]``.

    Beside the map, how many cameras lie outside it.

    Parameters
    ----------
    names, rotations, translations : the registered images, n >= 1.
    points, colors : (T,3) float64 and (T,3) uint8 RGB.
    axes : (3,3) rows right, up and towards the viewer of the map.
    """
    centers = center_of(rotations, translations) @ axes.T
    places = points @ axes.T
    low, high = map_box(centers[:, :2], places[:, :2])
    extent = max(float((high - low).max()), 1e-9)
    low, high = low - MARGIN * extent, high + MARGIN * extent
    scale = MAP_PX / float((high - low).max())
    width, height = np.maximum(np.ceil((high - low) * scale), 120).astype(int).tolist()

    def pixels(xy: Array) -> Array:
        return np.column_stack([(xy[:, 0] - low[0]) * scale, height - (xy[:, 1] - low[1]) * scale])

    picture = _point_picture(pixels(places), places[:, 2], colors, (width, height))
    spots = pixels(centers)
    outside = int(np.count_nonzero(((spots < 0) | (spots > (width, height))).any(axis=1)))
    forward = rotations[:, 2] @ axes.T
    long = MARK_PX * min(1.0, (FULL_SIZE_MARKS / len(names)) ** 0.25)
    mark = f"M0 0L{long:.1f} {-long / 2.2:.1f}V{long / 2.2:.1f}Z"
    marks = []
    for name, place, look in zip(names, spots, forward, strict=True):
        angle = np.degrees(np.arctan2(-look[1], look[0]))
        marks.append(
            f'<path d="{mark}" transform="translate({place[0]:.1f} {place[1]:.1f}) '
            f'rotate({angle:.0f})"><title>{html.escape(name)}</title></path>'
        )
    shown = (
        f'<svg viewBox="0 0 {width} {height}" class="plot map" style="max-width:{width}px">'
        f'<image href="data:image/png;base64,{picture}" width="{width}" height="{height}"/>'
        f'<g class="cameras">{"".join(marks)}</g></svg>'
    )
    return shown, outside


def _point_picture(pixels: Array, heights: Array, colors: Array, size: tuple[int, int]) -> str:
    """A transparent PNG with the points, higher ones over lower ones, as base64."""
    width, height = size
    picture = np.zeros((2 * height, 2 * width, 4), dtype=np.uint8)
    inside = np.all((pixels >= 0) & (pixels < (width, height)), axis=1)
    rows = np.flatnonzero(inside)[np.argsort(heights[inside], kind="stable")]
    x, y = (2 * pixels[rows]).astype(int).T
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        target = np.minimum(y + dy, 2 * height - 1), np.minimum(x + dx, 2 * width - 1)
        picture[target] = np.column_stack([colors[rows][:, ::-1], np.full(len(rows), 255, np.uint8)])
    # the highest level takes eight times as long for .6 % less
    ok, data = cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 6])
    return base64.b64encode(data.tobytes()).decode("ascii") if ok else ""
