"""Options of match_pairs."""

from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field

from snakesfm.config.base import StageOptions
from snakesfm.front_ends import DETECTOR_FREE


class MatchPairsOptions(StageOptions):
    """How the descriptors of two images are matched."""

    stage_version: ClassVar[int] = 6

    method: Literal[
        "mutual_ratio",
        "lightglue",
        "superglue",
        "virtual",
        "imported",
        "loftr",
        "virtual_places",
    ] = "mutual_ratio"
    """Nearest neighbours, a network, an oracle, hloc's file, or a matcher without keypoints; see
    docs/front_ends.md."""

    max_ratio: float = Field(0.8, gt=0.0, le=1.0)
    """Largest ratio of the distances to the nearest and the second nearest descriptor; 1 turns the test
    off."""

    words: int = Field(32, ge=1, le=256)
    """Number of words in the codebook learned on each image; nearest descriptors are searched among those
    with similar words. Fewer if the image has few keypoints; 1 searches among all, several times slower."""

    probes: float = Field(3.0, ge=1.0, le=256.0)
    """Number of words that a descriptor is compared with, on average over an image; more find more
    matches."""

    min_score: Annotated[float, Field(ge=0.0, le=1.0)] | Literal["auto"] = "auto"
    """Smallest confidence of a match made by a network; 'auto' is 0.1, or 0.2 without keypoints."""

    longer_side_px: int = Field(840, ge=64, le=20_000)
    """Longer side to which images are scaled down for a matcher without keypoints; the shorter side
    stays at least 64."""

    spread_px: float = Field(2.0, ge=0.0, le=100.0)
    """Largest shift, in x and y, of the matched positions of the oracle 'virtual_places' from the true
    point."""

    noise_px: float = Field(0.3, ge=0.0, le=100.0)
    """Standard deviation of the second position of each match of the oracle 'virtual_places'."""

    def resolved(self) -> Self:
        """The options with 'auto' replaced by what it means for the method."""
        if self.min_score != "auto":
            return self
        return self.model_copy(update={"min_score": 0.2 if self.method in DETECTOR_FREE else 0.1})
