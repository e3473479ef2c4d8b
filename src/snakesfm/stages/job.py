"""The inputs, outputs and options of a stage, wherever it runs."""

import json
import os
import sys
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TextIO

from snakesfm.artifacts.base import Header
from snakesfm.cache import cached_path
from snakesfm.digests import settings_text
from snakesfm.seeding import derive_seed


class JobOptions:
    """The options of a stage in a job: the attributes of the stage's options model, read-only.

    They were validated when the Snakefile was parsed, so a job does without the models, whose library takes
    longer to load than many jobs to run.

    Parameters
    ----------
    values : the model's canonical JSON, parsed.
    stage_version : the model's.
    """

    stage_version: int

    def __init__(self, values: Mapping[str, Any], stage_version: int) -> None:
        for name, value in values.items():
            self.__dict__[name] = tuple(value) if isinstance(value, list) else value
        self.__dict__["stage_version"] = stage_version

    def __setattr__(self, name: str, value: Any) -> None:
        raise AttributeError(f"options are read-only: {name} cannot be set")

    def model_dump(self, include: Collection[str] | None = None) -> dict[str, Any]:
        """All options by name, or those in ``include``: the same as the model's ``model_dump()``."""
        names = self.__dict__.keys() - {"stage_version"}
        return {name: self.__dict__[name] for name in sorted(names) if include is None or name in include}

    def canonical_json(self) -> str:
        """The same text as the model's ``canonical_json()``."""
        return json.dumps(self.model_dump(), sort_keys=True)


@dataclass(frozen=True)
class StageJob:
    """One job of one stage.

    Parameters
    ----------
    stage : verb_noun name of the stage.
    scene : name of the scene.
    inputs : named inputs of the rule; a list where the rule gathers several files.
    outputs : the files of the rule; ``output`` is the first, and the only one of most stages. A stage with
        one file per tile gets only some of them and names the others itself.
    options : the stage's options: JobOptions in a job; the stage's options model will do as well.
    settings : what is no option but changes the result, such as the image folder or the number of blocks.
    seed : the run's seed.
    threads : how many threads may be used; results never depend on it.
    former : an earlier version of the output whose unchanged parts may be taken over, or None.
    batch_size : how many images or pairs a network gets at once; results never depend on it.
    terminal : where progress and warnings are said beside the log, or None.
    distrusted : files in the shared folder that could not be read whole; the job's own replace them.
    """

    stage: str
    scene: str
    inputs: Mapping[str, Any]
    outputs: tuple[Path, ...]
    options: Any
    settings: Mapping[str, Any] = field(default_factory=dict)
    seed: int = 0
    threads: int = 1
    former: Path | None = None
    batch_size: int | Literal["auto"] = "auto"
    terminal: TextIO | None = None
    distrusted: set[Path] = field(default_factory=set)

    @property
    def output(self) -> Path:
        """The artifact to write, complete or not at all."""
        return self.outputs[0]

    @property
    def header(self) -> Header:
        """The root attributes of the artifact that this job writes."""
        return Header(
            self.stage,
            self.options.stage_version,
            self.scene,
            self.options.canonical_json(),
            settings_text(self.settings, self.seed),
        )

    def path(self, name: str) -> Path:
        """The one file of a named input."""
        return Path(self.inputs[name])

    def paths(self, name: str) -> list[Path]:
        """All files of a named input, in the rule's order."""
        value = self.inputs[name]
        if isinstance(value, str | Path):
            value = [value]
        return [Path(item) for item in value]

    def seed_for(self, *names: str) -> int:
        """A seed for one random draw of this stage, from the run's seed and what it works on."""
        return derive_seed(self.seed, self.stage, *names)

    def read_weights(self, model: str) -> Mapping[str, Any]:
        """The weights of a network, by parameter; networks then use the job's threads.

        Raises
        ------
        ConfigError : they are not in the run's weights folder, torch is not installed, or there is no CUDA
            device where one is asked for.
        """
        from snakesfm.learned.checkpoints import read_checkpoint
        from snakesfm.learned.device import use_device, use_threads

        use_threads(self.threads)
        use_device(str(self.settings.get("device", "auto")))
        return read_checkpoint(model, Path(self.settings["weights"]), self.settings["fetch"])

    def network_batch(self) -> int:
        """How many images or pairs are worked on at once: one where the stage runs no network."""
        if not self.settings.get("models"):
            return 1
        from snakesfm.learned.batches import choose_batch_size

        return choose_batch_size(self.batch_size)

    def sources_digest(self) -> str:
        """A digest of the weights and known results that it reads, for the digests of what it makes."""
        known = str(self.settings.get("source_content", ""))
        models = self.settings.get("models", ())
        if not models:
            return known
        from snakesfm.learned.weights import weights_digest

        return weights_digest(models, Path(self.settings["weights"])) + known

    def take_over(
        self, digests: Sequence[str], read: Callable[[Path, set[str]], Mapping[str, Any]]
    ) -> dict[int, Any]:
        """Results of unchanged images or pairs by their place, from the former file and the shared folder.

        Parameters
        ----------
        digests : of all images or pairs of the output, in its order.
        read : reads what a file holds of the wanted digests; nothing is taken where it fails.
        """
        wanted = set(digests)
        taken: dict[str, Any] = {}
        cached = cached_path(self.stage, digests)
        for path in (self.former, cached):
            # unlike a Path, this says no of a folder that may not be entered
            if path is None or not os.path.isfile(path) or wanted <= taken.keys():  # noqa: PTH113
                continue
            found: Mapping[str, Any] = {}
            try:
                found = read(path, wanted)
            # what h5py and numpy raise on damage has no common kind, and everything can be computed again
            except Exception as error:
                print(f"{path} cannot be read ({type(error).__name__}), so nothing is taken over from it")
            taken.update(found)
            if path == cached and not wanted <= found.keys():
                # its name promises all of them
                self.distrusted.add(path)
        return {place: taken[digest] for place, digest in enumerate(digests) if digest in taken}

    def warn(self, sentence: str) -> None:
        """Say a warning in the log and on the terminal, where a stage's result has no place for it.

        A job of a block or tile says one sentence of all its images: there may be hundreds of such jobs.
        """
        sys.stderr.write(f"warning: {sentence}\n")
        if self.terminal is not None:
            print(f"snakesfm: scene '{self.scene}': warning: {sentence}", file=self.terminal, flush=True)

    def progress(self, total: int, what: str) -> "Progress":
        """A counter that prints how far the job is, at most every five seconds."""
        label = f"{self.scene}: {self.stage} {self.output.stem}"
        return Progress(label, total, what, self.terminal)


class Progress:
    """Counts work that is done and says so, in the log and on the terminal."""

    interval_s = 5.0

    def __init__(self, label: str, total: int, what: str, terminal: TextIO | None = None) -> None:
        self.label = label
        self.total = total
        self.what = what
        self.terminal = terminal
        self.done = 0
        self.last = time.monotonic()

    def step(self, count: int = 1) -> None:
        """Count ``count`` more items as done."""
        self.done += count
        now = time.monotonic()
        if now - self.last >= self.interval_s and self.done < self.total:
            self.last = now
            line = f"{self.label}: {self.done} of {self.total} {self.what}"
            for stream in filter(None, (sys.stderr, self.terminal)):
                print(line, file=stream, flush=True)
