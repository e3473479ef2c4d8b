"""Focal lengths where many matches stand still: of places photographed several times, and on overlays."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from plain_artifacts import write_plain_matches
from synthetic_scene import write_scene

from snakesfm.artifacts import CalibratedCameras
from snakesfm.config.calibrate_cameras import CalibrateCamerasOptions
from snakesfm.stages import calibrate_cameras
from snakesfm.stages.job import StageJob
from snakesfm.synthetic.problems import make_problem

PLACES = 12
WRONG = 1.3


def burst(copies):
    """A scene of which every image is there several times, with noise; copies match best."""
    made = make_problem(PLACES, 600, "ring", noise_px=0.1, seed=7)
    random = np.random.default_rng(1)
    keypoints = [
        points + (copy > 0) * random.normal(0.0, 0.1, points.shape)
        for copy in range(copies)
        for points in made.keypoints
    ]
    pairs, matches = made.pairs.tolist(), np.split(made.matches, made.match_offsets[1:-1])
    for first, second in combinations(range(copies), 2):
        for place, points in enumerate(made.keypoints):
            pairs.append([first * PLACES + place, second * PLACES + place])
            matches.append(np.repeat(np.arange(len(points)), 2).reshape(-1, 2))
    order = sorted(range(len(pairs)), key=pairs.__getitem__)
    edges = np.minimum(order, len(made.pairs) - 1)
    lengths = [len(matches[row]) for row in order]
    camera = made.cameras[0].with_focal(WRONG * made.cameras[0].focal_px, "default")
    return made, replace(
        made,
        cameras=(camera,),
        camera_ids=np.zeros(PLACES * copies, int),
        rotations=np.tile(made.rotations, (copies, 1, 1)),
        translations=np.tile(made.translations, (copies, 1)),
        keypoints=keypoints,
        pairs=np.array([pairs[row] for row in order]),
        matches=np.concatenate([matches[row] for row in order]),
        match_offsets=np.r_[0, np.cumsum(lengths)],
        **{
            name: getattr(made, name)[edges]
            for name in (
                "edge_rotations",
                "edge_translations",
                "edge_covariances",
                "edge_inlier_counts",
                "edge_angles_deg",
            )
        },
    )


def with_overlay(made, rows):
    """A scene with rows of 78 keypoints in all images that stand still and match, twice in the first pair.

    All other matches of the first pair are gone.
    """
    places = np.stack(np.meshgrid(np.arange(8.0, 632.0, 8.0), 440.0 + 8.0 * np.arange(rows)), -1)
    random = np.random.default_rng(1)
    overlays = [places.reshape(-1, 2) + random.normal(0.0, 0.1, (78 * rows, 2)) for _ in made.keypoints]
    starts = np.array([len(points) for points in made.keypoints])
    matches = [
        np.concatenate([own, starts[pair] + np.arange(78 * rows)[:, None]])
        for pair, own in zip(made.pairs, np.split(made.matches, made.match_offsets[1:-1]), strict=True)
    ]
    matches[0] = np.tile(matches[0][-78 * rows :], (2, 1))
    return replace(
        made,
        cameras=(made.cameras[0].with_focal(WRONG * made.cameras[0].focal_px, "default"),),
        keypoints=[np.concatenate(parts) for parts in zip(made.keypoints, overlays, strict=True)],
        matches=np.concatenate(matches),
        match_offsets=np.r_[0, np.cumsum([len(part) for part in matches])],
    )


def calibrated(scene, folder):
    """What the stage makes of a scene."""
    inputs = write_scene(scene, folder)
    of_pair = np.split(scene.matches, scene.match_offsets[1:-1])
    write_plain_matches(folder / "matches.h5", scene.pairs, of_pair)
    inputs = {name: inputs[name] for name in ("index", "features")} | {"matches": folder / "matches.h5"}
    job = StageJob(
        "calibrate_cameras", "scene", inputs, (folder / "out.h5",), CalibrateCamerasOptions(), threads=1
    )
    calibrate_cameras.run(job)
    return CalibratedCameras.read(job.output)


@pytest.mark.parametrize(
    ("count", "moved_px", "source"), [(5, None, "estimated"), (5, 0.0, "default"), (26, None, "estimated")]
)
def test_pairs_of_one_place_do_not_take_the_place_of_those_that_tell(
    tmp_path, monkeypatch, count, moved_px, source
):
    if moved_px is not None:
        monkeypatch.setattr(calibrate_cameras, "MOVED_PX", moved_px)
    made, copies = burst(count)
    found = calibrated(copies, tmp_path)
    assert found.sources.tolist() == [source]
    expected = 1.0 if source == "estimated" else WRONG
    assert found.params[0, 0] / made.cameras[0].focal_px == pytest.approx(expected, rel=0.02)


def test_pairs_of_which_most_matches_are_on_an_overlay_tell_focal_lengths(tmp_path):
    made = make_problem(PLACES, 600, "ring", noise_px=0.1, seed=7)
    scene = with_overlay(made, 4)
    shares = 78 * 4 / np.diff(scene.match_offsets)
    assert shares[1:].min() > 0.5
    found = calibrated(scene, tmp_path)
    assert len(found.overlay_cells)
    assert found.sources.tolist() == ["estimated"]
    assert found.params[0, 0] / made.cameras[0].focal_px == pytest.approx(1.0, rel=0.02)
