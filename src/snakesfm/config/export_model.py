"""Options of export_model."""

from snakesfm.config.base import StageOptions


class ExportModelOptions(StageOptions):
    """How the model is written for other tools."""

    link_images: bool = True
    """Link the images beside the model, so that 3DGS and nerfstudio tools read the folder as it is."""

    undistort: bool = False
    """Also write images and model with PINHOLE cameras, in 'undistorted', for tools that need these."""
