"""Benchmarks of pronk, run from a checkout: `python -m benchmarks NAME`."""
