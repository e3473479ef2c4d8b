"""Simulated scenes: the truth holds, nothing depends on order or blocks, and memory is bounded."""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from full_disk import cut_references

from snakesfm.artifacts.features import LocalFeatures
from snakesfm.artifacts.images import ImageIndex
from snakesfm.artifacts.pairs import PairMatches, TwoViewGeometries
from snakesfm.geometry.rotations import angle_of
from snakesfm.matching.matcher import MATCHERS
from snakesfm.simulate import Simulation, SimulationOptions, main
from snakesfm.synthetic.pairing import candidate_pairs, choose_partners, simulate_edge
from snakesfm.synthetic.sightings import DetectorModel, DistinctLooks, match_looks, sight
from snakesfm.synthetic.surveys import LANDMARKS_PER_CELL, SURVEYS, AerialSurvey, StreetSurvey, Survey

SIZES = {"aerial": 100, "street": 400}


@pytest.fixture(params=sorted(SURVEYS), scope="module")
def survey(request) -> Survey:
    return SURVEYS[request.param](SIZES[request.param], 3)


def project(survey: Survey, image: int, points: np.ndarray) -> np.ndarray:
    in_camera = (points - survey.centers[image]) @ survey.rotations[image].T
    focal, _, x, y = survey.camera.params
    assert (in_camera[:, 2] > 0).all()
    return focal * in_camera[:, :2] / in_camera[:, 2:] + (x, y)


