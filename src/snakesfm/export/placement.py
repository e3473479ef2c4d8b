"""The place of a model on the earth, and what a user should know of it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from snakesfm.arrays import Array
from snakesfm.export.georeference import (
    LEAST_IMAGES,
    Georeference,
    georeference,
    taking_order,
)
from snakesfm.geometry.earth import local_origin
from snakesfm.geometry.poses import center_of, downward_axes, has_pose, translation_of

NO_GPS = "no image of the model has GPS in EXIF"
FEW_POSITIONS = f"only {{count}} images of the model have GPS in EXIF, and {LEAST_IMAGES} are needed"
NO_ALTITUDE = (
    "{count} images of the model have GPS without altitude in EXIF, and fewer than "
    f"{LEAST_IMAGES} with it: write GPSAltitude into EXIF"
)
NO_SIMILARITY = "no four of the positions agree with the model"

UNPLACED = "The model is not georeferenced by the GPS positions in EXIF: {reason}."
WANTED = "georeference is true, but the model is not georeferenced: {reason}."
UNTRUSTED = (
    "georeference is true, but the GPS positions in EXIF do not determine {model} reliably: {reason}."
)

OWN_FRAMES = ", each in its own coordinate frame"
ONE_FRAME = ", all in metres east, north and up from the origin in summary.json"
SOME_PLACED = (
    ", each model in its own coordinate frame but for those in metres east, north and up from the origin "
    "in summary.json (georeference_of_models): {folders}"
)
# more would make a sentence long
MOST_FOLDERS = 5


@dataclass(frozen=True)
class Placement:
    """Where a model is.

    Parameters
    ----------
    place : by which the model is moved, None where it stays in the coordinate frame of the adjustment.
    doubt : why there is no place, or why it is not to be relied on, a clause; empty where all is well and
        where none is wanted or no image has GPS.
    """

    place: Georeference | None
    doubt: str

    def move(self, rotations: Array, translations: Array, points: Array) -> tuple[Array, Array, Array]:
        """Poses and points in metres east, north and up; as they are where there is no place.

        Parameters
        ----------
        rotations, translations : (N,3,3) and (N,3) cam_from_world.
        points : (T,3).
        """
        if self.place is None:
            return rotations, translations, points
        to_local = self.place.local_from_model
        centers = to_local.transform_points(center_of(rotations, translations))
        turned = to_local.transform_rotations(rotations)
        return turned, translation_of(turned, centers), to_local.transform_points(points)


def placement_summary(placements: Sequence[Placement], names: Sequence[str]) -> dict[str, Any]:
    """What summary.json says of the places of all models, with the names of all images."""
    places = [placement.place and placement.place.summary(names) for placement in placements]
    return {
        "georeference": places[0],
        "georeference_refused": None if places[0] else placements[0].doubt or None,
        "georeference_of_models": places,
    }


def placement_warnings(placements: Sequence[Placement], names: Sequence[str], is_wanted: bool) -> list[str]:
    """Why the first model has no place, why places are not to be relied on, and steps of altitude."""
    warnings = []
    for number, each in enumerate(placements):
        model = f"sparse/{number}" if number else "the model"
        if each.place is not None:
            warnings += [
                f"sparse/{number}: {line}" if number else line for line in each.place.warnings(names)
            ]
        if each.doubt and each.place is not None:
            warnings.append(UNTRUSTED.format(model=model, reason=each.doubt))
        elif each.doubt and number == 0:
            warnings.append((WANTED if is_wanted else UNPLACED).format(reason=each.doubt))
    return warnings


def describe_frames(placements: Sequence[Placement]) -> str:
    """The end of a sentence about separate models: which share a coordinate frame."""
    placed = [f"sparse/{number}" for number, each in enumerate(placements) if each.place is not None]
    if not placed:
        return OWN_FRAMES
    if len(placed) == len(placements):
        return ONE_FRAME
    more = ["others"] if len(placed) > MOST_FOLDERS else []
    return SOME_PLACED.format(folders=", ".join(placed[:MOST_FOLDERS] + more))


def find_placement(
    rotations: Array,
    translations: Array,
    orientations: Array,
    gps: Array,
    names: Sequence[str],
    wanted: Literal["auto"] | bool,
    seed: int,
) -> Placement:
    """Where EXIF says that the model is.

    Parameters
    ----------
    rotations, translations : (N,3,3) and (N,3) cam_from_world, NaN where not registered in the model.
    orientations, gps, names : EXIF and name of each image, as :func:`downward_axes`,
        :func:`georeference` and :func:`taking_order` want them.
    wanted : False to leave the model where it is, True to move it even if positions are not to be trusted.
    seed : of the random draws.
    """
    if wanted is False:
        return Placement(None, "")
    mine = gps[has_pose(rotations, translations)]
    on_map = np.isfinite(mine[:, :2]).all(axis=1)
    in_space = int(np.isfinite(mine).all(axis=1).sum())
    count = int(on_map.sum())
    if not count:
        some = np.isfinite(gps[:, :2]).all(axis=1).any()
        return Placement(None, NO_GPS if some or wanted is True else "")
    if in_space < LEAST_IMAGES:
        few = count < LEAST_IMAGES
        return Placement(
            None, FEW_POSITIONS.format(count=count) if few else NO_ALTITUDE.format(count=count - in_space)
        )
    # of all images, so that all models share it
    origin = local_origin(gps)
    assert origin is not None
    place = georeference(
        center_of(rotations, translations),
        downward_axes(rotations, orientations),
        gps,
        origin,
        taking_order(names),
        seed,
    )
    if place is None:
        return Placement(None, NO_SIMILARITY)
    return Placement(place if place.trusted or wanted is True else None, place.refusal)
