"""What is read from pycolmap's files is what its objects say."""

import errno
import math
import tempfile
from pathlib import Path

import cv2  # noqa: F401
import numpy as np
import pycolmap
import pytest

from snakesfm.bundle.model import BundleModel, to_reconstruction
from snakesfm.bundle.reading import read_tracks, read_tracks_and_pixels
from snakesfm.synthetic.problems import make_problem


def reconstruction_with_gaps():
    """Without the pose of image 2, some points and some observations, and with one track out of order."""
    made = make_problem(8, 60, noise_px=0.3, seed=1)
    translations = made.translations.copy()
    translations[2] = np.nan
    names = [f"a folder/é {k}.jpg" for k in range(8)]
    model = BundleModel(
        made.cameras,
        made.camera_ids,
        made.rotations,
        translations,
        made.points,
        made.track_offsets,
        made.track_image_ids,
        made.track_keypoint_ids,
    )
    reconstruction = to_reconstruction(model, made.keypoints, names)
    ids = sorted(reconstruction.point3D_ids())
    for point in ids[3:20:4]:
        reconstruction.delete_point3D(point)
    longest = max(ids[20:], key=lambda k: reconstruction.point3D(k).track.length())
    first = reconstruction.point3D(longest).track.elements[0]
    element = pycolmap.TrackElement(first.image_id, first.point2D_idx)
    reconstruction.delete_observation(element.image_id, element.point2D_idx)
    reconstruction.add_observation(longest, element)
    return reconstruction


def test_points_and_observations_are_those_of_the_tracks_in_their_order():
    reconstruction = reconstruction_with_gaps()
    tracks = read_tracks(reconstruction)
    ids = sorted(reconstruction.point3D_ids())
    assert tracks.ids.tolist() == ids
    np.testing.assert_array_equal(tracks.points, [reconstruction.point3D(k).xyz for k in ids])
    expected = [
        (row, element.image_id - 1, element.point2D_idx)
        for row, k in enumerate(ids)
        for element in reconstruction.point3D(k).track.elements
    ]
    np.testing.assert_array_equal(
        np.stack([tracks.point_rows, tracks.images, tracks.rows], axis=1), expected
    )


def test_pixels_are_those_of_the_images_keypoints_now():
    reconstruction = reconstruction_with_gaps()
    before = read_tracks(reconstruction)
    reconstruction.image(int(before.images[5]) + 1).point2D(int(before.rows[5])).xy = (1.25, 7.5)
    tracks, pixels = read_tracks_and_pixels(reconstruction)
    for name, values in vars(before).items():
        np.testing.assert_array_equal(getattr(tracks, name), values)
    expected = [
        reconstruction.image(i + 1).point2D(k).xy
        for i, k in zip(tracks.images.tolist(), tracks.rows.tolist(), strict=True)
    ]
    np.testing.assert_array_equal(pixels, expected)
    assert pixels[5].tolist() == [1.25, 7.5]


def test_an_empty_model_has_none():
    tracks, pixels = read_tracks_and_pixels(pycolmap.Reconstruction())
    assert {len(values) for values in vars(tracks).values()} == {0}
    assert tracks.points.shape == (0, 3) and pixels.shape == (0, 2)


class OnAFullDisk:
    """A model of which pycolmap writes one file no farther than the disk has room: all but so many bytes."""

    def __init__(self, name: str, lacking: float) -> None:
        self.model, self.name, self.lacking = reconstruction_with_gaps(), name, lacking

    def write_binary(self, folder: str) -> None:
        self.model.write_binary(folder)
        path = Path(folder) / self.name
        content = path.read_bytes()
        # a share of the file below 1, bytes above
        lacking = self.lacking if self.lacking >= 1 else math.ceil(self.lacking * len(content))
        assert 0 < lacking < len(content)
        path.write_bytes(content[: len(content) - int(lacking)])


CUT = [
    *(("points3D.bin", lacking) for lacking in (0.001, 0.5, 0.7, 0.999)),
    # the last byte, the last keypoint, and all of the last image and more
    *(("images.bin", lacking) for lacking in (1, 24, 2400, 0.999)),
]


@pytest.mark.parametrize(("name", "lacking"), CUT)
def test_a_full_disk_for_temporary_files_is_named(name, lacking, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with pytest.raises(OSError, match="No space left") as error:
        read_tracks_and_pixels(OnAFullDisk(name, lacking))
    assert (error.value.errno, error.value.filename) == (errno.ENOSPC, str(tmp_path))
    assert not list(tmp_path.iterdir())


def test_a_folder_for_temporary_files_that_is_gone_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "gone"))
    with pytest.raises(OSError, match="No such file") as error:
        read_tracks(reconstruction_with_gaps())
    assert error.value.filename == str(tmp_path / "gone")
