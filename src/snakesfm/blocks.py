"""How many blocks the images are dealt into, and the tiles of pairs that these make."""

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


def tile_names(blocks: int) -> list[str]:
    """The tiles 'a-b', a <= b, of the matrix of image pairs."""
    return [f"{a}-{b}" for a in range(blocks) for b in range(a, blocks)]
