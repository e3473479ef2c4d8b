"""Removal of observations, points and images from the model between rounds."""

import heapq
from collections import Counter
from collections.abc import Collection

from snakesfm.geometry.colmap_binding import pycolmap


def filter_observations(
    reconstruction: pycolmap.Reconstruction,
    max_error_px: float,
    min_angle_deg: float,
    min_length: int = 2,
    sparse_observations: int = 0,
) -> None:
    """Drop observations with large errors, points with nearly parallel rays, and points too short.

    Parameters
    ----------
    reconstruction : changed in place.
    max_error_px : observations with larger errors, or behind the camera, are dropped one by one.
    min_angle_deg : points whose widest rays meet at less are dropped.
    min_length, sparse_observations : see :func:`drop_short_tracks`.
    """
    pycolmap.ObservationManager(reconstruction).filter_all_points3D(max_error_px, min_angle_deg)
    drop_short_tracks(reconstruction, min_length, sparse_observations)


def drop_short_tracks(
    reconstruction: pycolmap.Reconstruction, min_length: int, sparse_observations: int = 0
) -> None:
    """Drop points that too few images observe, but for those of images that see few others.

    Parameters
    ----------
    reconstruction : changed in place.
    min_length : observations that a point must have.
    sparse_observations : an image with fewer observations of such points keeps its shorter tracks too.
    """
    if min_length <= 2:
        return
    short = {
        point_id: {element.image_id for element in point.track.elements}
        for point_id, point in reconstruction.points3D.items()
        if point.track.length() < min_length
    }
    of_short = Counter(image_id for images in short.values() for image_id in images)
    sparse = {
        image_id
        for image_id in reconstruction.reg_image_ids()
        if reconstruction.image(image_id).num_points3D - of_short[image_id] < sparse_observations
    }
    for point_id, images in short.items():
        if not images & sparse:
            reconstruction.delete_point3D(point_id)


def deregister_weak_images(reconstruction: pycolmap.Reconstruction, min_observations: int) -> None:
    """Take out images that observe too few points, the weakest first.

    A point that is left with one observation goes with the image, which may make another image weak.

    Parameters
    ----------
    reconstruction : changed in place.
    min_observations : points that an image must observe.
    """
    counts = {i: reconstruction.image(i).num_points3D for i in reconstruction.reg_image_ids()}
    heap = [(count, image_id) for image_id, count in counts.items()]
    heapq.heapify(heap)
    while heap and heap[0][0] < min_observations:
        count, image_id = heapq.heappop(heap)
        if counts.get(image_id) != count:
            continue
        image = reconstruction.image(image_id)
        sharing = {
            element.image_id
            for keypoint in image.get_observation_points2D()
            for element in reconstruction.point3D(keypoint.point3D_id).track.elements
        }
        reconstruction.deregister_frame(image.frame_id)
        del counts[image_id]
        # points that two images saw are gone
        for other in sharing - {image_id}:
            counts[other] = reconstruction.image(other).num_points3D
            heapq.heappush(heap, (counts[other], other))


def deregister_images_alone(
    reconstruction: pycolmap.Reconstruction, camera_ids: Collection[int]
) -> frozenset[int]:
    """Take out those images of the cameras that no other registered image shares a camera with.

    Returns
    -------
    Ids of the cameras that are left without images.
    """
    gone = set()
    for camera_id in camera_ids:
        images = images_of(reconstruction, camera_id)
        if len(images) == 1:
            reconstruction.deregister_frame(reconstruction.image(images[0]).frame_id)
        if len(images) <= 1:
            gone.add(camera_id)
    return frozenset(gone)


def images_of(reconstruction: pycolmap.Reconstruction, camera_id: int) -> list[int]:
    """Ids of the registered images of a camera."""
    return [k for k in reconstruction.reg_image_ids() if reconstruction.image(k).camera_id == camera_id]
