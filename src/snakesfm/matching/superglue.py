"""SuperGlue (Sarlin et al. 2020): a network that matches SuperPoint's keypoints, by transformers."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snakesfm.errors import ConfigError
from snakesfm.features.keypoints import KeypointSet
from snakesfm.learned.checkpoints import fill_network
from snakesfm.learned.device import choose_device, load_torch
from snakesfm.matching.nearest import no_matches

Array = NDArray[Any]


class SuperglueMatcher:
    """SuperGlue, one pair at a time.

    Parameters
    ----------
    detector : must be "superpoint", which SuperGlue was trained on.
    min_score : least confidence of a match, 0 .. 1.
    state : weights under the names of transformers; None for random ones.
    """

    descriptor_size = 256

    def __init__(self, detector: str, min_score: float, state: Mapping[str, Any] | None) -> None:
        from transformers import SuperGlueConfig, SuperGlueForKeypointMatching

        network = SuperGlueForKeypointMatching(SuperGlueConfig(matching_threshold=min_score))
        self._network = fill_network(network, state, f"SuperGlue for {detector}")

    def prepare(self, first: KeypointSet) -> tuple[Array, Array, Array]:
        """See :class:`snakesfm.matching.matcher.Matcher`."""
        if first.descriptors.shape[1] != self.descriptor_size:
            raise ConfigError(
                f"SuperGlue needs SuperPoint's descriptors of {self.descriptor_size} numbers, not of "
                f"{first.descriptors.shape[1]}: let extract_features.method be 'superpoint'."
            )
        size = np.array(first.image_size, np.float32)
        # as in an image of one by one, so that two images of other sizes can be given together
        places = (first.keypoints - size / 2) / max(float(size.max()), 1.0) + 0.5
        return places.astype(np.float32), first.descriptors.astype(np.float32), first.scores

    prepare_second = prepare

    def match(
        self, first: tuple[Array, Array, Array], second: tuple[Array, Array, Array]
    ) -> tuple[Array, Array]:
        """See :class:`snakesfm.matching.matcher.Matcher`."""
        counts = len(first[0]), len(second[0])
        if min(counts) < 2:
            return no_matches()
        torch, device = load_torch(), choose_device()
        columns = []
        for one, other in zip(first, second, strict=True):
            both = np.zeros((1, 2, max(counts), *one.shape[1:]), np.float32)
            both[0, 0, : counts[0]], both[0, 1, : counts[1]] = one, other
            columns.append(torch.from_numpy(both).to(device))
        there = torch.arange(max(counts), device=device) < torch.tensor(counts, device=device)[:, None]
        with torch.inference_mode():
            partners, confidences, *_ = self._network._match_image_pair(
                *columns, height=1, width=1, mask=there[None].int()
            )
        partner = partners[0, 0, : counts[0]].cpu().numpy()
        confidence = confidences[0, 0, : counts[0]].float().cpu().numpy()
        rows = np.flatnonzero((partner >= 0) & (partner < counts[1]))
        matches = np.column_stack([rows, partner[rows]]).astype(np.int32)
        return matches, np.clip(confidence[rows], 0, 1).astype(np.float32)
