"""Points that follow cameras which were adjusted without them."""

from dataclasses import dataclass

import numpy as np

from snakesfm.arrays import Array
from snakesfm.geometry.colmap_binding import pycolmap
from snakesfm.grouping import rows_of_each

STEPS = 5
# of its loss, what a step of a point gains if another is to follow
LEAST_GAIN = 1e-4
# so that the arrays stay in a core's cache
OBSERVATIONS_AT_ONCE = 10_000
# squared error of a point behind the camera, over the squared scale of the loss
WITHOUT_ERROR = 1e6
# entries of a symmetric matrix, and where they are in it
UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
FULL = [0, 1, 2, 1, 3, 4, 2, 4, 5]


@dataclass(frozen=True)
class Views:
    """Observations with what the cameras make of them. Each number has a row of its own, which is faster.

    Parameters
    ----------
    images : (L,) int, row of the image.
    rays : (2,L) undistorted points on the plane z = 1; not finite where there is none.
    cameras : (13,N) rotation by rows, and translation, cam_from_world; mean focal length.
    """

    images: Array
    rays: Array
    cameras: Array

    @classmethod
    def of(cls, reconstruction: pycolmap.Reconstruction, images: Array, pixels: Array) -> "Views":
        """Observations of the registered images of a model, by the row of the image and the pixel (L,2)."""
        count = max(reconstruction.images)
        columns, cameras = np.zeros((13, count)), np.zeros(count, dtype=np.int64)
        for image_id in reconstruction.reg_image_ids():
            image = reconstruction.image(image_id)
            pose = image.cam_from_world()
            cameras[image_id - 1] = image.camera_id
            focal = reconstruction.camera(image.camera_id).mean_focal_length()
            columns[:, image_id - 1] = (*pose.rotation.matrix().ravel(), *pose.translation, focal)
        rays = np.full((2, len(images)), np.nan)
        for camera_id, rows in rows_of_each(cameras[images]):
            rays[:, rows] = reconstruction.camera(camera_id).cam_from_img(pixels[rows]).T
        return cls(images, rays, columns)


def follow_cameras(points: Array, owners: Array, views: Views, scale_px: float) -> Array:
    """Points (T,3) adjusted with the cameras held: Gauss-Newton with the weights of Cauchy's loss.

    Errors are taken on the plane z = 1 and multiplied by the focal length. A step that does not lower the
    loss of its point is not made, and no other follows it, nor one that lowers it by little.

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
        part = _Part(owners[rows] - start, views.rays[:, rows], views.cameras[:, views.images[rows]])
        moved[start:end] = _follow(points[start:end].T, part, scale_px).T
        start = end
    return moved


def _follow(points: Array, part: "_Part", scale_px: float) -> Array:
    """The same for points (3,T)."""
    moved, going = points.copy(), np.arange(points.shape[1])
    errors = part.errors(points, scale_px)
    for _ in range(STEPS):
        tried = moved[:, going] - part.step(errors, scale_px)
        found = part.errors(tried, scale_px)
        gains = errors.losses - found.losses
        better = gains > 0
        moved[:, going[better]] = tried[:, better]
        far = gains > LEAST_GAIN * errors.losses
        if not far.any():
            break
        going, rows = going[far], far[part.owners]
        part, errors = part.of(far, rows), found.of(far, rows)
    return moved


@dataclass(frozen=True)
class _Errors:
    """Reprojection errors of points (T) in their observations (L).

    Parameters
    ----------
    depths : (L,) in the camera, 1 where there is no error.
    places, offsets : (2,L) on the plane z = 1, and how far they are from the ray, 0 where there is none.
    squares : (L,) px^2, infinite where there is none.
    losses : (T,) sums of Cauchy's losses, over the square of its scale.
    """

    depths: Array
    places: Array
    offsets: Array
    squares: Array
    losses: Array

    def of(self, points: Array, rows: Array) -> "_Errors":
        """Those of some points (T,) bool and their observations (L,) bool."""
        return _Errors(
            self.depths[rows],
            self.places[:, rows],
            self.offsets[:, rows],
            self.squares[rows],
            self.losses[points],
        )


@dataclass(frozen=True)
class _Part:
    """Observations of some points.

    Parameters
    ----------
    owners : (L,) int, ascending: point of each observation; every point has one.
    rays, cameras : (2,L) and (13,L), see :class:`Views`.
    """

    owners: Array
    rays: Array
    cameras: Array

    def of(self, points: Array, rows: Array) -> "_Part":
        """Those of some of the points (T,) bool, which are ``rows`` (L,) bool."""
        owners = (np.cumsum(points) - 1)[self.owners[rows]]
        return _Part(owners, self.rays[:, rows], self.cameras[:, rows])

    def sums(self, values: Array, count: int) -> Array:
        """Sums (..., T) over the observations (..., L) of each of the ``count`` points T."""
        starts = np.searchsorted(self.owners, np.arange(count))
        return np.add.reduceat(values, starts, axis=-1)

    def errors(self, points: Array, scale_px: float) -> _Errors:
        """The errors of points (3,T)."""
        x, y, z = points[:, self.owners]
        r, t = self.cameras[:9], self.cameras[9:12]
        depths = r[6] * x + r[7] * y + r[8] * z + t[2]
        with np.errstate(divide="ignore", invalid="ignore"):
            places = np.stack(
                [r[0] * x + r[1] * y + r[2] * z + t[0], r[3] * x + r[4] * y + r[5] * z + t[1]]
            )
            places /= depths
            offsets = places - self.rays
            squares = self.cameras[12] ** 2 * (offsets[0] ** 2 + offsets[1] ** 2)
        shares = squares / scale_px**2
        none = ~((depths > 0) & np.isfinite(squares))
        depths[none], shares[none], squares[none] = 1.0, WITHOUT_ERROR, np.inf
        places[:, none], offsets[:, none] = 0.0, 0.0
        return _Errors(depths, places, offsets, squares, self.sums(np.log1p(shares), points.shape[1]))

    def step(self, errors: _Errors, scale_px: float) -> Array:
        """What (3,T) a step of Gauss-Newton takes off the points."""
        # nothing where there is no error, as its square is infinite
        weights = self.cameras[12] ** 2 / (1.0 + errors.squares / scale_px**2)
        r = self.cameras
        inverse = 1.0 / errors.depths
        u, v = errors.places
        first = [(r[k] - u * r[6 + k]) * inverse for k in range(3)]
        second = [(r[3 + k] - v * r[6 + k]) * inverse for k in range(3)]
        flat = np.empty((9, len(weights)))
        for row, (i, j) in enumerate(UPPER):
            flat[row] = weights * (first[i] * first[j] + second[i] * second[j])
        for i in range(3):
            flat[6 + i] = weights * (first[i] * errors.offsets[0] + second[i] * errors.offsets[1])
        sums = self.sums(flat, len(errors.losses))
        normal = sums[FULL].T.reshape(-1, 3, 3)
        # a little of the trace keeps points of nearly parallel rays from running away
        damping = 1e-9 * np.trace(normal, axis1=1, axis2=2) + 1e-300
        return np.linalg.solve(normal + damping[:, None, None] * np.eye(3), sums[6:].T[..., None])[..., 0].T
