"""Command line: ``python -m benchmarks.compare [run | render | ablate]``."""

import argparse
import os
import shlex
import signal
import sys
from pathlib import Path

from benchmarks import ROOT
from benchmarks.compare.ablate import ablate
from benchmarks.compare.results import METHODS, PACKAGES, read_results
from benchmarks.compare.run import Campaign
from benchmarks.compare.sets import DATA, read_sets
from benchmarks.compare.tables import render_csv, render_page
from benchmarks.machine import describe_machine
from snakesfm.errors import SnakesfmError

COMMANDS = ("run", "render", "ablate")


def parse(arguments: list[str]) -> argparse.Namespace:
    """The command line; without a command it is ``run``."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.compare", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    run = commands.add_parser("run", help="run what is not stored yet, then render")
    render = commands.add_parser("render", help="write the tables from what is stored")
    switch = commands.add_parser("ablate", help="change one option at a time")
    for command in (run, switch):
        command.add_argument("--data", type=Path, default=DATA, help="folder of the image sets")
        command.add_argument("--sets", nargs="*", default=[], help="names of sets (all)")
        command.add_argument(
            "--withhold-intrinsics", action="store_true", help="hide known intrinsics from all methods"
        )
        command.add_argument("--threads", type=int, default=os.cpu_count())
        command.add_argument(
            "--limit", type=float, default=3600, help="longest time of one command in seconds"
        )
    for command in (run, render, switch):
        command.add_argument("--out", type=Path, required=True, help="folder of results and working files")
    for command in (run, render):
        command.add_argument("--page", type=Path, help="Markdown page (OUT/benchmarks.md)")
    run.add_argument("--seeds", type=int, default=3)
    run.add_argument("--large-seeds", type=int, default=3, help="seeds on sets above 60 images")
    run.add_argument("--methods", nargs="*", choices=METHODS, default=list(METHODS))
    run.add_argument(
        "--retime", action="store_true", help="repeat timings taken while other processes were running"
    )
    switch.add_argument("--options", type=Path, default=ROOT / "benchmarks" / "ablations.yaml")
    switch.add_argument("--names", nargs="*", default=[], help="names of options in that file (all)")
    plain = arguments and arguments[0] not in (*COMMANDS, "-h", "--help")
    return parser.parse_args(["run", *arguments] if plain or not arguments else arguments)


def main(arguments: list[str]) -> int:
    """Do one command; 1 where its input is wrong."""
    given = parse(arguments)
    given.out = given.out.resolve()
    try:
        if given.command == "ablate":
            ablate(
                read_sets(given.data, given.sets, given.withhold_intrinsics),
                given.options,
                given.names,
                given.out,
                given.threads,
                given.limit,
            )
            return 0
        if given.command == "run":
            campaign = Campaign(
                given.out,
                given.seeds,
                given.large_seeds,
                given.threads,
                given.limit,
                tuple(given.methods),
                given.retime,
            )
            command = describe_command(given)
            for image_set in read_sets(given.data, given.sets, given.withhold_intrinsics):
                campaign.run(image_set)
                add_command(given.out, command)
                write_tables(given.out, given.page)
        write_tables(given.out, given.page)
    except SnakesfmError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


def describe_command(given: argparse.Namespace) -> str:
    """The command that made the results, with names in the place of this machine's folders."""
    parts = ["python -m benchmarks.compare --data DATA --out OUT"]
    parts += [f"--sets {shlex.join(given.sets)}"] if given.sets else []
    parts += [f"--seeds {given.seeds} --large-seeds {given.large_seeds} --threads {given.threads}"]
    parts += [f"--methods {shlex.join(given.methods)}"] if set(given.methods) != set(METHODS) else []
    parts += ["--withhold-intrinsics"] if given.withhold_intrinsics else []
    parts += ["--retime"] if given.retime else []
    return " ".join(parts)


def add_command(folder: Path, command: str) -> None:
    """Add a command to those that made the results, unless it is among them."""
    commands = read_commands(folder)
    if command not in commands:
        (folder / "command.txt").write_text("".join(f"{one}\n" for one in [*commands, command]), "utf-8")


def read_commands(folder: Path) -> list[str]:
    """The commands that made the results, the first one first."""
    file = folder / "command.txt"
    return file.read_text("utf-8").splitlines() if file.is_file() else []


def write_tables(folder: Path, page: Path | None) -> None:
    """Write the page, and the CSV file beside it."""
    page = page or folder / "benchmarks.md"
    results = read_results(folder / "results")
    commands = read_commands(folder) or ["python -m benchmarks.compare"]
    page.write_text(render_page(results, describe_machine(PACKAGES), commands), "utf-8")
    page.with_suffix(".csv").write_text(render_csv(results), "utf-8")


def _stop(number: int, _: object) -> None:
    """End as an exception does, so that what is being measured is ended too."""
    sys.exit(128 + number)


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, _stop)
    sys.exit(main(sys.argv[1:]))
