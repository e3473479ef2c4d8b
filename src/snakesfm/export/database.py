"""Features and two-view geometries as rows of a COLMAP database, through pycolmap."""

import numpy as np

from snakesfm.arrays import Array
from snakesfm.geometry.camera import Camera
from snakesfm.geometry.colmap_binding import pycolmap
from snakesfm.geometry.poses import to_rigid3d

UNSURE_SOURCES = ("default",)
KEYPOINT_FIELDS = 4


def database_camera(camera: Camera, camera_id: int) -> pycolmap.Camera:
    """The camera with COLMAP's flag that says whether its focal length is more than a guess."""
    row = camera.to_pycolmap(camera_id)
    row.has_prior_focal_length = camera.source not in UNSURE_SOURCES
    return row


def write_cameras(database: pycolmap.Database, cameras: list[Camera]) -> None:
    """Write cameras, each with a rig of its own that holds nothing else; ids are rows plus one."""
    for row, camera in enumerate(cameras):
        database.write_camera(database_camera(camera, row + 1), use_camera_id=True)
        rig = pycolmap.Rig(rig_id=row + 1)
        rig.add_ref_sensor(pycolmap.sensor_t(type=pycolmap.SensorType.CAMERA, id=row + 1))
        database.write_rig(rig, use_rig_id=True)


def write_images(database: pycolmap.Database, names: list[str], camera_ids: Array) -> None:
    """Write images, each with a frame of its own; ids are rows plus one.

    Parameters
    ----------
    names : N relative POSIX paths.
    camera_ids : (N,) int, row of each image's camera among those written.
    """
    for row, name in enumerate(names):
        camera_id = int(camera_ids[row]) + 1
        image = pycolmap.Image(name=name, camera_id=camera_id, image_id=row + 1)
        database.write_image(image, use_image_id=True)
        frame = pycolmap.Frame(frame_id=row + 1, rig_id=camera_id)
        frame.add_data_id(image.data_id)
        database.write_frame(frame, use_frame_id=True)


def write_positions(database: pycolmap.Database, gps: Array, camera_ids: Array) -> None:
    """Write pose priors of images of which all three are known, as COLMAP's own import does.

    Parameters
    ----------
    gps : (N,3) latitude and longitude in degrees, altitude in metres, NaN where unknown.
    camera_ids : (N,) int, row of each image's camera among those written.
    """
    for row in np.flatnonzero(np.isfinite(gps).all(axis=1)).tolist():
        sensor = pycolmap.sensor_t(type=pycolmap.SensorType.CAMERA, id=int(camera_ids[row]) + 1)
        prior = pycolmap.PosePrior(
            position=gps[row],
            coordinate_system=pycolmap.PosePriorCoordinateSystem.WGS84,
            corr_data_id=pycolmap.data_t(sensor_id=sensor, id=row + 1),
        )
        database.write_pose_prior(prior)


def keypoint_rows(keypoints: Array, scales: Array, angles: Array) -> Array:
    """COLMAP's keypoints (K,4) float32: x, y in pixels, scale (sigma) in pixels, orientation in radians.

    Parameters
    ----------
    keypoints : (K,2) pixels of the original image, first pixel's centre (.5, .5): COLMAP's convention.
    scales, angles : (K,) diameters in pixels (twice sigma), and radians.
    """
    rows = np.empty((len(keypoints), KEYPOINT_FIELDS), dtype=np.float32)
    rows[:, :2], rows[:, 2], rows[:, 3] = keypoints, np.asarray(scales) / 2.0, angles
    return rows


def sift_descriptors(descriptors: Array) -> pycolmap.FeatureDescriptors:
    """Descriptors (K,128) uint8 as COLMAP's SIFT descriptors."""
    return pycolmap.FeatureDescriptors(
        pycolmap.FeatureExtractorType.SIFT, np.ascontiguousarray(descriptors, dtype=np.uint8)
    )


def calibrated_geometry(rotation: Array, translation: Array, inliers: Array) -> pycolmap.TwoViewGeometry:
    """An accepted pair as COLMAP's calibrated two-view geometry: pose, essential matrix and inliers.

    Planar scenes are calibrated pairs too, because their pose is known and agrees with all inliers.

    Parameters
    ----------
    rotation, translation : (3,3), (3,) unit: pose of the second camera from the first.
    inliers : (M,2) keypoint rows in the first and in the second image.
    """
    pose = to_rigid3d(rotation, translation)
    geometry = pycolmap.TwoViewGeometry()
    geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
    geometry.E = pycolmap.essential_matrix_from_pose(pose)
    geometry.cam2_from_cam1 = pose
    geometry.inlier_matches = np.ascontiguousarray(inliers, dtype=np.uint32).reshape(-1, 2)
    return geometry


def panoramic_geometry(
    rotation: Array, inliers: Array, cameras: tuple[Camera, Camera]
) -> pycolmap.TwoViewGeometry:
    """An accepted pair without parallax as COLMAP's panoramic geometry: rotation, homography and inliers.

    Parameters
    ----------
    rotation : (3,3), second camera from the first.
    inliers : (M,2) keypoint rows in the first and in the second image.
    cameras : of the first and of the second image.
    """
    first, second = (camera.to_pycolmap().calibration_matrix() for camera in cameras)
    geometry = pycolmap.TwoViewGeometry()
    geometry.config = pycolmap.TwoViewGeometryConfiguration.PANORAMIC
    geometry.H = second @ rotation @ np.linalg.inv(first)
    geometry.cam2_from_cam1 = to_rigid3d(rotation, np.zeros(3))
    geometry.inlier_matches = np.ascontiguousarray(inliers, dtype=np.uint32).reshape(-1, 2)
    return geometry
