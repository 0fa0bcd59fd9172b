"""What the safety filter does with a command, and why: one table of all reasons."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple


class FilterAction(IntEnum):
    """What the filter does with a command, in order of severity."""

    PASS = 0
    """Sent unchanged."""
    LIMIT = 1
    """Sent with its target moved."""
    HOLD = 2
    """The last target is sent again."""
    DAMP = 3
    """The joints are damped for a second at least, until a request to stand."""
    LATCH = 4
    """The joints are damped until the operator resets the fault."""


class Reason(IntEnum):
    """Why the filter acted. Those up to `POWER` hold or move the target; the others are faults.

    The numbers are those of the log. `REASONS` holds the text and the action of each.
    """

    NONE = 0
    OLD_STATE = 1
    POSITION = 2
    CHANGE = 3
    TORQUE = 4
    POWER = 5
    STATE_NOT_FINITE = 6
    COMMAND_NOT_FINITE = 7
    GAINS = 8
    CLOCK = 9
    EXPIRED = 10
    NO_STATE = 11
    STATE_LOST = 12
    LAG = 13
    OVERRUN = 14
    TILT = 15
    SPEED = 16
    TEMPERATURE = 17
    IMPOSSIBLE = 18
    DEAD_MAN = 19
    ENDED = 20
    LINK = 21
    OVERLOAD = 22
    REPEATED = 23
    ATTITUDE = 24
    ENCODER = 25
    HELD = 26
    CLIPPED = 27
    SWAPPED = 28
    STANDBY = 29
    ROBOT_CLOCK = 30
    INTERRUPTED = 31
    BUS_VOLTAGE = 32
    FAR_TARGET = 33
    COLLAPSED = 34
    TRACKING = 35
    ORIENTATION = 36

    @property
    def text(self) -> str:
        """One line for people."""
        return REASONS[self].text

    @property
    def level(self) -> FilterAction:
        """What the filter does for this reason."""
        return REASONS[self].action


class ReasonEntry(NamedTuple):
    """A row of the table of reasons."""

    reason: Reason
    action: FilterAction
    """What the filter does; `LATCH` is a fault that lasts until the operator resets it."""
    text: str
    """One line for people."""


_PASS = FilterAction.PASS
_LIMIT = FilterAction.LIMIT
_HOLD = FilterAction.HOLD
_DAMP = FilterAction.DAMP
_LATCH = FilterAction.LATCH

REASONS: tuple[ReasonEntry, ...] = (
    ReasonEntry(Reason.NONE, _PASS, "no limit met"),
    ReasonEntry(
        Reason.OLD_STATE, _HOLD, "the newest state is older than 20 ms; the last target is held"
    ),
    ReasonEntry(
        Reason.POSITION,
        _LIMIT,
        "the target would drive a joint beyond its limits; it was moved back",
    ),
    ReasonEntry(
        Reason.CHANGE, _LIMIT, "the target changes too much in one tick; it was slowed down"
    ),
    ReasonEntry(
        Reason.TORQUE,
        _LIMIT,
        "the target needs more torque than the drive may give; it was moved back",
    ),
    ReasonEntry(
        Reason.POWER,
        _LIMIT,
        "the targets need more power than the battery may give; they were moved back",
    ),
    ReasonEntry(Reason.STATE_NOT_FINITE, _LATCH, "the state holds something that is not a number"),
    ReasonEntry(
        Reason.COMMAND_NOT_FINITE, _LATCH, "the command holds something that is not a number"
    ),
    ReasonEntry(
        Reason.GAINS,
        _LATCH,
        "the command's gains are negative or beyond the range of the drives",
    ),
    ReasonEntry(
        Reason.CLOCK,
        _LATCH,
        "a state or command is stamped in the future; the clocks disagree",
    ),
    ReasonEntry(
        Reason.EXPIRED, _LATCH, "the newest command has expired; check the policy's process"
    ),
    ReasonEntry(Reason.NO_STATE, _DAMP, "no state for 50 ms"),
    ReasonEntry(
        Reason.STATE_LOST,
        _LATCH,
        "no state for 100 ms; the link or the robot's program has stopped",
    ),
    ReasonEntry(
        Reason.LAG,
        _LATCH,
        "the command was computed from a state more than three policy steps old",
    ),
    ReasonEntry(
        Reason.OVERRUN,
        _LATCH,
        "a joint is beyond its mechanical limits; its encoder may have slipped",
    ),
    ReasonEntry(Reason.TILT, _LATCH, "the trunk is tilted too far"),
    ReasonEntry(Reason.SPEED, _LATCH, "a joint turns faster than its limit"),
    ReasonEntry(Reason.TEMPERATURE, _LATCH, "a motor is too hot"),
    ReasonEntry(Reason.IMPOSSIBLE, _LATCH, "no target meets all limits at once"),
    ReasonEntry(Reason.DEAD_MAN, _DAMP, "the dead-man button is not held"),
    ReasonEntry(Reason.ENDED, _DAMP, "the operator's program has ended"),
    ReasonEntry(Reason.LINK, _LATCH, "the link reports a fault"),
    ReasonEntry(Reason.OVERLOAD, _LATCH, "a joint's measured torque is beyond its limit"),
    ReasonEntry(
        Reason.REPEATED,
        _LATCH,
        "a sensor of the trunk repeats its numbers; it or its program has stopped",
    ),
    ReasonEntry(Reason.ATTITUDE, _LATCH, "attitude, gyro and accelerometer contradict each other"),
    ReasonEntry(
        Reason.ENCODER,
        _LATCH,
        "a joint's position and velocity contradict each other or its load",
    ),
    ReasonEntry(
        Reason.HELD,
        _DAMP,
        "states were too old, and the last target held, for too much of a second",
    ),
    ReasonEntry(
        Reason.CLIPPED,
        _LATCH,
        "a joint's target was beyond its torque for too long; the joint may be blocked",
    ),
    ReasonEntry(
        Reason.SWAPPED,
        _LATCH,
        "another joint moved than the one that was swung; their encoders are swapped",
    ),
    ReasonEntry(
        Reason.STANDBY,
        _LATCH,
        "the servo was silent for too long, and the standby process damped the joints",
    ),
    ReasonEntry(
        Reason.ROBOT_CLOCK,
        _LATCH,
        "the robot's own clock disagrees with the times at which its states arrive",
    ),
    ReasonEntry(
        Reason.INTERRUPTED,
        _LATCH,
        "states come with pauses or out of order, so that they cannot be compared",
    ),
    ReasonEntry(Reason.BUS_VOLTAGE, _LATCH, "the bus voltage is too low for the drives"),
    ReasonEntry(Reason.FAR_TARGET, _LATCH, "a target is far beyond the range of its joint"),
    ReasonEntry(Reason.COLLAPSED, _LATCH, "the trunk is down although the policy runs"),
    ReasonEntry(
        Reason.TRACKING,
        _LATCH,
        "a joint does not follow its target; it may be seized, or its motor without torque",
    ),
    ReasonEntry(
        Reason.ORIENTATION,
        _LATCH,
        "small motions in the standing pose were not measured as they were commanded",
    ),
)
"""Every reason in the order of its number: entry `n` is that of `Reason(n)`."""


class Decision(NamedTuple):
    """Why the filter acts on a command."""

    reason: Reason
    detail: str = ""
    """Joint and numbers of a new fault."""

    @property
    def level(self) -> FilterAction:
        """What the filter does."""
        return self.reason.level

    @property
    def text(self) -> str:
        """One line for people."""
        return f"{self.reason.text} ({self.detail})" if self.detail else self.reason.text
