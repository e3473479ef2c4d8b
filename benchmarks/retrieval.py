"""How many of the pairs that truly overlap each choice of pairs finds, at equal numbers of pairs.

    python -m benchmarks.retrieval --out DIR [--weights DIR] [--sets NAME ...] [--choices NAME ...]

Two images overlap truly where the reference model shows at least 10 of its points in both, so sets whose
reference has no points are left out. Descriptors are made by the workflow as users run it, into
DIR/CHOICE/out/SET. DIR/retrieval.json holds what is there so far. It is measured again where snakesfm, the
set or --options are others than before; --page writes docs/retrieval.md.
"""

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import ROOT
from benchmarks.compare.measure import CommandError, run_measured
from benchmarks.compare.sets import ImageSet
from benchmarks.markdown import markdown_head, markdown_row
from benchmarks.on_sets import Run, SetTable, Value, finished
from snakesfm.arrays import Array
from snakesfm.artifacts import GlobalDescriptors, ImageIndex
from snakesfm.config.select_pairs import SelectPairsOptions
from snakesfm.evaluation.colmap_model import read_model
from snakesfm.retrieval.pairs import natural_key, similarities_of
from snakesfm.retrieval.preview import look_at_pairs
from snakesfm.stages.select_pairs import read_previews

PAGE = ROOT / "docs" / "retrieval.md"
SHARED_POINTS = 10
# pairs per image that a choice may take
BUDGETS = (3, 5, 10)
# by the largest keypoints, as select_pairs looks at pairs
LOOK = "look at sift"
# what describes the images of each choice that retrieves; 'sequential' looks at nothing but names
RETRIEVED: dict[str, tuple[str, ...]] = {
    LOOK: (),
    "vlad of sift": (),
    "vlad of aliked": ("extract_features={method: aliked}",),
    "vlad of xfeat": ("extract_features={method: xfeat}",),
    "netvlad": ("describe_images={method: netvlad}",),
    "megaloc": ("describe_images={method: megaloc}",),
}
# what can be measured in minutes with the weights that Python packages hold
USUAL = ("sequential", LOOK, "vlad of sift", "vlad of aliked", "vlad of xfeat")


def overlapping_pairs(image_set: ImageSet, names: Sequence[str]) -> Array:
    """Which pairs of images share points of the reference, (N,N) bool, upper triangle."""
    rows = {name: row for row, name in enumerate(names)}
    model = read_model(image_set.reference)
    seen = np.zeros((len(names), max(len(model.points3D), 1)), np.float32)
    columns = {number: column for column, number in enumerate(model.points3D)}
    for image in model.images.values():
        if image.name in rows:
            for point in image.points2D:
                if point.has_point3D():
                    seen[rows[image.name], columns[point.point3D_id]] = 1
    return np.triu(seen @ seen.T >= SHARED_POINTS, 1)


def rank_pairs(similarities: Array) -> Array:
    """Pairs (P,2), best first: by the better of the ranks that two images have for each other.

    Ties go to the more similar. Images choose in turn, as they do in select_pairs, and pairs of a
    similarity of -inf are left out, as there.

    Parameters
    ----------
    similarities : (N,N), symmetric; the diagonal is not looked at.
    """
    values = np.where(np.eye(len(similarities), dtype=bool), -np.inf, similarities)
    order = np.argsort(-values, axis=1, kind="stable")
    ranks = np.empty_like(order)
    np.put_along_axis(ranks, order, np.arange(len(values))[None].repeat(len(values), 0), axis=1)
    first, second = np.triu_indices(len(values), 1)
    best = np.minimum(ranks[first, second], ranks[second, first])
    chosen = np.lexsort((-values[first, second], best))
    return np.column_stack([first, second])[chosen[np.isfinite(values[first, second][chosen])]]


def recalls(pairs: Array, overlapping: Array) -> list[float]:
    """Percent of the overlapping pairs among the first pairs, for every budget."""
    total = max(int(overlapping.sum()), 1)
    hits = overlapping[pairs.min(axis=1), pairs.max(axis=1)]
    return [100 * float(hits[: budget * len(overlapping)].sum()) / total for budget in BUDGETS]


