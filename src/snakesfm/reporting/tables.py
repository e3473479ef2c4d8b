"""Rows of the report's tables, as text, numbers and None."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from snakesfm.arrays import Array
from snakesfm.reporting.registration import ImageCounts

IMAGE_HEADS = ["image", "registered", "pairs", "accepted", "kept edges", "observations", "mean error px"]
ROUND_HEADS = [
    "round",
    "images",
    "points",
    "observations",
    "cost before",
    "cost after",
    "mean error, detector px",
]
PLACE_HEADS = [
    "model",
    "origin: latitude, longitude, altitude",
    "images with position",
    "inliers",
    "median residual m",
    "horizontal m",
    "vertical m",
]
STATISTICS = ("median", "mean", "p90", "max")
AREAS = re.compile(r"(?P<row>.*_auc)_(?P<column>[\d.]+)deg")
ERRORS = re.compile(rf"(?P<row>.*)_(?P<column>{'|'.join(STATISTICS)})")


def label_counts(labels: Array, names: Sequence[str]) -> list[tuple[str, int]]:
    """How many items have which label, as (name, count) in the order of the labels, without zeros."""
    values, counts = np.unique(labels, return_counts=True)
    return [
        (names[value] if 0 <= value < len(names) else f"label {value}", count)
        for value, count in zip(values.tolist(), counts.tolist(), strict=True)
    ]


def bundle_rows(names: Array, counts: Array, costs: Array, errors_px: Array) -> list[list[Any]]:
    """One row per round of the adjustment, of what ``ROUND_HEADS`` names."""
    return [
        [str(names[k]), *counts[k].tolist(), *costs[k].tolist(), float(errors_px[k])]
        for k in range(len(names))
    ]


def place_rows(summary: Mapping[str, Any]) -> list[list[Any]]:
    """Where models were georeferenced, of what ``PLACE_HEADS`` names; no rows where none was."""
    residuals = [f"median_{kind}residual_m" for kind in ("", "horizontal_", "vertical_")]
    return [
        [
            f"sparse/{number}",
            "{:.6f}, {:.6f}, {:.2f} m".format(*place["origin_latitude_longitude_altitude"]),
            place["images_with_position"],
            place["inliers"],
            *(place[name] for name in residuals),
        ]
        for number, place in enumerate(summary.get("georeference_of_models", []))
        if place is not None
    ]


def metric_tables(metrics: Mapping[str, Any]) -> list[tuple[str, list[str], list[list[Any]]]]:
    """Title, heads and rows of the metrics' tables: areas by threshold, errors by statistic, the rest."""
    numbers = {
        name: value
        for name, value in metrics.items()
        if isinstance(value, int | float) and not isinstance(value, bool)
    }
    areas, errors = _grouped(numbers, AREAS), _grouped(numbers, ERRORS)
    thresholds = sorted({column for row in areas.values() for column in row}, key=float)
    others = [
        [_words(name), value]
        for name, value in numbers.items()
        if not AREAS.fullmatch(name) and not ERRORS.fullmatch(name)
    ]
    return [
        (
            "Accuracy: area under the recall curve, percent",
            ["poses", *(f"@{column} deg" for column in thresholds)],
            [[_words(row), *(cells.get(column) for column in thresholds)] for row, cells in areas.items()],
        ),
        (
            "Errors and sizes",
            ["quantity", *STATISTICS],
            [[_words(row), *(cells.get(column) for column in STATISTICS)] for row, cells in errors.items()],
        ),
        ("Counts", ["quantity", "value"], others),
    ]


def _grouped(numbers: Mapping[str, Any], pattern: re.Pattern[str]) -> dict[str, dict[str, Any]]:
    groups: dict[str, dict[str, Any]] = {}
    for name, value in numbers.items():
        match = pattern.fullmatch(name)
        if match:
            groups.setdefault(match["row"], {})[match["column"]] = value
    return groups


def _words(name: str) -> str:
    return name.replace("_", " ").replace("auc", "AUC")


def image_table(
    names: Sequence[str],
    counts: ImageCounts,
    per_image: Mapping[str, Mapping[str, float | str | None]],
    most: int,
) -> tuple[list[str], list[list[Any]], str]:
    """Heads and rows of the table of images, and a note where it does not show all.

    Parameters
    ----------
    per_image : errors of the scored images against the reference, may be empty.
    most : rows at most; those with the fewest observations are shown.
    """
    shown = np.arange(len(names))
    note = ""
    if len(names) > most:
        shown = np.sort(np.argsort(counts.observations, kind="stable")[:most])
        note = f"Only the {most:,} of {len(names):,} images with the fewest observations are shown."
    rows = []
    for image in shown.tolist():
        error = float(counts.mean_error_px[image])
        row: list[Any] = [
            names[image],
            "yes" if counts.registered[image] else "no",
            int(counts.pairs[image]),
            int(counts.accepted[image]),
            int(counts.kept[image]),
            int(counts.observations[image]),
            error if np.isfinite(error) else None,
        ]
        if per_image:
            scores = per_image.get(names[image], {})
            row += [scores.get("rotation_error_deg"), scores.get("position_error")]
        rows.append(row)
    scored = ["rotation error deg", "position error"] if per_image else []
    return [*IMAGE_HEADS, *scored], rows, note
