"""What a person reads about a scene: counts, plots and reasons, as one HTML file."""
