"""Cameras whose lens is not of their model get a wider one; all others keep theirs."""

from dataclasses import replace

import numpy as np
import pytest
from plain_artifacts import HEADER
from synthetic_scene import run_rounds, true_model, write_scene

from snakesfm.artifacts import CameraCenters, CameraRotations, Reconstruction, TriangulatedPoints
from snakesfm.bundle import lenses
from snakesfm.bundle.interface import SolverSettings, bundle_adjuster
from snakesfm.bundle.model import to_reconstruction
from snakesfm.config.adjust_bundle import AdjustBundleOptions
from snakesfm.geometry.camera import Camera
from snakesfm.geometry.rotations import angle_of
from snakesfm.stages import adjust_bundle
from snakesfm.stages.job import StageJob
from snakesfm.synthetic.problems import Layout, make_problem

SIZE = (640, 480)
CENTER = (320.0, 240.0)
FISHEYE = Camera("OPENCV_FISHEYE", *SIZE, (250.0, 250.0, *CENTER, 0.01, 0.0, 0.0, 0.0))
START = Camera("SIMPLE_RADIAL", *SIZE, (300.0, *CENTER, 0.0), "estimated")
RADIAL = Camera("SIMPLE_RADIAL", *SIZE, (280.0, *CENTER, -0.05))


def seen_by(camera: Camera, layout: Layout = "facade"):
    return make_problem(14, 900, layout=layout, noise_px=0.05, camera=camera, seed=3)


def adjusted(
    true: Camera,
    start: Camera = START,
    held: frozenset[int] = frozenset(),
    layout: Layout = "facade",
    **changes: object,
):
    """What rounds make of keypoints of a true camera: the camera, the rounds' names and the largest error."""
    made = seen_by(true, layout)
    model = replace(true_model(made), cameras=(start,))
    settings = {"widen_lenses": True, "refine_principal_points": False} | changes
    found, records = run_rounds(made, model, SolverSettings(constant_cameras=held), **settings)
    relative = found.rotations[1:] @ found.rotations[:-1].transpose(0, 2, 1)
    truth = made.rotations[1:] @ made.rotations[:-1].transpose(0, 2, 1)
    errors_deg = np.degrees(angle_of(relative @ truth.transpose(0, 2, 1)))
    return found.cameras[0], [record.name for record in records], float(errors_deg.max())


def test_a_fisheye_lens_is_found_out_and_the_model_is_right() -> None:
    camera, names, error_deg = adjusted(FISHEYE)
    assert (camera.model, camera.source) == ("OPENCV_FISHEYE", "estimated")
    assert camera.params[0] == pytest.approx(250.0, rel=0.003)
    assert names.count("round 2 with wider lenses") == 1
    *_, narrow_deg = adjusted(FISHEYE, widen_lenses=False)
    assert error_deg < 0.03 < 0.3 < narrow_deg


@pytest.mark.parametrize(
    "case",
    [
        {"true": RADIAL},
        # of points within 45 degrees of the axis the wider model leaves more than half of the errors
        {"true": FISHEYE, "layout": "ring"},
        {"true": FISHEYE, "held": frozenset([1])},
        {"true": FISHEYE, "thresholds_px": (20.0, 3.0)},
        {"true": FISHEYE, "widen_lenses": False},
    ],
    ids=["its own", "hardly better", "held", "distortion still held", "switched off"],
)
def test_other_lenses_keep_their_model(case) -> None:
    camera, names, _ = adjusted(**case)
    assert camera.model == "SIMPLE_RADIAL"
    assert not any("lenses" in name for name in names)


@pytest.mark.parametrize("wanted", ["auto", "SIMPLE_RADIAL"])
def test_the_stage_looks_for_wider_lenses_where_no_model_is_wanted(tmp_path, wanted: str) -> None:
    made = replace(seen_by(FISHEYE), cameras=(START,))
    inputs = write_scene(made, tmp_path)
    edges, images = np.zeros(len(made.pairs)), np.zeros(14, int)
    CameraRotations(made.rotations, edges, edges.astype(int), images).write(inputs["rotations"], HEADER)
    CameraCenters(made.centers, images, edges, np.zeros(0)).write(inputs["centers"], HEADER)
    TriangulatedPoints(
        made.points,
        made.track_offsets,
        made.track_image_ids,
        made.track_keypoint_ids,
        made.track_keypoints,
        np.zeros((len(made.points), 3), np.uint8),
    ).write(inputs["points"], HEADER)
    options = AdjustBundleOptions(refine_keypoints=False)
    output, settings = inputs["reconstruction"], {"camera_model": wanted}
    adjust_bundle.run(StageJob("adjust_bundle", "scene", inputs, (output,), options, settings))
    found = "OPENCV_FISHEYE" if wanted == "auto" else wanted
    assert Reconstruction.read(output).camera_models.tolist() == [found]


def test_a_lens_gone_wild_later_goes_back_to_the_wider_model() -> None:
    camera, names, _ = adjusted(FISHEYE, max_distortion=1e-9)
    assert "round 2 with wider lenses" in names
    assert (camera.model, len(camera.params)) == ("OPENCV_FISHEYE", 8)


def test_errors_are_compared_on_the_points_that_were_tried(monkeypatch) -> None:
    monkeypatch.setattr(lenses, "MAX_MISFIT", -1.0)
    monkeypatch.setattr(lenses, "MAX_POINTS", 100)
    made = make_problem(14, 900, "facade", noise_px=0.05, camera=RADIAL, seed=3)
    keypoints = [points.copy() for points in made.keypoints]
    # of 15 for each image every so many are tried: all others are worse
    step = -(-len(made.points) // (15 * 14))
    random = np.random.default_rng(0)
    for point in np.flatnonzero(np.arange(len(made.points)) % step).tolist():
        for row in range(*made.track_offsets[point : point + 2].tolist()):
            image, keypoint = made.track_image_ids[row], made.track_keypoint_ids[row]
            keypoints[image][keypoint] += random.normal(0.0, 0.5, 2)
    model = to_reconstruction(true_model(made), keypoints, [f"{k}.jpg" for k in range(14)])
    assert lenses.find_wider_lenses(model, bundle_adjuster("ceres"), SolverSettings()) == {}
