"""Which images may see the same things: global descriptors and the choice of image pairs."""
