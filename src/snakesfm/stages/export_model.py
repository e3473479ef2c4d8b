"""export_model: the adjusted model as COLMAP model, PLY and transforms.json."""

import json
import shutil
import sys
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from snakesfm.artifacts import CalibratedCameras, ImageIndex, Reconstruction, temporary_folder
from snakesfm.artifacts.gather import gather_image_columns
from snakesfm.bundle.focal_pairs import STRETCHED_MODELS
from snakesfm.export.colmap import build_reconstruction, other_model_sizes, summarize
from snakesfm.export.image_folder import place_images
from snakesfm.export.nerfstudio import camera_warnings, transforms
from snakesfm.export.placement import (
    Placement,
    describe_frames,
    find_placement,
    placement_summary,
    placement_warnings,
)
from snakesfm.export.undistorted import undistorted_share, write_undistorted
from snakesfm.geometry.camera import Camera, cameras_from_columns
from snakesfm.geometry.colmap_checks import check_binary, check_ply, check_text
from snakesfm.geometry.lens_fit import MAX_MISFIT, fit_lenses
from snakesfm.geometry.poses import has_pose, to_camera
from snakesfm.ingest.masks import masks_as_large
from snakesfm.model_files import SUMMARY
from snakesfm.stages.job import StageJob

if TYPE_CHECKING:
    import pycolmap

    from snakesfm.config.export_model import ExportModelOptions

UNDISTORTED = "undistorted"
SPACES = (
    "Some image names contain spaces, where COLMAP cuts them when it reads images.txt: use the .bin files."
)

OTHER_MODELS = (
    "{images} images could not be connected to the largest model: they form {count} separate models in "
    "folders next to sparse/0{frames}."
)

MISSING_MASKS = (
    "{count} images have no mask of their own size, e.g. '{first}', and nerfstudio needs one for every "
    "image, so transforms.json names none."
)

MIXED_LENSES = (
    "transforms.json contains fisheye and perspective cameras, which nerfstudio treats as one kind: use "
    "export_model={undistort: true}, or a scene for each kind."
)

REFUSED = "{count} image files could not be used (all in the report): {first}"

OTHER_LENS = (
    "camera {camera} ({model}): reprojection errors grow with distance from the principal point, so this "
    "model does not describe the lens; try another index_images.camera_model (RADIAL, OPENCV) or other "
    "intrinsics."
)

OTHER_GIVEN_LENS = (
    "camera {camera} ({model}): reprojection errors grow with distance from the principal point, so the "
    "given intrinsics do not describe the lens; intrinsics=refine starts from them and refines them."
)

RESET_CAMERA = (
    "camera {camera} ({model}): its {cause} was implausible in the last pass of bundle adjustment, so it "
    "was reset and kept fixed; try an index_images.camera_model with fewer parameters, or other intrinsics."
)

FAR_PRINCIPAL_POINT = (
    "camera {camera} ({model}): its principal point seems to lie {offset:.1%} of the longer side away from "
    "where it is assumed, but reprojection errors hardly fall there, so it was left; if the images were "
    "cropped, give cameras=, or raise adjust_bundle.max_principal_point_offset."
)

MIXED_FOCALS = (
    "camera {camera} ({model}): its images seem to differ in focal length by {spread:.0%}, as by zoom or "
    "of several cameras whose EXIF is lost: put those of each into a folder and set "
    "index_images={{camera_sharing: per_folder}}, or per_image if you cannot tell them apart."
)

STRETCHED = (
    "camera {camera} ({model}): its pixels are not square (fx / fy = {ratio:.2f}), as of frames of "
    "anamorphic video or images stretched to a size; images in their true proportions give better models."
)

CUT_PICTURE = (
    "camera {camera} ({model}): undistorted/ shows only {share:.0%} of its images, because no flat image "
    "holds a view of about 180 degrees: use images/ and sparse/0 with software for fisheye lenses."
)

