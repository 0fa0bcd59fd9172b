"""Robots and logs that pronk's makers did not make: `python -m benchmarks foreign`."""
