"""Choices that several commands offer."""

from __future__ import annotations

from enum import StrEnum


class Link(StrEnum):
    """How the machine is reached."""

    SIM = "sim"
    LCM = "lcm"
    DDS = "dds"


class Layout(StrEnum):
    """The messages on LCM."""

    CHEETAH = "cheetah"
    WTW = "wtw"


class Base(StrEnum):
    """What the virtual robot's trunk stands on."""

    BENCH = "bench"
    GROUND = "ground"
