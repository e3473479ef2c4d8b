"""Focal lengths where every place was photographed several times."""

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


@pytest.mark.parametrize(
    ("count", "moved_px", "source"), [(5, None, "estimated"), (5, 0.0, "default"), (26, None, "estimated")]
)
def test_pairs_of_one_place_do_not_take_the_place_of_those_that_tell(
    tmp_path, monkeypatch, count, moved_px, source
):
    if moved_px is not None:
        monkeypatch.setattr(calibrate_cameras, "MOVED_PX", moved_px)
    made, copies = burst(count)
    inputs = write_scene(copies, tmp_path)
    of_pair = np.split(copies.matches, copies.match_offsets[1:-1])
    write_plain_matches(tmp_path / "matches.h5", copies.pairs, of_pair)
    inputs = {name: inputs[name] for name in ("index", "features")} | {"matches": tmp_path / "matches.h5"}
    job = StageJob(
        "calibrate_cameras", "scene", inputs, (tmp_path / "out.h5",), CalibrateCamerasOptions(), threads=1
    )
    calibrate_cameras.run(job)
    found = CalibratedCameras.read(job.output)
    assert found.sources.tolist() == [source]
    expected = 1.0 if source == "estimated" else WRONG
    assert found.params[0, 0] / made.cameras[0].focal_px == pytest.approx(expected, rel=0.02)
