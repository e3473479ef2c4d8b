"""Camera centres from rotations, directions between cameras and rays to landmarks."""
