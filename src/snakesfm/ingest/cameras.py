"""Assignment of images to cameras, and the initial intrinsics of these."""

import re
from bisect import bisect_left, bisect_right
from collections import Counter, defaultdict
from collections.abc import Container, Hashable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import PurePosixPath
from typing import Literal

import numpy as np

from snakesfm.arrays import Array
from snakesfm.geometry.camera import Camera
from snakesfm.geometry.colmap_binding import pycolmap
from snakesfm.ingest.exif import Exif, focal_from_exif, is_cropped, is_of_stated_size

Sharing = Literal["auto", "exif", "single", "per_folder", "per_image"]
Series = tuple[str, str, str, str]
Sides = tuple[int, int]

# so many camera models never agree on one image size by themselves: someone cropped to it
MODELS_OF_ONE_SIZE = 5
# sensors agree on a size, as telephones do on 4032 x 3024; images are cropped to smaller ones for a use
FULL_SIZE_PX = 8_000_000
# images without EXIF are of one camera where at most one size comes with so many images
IMAGES_PER_SIZE = 20
# or those of one size where they are so many of a folder's images, beside a few strays
SHARE_OF_ONE_SIZE = 0.75
# a folder of fewer images without EXIF may hold several such sizes, none of them a stray's
IMAGES_PER_SMALL_SIZE = 3
# numbers of frames of a video differ by less on average, those that a web site gives photographs by more
LARGEST_STEP = 1000
NUMBERED = re.compile(r"(.*?)([0-9]+)([^0-9]*)")
# 'auto' begins with it; adjust_bundle takes a wider model where a lens needs one
FIRST_MODEL = "SIMPLE_RADIAL"


@dataclass(frozen=True)
class Photograph:
    """An image's relative name, its size in pixels as stored, and its EXIF."""

    name: str
    width: int
    height: int
    exif: Exif

    @property
    def folder(self) -> str:
        """The folder of the relative name."""
        return str(PurePosixPath(self.name).parent)

    @property
    def sides(self) -> Sides:
        """The shorter and the longer side in pixels."""
        return min(self.width, self.height), max(self.width, self.height)

    @property
    def body(self) -> tuple[str, str] | None:
        """Make and model of the camera, or None where EXIF names no model."""
        return (self.exif.make, self.exif.model) if self.exif.model else None

    @property
    def optics(self) -> tuple[str | float, ...] | None:
        """Make, model, lens and focal lengths in mm, 0 where unknown; None where EXIF names no model."""
        if not self.exif.model:
            return None
        # NaN is not equal to itself
        focal = [round(mm, 3) if mm > 0 else 0.0 for mm in (self.exif.focal_mm, self.exif.focal_35mm)]
        return (self.exif.make, self.exif.model, self.exif.lens, *focal)

    @property
    def series(self) -> Series:
        """Folder, suffix, and what stands before and after the last number of the name."""
        before, _, after = self._parts
        return self.folder, PurePosixPath(self.name).suffix, before, after

    @property
    def number(self) -> int:
        """The last number of the name, -1 where it has none."""
        return int(self._parts[1] or -1)

    @cached_property
    def _parts(self) -> tuple[str, str, str]:
        stem = PurePosixPath(self.name).stem
        found = NUMBERED.fullmatch(stem)
        return (found[1], found[2], found[3]) if found else (stem, "", "")


@dataclass(frozen=True)
class ImageCameras:
    """Cameras in the order of their first image, the row of each image's camera, and EXIF focal lengths.

    ``camera_ids`` is (N,) int32; ``focal_exif_px`` is (N,) float64 in pixels, NaN where EXIF gives none
    or the image was cropped afterwards.
    """

    cameras: list[Camera]
    camera_ids: Array
    focal_exif_px: Array


