"""export_database: features, matches and two-view geometries as a COLMAP database."""

import os
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

from snakesfm.artifacts import (
    CalibratedCameras,
    ImageIndex,
    LocalFeatures,
    PairMatches,
    TwoViewGeometries,
    temporary_folder,
)
from snakesfm.artifacts.pairs import KINDS
from snakesfm.geometry.camera import Camera, cameras_from_columns
from snakesfm.stages.job import StageJob

if TYPE_CHECKING:
    import pycolmap

    from snakesfm.config.export_database import ExportDatabaseOptions

SIFT_SIZE = 128
# what COLMAP's tables take before anything is in them, with room to spare
EMPTY_DATABASE_BYTES = 1_000_000


def run(job: StageJob) -> None:
    """Write the database, complete or not at all, holding one block or tile in memory at a time.

    Raises
    ------
    OSError : the disk is full before the database has its tables; later SQLite ends the process.
    """
    from snakesfm.export.database import write_cameras, write_images, write_positions
    from snakesfm.geometry.colmap_binding import pycolmap
    from snakesfm.geometry.colmap_files import lack_of_space

    options: ExportDatabaseOptions = job.options
    index = ImageIndex.read(job.path("index"))
    cameras = cameras_from_columns(*CalibratedCameras.read(job.path("cameras")).camera_columns)
    with temporary_folder(job.output.parent) as temporary:
        path = temporary / job.output.name
        try:
            database = pycolmap.Database.open(path)
        except RuntimeError:
            # pycolmap says no more than that it failed
            if shutil.disk_usage(temporary).free < EMPTY_DATABASE_BYTES:
                raise lack_of_space(job.output.parent) from None
            raise
        try:
            with pycolmap.DatabaseTransaction(database):
                write_cameras(database, cameras)
                write_images(database, [str(image) for image in index.names], index.camera_ids)
                write_positions(database, index.gps, index.camera_ids)
            for file in job.paths("features"):
                with pycolmap.DatabaseTransaction(database):
                    _write_features(database, file, options.descriptors)
            accepted = matched = 0
            for matches, geometries in zip(job.paths("matches"), job.paths("geometries"), strict=True):
                with pycolmap.DatabaseTransaction(database):
                    matched += _write_matches(database, matches)
                    accepted += _write_geometries(database, geometries, cameras, index.camera_ids)
        finally:
            database.close()
        with path.open("rb+") as stream:
            os.fsync(stream.fileno())
        path.replace(job.output)
    print(
        f"export_database: {len(index.names)} images, {len(cameras)} cameras, "
        f"{matched} pairs with matches, {accepted} with a two-view geometry; for COLMAP "
        f"{pycolmap.__version__} or newer",
        flush=True,
    )


def _write_features(database: "pycolmap.Database", path: Path, descriptors: bool) -> None:
    """Keypoints of one block's images, and descriptors if wanted."""
    from snakesfm.export.database import keypoint_rows, sift_descriptors

    with LocalFeatures.open(path) as file:
        offsets = file["offsets"][()].tolist()
        for row, image in enumerate(file["image_ids"][()].tolist()):
            part = slice(offsets[row], offsets[row + 1])
            keypoints = keypoint_rows(file["keypoints"][part], file["scales"][part], file["angles"][part])
            database.write_keypoints(image + 1, keypoints)
            # COLMAP's own descriptors are SIFT's; it cannot hold those of networks
            column = file["descriptors"]
            if descriptors and column.dtype == "uint8" and column.shape[1] == SIFT_SIZE:
                database.write_descriptors(image + 1, sift_descriptors(column[part]))


def _write_matches(database: "pycolmap.Database", path: Path) -> int:
    """Putative matches of one tile's pairs; how many pairs have some."""
    tile = PairMatches.read(path)
    count = 0
    for row, (i, j) in enumerate(tile.pairs.tolist()):
        matches = tile.matches[tile.offsets[row] : tile.offsets[row + 1]]
        if len(matches):
            database.write_matches(i + 1, j + 1, matches.astype("uint32"))
            count += 1
    return count


def _write_geometries(
    database: "pycolmap.Database", path: Path, cameras: list[Camera], camera_ids: Any
) -> int:
    """Two-view geometries of one tile's accepted pairs; how many there are."""
    from snakesfm.export.database import calibrated_geometry, panoramic_geometry

    tile = TwoViewGeometries.read(path)
    accepted = (tile.rejections == 0).nonzero()[0].tolist()
    for row in accepted:
        i, j = tile.pairs[row].tolist()
        inliers = tile.inliers[tile.offsets[row] : tile.offsets[row + 1]]
        if KINDS[tile.kinds[row]] == "rotation_only":
            pair = (cameras[camera_ids[i]], cameras[camera_ids[j]])
            geometry = panoramic_geometry(tile.rotations[row], inliers, pair)
        else:
            geometry = calibrated_geometry(tile.rotations[row], tile.translations[row], inliers)
        database.write_two_view_geometry(i + 1, j + 1, geometry)
    return len(accepted)
