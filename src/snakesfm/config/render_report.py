"""Options of render_report."""

from pydantic import Field

from snakesfm.config.base import StageOptions


class RenderReportOptions(StageOptions):
    """What the report shows."""

    max_images: int = Field(1000, ge=1)
    """Rows of the table of images; of more images those with the fewest observations are shown."""
