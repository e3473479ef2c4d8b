"""The interface of matchers."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from snakesfm.arrays import Array
from snakesfm.features.keypoints import KeypointSet
from snakesfm.lazy_loading import lazy
from snakesfm.matching.clustered import ClusteredSearch
from snakesfm.matching.identity import IdentityMatcher


class Matcher(Protocol):
    """Matches the keypoints of two images; a new one joins by an entry in ``MATCHERS``."""

    def prepare(self, first: KeypointSet) -> Any:
        """Do once what all pairs of the image ``first`` need; the result goes into :meth:`match`."""

    def prepare_second(self, second: KeypointSet) -> Any:
        """The same for the image ``second``; what it holds is not much more than the keypoints."""

    def match(self, first: Any, second: Any) -> tuple[Array, Array]:
        """Match two images that are prepared.

        Returns
        -------
        matches : (K,2) int32 rows of ``first`` and ``second``, ascending, each row at most once.
        scores : (K,) float32 in 0 .. 1, larger is better.
        """


@runtime_checkable
class BatchMatcher(Protocol):
    """A matcher, with keypoints or without, that is quicker on several pairs at once."""

    def match_batch(self, pairs: Sequence[tuple[Any, Any]]) -> list[tuple[Array, Array]]:
        """What ``match`` finds in each pair of prepared images, to rounding; like pairs share work."""


@dataclass(frozen=True)
class MutualRatioMatcher:
    """Mutual nearest neighbours with the ratio test on the descriptors alone.

    Parameters
    ----------
    max_ratio : as in :func:`snakesfm.matching.nearest.accept`.
    words, probes : as in :meth:`snakesfm.matching.clustered.ClusteredSearch.build`.
    """

    max_ratio: float = 0.8
    words: int = 32
    probes: float = 3.0

    def prepare(self, first: KeypointSet) -> ClusteredSearch:
        """See :class:`Matcher`."""
        return ClusteredSearch.build(first.descriptors, self.words, self.probes)

    def prepare_second(self, second: KeypointSet) -> Array:
        """See :class:`Matcher`."""
        return second.descriptors

    def match(self, first: ClusteredSearch, second: Array) -> tuple[Array, Array]:
        """See :class:`Matcher`."""
        return first.match(second, self.max_ratio)


MATCHERS: dict[str, Callable[..., Matcher]] = {
    "mutual_ratio": MutualRatioMatcher,
    "virtual": IdentityMatcher,
    "lightglue": lazy("matching.lightglue", "LightglueMatcher"),
    "superglue": lazy("matching.superglue", "SuperglueMatcher"),
}
