"""Assignment of images to blocks, and the tiles of pairs between blocks."""

import hashlib
from collections.abc import Sequence

# images up to which so many blocks are used: few steps, so that adding images rarely re-deals them, and so
# few blocks that a tile takes about half a minute at the upper end of a step (docs/cluster.md)
BLOCK_LADDER = ((60, 2), (1_000, 4), (4_000, 8), (16_000, 16), (60_000, 32))
MOST_BLOCKS = 48


def choose_blocks(image_count: int) -> int:
    """The number of blocks for a number of images where the configuration says 'auto'."""
    for most_images, blocks in BLOCK_LADDER:
        if image_count <= most_images:
            return blocks
    return MOST_BLOCKS


def deal_blocks(names: Sequence[str], blocks: int) -> list[int]:
    """The block of each image, in 0 .. blocks-1: all of one size, and other images hardly change it.

    A hash of the name chooses the block, and another one where that is full; who comes too late for a full
    block is told by a hash, too (Mirrokni, Thorup and Zadimoghaddam, "Consistent hashing with bounded
    loads", SODA 2018). So each image that is added moves few others.

    Parameters
    ----------
    names : relative names of all images.
    blocks : how many blocks there are.
    """
    most = -(-len(names) // blocks)
    sizes = [0] * blocks
    chosen = [0] * len(names)
    for row in sorted(range(len(names)), key=lambda row: _hash(names[row], "turn")):
        choice = 0
        while sizes[block := _hash(names[row], str(choice)) % blocks] == most:
            choice += 1
        sizes[block] += 1
        chosen[row] = block
    return chosen


def _hash(name: str, use: str) -> int:
    return int.from_bytes(hashlib.sha256(f"{use}\0{name}".encode()).digest()[:8], "big")


def tile_names(blocks: int) -> list[str]:
    """The tiles 'a-b', a <= b, of the matrix of image pairs."""
    return [f"{a}-{b}" for a in range(blocks) for b in range(a, blocks)]
