"""Alignment of a point's keypoints to each other by the images' gray values.

A detector places each keypoint on its own; the pixels around the keypoints of one point show one piece of
surface, and agree on its place several times better (Lindenberger et al., Pixel-Perfect
Structure-from-Motion, ICCV 2021). Here one observation of each point is the template, and the others are
moved by the affine inverse-compositional algorithm (Baker and Matthews, IJCV 2004), which starts at the
warp of a plane that faces the cameras.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np

from snakesfm.arrays import Array
from snakesfm.grouping import rows_of_each

MAX_MOVE_PX = 1.5
"""An observation that moves farther has left its point; SIFT is off by a few tenths."""
CONVERGED_PX = 0.01
STALLED_PX = 0.1
"""An observation whose last step is larger has not settled."""
AFFINE_DAMPING = 1e-3
"""Holds the affine part, relative to the weight of the shift, where a patch has little texture."""
PATCHES_AT_ONCE = 256
"""Arrays over so many patches stay in a core's cache."""
IMAGES_AT_ONCE = 16
"""So many images are worked on in turn: even of large ones more are held."""
NOTHING = np.zeros(0, np.int64)


@dataclass(frozen=True)
class GrayImage:
    """Gray values (H,W) of an image, and the width and height (2,) of its pixels in those of keypoints."""

    gray: Array
    scale: Array


@dataclass(frozen=True)
class AlignmentSettings:
    """How observations are aligned.

    Parameters
    ----------
    radius_px : half the side of the square patch around a keypoint, in pixels of the gray images.
    min_correlation : normalised correlation that an aligned patch must have with its template.
    iterations : most steps per observation.
    threads : how many images are worked on at a time; results do not depend on it.
    """

    radius_px: int = 5
    min_correlation: float = 0.8
    iterations: int = 6
    threads: int = 1


@dataclass(frozen=True)
class _Templates:
    """The observations that others are aligned to.

    Parameters
    ----------
    rows : (K,) of the observations, ascending.
    patches : (K,S,S) float32 gray values around them.
    inverses : (K,6,6) float64, see :func:`_inverse_normals`.
    to_plane : (K,2,2), coordinates on the point's plane from pixels of the gray image.
    """

    rows: Array
    patches: Array
    inverses: Array
    to_plane: Array

    @classmethod
    def at(cls, rows: Array, radius: int) -> "_Templates":
        """Of none of them the patch is cut yet."""
        count, side = len(rows), 2 * radius + 3
        return cls(
            rows,
            np.zeros((count, side, side), dtype=np.float32),
            np.zeros((count, 6, 6)),
            np.zeros((count, 2, 2)),
        )


def choose_templates(
    directions: Array, sizes: Array, inside: Array, blurred: Array, offsets: Array
) -> Array:
    """The observation of each point whose view is the most central one of those that are not blurred.

    Sharp patches do not align well to a blurred one, and scatter more where they do.

    Parameters
    ----------
    directions : (L,3) unit rays from the points' cameras, in the world.
    sizes : (L,) log of how large the point's surroundings appear.
    inside, blurred : (L,) bool, whether the patch lies in the image, and whether the image is blurred.
    offsets : (T+1,) int64, rows ``offsets[k]:offsets[k+1]`` belong to point k.

    Returns
    -------
    Rows (T,) int64.
    """
    counts = np.diff(offsets)
    mean = np.add.reduceat(directions, offsets[:-1], axis=0)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    point_of = np.repeat(np.arange(len(counts)), counts)
    cosines = np.einsum("li,li->l", directions, mean[point_of])
    level = np.add.reduceat(sizes, offsets[:-1]) / counts
    oddness = np.arccos(np.clip(cosines, -1.0, 1.0)) + np.abs(sizes - level[point_of])
    order = np.lexsort((oddness, blurred, ~inside, point_of))
    return np.asarray(order[offsets[:-1]])


