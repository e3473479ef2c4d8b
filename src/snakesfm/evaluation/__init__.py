"""How good a model is: alignment to a reference, pose errors and the areas under their recall curves."""
