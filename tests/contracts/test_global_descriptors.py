"""What every network that describes whole images must do: with small random weights, as no real ones are here."""

import cv2
import numpy as np
import pytest
from contracts.test_detectors import shapes
from extras import import_extra
from random_weights import megaloc_state, write_netvlad

from snakesfm.errors import ConfigError
from snakesfm.learned.checkpoints import read_checkpoint
from snakesfm.learned.weights import WEIGHT_FILES
from snakesfm.retrieval.descriptor import DESCRIPTORS, describe_batch


def colored(width=96, height=70, seed=3):
    return np.stack([shapes(width, height, seed=seed + part)[0] for part in range(3)], axis=2)


def describe(descriptor, image, side):
    return describe_batch(descriptor, [image], side)[0]


class GlobalDescriptorContract:
    """Inherit, set ``method`` and write weights into a folder."""

    method = ""

    def write(self, path):
        raise NotImplementedError

    @pytest.fixture
    def state(self, tmp_path):
        import_extra("torch")
        import_extra("transformers")
        self.write(tmp_path / WEIGHT_FILES[self.method].name)
        return read_checkpoint(self.method, tmp_path, "fetch")

    @pytest.fixture
    def descriptor(self, state):
        return DESCRIPTORS[self.method](state=state)

    def test_is_registered(self, descriptor):
        assert self.method in DESCRIPTORS
        assert descriptor.multiple >= 1 and descriptor.usual_side_px >= 28

    @pytest.mark.parametrize(
        "shape", [(96, 70), (70, 96), (33, 131), (28, 28), (960, 32), (20, 700), (300, 9)]
    )
    def test_vectors_are_of_unit_length(self, descriptor, shape):
        vector = describe(descriptor, colored(*shape), 112)
        assert vector.shape == (descriptor.size,) and vector.dtype == np.float32
        assert np.linalg.norm(vector) == pytest.approx(1, abs=np.sqrt(descriptor.size) / 4096)
        # products of such vectors are exact, so that pairs do not depend on the blocks
        np.testing.assert_array_equal(vector * 2048, np.rint(vector * 2048))

    def test_an_image_of_one_tone_resembles_none(self, descriptor):
        assert not describe(descriptor, np.full((40, 60, 3), 7, np.uint8), 112).any()

    def test_does_not_depend_on_the_images_before_it(self, descriptor):
        expected = describe(descriptor, colored(), 112)
        describe(descriptor, colored(60, 60, 9), 112)
        np.testing.assert_array_equal(describe(descriptor, colored(), 112), expected)

    def test_a_batch_gives_what_single_images_give_in_any_order(self, descriptor):
        flat = np.full((56, 84, 3), 7, np.uint8)
        images = [colored(84, 56, 1), colored(56, 84, 2), colored(84, 56, 5), flat, colored(84, 56, 9)]
        apart = np.stack([describe(descriptor, image, 112) for image in images])
        for order in (np.arange(5), np.array([4, 3, 2, 1, 0]), np.array([2, 0, 4])):
            together = describe_batch(descriptor, [images[row] for row in order], 112)
            np.testing.assert_allclose(together, apart[order], atol=1.01 / 2048)
        assert not apart[3].any() and np.abs(apart[0] - apart[2]).max() > 1e-3

    def test_a_brighter_copy_is_nearer_than_another_image(self, descriptor):
        image, other = colored(), colored(seed=40)
        brighter = cv2.convertScaleAbs(image, alpha=0.9, beta=15)
        vectors = [describe(descriptor, one, 112) for one in (image, brighter, other)]
        assert 1 > vectors[0] @ vectors[1] > vectors[0] @ vectors[2]

    def test_weights_of_another_network_are_refused(self, state):
        with pytest.raises(ConfigError, match="fetch the right ones"):
            DESCRIPTORS[self.method](state=dict(list(state.items())[:5]))


