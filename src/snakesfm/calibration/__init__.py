"""Focal lengths from fundamental matrices, before any pose is known."""
