"""Options of render_report."""

from typing import ClassVar

from pydantic import Field

from snakesfm.config.base import StageOptions


class RenderReportOptions(StageOptions):
    """Contents of the report."""

    stage_version: ClassVar[int] = 4

    max_images: int = Field(1000, ge=1)
    """Largest number of rows in the table of images; if there are more, those with the fewest
    observations are shown."""
