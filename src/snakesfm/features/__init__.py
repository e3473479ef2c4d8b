"""Local features: keypoints with descriptors."""
