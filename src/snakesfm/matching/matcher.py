"""The interface of what matches two images."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from numpy.typing import NDArray

from snakesfm.features.keypoints import KeypointSet
from snakesfm.matching.nearest import match_mutual_ratio

Array = NDArray[Any]


class Matcher(Protocol):
    """Matches the keypoints of two images; a new one joins by an entry in ``MATCHERS``."""

    def match(self, first: KeypointSet, second: KeypointSet) -> tuple[Array, Array]:
        """Match two images.

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
    max_ratio : as in :func:`snakesfm.matching.nearest.match_mutual_ratio`.
    """

    max_ratio: float = 0.8

    def match(self, first: KeypointSet, second: KeypointSet) -> tuple[Array, Array]:
        """See :class:`Matcher`."""
        return match_mutual_ratio(first.descriptors, second.descriptors, self.max_ratio)


MATCHERS: dict[str, Callable[..., Matcher]] = {"mutual_ratio": MutualRatioMatcher}


def create_matcher(method: str, **options: Any) -> Matcher:
    """The matcher of a name in ``MATCHERS``, with its own options."""
    return MATCHERS[method](**options)
