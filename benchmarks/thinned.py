"""Every n-th image of each image set, for ``benchmarks.compare``: photographs that overlap little.

    python -m benchmarks.thinned DATA TARGET [--every 3 4] [--least 4] [--sets ...]

TARGET/NAME_every_N holds every N-th image that the reference of DATA/NAME has, as links, and the reference
of these.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks.compare.sets import ImageSet, read_sets
from snakesfm.errors import SnakesfmError
from snakesfm.evaluation.colmap_model import read_model
from snakesfm.geometry.colmap_checks import check_binary


def thin(images: ImageSet, every: int, target: Path) -> int:
    """Write every so many of the images that a set's reference has; how many these are."""
    model = read_model(images.reference)
    by_name = {model.image(key).name: key for key in model.reg_image_ids()}
    shown = sorted(by_name)[::every]
    for name in set(by_name) - set(shown):
        model.deregister_frame(model.image(by_name[name]).frame_id)
    for name in shown:
        place = target / "images" / name
        place.parent.mkdir(parents=True, exist_ok=True)
        place.unlink(missing_ok=True)
        place.symlink_to((images.images / name).resolve())
    (target / "reference").mkdir(exist_ok=True)
    model.write_binary(str(target / "reference"))
    check_binary(target / "reference", model)
    meta = images.folder / "meta.yaml"
    if meta.is_file():
        (target / "meta.yaml").write_bytes(meta.read_bytes())
    return len(shown)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.thinned", description=__doc__)
    parser.add_argument("data", type=Path, help="folder of image sets")
    parser.add_argument("target", type=Path, help="folder for the thinned sets")
    parser.add_argument("--every", type=int, nargs="+", default=[3, 4], help="take every n-th image")
    parser.add_argument("--least", type=int, default=4, help="images that a thinned set must have")
    parser.add_argument("--sets", nargs="*", default=[], help="which sets, all of DATA if none")
    options = parser.parse_args(arguments)
    if min(options.every) < 1:
        parser.error("--every takes numbers of at least 1")
    try:
        for images in read_sets(options.data, options.sets):
            posed = read_model(images.reference).num_reg_images()
            for every in options.every:
                if -(-posed // every) >= options.least:
                    name = f"{images.name}_every_{every}"
                    print(f"{name}: {thin(images, every, options.target / name)} images", flush=True)
    except SnakesfmError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