class TestNetvlad(GlobalDescriptorContract):
    method = "netvlad"

    def write(self, path):
        write_netvlad(path)

    def test_agrees_with_the_definition(self, descriptor, state):
        import torch

        image = colored(48, 32)
        columns = torch.from_numpy(image).permute(2, 0, 1)[None].double()
        values = {name: tensor.double() for name, tensor in state.items()}
        x = columns - values["mean"].reshape(1, 3, 1, 1)
        for place in (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28):
            if place in (5, 10, 17, 24):
                x = torch.nn.functional.max_pool2d(x, 2)
            kernel = values[f"layers.{place}.weights.0"].permute(3, 2, 0, 1)
            x = torch.nn.functional.conv2d(x, kernel, values[f"layers.{place}.weights.1"], padding=1)
            if place != 28:
                x = x.relu()
        local = x[0].flatten(1)
        local = (local / local.norm(dim=0)).numpy()
        logits = values["layers.30.weights.0"].numpy().T @ local
        shares = np.exp(logits) / np.exp(logits).sum(axis=0)
        centers = -values["layers.30.weights.1"].numpy()
        vlad = np.zeros_like(centers)
        for word in range(centers.shape[1]):
            for place in range(local.shape[1]):
                vlad[:, word] += shares[word, place] * (local[:, place] - centers[:, word])
        vlad /= np.linalg.norm(vlad, axis=0)
        flat = vlad.ravel() / np.linalg.norm(vlad)
        whitened = flat @ values["layers.33.weights.0"].numpy().reshape(len(flat), -1)
        whitened += values["layers.33.weights.1"].numpy()
        expected = whitened / np.linalg.norm(whitened)
        np.testing.assert_allclose(describe(descriptor, image, 112), expected, atol=5e-4)


class TestMegaloc(GlobalDescriptorContract):
    method = "megaloc"

    def write(self, path):
        import torch

        torch.save(megaloc_state(), path)

    def test_agrees_with_the_definition(self, descriptor, state):
        import torch
        from torch.nn import functional

        image = colored(70, 70)
        values = {name.removeprefix("backbone.model."): tensor for name, tensor in state.items()}
        mean, deviation = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
        x = ((torch.from_numpy(image).float() / 255 - mean) / deviation).permute(2, 0, 1)[None]
        x = functional.conv2d(
            x, values["patch_embed.proj.weight"], values["patch_embed.proj.bias"], stride=14
        )
        x = torch.cat([values["cls_token"], x.flatten(2).transpose(1, 2)], dim=1) + values["pos_embed"]

        def linear(x, name):
            return x @ values[f"{name}.weight"].flatten(1).T + values[f"{name}.bias"]

        def norm(x, name):
            weight, bias = values[f"{name}.weight"], values[f"{name}.bias"]
            return functional.layer_norm(x, (64,), weight, bias, 1e-6)

        for block in ("blocks.0.", "blocks.1."):
            q, k, v = linear(norm(x, f"{block}norm1"), f"{block}attn.qkv").chunk(3, dim=-1)
            attended = torch.softmax(q @ k.transpose(1, 2) / 8, dim=-1) @ v
            x = x + values[f"{block}ls1.gamma"] * linear(attended, f"{block}attn.proj")
            inner = functional.gelu(linear(norm(x, f"{block}norm2"), f"{block}mlp.fc1"))
            x = x + values[f"{block}ls2.gamma"] * linear(inner, f"{block}mlp.fc2")
        x = norm(x, "norm")[0]
        start = "aggregator.agg."
        scene = linear(linear(x[:1], f"{start}token_features.0").relu(), f"{start}token_features.2")[0]
        features = linear(linear(x[1:], f"{start}cluster_features.0").relu(), f"{start}cluster_features.3")
        scores = linear(linear(x[1:], f"{start}score.0").relu(), f"{start}score.3").T
        clusters, patches = scores.shape
        plan = torch.exp(torch.cat([scores, values[f"{start}dust_bin"].expand(1, patches)]))
        rows = torch.cat([torch.ones(clusters), torch.tensor([float(patches - clusters)])])
        for _ in range(3):
            plan = plan * (rows / plan.sum(dim=1))[:, None]
            plan = plan / plan.sum(dim=0)
        summed = functional.normalize(features.T @ plan[:-1].T, dim=0).flatten()
        joined = functional.normalize(torch.cat([functional.normalize(scene, dim=0), summed]), dim=0)
        expected = functional.normalize(linear(joined, "aggregator.linear"), dim=0).numpy()
        np.testing.assert_allclose(describe(descriptor, image, 70), expected, atol=2.6e-4)
