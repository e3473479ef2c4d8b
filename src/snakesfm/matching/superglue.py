"""SuperGlue (Sarlin et al. 2020): a network that matches SuperPoint's keypoints, by transformers."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from snakesfm.arrays import Array
from snakesfm.errors import ConfigError
from snakesfm.features.keypoints import KeypointSet
from snakesfm.learned.batches import equal_rows
from snakesfm.learned.checkpoints import fill_network
from snakesfm.learned.device import choose_device, load_torch
from snakesfm.matching.nearest import no_matches

# places (N,2), descriptors (N,D) and scores (N,) of an image, float32
Prepared = tuple[Array, Array, Array]


class SuperglueMatcher:
    """SuperGlue; pairs are matched together where equally many keypoints are filled up to in both images.

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

    def prepare(self, first: KeypointSet) -> Prepared:
        """See :class:`snakesfm.matching.matcher.Matcher`."""
        if first.descriptors.shape[1] != self.descriptor_size:
            raise ConfigError(
                f"SuperGlue needs SuperPoint's descriptors of {self.descriptor_size} numbers, not of "
                f"{first.descriptors.shape[1]}: set extract_features.method to 'superpoint'."
            )
        size = np.array(first.image_size, np.float32)
        # as in an image of one by one, so that two images of other sizes can be given together
        places = (first.keypoints - size / 2) / max(float(size.max()), 1.0) + 0.5
        return places.astype(np.float32), first.descriptors.astype(np.float32), first.scores

    prepare_second = prepare

    def match(self, first: Prepared, second: Prepared) -> tuple[Array, Array]:
        """See :class:`snakesfm.matching.matcher.Matcher`."""
        return self.match_batch([(first, second)])[0]

    def match_batch(self, pairs: Sequence[tuple[Prepared, Prepared]]) -> list[tuple[Array, Array]]:
        """See :class:`snakesfm.matching.matcher.BatchMatcher`."""
        results = [no_matches()] * len(pairs)
        counts = [(len(first[0]), len(second[0])) for first, second in pairs]
        # filled up to the same number as alone, so that a pair's result does not depend on the others
        for rows in equal_rows([max(pair) for pair in counts]):
            enough = [row for row in rows if min(counts[row]) >= 2]
            if enough:
                matched = self._match_equal([pairs[row] for row in enough], max(counts[enough[0]]))
                for row, result in zip(enough, matched, strict=True):
                    results[row] = result
        return results

    def _match_equal(
        self, pairs: Sequence[tuple[Prepared, Prepared]], most: int
    ) -> list[tuple[Array, Array]]:
        """Match pairs whose images are all filled up to ``most`` keypoints."""
        torch, device = load_torch(), choose_device()
        counts = np.array([[len(image[0]) for image in pair] for pair in pairs])
        columns = []
        for part in range(3):
            filled = np.zeros((len(pairs), 2, most, *pairs[0][0][part].shape[1:]), np.float32)
            for row, pair in enumerate(pairs):
                for side, image in enumerate(pair):
                    filled[row, side, : counts[row, side]] = image[part]
            columns.append(torch.from_numpy(filled).to(device))
        there = torch.from_numpy((np.arange(most) < counts[..., None]).astype(np.int32)).to(device)
        with torch.inference_mode():
            partners, confidences, *_ = self._network._match_image_pair(
                *columns, height=1, width=1, mask=there
            )
        partners, confidences = partners[:, 0].cpu().numpy(), confidences[:, 0].float().cpu().numpy()
        results = []
        for (first, second), partner, confidence in zip(counts, partners, confidences, strict=True):
            rows = np.flatnonzero((partner[:first] >= 0) & (partner[:first] < second))
            matches = np.column_stack([rows, partner[rows]]).astype(np.int32)
            results.append((matches, np.clip(confidence[rows], 0, 1).astype(np.float32)))
        return results
