"""export_model: the adjusted model as COLMAP model, PLY and transforms.json."""

import json
import shutil
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from snakesfm.artifacts import CalibratedCameras, ImageIndex, Reconstruction, temporary_folder
from snakesfm.artifacts.gather import gather_image_columns
from snakesfm.export.cameras import adjusted_warnings, flat_warnings, lens_warnings, stretched_warnings
from snakesfm.export.colmap import build_reconstruction, other_model_sizes, summarize
from snakesfm.export.image_folder import place_images, place_masks
from snakesfm.export.nerfstudio import transforms
from snakesfm.export.placement import (
    Placement,
    describe_frames,
    find_placement,
    placement_summary,
    placement_warnings,
)
from snakesfm.export.undistorted import FlatCamera, flatten, write_undistorted
from snakesfm.geometry.camera import Camera, cameras_from_columns
from snakesfm.geometry.colmap_checks import check_binary, check_ply, check_text
from snakesfm.geometry.poses import has_pose
from snakesfm.grouping import rows_of_each
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
    used = sorted({int(index.camera_ids[row]) for row in registered})
    flats = {row: flatten(cameras[row]) for row in used} if job.options.undistort else {}
    warnings = _warnings(job, index, adjusted, model, placements, cameras, registered, flats)
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
            built = _build(names, index, cameras, selected, keypoints)
            _write_colmap(temporary / "sparse" / str(number), built)
            if number == 0:
                _write_ply(temporary / "points.ply", built)
        content = transforms(
            names,
            index.camera_ids,
            cameras,
            model.rotations,
            model.translations,
            registered,
            masks,
            placements[0].place is not None,
        )
        _write_json(temporary / "transforms.json", content)
        summary = summarize(job.scene, names, adjusted.models, model.offsets, model.errors_px, warnings)
        _write_json(temporary / SUMMARY, {**summary, **placement_summary(placements, names)})
        _place_pictures(job, folder, names, index.orientations, masks)
        if job.options.undistort:
            target = temporary / UNDISTORTED
            _write_colmap(
                target / "sparse" / "0", _build_flat(names, index, cameras, flats, model, keypoints)
            )
            by_name = {names[row]: flats[index.camera_ids[row]] for row in registered}
            write_undistorted(target, folder / "images", given_masks, by_name, job.threads)
        _publish(temporary, folder)


def _warnings(
    job: StageJob,
    index: ImageIndex,
    adjusted: Reconstruction,
    model: Reconstruction,
    placements: list[Placement],
    cameras: list[Camera],
    registered: np.ndarray,
    flats: Mapping[int, FlatCamera],
) -> list[str]:
    """What a user should know of the model with the ``registered`` images (rows), a sentence each."""
    names = [str(name) for name in index.names]
    used = {row: cameras[row] for row in sorted({int(index.camera_ids[row]) for row in registered})}
    warnings = adjusted_warnings(
        used, adjusted.camera_resets, adjusted.camera_offsets, adjusted.camera_spreads
    )
    fixed = job.settings["intrinsics"] == "fixed"
    held = {row for row in used if fixed and index.camera_sources[row] == "given"}
    warnings += lens_warnings(
        cameras,
        index.camera_ids,
        model.rotations,
        model.translations,
        model.points,
        model.offsets,
        model.image_ids,
        model.keypoints,
        held,
    )
    warnings += flat_warnings(used, flats)
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
    warnings += stretched_warnings(used, [str(model) for model in calibrated.models])
    warnings += [str(line) for line in calibrated.warnings]
    warnings += placement_warnings(placements, names, job.options.georeference is True)
    # a list of pairs may name copies, which then are images as any other
    copies = int(np.count_nonzero((index.duplicate_of >= 0) & (adjusted.models < 0)))
    return warnings + ([COPIES.format(count=copies)] if copies else [])


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


def _build_flat(
    names: list[str],
    index: ImageIndex,
    cameras: list[Camera],
    flats: Mapping[int, FlatCamera],
    model: Reconstruction,
    keypoints: list[np.ndarray] | None,
) -> "pycolmap.Reconstruction":
    """The model of the pictures without distortion."""
    pixels = np.empty_like(model.keypoints)
    for row, mine in rows_of_each(index.camera_ids[model.image_ids]):
        pixels[mine] = flats[row].move(model.keypoints[mine])
    if keypoints is not None:
        # those of images of other models are not written
        keypoints = [
            flats[row].move(found) if row in flats else found
            for row, found in zip(index.camera_ids.tolist(), keypoints, strict=True)
        ]
    pinholes = [flats[row].camera if row in flats else camera for row, camera in enumerate(cameras)]
    return _build(names, index, pinholes, replace(model, keypoints=pixels), keypoints)


def _write_colmap(sparse: Path, model: "pycolmap.Reconstruction") -> None:
    """One model, binary and as text.

    Raises
    ------
    OSError : the disk is full.
    """
    sparse.mkdir(parents=True)
    model.write_binary(str(sparse))
    model.write_text(str(sparse))
    check_binary(sparse, model)
    check_text(sparse, model)


def _write_ply(path: Path, model: "pycolmap.Reconstruction") -> None:
    """The points of a model.

    Raises
    ------
    OSError : the disk is full.
    """
    model.export_PLY(str(path))
    check_ply(path, model.num_points3D())


def _place_pictures(
    job: StageJob, folder: Path, names: list[str], orientations: np.ndarray, masks: dict[str, str]
) -> None:
    """Put the images, and the masks if there are any, beside the model where that is wanted."""
    options: ExportModelOptions = job.options
    if options.link_images or options.undistort:
        place_images(folder / "images", Path(job.settings["images"]), names, orientations)
    if options.link_images and masks:
        place_masks(folder / "masks", Path(job.settings["masks"]), masks.values())
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
