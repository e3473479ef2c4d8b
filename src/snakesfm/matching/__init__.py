"""Matching of local descriptors between two images."""
