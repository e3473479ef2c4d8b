"""The files of an exported model, and the pictures beside them that no rule names."""

from collections.abc import Iterable
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


def without_pictures(results: Iterable[str], link_images: bool, undistort: bool) -> list[Path]:
    """Summaries of models beside which pictures are lost, or links lead nowhere, as where a project moved.

    Snakemake does not see it, for the names of the pictures are no outputs.

    Parameters
    ----------
    results : files that a run makes, summaries among them.
    link_images, undistort : options of export_model.
    """
    places = ["images"] if link_images or undistort else []
    places += ["undistorted/images", "undistorted/sparse"] if undistort else []
    return [
        Path(result)
        for result in results
        if Path(result).name == SUMMARY and _lacks(Path(result).parent, places)
    ]


def _lacks(folder: Path, places: Iterable[str]) -> bool:
    masks = folder / "masks"
    return any(_leads_nowhere(folder / place) for place in places) or (
        masks.is_symlink() and not masks.exists()
    )


def _leads_nowhere(place: Path) -> bool:
    """Whether there is no folder, or one of links of which the first leads nowhere, as then all do."""
    if not place.is_dir():
        return True
    if place.is_symlink():
        return False
    link = next((path for path in place.rglob("*") if path.is_symlink()), None)
    return link is not None and not link.exists()
