"""Typed options of every stage, and the configuration that holds them."""
