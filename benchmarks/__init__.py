"""Measurements against other systems; no part of the library."""

import os
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

# the environment of what is measured: the sources beside this file, whichever are installed
SOURCES = {"PYTHONPATH": os.pathsep.join((str(ROOT / "src"), str(ROOT)))}
