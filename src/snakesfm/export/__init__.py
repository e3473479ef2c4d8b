"""A finished model in the formats that other tools read."""
