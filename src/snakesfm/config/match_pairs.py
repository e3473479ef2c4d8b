"""Options of match_pairs."""

from typing import ClassVar, Literal

from pydantic import Field

from snakesfm.config.base import StageOptions


class MatchPairsOptions(StageOptions):
    """How the descriptors of two images are matched."""

    stage_version: ClassVar[int] = 3

    method: Literal["mutual_ratio", "lightglue", "superglue", "virtual", "imported"] = "mutual_ratio"
    """Mutual nearest neighbours with the ratio test, a network, an oracle, or hloc's file."""

    max_ratio: float = Field(0.8, gt=0.0, le=1.0)
    """Largest ratio of the distances to the nearest and second nearest descriptor (1: no test)."""

    search: Literal["clustered", "exact"] = "clustered"
    """Where nearest descriptors are looked for: among those of like words (much cheaper), or among all."""

    words: int = Field(32, ge=1, le=256)
    """Words of the codebook that clustered search learns on each image; few keypoints get fewer words."""

    probes: float = Field(3.0, ge=1.0, le=256.0)
    """Words that a descriptor is compared with, on average over an image; more find more of the matches."""

    preview_keypoints: int = Field(400, ge=0, le=10_000)
    """Largest keypoints that are compared first, to leave pairs that share nothing (0: match all pairs)."""

    min_likeness: float = Field(1.5, ge=0.0)
    """Least resemblance of these keypoints in a pair that is matched; higher leaves more pairs out."""

    min_score: float = Field(0.1, ge=0.0, le=1.0)
    """Least confidence of a match that a network makes."""
