"""The report about a scene: counts, plots and reasons, as one HTML file."""
