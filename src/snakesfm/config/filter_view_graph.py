"""Options of filter_view_graph."""

from typing import ClassVar, Literal

from pydantic import Field

from snakesfm.config.base import StageOptions


class FilterViewGraphOptions(StageOptions):
    """Refusal of view-graph edges that contradict the others."""

    stage_version: ClassVar[int] = 5

    method: Literal["message_passing", "cycles"] = "message_passing"
    """How edges are judged by 3-cycles: message passing between cycles, or the two passes below."""

    max_cycle_error_deg: float = Field(default=7.0, gt=0, le=180)
    """Edges with a larger cycle error, in degrees, are refused."""

    min_cycles_per_edge: float = Field(default=6.0, ge=0)
    """If edges are in fewer 3-cycles than this on average, message passing and the vote after it refuse
    none; average_rotations judges them."""

    first_pass: Literal["min", "median", "none"] = "min"
    """Error of an edge in the first pass of method 'cycles': its smallest or its median 3-cycle error."""

    second_pass: Literal["min", "median", "none"] = "median"
    """Error of an edge in the second pass of method 'cycles', which uses only edges kept by the first."""

    cluster_vote: bool = True
    """Let all inlier matches vote on how to connect groups of images that cycles do not connect."""

    min_cluster_inliers: int = Field(default=30, ge=0)
    """Edges with fewer inliers only vote, even if cycles confirm them."""

    vote_tolerance_deg: float = Field(default=10.0, gt=0, le=90)
    """Votes on the rotation between two groups agree if they differ by at most this angle in degrees."""
