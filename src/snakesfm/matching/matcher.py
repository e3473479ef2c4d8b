"""The interface of what matches two images."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, Protocol

from numpy.typing import NDArray

from snakesfm.features.keypoints import KeypointSet
from snakesfm.matching.clustered import ClusteredSearch
from snakesfm.matching.nearest import ExactSearch

Array = NDArray[Any]


class Matcher(Protocol):
    """Matches the keypoints of two images; a new one joins by an entry in ``MATCHERS``."""

    def prepare(self, first: KeypointSet) -> Any:
        """Do once what all pairs of the image ``first`` need; the result goes into :meth:`match`."""

    def match(self, first: Any, second: KeypointSet) -> tuple[Array, Array]:
        """Match two images, the first of them prepared.

        Returns
        -------
        matches : (K,2) int32 rows of ``first`` and ``second``, ascending, each row at most once.
        scores : (K,) float32 in 0 .. 1, larger is better.
        """


@dataclass(frozen=True)
class MutualRatioMatcher:
    """Mutual nearest neighbours with the ratio test on the descriptors alone.

    Parameters
    ----------
    max_ratio : as in :func:`snakesfm.matching.nearest.accept`.
    search : compare all descriptors, or those of like words.
    words, probes : as in :meth:`snakesfm.matching.clustered.ClusteredSearch.build`.
    """

    max_ratio: float = 0.8
    search: Literal["clustered", "exact"] = "clustered"
    words: int = 32
    probes: float = 3.0

    def prepare(self, first: KeypointSet) -> ClusteredSearch | ExactSearch:
        """See :class:`Matcher`."""
        if self.search == "exact":
            return ExactSearch.build(first.descriptors)
        return ClusteredSearch.build(first.descriptors, self.words, self.probes)

    def match(self, first: ClusteredSearch | ExactSearch, second: KeypointSet) -> tuple[Array, Array]:
        """See :class:`Matcher`."""
        return first.match(second.descriptors, self.max_ratio)


MATCHERS: dict[str, Callable[..., Matcher]] = {"mutual_ratio": MutualRatioMatcher}


def create_matcher(method: str, **options: Any) -> Matcher:
    """The matcher of a name in ``MATCHERS``, with its own options."""
    return MATCHERS[method](**options)
