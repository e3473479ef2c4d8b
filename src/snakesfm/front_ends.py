"""Front-ends by name: their detectors and matchers, what fits together, and the weights they need."""

import shlex
from collections.abc import Mapping
from dataclasses import dataclass

from snakesfm.errors import ConfigError


@dataclass(frozen=True)
class FrontEnd:
    """The methods of extract_features and match_pairs that a name stands for."""

    detector: str
    matcher: str


FRONT_ENDS: dict[str, FrontEnd] = {
    "sift": FrontEnd("sift", "mutual_ratio"),
    "aliked+lightglue": FrontEnd("aliked", "lightglue"),
    "disk+lightglue": FrontEnd("disk", "lightglue"),
    "xfeat+lighterglue": FrontEnd("xfeat", "lightglue"),
    "superpoint+lightglue": FrontEnd("superpoint", "lightglue"),
    "superpoint+superglue": FrontEnd("superpoint", "superglue"),
    "loftr": FrontEnd("sift", "loftr"),
    "virtual": FrontEnd("virtual", "virtual"),
    "virtual_places": FrontEnd("sift", "virtual_places"),
    "imported": FrontEnd("imported", "imported"),
}

LEARNED_DESCRIPTORS = ("netvlad", "megaloc")
LEARNED_DETECTORS = ("aliked", "disk", "xfeat", "superpoint")
LEARNED_METHODS = (*LEARNED_DETECTORS, "lightglue", "superglue", "loftr", *LEARNED_DESCRIPTORS)
# matchers that need no keypoints; a detector then serves the choice of pairs alone
DETECTOR_FREE = ("loftr", "virtual_places")
# the detectors whose keypoints a matcher understands; the others take any
TRAINED_ON: dict[str, tuple[str, ...]] = {
    "lightglue": LEARNED_DETECTORS,
    "superglue": ("superpoint",),
    "virtual": ("virtual",),
    "imported": ("imported",),
}


def check_methods(detector: str, matcher: str) -> None:
    """Refuse a matcher that knows nothing of a detector's descriptors.

    Raises
    ------
    ConfigError : they do not fit together.
    """
    detectors = TRAINED_ON.get(matcher)
    if detectors is not None and detector not in detectors:
        raise ConfigError(
            f"match_pairs.method '{matcher}' cannot match the keypoints of extract_features.method "
            f"'{detector}': use one of {', '.join(detectors)}, or set both at once with front_end="
            f"{next(name for name, end in FRONT_ENDS.items() if end.matcher == matcher)}."
        )


def needed_weights(stage: str, method: str, detector: str) -> list[str]:
    """The models whose weight files a stage reads, keys of ``learned.weights.WEIGHT_FILES``.

    Parameters
    ----------
    stage : name of the stage.
    method : its method.
    detector : the method of extract_features.
    """
    known = {
        "extract_features": LEARNED_DETECTORS,
        "match_pairs": ("loftr",),
        "describe_images": LEARNED_DESCRIPTORS,
    }
    if method in known.get(stage, ()):
        return [method]
    if stage == "match_pairs" and method in ("lightglue", "superglue"):
        return [f"{detector}_{method}"]
    return []


def fetch_command(front_end: str, methods: Mapping[str, str], weights: str) -> str:
    """The command that fetches the weights of a run, as a shell takes it, in any folder.

    Parameters
    ----------
    front_end : name of the front-end, or "" where the methods were named.
    methods : method by stage, of the stages that may have a network.
    weights : the run's folder of weights.
    """
    named = {stage: method for stage, method in methods.items() if method in LEARNED_METHODS}
    chosen = [f"front_end={front_end}"] if front_end else []
    chosen += [
        f"{stage}={{method: {method}}}"
        for stage, method in named.items()
        if not front_end or stage not in ("extract_features", "match_pairs")
    ]
    command = ["snakemake", "--cores", "1", "fetch_weights", "--config", *chosen, f"weights={weights}"]
    return shlex.join(command)