def assign_cameras(
    photographs: Sequence[Photograph],
    known: Sequence[Camera | None],
    *,
    sharing: Sharing,
    model: str,
    default_focal_ratio: float,
    use_exif: bool,
) -> ImageCameras:
    """Give every image a camera.

    Parameters
    ----------
    photographs : the images.
    known : the image's known intrinsics, or None; equal ones are one camera.
    sharing : which of the other images share a camera; see :func:`group_images`.
    model : COLMAP camera model of the cameras that are not known; ``auto`` begins with SIMPLE_RADIAL.
    default_focal_ratio : focal length as a multiple of the longer side where nothing is known.
    use_exif : whether EXIF focal lengths are used.
    """
    of_one_size = folders_of_one_size(photographs)
    cropped = np.array(
        [
            p.folder in of_one_size or (p.body is not None and is_cropped(p.exif, p.width, p.height))
            for p in photographs
        ],
        dtype=bool,
    )
    stated = np.array(
        [focal_from_exif(p.exif, p.width, p.height) if use_exif else np.nan for p in photographs],
        dtype=np.float64,
    )
    unknown = [row for row, camera in enumerate(known) if camera is None]
    groups: dict[int, Hashable] = dict(
        zip(unknown, group_images([photographs[row] for row in unknown], sharing, of_one_size), strict=True)
    )
    rows_of: dict[Hashable, list[int]] = defaultdict(list)
    for row, camera in enumerate(known):
        rows_of[groups[row] if camera is None else camera].append(row)
    cameras: list[Camera] = []
    camera_ids = np.zeros(len(photographs), np.int32)
    for rows in rows_of.values():
        camera_ids[rows] = len(cameras)
        first = photographs[rows[0]]
        given = known[rows[0]]
        focal, source = _initial_focal(
            stated[rows], cropped[rows], default_focal_ratio * max(first.width, first.height)
        )
        chosen = FIRST_MODEL if model == "auto" else model
        cameras.append(given or _create_camera(chosen, first.width, first.height, focal, source))
    return ImageCameras(cameras, camera_ids, np.where(cropped, np.nan, stated))


def folders_of_one_size(photographs: Sequence[Photograph]) -> set[str]:
    """Folders whose images have all one size though many camera models took them: someone cropped them.

    Models do not count whose photographs are large and state this size in EXIF.
    """
    sizes = defaultdict(set)
    bodies = defaultdict(set)
    for photograph in photographs:
        sizes[photograph.folder].add((photograph.width, photograph.height))
        whole = is_of_stated_size(photograph.exif, photograph.width, photograph.height)
        if photograph.body and not (whole and photograph.width * photograph.height >= FULL_SIZE_PX):
            bodies[photograph.folder].add(photograph.body)
    return {
        folder
        for folder, found in sizes.items()
        if len(found) == 1 and len(bodies[folder]) >= MODELS_OF_ONE_SIZE
    }


def group_images(
    photographs: Sequence[Photograph], sharing: Sharing, of_one_size: Container[str]
) -> list[Hashable]:
    """A key per image; images with equal keys share a camera. Images of different size never do.

    Parameters
    ----------
    photographs : the images.
    sharing : ``single``, ``per_folder`` and ``per_image`` as they say. ``exif``: by camera, lens and focal
        length; images without EXIF each have their own. ``auto``: as ``exif``, but cropped images have
        their own, unless EXIF states their very size, as of sensors of 5:4. Images without EXIF share per
        folder where their sizes agree as one camera's do, a few strays apart, or where those of one size
        are a numbered series.
    of_one_size : folders whose images were cropped to one size (:func:`folders_of_one_size`).
    """
    if sharing == "single":
        return [(p.width, p.height) for p in photographs]
    if sharing == "per_folder":
        return [(p.folder, p.width, p.height) for p in photographs]
    if sharing == "per_image":
        return [p.name for p in photographs]
    if sharing == "exif":
        return [_exif_key(p) if p.body else p.name for p in photographs]
    shared, series = _shared_sizes(photographs), _numbered_series(photographs)
    keys: list[Hashable] = []
    for photograph in photographs:
        if photograph.body:
            shape = (photograph.exif, photograph.width, photograph.height)
            own = photograph.folder in of_one_size or (is_cropped(*shape) and not is_of_stated_size(*shape))
            keys.append(photograph.name if own else _exif_key(photograph))
        elif (photograph.folder, photograph.sides) in shared:
            keys.append((photograph.folder, photograph.width, photograph.height))
        elif (photograph.series, photograph.sides) in series:
            keys.append((photograph.series, photograph.width, photograph.height))
        else:
            keys.append(photograph.name)
    return keys


def _exif_key(photograph: Photograph) -> Hashable:
    return ("exif", photograph.optics, photograph.width, photograph.height)


