import numpy as np

from snakesfm.geometry.poses import has_pose


def test_a_pose_of_which_a_part_is_missing_is_none():
    rotations, translations = np.tile(np.eye(3), (4, 1, 1)), np.zeros((4, 3))
    rotations[1], translations[1] = np.nan, np.nan
    rotations[2, 2, 1] = np.nan
    translations[3, 2] = np.nan
    np.testing.assert_array_equal(has_pose(rotations, translations), [True, False, False, False])
    assert has_pose(rotations[:0], translations[:0]).shape == (0,)
    assert has_pose(rotations[0], translations[0])
