"""Options of index_images."""

from typing import ClassVar, Literal

from pydantic import Field

from snakesfm.config.base import StageOptions


class IndexImagesOptions(StageOptions):
    """How cameras are told from the images."""

    stage_version: ClassVar[int] = 4

    camera_sharing: Literal["auto", "exif", "single", "per_folder", "per_image"] = "auto"
    """Which images share a camera: alike in EXIF or, without it, in folder and size, or a fixed rule."""

    camera_model: Literal[
        "auto",
        "SIMPLE_PINHOLE",
        "PINHOLE",
        "SIMPLE_RADIAL",
        "RADIAL",
        "OPENCV",
        "FULL_OPENCV",
        "OPENCV_FISHEYE",
        "SIMPLE_RADIAL_FISHEYE",
        "RADIAL_FISHEYE",
    ] = "auto"
    """COLMAP camera model where none is given; 'auto': SIMPLE_RADIAL, OPENCV_FISHEYE if the lens is one."""

    use_exif_focal: bool = True
    """Whether focal lengths start from EXIF and COLMAP's sensor database, unless an image was cropped."""

    default_focal_ratio: float = Field(1.2, ge=0.2, le=25.0)
    """Focal length that is assumed where nothing is known, as a multiple of the longer side."""
