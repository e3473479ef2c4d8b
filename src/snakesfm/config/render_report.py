"""Options of render_report."""

from typing import ClassVar

from pydantic import Field

from snakesfm.config.base import StageOptions


class RenderReportOptions(StageOptions):
    """What the report shows."""

    stage_version: ClassVar[int] = 2

    max_images: int = Field(1000, ge=1)
    """Rows of the table of images; of more images those with the fewest observations are shown."""
