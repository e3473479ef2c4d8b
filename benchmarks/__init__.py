"""Measurements against other systems; no part of the library."""

import os
from pathlib import Path

from snakesfm.start import NO_SERVER, VARIABLE

ROOT = Path(__file__).resolve().parents[1]

# the environment of what is measured: the sources beside this file, whichever are installed
SOURCES = {"PYTHONPATH": os.pathsep.join((str(ROOT / "src"), str(ROOT)))}

# where the memory of each job is measured: jobs that are forked start with that of their server
NO_FORKS = {VARIABLE: NO_SERVER}
