"""A plan of images that are none: their bytes only tell them apart."""

from pathlib import Path

from snakesfm.plan import Plan


def make_images(folder: Path, count: int) -> Path:
    folder.mkdir(parents=True)
    for number in range(count):
        (folder / f"{number:03d}.jpg").write_bytes(b"bytes of image %d" % number)
    return folder


def plan_of(tmp_path: Path, **config: object) -> Plan:
    return Plan({"output": str(tmp_path / "out"), **config})
