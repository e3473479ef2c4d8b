"""Options of filter_view_graph."""

from typing import ClassVar, Literal

from pydantic import Field

from snakesfm.config.base import StageOptions


class FilterViewGraphOptions(StageOptions):
    """Options of refusing edges of the view graph that contradict the others."""

    stage_version: ClassVar[int] = 4

    method: Literal["message_passing", "cycles"] = "message_passing"
    """How 3-cycles refuse edges: by message passing between them, or by the paper's two passes."""

    max_cycle_error_deg: float = Field(default=7.0, gt=0, le=180)
    """Edges are refused whose cycle error in degrees is larger than this."""

    min_cycles_per_edge: float = Field(default=6.0, ge=0)
    """Where edges are in fewer 3-cycles on average, message passing and vote refuse none."""

    first_pass: Literal["min", "median", "none"] = "min"
    """Error of an edge in the first pass of method cycles: that of its best or of its median 3-cycle."""

    second_pass: Literal["min", "median", "none"] = "median"
    """The same for the second pass, which sees only the survivors of the first."""

    cluster_vote: bool = True
    """Let all inlier matches vote on how groups of images that the cycles left apart are joined."""

    min_cluster_inliers: int = Field(default=30, ge=0)
    """Edges of fewer inliers only vote, even where cycles confirm them."""

    vote_tolerance_deg: float = Field(default=10.0, gt=0, le=90)
    """Votes on the rotation between two groups agree if they differ by at most so many degrees."""
