"""The names of hloc's files, which are planned before anything that reads them is loaded."""

FEATURES, MATCHES, PAIRS = "features.h5", "matches.h5", "pairs.txt"
