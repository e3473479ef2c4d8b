"""Scenes whose truth is known exactly: for tests, benchmarks and demos."""
