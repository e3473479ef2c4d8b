"""Steps in altitudes, as of barometers that start anew with every battery."""

from dataclasses import dataclass

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from snakesfm.export.altitude_steps import altitude_steps
from snakesfm.export.georeference import STEP_ROUNDS, Georeference, georeference, taking_order
from snakesfm.geometry.earth import local_origin

ORIGIN = (41.0, -83.0, 300.0)


def grid(columns: int, lines: int) -> np.ndarray:
    """Centres (columns lines,3) in metres along lines that are flown to and fro."""
    x, y = np.meshgrid(25.0 * np.arange(columns), 30.0 * np.arange(lines))
    x[1::2] = x[1::2, ::-1]
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])


def flight(rng: np.random.Generator) -> np.ndarray:
    """Centres (63,3) of seven lines."""
    return grid(9, 7) + rng.normal(size=(63, 3)) * 0.5


def tilted(centers: np.ndarray, degrees: float) -> np.ndarray:
    return centers @ Rotation.from_euler("x", degrees, degrees=True).as_matrix().T


@pytest.mark.parametrize(
    ("places", "heights"),
    [([32], [15.0]), ([32], [-6.0]), ([20, 44], [15.0, -20.0]), ([14, 30, 47], [12.0, 12.0, -9.0])],
)
@pytest.mark.parametrize("seed", range(5))
def test_steps_are_found_though_they_tilted_the_model(places, heights, seed):
    rng = np.random.default_rng(seed)
    centers = flight(rng)
    altitudes = centers[:, 2] + rng.normal(size=63) * 0.3
    for place, height in zip(places, heights, strict=True):
        altitudes[place:] += height
    # one image without a fix
    altitudes[7] -= 281.0
    found = altitude_steps(tilted(centers, 6.0), altitudes)
    assert [place for place, _ in found] == places
    assert [height for _, height in found] == pytest.approx(heights, abs=0.9)


