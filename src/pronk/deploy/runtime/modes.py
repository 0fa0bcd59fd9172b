"""Modes of the servo, and the requests by which the operator changes them.

    Idle -> Preflight -> Damp -> Stand -> Policy -> Halt -> Sit -> Damp
                      -> Sweep -> Damp
                                   any fault -> Fault (damped) -> Damp -> ...

`pronk.deploy.runtime.state_machine` says when one mode follows another.
"""

from __future__ import annotations

from collections.abc import Iterable
from enum import IntEnum


class Mode(IntEnum):
    """State of the servo."""

    IDLE = 0
    """Connected or not; nothing is sent."""
    PREFLIGHT = 1
    """States are checked; nothing is sent."""
    DAMP = 2
    """The joints are damped, and the servo waits for a request."""
    STAND = 3
    """The robot stands up, or stands."""
    POLICY = 4
    """The policy runs with the operator's command."""
    HALT = 5
    """The policy runs with a zero command before the robot sits down."""
    SIT = 6
    """The robot sits down."""
    FAULT = 7
    """The joints are damped after a fault."""
    ENDED = 8
    """The link is closed."""
    SWEEP = 9
    """Joints are excited one after another."""


SILENT = (Mode.IDLE, Mode.PREFLIGHT, Mode.ENDED)
"""Modes in which nothing is sent."""
DRIVEN = (Mode.STAND, Mode.POLICY, Mode.HALT, Mode.SIT, Mode.SWEEP)
"""Modes whose newest command on the wire is a target, not damping."""
POLICY_MODES = (Mode.POLICY, Mode.HALT)
"""Modes in which the policy gives the targets."""


class OperatorRequest(IntEnum):
    """Request of the operator."""

    NONE = 0
    """No request."""
    DAMP = 1
    """Damp the joints at once."""
    STAND = 2
    """Stand up."""
    WALK = 3
    """Start the policy."""
    SIT = 4
    """Stop, sit down, damp."""
    RESET = 5
    """Clear a latched fault whose cause is gone."""
    QUIT = 6
    """Damp the joints and end."""
    CLAMPED = 7
    """The joints of a sweep are clamped as requested."""


def deciding_request(requests: Iterable[OperatorRequest]) -> OperatorRequest:
    """Return which of requests that are read together counts, in whatever order they came.

    To quit outweighs to damp, because it damps too, and either outweighs the others. Of the others
    the last counts; without any it is `OperatorRequest.NONE`.
    """
    deciding = OperatorRequest.NONE
    for request in requests:
        if deciding is OperatorRequest.QUIT:
            break
        if deciding is OperatorRequest.DAMP and request is not OperatorRequest.QUIT:
            continue
        deciding = request
    return deciding
