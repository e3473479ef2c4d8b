"""export_database: what COLMAP reads from it, and what its mapper makes of it."""

import resource
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
from plain_artifacts import write_plain_cameras, write_plain_index, write_plain_matches

from snakesfm.artifacts import Header, LocalFeatures, TwoViewGeometries
from snakesfm.config.evaluate_model import EvaluateModelOptions
from snakesfm.config.export_database import ExportDatabaseOptions
from snakesfm.errors import ArtifactError
from snakesfm.evaluation.colmap_model import model_poses
from snakesfm.evaluation.metrics import Poses, evaluate_poses
from snakesfm.export.database import panoramic_geometry
from snakesfm.geometry.camera import Camera
from snakesfm.geometry.rotations import exp_so3
from snakesfm.stages import export_database
from snakesfm.stages.job import StageJob
from snakesfm.synthetic.problems import SyntheticProblem, make_problem

COUNT = 12
HEADER = Header("test", 1, "scene")
NAMES = [f"day 1/ü{k:02d}.jpg" for k in range(COUNT)]
SIZE = (640, 480)
GPS = np.full((COUNT, 3), np.nan)
GPS[2] = 48.5, -2.25, 120.0
# COLMAP does not read a position without altitude either
GPS[4, :2] = 48.5, -2.25
GUESSED = Camera("SIMPLE_RADIAL", *SIZE, (500.0, 320.0, 240.0, 0.0), "default")
CAMERAS = [Camera("PINHOLE", *SIZE, (500.0, 500.0, 320.0, 240.0), "given"), GUESSED]
ROTATION_ONLY, REJECTED = 0, 1
TOO_FEW_INLIERS = 3


@pytest.fixture(scope="module")
def problem() -> SyntheticProblem:
    return make_problem(camera_count=COUNT, point_count=600, noise_px=0.3, rotation_noise_deg=0.1)


def descriptors_of(image: int, count: int) -> np.ndarray:
    return np.random.default_rng(image).integers(0, 256, (count, 128), dtype=np.uint8)


def write_inputs(folder: Path, problem: SyntheticProblem) -> dict[str, str | list[str]]:
    """The artifacts of two blocks, with all pairs in one of three tiles."""
    folder.mkdir(exist_ok=True)
    of_image = np.arange(COUNT) % 2
    write_plain_index(
        folder / "index.h5", NAMES, [SIZE] * COUNT, CAMERAS, blocks=of_image, camera_ids=of_image, gps=GPS
    )
    write_plain_cameras(folder / "cameras.h5", CAMERAS, 0.0)
    for block in (0, 1):
        images = np.arange(block, COUNT, 2)
        counts = [len(problem.keypoints[image]) for image in images]
        total = sum(counts)
        LocalFeatures(
            image_ids=images,
            names=[NAMES[image] for image in images],
            digests=["d"] * len(images),
            sizes=np.tile(SIZE, (len(images), 1)),
            offsets=np.r_[0, np.cumsum(counts)],
            keypoints=np.concatenate([problem.keypoints[image] for image in images]),
            descriptors=np.concatenate(
                [descriptors_of(i, n) for i, n in zip(images.tolist(), counts, strict=True)]
            ),
            scores=np.ones(total, np.float32),
            scales=np.full(total, 5.0, np.float32),
            angles=np.full(total, 0.25, np.float32),
            colors=np.zeros((total, 3), np.uint8),
        ).write(folder / f"features{block}.h5", HEADER)
    tiles = [np.arange(len(problem.pairs)), np.zeros(0, np.int64), np.zeros(0, np.int64)]
    for tile, rows in enumerate(tiles):
        write_tile(folder, tile, problem, rows)
    return {
        "index": str(folder / "index.h5"),
        "cameras": str(folder / "cameras.h5"),
        "features": [str(folder / f"features{block}.h5") for block in (0, 1)],
        "matches": [str(folder / f"matches{tile}.h5") for tile in range(3)],
        "geometries": [str(folder / f"geometries{tile}.h5") for tile in range(3)],
    }


