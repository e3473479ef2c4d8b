"""Several models of a scene, each in its own coordinate frame: splitting and joining."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from snakesfm.arrays import Array
from snakesfm.bundle.model import BundleModel
from snakesfm.geometry.camera import Camera
from snakesfm.grouping import offsets_of
from snakesfm.view_graph.components import label_components


def tied_images(pairs: Array, posed: Array) -> Array:
    """Which images (N,) bool have a pose or are tied to posed ones by chains of pairs (P,2)."""
    labels = label_components(len(posed), pairs)
    return np.isin(labels, labels[posed])


def join_models(models: Sequence[BundleModel], cameras: tuple[Camera, ...]) -> tuple[BundleModel, Array]:
    """All models in one, and the model of each image (N,) int32, -1 where it is in none.

    No image is in two of them. ``cameras`` are the intrinsics of all.
    """
    first = models[0]
    labels = np.full(len(first.camera_ids), -1, dtype=np.int32)
    rotations, translations = first.rotations.copy(), first.translations.copy()
    for number, model in enumerate(models):
        mine = model.registered
        labels[mine] = number
        rotations[mine], translations[mine] = model.rotations[mine], model.translations[mine]
    lengths = np.concatenate([np.diff(model.offsets) for model in models])
    joined = replace(
        first,
        cameras=cameras,
        rotations=rotations,
        translations=translations,
        points=np.concatenate([model.points for model in models]),
        offsets=offsets_of(lengths),
        image_ids=np.concatenate([model.image_ids for model in models]),
        keypoint_ids=np.concatenate([model.keypoint_ids for model in models]),
    )
    return joined, labels
