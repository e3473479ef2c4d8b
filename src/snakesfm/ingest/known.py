"""Known intrinsics: COLMAP's cameras files and 3x3 matrices, and which image they belong to."""

import struct
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from snakesfm.errors import ConfigError
from snakesfm.geometry.camera import Camera
from snakesfm.geometry.colmap_binding import pycolmap
from snakesfm.given_files import NO_CAMERAS, NO_CAMERAS_FILE, find_cameras_file
from snakesfm.image_names import match_names
from snakesfm.ingest.cameras import Photograph

# images.bin: quaternion and translation between image id and camera id
POSE_BYTES = 56
POINT_BYTES = 24
# cropping a third away on one side moves the principal point a quarter of what remains from the centre
MAX_OFF_CENTRE = 0.5
# off alike in both directions: scaling does that, and hardly ever a lens or a crop
MAX_SCALING = 0.2
SAME_ASPECT = 0.03
LIMIT = "; with an images.txt next to a cameras.txt, a camera applies only to the images listed there"


@dataclass(frozen=True)
class KnownCameras:
    """Intrinsics that the user gave.

    Parameters
    ----------
    path : the file, for messages.
    cameras : by COLMAP camera id; the one of a 3x3 matrix has width and height 0.
    camera_of : camera id by image name; empty where no list of images lies beside the file.
    """

    path: Path
    cameras: dict[int, Camera]
    camera_of: dict[str, int]

    @property
    def listing(self) -> Path:
        """The list of images beside the file, whether it is there or not."""
        return self.path.with_name("images" + self.path.suffix)


def read_known_cameras(path: Path | str) -> KnownCameras:
    """Read intrinsics from cameras.txt, cameras.bin, a folder that holds one of them, or a 3x3 K.txt.

    Of images.txt or images.bin beside a COLMAP file only names and camera ids are used, never poses. A
    matrix is taken to be in this project's pixels, where the image's first corner is (0, 0).

    Raises
    ------
    ConfigError : the file is missing, or is not what its name says.
    """
    path = _find_file(Path(path))
    try:
        if path.suffix == ".bin":
            cameras = dict(_binary_cameras(path.read_bytes()))
        else:
            lines = _content_lines(path)
            rows = [line.split() for line in lines]
            if len(rows) == 3 and all(len(row) == 3 for row in rows):
                return KnownCameras(path, {1: _matrix_camera(path, rows)}, {})
            cameras = dict(_text_cameras(lines))
    except (ValueError, UnicodeDecodeError, struct.error, IndexError) as error:
        raise ConfigError(f"{path}, given as cameras=, {NO_CAMERAS} ({error}): correct it.") from None
    if not cameras:
        raise ConfigError(f"{path}, given as cameras=, contains no camera: correct it or remove the key.")
    for camera_id, camera in cameras.items():
        _check(path, camera_id, camera)
    camera_of = _image_cameras(path)
    missing = sorted(set(camera_of.values()) - set(cameras))
    if missing:
        raise ConfigError(
            f"The list of images next to {path} names camera {missing[0]}, which that file lacks: add it."
        )
    return KnownCameras(path, cameras, camera_of)


def match_known_cameras(
    known: KnownCameras, photographs: Sequence[Photograph]
) -> tuple[list[Camera | None], list[str]]:
    """The known camera of each image, scaled to the image's size, None where there is none; and warnings.

    Without a list, one camera is that of all images, and of several the one of the image's size. An image
    that the list names, by its path or else by a file name of its own, has the camera named there. An image
    that the list lacks has the one camera of its size, if any, where EXIF names the same body, lens and
    focal length as of that camera's images, or names none of either.

    Raises
    ------
    ConfigError : an image's camera is of another shape than the image, or cannot be told.
    """
    if known.camera_of:
        return _match_list(known, photographs)
    if any(camera.width == 0 for camera in known.cameras.values()):
        found = list(_match_matrix(known, photographs))
    else:
        found = [_match_size(known, photograph) for photograph in photographs]
    # one camera is scaled to images of several sizes
    models_of: dict[Camera | None, set[str]] = defaultdict(set)
    for photograph, camera in zip(photographs, found, strict=True):
        if photograph.body:
            models_of[camera if len(known.cameras) > 1 else None].add(photograph.body[1])
    return list(found), [
        f"{known.path} gives one camera to images of {len(models)} camera models in EXIF "
        f"({', '.join(sorted(models)[:3])}): list its images in an images.txt next to a cameras.txt."
        for models in models_of.values()
        if len(models) > 1
    ]


