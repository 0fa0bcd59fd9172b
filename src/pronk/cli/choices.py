"""Choices that several commands offer."""

from __future__ import annotations

from typing import Literal

Link = Literal["sim", "lcm", "dds"]
"""How the machine is reached."""


Layout = Literal["cheetah", "wtw"]
"""The messages on LCM."""


Base = Literal["bench", "ground"]
"""What the virtual robot's trunk stands on."""
