"""Options of match_pairs."""

from typing import ClassVar, Literal

from pydantic import Field

from snakesfm.config.base import StageOptions


class MatchPairsOptions(StageOptions):
    """How the descriptors of two images are matched."""

    stage_version: ClassVar[int] = 2

    method: Literal["mutual_ratio"] = "mutual_ratio"
    """Matcher: mutual nearest neighbours with the ratio test."""

    max_ratio: float = Field(0.8, gt=0.0, le=1.0)
    """Largest ratio of the distances to the nearest and second nearest descriptor (1: no test)."""

    search: Literal["clustered", "exact"] = "clustered"
    """Where nearest descriptors are looked for: among those of like words (much cheaper), or among all."""

    words: int = Field(32, ge=1, le=256)
    """Words of the codebook that clustered search learns on each image; few keypoints get fewer words."""

    probes: float = Field(3.0, ge=1.0, le=256.0)
    """Words that a descriptor is compared with, on average over an image; more find more of the matches."""