def _match_list(
    known: KnownCameras, photographs: Sequence[Photograph]
) -> tuple[list[Camera | None], list[str]]:
    """As :func:`match_known_cameras`, by a list of images."""
    listed = _listed_cameras(known, [photograph.name for photograph in photographs])
    optics_of = defaultdict(set)
    for photograph, camera_id in zip(photographs, listed, strict=True):
        optics_of[camera_id].add(photograph.optics)
    found: list[Camera | None] = []
    by_size: Counter[int] = Counter()
    for photograph, camera_id in zip(photographs, listed, strict=True):
        if camera_id is not None:
            found.append(_fit(known.path, known.cameras[camera_id], photograph))
            continue
        same = _cameras_of_size(known, photograph)
        if len(same) == 1 and photograph.optics in optics_of.get(same[0], {None}):
            found.append(known.cameras[same[0]])
            by_size[same[0]] += photograph.optics is None
        else:
            found.append(None)
    return found, [
        f"{count} images not listed in {known.listing} were assigned camera {camera_id} by their size: "
        "list them there with their camera."
        for camera_id, count in by_size.items()
        if count
    ]


def _listed_cameras(known: KnownCameras, names: Sequence[str]) -> list[int | None]:
    """The camera that the list names for each image, None where it lacks the image."""
    found = [known.camera_of.get(name) for name in names]
    if not names or any(camera_id is not None for camera_id in found):
        return found
    others = list(known.camera_of)
    rows = match_names(others, names)
    if (rows < 0).all():
        raise ConfigError(
            f"{known.listing} names none of the images (it has '{others[0]}', the folder '{names[0]}'): "
            "correct the names or move the file away."
        )
    return [known.camera_of[others[row]] if row >= 0 else None for row in rows.tolist()]


def _cameras_of_size(known: KnownCameras, photograph: Photograph) -> list[int]:
    size = (photograph.width, photograph.height)
    return [key for key, camera in known.cameras.items() if (camera.width, camera.height) == size]


def _match_size(known: KnownCameras, photograph: Photograph) -> Camera:
    """The only camera there is, or the one of the image's size."""
    if len(known.cameras) == 1:
        return _fit(known.path, next(iter(known.cameras.values())), photograph, LIMIT)
    same = _cameras_of_size(known, photograph)
    if len(same) != 1:
        raise ConfigError(
            f"{known.path} has {len(known.cameras)} cameras, of which {len(same)} have the size "
            f"{photograph.width} x {photograph.height} of {photograph.name}: put the images.txt next to it "
            "that assigns images to cameras."
        )
    return known.cameras[same[0]]


def _find_file(path: Path) -> Path:
    path = path.expanduser()
    file = find_cameras_file(path)
    if file is None and path.is_dir():
        raise ConfigError(f"{path}, given as cameras=, {NO_CAMERAS_FILE}")
    if file is None:
        raise ConfigError(f"{path}, given as cameras=, does not exist: correct the path or remove the key.")
    return file


def _content_lines(path: Path) -> list[str]:
    lines = path.read_text("utf-8-sig").splitlines()
    return [line.strip() for line in lines if line.strip() and not line.lstrip().startswith("#")]


def _matrix_camera(path: Path, rows: list[list[str]]) -> Camera:
    K = np.array(rows, dtype=np.float64)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    plain = K[2].tolist() == [0, 0, 1] and K[1, 0] == 0 and abs(K[0, 1]) < 1e-3 * abs(fx)
    if not (plain and np.isfinite(K).all() and min(fx, fy, cx, cy) > 0):
        raise ConfigError(
            f"{path}, given as cameras=, is not a matrix [fx 0 cx; 0 fy cy; 0 0 1] in pixels: correct it."
        )
    return Camera("PINHOLE", 0, 0, (float(fx), float(fy), float(cx), float(cy)))


def _text_cameras(lines: list[str]) -> Iterator[tuple[int, Camera]]:
    for line in lines:
        words = line.split()
        if len(words) < 5:
            raise ValueError(f"'{line[:60]}' has fewer than 5 words")
        params = tuple(float(word) for word in words[4:])
        yield int(words[0]), Camera(words[1], int(words[2]), int(words[3]), params)


def _binary_cameras(data: bytes) -> Iterator[tuple[int, Camera]]:
    (count,) = struct.unpack_from("<Q", data)
    place = 8
    for _ in range(count):
        camera_id, model_id, width, height = struct.unpack_from("<IiQQ", data, place)
        place += 24
        # the constructor, unlike create_from_model_id, raises ValueError on a number that is no model
        model = pycolmap.CameraModelId(model_id)
        slots = len(pycolmap.Camera.create_from_model_id(1, model, 1.0, 1, 1).params)
        params = struct.unpack_from(f"<{slots}d", data, place)
        place += 8 * slots
        yield camera_id, Camera(model.name, width, height, params)


