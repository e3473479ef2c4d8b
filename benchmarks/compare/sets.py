"""Image sets with reference poses: a folder with images/, reference/ and meta.yaml."""

from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from benchmarks import ROOT
from snakesfm.errors import ConfigError
from snakesfm.evaluation.colmap_model import read_model

DATA = ROOT.parent / "shared" / "data"
IMAGE_SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp"}


@dataclass(frozen=True)
class ImageSet:
    """One set; are its intrinsics given to all, and is its reference no COLMAP model of these images?"""

    folder: Path
    known: bool
    truth: bool

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.folder.name

    @property
    def images(self) -> Path:
        """The folder of images."""
        return self.folder / "images"

    @property
    def reference(self) -> Path:
        """The folder of the reference model."""
        return self.folder / "reference"

    def image_names(self) -> list[str]:
        """Paths of all images relative to their folder, sorted."""
        files = (path for path in self.images.rglob("*") if path.suffix.lower() in IMAGE_SUFFIXES)
        return sorted(path.relative_to(self.images).as_posix() for path in files)

    def camera_groups(self) -> list[dict[str, Any]]:
        """What COLMAP is told of the cameras: each group's images, mode and known intrinsics.

        Unknown intrinsics: images share a camera as in the reference; what it lacks has one of its own.
        """
        model = read_model(self.reference)
        if not self.known and len(model.cameras) == len(model.images):
            return [{"names": [], "mode": "PER_IMAGE"}]
        members = defaultdict(list)
        for image in model.images.values():
            members[image.camera_id].append(image.name)
        groups = []
        for key in sorted(members):
            camera = model.cameras[key]
            names = sorted(members[key]) if len(members) > 1 else []
            group: dict[str, Any] = {"names": names, "mode": "SINGLE"}
            if self.known:
                group |= {"model": camera.model_name, "params": camera.params.tolist()}
            groups.append(group)
        others = sorted(set(self.image_names()) - {image.name for image in model.images.values()})
        if others and len(members) > 1:
            groups.append({"names": others, "mode": "PER_IMAGE"})
        return groups

    def pinhole(self) -> list[list[float]] | None:
        """The 3x3 camera matrix where one known camera without distortion took all images."""
        cameras = list(read_model(self.reference).cameras.values())
        if not self.known or len(cameras) != 1 or not cameras[0].is_undistorted():
            return None
        matrix: list[list[float]] = cameras[0].calibration_matrix().tolist()
        return matrix


def read_sets(data: Path, names: list[str], withhold_intrinsics: bool = False) -> list[ImageSet]:
    """The named sets below ``data``, or all of them, smallest first.

    Parameters
    ----------
    data, names : the folder of the sets, and which of them.
    withhold_intrinsics : whether known intrinsics are given to nobody, as in a folder of photographs.

    Raises
    ------
    ConfigError : a set is not there.
    """
    folders = [data / name for name in names] or sorted(path.parent for path in data.glob("*/reference"))
    sets = []
    for folder in folders:
        if not (folder / "images").is_dir() or not (folder / "reference").is_dir():
            raise ConfigError(f"{folder} is not an image set: it needs images/ and reference/.")
        meta = folder / "meta.yaml"
        content = yaml.safe_load(meta.read_text("utf-8")) if meta.is_file() else {}
        truth = "colmap" not in content.get("reference_source", "colmap")
        known = bool(content.get("known_intrinsics", False)) and not withhold_intrinsics
        sets.append(ImageSet(folder.resolve(), known, truth))
    return sorted(sets, key=lambda item: (len(item.image_names()), item.name))
