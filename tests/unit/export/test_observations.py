"""What is filled in by COLMAP's binary files is what pycolmap makes of single objects, to the byte."""

import struct
from itertools import pairwise
from pathlib import Path

import cv2  # noqa: F401
import numpy as np
import pycolmap
import pytest

from snakesfm.errors import ConfigError
from snakesfm.export.colmap import build_reconstruction
from snakesfm.geometry import colmap_files
from snakesfm.geometry.camera import Camera
from snakesfm.geometry.colmap_checks import check_binary, check_ply, check_text
from snakesfm.geometry.poses import has_pose, to_rigid3d
from snakesfm.synthetic.problems import make_problem

COUNT = 30
# its images are of no camera that is exported, of no observation, and of another model
UNREGISTERED, UNOBSERVED, OTHERS = 4, 7, (20, 29)
NAMES = [f"day {k % 3}/ü 写真 {k:02}\U0001f4f7.jpg" for k in range(COUNT)]
CAMERAS = [
    Camera("PINHOLE", 640, 480, (500.0, 510.0, 320.0, 240.0)),
    Camera("OPENCV", 640, 480, (500.0, 510.0, 320.0, 240.0, 0.01, -0.02, 0.003, 1e-4)),
    Camera("SIMPLE_PINHOLE", 320, 240, (250.0, 160.0, 120.0)),
    Camera("OPENCV_FISHEYE", 640, 480, (300.0, 310.0, 321.0, 239.0, 0.01, -0.02, 0.003, 1e-4)),
]


def parts():
    """The arguments of build_reconstruction for each of two models, whose tracks are in no order."""
    made = make_problem(COUNT, 900, layout="street", noise_px=0.3, seed=3)
    rng = np.random.default_rng(1)
    camera_ids = np.arange(COUNT) % 2
    camera_ids[[UNREGISTERED, 11]] = 2, 3
    lengths = np.diff(made.track_offsets)
    point_rows = np.repeat(np.arange(len(lengths)), lengths)
    pixels = np.concatenate(
        [made.keypoints[i][k] for i, k in zip(made.track_image_ids, made.track_keypoint_ids, strict=True)]
    ).reshape(-1, 2)
    model_of = np.where(np.isin(np.arange(COUNT), range(*OTHERS)), 1, 0)
    model_of[[UNREGISTERED, OTHERS[1]]] = -1
    for model in range(2):
        mine = model_of == model
        seen = np.flatnonzero(mine[made.track_image_ids] & (made.track_image_ids != UNOBSERVED))
        seen = rng.permutation(seen)
        seen = seen[np.argsort(point_rows[seen], kind="stable")]
        points, counts = np.unique(point_rows[seen], return_counts=True)
        yield (
            NAMES,
            camera_ids,
            CAMERAS,
            np.where(mine[:, None, None], made.rotations, np.nan),
            np.where(mine[:, None], made.translations, np.nan),
            made.points[points],
            rng.integers(0, 256, (len(points), 3)).astype(np.uint8),
            rng.random(len(points)),
            np.r_[0, np.cumsum(counts)],
            made.track_image_ids[seen],
            pixels[seen],
        )


def object_by_object(
    names,
    camera_ids,
    cameras,
    rotations,
    translations,
    points,
    colors,
    errors_px,
    offsets,
    image_ids,
    keypoints,
):
    """The same by pycolmap's objects alone."""
    registered = np.flatnonzero(has_pose(rotations, translations)).tolist()
    model = pycolmap.Reconstruction()
    for row in sorted({int(camera_ids[image]) for image in registered}):
        model.add_camera_with_trivial_rig(cameras[row].to_pycolmap(row + 1))
    rows_in_image = np.empty(len(image_ids), int)
    for row in registered:
        mine = np.flatnonzero(image_ids == row)
        rows_in_image[mine] = np.arange(len(mine))
        image = pycolmap.Image(
            name=names[row],
            keypoints=keypoints[mine].astype(float).reshape(-1, 2),
            camera_id=int(camera_ids[row]) + 1,
            image_id=row + 1,
        )
        model.add_image_with_trivial_frame(image, to_rigid3d(rotations[row], translations[row]))
    for row, (start, end) in enumerate(pairwise(offsets)):
        track = pycolmap.Track(
            [pycolmap.TrackElement(image_ids[k] + 1, rows_in_image[k]) for k in range(start, end)]
        )
        point = pycolmap.Point3D(xyz=points[row], color=colors[row], error=errors_px[row], track=track)
        model.add_point3D_with_id(row + 1, point)
    return model


