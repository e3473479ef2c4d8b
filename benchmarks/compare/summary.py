"""Medians over seeds, ratios to the better peer, and where snakesfm wins and loses. Pure functions."""

import statistics
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

from benchmarks.compare.results import OURS, PEERS, Result

Key = tuple[str, str, str]
TIE = 0.1


@dataclass(frozen=True)
class Column:
    """One column of the tables.

    Attributes
    ----------
    key, title : its name in the CSV file, and above it in the tables.
    larger_is_better : None where neither is.
    digits : behind the point.
    of_failure : the value of a run without a model; None leaves the run out.
    value : takes it from a result; None where the result has none.
    timing : a wall clock or processor time, which others on the machine disturb.
    """

    key: str
    title: str
    larger_is_better: bool | None
    digits: int
    of_failure: float | None
    value: Callable[[Result], float | None]
    timing: bool = False


def _metric(
    key: str, title: str, larger: bool | None, digits: int, of_failure: float | None = None
) -> Column:
    return Column(key, title, larger, digits, of_failure, lambda result: result.metrics.get(key))


def _cost(stage: str, attribute: str, title: str, timing: bool = True) -> Column:
    def value(result: Result) -> float | None:
        cost = result.stages.get(stage)
        return None if cost is None else float(getattr(cost, attribute))

    return Column(f"{stage}_{attribute}", title, False, 1 if timing else 0, None, value, timing)


ACCURACY = (
    _metric("registered_images", "registered", True, 0, 0.0),
    *(_metric(f"relative_pose_auc_{t}deg", f"AUC@{t}", True, 2, 0.0) for t in ("1", "3", "5")),
    *(_metric(f"pose_auc_{t}deg", f"global@{t}", True, 2, 0.0) for t in ("1", "2.5", "5", "10", "20")),
    _metric("position_error_median", "position error", False, 4),
    _metric("position_error_percent_median", "% of extent", False, 3),
    _metric("points", "points", None, 0),
    _metric("track_length_mean", "track length", None, 2),
    _metric("reprojection_error_px_mean", "error px", None, 3),
)
COSTS = (
    *(_cost(stage, "seconds", f"{stage} s") for stage in ("extract", "match", "map", "total")),
    *(_cost(stage, "cpu_seconds", f"{stage} CPU s") for stage in ("extract", "match", "map", "total")),
    Column(
        "peak_mib",
        "peak MiB",
        False,
        0,
        None,
        lambda result: max((cost.peak_mib for cost in result.stages.values()), default=None),
    ),
)
COLUMNS = ACCURACY + COSTS


@dataclass(frozen=True)
class Spread:
    """Median, least and greatest over the seeds; ``disturbed`` where no run was left alone."""

    median: float
    least: float
    greatest: float
    disturbed: bool = False


def group(results: Iterable[Result]) -> dict[Key, list[Result]]:
    """Results by set, setting and method."""
    groups: dict[Key, list[Result]] = {}
    for result in results:
        groups.setdefault((result.image_set, result.setting, result.method), []).append(result)
    return groups


def spread(column: Column, results: Iterable[Result]) -> Spread | None:
    """A column over the seeds; None where no result has it.

    Timings are of undisturbed runs where there are some, else the shortest: the load of others only adds.
    """
    values, disturbed = [], False
    runs = list(results)
    if column.timing:
        calm = [result for result in runs if result.undisturbed and not result.failure]
        disturbed, runs = not calm, calm or runs
    for result in runs:
        value = column.of_failure if result.failure else column.value(result)
        if value is not None:
            values.append(float(value))
    if not values:
        return None
    middle = min(values) if disturbed else statistics.median(values)
    return Spread(middle, min(values), max(values), disturbed)


def best_peer(
    column: Column, groups: Mapping[Key, list[Result]], image_set: str, setting: str
) -> Spread | None:
    """The better median of COLMAP's two mappers; None where neither has one or neither end is better."""
    if column.larger_is_better is None:
        return None
    found = [
        one
        for peer in PEERS
        if (one := spread(column, groups.get((image_set, setting, peer), []))) is not None
    ]
    choose = max if column.larger_is_better else min
    return choose(found, key=lambda one: one.median, default=None)


def ratio(column: Column, ours: Spread | None, peer: Spread | None) -> tuple[float, bool] | None:
    """How many times better than the peer, above 1 where snakesfm is, and whether either was disturbed.

    None where that cannot be said, and for a wall clock where only one of the two was left alone: that
    would compare loads.
    """
    if ours is None or peer is None:
        return None
    if column.timing and "cpu" not in column.key and ours.disturbed != peer.disturbed:
        return None
    better, worse = (ours, peer) if column.larger_is_better else (peer, ours)
    if worse.median <= 0:
        return None
    return better.median / worse.median, ours.disturbed or peer.disturbed


def ratios(
    groups: Mapping[Key, list[Result]], image_set: str, setting: str
) -> dict[str, tuple[float, bool] | None]:
    """For every column, the ratio of snakesfm's median to the better peer's."""
    found = {}
    for column in COLUMNS:
        ours = spread(column, groups.get((image_set, setting, OURS), []))
        found[column.key] = ratio(column, ours, best_peer(column, groups, image_set, setting))
    return found


def gap(key: str, groups: Mapping[Key, list[Result]], image_set: str, setting: str) -> float | None:
    """Snakesfm's median minus the better peer's."""
    column = next(column for column in COLUMNS if column.key == key)
    ours = spread(column, groups.get((image_set, setting, OURS), []))
    peer = best_peer(column, groups, image_set, setting)
    return None if ours is None or peer is None else ours.median - peer.median


def speed(
    key: str, groups: Mapping[Key, list[Result]], image_set: str, setting: str, method: str
) -> tuple[float, bool] | None:
    """How many times faster snakesfm is than ``method`` in a cost, as :func:`ratio` says it."""
    column = next(column for column in COLUMNS if column.key == key)
    ours = spread(column, groups.get((image_set, setting, OURS), []))
    return ratio(column, ours, spread(column, groups.get((image_set, setting, method), [])))


def verdict(difference: float | None, tie: float = TIE) -> str:
    """Better, equal or worse, of a difference where more is better; '' where there is none."""
    if difference is None:
        return ""
    return "better" if difference > tie else "worse" if difference < -tie else "equal"


def tally(differences: Iterable[float | None], tie: float = TIE) -> dict[str, int]:
    """How often snakesfm is better, equal and worse."""
    verdicts = [verdict(difference, tie) for difference in differences]
    return {name: verdicts.count(name) for name in ("better", "equal", "worse")}
