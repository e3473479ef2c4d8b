"""How time and memory of every stage grow with the number of images; see ``python -m benchmarks.growth -h``."""
