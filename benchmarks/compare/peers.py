"""What a peer does in one process of its own: ``python -m benchmarks.compare.peers SPEC.json``.

The specification names an operation and its arguments. Each operation reads and writes files, so that the
time, processor time and memory of its process are those of the operation.
"""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

MIN_MODEL_SIZE = 3  # COLMAP's 10 would refuse the smallest sets


def extract(images: str, database: str, cameras: list[dict[str, Any]], features: int, threads: int) -> None:
    """SIFT of COLMAP into a new database.

    ``cameras`` lists groups of images: names (none for all), mode, and model and params where the
    intrinsics are known. Of several groups COLMAP is told first, so that all images are extracted at once:
    in a group of one image there is nothing for a second thread.
    """
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu, options.num_threads = False, threads
    options.sift.max_num_features = features
    if len(cameras) == 1:
        (camera,) = cameras
        pycolmap.extract_features(
            database,
            images,
            image_names=camera["names"],
            camera_mode=getattr(pycolmap.CameraMode, camera["mode"]),
            reader_options=_reader(camera),
            extraction_options=options,
        )
        return
    pycolmap.Database.open(database).close()
    for camera in cameras:
        pycolmap.import_images(
            database,
            images,
            image_names=camera["names"],
            camera_mode=getattr(pycolmap.CameraMode, camera["mode"]),
            options=_reader(camera),
        )
    names = [name for camera in cameras for name in camera["names"]]
    pycolmap.extract_features(database, images, image_names=names, extraction_options=options)


def _reader(camera: dict[str, Any]) -> pycolmap.ImageReaderOptions:
    reader = pycolmap.ImageReaderOptions()
    if "params" in camera:
        reader.camera_model = camera["model"]
        reader.camera_params = ",".join(repr(value) for value in camera["params"])
    return reader


def match(database: str, threads: int) -> None:
    """Match and verify all pairs."""
    options = pycolmap.FeatureMatchingOptions()
    options.use_gpu, options.num_threads = False, threads
    pycolmap.match_exhaustive(database, matching_options=options)


def map_incremental(database: str, images: str, output: str, fixed: bool, seed: int, threads: int) -> None:
    """COLMAP's incremental mapper; intrinsics are held where ``fixed``."""
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed, options.min_model_size = threads, seed, MIN_MODEL_SIZE
    if fixed:
        options.ba_refine_focal_length = options.ba_refine_principal_point = False
        options.ba_refine_extra_params = False
        options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    models = pycolmap.incremental_mapping(database, images, _folder(output, "models"), options)
    _keep_largest(models, output)


def map_global(
    database: str, images: str, output: str, fixed: bool, calibrate: bool, seed: int, threads: int
) -> None:
    """COLMAP's global mapper (GLOMAP), after its view graph calibration where ``calibrate``.

    Calibration writes to the database: give it a copy.
    """
    if calibrate:
        calibration = pycolmap.ViewGraphCalibrationOptions()
        calibration.random_seed = seed
        pycolmap.calibrate_view_graph(database, calibration)
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads, options.random_seed, options.min_model_size = threads, seed, MIN_MODEL_SIZE
    options.mapper.num_threads, options.mapper.random_seed = threads, seed
    options.mapper.global_positioning.use_gpu = False
    adjustment = options.mapper.bundle_adjustment
    adjustment.ceres.use_gpu = False
    if fixed:
        adjustment.refine_focal_length = adjustment.refine_principal_point = False
        adjustment.refine_extra_params = False
    models = pycolmap.global_mapping(database, images, _folder(output, "models"), options)
    _keep_largest(models, output)


def openmvg(
    images: str, output: str, intrinsics: list[list[float]] | None, seed: int, threads: int
) -> None:
    """OpenMVG's global engine, from images to model, with its own front-end."""
    import openmvg_rs

    path = None
    if intrinsics is not None:
        path = Path(output) / "K.txt"
        np.savetxt(path, np.array(intrinsics))
    scene = openmvg_rs.reconstruct(
        images, engine="global", seed=seed, intrinsics=path, progress=False, max_workers=threads
    )
    scene.write_colmap(_folder(output, "model"))


def _folder(output: str, name: str) -> Path:
    folder = Path(output) / name
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def _keep_largest(models: dict[int, Any], output: str) -> None:
    """Write the model with the most images to the folder ``model``."""
    if not models:
        raise SystemExit("no model was found")
    largest = max(models.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()))
    largest.write(_folder(output, "model"))


OPERATIONS = {
    operation.__name__: operation for operation in (extract, match, map_incremental, map_global, openmvg)
}


def main(path: str) -> None:
    """Do what the specification says."""
    specification = json.loads(Path(path).read_text("utf-8"))
    pycolmap.logging.minloglevel = 1
    pycolmap.logging.logtostderr = True
    OPERATIONS[specification["operation"]](**specification["arguments"])


if __name__ == "__main__":
    main(sys.argv[1])
