"""What is read from pycolmap's files is what its objects say."""

import cv2  # noqa: F401
import numpy as np
import pycolmap

from snakesfm.bundle.model import BundleModel, to_reconstruction
from snakesfm.bundle.reading import observations_of, observed_keypoints
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


def test_observations_are_those_of_the_tracks_in_their_order():
    reconstruction = reconstruction_with_gaps()
    points, owners, images, rows = observations_of(reconstruction)
    ids = sorted(reconstruction.point3D_ids())
    np.testing.assert_array_equal(points, [reconstruction.point3D(k).xyz for k in ids])
    expected = [
        (row, element.image_id - 1, element.point2D_idx)
        for row, k in enumerate(ids)
        for element in reconstruction.point3D(k).track.elements
    ]
    np.testing.assert_array_equal(np.stack([owners, images, rows], axis=1), expected)


def test_keypoints_are_those_of_the_images():
    reconstruction = reconstruction_with_gaps()
    _, _, images, rows = observations_of(reconstruction)
    reconstruction.image(int(images[5]) + 1).point2D(int(rows[5])).xy = (1.25, 7.5)
    expected = [
        reconstruction.image(i + 1).point2D(k).xy
        for i, k in zip(images.tolist(), rows.tolist(), strict=True)
    ]
    np.testing.assert_array_equal(observed_keypoints(reconstruction, images, rows), expected)
    np.testing.assert_array_equal(
        observed_keypoints(reconstruction, images[::-1], rows[::-1]), expected[::-1]
    )


def test_an_empty_model_has_none():
    points, owners, images, rows = observations_of(pycolmap.Reconstruction())
    assert len(points) == len(owners) == len(images) == len(rows) == 0
    assert observed_keypoints(pycolmap.Reconstruction(), images, rows).shape == (0, 2)
