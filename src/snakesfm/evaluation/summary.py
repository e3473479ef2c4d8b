"""What the metrics of a model come to, in a few words."""

import re
from typing import Any

RELATIVE_AUC = re.compile(r"relative_pose_auc_(.+)deg")


def describe_accuracy(metrics: dict[str, Any]) -> str:
    """A clause on how near a model is to its reference; empty where there is none."""
    if "reference_images" not in metrics:
        return ""
    images, present = metrics["reference_images"], metrics["reference_images_present"]
    if not present:
        return ", no image name occurs in the reference, so nothing is evaluated"
    found = [area for area in map(RELATIVE_AUC.fullmatch, metrics) if area]
    found.sort(key=lambda area: float(area[1]))
    areas = "/".join(f"{metrics[area[0]]:.1f}" for area in found)
    thresholds = "/".join(area[1] for area in found)
    share = f" over the reference's {images} images, {present} of them here" if present < images else ""
    return f", relative-pose AUC {areas} at {thresholds} deg{share}"
