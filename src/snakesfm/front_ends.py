"""Front-ends by name: their detectors and matchers, what fits together, and the weights they need."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

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

LEARNED_DESCRIPTORS = ("netvlad", "salad")
LEARNED_DETECTORS = ("aliked", "disk", "xfeat", "superpoint")
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
            f"'{detector}': take one of {', '.join(detectors)}, or name both at once with front_end="
            f"{next(name for name, end in FRONT_ENDS.items() if end.matcher == matcher)}."
        )


def needed_weights(stage: str, options: Any, detector: str) -> list[str]:
    """The models whose weight files a stage reads, keys of ``learned.weights.WEIGHT_FILES``.

    Parameters
    ----------
    stage : name of the stage.
    options : its options.
    detector : the method of extract_features.
    """
    if stage == "extract_features" and options.method in LEARNED_DETECTORS:
        return [options.method]
    if stage == "match_pairs" and options.method in ("lightglue", "superglue"):
        return [f"{detector}_{options.method}"]
    if stage == "match_pairs" and options.method == "loftr":
        return [str(options.method)]
    if stage == "describe_images" and options.method in LEARNED_DESCRIPTORS:
        return [str(options.method)]
    return []


def fetch_command(front_end: str, methods: Mapping[str, str], weights: str, images: str) -> str:
    """The command that fetches the weights of a run.

    Parameters
    ----------
    front_end : name of the front-end, or "" where the methods were named.
    methods : method by stage.
    weights, images : the run's folders.
    """
    if front_end:
        chosen = [f"front_end={front_end}"]
    else:
        chosen = [f"'{stage}={{method: {method}}}'" for stage, method in methods.items()]
    return " ".join(["snakemake fetch_weights --config", *chosen, f"weights={weights}", f"images={images}"])
