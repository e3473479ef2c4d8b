"""What every survey of simulated scenes must do."""

from typing import ClassVar

import numpy as np
import pytest

from snakesfm.synthetic.sightings import sight
from snakesfm.synthetic.surveys import LANDMARKS_PER_CELL, SURVEYS

COLUMNS = ("ids", "points", "normals", "sizes", "repeatability", "appearance")


class SurveyContract:
    """Inherit and set ``name``, and the ``count`` of images."""

    name = ""
    count = 100
    made: ClassVar[dict] = {}

    def make(self, seed=3):
        return SURVEYS[self.name](self.count, seed)

    @pytest.fixture
    def survey(self):
        if self.name not in self.made:
            self.made[self.name] = self.make()
        return self.made[self.name]

    def test_every_image_has_a_name_and_a_pose(self, survey):
        assert survey.names == sorted(set(survey.names)) and len(survey.names) == self.count
        assert survey.centers.shape == (self.count, 3) and np.isfinite(survey.centers).all()
        assert survey.rotations.shape == (self.count, 3, 3)
        products = survey.rotations @ survey.rotations.transpose(0, 2, 1)
        np.testing.assert_allclose(products, np.broadcast_to(np.eye(3), products.shape), atol=1e-9)
        np.testing.assert_allclose(np.linalg.det(survey.rotations), 1.0, atol=1e-9)
        assert survey.reach_m > 0 and survey.depth_m > 0 and 0 < survey.min_cosine < 1
        assert survey.camera.width > 0 and survey.camera.focal_px > 0

    def test_neighbours_are_proper_sorted_and_distinct_pairs(self, survey):
        pairs = survey.neighbours()
        assert (pairs[:, 0] < pairs[:, 1]).all() and pairs.min() >= 0 and pairs.max() < self.count
        assert (np.diff(pairs[:, 0] * self.count + pairs[:, 1]) > 0).all()
        assert len(np.unique(pairs)) == self.count
        # not all see the same
        assert len(pairs) < self.count * (self.count - 1) // 2

    def test_an_image_shares_landmarks_with_a_neighbour_and_hardly_any_with_the_farthest(self, survey):
        image = 17
        distances = np.linalg.norm(survey.centers - survey.centers[image], axis=1)
        pairs = survey.neighbours()
        mine = pairs[(pairs == image).any(axis=1)].sum(axis=1) - image
        alike = survey.rotations[mine, 2] @ survey.rotations[image, 2] > 0.9
        nearest, farthest = mine[alike][np.argmin(distances[mine[alike]])], np.argmax(distances)
        assert farthest not in mine
        seen = [
            set(sight(survey, int(one), 3, descriptors=False).landmarks.tolist()) - {-1}
            for one in (image, nearest, farthest)
        ]
        shared = len(seen[0] & seen[1])
        assert shared > 20 and len(seen[0] & seen[2]) < 0.1 * shared

    def test_landmarks_have_the_promised_columns(self, survey):
        found = survey.near(self.count // 2)
        count = len(found.ids)
        assert count > 1000 and len(np.unique(found.ids)) == count and (found.ids >= 0).all()
        assert found.ids.dtype == np.int64 and found.appearance.dtype == np.uint64
        assert found.points.shape == found.normals.shape == (count, 3)
        assert np.isfinite(found.points).all()
        np.testing.assert_allclose(np.linalg.norm(found.normals, axis=1), 1.0, atol=1e-9)
        for column in (found.sizes, found.repeatability, found.appearance):
            assert column.shape == (count,)
        assert (found.sizes > 0).all()
        assert (found.repeatability >= 0).all() and (found.repeatability <= 1).all()

    def test_a_landmark_is_the_same_for_all_images(self, survey):
        i, j = survey.neighbours()[0]
        one, other = survey.near(int(i)), survey.near(int(j))
        _, rows, others = np.intersect1d(one.ids, other.ids, return_indices=True)
        assert len(rows) > 0
        for column in COLUMNS:
            np.testing.assert_array_equal(getattr(one, column)[rows], getattr(other, column)[others])

    def test_landmarks_of_a_cell_have_one_origin_and_no_other_has_it(self, survey):
        ids = survey.near(self.count // 2).ids
        cells = ids // LANDMARKS_PER_CELL
        origins = survey.cell_origins(ids)
        assert origins.shape == (len(ids), 3) and np.isfinite(origins).all()
        both = np.unique(np.column_stack([cells, origins]), axis=0)
        assert len(both) == len(np.unique(cells)) == len(np.unique(origins, axis=0)) > 1
        assert np.isnan(survey.cell_origins(np.array([-1, ids[0]]))[0]).all()

    def test_something_is_not_hidden(self, survey):
        image = self.count // 2
        points = survey.near(image).points
        hidden = survey.hidden(image, points)
        assert hidden.shape == (len(points),) and hidden.dtype == bool
        assert not hidden.all()
        assert survey.hidden(image, points[:0]).shape == (0,)

    def test_all_depends_on_the_seed_alone(self, survey):
        again, other = self.make(), self.make(seed=4)
        again.near(0)
        image = self.count // 2
        for column in COLUMNS:
            np.testing.assert_array_equal(
                getattr(again.near(image), column), getattr(survey.near(image), column)
            )
        for column in ("centers", "rotations"):
            np.testing.assert_array_equal(getattr(again, column), getattr(survey, column))
            assert not np.array_equal(getattr(other, column), getattr(survey, column))
        assert not np.array_equal(other.near(image).sizes, survey.near(image).sizes)


class TestAerial(SurveyContract):
    name = "aerial"


class TestStreet(SurveyContract):
    name = "street"
    count = 400
