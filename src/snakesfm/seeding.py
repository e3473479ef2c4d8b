"""Seeds that depend on the data worked on, never on the order or number of jobs."""

import hashlib


def derive_seed(seed: int, *names: str) -> int:
    """A 31-bit seed for one random draw.

    Parameters
    ----------
    seed : the run's seed.
    names : stage and names of what is worked on, such as the two image names of a pair.
    """
    text = "\0".join((str(seed), *names))
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "big") >> 1
