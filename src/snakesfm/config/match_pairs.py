"""Options of match_pairs."""

from typing import ClassVar, Literal

from pydantic import Field

from snakesfm.config.base import StageOptions


class MatchPairsOptions(StageOptions):
    """How the descriptors of two images are matched."""

    stage_version: ClassVar[int] = 1

    method: Literal["mutual_ratio"] = "mutual_ratio"
    """Matcher: mutual nearest neighbours with the ratio test."""

    max_ratio: float = Field(0.8, gt=0.0, le=1.0)
    """Largest ratio of the distances to the nearest and second nearest descriptor (1: no test)."""
