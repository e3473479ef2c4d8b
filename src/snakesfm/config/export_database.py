"""Options of export_database."""

from snakesfm.config.base import StageOptions


class ExportDatabaseOptions(StageOptions):
    """The COLMAP database of features and two-view geometries; made only by the target `databases`."""

    descriptors: bool = True
    """Also write descriptors, which COLMAP needs to match further pairs but not to map."""
