"""Options of export_database."""

from typing import ClassVar

from snakesfm.config.base import StageOptions


class ExportDatabaseOptions(StageOptions):
    """The COLMAP database of features and two-view geometries; made only by the target `databases`."""

    stage_version: ClassVar[int] = 2

    descriptors: bool = True
    """Also write descriptors, which COLMAP needs to match further pairs but not to map."""
