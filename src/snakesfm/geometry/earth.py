"""Positions on the earth in a local coordinate frame in metres."""

import numpy as np

from snakesfm.arrays import Array

Origin = tuple[float, float, float]


def local_origin(gps: Array) -> Origin | None:
    """The median position of all images that have one, None where none has.

    Parameters
    ----------
    gps : (N,3) latitude and longitude in degrees, altitude in metres, WGS84; NaN where unknown.
    """
    known = gps[np.isfinite(gps).all(axis=1)]
    if not len(known):
        return None
    # counted from one of them, longitudes do not jump at the 180th meridian
    first = known[0, 1]
    eastward = (known[:, 1] - first + 180.0) % 360.0 - 180.0
    latitude, altitude = np.median(known[:, [0, 2]], axis=0).tolist()
    longitude = (first + float(np.median(eastward)) + 180.0) % 360.0 - 180.0
    return latitude, float(longitude), altitude


def local_metres(gps: Array, origin: Origin) -> Array:
    """Metres east, north and up (N,3) of an origin; NaN where unknown. Parameters as in local_origin."""
    from snakesfm.geometry.colmap_binding import pycolmap

    metres = np.full(gps.shape, np.nan)
    known = np.isfinite(gps).all(axis=1)
    if known.any():
        metres[known] = pycolmap.GPSTransform().ellipsoid_to_enu(gps[known], *origin)
    return metres
