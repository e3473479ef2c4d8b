"""Adjustment of large models with a selection of their points; the others follow with fixed cameras."""

from collections.abc import Container
from dataclasses import dataclass

import numpy as np

from snakesfm.arrays import Array
from snakesfm.bundle.interface import BundleAdjuster, SolverSettings
from snakesfm.bundle.model import BundleModel, to_reconstruction
from snakesfm.bundle.reading import Tracks, read_tracks, read_tracks_and_pixels
from snakesfm.geometry.camera import Camera
from snakesfm.geometry.colmap_binding import pycolmap
from snakesfm.geometry.colmap_writing import keypoints_of_observations
from snakesfm.grouping import offsets_of, rows_of_each

STEPS = 5
OBSERVATIONS_AT_ONCE = 500_000


def select_points(point_rows: Array, images: Array, count: int, per_image: int, seed: int) -> Array:
    """Points that are among the first ``per_image`` of any image, those seen by most images first.

    So every image keeps as many observations as it has, up to ``per_image`` and somewhat more, and the
    points are those that tie most images together (track selection as in GLOMAP, Pan et al., ECCV 2024,
    and 1DSfM's cover). Ties are drawn: rows of keypoints may follow their places in the image.

    Parameters
    ----------
    point_rows, images : (L,) int, point and image of each observation.
    count : number of points.
    per_image : observations that an image is to keep.
    seed : of the draw.

    Returns
    -------
    (count,) bool.
    """
    lengths = np.bincount(point_rows, minlength=count)
    order = np.lexsort((np.random.default_rng(seed).permutation(count), -lengths))
    rank = np.empty(count, dtype=np.int64)
    rank[order] = np.arange(count)
    by_image = np.argsort(images.astype(np.int64) * count + rank[point_rows])
    sizes = np.bincount(images)
    place = np.arange(len(images)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    chosen = np.zeros(count, dtype=bool)
    chosen[point_rows[by_image[place < per_image]]] = True
    return chosen


def adjust_selection(
    reconstruction: pycolmap.Reconstruction,
    adjust: BundleAdjuster,
    solving: SolverSettings,
    per_image: int,
    seed: int,
) -> tuple[float, float]:
    """One pass of a solver on the points of :func:`select_points`, then all other points by themselves.

    Parameters
    ----------
    reconstruction : changed in place: intrinsics, poses and points.
    adjust, solving : the solver and what it is told.
    per_image, seed : how points are chosen.

    Returns
    -------
    The robust cost of the chosen points before and after, px^2.
    """
    tracks, pixels = read_tracks_and_pixels(reconstruction)
    ids, points = tracks.ids, tracks.points
    if not len(points):
        return 0.0, 0.0
    chosen = select_points(tracks.point_rows, tracks.images, len(points), per_image, seed)
    small = with_points(reconstruction, tracks, pixels, chosen)
    others = ~chosen[tracks.point_rows]
    followers, owners = np.unique(tracks.point_rows[others], return_inverse=True)
    images, pixels = tracks.images[others].astype(np.int32), pixels[others]
    # the solver needs the memory
    del tracks, others
    costs = adjust(small, solving)
    points[chosen] = read_tracks(small).points
    for camera_id, camera in small.cameras.items():
        reconstruction.camera(camera_id).params = camera.params
    for image_id in small.reg_image_ids():
        image = reconstruction.image(image_id)
        image.frame.set_cam_from_world(image.camera_id, small.image(image_id).cam_from_world())
    views = _Views.of(reconstruction, images, pixels)
    points[followers] = follow_cameras(points[followers], owners, views, solving.loss_scale_px)
    for point_id, xyz in zip(ids.tolist(), points, strict=True):
        reconstruction.point3D(point_id).xyz = xyz
    return costs


def with_points(
    reconstruction: pycolmap.Reconstruction,
    tracks: Tracks,
    pixels: Array,
    chosen: Array,
    split: Container[int] = (),
) -> pycolmap.Reconstruction:
    """The cameras and poses with some of the points, and only the keypoints that observe them.

    Parameters
    ----------
    reconstruction : gives the cameras and poses.
    tracks, pixels : its observations, see :func:`read_tracks_and_pixels`.
    chosen : (T,) bool, the points.
    split : ids of cameras of which each image gets a copy of its own.
    """
    mine = chosen[tracks.point_rows]
    images = tracks.images[mine]
    count = max(reconstruction.images)
    camera_ids = np.zeros(count, dtype=np.int64)
    rotations, translations = np.full((count, 3, 3), np.nan), np.full((count, 3), np.nan)
    camera_count = max(reconstruction.cameras)
    cameras = [Camera.of_pycolmap(reconstruction.camera(row + 1)) for row in range(camera_count)]
    for image_id, image in sorted(reconstruction.images.items()):
        camera_ids[image_id - 1] = image.camera_id - 1
        if image.camera_id in split:
            camera_ids[image_id - 1] = len(cameras)
            cameras.append(cameras[image.camera_id - 1])
        if image.has_pose:
            pose = image.cam_from_world()
            rotations[image_id - 1], translations[image_id - 1] = pose.rotation.matrix(), pose.translation
    keypoints, keypoint_ids = keypoints_of_observations(images, pixels[mine], count)
    lengths = np.bincount(tracks.point_rows, minlength=len(chosen))[chosen]
    model = BundleModel(
        tuple(cameras),
        camera_ids,
        rotations,
        translations,
        tracks.points[chosen],
        offsets_of(lengths),
        images,
        keypoint_ids,
    )
    return to_reconstruction(model, keypoints, [str(row) for row in range(count)])


@dataclass(frozen=True)
class _Views:
    """Observations with what the cameras make of them.

    Parameters
    ----------
    images : (L,) int, row of the image.
    rays : (L,2) undistorted points on the plane z = 1; not finite where there is none.
    rotations, translations : (N,3,3), (N,3) cam_from_world.
    focals_px : (N,) mean focal length.
    """

    images: Array
    rays: Array
    rotations: Array
    translations: Array
    focals_px: Array

    @classmethod
    def of(cls, reconstruction: pycolmap.Reconstruction, images: Array, pixels: Array) -> "_Views":
        count = max(reconstruction.images)
        rotations, translations = np.zeros((count, 3, 3)), np.zeros((count, 3))
        focals, cameras = np.ones(count), np.zeros(count, dtype=np.int64)
        for image_id in reconstruction.reg_image_ids():
            image = reconstruction.image(image_id)
            pose = image.cam_from_world()
            rotations[image_id - 1], translations[image_id - 1] = pose.rotation.matrix(), pose.translation
            cameras[image_id - 1] = image.camera_id
            focals[image_id - 1] = reconstruction.camera(image.camera_id).mean_focal_length()
        rays = np.full((len(images), 2), np.nan)
        for camera_id, rows in rows_of_each(cameras[images]):
            rays[rows] = reconstruction.camera(camera_id).cam_from_img(pixels[rows])
        return cls(images, rays, rotations, translations, focals)

    def part(self, rows: slice) -> "_Views":
        """Some of the observations."""
        return _Views(self.images[rows], self.rays[rows], self.rotations, self.translations, self.focals_px)


def follow_cameras(points: Array, owners: Array, views: _Views, scale_px: float) -> Array:
    """Points (T,3) adjusted with the cameras held: Gauss-Newton with the weights of Cauchy's loss.

    Errors are taken on the plane z = 1 and multiplied by the focal length. A step that does not lower the
    loss of its point is not made.

    Parameters
    ----------
    points : (T,3) where they were.
    owners : (L,) int, ascending: point of each observation; every point has one.
    views : the observations.
    scale_px : where the loss sets in.
    """
    moved = points.copy()
    offsets = np.searchsorted(owners, np.arange(len(points) + 1))
    start = 0
    while start < len(points):
        end = int(np.searchsorted(offsets, offsets[start] + OBSERVATIONS_AT_ONCE, side="right")) - 1
        end = max(start + 1, end)
        rows = slice(int(offsets[start]), int(offsets[end]))
        moved[start:end] = _follow(points[start:end], owners[rows] - start, views.part(rows), scale_px)
        start = end
    return moved


def _follow(points: Array, owners: Array, views: _Views, scale_px: float) -> Array:
    starts = np.searchsorted(owners, np.arange(len(points)))
    rotations, translations = views.rotations[views.images], views.translations[views.images]
    squared_focals = views.focals_px[views.images] ** 2

    def errors(at: Array) -> tuple[Array, Array, Array, Array]:
        """Depths (L,), places on z = 1 (L,2), offsets (L,2) and losses (T,) px^2."""
        in_camera = np.einsum("lij,lj->li", rotations, at[owners]) + translations
        depths = in_camera[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            places = in_camera[:, :2] / depths[:, None]
            offsets = places - views.rays
            squares = squared_focals * np.einsum("li,li->l", offsets, offsets)
        squares = np.where((depths > 0) & np.isfinite(squares), squares, (1e3 * scale_px) ** 2)
        losses = np.add.reduceat(np.log1p(squares / scale_px**2), starts)
        return depths, places, offsets, losses

    depths, places, offsets, losses = errors(points)
    for _ in range(STEPS):
        usable = (depths > 0) & np.isfinite(offsets).all(axis=1)
        depths = np.where(usable, depths, 1.0)
        places, offsets = (np.where(usable[:, None], values, 0.0) for values in (places, offsets))
        squares = squared_focals * np.einsum("li,li->l", offsets, offsets)
        weights = np.where(usable, squared_focals / (1.0 + squares / scale_px**2), 0.0)
        jacobian = rotations[:, :2] - places[..., None] * rotations[:, 2:]
        jacobian /= depths[:, None, None]
        weighted = jacobian * weights[:, None, None]
        normal = np.add.reduceat(np.einsum("lki,lkj->lij", weighted, jacobian), starts)
        right = np.add.reduceat(np.einsum("lki,lk->li", weighted, offsets), starts)
        # a little of the trace keeps points of nearly parallel rays from running away
        damping = 1e-9 * np.trace(normal, axis1=1, axis2=2) + 1e-300
        step = np.linalg.solve(normal + damping[:, None, None] * np.eye(3), right[..., None])[..., 0]
        tried = points - step
        found = errors(tried)
        better = found[3] < losses
        if not better.any():
            break
        points = np.where(better[:, None], tried, points)
        depths, places, offsets, losses = errors(points) if not better.all() else found
    return points
