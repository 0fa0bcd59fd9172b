"""What a deployment's log holds: topics, fields of their messages, and the arrays they become."""

from __future__ import annotations

from typing import Any

import numpy as np

from pronk.policy.layout import MEASURED_SIZE
from pronk.runtime.columns import Field

SCHEMA = "pronk/deploy/1"
ROOT = "/deploy/"

_N: dict[str, Any] = {"type": "number"}
_I: dict[str, Any] = {"type": "integer"}
_S: dict[str, Any] = {"type": "string"}
_B: dict[str, Any] = {"type": "boolean"}
_NS: dict[str, Any] = {"type": "array", "items": {"type": "number"}}
# Foxglove reads the properties of every object; without them it refuses the channel.
_O: dict[str, Any] = {"type": "object", "properties": {}}

TOPICS: dict[str, dict[str, dict[str, Any]]] = {
    "header": {"schema": _S, "robot": _S, "joints": {"type": "array", "items": _S}}
    | {"link": _S, "policy": _O, "limits": _O, "timing": _O, "versions": _O},
    "state": {"t": _N, "sequence": _I, "position": _NS, "velocity": _NS, "torque": _NS}
    | {"gyro": _NS, "accelerometer": _NS, "orientation": _NS, "bus_voltage": _N}
    | {"robot_time": _N, "temperature": _NS},
    "asked": {"t": _N, "tick": _I, "mode": _I, "mode_name": _S, "position": _NS, "blend": _N}
    | {"order": _I, "state_sequence": _I},
    "sent": {"t": _N, "tick": _I, "position": _NS, "stiffness": _N, "damped": _B, "level": _I}
    | {"reason": _I, "reason_name": _S},
    "timing": {"t": _N, "tick": _I, "lateness": _N, "work": _N, "state_age": _N, "latency": _N},
    "observation": {"t": _N, "step": _I, "state_sequence": _I, "observation": _NS},
    "action": {"t": _N, "step": _I, "live": _B, "command": _NS, "jump": _B, "action": _NS}
    | {"target": _NS, "contact": _NS, "linear_velocity": _NS, "lateness": _N, "decision": _N}
    | {"state_age": _N},
    "event": {"t": _N, "kind": _S, "text": _S, "reason": _S, "level": _S},
    "end": {"complete": _B, "figures": _O},
}
"""Topic to the fields of its messages."""

JOINTS = (-1,)
"""Stands for the shape of one number a joint."""
TICKS = {
    "time": Field(topic="asked", key="t"),
    "tick": Field(topic="asked", key="tick", dtype=np.int64),
    "mode": Field(topic="asked", key="mode", dtype=np.int64),
    "state_time": Field(topic="state", key="t"),
    "state_sequence": Field(topic="state", key="sequence", dtype=np.int64),
    "position": Field(topic="state", key="position", shape=JOINTS),
    "velocity": Field(topic="state", key="velocity", shape=JOINTS),
    "torque": Field(topic="state", key="torque", shape=JOINTS),
    "gyro": Field(topic="state", key="gyro", shape=(3,)),
    "accelerometer": Field(topic="state", key="accelerometer", shape=(3,)),
    "orientation": Field(topic="state", key="orientation", shape=(4,)),
    "bus_voltage": Field(topic="state", key="bus_voltage"),
    "asked": Field(topic="asked", key="position", shape=JOINTS),
    "sent": Field(topic="sent", key="position", shape=JOINTS),
    "blend": Field(topic="asked", key="blend"),
    "stiffness": Field(topic="sent", key="stiffness"),
    "damped": Field(topic="sent", key="damped", dtype=np.bool_),
    "level": Field(topic="sent", key="level", dtype=np.int64),
    "reason": Field(topic="sent", key="reason", dtype=np.int64),
    "order": Field(topic="asked", key="order", dtype=np.int64),
    "lateness": Field(topic="timing", key="lateness"),
    "work": Field(topic="timing", key="work"),
    "state_age": Field(topic="timing", key="state_age"),
    "latency": Field(topic="timing", key="latency"),
}
"""Arrays of `DeployLog` that have one row a tick, and where they come from."""
STEPS = {
    "step_time": Field(topic="action", key="t"),
    "step_live": Field(topic="action", key="live", dtype=np.bool_),
    "step_lateness": Field(topic="action", key="lateness"),
    "decision": Field(topic="action", key="decision"),
    "step_state_age": Field(topic="action", key="state_age"),
    "command": Field(topic="action", key="command", shape=(3,)),
    "jump": Field(topic="action", key="jump", dtype=np.bool_),
    "observation": Field(topic="observation", key="observation", shape=(MEASURED_SIZE,)),
    "action": Field(topic="action", key="action", shape=JOINTS),
    "target": Field(topic="action", key="target", shape=JOINTS),
    "contact": Field(topic="action", key="contact", shape=(4,)),
    "linear_velocity": Field(topic="action", key="linear_velocity", shape=(3,)),
}
"""Those that have one row a step of the policy."""
