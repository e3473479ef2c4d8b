"""Options of export_model."""

from typing import ClassVar, Literal

from snakesfm.config.base import StageOptions


class ExportModelOptions(StageOptions):
    """How the model is written for other tools."""

    stage_version: ClassVar[int] = 5

    georeference: Literal["auto"] | bool = "auto"
    """Move models to metres east, north and up by the GPS in EXIF; 'auto': where the two agree."""

    link_images: bool = True
    """Link the images beside the model, so that COLMAP and nerfstudio read the folder as it is."""

    undistort: bool = False
    """Also write images, masks and model with PINHOLE cameras, in 'undistorted', for Inria's 3DGS."""
