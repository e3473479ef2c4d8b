import dataclasses

import numpy as np
import pytest

from snakesfm.geometry.camera import Camera
from snakesfm.ingest.cameras import (
    Photograph,
    assign_cameras,
    folders_of_one_size,
    group_images,
    warn_of_own_cameras,
)
from snakesfm.ingest.exif import Exif

PHONE = Exif("DJI", "FC6310", focal_mm=8.8)
PHONE_FOCAL = 8.8 / 13.2


def photos(folder, sizes, exif=None):
    exif = exif or Exif()
    return [Photograph(f"{folder}/{k:03}.jpg", w, h, exif) for k, (w, h) in enumerate(sizes)]


def assign(photographs, known=None, **changes):
    rules = {"sharing": "auto", "model": "SIMPLE_RADIAL", "default_focal_ratio": 1.2, "use_exif": True}
    return assign_cameras(photographs, known or [None] * len(photographs), **(rules | changes))


def group_sizes(photographs, sharing="auto"):
    keys = group_images(photographs, sharing, folders_of_one_size(photographs))
    return sorted(keys.count(key) for key in set(keys))


def test_one_exif_camera_is_shared_over_folders_and_orientations():
    found = assign(photos("a", [(4000, 3000)] * 3, PHONE) + photos("b", [(4000, 3000)] * 2, PHONE))
    assert found.camera_ids.tolist() == [0] * 5
    (camera,) = found.cameras
    assert (camera.model, camera.width, camera.height, camera.source) == (
        "SIMPLE_RADIAL",
        4000,
        3000,
        "exif",
    )
    assert camera.params == pytest.approx((PHONE_FOCAL * 4000, 2000, 1500, 0), rel=1e-5)
    np.testing.assert_allclose(found.focal_exif_px, PHONE_FOCAL * 4000, rtol=1e-5)


@pytest.mark.parametrize(
    "change", [{"focal_mm": 10.0}, {"lens": "wide"}, {"model": "FC330"}, {"make": "X"}]
)
def test_other_lens_focal_length_or_body_is_another_camera(change):
    other = Exif(**({"make": "DJI", "model": "FC6310", "focal_mm": 8.8} | change))
    found = assign(photos("a", [(4000, 3000)] * 2, PHONE) + photos("b", [(4000, 3000)] * 2, other))
    assert found.camera_ids.tolist() == [0, 0, 1, 1]


def test_auto_begins_with_one_term_of_distortion():
    (camera,) = assign(photos("a", [(1280, 720)] * 3), model="auto").cameras
    assert camera.model == "SIMPLE_RADIAL"


def test_video_without_exif_shares_one_default_camera_per_folder():
    found = assign(photos("a", [(1280, 720)] * 3) + photos("b", [(640, 480)] * 2))
    assert found.camera_ids.tolist() == [0, 0, 0, 1, 1]
    assert [camera.source for camera in found.cameras] == ["default"] * 2
    assert found.cameras[0].focal_px == pytest.approx(1.2 * 1280)
    assert np.isnan(found.focal_exif_px).all()


def test_portrait_and_landscape_of_one_camera_are_two_cameras():
    assert group_sizes(photos("a", [(800, 600), (600, 800), (800, 600)])) == [1, 2]


def test_crowd_photographs_have_a_camera_each():
    assert group_sizes(photos("a", [(1024, 768), (1024, 683), (1024, 768)])) == [1, 1, 1]
    bodies = photos("a", [(1024, 683)], PHONE) + photos("a", [(1024, 683)], Exif("X", "Y"))
    assert group_sizes(bodies + photos("a", [(1024, 768)] * 3)) == [1] * 5


def test_two_videos_in_one_folder_are_two_cameras():
    assert group_sizes(photos("a", [(1920, 1080)] * 30 + [(1280, 720)] * 20)) == [20, 30]


def test_a_few_strays_do_not_part_a_video():
    video, strays = [(1280, 720)] * 11, [(500, 400), (640, 480)]
    phones = [Photograph(f"a/{name}.jpg", 300, 200, Exif("X", name)) for name in "bc"]
    assert group_sizes(photos("a", [*video, (720, 1280), *strays]) + phones) == [1] * 5 + [11]
    # too many: as crowd photographs, whose commonest size is not of one camera
    assert group_sizes(photos("a", video + strays) + phones) == [1] * 15


def numbered(start, count, size, exif=None, first=0, step=1):
    exif = exif or Exif()
    return [Photograph(f"{start}{first + k * step:05}.jpg", *size, exif) for k in range(count)]


FRAMES = (1920, 1080)
FIRST, SECOND = Exif("Apple", "iPhone 12"), Exif("Apple", "iPhone 13")


