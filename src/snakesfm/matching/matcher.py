"""The interface of what matches two images."""

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol, runtime_checkable

from numpy.typing import NDArray

from snakesfm.features.keypoints import KeypointSet
from snakesfm.matching.clustered import ClusteredSearch
from snakesfm.matching.identity import IdentityMatcher
from snakesfm.matching.nearest import ExactSearch, no_matches
from snakesfm.matching.preview import largest_keypoints, likeness

Array = NDArray[Any]


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
class PreparedImage:
    """What :class:`MutualRatioMatcher` keeps of an image.

    Parameters
    ----------
    target : where the first image's nearest descriptors are looked for, or the second image's descriptors.
    preview : descriptors of the largest keypoints, or None where there is no preview.
    """

    target: Any
    preview: Array | None


@dataclass(frozen=True)
class MutualRatioMatcher:
    """Mutual nearest neighbours with the ratio test on the descriptors alone.

    Parameters
    ----------
    max_ratio : as in :func:`snakesfm.matching.nearest.accept`.
    search : compare all descriptors, or those of like words.
    words, probes : as in :meth:`snakesfm.matching.clustered.ClusteredSearch.build`.
    preview_keypoints : how many keypoints are looked at first; 0 for no preview.
    min_likeness : least :func:`snakesfm.matching.preview.likeness` of images that are matched at all.
    """

    max_ratio: float = 0.8
    search: Literal["clustered", "exact"] = "clustered"
    words: int = 32
    probes: float = 3.0
    preview_keypoints: int = 400
    min_likeness: float = 1.5

    def prepare(self, first: KeypointSet) -> PreparedImage:
        """See :class:`Matcher`."""
        search: ClusteredSearch | ExactSearch
        if self.search == "exact":
            search = ExactSearch.build(first.descriptors)
        else:
            search = ClusteredSearch.build(first.descriptors, self.words, self.probes)
        return PreparedImage(search, largest_keypoints(first, self.preview_keypoints))

    def prepare_second(self, second: KeypointSet) -> PreparedImage:
        """See :class:`Matcher`."""
        return PreparedImage(second.descriptors, largest_keypoints(second, self.preview_keypoints))

    def match(self, first: PreparedImage, second: PreparedImage) -> tuple[Array, Array]:
        """See :class:`Matcher`."""
        if (
            first.preview is not None
            and second.preview is not None
            and likeness(first.preview, second.preview) < self.min_likeness
        ):
            return no_matches()
        matches: tuple[Array, Array] = first.target.match(second.target, self.max_ratio)
        return matches


def _learned(module: str, name: str) -> Callable[..., Matcher]:
    """A matcher whose libraries load when one is made."""

    def make(**options: Any) -> Matcher:
        matcher: Matcher = getattr(importlib.import_module(f"snakesfm.matching.{module}"), name)(**options)
        return matcher

    return make


MATCHERS: dict[str, Callable[..., Matcher]] = {
    "mutual_ratio": MutualRatioMatcher,
    "virtual": IdentityMatcher,
    "lightglue": _learned("lightglue", "LightglueMatcher"),
    "superglue": _learned("superglue", "SuperglueMatcher"),
}


def create_matcher(method: str, **options: Any) -> Matcher:
    """The matcher of a name in ``MATCHERS``, with its own options."""
    return MATCHERS[method](**options)
