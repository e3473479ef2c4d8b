import cv2  # noqa: F401 - before pycolmap
import pycolmap
import pytest

from snakesfm.errors import ConfigError
from snakesfm.ingest.cameras import Photograph
from snakesfm.ingest.exif import Exif
from snakesfm.ingest.known import match_known_cameras, read_known_cameras

TWO = "# comment\n1 PINHOLE 800 600 700 701 400 300\n\n7 SIMPLE_RADIAL 640 480 500 320 240 -0.1\n"
SAME = "1 PINHOLE 800 600 700 701 400 300\n2 PINHOLE 800 600 710 711 400 300\n"
POSE = "1 0 0 0 0 0 0"


def write(folder, **files):
    folder.mkdir(exist_ok=True)
    for name, text in files.items():
        (folder / f"{name}.txt").write_text(text, "utf-8")
    return folder


def match_and_warn(known, images, exif=None):
    exif = exif or {}
    photographs = [Photograph(name, *size, exif.get(name, Exif())) for name, size in images.items()]
    return match_known_cameras(known, photographs)


def match(known, images):
    return match_and_warn(known, images)[0]


def test_one_camera_is_that_of_all_images_and_scales(tmp_path):
    known = read_known_cameras(write(tmp_path, cameras=TWO.splitlines()[1]) / "cameras.txt")
    same, half, odd = match(known, {"a.jpg": (800, 600), "b.jpg": (400, 300), "c.jpg": (267, 200)})
    assert (same.model, same.params, same.source) == ("PINHOLE", (700, 701, 400, 300), "given")
    assert half.params == (350, 350.5, 200, 150)
    assert (odd.width, odd.height) == (267, 200)
    assert odd.params == pytest.approx((700 * 267 / 800, 701 / 3, 133.5, 100))
    with pytest.raises(ConfigError, match=r"turned\.jpg has 600 x 800 .*EXIF rotation"):
        match(known, {"turned.jpg": (600, 800)})
    with pytest.raises(
        ConfigError, match=r"wide\.jpg has 800 x 450 .*an images\.txt next to a cameras\.txt"
    ):
        match(known, {"wide.jpg": (800, 450)})


def test_several_cameras_without_a_list_go_by_size(tmp_path):
    known = read_known_cameras(write(tmp_path, cameras=TWO))
    found = match(known, {"a.jpg": (640, 480), "b.jpg": (800, 600)})
    assert [camera.model for camera in found] == ["SIMPLE_RADIAL", "PINHOLE"]
    with pytest.raises(ConfigError, match=r"2 cameras, of which 0 .* 400 x 300 of c\.jpg"):
        match(known, {"c.jpg": (400, 300)})
    with pytest.raises(ConfigError, match="2 cameras, of which 2 "):
        match(read_known_cameras(write(tmp_path, cameras=SAME)), {"a.jpg": (800, 600)})


def test_list_of_images_decides(tmp_path):
    images = f"# list\n3 {POSE} 2 sub/a b.jpg\n1.5 2.5 -1 3 4 17\n4 {POSE} 1 c.jpg\n\n"
    known = read_known_cameras(write(tmp_path, cameras=SAME, images=images))
    assert known.camera_of == {"sub/a b.jpg": 2, "c.jpg": 1}
    found = match(known, {"c.jpg": (800, 600), "new.jpg": (800, 600), "sub/a b.jpg": (400, 300)})
    assert found[0].params[0] == 700
    assert found[1] is None
    assert found[2].params[0] == 355


@pytest.mark.parametrize("points", ["", "1.5 2.5 -1 3 4 17"])
def test_blank_lines_before_an_image_hide_none(tmp_path, points):
    images = f"# list\n\n1 {POSE} 2 a.jpg\n{points}\n \n\n2 {POSE} 1 b.jpg\n{points}\n3 {POSE} 1 c.jpg"
    known = read_known_cameras(write(tmp_path, cameras=SAME, images=images))
    assert known.camera_of == {"a.jpg": 2, "b.jpg": 1, "c.jpg": 1}


def test_image_missing_from_the_list_takes_the_one_camera_of_its_size(tmp_path):
    known = read_known_cameras(write(tmp_path, cameras=TWO, images=f"1 {POSE} 1 a.jpg\n\n"))
    found = match(known, {"a.jpg": (800, 600), "b.jpg": (640, 480), "c.jpg": (100, 100)})
    assert [camera and camera.model for camera in found] == ["PINHOLE", "SIMPLE_RADIAL", None]


