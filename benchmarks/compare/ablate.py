"""What each option is worth: one change at a time, on all sets, re-making only what depends on it."""

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from benchmarks.compare.inputs import inputs_of, source_digest
from benchmarks.compare.measure import CommandError
from benchmarks.compare.methods import snakesfm
from benchmarks.compare.sets import ImageSet
from benchmarks.machine import today
from benchmarks.markdown import markdown_head, markdown_row
from snakesfm.config.configuration import load_configuration
from snakesfm.errors import ConfigError
from snakesfm.pipeline import STAGES

DEFAULT = "default"
AREA = "relative_pose_auc_1deg"
METRICS = (AREA, "relative_pose_auc_3deg", "relative_pose_auc_5deg", "reference_images_registered")
Overrides = Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True)
class Ablation:
    """A named change of some stages' options."""

    name: str
    overrides: Overrides

    @property
    def first_stage(self) -> int:
        """Place of the earliest stage that it changes."""
        return min((STAGES.index(stage) for stage in self.overrides), default=len(STAGES))

    def config(self) -> list[str]:
        """The items for ``--config``."""
        return [f"{stage}={json.dumps(options)}" for stage, options in sorted(self.overrides.items())]


def read_ablations(path: Path, names: Sequence[str]) -> list[Ablation]:
    """The default, then the named ablations of a file (all of them without names), late stages first.

    In that order no stage is made again for the sake of the option before.

    Raises
    ------
    ConfigError : a name that the file lacks, or an option that snakesfm does not know.
    """
    content: dict[str, Overrides] = yaml.safe_load(path.read_text("utf-8"))
    unknown = [name for name in names if name not in content]
    if unknown:
        raise ConfigError(f"{path} has no '{unknown[0]}': it has {', '.join(content)}.")
    for name, overrides in content.items():
        try:
            load_configuration(overrides)
        except ConfigError as error:
            raise ConfigError(f"{path}, '{name}': {error}") from None
    chosen = [Ablation(name, content[name]) for name in names or content]
    chosen.sort(key=lambda ablation: -ablation.first_stage)
    return [Ablation(DEFAULT, {}), *chosen]


def ablate(
    sets: Sequence[ImageSet], path: Path, names: Sequence[str], out: Path, threads: int, limit_s: float
) -> None:
    """Run all ablations on all sets, each set in one output folder; writes OUT/ablations.md and .json."""
    ablations = read_ablations(path, names)
    store = out / "ablations.json"
    values: dict[str, dict[str, Any]] = json.loads(store.read_text("utf-8")) if store.is_file() else {}
    digest = source_digest()
    for image_set in sets:
        for ablation in ablations:
            key = f"{image_set.name}|{ablation.name}"
            inputs = inputs_of(image_set, digest, *ablation.config())
            if values.get(key, {}).get("inputs") == inputs:
                continue
            values[key] = {"inputs": inputs, **_measure(image_set, ablation, out, threads, limit_s)}
            print(
                f"{image_set.name}, {ablation.name}: {values[key].get(AREA, values[key].get('failure'))}",
                flush=True,
            )
            store.write_text(json.dumps(values, indent=1, sort_keys=True) + "\n", "utf-8")
    areas = {key: value.get(AREA) for key, value in values.items()}
    truth = {image_set.name: image_set.truth for image_set in sets}
    text = render_ablations(areas, [ablation.name for ablation in ablations], truth, today())
    (out / "ablations.md").write_text(text, "utf-8")


def _measure(
    image_set: ImageSet, ablation: Ablation, out: Path, threads: int, limit_s: float
) -> dict[str, Any]:
    folder = out / "ablation" / image_set.name
    compared = out / "work" / image_set.name / "snakesfm-0"
    if compared.is_dir() and not folder.exists():
        # what the comparison has made already; Snakemake re-makes what is not up to date
        shutil.copytree(compared, folder, symlinks=True)
    metrics = folder / "out" / image_set.name / "evaluate_model" / "metrics.json"
    target = metrics.relative_to(folder).as_posix()
    try:
        snakesfm(image_set, folder, 0, threads, limit_s, ablation.config(), target)
    except CommandError as error:
        return {"failure": str(error)}
    content = json.loads(metrics.read_text("utf-8"))
    return {name: content[name] for name in METRICS}


def render_ablations(
    areas: Mapping[str, float | None], names: Sequence[str], truth: Mapping[str, bool], date: str
) -> str:
    """Markdown table of AUC@1 per option and set, and the mean change against the default.

    ``areas`` maps 'set|option' to the AUC, None where there is no model, which counts as 0.
    """
    titles = [f"{name}{'*' if is_truth else ''}" for name, is_truth in truth.items()]
    lines = [
        "# Ablations",
        "",
        f"Generated on {date} by `python -m benchmarks.compare ablate`; do not edit. Relative-pose AUC at 1 degree "
        "in per cent with one option changed; change: mean over the sets against the default. * marks independent references.",
        "",
        *markdown_head(["option", "change", "change on independent references", *titles]),
    ]
    for name in names:
        cells = [
            _mean_change(areas, name, list(truth)),
            _mean_change(areas, name, [item for item, is_truth in truth.items() if is_truth]),
        ]
        for image_set in truth:
            value = areas.get(f"{image_set}|{name}", 0.0)
            cells.append("failed" if value is None else f"{value:.2f}")
        lines.append(markdown_row([name, *cells]))
    return "\n".join(lines) + "\n"


def _mean_change(areas: Mapping[str, float | None], name: str, sets: Sequence[str]) -> str:
    """Mean difference to the default over the sets, with its sign; empty for the default itself."""
    if name == DEFAULT or not sets:
        return ""
    changes = [(areas.get(f"{s}|{name}") or 0.0) - (areas.get(f"{s}|{DEFAULT}") or 0.0) for s in sets]
    return f"{sum(changes) / len(changes):+.2f}"
