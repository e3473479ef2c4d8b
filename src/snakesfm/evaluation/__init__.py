"""Accuracy of a model: alignment to a reference, pose errors and the areas under their recall curves."""
