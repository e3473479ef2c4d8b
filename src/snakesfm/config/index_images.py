"""Options of index_images."""

from typing import ClassVar, Literal

from pydantic import Field

from snakesfm.config.base import StageOptions


class IndexImagesOptions(StageOptions):
    """How images are assigned to cameras, and where intrinsics start."""

    stage_version: ClassVar[int] = 6

    camera_sharing: Literal["auto", "exif", "single", "per_folder", "per_image"] = "auto"
    """Which images share a camera: 'auto' compares EXIF or, without it, folder, size and numbering;
    'exif' only EXIF; 'single' all images of one size; 'per_folder' those of one folder and size;
    'per_image' none."""

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
    """COLMAP camera model of cameras without known intrinsics; 'auto' is SIMPLE_RADIAL,
    OPENCV_FISHEYE if the lens needs it, or OPENCV if pixels are not square."""

    use_exif_focal: bool = True
    """Start focal lengths from EXIF and COLMAP's sensor database, except for cropped images."""

    default_focal_ratio: float = Field(1.2, ge=0.2, le=25.0)
    """Focal length assumed if nothing is known, as a multiple of the longer image side."""