def _shared_sizes(photographs: Sequence[Photograph]) -> set[tuple[str, Sides]]:
    """Folders and sides of images without EXIF that look like those of one camera.

    Portrait and landscape count as one size. Crowd photographs differ in size, or stand beside photographs
    that name several cameras.
    """
    bodies = defaultdict(set)
    images: Counter[str] = Counter()
    counts: dict[str, Counter[Sides]] = defaultdict(Counter)
    for photograph in photographs:
        images[photograph.folder] += 1
        if photograph.body:
            bodies[photograph.folder].add(photograph.body)
        else:
            counts[photograph.folder][photograph.sides] += 1
    shared = set()
    for folder, sizes in counts.items():
        few = len(bodies[folder]) <= 1 and len(sizes) <= max(1, sizes.total() // IMAGES_PER_SIZE)
        most = SHARE_OF_ONE_SIZE * images[folder]
        shared |= {(folder, sides) for sides, count in sizes.items() if few or count >= most}
    return shared


def _numbered_series(photographs: Sequence[Photograph]) -> set[tuple[Series, Sides]]:
    """Series and sides of images without EXIF that look like those of one camera, whatever lies beside.

    There are many of them, or the folder holds nothing but a few such series; their numbers are close, and
    next to no other image stands between them, as it does in numbered crowd photographs.
    """
    numbers: dict[Series, list[int]] = defaultdict(list)
    found: dict[tuple[Series, Sides], list[int]] = defaultdict(list)
    for photograph in photographs:
        numbers[photograph.series].append(photograph.number)
        if not photograph.body and photograph.number >= 0:
            found[photograph.series, photograph.sides].append(photograph.number)
    for of_series in numbers.values():
        of_series.sort()
    runs = {key for key, own in found.items() if _is_run(own, numbers[key[0]])}
    scattered = _scattered_folders(photographs, runs)
    return {key for key in runs if len(found[key]) >= IMAGES_PER_SIZE or key[0][0] not in scattered}


def _is_run(own: list[int], numbers: list[int]) -> bool:
    """Whether the numbers of some images are close, and few other ones of their sorted series between."""
    low, high = min(own), max(own)
    between = bisect_right(numbers, high) - bisect_left(numbers, low)
    return high - low <= LARGEST_STEP * len(own) and len(own) >= SHARE_OF_ONE_SIZE * between


def _scattered_folders(photographs: Sequence[Photograph], runs: set[tuple[Series, Sides]]) -> set[str]:
    """Folders that hold few images of a size, or images of one size without EXIF that are not one run."""
    sizes: dict[str, Counter[Sides]] = defaultdict(Counter)
    series_of: dict[tuple[str, Sides], set[Series]] = defaultdict(set)
    for photograph in photographs:
        sizes[photograph.folder][photograph.sides] += 1
        if not photograph.body:
            series_of[photograph.folder, photograph.sides].add(photograph.series)
    few = {folder for folder, counts in sizes.items() if min(counts.values()) < IMAGES_PER_SMALL_SIZE}
    return few | {
        folder
        for (folder, sides), found in series_of.items()
        if len(found) > 1 or (next(iter(found)), sides) not in runs
    }


def warn_of_own_cameras(
    photographs: Sequence[Photograph], found: ImageCameras, sharing: Sharing
) -> list[str]:
    """A sentence where images count as cropped to one size, or most have a camera each though few sizes."""
    folders = folders_of_one_size(photographs) if sharing == "auto" else set()
    cropped = sum(
        p.folder in folders and p.body is not None and found.cameras[row].source != "given"
        for p, row in zip(photographs, found.camera_ids.tolist(), strict=True)
    )
    if cropped:
        return [
            f"{cropped} images of one size, from {MODELS_OF_ONE_SIZE} camera models or more, count as "
            "cropped: each has a camera of its own, and focal lengths in EXIF are not used. If nobody "
            "cropped them, set index_images={camera_sharing: exif}."
        ]
    counts = np.bincount(found.camera_ids, minlength=len(found.cameras))
    own = [
        photograph
        for photograph, row in zip(photographs, found.camera_ids.tolist(), strict=True)
        if counts[row] == 1 and found.cameras[row].source != "given"
    ]
    models = {photograph.body for photograph in own if photograph.body}
    sizes = {photograph.sides for photograph in own}
    chosen = sharing in ("single", "per_folder", "per_image")
    most_of_few_sizes = len(own) > max(len(photographs) / 2, 2 * len(sizes))
    if chosen or len(models) >= MODELS_OF_ONE_SIZE or not most_of_few_sizes:
        return []
    return [
        f"{len(own)} images have a camera of their own: if one camera took them all, and none was cropped "
        "individually, set index_images={camera_sharing: single}."
    ]


def _initial_focal(stated: Array, cropped: Array, default: float) -> tuple[float, str]:
    """Focal length in pixels of one camera's images, and where it is from."""
    trusted = stated[~cropped & (stated > 0)]
    if len(trusted):
        return float(np.median(trusted)), "exif"
    # cropping never widens the view, so what EXIF states is a lower bound
    bounds = stated[cropped & (stated > 0)]
    return max(default, float(np.median(bounds)) if len(bounds) else 0.0), "default"


def _create_camera(model: str, width: int, height: int, focal: float, source: str) -> Camera:
    camera = pycolmap.Camera.create_from_model_name(1, model, focal, width, height)
    return Camera.of_pycolmap(camera, source)
