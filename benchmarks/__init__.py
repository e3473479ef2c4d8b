"""Measurements against other systems; no part of the library."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
