"""Tracks: keypoints of many images that show one point."""
