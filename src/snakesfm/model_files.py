"""The files of an exported model, and the pictures beside them that no rule names."""

import os
from pathlib import Path

SUMMARY = "summary.json"
MODEL_FILES = (
    "sparse/0/cameras.bin",
    "sparse/0/images.bin",
    "sparse/0/points3D.bin",
    "sparse/0/cameras.txt",
    "sparse/0/images.txt",
    "sparse/0/points3D.txt",
    "points.ply",
    "transforms.json",
    SUMMARY,
)


def lacks_pictures(model: Path, link_images: bool, undistort: bool) -> bool:
    """Whether pictures beside a model are lost, or links lead nowhere, as where a project moved.

    Snakemake does not see it, for the names of the pictures are no outputs.

    Parameters
    ----------
    model : the folder of export_model.
    link_images, undistort : options of export_model.
    """
    masks = model / "masks"
    if masks.is_symlink() and not masks.exists():
        return True
    if undistort and not all((model / "undistorted" / part).is_dir() for part in ("images", "sparse")):
        return True
    return (link_images or undistort) and _leads_nowhere(model / "images")


def _leads_nowhere(place: Path) -> bool:
    """Whether there is no folder, or one of links of which the first leads nowhere, as then all do."""
    if not place.is_dir():
        return True
    if place.is_symlink():
        return False
    files = (Path(folder, name) for folder, _, names in os.walk(place) for name in names)
    link = next((file for file in files if file.is_symlink()), None)
    return link is not None and not link.exists()