def test_frames_are_of_one_camera_whatever_lies_beside_them():
    phones = numbered("a", 55, (4032, 3024), FIRST) + numbered("b", 1, (4032, 3024), SECOND)
    assert group_sizes(numbered("frame_", 300, FRAMES, step=30) + phones) == [1, 55, 300]
    beside = numbered("x", 1, (800, 600)) + numbered("y", 1, (500, 400), SECOND)
    assert group_sizes(numbered("frame_", 20, FRAMES) + phones + beside) == [1, 1, 1, 20, 55]
    # too few, and not all sizes repeat
    assert group_sizes(numbered("frame_", 19, FRAMES) + phones + beside) == [1] * 22 + [55]
    # two videos of one size need not be of one camera
    two = numbered("f", 20, FRAMES) + numbered("g", 20, FRAMES)
    assert group_sizes(two + phones + beside) == [1, 1, 1, 20, 20, 55]


def test_few_images_of_few_cameras_share_by_series():
    assert group_sizes(numbered("a", 18, (4000, 3000)) + numbered("b", 18, (3264, 2448))) == [18, 18]
    assert group_sizes(numbered("a", 20, (4000, 3000)) + numbered("b", 19, (3264, 2448))) == [19, 20]
    # one run of numbers that changes its size once
    assert group_sizes(numbered("a", 4, (4000, 3000)) + numbered("a", 3, (3264, 2448), first=4)) == [3, 4]
    assert group_sizes(numbered("a", 4, (4000, 3000)) + numbered("b", 2, (3264, 2448))) == [1] * 6
    # of two names in one size, neither is a series of the folder's
    parts = numbered("a", 4, (4000, 3000)) + numbered("b", 4, (4000, 3000))
    assert group_sizes(parts + numbered("c", 4, (3264, 2448))) == [1] * 12


@pytest.mark.parametrize("step", [1, 5000])
def test_numbered_crowd_photographs_have_a_camera_each(step):
    sizes = [(1024, 768), (1024, 683), (1024, 680)]
    crowd = [Photograph(f"{k * step:08}.jpg", *sizes[k * k % 7 % 3], Exif()) for k in range(90)]
    strays = [Photograph(f"s{k}.jpg", 600, 401 + k, Exif()) for k in range(4)]
    bodies = numbered("p", 1, (600, 400), FIRST) + numbered("q", 1, (600, 400), SECOND)
    assert group_sizes(crowd + strays + bodies) == [1] * 96
    # all made to one size, some without EXIF
    made = [Photograph(f"{k * step:08}.jpg", 760, 1140, (Exif(), FIRST, SECOND)[k % 3]) for k in range(90)]
    assert group_sizes(made) == [1] * 30 + [30, 30]
    # numbers of a web site
    apart = numbered("", 30, (760, 1140), step=5000) + numbered("p", 12, (600, 400), FIRST) + bodies[1:]
    assert group_sizes(apart + strays) == [1] * 35 + [12]


