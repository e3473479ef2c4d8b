"""The demo scene: exact projection, occlusion, determinism, and images that SIFT matches."""

import dataclasses
import json

import cv2
import numpy as np
import pycolmap
import pytest
from full_disk import cut_references
from PIL import Image

from snakesfm.errors import ConfigError
from snakesfm.geometry.camera import Camera
from snakesfm.geometry.poses import center_of
from snakesfm.geometry.rotations import angle_of
from snakesfm.synthetic.raster import Face, Texture, View, render
from snakesfm.synthetic.render_demo import main, make_demo, visible_points
from snakesfm.synthetic.scene import DemoOptions, camera_path

# those of the scene that tests share
SMALL = DemoOptions(image_count=16, width=400, height=300)
CAMERA = Camera("PINHOLE", 80, 60, (50.0, 50.0, 40.0, 30.0))
FRONT = View(CAMERA, np.eye(3), np.zeros(3))


def plain(color: tuple[float, float, float]) -> Texture:
    return Texture(np.full((16, 16, 3), color, np.float32))


def square(depth: float, half: float, texture: Texture, triangle: bool = False) -> Face:
    """A square in front of the camera, seen from its front."""
    return Face(
        np.array([-half, -half, depth]),
        np.array([2 * half, 0.0, 0.0]),
        np.array([0.0, 2 * half, 0.0]),
        texture,
        triangle=triangle,
    )


def black(view: View, samples: int = 2) -> np.ndarray:
    return np.zeros((view.camera.height * samples, view.camera.width * samples, 3), np.float32)


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_the_nearer_face_hides_the_farther_in_any_order(order) -> None:
    faces = [square(4.0, 2.0, plain((200, 0, 0))), square(2.0, 0.5, plain((0, 200, 0)))]
    image, inverse_depth = render([faces[k] for k in order], FRONT, black(FRONT))
    assert image[30, 40] == pytest.approx([0, 200, 0], abs=1)
    assert image[30, 20] == pytest.approx([200, 0, 0], abs=1)
    assert inverse_depth[60, 80] == pytest.approx(0.5)
    assert inverse_depth[0, 0] == 0.0


def test_edges_are_where_projection_says_and_anti_aliased() -> None:
    # x = 0.51 at depth 2 is column 52.75: the pixel from 52 to 53 is three quarters covered
    image, _ = render([square(2.0, 0.51, plain((200, 200, 200)))], FRONT, black(FRONT, 4), samples=4)
    assert image[30, 51, 0] == pytest.approx(200.0, abs=1)
    assert image[30, 52, 0] == pytest.approx(150.0, abs=1)
    assert image[30, 53, 0] == pytest.approx(0.0, abs=1)


def test_the_back_of_a_face_and_what_is_behind_the_camera_are_not_seen() -> None:
    texture = plain((200, 200, 200))
    away = Face(np.array([1.0, -1, 2]), np.array([-2.0, 0, 0]), np.array([0.0, 2, 0]), texture)
    for face in (away, square(-2.0, 1.0, texture)):
        assert render([face], FRONT, black(FRONT))[0].max() == 0.0


def test_a_floor_that_passes_under_the_camera_is_clipped_at_the_near_plane() -> None:
    floor = Face(np.array([-9.0, 1, 9]), np.array([18.0, 0, 0]), np.array([0.0, 0, -18]), plain((9, 99, 9)))
    image, inverse_depth = render([floor], FRONT, black(FRONT))
    assert image[-1, 40] == pytest.approx([9, 99, 9], abs=1)
    assert image[10, 40].max() == 0.0
    assert np.isfinite(inverse_depth).all()


def test_a_triangle_has_its_apex_up() -> None:
    image, _ = render([square(2.0, 1.0, plain((200, 200, 200)), triangle=True)], FRONT, black(FRONT))
    assert image[50, 20, 0] > 150
    assert image[8, 20, 0] == 0.0


def test_a_texture_far_away_is_averaged_and_not_aliased() -> None:
    board = np.indices((256, 256)).sum(axis=0) % 2 * 255.0
    texture = Texture(np.repeat(board[..., None], 3, axis=2))
    image, _ = render([square(4.0, 2.0, texture)], FRONT, black(FRONT))
    assert image[25:35, 35:45] == pytest.approx(127.5, abs=4)


def test_visible_points_are_in_front_and_not_hidden() -> None:
    faces = [square(4.0, 2.0, plain((9, 9, 9))), square(2.0, 0.5, plain((9, 9, 9)))]
    _, inverse_depth = render(faces, FRONT, black(FRONT))
    points = np.array([[0.0, 0, 4], [0, 0, 2], [1.5, 0, 4], [0, 0, -2], [99, 0, 4]])
    seen, pixels = visible_points(points, FRONT, inverse_depth, 2)
    assert seen.tolist() == [False, True, True, False, False]
    assert pixels[1] == pytest.approx([40.0, 30.0])


