"""Absolute rotations from relative ones, by interchangeable averagers."""