# of each kind: every image of a collection may have a camera of its own
MOST_CAMERAS = 5
MORE_CAMERAS = "{count} more cameras have the problem of the warning before this one."

# of a picture, what is left of it without distortion: normal lenses keep 0.8 and more
LEAST_UNDISTORTED = 0.5
# more of them add nothing about a lens
OBSERVATIONS_OF_LENSES = 500_000

COPIES = "{count} images are exact copies of others and are left out; the originals are used."


def run(job: StageJob) -> None:
    """Write the files that ``job.outputs`` names, complete or not at all, summary.json last."""
    index = ImageIndex.read(job.path("index"))
    adjusted = Reconstruction.read(job.path("reconstruction"))
    names = [str(name) for name in index.names]
    placements = _placements(job, index, adjusted, names)
    model = _moved(adjusted.select_model(0), placements[0])
    cameras = cameras_from_columns(model.camera_models, model.camera_sizes, model.camera_params)
    registered = np.flatnonzero(has_pose(model.rotations, model.translations))
    warnings = _warnings(job, index, adjusted, model, placements, cameras, registered)
    given_masks = Path(job.settings["masks"]) if "masks" in job.settings else None
    of_image = {names[row]: cameras[index.camera_ids[row]] for row in registered}
    masks = _masks(given_masks, of_image, warnings)
    for line in warnings:
        sys.stderr.write(f"warning: {line}\n")
    folder = _export_folder(job)
    keypoints = _all_keypoints(job, adjusted.models)
    with temporary_folder(folder) as temporary:
        for number, placement in enumerate(placements):
            selected = _moved(adjusted.select_model(number), placement) if number else model
            _write_colmap(temporary, number, _build(names, index, cameras, selected, keypoints))
        content = transforms(
            names, index.camera_ids, cameras, model.rotations, model.translations, registered, masks
        )
        _write_json(temporary / "transforms.json", content)
        summary = summarize(job.scene, names, adjusted.models, model.offsets, model.errors_px, warnings)
        _write_json(temporary / SUMMARY, {**summary, **placement_summary(placements, names)})
        _place_pictures(job, folder, names, index.orientations, masks)
        if job.options.undistort:
            write_undistorted(
                temporary / UNDISTORTED,
                temporary / "sparse" / "0",
                folder / "images",
                given_masks,
                job.threads,
            )
        _publish(temporary, folder)


def _warnings(
    job: StageJob,
    index: ImageIndex,
    adjusted: Reconstruction,
    model: Reconstruction,
    placements: list[Placement],
    cameras: list[Camera],
    registered: np.ndarray,
) -> list[str]:
    """What a user should know of the model with the ``registered`` images (rows), a sentence each."""
    names = [str(name) for name in index.names]
    used = {row: cameras[row] for row in sorted({int(index.camera_ids[row]) for row in registered})}
    warnings = _camera_warnings(adjusted, used)
    fixed = job.settings["intrinsics"] == "fixed"
    held = {row for row in used if fixed and index.camera_sources[row] == "given"}
    warnings += _lens_warnings(model, cameras, index.camera_ids, held)
    if job.options.undistort:
        warnings += _cut_warnings(used)
    if len({camera.is_fisheye for camera in used.values()}) > 1:
        warnings.append(MIXED_LENSES)
    if any(" " in names[row] for row in registered):
        warnings.append(SPACES)
    others = other_model_sizes(adjusted.models)
    if others:
        warnings.append(
            OTHER_MODELS.format(images=sum(others), count=len(others), frames=describe_frames(placements))
        )
    if len(index.refused_names):
        warnings.append(REFUSED.format(count=len(index.refused_names), first=index.refused_reasons[0]))
    warnings += [str(line) for line in index.warnings]
    calibrated = CalibratedCameras.read(job.path("cameras"))
    warnings += _stretched_warnings(used, [str(model) for model in calibrated.models])
    warnings += [str(line) for line in calibrated.warnings]
    warnings += placement_warnings(placements, names, job.options.georeference is True)
    # a list of pairs may name copies, which then are images as any other
    copies = int(np.count_nonzero((index.duplicate_of >= 0) & (adjusted.models < 0)))
    return warnings + ([COPIES.format(count=copies)] if copies else [])