def test_the_path_is_a_closed_ring_of_small_steps_that_looks_inward() -> None:
    options = DemoOptions()
    views = camera_path(options)
    assert len(views) >= 16
    rotations = np.array([view.rotation for view in views])
    centers = center_of(rotations, np.array([view.translation for view in views]))
    steps = np.degrees(angle_of(np.roll(rotations, -1, axis=0) @ np.swapaxes(rotations, 1, 2)))
    assert 5.0 < steps.min() < steps.max() < 22.0
    around = np.unwrap(np.arctan2(centers[:, 1], centers[:, 0]))
    assert np.degrees(np.diff(around)) == pytest.approx(360.0 / len(views), abs=0.01)
    assert np.all(np.sum(rotations[:, 2] * centers, axis=1) < 0)
    assert np.all(np.abs(np.linalg.det(rotations) - 1) < 1e-9)


def test_the_demo_is_complete_and_made_only_once(small_scene) -> None:
    assert len(list((small_scene / "images").glob("*.jpg"))) == 16
    assert json.loads((small_scene / "demo.json").read_text("utf-8"))["image_count"] == 16
    assert [path.name for path in small_scene.parent.iterdir()] == ["square"]
    assert not make_demo(small_scene, SMALL)


def test_the_reference_points_project_to_where_it_says(small_scene) -> None:
    model = pycolmap.Reconstruction(str(small_scene / "reference"))
    assert model.num_reg_images() == 16
    assert model.num_points3D() > 300
    assert model.compute_mean_track_length() >= 3
    model.update_point_3d_errors()
    assert model.compute_mean_reprojection_error() < 1e-6


def test_photos_tell_their_focal_length_by_exif(small_scene) -> None:
    camera = pycolmap.infer_camera_from_image(str(small_scene / "images" / "square_00.jpg"))
    truth = SMALL.camera.focal_px
    assert camera.has_prior_focal_length
    assert abs(camera.mean_focal_length() / truth - 1) < 0.05
    assert abs(camera.mean_focal_length() / truth - 1) > 1e-4


def test_sift_matches_neighbours_and_closes_the_loop_where_the_truth_says(small_scene) -> None:
    model = pycolmap.Reconstruction(str(small_scene / "reference"))
    views = {image.name: image for image in model.images.values()}
    sift = cv2.SIFT_create(2000)
    found = {}
    for name in ("square_00.jpg", "square_01.jpg", "square_15.jpg"):
        found[name] = sift.detectAndCompute(cv2.imread(str(small_scene / "images" / name), 0), None)
    matrix = SMALL.camera.to_pycolmap().calibration_matrix()
    for first, second in (("square_00.jpg", "square_01.jpg"), ("square_15.jpg", "square_00.jpg")):
        pairs = cv2.BFMatcher(cv2.NORM_L2, crossCheck=False).knnMatch(found[first][1], found[second][1], 2)
        good = [a for a, b in pairs if a.distance < 0.8 * b.distance]
        ends = [
            np.array([found[name][0][getattr(m, index)].pt for m in good]) + 0.5
            for name, index in ((first, "queryIdx"), (second, "trainIdx"))
        ]
        pose = views[second].cam_from_world() * views[first].cam_from_world().inverse()
        x, y, z = pose.translation
        essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ pose.rotation.matrix()
        inverse = np.linalg.inv(matrix)
        lines = np.column_stack([ends[0], np.ones(len(good))]) @ (inverse.T @ essential @ inverse).T
        distances = np.abs(np.sum(lines * np.column_stack([ends[1], np.ones(len(good))]), axis=1))
        distances /= np.linalg.norm(lines[:, :2], axis=1)
        assert np.sum(distances < 1.0) > 50
        assert np.mean(distances < 1.0) > 0.6
        assert 0.01 < np.median(distances[distances < 1.0]) < 0.4


def test_equal_seeds_give_equal_bytes_and_another_seed_is_rendered_anew(small_scene, tmp_path) -> None:
    options = DemoOptions(image_count=1, width=SMALL.width, height=SMALL.height)
    folder = tmp_path / "again"
    folder.mkdir()
    assert make_demo(folder, options)
    same = (folder / "images" / "square_00.jpg").read_bytes()
    assert same == (small_scene / "images" / "square_00.jpg").read_bytes()
    assert make_demo(folder, dataclasses.replace(options, seed=4, width=80, height=60))
    (image,) = (folder / "images").iterdir()
    with Image.open(image) as photo:
        assert photo.size == (80, 60)
        small = np.asarray(photo.convert("L"), dtype=float)
    with Image.open(small_scene / "images" / "square_00.jpg") as photo:
        other = np.asarray(photo.convert("L").resize((80, 60)), dtype=float)
    assert np.abs(small - other).mean() > 10


def test_a_reference_that_the_disk_has_no_room_for_is_not_kept(tmp_path, monkeypatch) -> None:
    cut_references(monkeypatch, "write_text", "images.txt")
    with pytest.raises(OSError, match="No space left"):
        make_demo(tmp_path / "scene", DemoOptions(image_count=3, width=80, height=60))
    assert not list(tmp_path.iterdir())


def test_a_folder_with_something_else_is_left_alone(tmp_path, capsys) -> None:
    (tmp_path / "mine.txt").write_text("keep", "utf-8")
    with pytest.raises(ConfigError, match="choose a new folder"):
        make_demo(tmp_path, SMALL)
    assert main([str(tmp_path)]) == 1
    assert "choose a new folder" in capsys.readouterr().err
    assert (tmp_path / "mine.txt").read_text("utf-8") == "keep"