def altitudes_without_steps(kind: str, centers: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    time = np.linspace(0.0, 1.0, len(centers))
    noise = rng.normal(size=len(centers))
    return (
        centers[:, 2]
        + {
            "accurate": 0.3 * noise,
            "plain": 3.0 * noise,
            "poor": 8.0 * noise,
            "wandering": 0.3 * noise + np.cumsum(rng.normal(size=len(centers)) * 0.2),
            "steady drift": 0.3 * noise + 20.0 * time,
            "ever slower drift": 0.3 * noise + 8.0 * (1.0 - np.exp(-4.0 * time)),
            "bowl": 0.3 * noise + 3e-4 * ((centers[:, :2] - centers[:, :2].mean(axis=0)) ** 2).sum(axis=1),
        }[kind]
    )


@pytest.mark.parametrize(
    "kind",
    ["accurate", "plain", "poor", "wandering", "steady drift", "ever slower drift", "bowl"],
)
@pytest.mark.parametrize("heights", [1, 2])
def test_noise_drift_and_flights_at_two_heights_are_no_steps(kind, heights):
    for seed in range(60):
        rng = np.random.default_rng(seed)
        centers = flight(rng)
        if heights == 2:
            centers = np.vstack([centers, flight(rng)[:, [1, 0, 2]] + [8.0, 3.0, 50.0]])
        altitudes = altitudes_without_steps(kind, centers, rng)
        assert altitude_steps(tilted(centers, rng.uniform(0.0, 3.0)), altitudes) == []


@pytest.mark.parametrize("height", [6.0, 15.0, 30.0, -60.0])
def test_a_model_is_level_though_the_second_battery_starts_at_another_altitude(height):
    rng = np.random.default_rng(5)
    local = flight(rng)
    noisy = local + rng.normal(size=local.shape) * [0.5, 0.5, 0.3]
    noisy[35:, 2] += height
    turn = Rotation.random(random_state=1).as_matrix()
    gps = pycolmap.GPSTransform().enu_to_ellipsoid(noisy, *ORIGIN)
    # as files are sorted, not as they were taken
    names = [f"day {row // 40 + 9}/DJI_{row}.JPG" for row in range(63)]
    given = np.array(sorted(range(63), key=names.__getitem__))
    sources, gps, names = 0.1 * (local @ turn)[given], gps[given], [names[row] for row in given]
    order = taking_order(names)
    found = georeference(sources, np.zeros((63, 3)), gps, local_origin(gps), order, 0)
    up = found.local_from_model.rotation @ turn.T @ [0.0, 0.0, 1.0]
    assert np.degrees(np.arccos(min(up[2], 1.0))) < 0.5
    assert found.trusted and found.inliers >= 61
    assert 0.4 < found.median_horizontal_m < 0.9 and 0.1 < found.median_vertical_m < 0.4
    assert found.median_horizontal_m < found.median_residual_m < 1.0
    (step,) = found.summary(names)["altitude_steps"]
    assert step["from_image"] == "day 9/DJI_35.JPG"
    assert step["metres"] == pytest.approx(height, abs=0.6)
    (sentence,) = found.warnings(names)
    assert f"{step['metres']:+.1f} m from 'day 9/DJI_35.JPG' on" in sentence
    # heights are those of the first 35, the longer part
    moved = found.local_from_model.transform_points(sources)[:, 2] + found.origin[2]
    np.testing.assert_allclose(np.median(moved), ORIGIN[2], atol=0.5)


@dataclass(frozen=True)
class Survey:
    """Centres and altitudes of a grid of lines, each in metres, and what the model makes of the centres."""

    local: np.ndarray
    model: np.ndarray
    errors: np.ndarray


def batteries(
    rng: np.random.Generator, count: int, images: int, sigma: float, drift: float = 0.0
) -> Survey:
    """A survey in which each battery starts at an altitude of its own and drifts by as much as the others."""
    lines = round(images**0.5)
    local = grid(images // lines, lines) + rng.normal(size=(images // lines * lines, 3)) * 0.5
    ends = np.linspace(0, len(local), count + 1).astype(int)
    errors = rng.normal(size=local.shape) * [0.5, 0.5, 0.3]
    for start, end, offset in zip(ends, ends[1:], rng.normal(size=count) * sigma, strict=False):
        errors[start:end, 2] += offset + drift * np.linspace(0.0, 1.0, end - start)
    return Survey(local, local, errors)


def waves(rng: np.random.Generator, periods: int, amplitude: float) -> Survey:
    """A model of level lines that is bent across them."""
    local = grid(20, 10) + rng.normal(size=(200, 3)) * 0.5
    phase = local[:, 1] / np.ptp(local[:, 1]) * 2.0 * np.pi * periods
    bent = local + np.sin(phase)[:, None] * [0.0, 0.0, amplitude]
    return Survey(local, bent, rng.normal(size=local.shape) * [0.5, 0.5, 0.3])


def tilts(survey: Survey, monkeypatch: pytest.MonkeyPatch) -> tuple[float, float, Georeference]:
    """Degrees by which the georeferenced model leans, before and after the search for steps; and its result."""
    turn = Rotation.random(random_state=1).as_matrix()
    gps = pycolmap.GPSTransform().enu_to_ellipsoid(survey.local + survey.errors, *ORIGIN)
    leans = []
    for rounds in (0, STEP_ROUNDS):
        monkeypatch.setattr("snakesfm.export.georeference.STEP_ROUNDS", rounds)
        rows = np.arange(len(gps))
        found = georeference(
            0.1 * survey.model @ turn, np.zeros((len(gps), 3)), gps, local_origin(gps), rows, 0
        )
        up = found.local_from_model.rotation @ turn.T @ [0.0, 0.0, 1.0]
        leans.append(float(np.degrees(np.arccos(min(up[2], 1.0)))))
    return leans[0], leans[1], found


@pytest.mark.parametrize(
    ("count", "images", "sigma", "least_gain"),
    [
        (2, 1000, 5.0, 0.3),
        (4, 1000, 5.0, 0.3),
        (8, 1000, 5.0, 0.0),
        (8, 1000, 10.0, 0.5),
        (12, 1000, 10.0, -0.02),
        (16, 1000, 5.0, -0.02),
        (16, 1000, 10.0, -0.02),
    ],
)
def test_a_model_leans_no_more_without_the_steps_of_many_batteries(
    count, images, sigma, least_gain, monkeypatch
):
    gains = []
    for seed in range(8):
        survey = batteries(np.random.default_rng(seed), count, images, sigma)
        before, after, found = tilts(survey, monkeypatch)
        assert after <= before + 0.1
        assert not (found.altitude_steps and found.doubtful_steps)
        gains.append(before - after)
    assert least_gain <= np.mean(gains) < 1.5


@pytest.mark.parametrize(
    "make",
    [
        lambda rng: waves(rng, 1, 8.0),
        lambda rng: waves(rng, 2, 6.0),
        lambda rng: batteries(rng, 2, 200, 0.0, drift=15.0),
        lambda rng: batteries(rng, 8, 1000, 0.0, drift=15.0),
    ],
    ids=["one wave", "two waves", "two drifts", "eight drifts"],
)
@pytest.mark.parametrize("seed", range(3))
def test_steps_that_may_be_a_drift_or_a_bent_model_are_left_in_and_told(make, seed, monkeypatch):
    before, after, found = tilts(make(np.random.default_rng(seed)), monkeypatch)
    assert after == pytest.approx(before, abs=0.01)
    assert found.altitude_steps == () and 1 <= len(found.doubtful_steps) <= 10
    names = [f"DJI_{row}.JPG" for row in range(1000)]
    (sentence,) = found.warnings(names)
    assert f"(first 'DJI_{found.doubtful_steps[0]}.JPG')" in sentence and "may be tilted" in sentence