def _camera_warnings(adjusted: Reconstruction, cameras: dict[int, Camera]) -> list[str]:
    """What other tools cannot do with cameras, given by rows, and what bundle adjustment could not."""
    by_kind: dict[str, list[str]] = {}
    for row, camera in cameras.items():
        for kind, line in camera_warnings(camera, row + 1).items():
            by_kind.setdefault(kind, []).append(line)
    by_kind["reset"] = [
        RESET_CAMERA.format(camera=row + 1, model=camera.model, cause=adjusted.camera_resets[row])
        for row, camera in cameras.items()
        if adjusted.camera_resets[row]
    ]
    by_kind["far"] = [
        FAR_PRINCIPAL_POINT.format(camera=row + 1, model=camera.model, offset=adjusted.camera_offsets[row])
        for row, camera in cameras.items()
        if np.isfinite(adjusted.camera_offsets[row])
    ]
    by_kind["mixed"] = [
        MIXED_FOCALS.format(camera=row + 1, model=camera.model, spread=adjusted.camera_spreads[row])
        for row, camera in cameras.items()
        if np.isfinite(adjusted.camera_spreads[row])
    ]
    return [line for lines in by_kind.values() for line in _some_cameras(lines)]


def _some_cameras(lines: list[str]) -> list[str]:
    """Of warnings of one kind, a sentence per camera, the first, and of how many more they are true."""
    more = len(lines) - MOST_CAMERAS
    return lines if more < 2 else [*lines[:MOST_CAMERAS], MORE_CAMERAS.format(count=more)]


