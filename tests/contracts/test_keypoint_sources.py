"""What everything must do that knows keypoints by the image's name, and the points of the oracle 'virtual'."""

from typing import Any, ClassVar

import h5py
import numpy as np
import pytest
from known_model import SIZE, synthesize_model

from snakesfm.artifacts.hloc import write_hloc_features
from snakesfm.features.keypoints import KeypointSource
from snakesfm.features.virtual import VirtualKeypoints
from snakesfm.features.virtual_points import ObservedPoints, SurfacePoints, ViewPoints
from snakesfm.hloc_files import FEATURES
from snakesfm.stages.extract_features import ImportedKeypoints

COLUMNS = ("keypoints", "descriptors", "scores", "scales", "angles")


@pytest.fixture(scope="module")
def model():
    return synthesize_model()


class KeypointSourceContract:
    """Inherit, set ``method``, and give a source and the names of images of which it knows keypoints."""

    method = ""

    @pytest.fixture
    def source(self):
        raise NotImplementedError

    @pytest.fixture
    def names(self):
        raise NotImplementedError

    def test_has_what_extraction_asks_of_it(self, source):
        assert isinstance(source, KeypointSource)
        assert source.descriptor_size > 0 and source.usual_keypoints >= 0

    def test_keypoints_lie_in_their_images(self, source, names):
        for name in names:
            found = source.read(name, SIZE)
            count = len(found)
            assert count > 20 and found.image_size == SIZE
            assert found.keypoints.shape == (count, 2) and found.keypoints.dtype == np.float32
            assert (found.keypoints >= 0).all() and (found.keypoints <= SIZE).all()
            assert found.descriptors.shape == (count, source.descriptor_size)
            assert found.descriptors.dtype == source.descriptor_dtype
            for column in (found.scores, found.scales, found.angles):
                assert column.shape == (count,) and column.dtype == np.float32
                assert np.isfinite(column).all()
            assert (found.scales > 0).all()

    def test_an_image_that_it_does_not_know_has_none(self, source):
        found = source.read("unknown.jpg", SIZE)
        assert found.keypoints.shape == (0, 2) and found.keypoints.dtype == np.float32
        assert found.descriptors.shape == (0, source.descriptor_size)
        assert found.descriptors.dtype == source.descriptor_dtype

    def test_an_image_does_not_depend_on_the_images_before_it(self, source, names):
        expected, other = source.read(names[0], SIZE), source.read(names[1], SIZE)
        again = source.read(names[0], SIZE)
        for column in COLUMNS:
            np.testing.assert_array_equal(getattr(again, column), getattr(expected, column))
        assert not np.array_equal(other.keypoints, expected.keypoints)

    def test_keypoints_are_in_the_pixels_of_the_image_that_is_asked_for(self, source, names):
        whole, half = (source.read(names[0], size) for size in (SIZE, (SIZE[0] // 2, SIZE[1] // 2)))
        np.testing.assert_allclose(half.keypoints, whole.keypoints / 2, atol=1e-3)
        np.testing.assert_array_equal(half.descriptors, whole.descriptors)
        assert half.image_size == (SIZE[0] // 2, SIZE[1] // 2)


class VirtualContract(KeypointSourceContract):
    """Set ``options``: which points are projected."""

    method = "virtual"
    options: ClassVar[dict[str, int]] = {}

    @pytest.fixture
    def source(self, model):
        return VirtualKeypoints(model, **self.options)

    @pytest.fixture
    def names(self, model):
        return sorted(image.name for image in model.images.values())


class TestVirtual(VirtualContract):
    pass


class TestVirtualOfViews(VirtualContract):
    options: ClassVar = {"view_points": 40}


@pytest.mark.usefixtures("open3d")
class TestVirtualOnASurface(VirtualContract):
    options: ClassVar = {"surface_points": 400}


class TestImported(KeypointSourceContract):
    """hloc's features, of images of the size that hloc saw."""

    method = "imported"

    @pytest.fixture
    def names(self):
        return ["a/1.jpg", "b.jpg", "c.jpg"]

    @pytest.fixture
    def source(self, names, tmp_path):
        rng = np.random.default_rng(0)
        with h5py.File(tmp_path / FEATURES, "w") as file:
            for name in names:
                columns = {
                    "keypoints": rng.uniform(1, np.array(SIZE) - 1, (40, 2)),
                    "descriptors": rng.normal(size=(40, 16)),
                    "scores": rng.uniform(size=40),
                    "scales": rng.uniform(1, 9, 40),
                    "angles": rng.uniform(-3, 3, 40),
                }
                write_hloc_features(file, name, columns, SIZE)
        return ImportedKeypoints(tmp_path / FEATURES)


class PointSourceContract:
    """Inherit and set ``kind`` and its ``arguments`` beside the model."""

    kind: Any = None
    arguments: ClassVar[tuple[int, ...]] = ()

    @pytest.fixture
    def source(self, model):
        return self.kind(model, *self.arguments)

    def test_points_have_numbers_places_and_scores(self, source, model):
        for image in model.images.values():
            ids, places, scores = source.seen_by(image)
            assert len(ids) > 20
            assert ids.dtype == np.uint32 and len(np.unique(ids)) == len(ids)
            assert places.shape == (len(ids), 3) and places.dtype == np.float64
            assert scores.shape == (len(ids),) and scores.dtype == np.float32
            assert np.isfinite(places).all() and np.isfinite(scores).all()

    def test_a_number_is_of_the_same_place_in_all_images(self, source, model):
        known, shared = {}, 0
        for image in model.images.values():
            ids, places, _ = source.seen_by(image)
            for number, place in zip(ids.tolist(), map(tuple, places.tolist()), strict=True):
                shared += number in known
                assert known.setdefault(number, place) == place
        assert shared > 10 and len(set(known.values())) == len(known)

    def test_is_deterministic(self, source, model):
        again = self.kind(model, *self.arguments)
        for image in model.images.values():
            for one, other in zip(source.seen_by(image), again.seen_by(image), strict=True):
                np.testing.assert_array_equal(one, other)


class TestObservedPoints(PointSourceContract):
    kind = ObservedPoints


class TestViewPoints(PointSourceContract):
    kind = ViewPoints
    arguments = (40,)


@pytest.mark.usefixtures("open3d")
class TestSurfacePoints(PointSourceContract):
    kind = SurfacePoints
    arguments = (400,)