def test_own_cameras_of_few_sizes_are_doubted():
    def warn(photographs, known=None, **changes):
        sharing = changes.get("sharing", "auto")
        return warn_of_own_cameras(photographs, assign(photographs, known, **changes), sharing)

    square = photos("a", [(760, 760)] * 6, PHONE)
    (line,) = warn(square)
    assert line.startswith("6 images have a camera of their own")
    assert "index_images={camera_sharing: single}" in line
    assert warn(square, sharing="single") == warn(square, sharing="per_image") == []
    assert warn(square, [Camera("PINHOLE", 760, 760, (700.0 + k, 700, 380, 380)) for k in range(6)]) == []
    assert warn(square + numbered("f", 6, FRAMES)) == []
    assert warn(photos("a", [(760, 700 + k // 2) for k in range(12)])) == []
    bodies = [Photograph(f"{k}.jpg", 760, 1140 + k % 2, Exif("X", f"M{k}")) for k in range(6)]
    assert warn(bodies) == []


def test_images_that_count_as_cropped_to_one_size_are_told():
    bodies = [Photograph(f"{k}.jpg", 760, 1140, Exif("X", f"M{k % 6}")) for k in range(12)]
    others = photos("a", [(760, 1140)] * 3, PHONE)
    known = [Camera("PINHOLE", 760, 1140, (700, 700, 380, 570)), *[None] * 14]

    def warn(known, **changes):
        found = assign(bodies + others, known, **changes)
        return warn_of_own_cameras(bodies + others, found, changes.get("sharing", "auto"))

    (line,) = warn(known)
    assert line.startswith(
        "11 images of one size, from 5 camera models or more, count as cropped: each has"
    )
    assert "index_images={camera_sharing: exif}" in line
    assert warn(known, sharing="exif") == warn(known, sharing="single") == []
    assert warn([known[0]] * 12 + [None] * 3) == []


def test_cropped_images_are_not_trusted():
    square = assign(photos("a", [(760, 760)] * 3, PHONE))
    assert len(square.cameras) == 3
    assert {camera.source for camera in square.cameras} == {"default"}
    assert square.cameras[0].focal_px == pytest.approx(1.2 * 760)
    assert np.isnan(square.focal_exif_px).all()


@pytest.mark.parametrize(
    ("size", "stated", "cameras"),
    [
        ((950, 760), (950, 760), 1),
        # GoPro
        ((5568, 4872), (5568, 4872), 1),
        ((950, 760), (1140, 760), 3),
        ((760, 760), (760, 760), 3),
    ],
)
def test_images_of_a_sensor_of_5_to_4_or_8_to_7_share_a_camera(size, stated, cameras):
    exif = dataclasses.replace(PHONE, width=stated[0], height=stated[1])
    found = assign(photos("a", [size] * 3, exif))
    assert len(found.cameras) == cameras
    assert {camera.source for camera in found.cameras} == {"default"}


def test_one_size_of_many_cameras_is_not_trusted():
    mixed = [Photograph(f"{k}.jpg", 760, 1140, Exif("X", f"M{k}", focal_35mm=100)) for k in range(6)]
    found = assign(mixed)
    assert {camera.source for camera in found.cameras} == {"default"}
    # cropping narrows the view, so the stated focal length is a lower bound
    assert found.cameras[0].focal_px == pytest.approx(100 * np.hypot(760, 1140) / np.hypot(36, 24))
    three = assign(mixed[:3])
    assert {camera.source for camera in three.cameras} == {"exif"}


@pytest.mark.parametrize(
    ("size", "stated", "whole"),
    [
        ((4032, 3024), (4032, 3024), True),
        ((3024, 4032), (4032, 3024), True),
        # cut from the left
        ((4032, 3024), (5472, 3648), False),
        ((4032, 3024), (0, 0), False),
        # the size of a web page
        ((1024, 768), (1024, 768), False),
    ],
)
def test_telephones_that_agree_on_a_large_size_are_cameras_of_their_own(size, stated, whole):
    phones = [
        Photograph(f"{k}.jpg", *size, Exif("X", f"M{k % 5}", "", 4.2, 26.0, *stated)) for k in range(20)
    ]
    found = assign(phones)
    assert len(found.cameras) == (5 if whole else 20)
    assert {camera.source for camera in found.cameras} == {"exif" if whole else "default"}
    assert np.isfinite(found.focal_exif_px).all() == whole


def test_crops_of_many_cameras_do_not_share_one_where_another_is_known():
    mixed = [Photograph(f"{k}.jpg", 760, 1140, Exif("X", f"M{k % 5}", focal_35mm=100)) for k in range(6)]
    given = Camera("PINHOLE", 760, 1140, (900, 900, 380, 570), "given")
    assert len(assign(mixed).cameras) == 6
    assert len(assign(mixed, [None, given, *[None] * 4]).cameras) == 6


@pytest.mark.parametrize(
    ("sharing", "sizes"),
    [("single", [1, 5]), ("per_folder", [1, 2, 3]), ("per_image", [1] * 6), ("exif", [1, 1, 1, 3])],
)
def test_fixed_rules(sharing, sizes):
    images = (
        photos("a", [(800, 600)] * 3, PHONE) + photos("b", [(800, 600)] * 2) + photos("c", [(640, 480)])
    )
    assert group_sizes(images, sharing) == sizes


def test_options_of_unknown_cameras():
    images = photos("a", [(800, 600)] * 2, PHONE)
    found = assign(images, model="OPENCV", use_exif=False, default_focal_ratio=0.9)
    assert found.cameras == [Camera("OPENCV", 800, 600, (720, 720, 400, 300, 0, 0, 0, 0), "default")]
    assert np.isnan(found.focal_exif_px).all()


def test_known_cameras_are_kept_beside_unknown_ones():
    known = Camera("PINHOLE", 800, 600, (700, 701, 400, 300))
    images = photos("a", [(800, 600)] * 4, PHONE)
    found = assign(images, [known, None, Camera("PINHOLE", 800, 600, (700, 701, 400, 300)), None])
    assert found.camera_ids.tolist() == [0, 1, 0, 1]
    assert [camera.source for camera in found.cameras] == ["given", "exif"]
    assert found.cameras[0] is known


def test_no_images():
    found = assign([])
    assert found.cameras == []
    assert len(found.camera_ids) == len(found.focal_exif_px) == 0
