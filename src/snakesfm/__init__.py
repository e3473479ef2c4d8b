"""snakesfm: global Structure-from-Motion as a Snakemake workflow of files."""

__version__ = "0.1.0"
