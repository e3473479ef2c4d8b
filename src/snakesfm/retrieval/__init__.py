"""Candidate image pairs: global descriptors and pair selection."""
