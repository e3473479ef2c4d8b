"""What every translation averager must do; each implementation inherits the suite."""

from typing import ClassVar

import numpy as np
import pytest

from snakesfm.config.average_translations import AverageTranslationsOptions
from snakesfm.stages.average_translations import translation_averager
from snakesfm.synthetic.problems import make_problem, perturb_rotations
from snakesfm.translation_averaging.averagers import with_rays
from snakesfm.translation_averaging.problem import PositioningProblem, edge_directions, world_rays


def positioning_problem(problem, rotations=None, min_length=3):
    rotations = problem.rotations if rotations is None else rotations
    lengths = np.diff(problem.track_offsets)
    rows = np.repeat(lengths >= min_length, lengths)
    images = problem.track_image_ids[rows].astype(np.int64)
    normalized = problem.cameras[0].normalize(problem.track_keypoints[rows])
    whole = PositioningProblem(
        image_count=problem.image_count,
        pairs=problem.pairs.astype(np.int64),
        directions=edge_directions(rotations, problem.pairs, problem.edge_translations),
        sigmas_rad=np.sqrt(problem.edge_covariances[:, 3, 3]),
        ray_images=images,
        ray_tracks=np.repeat(np.arange(len(lengths)), lengths)[rows],
        rays=world_rays(rotations, images, normalized),
    )
    return with_rays(whole, AverageTranslationsOptions().rays_per_camera)


def noisy_street():
    """A problem that magnifies what differs between two runs."""
    truth = make_problem(40, 1600, "street", 1.0, 0.1, 0.3, 0.1, seed=2)
    return positioning_problem(truth, perturb_rotations(truth.rotations, 0.2, 3))


def center_errors(estimated, truth):
    """Distances after scale and shift only: the frame of the rotations must be kept."""
    known = np.isfinite(estimated[:, 0])
    a = estimated[known] - np.median(estimated[known], axis=0)
    b = truth[known] - np.median(truth[known], axis=0)
    scale = np.sum(a * b) / np.sum(a * a)
    assert scale > 0
    shift = np.median(b - scale * a, axis=0)
    return np.linalg.norm(scale * a + shift - b, axis=1)


class TranslationAveragerContract:
    """Inherit and set ``method``, and ``options`` where they are not the defaults."""

    method = ""
    options: ClassVar[dict[str, str]] = {}
    same_tolerance = 0.0

    @property
    def averager(self):
        return translation_averager(AverageTranslationsOptions(method=self.method, **self.options))

    @pytest.mark.parametrize("layout", ["ring", "area", "facade"])
    def test_exact_directions_give_exact_centers(self, layout):
        truth = make_problem(20, 800, layout, noise_px=0.0, rotation_noise_deg=0.0)
        centers = self.averager.position(positioning_problem(truth), 0)
        assert centers.shape == (20, 3)
        assert center_errors(centers, truth.centers).max() < 1e-5

    def test_noise_and_outliers_give_errors_of_their_size(self):
        truth = make_problem(25, 1200, "area", 1.0, 0.1, 0.3, 0.1, seed=2)
        problem = positioning_problem(truth, perturb_rotations(truth.rotations, 0.2, 3))
        errors = center_errors(self.averager.position(problem, 0), truth.centers)
        assert 1e-3 < np.median(errors) < 0.045
        assert errors.max() < 0.12

    def test_images_outside_the_problem_stay_without_center(self):
        truth = make_problem(15, 800, "area", noise_px=0.1)
        problem = positioning_problem(truth)
        inside = problem.select_edges((problem.pairs != 14).all(axis=1)).select_rays(
            problem.ray_images != 14
        )
        centers = self.averager.position(inside, 0)
        assert np.isnan(centers[14]).all()
        assert np.isfinite(centers[:14]).all()

    def test_same_seed_same_result(self):
        problem = noisy_street()
        one, two = self.averager.position(problem, 7), self.averager.position(problem, 7)
        if self.same_tolerance:
            assert center_errors(two, one).max() <= self.same_tolerance * np.ptp(one, axis=0).max()
        else:
            assert np.array_equal(one, two, equal_nan=True)


class TestScaleChain(TranslationAveragerContract):
    method = "scale_chain"


class TestTranslationRecovery(TranslationAveragerContract):
    method = "translation_recovery"


class TestTranslationRecoveryMfas(TranslationAveragerContract):
    method = "translation_recovery"
    options: ClassVar = {"reject_outliers": "mfas"}


class TestTranslationRecoveryNone(TranslationAveragerContract):
    method = "translation_recovery"
    options: ClassVar = {"reject_outliers": "none"}


class TestGlobalPositioning(TranslationAveragerContract):
    method = "global_positioning"
    same_tolerance = 1e-3

    def test_another_seed_differs_by_more_than_two_runs_of_one(self):
        problem = noisy_street()
        one, other = self.averager.position(problem, 7), self.averager.position(problem, 8)
        assert center_errors(other, one).max() > self.same_tolerance * np.ptp(one, axis=0).max()
