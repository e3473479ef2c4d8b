"""``python -m snakesfm.synthetic.render_demo OUTPUT_FOLDER`` makes the demo scene and its exact truth.

OUTPUT_FOLDER gets images/*.jpg with EXIF as a camera would write it, reference/ as COLMAP text (cameras,
poses, points on the surfaces with the images that see them) and demo.json: what it was made from.
"""

import argparse
import dataclasses
import json
import shutil
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from snakesfm.arrays import Array
from snakesfm.errors import ConfigError, SnakesfmError
from snakesfm.export.colmap import build_reconstruction
from snakesfm.geometry.camera import Camera
from snakesfm.geometry.colmap_checks import check_text
from snakesfm.seeding import derive_seed
from snakesfm.synthetic.raster import Face, View, render
from snakesfm.synthetic.scene import DemoOptions, build_scene, camera_path, sample_points, sky

VERSION = 1
MARKER = "demo.json"
SAMPLES = 2
NOISE = 1.6
JPEG_QUALITY = 93
POINTS = 4000
MIN_TRACK = 3
DEPTH_TOLERANCE = 0.004


def make_demo(folder: Path, options: DemoOptions) -> bool:
    """Render the demo scene into ``folder``, complete or not at all.

    Returns
    -------
    False where the folder already holds just this scene.

    Raises
    ------
    ConfigError : the folder holds something that is no demo scene.
    """
    content = {"version": VERSION, **dataclasses.asdict(options)}
    marker = folder / MARKER
    if marker.is_file() and json.loads(marker.read_text("utf-8")) == content:
        return False
    if folder.exists() and not marker.is_file() and (not folder.is_dir() or any(folder.iterdir())):
        raise ConfigError(f"{folder} contains something other than the demo scene: choose a new folder.")
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as name:
        temporary = Path(name) / "demo"
        faces = build_scene(options.seed)
        views = {f"square_{number:02d}.jpg": view for number, view in enumerate(camera_path(options))}
        points = sample_points(faces, POINTS, options.seed)
        write_scene(temporary, faces, views, points, options.seed, options.focal_35mm)
        (temporary / MARKER).write_text(json.dumps(content, indent=1) + "\n", "utf-8")
        if folder.exists():
            shutil.rmtree(folder)
        temporary.rename(folder)
    return True


def visible_points(points: Array, view: View, inverse_depth: Array, samples: int) -> tuple[Array, Array]:
    """Which points (n,) the view sees, and where (n,2) in pixels."""
    pixels, depths = view.project(points)
    height, width = inverse_depth.shape
    inside = (depths > 0) & np.all((pixels >= 0) & (pixels * samples < (width, height)), axis=1)
    places = np.where(inside[:, None], pixels * samples, 0).astype(int)
    seen = inverse_depth[places[:, 1], places[:, 0]]
    with np.errstate(divide="ignore"):
        inside &= np.abs(1.0 / depths - seen) <= DEPTH_TOLERANCE * seen
    return inside, pixels


def write_scene(
    folder: Path,
    faces: Sequence[Face],
    views: Mapping[str, View],
    points: Array,
    seed: int,
    focal_35mm: float,
    samples: int = SAMPLES,
    blur_px: float = 0.0,
    lens: Camera | None = None,
) -> None:
    """Write images/ and reference/ of a scene.

    Parameters
    ----------
    views : of all images by file name, of one camera.
    points : (n,3) world points on the faces, those of the reference.
    seed : of the images' noise.
    focal_35mm : focal length that EXIF tells.
    samples : samples per pixel along each axis.
    blur_px : standard deviation of the lens's blur; 0 for none.
    lens : what the photographs are taken with in place of the views' pinhole, which must show as much.
    """
    (folder / "images").mkdir(parents=True)
    (folder / "reference").mkdir()
    seen, pixels, colors = [], [], []
    for name, view in views.items():
        image, inverse_depth = render(faces, view, sky(view, samples), samples)
        visible, places = visible_points(points, view, inverse_depth, samples)
        if lens is not None:
            image = bend(image, view.camera, lens)
            places = np.asarray(
                lens.to_pycolmap().img_from_cam(points @ view.rotation.T + view.translation)
            )
            visible &= np.all((places >= 0) & (places < (lens.width, lens.height)), axis=1)
        if blur_px > 0:
            image = cv2.GaussianBlur(image, (0, 0), blur_px)
        inside = np.where(visible[:, None], places, 0).astype(int)
        colors.append(np.where(visible[:, None], image[inside[:, 1], inside[:, 0]], np.nan))
        rng = np.random.default_rng(derive_seed(seed, "demo", "noise", name))
        noisy = image + rng.normal(0.0, NOISE, image.shape).astype(np.float32)
        _write_photo(folder / "images" / name, np.clip(np.rint(noisy), 0, 255).astype(np.uint8), focal_35mm)
        seen.append(visible)
        pixels.append(places)
    camera = lens or next(iter(views.values())).camera
    _write_reference(folder / "reference", camera, views, points, (seen, pixels, colors))


