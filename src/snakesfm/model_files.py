"""The files of an exported model, and the pictures beside them that no rule names."""

import json
import os
from pathlib import Path

SUMMARY = "summary.json"
SPARSE_FILES = (
    "cameras.bin",
    "images.bin",
    "points3D.bin",
    "cameras.txt",
    "images.txt",
    "points3D.txt",
)
MODEL_FILES = (
    *(f"sparse/0/{name}" for name in SPARSE_FILES),
    "points.ply",
    "transforms.json",
    SUMMARY,
)


def lacks_pictures(model: Path, link_images: bool, undistort: bool) -> bool:
    """Whether pictures or models beside a model are lost, or links lead nowhere, as where a project moved.

    Snakemake does not see it, for they are no outputs. Pictures without distortion are only counted.

    Parameters
    ----------
    model : the folder of export_model.
    link_images, undistort : options of export_model.
    """
    masks = model / "masks"
    if masks.is_symlink() and not masks.exists():
        return True
    try:
        summary = json.loads((model / SUMMARY).read_text("utf-8"))
        pictures, others = summary["registered_images"], len(summary["images_in_other_models"])
    except (OSError, ValueError, KeyError, TypeError):
        return True
    models = [model / "sparse" / str(number + 1) for number in range(others)]
    if undistort:
        models.append(model / "undistorted" / "sparse" / "0")
        if sum(len(files) for *_, files in os.walk(model / "undistorted" / "images")) < pictures:
            return True
    if not all((folder / name).is_file() for folder in models for name in SPARSE_FILES):
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