def write_tile(folder: Path, tile: int, problem: SyntheticProblem, rows: np.ndarray) -> None:
    count = len(rows)
    offsets = problem.match_offsets if count else np.zeros(1, np.int64)
    matches = problem.matches if count else np.zeros((0, 2), np.int32)
    kinds, rejections = np.zeros(count, np.int8), np.zeros(count, np.int8)
    if count:
        kinds[ROTATION_ONLY], rejections[REJECTED] = 2, TOO_FEW_INLIERS
    lengths = np.diff(offsets).astype(np.int32)
    of_pair = np.split(matches, offsets[1:-1]) if count else []
    write_plain_matches(folder / f"matches{tile}.h5", problem.pairs[rows], of_pair)
    TwoViewGeometries(
        pairs=problem.pairs[rows],
        digests=["d"] * count,
        rotations=problem.edge_rotations[rows],
        translations=problem.edge_translations[rows],
        covariances=problem.edge_covariances[rows],
        kinds=kinds,
        rejections=rejections,
        match_counts=lengths,
        inlier_counts=lengths,
        inlier_ratios=np.ones(count),
        triangulation_angles_deg=problem.edge_angles_deg[rows],
        offsets=offsets,
        inliers=matches,
    ).write(folder / f"geometries{tile}.h5", HEADER)


def job_of(folder: Path, inputs: dict[str, str | list[str]], descriptors: bool = True) -> StageJob:
    output = folder / "out" / "scene" / "export_database" / "database.db"
    options = ExportDatabaseOptions(descriptors=descriptors)
    return StageJob("export_database", "scene", inputs, (output,), options)


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory, problem: SyntheticProblem) -> Path:
    folder = tmp_path_factory.mktemp("database")
    job = job_of(folder, write_inputs(folder, problem))
    export_database.run(job)
    assert [path.name for path in job.output.parent.iterdir()] == ["database.db"]
    return job.output


@pytest.fixture
def database(exported: Path):
    database = pycolmap.Database.open(exported)
    yield database
    database.close()


def test_cameras_and_images_come_with_trivial_rigs_and_frames(database) -> None:
    cameras = database.read_all_cameras()
    assert [camera.has_prior_focal_length for camera in cameras] == [True, False]
    for camera, ours in zip(cameras, CAMERAS, strict=True):
        assert (camera.model_name, camera.width, camera.height) == (ours.model, *SIZE)
        np.testing.assert_array_equal(camera.params, ours.params)
    rigs = database.read_all_rigs()
    assert [(rig.rig_id, rig.ref_sensor_id.id, rig.num_sensors()) for rig in rigs] == [(1, 1, 1), (2, 2, 1)]
    images = database.read_all_images()
    assert [image.name for image in images] == NAMES
    frames = {frame.frame_id: frame for frame in database.read_all_frames()}
    assert len(frames) == COUNT
    for row, image in enumerate(images):
        assert image.camera_id == row % 2 + 1
        frame = frames[image.frame_id]
        assert frame.rig_id == image.camera_id
        assert [(data.sensor_id.id, data.id) for data in frame.data_ids] == [
            (image.camera_id, image.image_id)
        ]


def test_the_last_line_names_the_version_of_colmap(tmp_path, problem, capsys) -> None:
    export_database.run(job_of(tmp_path, write_inputs(tmp_path, problem)))
    assert capsys.readouterr().out.endswith(f"; for COLMAP {pycolmap.__version__} or newer\n")


def test_gps_is_a_pose_prior(database) -> None:
    (prior,) = database.read_all_pose_priors()
    np.testing.assert_array_equal(prior.position, GPS[2])
    assert prior.coordinate_system == pycolmap.PosePriorCoordinateSystem.WGS84
    assert prior.corr_data_id == database.read_image(3).data_id
    assert not prior.has_position_cov()


def test_features_are_those_of_the_artifacts(database, problem: SyntheticProblem) -> None:
    for image in range(COUNT):
        count = len(problem.keypoints[image])
        keypoints = database.read_keypoints(image + 1)
        np.testing.assert_array_equal(keypoints[:, :2], problem.keypoints[image])
        # sigma, half of the diameter, and the angle
        np.testing.assert_array_equal(keypoints[:, 2:], np.tile(np.float32([2.5, 0.25]), (count, 1)))
        descriptors = database.read_descriptors(image + 1)
        assert descriptors.type == pycolmap.FeatureExtractorType.SIFT
        np.testing.assert_array_equal(descriptors.data, descriptors_of(image, count))