def test_binary_model_says_the_same_as_text(tmp_path):
    model = pycolmap.Reconstruction()
    for camera_id, name in ((3, "OPENCV"), (5, "SIMPLE_PINHOLE")):
        camera = pycolmap.Camera.create_from_model_name(camera_id, name, 500.0 + camera_id, 640, 480)
        model.add_camera_with_trivial_rig(camera)
    for image_id, name in ((1, "a b.jpg"), (2, "ü/c.jpg")):
        image = pycolmap.Image(name=name, camera_id=3 if image_id == 1 else 5, image_id=image_id)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D([1.0, 2.0])] * image_id)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    (tmp_path / "bin").mkdir()
    (tmp_path / "txt").mkdir()
    model.write_binary(tmp_path / "bin")
    model.write_text(tmp_path / "txt")
    binary = read_known_cameras(tmp_path / "bin")
    text = read_known_cameras(tmp_path / "txt" / "cameras.txt")
    assert binary.path.name == "cameras.bin"
    assert binary.cameras == text.cameras
    assert binary.camera_of == text.camera_of == {"a b.jpg": 3, "ü/c.jpg": 5}
    data = (tmp_path / "bin" / "cameras.bin").read_bytes()
    (tmp_path / "bin" / "cameras.bin").write_bytes(data[:-5])
    with pytest.raises(ConfigError, match="neither a COLMAP cameras file nor a 3x3 matrix"):
        read_known_cameras(tmp_path / "bin")


def test_matrix(tmp_path):
    known = read_known_cameras(write(tmp_path, K="700 0 400\n0 701 300\n0 0 1\n") / "K.txt")
    first, half = match(known, {"a.jpg": (800, 600), "b.jpg": (400, 300)})
    assert (first.model, first.width, first.params) == ("PINHOLE", 800, (700, 701, 400, 300))
    assert half.params == (350, 350.5, 200, 150)
    with pytest.raises(ConfigError, match="another aspect ratio"):
        match(known, {"a.jpg": (800, 600), "b.jpg": (600, 800)})
    with pytest.raises(ConfigError, match=r"about 800 x 600 pixels, but the images have 200 x 150"):
        match(known, {"a.jpg": (200, 150)})
    assert match(known, {}) == []


@pytest.mark.parametrize(
    ("sizes", "about"),
    [
        # the matrix is that of half, three quarters and twice the size
        ([(1600, 1200)], "800 x 600"),
        ([(1066, 800)], "800 x 600"),
        ([(500, 375)], "800 x 600"),
        ([(1600, 1200), (3200, 2400)], "800 x 600"),
        # in one direction alone
        ([(800, 1210)], "800 x 600"),
        ([(380, 600)], "800 x 600"),
    ],
)
def test_matrix_for_another_size_is_refused(tmp_path, sizes, about):
    known = read_known_cameras(write(tmp_path, K="700 0 400\n0 701 300\n0 0 1\n") / "K.txt")
    with pytest.raises(ConfigError, match=f"about {about} pixels, but the images have {sizes[0][0]} x"):
        match(known, {f"{k}.jpg": size for k, size in enumerate(sizes)})


@pytest.mark.parametrize(
    "size",
    # a lens off by a tenth; a third cropped away on one side, right or left, or below
    [(880, 660), (534, 600), (1190, 600), (800, 401), (800, 450)],
)
def test_matrix_of_cropped_images_is_taken(tmp_path, size):
    known = read_known_cameras(write(tmp_path, K="700 0 400\n0 701 300\n0 0 1\n") / "K.txt")
    (camera,) = match(known, {"a.jpg": size})
    assert (camera.width, camera.height, camera.params) == (*size, (700, 701, 400, 300))


PHONE = Exif("Apple", "iPhone 12", focal_mm=4.2)
OTHER = Exif("Samsung", "SM-G991B", focal_mm=5.4)
ZOOMED = Exif("Apple", "iPhone 12", focal_mm=6.0)
LISTED = f"1 {POSE} 1 a.jpg\n\n"


@pytest.mark.parametrize(
    ("listed", "unlisted", "is_known", "warnings"),
    [
        (PHONE, PHONE, True, 0),
        (PHONE, ZOOMED, False, 0),
        (PHONE, OTHER, False, 0),
        (PHONE, Exif(), False, 0),
        (Exif(), PHONE, False, 0),
        (Exif(), Exif(), True, 1),
    ],
)
def test_image_that_the_list_lacks_is_known_by_its_exif(tmp_path, listed, unlisted, is_known, warnings):
    known = read_known_cameras(write(tmp_path, cameras=TWO.splitlines()[1], images=LISTED))
    images = {"a.jpg": (800, 600), "b.jpg": (800, 600), "c.jpg": (400, 300)}
    found, lines = match_and_warn(known, images, {"a.jpg": listed, "b.jpg": unlisted, "c.jpg": listed})
    assert [camera is not None for camera in found] == [True, is_known, False]
    assert len(lines) == warnings
    for line in lines:
        assert f"1 images not listed in {tmp_path / 'images.txt'} were assigned camera 1" in line


