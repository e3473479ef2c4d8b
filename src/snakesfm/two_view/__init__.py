"""Relative pose of two images from keypoint matches: estimation, refinement, covariance, acceptance."""
