"""Stages calibrate_cameras and estimate_two_view on small artifacts."""

from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from plain_artifacts import HEADER, write_plain_cameras, write_plain_index, write_plain_matches

from snakesfm.artifacts import CalibratedCameras, LocalFeatures, TwoViewGeometries
from snakesfm.artifacts.pairs import KINDS, REJECTIONS
from snakesfm.calibration import focal
from snakesfm.config.calibrate_cameras import CalibrateCamerasOptions
from snakesfm.config.estimate_two_view import EstimateTwoViewOptions
from snakesfm.errors import ArtifactError
from snakesfm.geometry.camera import Camera
from snakesfm.stages import calibrate_cameras, estimate_two_view
from snakesfm.stages.job import StageJob
from snakesfm.two_view.estimate import estimate_two_view_geometry

Views = Callable[..., Any]
FEATURES = tuple(field.name for field in fields(LocalFeatures))


def write_inputs(folder: Path, views: Any, source: str, enlarged: int = 1) -> dict[str, Any]:
    """Three images of which 0 and 1 are a pair; image 2 matches image 0 in twelve places only."""
    camera = Camera("SIMPLE_RADIAL", 1000, 800, (900.0, 500.0, 400.0, 0.0), source).scaled(enlarged)
    names = ["a.jpg", "b.jpg", "c.jpg"]
    write_plain_index(folder / "index.h5", names, [(camera.width, camera.height)] * 3, [camera])
    if source == "given":
        write_plain_cameras(folder / "cameras.h5", [camera], 0.0)
    keypoints = [views.keypoints_i, views.keypoints_j, views.keypoints_j[:50]]
    total = sum(len(k) for k in keypoints)
    LocalFeatures(
        image_ids=np.arange(3, dtype=np.int32),
        names=names,
        digests=np.array(["da", "db", "dc"], dtype=object),
        sizes=np.tile([640, 480], (3, 1)),
        offsets=np.cumsum([0, *(len(k) for k in keypoints)]),
        keypoints=np.concatenate(keypoints) * enlarged,
        descriptors=np.zeros((total, 8), dtype=np.uint8),
        scores=np.ones(total, dtype=np.float32),
        scales=np.ones(total, dtype=np.float32),
        angles=np.zeros(total, dtype=np.float32),
        colors=np.zeros((total, 3), dtype=np.uint8),
    ).write(folder / "features.h5", HEADER)
    few = np.column_stack([np.arange(12), np.arange(12)]).astype(np.int32)
    write_plain_matches(folder / "matches.h5", [(0, 1), (0, 2)], [views.matches, few])
    return {
        "index": folder / "index.h5",
        "cameras": folder / "cameras.h5",
        "features": [folder / "features.h5"],
        "matches": folder / "matches.h5",
    }


def pose_job(folder: Path, inputs: dict[str, Any], **changes: Any) -> StageJob:
    job = StageJob(
        "estimate_two_view", "scene", inputs, (folder / "0-0.h5",), EstimateTwoViewOptions(), seed=5
    )
    return replace(job, **changes)