def _check(path: Path, camera_id: int, camera: Camera) -> None:
    where = f"Camera {camera_id} of {path}, given as cameras=,"
    if camera.model not in pycolmap.CameraModelId.__members__ or camera.model == "INVALID":
        raise ConfigError(f"{where} has the unknown camera model '{camera.model}': use one of COLMAP's.")
    try:
        parsed = camera.to_pycolmap()
        focal = parsed.mean_focal_length()
        valid = parsed.verify_params() and np.isfinite(parsed.params).all() and focal > 0
    except (ValueError, RuntimeError):
        valid = False
    if not (valid and camera.width > 0 and camera.height > 0):
        raise ConfigError(f"{where} has an invalid size or parameters for a {camera.model}: correct them.")


def _image_cameras(path: Path) -> dict[str, int]:
    """Camera id by image name from the list of images beside a COLMAP cameras file."""
    listing = KnownCameras(path, {}, {}).listing
    if not listing.is_file():
        return {}
    try:
        if listing.suffix == ".bin":
            return dict(_binary_image_cameras(listing.read_bytes()))
        return dict(_text_image_cameras(listing.read_text("utf-8-sig")))
    except (ValueError, UnicodeDecodeError, struct.error, IndexError) as error:
        raise ConfigError(
            f"{listing}, next to the file given as cameras=, is not a COLMAP list of images ({error}): "
            "correct it or move it away."
        ) from None


def _text_image_cameras(text: str) -> Iterator[tuple[str, int]]:
    lines = (line.strip() for line in text.splitlines() if not line.startswith("#"))
    for line in lines:
        if not line:
            continue
        # every image has two lines, and the second, its points, may be empty
        points = next(lines, "")
        # a list without lines of points would lose every second image
        if len(points.split()) % 3 or (points and not points.split()[-1].lstrip("-").isdigit()):
            raise ValueError(f"expected the points of the image before, found '{points[:60]}'")
        words = line.split(maxsplit=9)
        if len(words) < 10:
            raise ValueError(f"'{line[:60]}' has fewer than 10 words")
        yield words[9], int(words[8])


def _binary_image_cameras(data: bytes) -> Iterator[tuple[str, int]]:
    (count,) = struct.unpack_from("<Q", data)
    place = 8
    for _ in range(count):
        place += 4 + POSE_BYTES
        (camera_id,) = struct.unpack_from("<I", data, place)
        end = data.index(b"\0", place + 4)
        name = data[place + 4 : end].decode()
        (points,) = struct.unpack_from("<Q", data, end + 1)
        place = end + 9 + points * POINT_BYTES
        yield name, camera_id


def _match_matrix(known: KnownCameras, photographs: Sequence[Photograph]) -> Iterator[Camera]:
    if not photographs:
        return
    (camera,) = known.cameras.values()
    _, _, cx, cy = camera.params
    sizes = {(photograph.width, photograph.height) for photograph in photographs}
    # the matrix belongs to the size whose centre is nearest to its principal point
    width, height = min(sorted(sizes), key=lambda size: abs(2 * cx - size[0]) + abs(2 * cy - size[1]))
    across, down = 2 * cx / width, 2 * cy / height
    scaled = abs(across / down - 1) <= SAME_ASPECT and abs(across - 1) > MAX_SCALING
    if scaled or max(abs(across - 1), abs(down - 1)) > MAX_OFF_CENTRE:
        raise ConfigError(
            f"The principal point ({cx:g}, {cy:g}) of {known.path} belongs to images of about "
            f"{2 * cx:.0f} x {2 * cy:.0f} pixels, but the images have {width} x {height}: give the matrix "
            "for the size of the images or, if they were cropped, a cameras.txt that states their size."
        )
    sized = replace(camera, width=width, height=height)
    for photograph in photographs:
        yield _fit(known.path, sized, photograph, LIMIT)


def _fit(path: Path, camera: Camera, photograph: Photograph, hint: str = "") -> Camera:
    """The camera for an image of the same shape."""
    width, height = photograph.width, photograph.height
    if (camera.width, camera.height) == (width, height):
        return camera
    across, down = width / camera.width, height / camera.height
    # a scaled image's sides are rounded to pixels
    if abs(across * camera.height - height) > 1 and abs(down * camera.width - width) > 1:
        if (camera.height, camera.width) == (width, height):
            hint = "; images are used as stored, without their EXIF rotation" + hint
        raise ConfigError(
            f"{photograph.name} has {width} x {height} pixels, another aspect ratio than its camera in "
            f"{path}, {camera.width} x {camera.height}: correct that file or the image{hint}."
        )
    scaled = camera.to_pycolmap()
    scaled.rescale(width, height)
    return replace(camera, width=width, height=height, params=tuple(scaled.params.tolist()))
