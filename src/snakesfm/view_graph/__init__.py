"""The view graph: its components, the consistency of its cycles, and the edges that filters refuse."""