def test_matches_of_all_pairs_and_geometries_of_accepted_ones(database, problem: SyntheticProblem) -> None:
    configurations = pycolmap.TwoViewGeometryConfiguration
    for row, (i, j) in enumerate(problem.pairs.tolist()):
        matches = problem.matches[problem.match_offsets[row] : problem.match_offsets[row + 1]]
        np.testing.assert_array_equal(database.read_matches(i + 1, j + 1), matches)
        assert database.exists_two_view_geometry(i + 1, j + 1) == (row != REJECTED)
        if row == REJECTED:
            continue
        geometry = database.read_two_view_geometry(i + 1, j + 1)
        pose = geometry.cam2_from_cam1
        np.testing.assert_array_equal(geometry.inlier_matches, matches)
        np.testing.assert_allclose(pose.rotation.matrix(), problem.edge_rotations[row], atol=1e-9)
        if row == ROTATION_ONLY:
            assert geometry.config == configurations.PANORAMIC.value
            first, second = (CAMERAS[image % 2].to_pycolmap().calibration_matrix() for image in (i, j))
            np.testing.assert_allclose(
                np.linalg.solve(second, geometry.H @ first), problem.edge_rotations[row], atol=1e-9
            )
            continue
        assert geometry.config == configurations.CALIBRATED.value
        np.testing.assert_allclose(pose.translation, problem.edge_translations[row], atol=1e-9)
        left = np.cross(np.eye(3), pose.translation) @ geometry.E
        assert np.abs(np.trace(left)) > 0.1
        assert np.abs(pose.translation @ geometry.E).max() < 1e-9


def test_homography_takes_the_first_cameras_pixels_to_the_second() -> None:
    first, second = CAMERAS[0], Camera("SIMPLE_RADIAL", *SIZE, (700.0, 300.0, 250.0, 0.0))
    turn = exp_so3(np.array([0.05, -0.2, 0.1]))
    inliers = np.array([[0, 1], [2, 0]])
    geometry = panoramic_geometry(turn, inliers, (first, second))
    rays = np.array([[0.1, -0.2, 1.0], [-0.3, 0.05, 1.0], [0.0, 0.3, 1.0]])
    pixels = np.column_stack([first.to_pycolmap().img_from_cam(rays), np.ones(3)])
    found = pixels @ geometry.H.T
    np.testing.assert_allclose(
        found[:, :2] / found[:, 2:], second.to_pycolmap().img_from_cam(rays @ turn.T), atol=1e-9
    )
    np.testing.assert_array_equal(geometry.inlier_matches, inliers)


def test_global_mapping_takes_the_database_as_it_is(
    exported: Path, problem: SyntheticProblem, tmp_path: Path
) -> None:
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    options.random_seed = options.mapper.random_seed = 0
    options.mapper.global_positioning.use_gpu = options.mapper.bundle_adjustment.ceres.use_gpu = False
    models = pycolmap.global_mapping(exported, tmp_path, tmp_path / "models", options)
    model = max(models.values(), key=lambda item: item.num_reg_images())
    assert model.num_reg_images() == COUNT
    truth = Poses(NAMES, problem.rotations, problem.translations)
    metrics = evaluate_poses(model_poses(model), truth, **EvaluateModelOptions().model_dump()).metrics
    assert 75.0 < metrics["relative_pose_auc_1deg"] < 99.9


def test_descriptors_may_be_left_out(tmp_path: Path, problem: SyntheticProblem) -> None:
    job = job_of(tmp_path, write_inputs(tmp_path, problem), descriptors=False)
    export_database.run(job)
    database = pycolmap.Database.open(job.output)
    counts = database.num_keypoints(), database.num_descriptors()
    database.close()
    assert counts == (sum(map(len, problem.keypoints)), 0)


@pytest.mark.parametrize(("free", "error"), [(0, "No space left"), (1 << 30, "No registered database")])
def test_a_database_that_cannot_be_opened_on_a_full_disk_says_so(
    tmp_path: Path, problem: SyntheticProblem, monkeypatch: pytest.MonkeyPatch, free: int, error: str
) -> None:
    job = job_of(tmp_path, write_inputs(tmp_path, problem))
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=free))
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    # no file may hold more
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        with pytest.raises((OSError, RuntimeError), match=error):
            export_database.run(job)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert not job.output.exists()


def test_a_fault_leaves_the_former_database_alone(tmp_path: Path, problem: SyntheticProblem) -> None:
    inputs = write_inputs(tmp_path, problem)
    job = job_of(tmp_path, inputs)
    job.output.parent.mkdir(parents=True)
    job.output.write_bytes(b"former")
    (job.output.parent / ".export.left").mkdir()
    Path(inputs["geometries"][2]).write_bytes(b"no artifact")
    with pytest.raises(ArtifactError, match=r"geometries2\.h5 is damaged"):
        export_database.run(job)
    assert [path.name for path in job.output.parent.iterdir()] == ["database.db"]
    assert job.output.read_bytes() == b"former"