def test_pairs_of_a_tile(two_views: Views, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    views = two_views(seed=1)
    estimate_two_view.run(pose_job(tmp_path, write_inputs(tmp_path, views, "given")))
    found = TwoViewGeometries.read(tmp_path / "0-0.h5")
    assert found.pairs.tolist() == [[0, 1], [0, 2]]
    assert [REJECTIONS[r] for r in found.rejections] == ["", "too_few_matches"]
    assert np.allclose(found.rotations[0], views.rotation, atol=5e-3)
    assert np.isnan(found.rotations[1]).all()
    assert found.offsets.tolist() == [0, found.inlier_counts[0], found.inlier_counts[0]]
    assert len(found.inliers) > 200
    assert "1 of 2 pairs accepted" in capsys.readouterr().out


def test_what_stands_still_on_an_overlay_makes_no_pair(two_views: Views, tmp_path: Path) -> None:
    views, found = two_views(seed=1), {}
    inputs = write_inputs(tmp_path, views, "given")
    # images 0 and 2 share a stamp alone, at the same 50 places
    columns = {name: getattr(LocalFeatures.read(tmp_path / "features.h5"), name) for name in FEATURES}
    columns["keypoints"][-50:] = views.keypoints_i[:50]
    LocalFeatures(**columns).write(tmp_path / "features.h5", HEADER)
    same = np.column_stack([np.arange(50)] * 2).astype(np.int32)
    write_plain_matches(tmp_path / "matches.h5", [(0, 1), (0, 2)], [views.matches, same])
    cells = np.unique(np.floor(views.keypoints_i[:50] / 8).astype(np.int32), axis=0)
    for name, covered in (("none", cells[:0]), ("stamp", cells)):
        given = CalibratedCameras.read(tmp_path / "cameras.h5")
        sizes = np.tile([1000, 800], (len(covered), 1))
        replace(given, overlay_cells=np.hstack([sizes, covered]).astype(np.int32)).write(
            tmp_path / "cameras.h5", HEADER
        )
        estimate_two_view.run(pose_job(tmp_path, inputs))
        found[name] = TwoViewGeometries.read(tmp_path / "0-0.h5")
    assert [REJECTIONS[r] for r in found["none"].rejections] == ["", ""]
    assert found["none"].inlier_counts[1] == 50
    assert [REJECTIONS[r] for r in found["stamp"].rejections] == ["", "too_few_matches"]
    assert found["stamp"].digests[1] != found["none"].digests[1]
    assert found["stamp"].match_counts[1] == 0
    # the pair that moves keeps its matches in the stamp's cells, but for what is far away
    assert 297 <= found["stamp"].match_counts[0] <= found["none"].match_counts[0] == 300


def test_larger_photographs_are_judged_as_the_detector_saw_them(two_views: Views, tmp_path: Path) -> None:
    views, rows = two_views(seed=1), {}
    for name, enlarged, settings in [
        ("small", 1, {}),
        ("large", 4, {"detector_shorter_side_px": 800}),
        ("strict", 4, {}),
    ]:
        folder = tmp_path / name
        folder.mkdir()
        inputs = write_inputs(folder, views, "given", enlarged)
        estimate_two_view.run(pose_job(folder, inputs, settings=settings))
        rows[name] = TwoViewGeometries.read(folder / "0-0.h5")
    np.testing.assert_array_equal(rows["large"].inliers, rows["small"].inliers)
    np.testing.assert_array_equal(rows["large"].rotations, rows["small"].rotations)
    np.testing.assert_array_equal(rows["large"].covariances, rows["small"].covariances)
    # what is known of the small photographs is not taken for the large ones judged in their own pixels
    assert rows["large"].digests[0] == rows["small"].digests[0] != rows["strict"].digests[0]
    assert not np.array_equal(rows["strict"].rotations, rows["small"].rotations)


def test_estimators_are_given_the_best_matches_first(
    two_views: Views, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    views = two_views(seed=1)
    scores = np.random.default_rng(0).permutation(300) / 300
    order = views.matches[np.argsort(-scores)]
    given = {}

    def remember(module: ModuleType, name: str) -> None:
        function = getattr(module, name)

        def remembered(*arguments: Any) -> Any:
            given[name] = arguments
            return function(*arguments)

        monkeypatch.setattr(module, name, remembered)

    remember(estimate_two_view, "estimate_two_view_geometry")
    remember(focal, "calibrate_focals")
    # these have calibrated cameras, and those some to calibrate
    write_inputs(tmp_path, views, "given")
    inputs = write_inputs(tmp_path, views, "exif")
    write_plain_matches(inputs["matches"], [(0, 1)], [views.matches], scores)
    estimate_two_view.run(pose_job(tmp_path, inputs))
    options = CalibrateCamerasOptions()
    calibrate_cameras.run(StageJob("calibrate_cameras", "scene", inputs, (tmp_path / "out.h5",), options))
    np.testing.assert_array_equal(given["estimate_two_view_geometry"][2], order)
    (pair,) = given["calibrate_focals"][0]
    np.testing.assert_array_equal(pair.points_i, views.keypoints_i[order[:, 0]])
    np.testing.assert_array_equal(pair.points_j, views.keypoints_j[order[:, 1]])


def test_unchanged_pairs_are_taken_over(
    two_views: Views, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    inputs = write_inputs(tmp_path, two_views(seed=3), "given")
    estimate_two_view.run(pose_job(tmp_path, inputs))
    again = pose_job(tmp_path, inputs, former=tmp_path / "0-0.h5", outputs=(tmp_path / "again.h5",))
    with monkeypatch.context() as patch:
        patch.setattr(estimate_two_view, "estimate_two_view_geometry", None)
        estimate_two_view.run(again)
    assert (tmp_path / "again.h5").read_bytes() == (tmp_path / "0-0.h5").read_bytes()
    calls = []

    def counted(*arguments: Any) -> Any:
        calls.append(arguments)
        return original(*arguments)

    original = estimate_two_view_geometry
    monkeypatch.setattr(estimate_two_view, "estimate_two_view_geometry", counted)
    estimate_two_view.run(replace(again, options=EstimateTwoViewOptions(min_inliers=20)))
    assert len(calls) == 2


def newer() -> EstimateTwoViewOptions:
    """The options of a version to come."""
    return type("Newer", (EstimateTwoViewOptions,), {"stage_version": 999})()


@pytest.mark.parametrize("change", [{"options": newer()}, {"seed": 6}])
def test_another_version_or_seed_takes_nothing_over(
    two_views: Views, tmp_path: Path, change: dict[str, Any]
) -> None:
    inputs = write_inputs(tmp_path, two_views(seed=3, count=60, outliers=0), "given")
    estimate_two_view.run(pose_job(tmp_path, inputs))
    former, output = tmp_path / "0-0.h5", tmp_path / "again.h5"
    estimate_two_view.run(pose_job(tmp_path, inputs, former=former, outputs=(output,), **change))
    digests = [set(TwoViewGeometries.read(path).digests) for path in (former, output)]
    assert len(digests[0]) == len(digests[1]) == 2 and digests[0].isdisjoint(digests[1])


def test_pairs_of_images_with_other_keypoints_are_estimated_again(two_views: Views, tmp_path: Path) -> None:
    views = two_views(seed=3, count=60, outliers=0)
    inputs = write_inputs(tmp_path, views, "given")
    estimate_two_view.run(pose_job(tmp_path, inputs))
    features = LocalFeatures.read(tmp_path / "features.h5")
    moved = features.keypoints.copy()
    moved[features.offsets[1] + views.matches[0, 1]] += 5.0
    digests = np.array(["da", "another", "dc"], dtype=object)
    replace(features, keypoints=moved, digests=digests).write(tmp_path / "features.h5", HEADER)
    former, output = tmp_path / "0-0.h5", tmp_path / "again.h5"
    estimate_two_view.run(pose_job(tmp_path, inputs, former=former, outputs=(output,)))
    before, after = (TwoViewGeometries.read(path) for path in (former, output))
    assert (before.digests == after.digests).tolist() == [False, True]
    assert not np.array_equal(before.rotations[0], after.rotations[0])
    assert before.inlier_counts[0] == 60 and after.inlier_counts[0] == 59


def test_damaged_former_is_ignored(two_views: Views, tmp_path: Path) -> None:
    inputs = write_inputs(tmp_path, two_views(seed=4), "given")
    (tmp_path / "former.h5").write_bytes(b"no artifact")
    estimate_two_view.run(pose_job(tmp_path, inputs, former=tmp_path / "former.h5"))
    assert len(TwoViewGeometries.read(tmp_path / "0-0.h5").pairs) == 2


def test_tile_without_pairs(two_views: Views, tmp_path: Path) -> None:
    inputs = write_inputs(tmp_path, two_views(seed=5), "given")
    write_plain_matches(tmp_path / "matches.h5", [], [])
    estimate_two_view.run(pose_job(tmp_path, inputs))
    assert TwoViewGeometries.read(tmp_path / "0-0.h5").pairs.shape == (0, 2)


def test_matches_of_unknown_images_are_refused(two_views: Views, tmp_path: Path) -> None:
    views = two_views(seed=6)
    inputs = write_inputs(tmp_path, views, "given")
    inputs["features"] = []
    with pytest.raises(ArtifactError, match=r"a\.jpg"):
        estimate_two_view.run(pose_job(tmp_path, inputs))
    options = CalibrateCamerasOptions(min_matches=20)
    inputs = write_inputs(tmp_path, views, "default") | {"features": []}
    with pytest.raises(ArtifactError, match=r"a\.jpg"):
        calibrate_cameras.run(
            StageJob("calibrate_cameras", "scene", inputs, (tmp_path / "out.h5",), options)
        )


@pytest.mark.parametrize(
    ("source", "sigma"), [("given", 0.0), ("exif", CalibrateCamerasOptions().exif_sigma)]
)
def test_one_pair_leaves_what_is_known(two_views: Views, tmp_path: Path, source: str, sigma: float) -> None:
    inputs = write_inputs(tmp_path, two_views(seed=7), source)
    job = StageJob(
        "calibrate_cameras", "scene", inputs, (tmp_path / "out.h5",), CalibrateCamerasOptions(), seed=5
    )
    calibrate_cameras.run(job)
    found = CalibratedCameras.read(tmp_path / "out.h5")
    assert found.sources.tolist() == [source]
    assert found.params[0, 0] == 900.0
    assert found.focal_sigma.tolist() == [sigma]


@pytest.mark.parametrize(("wanted", "source"), [(True, "estimated"), (False, "exif")])
def test_calibration_stage_estimates(two_views: Views, tmp_path: Path, wanted: bool, source: str) -> None:
    inputs = write_inputs(tmp_path, two_views(seed=8, count=400), "exif")
    options = CalibrateCamerasOptions(
        estimate_focals=wanted, min_votes=1, systematic_sigma=0.0, max_sigma=10.0
    )
    job = StageJob("calibrate_cameras", "scene", inputs, (tmp_path / "out.h5",), options, seed=5)
    calibrate_cameras.run(job)
    found = CalibratedCameras.read(tmp_path / "out.h5")
    assert found.sources.tolist() == [source]
    assert found.params[0, 0] == pytest.approx(900.0, rel=0.1)
    assert (found.params[0, 0] != 900.0) == wanted
    assert found.params[0, 3] == 0.0


def test_larger_photographs_have_longer_focal_lengths(two_views: Views, tmp_path: Path) -> None:
    views, found = two_views(seed=8, count=400), []
    for enlarged in (1, 4):
        inputs = write_inputs(tmp_path, views, "exif", enlarged)
        options = CalibrateCamerasOptions(min_votes=1, systematic_sigma=0.0, max_sigma=10.0)
        settings = {"detector_shorter_side_px": 800}
        job = StageJob("calibrate_cameras", "scene", inputs, (tmp_path / "out.h5",), options, settings, 5)
        calibrate_cameras.run(job)
        found.append(CalibratedCameras.read(tmp_path / "out.h5"))
    small, large = found
    np.testing.assert_array_equal(large.sizes, 4 * small.sizes)
    np.testing.assert_array_equal(large.params[0, :3], 4 * small.params[0, :3])
    np.testing.assert_array_equal(large.params[0, 3:], small.params[0, 3:])
    assert large.sources.tolist() == small.sources.tolist() == ["estimated"]
    np.testing.assert_array_equal(large.focal_sigma, small.focal_sigma)


def test_calibration_stage_without_pairs(two_views: Views, tmp_path: Path) -> None:
    inputs = write_inputs(tmp_path, two_views(seed=9), "default")
    write_plain_matches(tmp_path / "matches.h5", [], [])
    job = StageJob(
        "calibrate_cameras", "scene", inputs, (tmp_path / "out.h5",), CalibrateCamerasOptions(), seed=5
    )
    calibrate_cameras.run(job)
    assert CalibratedCameras.read(tmp_path / "out.h5").sources.tolist() == ["default"]


def test_identical_images_are_a_pair_that_only_turns(two_views: Views, tmp_path: Path) -> None:
    views = two_views(seed=10, outliers=0)
    same = replace(
        views,
        keypoints_j=views.keypoints_i,
        matches=np.column_stack([np.arange(300), np.arange(300)]).astype(np.int32),
    )
    estimate_two_view.run(pose_job(tmp_path, write_inputs(tmp_path, same, "given")))
    found = TwoViewGeometries.read(tmp_path / "0-0.h5")
    assert KINDS[found.kinds[0]] == "rotation_only"
    assert np.allclose(found.rotations[0], np.eye(3), atol=1e-4)
    assert np.isfinite(found.covariances[0]).all()
