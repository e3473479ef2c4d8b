"""What the tables of image set by method share: their options, their store of results, and their rows."""

import argparse
import json
import os
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks import ROOT
from benchmarks.compare.inputs import inputs_of, source_digest
from benchmarks.compare.sets import DATA, ImageSet, read_sets
from snakesfm.errors import SnakesfmError

Value = Mapping[str, Any]


@dataclass(frozen=True)
class Run:
    """How every result of a table is made.

    Parameters
    ----------
    out : folder of results and working files.
    options : items for ``--config`` of every run.
    threads, limit_s : processors, and the longest time of one run in seconds.
    """

    out: Path
    options: tuple[str, ...]
    threads: int
    limit_s: float


@dataclass(frozen=True)
class SetTable:
    """A table of image set by method that one command measures, stores and writes.

    Parameters
    ----------
    name : of the module in ``benchmarks``, whose files are DIR/NAME.json and .md.
    text : the module's description.
    page : what ``--page`` writes.
    option : the name of the command's option of methods.
    methods, usual : all methods, and those measured where the command names none.
    measure : the result of one set and method, with the key ``failure`` where there is none.
    render : the page of results by 'SET|METHOD', of sets and of methods.
    accepts : which image sets can be in the table.
    """

    name: str
    text: str
    page: Path
    option: str
    methods: Sequence[str]
    usual: Sequence[str]
    measure: Callable[[ImageSet, str, Run], dict[str, Any]]
    render: Callable[[Mapping[str, Value], Sequence[str], Sequence[str]], str]
    accepts: Callable[[ImageSet], bool] = lambda image_set: True

    def main(self, arguments: list[str]) -> int:
        """Measure what is asked for and not there yet, and write the tables; 1 where a set is not there."""
        given = self._parse(arguments)
        out = given.out.resolve()
        out.mkdir(parents=True, exist_ok=True)
        store = out / f"{self.name}.json"
        values: dict[str, dict[str, Any]] = json.loads(store.read_text("utf-8")) if store.is_file() else {}
        options = (f"weights={given.weights.resolve()}", *given.options)
        run = Run(out, options, given.threads, given.limit)
        try:
            sets = [one for one in read_sets(given.data, given.sets) if self.accepts(one)]
        except SnakesfmError as error:
            sys.stderr.write(f"{error}\n")
            return 1
        source = source_digest()
        for image_set in sets:
            inputs = inputs_of(image_set, source, *given.options)
            for method in given.methods:
                key = f"{image_set.name}|{method}"
                if finished(values, image_set.name, method) and values[key].get("inputs") == inputs:
                    continue
                values[key] = {"inputs": inputs, **self.measure(image_set, method, run)}
                print(f"{key}: {values[key]}", flush=True)
                store.write_text(json.dumps(values, indent=1, sort_keys=True) + "\n", "utf-8")
        text = self.render(values, [one.name for one in sets], given.methods)
        text += f"\nOptions of the workflow: {describe_options(given.options)}.\n"
        (out / f"{self.name}.md").write_text(text, "utf-8")
        if given.page:
            self.page.write_text(text, "utf-8")
        return 0

    def _parse(self, arguments: list[str]) -> argparse.Namespace:
        parser = argparse.ArgumentParser(
            prog=f"python -m benchmarks.{self.name}",
            description=self.text,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        add = parser.add_argument
        add("--out", type=Path, required=True, help="folder of results and working files")
        add("--weights", type=Path, default=Path("weights"), help="folder that fetch_weights filled")
        add("--data", type=Path, default=DATA, help="folder of the image sets")
        add("--sets", nargs="*", default=[], help="names of sets (all that can be measured)")
        add(self.option, dest="methods", nargs="*", choices=self.methods, default=list(self.usual))
        add("--options", nargs="*", default=[], help="more items for --config of every run")
        add("--threads", type=int, default=os.cpu_count())
        add("--limit", type=float, default=7200, help="longest time of one run in seconds")
        add("--page", action="store_true", help=f"write {self.page.relative_to(ROOT)} too")
        return parser.parse_args(arguments)


def describe_options(options: Sequence[str]) -> str:
    """What a page says of the options that all its runs had."""
    return f"`{shlex.join(options)}`, all others default" if options else "default"


def finished(values: Mapping[str, Value], name: str, method: str) -> bool:
    """Whether there is a result of a set and a method, and no failure."""
    value = values.get(f"{name}|{method}")
    return value is not None and "failure" not in value
