"""What a sweep's MCAP file holds: its topics, the schema of each, and the header.

Each message is a line of JSON with its schema in the file, so that Foxglove and PlotJuggler show
them as they are:

- `/sweep/header`, once, first: robot, joints, gains, pose, units, whether the robot is virtual;
- `/sweep/segment`, before its samples, so that a cut log still has it;
- `/sweep/sample`, one per measured state: command in force, answer, instantaneous frequency;

and `/sweep/end`, last: whether the sweep is complete, and if not, why.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

SCHEMA = "pronk/sweep/1"

HEADER, SEGMENT, SAMPLE, END = "/sweep/header", "/sweep/segment", "/sweep/sample", "/sweep/end"

_NUMBERS = {"type": "array", "items": {"type": "number"}}
_NAMES = {"type": "array", "items": {"type": "string"}}
SCHEMAS: dict[str, dict[str, Any]] = {
    HEADER: {
        "schema": {"type": "string"},
        "robot": {"type": "string"},
        "joints": _NAMES,
        "stiffness": _NUMBERS,
        "damping": _NUMBERS,
        "pose": _NUMBERS,
        "units": _NAMES,
        "virtual": {"type": "boolean"},
        "metadata": {"type": "object"},
    },
    SEGMENT: {
        "kind": {"type": "string"},
        "joints": _NAMES,
        "start": {"type": "number"},
        "stop": {"type": "number"},
        "amplitude": {"type": "number"},
        "repeat": {"type": "integer"},
        "band_hz": _NUMBERS,
        "period_s": {"type": "number"},
        "clamped": _NAMES,
    },
    SAMPLE: {
        "t": {"type": "number"},
        "command": _NUMBERS,
        "position": _NUMBERS,
        "velocity": _NUMBERS,
        "torque": _NUMBERS,
        "frequency": {"type": "number"},
        "segment": {"type": "integer"},
    },
    END: {"complete": {"type": "boolean"}, "reason": {"type": "string"}},
}
"""Properties of each topic's messages, as JSON Schema has them."""


@dataclass(frozen=True, kw_only=True)
class LogHeader:
    """What is known of a log before its first sample. Fields as in JointLog."""

    robot: str
    joints: tuple[str, ...]
    stiffness: Sequence[float] | None = None
    damping: Sequence[float] | None = None
    pose: Sequence[float] | None = None
    units: tuple[str, ...] = ()
    virtual: bool = False
    metadata: dict[str, str] = field(default_factory=dict)