def bend(image: Array, pinhole: Camera, lens: Camera) -> Array:
    """The image (H,W,3) float32 of a pinhole camera as another lens shows it; black where it shows more."""
    columns, rows = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    rays = lens.normalize(np.column_stack([columns.ravel(), rows.ravel()]))
    seen = np.asarray(pinhole.to_pycolmap().img_from_cam(np.column_stack([rays, np.ones(len(rays))])))
    # OpenCV counts from the middle of the first pixel
    x, y = (seen - 0.5).astype(np.float32).T.reshape(2, lens.height, lens.width)
    bent: Array = cv2.remap(image, x, y, cv2.INTER_LINEAR)
    return bent


def _write_photo(path: Path, image: Array, focal_35mm: float) -> None:
    from PIL import ExifTags, Image

    exif = Image.Exif()
    exif[ExifTags.Base.Make] = "snakesfm"
    exif[ExifTags.Base.Model] = "virtual full frame"
    details = exif.get_ifd(ExifTags.IFD.Exif)
    details[ExifTags.Base.FocalLength] = focal_35mm
    details[ExifTags.Base.FocalLengthIn35mmFilm] = round(focal_35mm)
    Image.fromarray(image).save(path, quality=JPEG_QUALITY, subsampling=0, exif=exif)


def _write_reference(
    folder: Path,
    camera: Camera,
    views: Mapping[str, View],
    points: Array,
    observed: tuple[Sequence[Array], Sequence[Array], Sequence[Array]],
) -> None:
    seen, pixels, colors = (np.stack(columns, axis=1) for columns in observed)
    kept = np.flatnonzero(seen.sum(axis=1) >= MIN_TRACK)
    point_ids, image_ids = np.nonzero(seen[kept])
    model = build_reconstruction(
        list(views),
        np.zeros(len(views), dtype=np.int32),
        [camera],
        np.array([view.rotation for view in views.values()]),
        np.array([view.translation for view in views.values()]),
        points[kept],
        np.clip(np.rint(np.nanmean(colors[kept], axis=1)), 0, 255).astype(np.uint8),
        np.zeros(len(kept)),
        np.searchsorted(point_ids, np.arange(len(kept) + 1)),
        image_ids,
        pixels[kept][point_ids, image_ids],
    )
    model.write_text(str(folder))
    check_text(folder, model)


def main(arguments: list[str] | None = None) -> int:
    """Command line: 0 where the scene is there, 1 with one sentence where it cannot be made."""
    parser = argparse.ArgumentParser(
        prog="python -m snakesfm.synthetic.render_demo", description="Render the demo scene."
    )
    parser.add_argument("folder", type=Path, help="where to write images/ and reference/")
    parser.add_argument(
        "--images", type=int, default=DemoOptions.image_count, help="images around the ring"
    )
    parser.add_argument("--seed", type=int, default=DemoOptions.seed, help="another seed, another square")
    given = parser.parse_args(arguments)
    cv2.setNumThreads(1)
    options = DemoOptions(image_count=given.images, seed=given.seed)
    try:
        made = make_demo(given.folder, options)
    except SnakesfmError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    state = "rendered" if made else "already rendered"
    sys.stdout.write(f"demo scene: {options.image_count} images {state} in {given.folder / 'images'}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
