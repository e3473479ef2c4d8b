"""Short digests by which a job knows that a file is of the configuration that it is told."""

import hashlib


def options_digest(stage_version: int, options: str) -> str:
    """A digest of a stage's version and the canonical JSON of its options: 16 hexadecimal digits."""
    return hashlib.sha256(f"{stage_version}\0{options}".encode()).hexdigest()[:16]
