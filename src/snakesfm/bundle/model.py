"""The model as arrays, and as a ``pycolmap.Reconstruction`` while it is worked on.

Ids of cameras, images and frames in the reconstruction are rows plus one.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from snakesfm.arrays import Array
from snakesfm.bundle.reading import read_tracks_and_pixels
from snakesfm.geometry.camera import Camera, observation_errors
from snakesfm.geometry.colmap_binding import pycolmap
from snakesfm.geometry.colmap_writing import with_observations
from snakesfm.geometry.poses import has_pose, to_rigid3d
from snakesfm.grouping import offsets_of


@dataclass(frozen=True)
class BundleModel:
    """Cameras, poses, points and observations.

    Parameters
    ----------
    cameras : intrinsics (C).
    camera_ids : (N,) int, camera of each image.
    rotations, translations : (N,3,3) and (N,3) float64 cam_from_world, NaN where not registered.
    points : (T,3) float64 in the world.
    offsets : (T+1,) int64, rows ``offsets[k]:offsets[k+1]`` of the next two belong to point k.
    image_ids, keypoint_ids : (L,) int32, row of the image, and of the keypoint in it.
    """

    cameras: tuple[Camera, ...]
    camera_ids: Array
    rotations: Array
    translations: Array
    points: Array
    offsets: Array
    image_ids: Array
    keypoint_ids: Array

    @property
    def registered(self) -> Array:
        """Which images (N,) bool have a pose."""
        return has_pose(self.rotations, self.translations)


def restrict_to(model: BundleModel, images: Array) -> BundleModel:
    """Poses and observations of some images (N,) bool, and the points that two of them observe."""
    kept = images[model.image_ids]
    point_of = np.repeat(np.arange(len(model.points)), np.diff(model.offsets))
    counts = np.bincount(point_of[kept], minlength=len(model.points))
    kept &= counts[point_of] >= 2
    lengths = counts[counts >= 2]
    return replace(
        model,
        rotations=np.where(images[:, None, None], model.rotations, np.nan),
        translations=np.where(images[:, None], model.translations, np.nan),
        points=model.points[counts >= 2],
        offsets=offsets_of(lengths),
        image_ids=model.image_ids[kept],
        keypoint_ids=model.keypoint_ids[kept],
    )


def to_reconstruction(
    model: BundleModel, keypoints: Sequence[Array], names: Sequence[str], images: Array | None = None
) -> pycolmap.Reconstruction:
    """The model for pycolmap.

    Parameters
    ----------
    model : observations by images that are not registered are left out.
    keypoints : per image (K_i,2), pixels.
    names : of the images.
    images : (N,) bool, those that take part, registered or not; all if None.
    """
    taking_part = np.ones(len(names), dtype=bool) if images is None else images
    posed = model.registered

    def image(row: int, **more: Array) -> pycolmap.Image:
        camera_id = int(model.camera_ids[row]) + 1
        return pycolmap.Image(name=str(names[row]), camera_id=camera_id, image_id=row + 1, **more)

    poses = pycolmap.Reconstruction()
    for row, camera in enumerate(model.cameras):
        poses.add_camera_with_trivial_rig(camera.to_pycolmap(row + 1))
    for row in np.flatnonzero(taking_part & posed).tolist():
        pose = to_rigid3d(model.rotations[row], model.translations[row])
        poses.add_image_with_trivial_frame(image(row), pose)
    seen = restrict_to(model, posed)
    reconstruction = with_observations(
        poses, keypoints, seen.points, seen.offsets, seen.image_ids, seen.keypoint_ids
    )
    # files hold images with a pose alone
    for row in np.flatnonzero(taking_part & ~posed).tolist():
        reconstruction.add_image_with_trivial_frame(image(row, keypoints=keypoints[row].astype(np.float64)))
    return reconstruction


def from_reconstruction(
    reconstruction: pycolmap.Reconstruction, model: BundleModel
) -> tuple[BundleModel, Array]:
    """The reconstruction as arrays, and the keypoints (L,2) float64 that are observations, in pixels.

    Points are sorted by their first observation, and observations by image.

    Parameters
    ----------
    reconstruction : what :func:`to_reconstruction` made of ``model``, changed since.
    model : gives the cameras' sources and which camera took each image.
    """
    cameras = tuple(
        Camera.of_pycolmap(reconstruction.camera(row + 1), camera.source)
        for row, camera in enumerate(model.cameras)
    )
    rotations = np.full((len(model.camera_ids), 3, 3), np.nan)
    translations = np.full((len(model.camera_ids), 3), np.nan)
    for image_id in reconstruction.reg_image_ids():
        pose = reconstruction.image(image_id).cam_from_world()
        rotations[image_id - 1] = pose.rotation.matrix()
        translations[image_id - 1] = pose.translation
    tracks, pixels = read_tracks_and_pixels(reconstruction)
    order = np.lexsort((tracks.rows, tracks.images, tracks.point_rows))
    images, rows = tracks.images[order], tracks.rows[order]
    offsets = np.searchsorted(tracks.point_rows, np.arange(len(tracks.points) + 1))
    rank = np.lexsort((rows[offsets[:-1]], images[offsets[:-1]]))
    lengths = np.diff(offsets)[rank]
    sorted_offsets = offsets_of(lengths)
    take = np.repeat(offsets[:-1][rank] - sorted_offsets[:-1], lengths) + np.arange(len(rows))
    result = BundleModel(
        cameras,
        model.camera_ids,
        rotations,
        translations,
        tracks.points[rank],
        sorted_offsets,
        images[take].astype(np.int32),
        rows[take].astype(np.int32),
    )
    return result, pixels[order][take]


def reprojection_errors(model: BundleModel, keypoints: Array) -> Array:
    """Distance (L,) in pixels of each observation from its projected point; inf behind the camera.

    Parameters
    ----------
    model : the model.
    keypoints : (L,2) pixels of the observations.
    """
    point_of = np.repeat(np.arange(len(model.points)), np.diff(model.offsets))
    return observation_errors(
        model.cameras,
        model.camera_ids,
        model.rotations,
        model.translations,
        model.points[point_of],
        model.image_ids,
        keypoints,
    )


def mean_point_errors(errors: Array, offsets: Array) -> Array:
    """Mean (T,) of flat errors (L,) per point."""
    if len(offsets) == 1:
        return np.zeros(0)
    return np.asarray(np.add.reduceat(errors, offsets[:-1]) / np.diff(offsets))
