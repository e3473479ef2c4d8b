"""snakesfm side by side with COLMAP's two mappers and openMVG, on sets with reference poses."""
