"""The page of what was measured."""

from collections import defaultdict

import numpy as np

from benchmarks.machine import describe_machine, today

PACKAGES = ("snakesfm", "pycolmap", "gtsam", "numpy")
Row = dict[str, str]
"""Values of a row by its columns; those that do not apply are empty."""


def render(rows: list[Row]) -> str:
    """Markdown: rotations, then positions, each over seeds; before them an overview of positions."""
    origins: dict[str, dict[str, None]] = {}
    for row in rows:
        origins.setdefault(row.get("made") or describe_origin(), {})[row["command"]] = None
    made = [
        line
        for origin, commands in origins.items()
        for line in (f"{origin}. Made by", "", *(f"- `{command}`" for command in commands), "")
    ]
    positioned = [row for row in rows if row["positions"]]
    return "\n".join(
        [
            "# The back-end on view graphs with known truth",
            "",
            *made,
            "Seconds are of the processor, of all threads; MiB are the largest memory above what Python,"
            " the libraries and the problem take. Cells are the median over seeds, in brackets the smallest"
            " and the largest.",
            *(overview(positioned) if positioned else []),
            *rotation_table([row for row in rows if not row["positions"]]),
            *(position_table(positioned) if positioned else []),
            "",
        ]
    )


def describe_origin() -> str:
    """Date, machine and versions of what is measured now."""
    return f"{today()}, {describe_machine(PACKAGES)}"


def overview(rows: list[Row]) -> list[str]:
    """Lines: position errors by method and share of wrong pairs, over families and seeds."""
    shares = sorted({float(row["outliers"]) for row in rows})
    columns = " | ".join(f"{share:.0%}" for share in shares)
    lines = [
        "",
        "## Positions at a glance",
        "",
        "Mean position error in per cent of the scene's extent, over the images that have a centre: the"
        " median over families and seeds, and in brackets the largest; *failed* counts problems without a"
        " result. Columns: share of wrong pairs. *Placed*: images that have a centre, on average and at"
        " least.",
        "",
        f"| cameras | rotations | positions | {columns} | placed | s |",
        "|---|---|---|" + "---|" * (len(shares) + 2),
    ]
    for (cameras, method, positions), group in _grouped(rows, "cameras", "method", "positions").items():
        cells = []
        for share in shares:
            mine = [row for row in group if float(row["outliers"]) == share]
            values = _values(mine, "mean_percent")
            failed = len(mine) - len(values)
            cell = f"{np.median(values):.3f} ({max(values):.3f})" if values else ""
            cells.append(f"{cell} {failed} failed".strip() if failed else cell)
        placed = [count / int(cameras) for count in _values(group, "images")] or [0.0]
        cells.append(f"{np.mean(placed):.0%} ({min(placed):.0%})")
        seconds = f"{np.median(_values(group, 'cpu_s') or [np.nan]):.1f}"
        lines.append(f"| {cameras} | {method} | {positions} | {' | '.join(cells)} | {seconds} |")
    return lines


def rotation_table(rows: list[Row]) -> list[str]:
    """Lines: mean and median rotation error of each problem and method, and their ratios to COLMAP's."""
    lines = [
        "",
        "## Rotations",
        "",
        "Errors in degrees after alignment by the median rotation: the mean over images, and the median."
        " *Ratio* is to COLMAP's default on the same problems. *Oracle* is weighted least squares on the"
        " right edges alone, started at the truth.",
        "",
        "| problem | cameras | outliers | coherent | method | images"
        " | mean | ratio | median | ratio | s | MiB |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    groups = _grouped(rows, "problem", "cameras", "outliers", "coherent", "method")
    for (name, cameras, outliers, coherent, method), group in groups.items():
        repeats = "yes" if int(coherent) else "no"
        head = f"| {name} | {cameras} | {float(outliers):.0%} | {repeats} | {method} |"
        images = _values(group, "images")
        means, medians = _values(group, "mean_deg"), _values(group, "median_deg")
        if not means:
            lines.append(f"{head} {group[0]['failure']} | | | | | | |")
            continue
        base = groups.get((name, cameras, outliers, coherent, "colmap"), [])
        cells = [
            f"{np.median(images):.0f}",
            _spread(means),
            _ratio(means, _values(base, "mean_deg")),
            f"{np.median(medians):.3f}",
            _ratio(medians, _values(base, "median_deg")),
            f"{np.median(_values(group, 'cpu_s')):.1f}",
            f"{max(_values(group, 'peak_mib')):.0f}",
        ]
        lines.append(f"{head} {' | '.join(cells)} |")
    return lines


def position_table(rows: list[Row]) -> list[str]:
    """Lines: rotation and position errors of each problem, method of rotations and method of positions."""
    lines = [
        "",
        "## Positions",
        "",
        "Mean rotation error in degrees; mean and median position error in per cent of the scene's extent"
        " after a robust Sim(3) alignment, over the images that have a centre. Seconds and MiB are of"
        " positioning alone.",
        "",
        "| family | cameras | outliers | rotations | positions | images | rotation error | position error"
        " | median | s | MiB |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    groups = _grouped(rows, "problem", "cameras", "outliers", "method", "positions")
    for (name, cameras, outliers, method, positions), group in groups.items():
        head = f"| {name} | {cameras} | {float(outliers):.0%} | {method} | {positions} |"
        errors = _values(group, "mean_percent")
        if not errors:
            lines.append(f"{head} {group[0]['failure']} | | | | | |")
            continue
        cells = [
            f"{np.median(_values(group, 'images')):.0f}",
            f"{np.median(_values(group, 'mean_deg')):.3f}",
            _spread(errors),
            f"{np.median(_values(group, 'median_percent')):.3f}",
            f"{np.median(_values(group, 'cpu_s')):.1f}",
            f"{max(_values(group, 'peak_mib')):.0f}",
        ]
        lines.append(f"{head} {' | '.join(cells)} |")
    return lines


def _grouped(rows: list[Row], *keys: str) -> dict[tuple[str, ...], list[Row]]:
    groups: dict[tuple[str, ...], list[Row]] = defaultdict(list)
    for row in rows:
        groups[tuple(row[key] for key in keys)].append(row)
    return dict(groups)


def _values(rows: list[Row], column: str) -> list[float]:
    return [float(row[column]) for row in rows if not row["failure"]]


def _spread(values: list[float]) -> str:
    return f"{np.median(values):.3f} ({min(values):.3f} to {max(values):.3f})"


def _ratio(values: list[float], base: list[float]) -> str:
    return f"{np.median(values) / np.median(base):.2f}" if base else ""