def align_observations(
    read_gray: Callable[[int], GrayImage | None],
    images: Array,
    pixels: Array,
    tangents: Array,
    templates: Array,
    inside: Array,
    settings: AlignmentSettings,
) -> tuple[Array, Array]:
    """Move observations to where their patch matches the template's best.

    Parameters
    ----------
    read_gray : gives image k, or None where there are no pixels; called at most twice per image.
    images : (L,) int, image of each observation.
    pixels : (L,2) float64, detector pixels.
    tangents : (L,2,2), how an observation moves in pixels with two coordinates on the point's plane.
    templates : (L,) int, row of the observation that is the template of each; of templates, their own.
    inside : (L,) bool, whether the patch lies in the image; others are left as they are.
    settings : how.

    Returns
    -------
    Pixels (L,2), and which observations (L,) bool were aligned or are templates; the others did not move.
    """
    moved, aligned = pixels.copy(), np.zeros(len(images), dtype=bool)
    usable = np.flatnonzero((templates != np.arange(len(images))) & inside & inside[templates])
    cut = _Templates.at(np.unique(templates[usable]), settings.radius_px)
    # an image is aligned as soon as all its templates are cut, when a sequence's images are still held
    last = np.arange(int(images.max(initial=-1)) + 1)
    np.maximum.at(last, images[usable], images[templates[usable]])
    to_cut = dict(rows_of_each(images[cut.rows] // IMAGES_AT_ONCE))
    to_align = dict(rows_of_each(last[images[usable]] // IMAGES_AT_ONCE))

    def align(part: tuple[int, Array]) -> tuple[Array, Array]:
        image, mine = part
        chosen = np.searchsorted(cut.rows, templates[mine])
        return _align_in_image(read_gray(image), pixels[mine], tangents[mine], cut, chosen, settings)

    # OpenCV and numpy run without Python's lock
    with ThreadPoolExecutor(settings.threads) as pool:
        for batch in sorted(to_cut.keys() | to_align.keys()):
            own = to_cut.get(batch, NOTHING)
            _cut_templates(pool, read_gray, images, pixels, tangents, cut, own, aligned)
            rows = usable[to_align.get(batch, NOTHING)]
            rows = rows[aligned[templates[rows]]]
            parts = [(image, rows[mine]) for image, mine in rows_of_each(images[rows])]
            for (_, mine), found in zip(parts, pool.map(align, parts), strict=True):
                moved[mine], aligned[mine] = found
    return moved, aligned


def _cut_templates(
    pool: ThreadPoolExecutor,
    read_gray: Callable[[int], GrayImage | None],
    images: Array,
    pixels: Array,
    tangents: Array,
    templates: _Templates,
    which: Array,
    there: Array,
) -> None:
    """Fill in some (k,) of the templates, with a border of a pixel for gradients; ``there`` marks them."""
    x, y = _grid(templates.patches.shape[1] // 2)

    def cut(part: tuple[int, Array]) -> None:
        image, mine = part
        read = read_gray(image)
        if read is None:
            return
        rows = templates.rows[mine]
        place = pixels[rows] / read.scale
        patches = _sample(read.gray.astype(np.float32), place[:, :1] + x, place[:, 1:] + y)
        templates.patches[mine] = patches.reshape(-1, *templates.patches.shape[1:])
        templates.to_plane[mine] = _inverse(tangents[rows] / read.scale[:, None])
        there[rows] = True

    def invert(part: Array) -> None:
        templates.inverses[part] = _inverse_normals(templates.patches[part])

    of_images = [(image, which[mine]) for image, mine in rows_of_each(images[templates.rows[which]])]
    starts = range(0, len(which), PATCHES_AT_ONCE)
    # each image writes rows of its own
    list(pool.map(cut, of_images))
    list(pool.map(invert, [which[start : start + PATCHES_AT_ONCE] for start in starts]))


def _grid(radius: int) -> tuple[Array, Array]:
    """Columns and rows (n,) float32 of the pixels of a square patch around its centre."""
    steps = np.arange(-radius, radius + 1, dtype=np.float32)
    x, y = np.meshgrid(steps, steps)
    return x.ravel(), y.ravel()


def _sample(gray: Array, x: Array, y: Array) -> Array:
    """Gray values (M,S) float32 at pixels, whose first one has its centre at (0.5, 0.5)."""
    half = np.float32(0.5)
    columns, rows = x.astype(np.float32, copy=False) - half, y.astype(np.float32, copy=False) - half
    sampled = np.empty(columns.shape, dtype=np.float32)
    # OpenCV's maps are shorter than 2^15
    for start in range(0, len(columns), 1 << 14):
        part = slice(start, start + (1 << 14))
        sampled[part] = cv2.remap(
            gray, columns[part], rows[part], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
        )
    return sampled


def _align_in_image(
    read: GrayImage | None,
    pixels: Array,
    tangents: Array,
    templates: _Templates,
    chosen: Array,
    settings: AlignmentSettings,
) -> tuple[Array, Array]:
    """Pixels (M,2) of observations in one image, and which (M,) bool were aligned; the others did not move.

    The template of each observation is the row ``chosen`` (M,) of ``templates``.
    """
    place, good = pixels.copy(), np.zeros(len(pixels), dtype=bool)
    if read is None:
        return place, good
    gray, starts = read.gray.astype(np.float32), pixels / read.scale
    warps = tangents / read.scale[:, None] @ templates.to_plane[chosen]
    for start in range(0, len(pixels), PATCHES_AT_ONCE):
        part = slice(start, start + PATCHES_AT_ONCE)
        own = chosen[part]
        found, good[part] = _align_patches(
            gray, starts[part], warps[part], templates.patches[own], templates.inverses[own], settings
        )
        place[part] = np.where(good[part, None], found * read.scale, pixels[part])
    return place, good


def _align_patches(
    gray: Array, pixels: Array, warps: Array, templates: Array, inverse: Array, settings: AlignmentSettings
) -> tuple[Array, Array]:
    """The same in pixels of the gray image, for so few that arrays stay small, with templates (M,S,S)."""
    radius = settings.radius_px
    grid, window = np.stack(_grid(radius)), _window(radius)
    wanted, slopes = _prepare(templates, grid)
    slopes *= window
    place, warps = pixels.copy(), warps.copy()
    last = np.full(len(pixels), np.inf)
    active = np.arange(len(pixels))
    for _ in range(settings.iterations):
        found, gain = _match(gray, place[active], warps[active], grid, window, wanted[active])
        found *= gain[:, None]
        found -= wanted[active]
        slope = np.matmul(slopes[active], found[:, :, None])
        step = np.matmul(inverse[active], slope)[:, :, 0]
        turn = _inverse(np.eye(2) + step[:, 2:].reshape(-1, 2, 2))
        warps[active] = warps[active] @ turn
        shift = -np.einsum("mij,mj->mi", warps[active], step[:, :2])
        length = np.linalg.norm(shift, axis=1)
        place[active] += shift / np.maximum(length, 1.0)[:, None]
        last[active] = length
        active = active[np.isfinite(length) & (length > CONVERGED_PX)]
        if not len(active):
            break
    finite = np.isfinite(place).all(axis=1) & np.isfinite(warps).all(axis=(1, 2))
    good = finite & (last < STALLED_PX) & (np.linalg.norm(place - pixels, axis=1) < MAX_MOVE_PX)
    rows = np.nonzero(good)[0]
    if not len(rows):
        return place, good
    found, gain = _match(gray, place[rows], warps[rows], grid, window, wanted[rows])
    # the gain is the regression of the template on the patch, so their correlation is its share explained
    explained = gain**2 * ((found**2) @ window) / np.maximum((wanted[rows] ** 2) @ window, 1e-12)
    good[rows] = (gain > 0) & (explained > settings.min_correlation**2)
    return place, good


def _window(radius: int) -> Array:
    """Weights (n,) float32 of the pixels of a patch; they sum to one."""
    x, y = _grid(radius)
    window = np.exp(-(x**2 + y**2) / (2 * (0.6 * radius) ** 2))
    return np.asarray(window / window.sum())


def _inverse(matrices: Array) -> Array:
    """Inverses of (M,2,2); not finite where there is none."""
    inverse = np.empty_like(matrices)
    inverse[:, 0, 0], inverse[:, 1, 1] = matrices[:, 1, 1], matrices[:, 0, 0]
    inverse[:, 0, 1], inverse[:, 1, 0] = -matrices[:, 0, 1], -matrices[:, 1, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse /= (matrices[:, 0, 0] * matrices[:, 1, 1] - matrices[:, 0, 1] * matrices[:, 1, 0])[
            :, None, None
        ]
    return inverse


def _prepare(templates: Array, grid: Array) -> tuple[Array, Array]:
    """Templates (M,n) of mean zero, and their slopes (M,6,n) by shift and affine part."""
    count = len(templates)
    inner = templates[:, 1:-1, 1:-1].reshape(count, -1)
    wanted = inner - (inner @ _window(templates.shape[1] // 2 - 1))[:, None]
    slopes = np.empty((count, 6, inner.shape[1]), dtype=np.float32)
    slopes[:, 0] = (templates[:, 1:-1, 2:] - templates[:, 1:-1, :-2]).reshape(count, -1)
    slopes[:, 1] = (templates[:, 2:, 1:-1] - templates[:, :-2, 1:-1]).reshape(count, -1)
    slopes[:, :2] /= 2
    slopes[:, 2:4] = slopes[:, :1] * grid
    slopes[:, 4:] = slopes[:, 1:2] * grid
    return wanted, slopes


def _inverse_normals(templates: Array) -> Array:
    """Inverse normal matrices (M,6,6) float64 of the steps that bring patches to templates (M,S,S)."""
    radius = templates.shape[1] // 2 - 1
    _, slopes = _prepare(templates, np.stack(_grid(radius)))
    normal = np.matmul(slopes * _window(radius), slopes.transpose(0, 2, 1)).astype(np.float64)
    strength = normal[:, 0, 0] + normal[:, 1, 1]
    damping = np.array([0, 0, 1, 1, 1, 1]) * AFFINE_DAMPING * float(radius) ** 2 + 1e-6
    normal[:, range(6), range(6)] += damping * np.maximum(strength, 1e-6)[:, None]
    return np.linalg.inv(normal)


def _match(
    gray: Array, place: Array, warps: Array, grid: Array, window: Array, wanted: Array
) -> tuple[Array, Array]:
    """Patches (M,n) of mean zero under the warps, and the gains (M,) that bring them to the templates."""
    moved = np.matmul(warps.astype(np.float32).reshape(-1, 2), grid).reshape(len(warps), 2, -1)
    moved += place.astype(np.float32)[:, :, None]
    found = _sample(gray, moved[:, 0], moved[:, 1])
    found -= (found @ window)[:, None]
    energy = (found**2) @ window
    return found, ((found * wanted) @ window) / np.maximum(energy, 1e-6)
