"""Measurements against other systems; no part of the library."""
