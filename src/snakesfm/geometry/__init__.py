"""Cameras, rotations and poses as arrays."""
