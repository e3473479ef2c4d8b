"""Options of the simulation, and its command line."""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from snakesfm.errors import ConfigError
from snakesfm.synthetic.surveys import SURVEYS

UNTIL = ("extract_features", "select_pairs", "match_pairs", "estimate_two_view")
LEAST_IMAGES = {"aerial": 2, "street": 320}


@dataclass(frozen=True)
class SimulationOptions:
    """What is simulated.

    Parameters
    ----------
    images : number N of images.
    survey : ``aerial`` or ``street``, see :mod:`snakesfm.synthetic.surveys`.
    until : the last stage whose artifacts are made; descriptors are left out from ``match_pairs`` on.
    partners : how many images that see the same an image chooses; about 1.6 times as many result.
    keypoints : most keypoints of an image, the strongest.
    known_focal : whether the cameras' intrinsics are given.
    blocks : number of blocks, 0 for what the workflow would choose.
    seed : of everything random, not negative.

    Raises
    ------
    ConfigError : the survey needs more images, or the focal length is to be estimated from relative poses
        that are known.
    """

    images: int = 1000
    survey: str = "aerial"
    until: str = "select_pairs"
    partners: int = 15
    keypoints: int = 5000
    known_focal: bool = True
    blocks: int = 0
    seed: int = 0

    def __post_init__(self) -> None:
        least = LEAST_IMAGES[self.survey]
        if self.images < least:
            raise ConfigError(f"A survey '{self.survey}' needs at least {least} images: set --images.")
        if not self.known_focal and self.until == "estimate_two_view":
            # calibrate_cameras comes before it, and the poses are those that the true camera gives
            raise ConfigError(
                "--unknown-focal leaves the focal length to calibrate_cameras, which --until "
                "estimate_two_view would skip: end with --until match_pairs."
            )


def parse_arguments(arguments: Sequence[str] | None) -> tuple[Path, SimulationOptions]:
    """The folder and the options that a command line names; it ends the process where it is wrong.

    Raises
    ------
    ConfigError : see :class:`SimulationOptions`.
    """
    default = SimulationOptions()
    parser = argparse.ArgumentParser(
        prog="python -m snakesfm.simulate",
        description="Make the artifacts of a large scene with known ground truth.",
    )
    add = parser.add_argument
    add("folder", type=Path, help="a new folder")
    add("--images", type=_natural, default=default.images)
    add("--survey", choices=sorted(SURVEYS), default=default.survey)
    add("--until", choices=UNTIL, default=default.until, help="the last stage that is made")
    add("--partners", type=_natural, default=default.partners, help="nearby images paired with each image")
    add("--keypoints", type=_natural, default=default.keypoints, help="largest number per image")
    add(
        "--unknown-focal",
        dest="known_focal",
        action="store_false",
        help="leave the focal length to the workflow",
    )
    add("--blocks", type=_natural, default=default.blocks, help="0 lets the workflow choose")
    add("--seed", type=_natural, default=default.seed)
    given = vars(parser.parse_args(arguments))
    return given.pop("folder"), SimulationOptions(**given)


def _natural(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number: give 0 or more")
    return int(text)
