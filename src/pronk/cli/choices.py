"""Choices that several commands offer."""

from __future__ import annotations

from typing import Literal

Layout = Literal["cheetah", "wtw"]
"""The messages on LCM."""


Base = Literal["bench", "ground"]
"""What the virtual robot's trunk stands on."""
