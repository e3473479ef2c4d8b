"""Options of export_model."""

from typing import ClassVar, Literal

from snakesfm.config.base import StageOptions


class ExportModelOptions(StageOptions):
    """How the model is written for other tools."""

    stage_version: ClassVar[int] = 9

    georeference: Literal["auto"] | bool = "auto"
    """Transform models to metres east, north and up by the GPS in EXIF: 'auto' if the positions agree
    with the model, true also if they are doubtful (with a warning), false never."""

    link_images: bool = True
    """Link the images next to the model, so that COLMAP and nerfstudio can read the folder directly."""

    all_keypoints: bool = False
    """Write all keypoints of registered images, numbered as in the COLMAP database and in hloc's files, so
    that COLMAP can continue the model and hloc can localise images in it; otherwise only observations."""

    undistort: bool = False
    """Also write images, masks and a model with PINHOLE cameras to 'undistorted', for Inria's 3DGS:
    cropped so that the principal point is in the middle. Subfolders are kept, which its original code
    does not read. Up to four images are undistorted at once; '--set-threads export_model=8' changes that
    to eight."""