def middle_pair(survey: Survey) -> tuple[int, int]:
    """Two images that see much in common."""
    pairs = survey.neighbours()
    gaps = np.linalg.norm(survey.centers[pairs[:, 0]] - survey.centers[pairs[:, 1]], axis=1)
    aligned = np.einsum("pi,pi->p", survey.rotations[pairs[:, 0], 2], survey.rotations[pairs[:, 1], 2])
    order = np.argsort(gaps + 100 * (aligned < 0.9))
    return tuple(pairs[order[len(order) // 20]].tolist())


def test_keypoints_lie_where_their_landmarks_project(survey: Survey) -> None:
    image = len(survey.names) // 2
    found = sight(survey, image, 3, DetectorModel(displaced=0.0), descriptors=False)
    landmarks = survey.near(image)
    shown = found.landmarks >= 0
    place = {key: row for row, key in enumerate(landmarks.ids.tolist())}
    points = landmarks.points[[place[key] for key in found.landmarks[shown].tolist()]]
    misses = found.keypoints.keypoints[shown] - project(survey, image, points)
    assert 300 < len(found.landmarks) <= DetectorModel.max_keypoints
    assert 0.45 < float(np.median(np.abs(misses))) / 0.6745 < 0.6
    assert 0.1 < 1 - shown.mean() < 0.2


def test_a_sighting_depends_on_its_image_alone(survey: Survey) -> None:
    again = SURVEYS["aerial" if isinstance(survey, AerialSurvey) else "street"](len(survey.names), 3)
    first = sight(survey, 17, 3)
    sight(again, 40, 3)
    second = sight(again, 17, 3)
    for name in ("keypoints", "descriptors", "scores", "scales", "angles"):
        np.testing.assert_array_equal(getattr(first.keypoints, name), getattr(second.keypoints, name))
    np.testing.assert_array_equal(first.landmarks, second.landmarks)
    assert not np.array_equal(first.landmarks, sight(survey, 17, 4).landmarks)


def test_given_matches_resemble_those_of_the_real_matcher(survey: Survey) -> None:
    i, j = middle_pair(survey)
    a, b = sight(survey, i, 3), sight(survey, j, 3)
    matcher = MATCHERS["mutual_ratio"]()
    real, _ = matcher.match(matcher.prepare(a.keypoints), matcher.prepare_second(b.keypoints))
    given = match_looks(
        DistinctLooks.of(a.appearance), DistinctLooks.of(b.appearance), 0.65, np.random.default_rng(0)
    )
    right = [float(np.mean(a.landmarks[m[:, 0]] == b.landmarks[m[:, 1]])) for m in (real, given)]
    assert 0.6 < len(given) / len(real) < 1.6
    assert min(right) > 0.7
    assert abs(right[0] - right[1]) < 0.12


def test_strangers_match_by_look_alikes_only() -> None:
    survey = AerialSurvey(400, 0)
    a, b = sight(survey, 0, 0), sight(survey, 399, 0)
    assert not set(a.landmarks[a.landmarks >= 0]) & set(b.landmarks)
    assert (
        3
        < len(
            match_looks(
                DistinctLooks.of(a.appearance),
                DistinctLooks.of(b.appearance),
                0.65,
                np.random.default_rng(0),
            )
        )
        < 60
    )


def test_houses_hide_what_lies_behind_them() -> None:
    survey = StreetSurvey(400, 0)
    survey.centers = np.array([[20.0, 0.0, 2.0]])
    points = np.array([[20.0, 6.0, 3.0], [20.0, 34.0, 3.0], [29.0, -6.0, 1.0]])
    assert survey.hidden(0, points).tolist() == [False, True, False]


def test_pairs_are_those_most_alike_and_one_stranger() -> None:
    pairs = np.array([[0, 1], [0, 2], [0, 3], [0, 4], [0, 5], [1, 2]])
    near = np.array([True, True, True, False, False, True])
    chosen = choose_partners(pairs, near, np.array([5, 9, 7, 2, 3, 0]), 6, 1)
    # 0 takes 2, 1 and 3 take 0, the stranger most alike is 5, whose only stranger is 0; 4 has 0 alone
    assert pairs[chosen].tolist() == [[0, 1], [0, 2], [0, 3], [0, 4], [0, 5]]


def test_candidates_hold_all_neighbours() -> None:
    survey = AerialSurvey(150, 1)
    pairs, near = candidate_pairs(survey, 1)
    np.testing.assert_array_equal(pairs[near], survey.neighbours())
    assert (pairs[:, 0] < pairs[:, 1]).all()
    assert 0.5 < (~near).sum() / (8 * 150) < 1.0


def test_edges_err_as_their_covariances_say() -> None:
    survey = AerialSurvey(200, 2)
    rng = np.random.default_rng(0)
    squares = []
    for i, j in survey.neighbours()[:400].tolist():
        ids = rng.integers(1 << 52, 1 << 53, 100)
        edge = simulate_edge(survey, (i, j), (ids, ids), 0.5, 0)
        assert edge is not None and edge.is_true
        true = survey.rotations[j] @ survey.rotations[i].T
        squares.append(float(angle_of(edge.rotation @ true.T)) ** 2 / edge.covariance[0, 0])
    assert 2.6 < np.mean(squares) < 3.4


def test_copies_give_a_consistent_wrong_pose() -> None:
    survey = AerialSurvey(400, 5, copied=1.0)
    survey.patterns = 1
    a, b = (sight(survey, image, 5, descriptors=False) for image in (0, 399))
    # one cell of each image, all cells being copies of one pattern
    rows = []
    for found in (a, b):
        cells = found.landmarks // LANDMARKS_PER_CELL
        kinds, counts = np.unique(cells[cells >= 0], return_counts=True)
        rows.append(np.flatnonzero(cells == kinds[counts.argmax()]))
    matches = match_looks(
        DistinctLooks.of(a.appearance[rows[0]]),
        DistinctLooks.of(b.appearance[rows[1]]),
        1.0,
        np.random.default_rng(0),
    )
    shown = a.landmarks[rows[0]][matches[:, 0]], b.landmarks[rows[1]][matches[:, 1]]
    edge = simulate_edge(survey, (0, 399), shown, 0.5, 5)
    assert edge is not None and not edge.is_true
    assert edge.inliers.sum() >= 15 and edge.inliers.mean() > 0.9
    # the rotation is that of the images all the same: copies are moved, not turned
    true = survey.rotations[399] @ survey.rotations[0].T
    assert float(angle_of(edge.rotation @ true.T)) < 8 * np.sqrt(edge.covariance[0, 0])


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    """One scene of 40 images cut into 1 and into 3 blocks."""
    folders = {blocks: tmp_path_factory.mktemp("scenes") / "field" for blocks in (1, 3)}
    for blocks, folder in folders.items():
        Simulation(folder, SimulationOptions(40, until="estimate_two_view", blocks=blocks)).run()
    return folders


def by_pair(folder: Path, stage: str, kind: type, column: str) -> dict[tuple[int, int], np.ndarray]:
    found = {}
    for path in sorted((folder / "results" / "field" / stage).glob("*.h5")):
        content = kind.read(path)
        for row, pair in enumerate(content.pairs.tolist()):
            values = getattr(content, column)
            part = slice(*content.offsets[row : row + 2]) if len(values) != len(content.pairs) else row
            found[tuple(pair)] = values[part]
    return found


@pytest.mark.parametrize(
    ("stage", "kind", "column"),
    [("match_pairs", PairMatches, "matches"), ("estimate_two_view", TwoViewGeometries, "rotations")],
)
def test_blocks_play_no_part(scenes: dict[int, Path], stage: str, kind: type, column: str) -> None:
    one, three = (by_pair(scenes[blocks], stage, kind, column) for blocks in (1, 3))
    assert one.keys() == three.keys()
    assert len(one) > 200
    for pair, values in one.items():
        np.testing.assert_array_equal(values, three[pair])


def test_equal_options_give_equal_bytes(scenes: dict[int, Path], tmp_path: Path) -> None:
    folder = tmp_path / "field"
    Simulation(folder, SimulationOptions(40, until="estimate_two_view", blocks=3)).run()
    files = sorted(path.relative_to(folder) for path in folder.rglob("*.h5"))
    assert len(files) == 2 + 3 + 3 * 6
    for file in files:
        assert (folder / file).read_bytes() == (scenes[3] / file).read_bytes(), file


def test_truth_names_the_landmark_of_every_keypoint(scenes: dict[int, Path]) -> None:
    folder = scenes[3] / "results" / "field"
    index = ImageIndex.read(folder / "index_images" / "index.h5")
    for block in range(3):
        features = LocalFeatures.read(folder / "extract_features" / f"{block}.h5")
        with np.load(scenes[3] / "truth" / f"{block}.npz") as truth:
            np.testing.assert_array_equal(truth["offsets"], features.offsets)
            assert len(truth["landmarks"]) == len(features.keypoints)
        assert (index.blocks[features.image_ids] == block).all()
        assert features.descriptors.shape[1] == 0


def test_memory_does_not_grow_with_the_number_of_blocks(tmp_path: Path) -> None:
    peaks = []
    for images, blocks in ((24, 2), (72, 6)):
        simulation = Simulation(tmp_path / str(images), SimulationOptions(images, blocks=blocks))
        simulation.write_inputs()
        sight(simulation.survey, 0, 0)
        tracemalloc.start()
        for block in range(blocks):
            simulation.write_features(block)
        peaks.append(tracemalloc.get_traced_memory()[1] / np.bincount(simulation.block_of).max())
        tracemalloc.stop()
    # per image of the largest block; cells that are kept for reuse may add a little
    assert 0.6 < peaks[1] / peaks[0] < 1.4


def test_a_reference_that_the_disk_has_no_room_for_is_no_success(tmp_path: Path, monkeypatch) -> None:
    cut_references(monkeypatch, "write_binary", "images.bin")
    with pytest.raises(OSError, match="No space left"):
        main([str(tmp_path / "new"), "--images", "10"])


def test_a_folder_in_use_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "photo.jpg").touch()
    assert main([str(tmp_path), "--images", "10"]) == 1
    assert "is not empty: choose a new folder" in capsys.readouterr().err
    assert main([str(tmp_path / "new"), "--images", "10", "--survey", "street"]) == 1
    assert "at least 320 images" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--seed", "--blocks"])
@pytest.mark.parametrize("value", ["-1", "1.5"])
def test_numbers_that_are_none_are_refused(
    option: str, value: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as caught:
        main([str(tmp_path / "new"), "--images", "10", option, value])
    assert caught.value.code == 2
    assert f"{option}: '{value}' is not a whole number: give 0 or more" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_a_focal_length_is_not_unknown_where_relative_poses_are_known(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--images", "10", "--keypoints", "200", "--unknown-focal", "--until"]
    assert main([str(tmp_path / "new"), *arguments, "estimate_two_view"]) == 1
    assert "end with --until match_pairs." in capsys.readouterr().err
    assert not (tmp_path / "new").exists()
    assert main([str(tmp_path / "new"), *arguments, "match_pairs"]) == 0
    written = tmp_path / "new" / "results" / "new"
    assert ImageIndex.read(written / "index_images" / "index.h5").camera_sources.tolist() == ["default"]
    assert not (written / "calibrate_cameras").exists()
