"""Options of export_hloc."""

from typing import Literal

from snakesfm.config.base import StageOptions


class ExportHlocOptions(StageOptions):
    """Features and matches as hloc's files; made only by the target `hloc`."""

    matches: Literal["inliers", "putative"] = "inliers"
    """Which matches are written: those that fit the pair's relative pose, or all that were found."""
