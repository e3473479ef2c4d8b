"""Points from tracks and poses."""
