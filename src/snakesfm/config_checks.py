"""Checks of how a run is configured: what was typed or written twice, of which one would be lost."""

import re
from collections.abc import Sequence

from snakesfm.errors import ConfigError

# behind letters that take no value, the rest of a word is another option
GIVEN_ONCE = {
    "--config": (re.compile(r"--config(=.*)?|-[hntkfFlSDvpa]*C.*", re.DOTALL), "KEY=VALUE"),
    "--configfile": (re.compile(r"--configfiles?(=.*)?", re.DOTALL), "files"),
}


def check_given_once(arguments: Sequence[str]) -> None:
    """Refuse options of which Snakemake would use the last occurrence alone.

    Parameters
    ----------
    arguments : Snakemake's command line.

    Raises
    ------
    ConfigError : --config or --configfile is given more than once.
    """
    for option, (spelling, values) in GIVEN_ONCE.items():
        count = sum(spelling.fullmatch(argument) is not None for argument in arguments)
        if count > 1:
            times = "twice" if count == 2 else f"{count} times"
            raise ConfigError(
                f"{option} is given {times}, and Snakemake uses only the last: write all {values} behind "
                f"one {option}."
            )
