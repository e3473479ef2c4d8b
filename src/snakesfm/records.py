"""Snakemake's records of the files that it made."""

import json
import os
import re
from base64 import urlsafe_b64encode
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from snakesfm.errors import ConfigError

RECORDS = Path(".snakemake", "metadata")
# Snakemake's letters without a value: behind another, the rest of a word is one ('-call' is '--cores all')
FLAGS = "hntkfFlSDvpa"
MAKES_NOTHING = re.compile(
    rf"-[{FLAGS}]*[nSDlt].*|"
    r"--(dry-?run|touch|unlock|lint|report|archive|l[tipu]|list.*|summary|detailed-summary|dag|rulegraph|filegraph|"
    r"d3dag|cleanup-.*|delete-.*|containerize|generate-unit-tests|export-cwl|print-compilation)(=.*)?"
)
DELETES = re.compile(r"--delete-.*")
PRETENDS = re.compile(rf"-[{FLAGS}]*n.*|--dry-?run")
# it does not make all of its targets, or keeps no records
MAKES_PART = frozenset(("--until", "-U", "--omit-from", "-O", "--drop-metadata"))
# an option that names rules, the first of them in the same word
NAMES_RULES = re.compile(
    r"(--until|--omit-from|--forcerun|--prioritize|--allowed-rules|--preemptible-rules)=(.*)|"
    rf"-[{FLAGS}]*([UORP])(.*)"
)
# the longest name of a file, less the mark of a part that goes on
PART = 254
# times pass through floating point
SAME_TIME_S = 1e-3


def unrecorded_files(outputs: Iterable[str], records: Path = RECORDS) -> list[Path]:
    """Files that are there and of which no record tells how they were made.

    Snakemake compares a job's options with those that it noted in the folder it was started in, under the
    output's name as it was said. Of a file that was made from another folder or under another name, or
    whose notes are gone, it takes any for granted; and notes of a file that was made again so are of the
    former one, whose time they hold.

    Parameters
    ----------
    outputs : files as the rules name them.
    records : Snakemake's folder of records.
    """
    return [Path(output) for output in outputs if not _is_recorded(output, records)]


def forget(output: Path, records: Path = RECORDS) -> None:
    """Have Snakemake make a file again: it is older than everything, and no record is of it."""
    (records / _record_name(str(output))).unlink(missing_ok=True)
    # Snakemake takes 0 for no time
    os.utime(output, (1, 1))


def _is_recorded(output: str, records: Path) -> bool:
    """Whether a file is missing, or is the one that its record is of."""
    try:
        changed = Path(output).stat().st_mtime
    except OSError:
        return True
    ended = _read_record(output, records).get("endtime")
    return isinstance(ended, int | float) and abs(ended - changed) < SAME_TIME_S


def was_made_with(output: str, params: str, records: Path = RECORDS) -> bool:
    """Whether a file was made with these params of its job, as far as there is a record of it.

    Parameters
    ----------
    output : a file as the rules name it.
    params : the one param that Snakemake compares.
    records : Snakemake's folder of records.
    """
    noted = _read_record(output, records).get("params")
    return not isinstance(noted, list) or repr(params) in noted


def _read_record(output: str, records: Path) -> dict[str, Any]:
    """What Snakemake noted of an output; empty where that is nothing, or cannot be read."""
    try:
        record = json.loads((records / _record_name(output)).read_text("utf-8"))
    except (OSError, ValueError):
        return {}
    return record if isinstance(record, dict) else {}


def check_folder(snakefile: str) -> None:
    """Make sure that Snakemake can keep its records, without which it ends in a traceback.

    Parameters
    ----------
    snakefile : path of the Snakefile, to start it from elsewhere.

    Raises
    ------
    ConfigError : the folder that Snakemake was started in cannot be written.
    """
    place = next(folder for folder in (RECORDS.parent, Path()) if folder.is_dir())
    if not os.access(place, os.W_OK, effective_ids=True):
        raise ConfigError(
            f"Snakemake keeps its records in '.snakemake' of the folder it is started in, and "
            f"{place.resolve()} cannot be written: start it elsewhere with -s {snakefile}, "
            "or use --directory DIR."
        )


def check_backend(backend: str) -> None:
    """Make sure that Snakemake keeps its records where they are looked for.

    Parameters
    ----------
    backend : Snakemake's option ``--persistence-backend``.

    Raises
    ------
    ConfigError : they are not kept in files.
    """
    if backend != "file":
        raise ConfigError(
            "snakesfm reads Snakemake's records in '.snakemake/metadata', where --persistence-backend "
            f"{backend} keeps none: leave out this option."
        )


def split_words(arguments: Iterable[str]) -> set[str]:
    """The words of Snakemake's command line, with rules apart from the option that names them.

    Parameters
    ----------
    arguments : of the command line; ``--until=RULE`` and ``-URULE`` are two words each.
    """
    words: set[str] = set()
    for argument in arguments:
        named = NAMES_RULES.fullmatch(argument)
        words |= {argument} if named is None else {named[1] or f"-{named[3]}", named[2] or named[4]}
    return words


def makes_nothing(arguments: Iterable[str]) -> bool:
    """Whether Snakemake is only asked for something, by these arguments of its command line."""
    return any(MAKES_NOTHING.fullmatch(argument) for argument in arguments)


def deletes(arguments: Iterable[str]) -> bool:
    """Whether Snakemake is asked to delete results, and not only to say which, by these arguments."""
    given = list(arguments)
    return any(map(DELETES.fullmatch, given)) and not any(map(PRETENDS.fullmatch, given))


def _record_name(output: str) -> str:
    """The file in which Snakemake 9 notes how an output was made."""
    name = urlsafe_b64encode(output.encode()).decode()
    parts = [name[k : k + PART] for k in range(0, len(name), PART)]
    return "/".join([*(f"@{part}" for part in parts[:-1]), parts[-1]])
