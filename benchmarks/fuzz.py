"""Mutated inputs of every reader, as the tests mutate them, in any number."""

from __future__ import annotations

from tests.mutated_files import fuzz

__all__ = ["fuzz"]