def test_one_camera_for_several_models_is_doubted(tmp_path):
    images = {"a.jpg": (800, 600), "b.jpg": (400, 300), "c.jpg": (800, 600)}
    for files in ({"cameras": TWO.splitlines()[1]}, {"K": "700 0 400\n0 701 300\n0 0 1\n"}):
        (name,) = files
        known = read_known_cameras(write(tmp_path / name, **files))
        found, lines = match_and_warn(known, images, {"a.jpg": PHONE, "b.jpg": OTHER})
        assert all(camera is not None for camera in found)
        assert len(lines) == 1
        assert (
            f"{name}.txt gives one camera to images of 2 camera models in EXIF (SM-G991B, iPhone 12)"
            in lines[0]
        )
        assert match_and_warn(known, images, {"a.jpg": PHONE, "b.jpg": ZOOMED})[1] == []
    known = read_known_cameras(write(tmp_path / "two", cameras=TWO))
    by_size = {"a.jpg": (800, 600), "b.jpg": (640, 480)}
    assert match_and_warn(known, by_size, {"a.jpg": PHONE, "b.jpg": OTHER})[1] == []


@pytest.mark.parametrize("cameras", [SAME, SAME.splitlines()[0]])
def test_list_with_other_folders_goes_by_file_names(tmp_path, cameras):
    last = 2 if cameras == SAME else 1
    images = f"1 {POSE} 1 images/A_1.jpg\n\n2 {POSE} {last} images/B_1.jpg\n\n"
    known = read_known_cameras(write(tmp_path, cameras=cameras, images=images))
    exif = {"A_1.jpg": PHONE, "B_1.jpg": OTHER}
    found, lines = match_and_warn(known, dict.fromkeys((*exif, "C.jpg"), (800, 600)), exif)
    assert [camera and camera.params[0] for camera in found] == [700, 710 if last == 2 else 700, None]
    assert lines == []
    with pytest.raises(
        ConfigError,
        match=r"images\.txt names none of the images \(it has 'images/A_1\.jpg', the folder 'x\.jpg'\)",
    ):
        match(known, {"x.jpg": (800, 600), "y.jpg": (800, 600)})


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("cameras", "", "contains no camera"),
        ("cameras", "hello world", "neither a COLMAP"),
        ("cameras", "1 PINHOLE 800 600 700 x 400 300", "neither a COLMAP"),
        ("cameras", "1 PINHOLE 800 600 700 400 300", "parameters for a PINHOLE"),
        ("cameras", "1 PINHOLE 800 600 -700 700 400 300", "parameters for a PINHOLE"),
        ("cameras", "1 PINHOLE 800 600 nan 700 400 300", "parameters for a PINHOLE"),
        ("cameras", "1 PINHOLE 0 600 700 700 400 300", "parameters for a PINHOLE"),
        ("cameras", "1 LEICA 800 600 700 700 400 300", "unknown camera model 'LEICA'"),
        ("K", "700 0 400\n0 701 300\n0 0 2\n", "not a matrix"),
        ("K", "700 50 400\n0 701 300\n0 0 1\n", "not a matrix"),
        ("K", "nan 0 400\n0 701 300\n0 0 1\n", "not a matrix"),
    ],
)
def test_wrong_files_are_one_sentence(tmp_path, name, text, message):
    with pytest.raises(ConfigError, match=message) as caught:
        read_known_cameras(write(tmp_path, **{name: text}) / f"{name}.txt")
    assert f"{name}.txt" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_files_and_wrong_lists(tmp_path):
    with pytest.raises(ConfigError, match="does not exist"):
        read_known_cameras(tmp_path / "cameras.txt")
    with pytest.raises(ConfigError, match=r"contains none of cameras\.bin"):
        read_known_cameras(tmp_path)
    with pytest.raises(ConfigError, match="camera 9, which that file lacks"):
        read_known_cameras(write(tmp_path, cameras=TWO, images=f"1 {POSE} 9 a.jpg\n\n"))
    with pytest.raises(ConfigError, match=r"images\.txt.* is not a COLMAP list"):
        read_known_cameras(write(tmp_path, cameras=TWO, images="a.jpg\n"))
