"""Gaps and platforms of growing size, until they are too much."""