def files_of(model: pycolmap.Reconstruction, folder: Path) -> dict[str, bytes]:
    """All that export_model writes by pycolmap."""
    folder.mkdir()
    model.write_binary(str(folder))
    model.write_text(str(folder))
    model.export_PLY(str(folder / "points.ply"))
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("deregistered", [False, True])
@pytest.mark.parametrize("number", [0, 1])
def test_every_file_that_lacks_its_last_byte_is_found(tmp_path, number, deregistered) -> None:
    model = build_reconstruction(*list(parts())[number])
    if deregistered:
        model.deregister_frame(max(model.reg_frame_ids()))
        assert model.num_reg_images() < model.num_images()

    def check() -> None:
        check_binary(tmp_path / "model", model)
        check_text(tmp_path / "model", model)
        check_ply(tmp_path / "model" / "points.ply", model.num_points3D())

    contents = files_of(model, tmp_path / "model")
    check()
    for name, content in contents.items():
        for room in (0, len(content) - 1):
            (tmp_path / "model" / name).write_bytes(content[:room])
            with pytest.raises(OSError, match="No space left"):
                check()
        (tmp_path / "model" / name).write_bytes(content)
    check()


@pytest.mark.parametrize("number", [0, 1])
def test_all_files_are_those_of_single_objects(tmp_path, number) -> None:
    given = list(parts())[number]
    model = build_reconstruction(*given)
    assert model.num_points3D() > 100
    found, expected = (
        files_of(model, tmp_path / "found"),
        files_of(object_by_object(*given), tmp_path / "expected"),
    )
    assert len(expected) == 11
    assert found.keys() == expected.keys()
    assert [name for name, content in expected.items() if found[name] != content] == []
    if number == 0:
        assert model.image(UNOBSERVED + 1).num_points2D() == 0
        assert sorted(model.cameras) == [1, 2, 4]
    for image_id, image in model.images.items():
        assert image.name == NAMES[image_id - 1]


def test_a_model_without_points_or_without_images_is_that_of_single_objects(tmp_path) -> None:
    posed = next(parts())
    no_points = (np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0), np.zeros(1, int))
    no_points += (np.zeros(0, np.int32), np.zeros((0, 2), np.float32))
    empty = (*posed[:3], np.full_like(posed[3], np.nan), np.full_like(posed[4], np.nan))
    for name, given in (("posed", (*posed[:5], *no_points)), ("empty", (*empty, *no_points))):
        found = files_of(build_reconstruction(*given), tmp_path / f"{name}_found")
        assert found == files_of(object_by_object(*given), tmp_path / f"{name}_expected")


def test_an_observation_without_a_pose_is_refused() -> None:
    given = list(next(parts()))
    given[4] = given[4].copy()
    given[4][given[9][0]] = np.nan
    with pytest.raises(ValueError, match="images without a pose"):
        build_reconstruction(*given)


@pytest.mark.parametrize(
    ("name", "other"),
    [
        ("POINT", colmap_files.POINT.newbyteorder(">")),
        ("POINT", np.dtype(colmap_files.POINT.descr, align=True)),
        ("ELEMENT", np.dtype([("image", "<u8"), ("keypoint", "<u4")])),
        ("KEYPOINT", np.dtype([("xy", "<f4", 2), ("point", "<u8")])),
        ("IMAGE", struct.Struct("<I7dQ")),
        ("COUNT", struct.Struct("<I")),
    ],
)
def test_a_pycolmap_that_writes_another_layout_is_refused(monkeypatch, name, other) -> None:
    monkeypatch.setattr(colmap_files, name, other)
    colmap_files.check_layout.cache_clear()
    with pytest.raises(ConfigError, match=rf"pycolmap {pycolmap.__version__} writes another .*pip install"):
        build_reconstruction(*next(parts()))
