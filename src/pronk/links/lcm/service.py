"""What goes over LCM beside states and commands, as pure functions.

Cheetah-Software sets its parameters by messages; `control_mode` is the one that says which of the
robot's own controllers holds the joints. The virtual robot has a bench: it holds joints
mechanically when asked, and says what it is and what it holds.
"""

from __future__ import annotations

import struct

from pronk.links.lcm import types
from pronk.links.lcm.message import RefusedError

REQUEST_CHANNEL, RESPONSE_CHANNEL = "interface_request", "interface_response"
"""Where parameters are set and confirmed (`HardwareBridge.cpp`)."""
BENCH_CHANNEL, BEACON_CHANNEL = "pronk_bench", "pronk_virtual"
"""Where the virtual robot is asked for clamps, and where it says what it is."""

MODES = {0: "", 1: "stand_up", 3: "balance_stand", 4: "locomotion", 6: "recovery_stand"}
"""`control_mode` (`FSM_State.h`); 0 is passive, the joints are free for others."""
_MODE = b"control_mode"
# ControlParameters.h: the value is a double. ControlParameterInterface.h: set a robot's parameter.
_DOUBLE, _SET = 1, 1


def mode_request(mode: int, number: int) -> bytes:
    """The message that sets `control_mode`; the same bytes confirm it.

    Args:
        mode: As in `MODES`.
        number: Of the request.
    """
    # The robot copies memory here: little-endian, unlike everything else on this wire.
    value = struct.pack("<d", mode).ljust(64, b"\0")
    return types.CONTROL_PARAMETER.encode(
        name=list(_MODE.ljust(64, b"\0")),
        requestNumber=number,
        value=list(memoryview(value).cast("b")),
        parameterKind=_DOUBLE,
        requestKind=_SET,
    )


def read_mode_request(data: bytes) -> str:
    """The name of the mode that is asked for; empty for passive.

    Raises:
        RefusedError: `fingerprint`, `length`, or `parameter` (not `control_mode`, or no mode).
    """
    fields = types.CONTROL_PARAMETER.decode(data)
    name = fields["name"].tobytes().split(b"\0")[0]
    kinds = (int(fields["parameterKind"]), int(fields["requestKind"]))
    (value,) = struct.unpack_from("<d", fields["value"].tobytes())
    if name != _MODE or kinds != (_DOUBLE, _SET) or value not in MODES:
        raise RefusedError(
            "parameter",
            f"a request sets {name!r} to {value}; only {_MODE.decode()} can be set here, to one "
            f"of {', '.join(map(str, MODES))}.",
        )
    return MODES[int(value)]


def clamp_message(names: tuple[str, ...], held: tuple[str, ...], number: int) -> bytes:
    """The message that asks for clamps, or says which are held.

    Args:
        names: Of all twelve joints.
        held: Of those to be held, or held.
        number: Of the request.
    """
    return types.VIRTUAL_ROBOT.encode(request=number, clamped=[int(name in held) for name in names])


def read_clamp_message(names: tuple[str, ...], data: bytes) -> tuple[int, tuple[str, ...]]:
    """The number of the request, and the joints that are or shall be held.

    Raises:
        RefusedError: `fingerprint` or `length`.
    """
    fields = types.VIRTUAL_ROBOT.decode(data)
    flags = zip(names, fields["clamped"].tolist(), strict=True)
    return int(fields["request"]), tuple(name for name, held in flags if held)
