"""Checks of how a run is configured: what was typed or written twice, of which one would be lost."""

import contextlib
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import yaml

from snakesfm.errors import ConfigError
from snakesfm.records import FLAGS

# written in C, and 20 times as fast, where PyYAML was built with it
LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
MERGE_TAG = "tag:yaml.org,2002:merge"

GIVEN_ONCE = {
    "--config": (re.compile(rf"--config(=.*)?|-[{FLAGS}]*C.*", re.DOTALL), "KEY=VALUE"),
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


def check_keys(files: Iterable[Path]) -> None:
    """Refuse a key that stands twice in one block of a file, of which readers of YAML keep the last.

    Parameters
    ----------
    files : the user's files of configuration, which Snakemake could read.

    Raises
    ------
    ConfigError : names the key, the file, the lines and the remedy.
    """
    for file in files:
        # what comes through a pipe was read by Snakemake already
        if not file.is_file():
            continue
        # Snakemake takes JSON that is no YAML too
        with contextlib.suppress(yaml.YAMLError):
            _check_blocks(file, yaml.compose(file.read_text("utf-8"), Loader=LOADER))


def _check_blocks(file: Path, root: yaml.Node | None) -> None:
    """Refuse a repeated key in any mapping of a file."""
    # an alias leads to a node that is looked at where its anchor is
    seen, left = set(), [root]
    while left:
        node = left.pop()
        if node is None or id(node) in seen:
            continue
        seen.add(id(node))
        if isinstance(node, yaml.SequenceNode):
            left += node.value
        elif isinstance(node, yaml.MappingNode):
            left += [value for _, value in node.value]
            _check_block(file, node)


def _check_block(file: Path, block: yaml.MappingNode) -> None:
    former: dict[str, tuple[yaml.Node, yaml.Node]] = {}
    for key, value in block.value:
        # several blocks may be merged into one
        if not isinstance(key, yaml.ScalarNode) or key.tag == MERGE_TAG:
            continue
        if key.value in former:
            first, first_value = former[key.value]
            blocks = isinstance(value, yaml.MappingNode) and isinstance(first_value, yaml.MappingNode)
            raise ConfigError(
                f"Key '{key.value}' stands twice in {file} (lines {first.start_mark.line + 1} and "
                f"{key.start_mark.line + 1}): {'join the blocks' if blocks else 'remove one of them'}."
            )
        former[key.value] = key, value