def measure(image_set: ImageSet, choice: str, run: Run) -> dict[str, Any]:
    """Recall of one choice of pairs in one set at each budget, or why there is none."""
    if choice == "sequential":
        names = sorted(image_set.image_names())
        order = np.argsort(np.array(sorted(range(len(names)), key=lambda row: natural_key(names[row]))))
        similarities = -np.abs(order[:, None] - order[None]).astype(float)
    else:
        folder = run.out / choice.replace(" ", "_")
        folder.mkdir(parents=True, exist_ok=True)
        config = [f"images={image_set.images}", "output=out", f"scene={image_set.name}", *run.options]
        config += ["select_pairs={method: retrieval}", *RETRIEVED[choice]]
        command = [sys.executable, "-m", "snakemake", "--snakefile", str(ROOT / "Snakefile")]
        command += ["--profile", str(ROOT / "profiles" / "local"), "--cores", str(run.threads)]
        until = "extract_features" if choice == LOOK else "describe_images"
        command += ["--until", until, "--config", *config]
        try:
            run_measured(command, folder, folder / f"{image_set.name}.log", run.limit_s)
        except CommandError as error:
            return {"failure": str(error)}
        scene = folder / "out" / image_set.name
        names = [str(name) for name in ImageIndex.read(scene / "index_images" / "index.h5").names]
        similarities = (_likenesses if choice == LOOK else _similarities)(scene, len(names))
    overlapping = overlapping_pairs(image_set, names)
    every = len(names) * (len(names) - 1) // 2
    return {
        "images": len(names),
        "pairs": every,
        "overlapping": int(overlapping.sum()),
        "recalls": recalls(rank_pairs(similarities), overlapping),
    }


def _likenesses(scene: Path, count: int) -> Array:
    """How much the largest keypoints of all pairs resemble each other, (N,N)."""
    files = sorted((scene / "extract_features").glob("*.h5"))
    most = SelectPairsOptions().preview_keypoints
    previews = read_previews(files, count, most)
    pairs = np.column_stack(np.triu_indices(count, 1))
    values = np.zeros((count, count))
    values[tuple(pairs.T)] = look_at_pairs(pairs, previews, most)
    return values + values.T


def _similarities(scene: Path, count: int) -> Array:
    """Similarities (N,N) of the images' global descriptors, as select_pairs has them."""
    described: dict[int, Array] = {}
    for path in sorted((scene / "describe_images").glob("*.h5")):
        block = GlobalDescriptors.read(path)
        described |= dict(zip(block.image_ids.tolist(), block.descriptors, strict=True))
    vectors = np.stack([described[row] for row in range(count)])
    return similarities_of(vectors, vectors)


def render(values: Mapping[str, Value], sets: Sequence[str], choices: Sequence[str]) -> str:
    """Markdown: a table of recall by set, choice and budget, and the mean over sets that all finished."""
    lines = [
        "# Retrieval",
        "",
        "Generated by `python -m benchmarks.retrieval --page`; do not edit.",
        "",
        "Recall: percentage of the truly overlapping pairs among the best pairs of each method, if it may",
        f"choose {', '.join(map(str, BUDGETS))} pairs per image. Two images overlap if they share at least",
        f"{SHARED_POINTS} points of the reference. `look at sift` ranks pairs by a preview of the largest",
        "keypoints; `possible` is the recall without a wrong pair, `by chance` that of random pairs.",
    ]
    head = ["choice", *(f"{budget} per image" for budget in BUDGETS)]
    for name in sets:
        found = {one: values.get(f"{name}|{one}", {}) for one in choices}
        known = next((value for value in found.values() if "recalls" in value), None)
        if known is None:
            continue
        title = f"## {name}: {known['images']} images, "
        title += f"{known['overlapping']} of {known['pairs']} pairs overlap"
        lines += ["", title, "", *markdown_head(head)]
        taken = [min(budget * known["images"], known["pairs"]) for budget in BUDGETS]
        ceiling = [100 * min(1, count / max(known["overlapping"], 1)) for count in taken]
        for choice, value in found.items():
            cells = [f"{part:.1f}" for part in value.get("recalls", [])]
            lines.append(markdown_row([choice, *(cells or [value.get("failure", "not run"), "", ""])]))
        lines.append(markdown_row(["possible", *(f"{part:.1f}" for part in ceiling)]))
        lines.append(
            markdown_row(["by chance", *(f"{100 * count / known['pairs']:.1f}" for count in taken)])
        )
    # a choice that was not measured everywhere leaves the others the mean of all sets
    everywhere = [choice for choice in choices if all(finished(values, name, choice) for name in sets)]
    means = [everywhere] if everywhere else []
    means += [list(choices)] if everywhere != list(choices) else []
    for chosen in means:
        complete = [name for name in sets if all(finished(values, name, choice) for choice in chosen)]
        if not complete:
            continue
        lines += ["", f"## Mean of {len(complete)} sets", "", *markdown_head(head)]
        for choice in chosen:
            mean = np.mean([values[f"{name}|{choice}"]["recalls"] for name in complete], axis=0)
            lines.append(markdown_row([choice, *(f"{part:.1f}" for part in mean)]))
    return "\n".join(lines) + "\n"


TABLE = SetTable(
    "retrieval",
    __doc__,
    PAGE,
    "--choices",
    ("sequential", *RETRIEVED),
    USUAL,
    measure,
    render,
    accepts=lambda image_set: bool(read_model(image_set.reference).points3D),
)

if __name__ == "__main__":
    sys.exit(TABLE.main(sys.argv[1:]))
