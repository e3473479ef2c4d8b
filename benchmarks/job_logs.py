"""The last line of a job's log, which says what the job cost."""

import re

DONE = re.compile(
    r"^(?P<clock>\d{4}-\d\d-\d\dT\S+) (?P<stage>\w+) done in (?P<seconds>[\d.]+) s, "
    r"(?P<cpu>[\d.]+) s of processor time, (?P<mb>\d+) MB at most$",
    re.MULTILINE,
)
