"""The detectors that are networks, with their real weights."""

from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
from contracts.test_detectors import DetectorContract, extract, shapes
from extras import import_extra

from snakesfm.errors import ConfigError
from snakesfm.features.extraction import DETECTORS, extract_keypoints
from snakesfm.learned.checkpoints import read_checkpoint


def same_keypoints(one, other):
    """The same keypoints to rounding."""
    assert one.image_size == other.image_size
    np.testing.assert_allclose(one.keypoints, other.keypoints, atol=2e-3)
    np.testing.assert_allclose(one.scores, other.scores, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(one.descriptors, other.descriptors, atol=2e-3)


class LearnedDetectorContract(DetectorContract):
    picture = staticmethod(shapes)
    detectors: ClassVar[dict] = {}
    size = 128
    score_name = "keypoint_scores"
    seen_size: tuple[int, int] | None = None

    @pytest.fixture
    def detector(self, weights):
        if self.method not in self.detectors:
            state = read_checkpoint(self.method, weights, "fetch")
            self.detectors[self.method] = DETECTORS[self.method](state=state)
        return self.detectors[self.method]

    def test_descriptors_are_of_unit_length(self, detector):
        found = extract(detector, *shapes(), 300, 760)
        lengths = np.linalg.norm(found.descriptors.astype(np.float64), axis=1)
        np.testing.assert_allclose(lengths, 1, atol=2e-3)

    def test_the_first_pixel_has_its_centre_at_a_half(self, detector, monkeypatch):
        # a network's pixel (i, j) is (i + .5, j + .5), and larger where the network sees a smaller image
        pixels = np.array([[0, 0], [7, 3], [90, 60]], np.float32)
        width, height = 200, 150
        seen = np.array(self.seen_size or (width, height))
        monkeypatch.setattr(detector, "_network", self.fake(pixels * [width, height] / seen))
        found = detector.detect(*shapes(width, height), 50)
        np.testing.assert_allclose(found.keypoints, (pixels + 0.5) * [width, height] / seen, rtol=1e-6)

    def fake(self, pixels):
        """A network that finds just these pixels, in its own convention."""
        import torch

        tensors = {
            "keypoints": torch.tensor(pixels, dtype=torch.float32),
            "descriptors": torch.ones(len(pixels), self.size),
            self.score_name: torch.ones(len(pixels)),
        }
        return lambda *_, **__: [SimpleNamespace(**tensors)]

    def test_a_batch_gives_what_single_images_give_in_any_order(self, detector):
        sizes = [(200, 150), (160, 224), (200, 150), (200, 150)]
        images = [shapes(*size, seed=seed) for seed, size in enumerate(sizes)]
        images[2] = (np.full_like(images[2][0], 9), np.full_like(images[2][1], 9))
        apart = [extract(detector, *image, 100, 760) for image in images]
        assert len(apart[2]) == 0 and min(len(apart[row]) for row in (0, 1, 3)) > 30
        for order in ([0, 1, 2, 3], [3, 2, 1, 0]):
            together = extract_keypoints(detector, [images[row] for row in order], 100, 760)
            for row, found in zip(order, together, strict=True):
                same_keypoints(found, apart[row])

    def test_random_weights_run_through(self, weights):
        found = DETECTORS[self.method](state=None).detect(*shapes(64, 96), 50)
        assert found.descriptors.dtype == np.float16
        assert found.keypoints.shape == (len(found), 2)

    def test_weights_of_another_network_are_refused(self, weights):
        other = "disk" if self.method != "disk" else "xfeat"
        with pytest.raises(ConfigError, match="fetch the right ones"):
            DETECTORS[self.method](state=read_checkpoint(other, weights, "fetch"))


class TestAliked(LearnedDetectorContract):
    method = "aliked"


class TestDisk(LearnedDetectorContract):
    method = "disk"
    score_name = "detection_scores"


class TestXfeat(LearnedDetectorContract):
    method = "xfeat"
    size = 64
    seen_size = (192, 128)

    def fake(self, pixels):
        import torch

        found = {
            "keypoints": torch.tensor(pixels, dtype=torch.float32),
            "descriptors": torch.ones(len(pixels), self.size),
            "scores": torch.ones(len(pixels)),
        }
        return SimpleNamespace(detectAndCompute=lambda *_, **__: [found])


class TestSuperpointOfRandomWeights(DetectorContract):
    method = "superpoint"
    picture = staticmethod(shapes)
    made: ClassVar[list] = []

    @pytest.fixture
    def detector(self):
        import_extra("transformers")
        if not self.made:
            import torch

            torch.manual_seed(0)
            self.made.append(DETECTORS[self.method](state=None))
        return self.made[0]

    def test_the_first_pixel_has_its_centre_at_a_half(self, detector, monkeypatch):
        import torch

        pixels = torch.tensor([[8.0, 9.0], [100.0, 50.0]])
        monkeypatch.setattr(
            detector._network.keypoint_decoder, "forward", lambda encoded: (pixels, torch.ones(2))
        )
        found = detector.detect(*shapes(203, 149), 50)
        np.testing.assert_array_equal(found.keypoints, [[8.5, 9.5], [100.5, 50.5]])
        lengths = np.linalg.norm(found.descriptors.astype(np.float64), axis=1)
        np.testing.assert_allclose(lengths, 1, atol=2e-3)

    def test_a_batch_gives_what_single_images_give(self, detector):
        images = [shapes(160, 120, seed=seed) for seed in range(3)]
        together = extract_keypoints(detector, images, 100, 760)
        for image, found in zip(images, together, strict=True):
            same_keypoints(found, extract(detector, *image, 100, 760))
            assert len(found) == 100

    def test_its_weights_survive_their_file(self, detector, tmp_path):
        from safetensors.torch import save_file

        save_file(detector._network.state_dict(), tmp_path / "superpoint.safetensors")
        again = DETECTORS[self.method](state=read_checkpoint(self.method, tmp_path, "fetch"))
        one, other = (extract(d, *shapes(), 50, 760) for d in (detector, again))
        np.testing.assert_array_equal(one.descriptors, other.descriptors)
        (tmp_path / "superpoint.safetensors").write_bytes(b"damaged")
        with pytest.raises(ConfigError, match="contains no weights"):
            read_checkpoint(self.method, tmp_path, "fetch")
