"""Options of export_hloc."""

from typing import ClassVar, Literal

from snakesfm.config.base import StageOptions


class ExportHlocOptions(StageOptions):
    """Features and matches in hloc's file format; made only by the target `hloc`."""

    stage_version: ClassVar[int] = 3

    matches: Literal["inliers", "putative"] = "inliers"
    """Which matches are written: the inliers of the pair's relative pose, or all."""