def _lens_warnings(
    model: Reconstruction, cameras: list[Camera], camera_ids: np.ndarray, held: Collection[int]
) -> list[str]:
    """A sentence per camera whose lens is not of its model; the parameters of those ``held`` were given."""
    some = slice(None, None, -(-len(model.image_ids) // OBSERVATIONS_OF_LENSES) or 1)
    images = model.image_ids[some]
    points = model.points[np.repeat(np.arange(len(model.points)), np.diff(model.offsets))[some]]
    in_camera = to_camera(model.rotations[images], model.translations[images], points)
    fits = fit_lenses(
        dict(enumerate(cameras)), camera_ids[images], images, in_camera, model.keypoints[some]
    )
    return _some_cameras(
        [
            (OTHER_GIVEN_LENS if row in held else OTHER_LENS).format(
                camera=row + 1, model=cameras[row].model
            )
            for row, fit in fits.items()
            if fit.misfit > MAX_MISFIT
        ]
    )


def _stretched_warnings(cameras: dict[int, Camera], former: list[str]) -> list[str]:
    """A sentence per camera, given by its row, that bundle adjustment gave a second focal length."""
    return _some_cameras(
        [
            STRETCHED.format(camera=row + 1, model=camera.model, ratio=camera.params[0] / camera.params[1])
            for row, camera in cameras.items()
            if camera.model == STRETCHED_MODELS.get(former[row])
        ]
    )


def _cut_warnings(cameras: dict[int, Camera]) -> list[str]:
    """A sentence per camera, given by its row, of whose pictures little is left without distortion."""
    shares = {row: undistorted_share(camera) for row, camera in cameras.items()}
    return _some_cameras(
        [
            CUT_PICTURE.format(camera=row + 1, model=cameras[row].model, share=share)
            for row, share in shares.items()
            if share < LEAST_UNDISTORTED
        ]
    )


def _masks(folder: Path | None, cameras: dict[str, Camera], warnings: list[str]) -> dict[str, str]:
    """The masks of all images, given with their cameras; none and a warning where some are missing."""
    if folder is None:
        return {}
    sizes = {name: (camera.width, camera.height) for name, camera in cameras.items()}
    masks = masks_as_large(folder, sizes)
    missing = sorted(sizes.keys() - masks.keys())
    if missing:
        warnings.append(MISSING_MASKS.format(count=len(missing), first=missing[0]))
        return {}
    return masks


def _placements(
    job: StageJob, index: ImageIndex, adjusted: Reconstruction, names: list[str]
) -> list[Placement]:
    """Of each model."""
    return [
        find_placement(
            np.where((adjusted.models == number)[:, None, None], adjusted.rotations, np.nan),
            np.where((adjusted.models == number)[:, None], adjusted.translations, np.nan),
            index.orientations,
            index.gps,
            names,
            job.options.georeference,
            job.seed_for("georeference"),
        )
        for number in range(max(1, adjusted.model_count))
    ]


def _moved(model: Reconstruction, placement: Placement) -> Reconstruction:
    rotations, translations, points = placement.move(model.rotations, model.translations, model.points)
    return replace(model, rotations=rotations, translations=translations, points=points)


def _all_keypoints(job: StageJob, models: np.ndarray) -> list[np.ndarray] | None:
    """Keypoints (K_i,2) in original pixels per image of a model where all are wanted there, else None."""
    if not job.options.all_keypoints:
        return None
    registered = set(np.flatnonzero(models >= 0).tolist())
    return gather_image_columns(job.paths("features"), len(models), "keypoints", images=registered)[0]


def _build(
    names: list[str],
    index: ImageIndex,
    cameras: list[Camera],
    model: Reconstruction,
    keypoints: list[np.ndarray] | None,
) -> "pycolmap.Reconstruction":
    return build_reconstruction(
        names,
        index.camera_ids,
        cameras,
        model.rotations,
        model.translations,
        model.points,
        model.colors,
        model.errors_px,
        model.offsets,
        model.image_ids,
        model.keypoints,
        None if keypoints is None else (model.keypoint_ids, keypoints),
    )


def _write_colmap(folder: Path, number: int, model: "pycolmap.Reconstruction") -> None:
    """One model, binary and as text; the points of the first as PLY too.

    Raises
    ------
    OSError : the disk is full.
    """
    sparse = folder / "sparse" / str(number)
    sparse.mkdir(parents=True)
    model.write_binary(str(sparse))
    model.write_text(str(sparse))
    check_binary(sparse, model)
    check_text(sparse, model)
    if number == 0:
        ply = folder / "points.ply"
        model.export_PLY(str(ply))
        check_ply(ply, model.num_points3D())


def _place_pictures(
    job: StageJob, folder: Path, names: list[str], orientations: np.ndarray, masks: dict[str, str]
) -> None:
    """Put the images, and the masks if there are any, beside the model where that is wanted."""
    options: ExportModelOptions = job.options
    if options.link_images or options.undistort:
        place_images(folder / "images", Path(job.settings["images"]), names, orientations)
    if options.link_images and masks:
        upright = np.ones(len(masks), np.int32)
        place_images(folder / "masks", Path(job.settings["masks"]), list(masks.values()), upright)
    elif (folder / "masks").is_symlink():
        (folder / "masks").unlink()


def _export_folder(job: StageJob) -> Path:
    """The folder that holds summary.json, whichever place it has among the outputs."""
    return next((path.parent for path in job.outputs if path.name == SUMMARY), job.output.parent)


def _write_json(path: Path, content: object) -> None:
    path.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", "utf-8")


def _publish(temporary: Path, folder: Path) -> None:
    """Replace the former export by every finished file; the summary, which says that all is there, last."""
    shutil.rmtree(folder / UNDISTORTED, ignore_errors=True)
    for former in (folder / "sparse").glob("[1-9]*"):
        shutil.rmtree(former)
    files = sorted(path.relative_to(temporary) for path in temporary.rglob("*") if path.is_file())
    for file in sorted(files, key=lambda file: file.name == SUMMARY):
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (temporary / file).replace(folder / file)
