"""Options of build_view_graph."""

from snakesfm.config.base import StageOptions


class BuildViewGraphOptions(StageOptions):
    """Options of merging the two-view geometries into one view graph: there are none."""
