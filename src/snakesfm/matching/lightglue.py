"""LightGlue (Lindenberger et al. 2023): a network that matches the keypoints of two images, by kornia."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from snakesfm.arrays import Array
from snakesfm.errors import ConfigError
from snakesfm.features.keypoints import KeypointSet
from snakesfm.learned.checkpoints import fill_network
from snakesfm.learned.device import choose_device, load_torch
from snakesfm.matching.nearest import no_matches

# what a network must know of the descriptors that it was trained on
NETWORKS: dict[str, dict[str, Any]] = {
    "aliked": {"input_dim": 128},
    "disk": {"input_dim": 128},
    "superpoint": {"input_dim": 256},
    # LighterGlue of XFeat's authors: fewer and narrower layers
    "xfeat": {
        "input_dim": 64,
        "descriptor_dim": 96,
        "n_layers": 6,
        "num_heads": 1,
        "depth_confidence": -1,
        "width_confidence": 0.95,
    },
}


class LightglueMatcher:
    """LightGlue with early exit and pruning, one pair at a time: its matches depend on the pair alone.

    A batch would go on until its last pair is sure, and what is pruned differs from pair to pair. On CUDA
    the attention runs in half precision.

    Parameters
    ----------
    detector : key of ``NETWORKS``, whose keypoints are matched.
    min_score : least confidence of a match, 0 .. 1.
    state : the network's weights; None for random ones.
    """

    def __init__(self, detector: str, min_score: float, state: Mapping[str, Any] | None) -> None:
        from kornia.feature import LightGlue

        half = choose_device().type == "cuda"
        network = LightGlue(None, **NETWORKS[detector], filter_threshold=min_score, mp=half)
        self._detector = detector
        self._network = fill_network(
            network, state and renamed(state), f"LightGlue for {detector}", ("confidence_thresholds",)
        )

    def prepare(self, first: KeypointSet) -> tuple[int, dict[str, Any]]:
        """See :class:`snakesfm.matching.matcher.Matcher`."""
        return len(first), self._to_tensors(first)

    prepare_second = prepare

    def match(
        self, first: tuple[int, dict[str, Any]], second: tuple[int, dict[str, Any]]
    ) -> tuple[Array, Array]:
        """See :class:`snakesfm.matching.matcher.Matcher`."""
        if min(first[0], second[0]) < 2:
            return no_matches()
        with load_torch().inference_mode():
            found = self._network({"image0": first[1], "image1": second[1]})
        matches = found["matches"][0].cpu().numpy().astype(np.int32)
        scores = found["scores"][0].float().cpu().numpy().astype(np.float32)
        order = np.argsort(matches[:, 0], kind="stable")
        return matches[order], np.clip(scores[order], 0, 1)

    def _to_tensors(self, points: KeypointSet) -> dict[str, Any]:
        torch, device = load_torch(), choose_device()
        size = NETWORKS[self._detector]["input_dim"]
        if points.descriptors.shape[1] != size:
            raise ConfigError(
                f"LightGlue for {self._detector} needs descriptors of {size} numbers, not of "
                f"{points.descriptors.shape[1]}: set extract_features.method to '{self._detector}'."
            )
        columns = {
            "keypoints": points.keypoints.astype(np.float32),
            "descriptors": points.descriptors.astype(np.float32),
            "image_size": np.array(points.image_size, np.float32),
        }
        return {name: torch.from_numpy(column).to(device)[None] for name, column in columns.items()}


def renamed(state: Mapping[str, Any]) -> dict[str, Any]:
    """Weights of LightGlue's authors (and of XFeat's) under the names of kornia's network."""
    names = {}
    for name in state:
        new = name.removeprefix("matcher.")
        for kind in ("self_attn", "cross_attn"):
            if new.startswith(f"{kind}."):
                layer, _, rest = new.removeprefix(f"{kind}.").partition(".")
                new = f"transformers.{layer}.{kind}.{rest}"
        names[new] = state[name]
    return names
