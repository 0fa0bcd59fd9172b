"""What the safety filter does with a command, and why: levels and reasons, a line for each."""

from __future__ import annotations

from enum import IntEnum


class Level(IntEnum):
    """What is done with a command, from nothing to all."""

    PASS = 0
    """Sent as it is."""
    LIMIT = 1
    """Sent with its target moved."""
    HOLD = 2
    """The last one is sent again."""
    DAMP = 3
    """The joints are damped, for a second at least and until somebody asks to stand again."""
    LATCH = 4
    """The joints are damped until a person has said that the fault is mended."""


class Reason(IntEnum):
    """Why. Those up to `POWER` move the target, or hold; the others damp."""

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

    @property
    def text(self) -> str:
        """The reason in one line."""
        return TEXTS[self]


TEXTS: dict[Reason, str] = {
    Reason.NONE: "nothing to object to",
    Reason.OLD_STATE: "the newest state is older than 20 ms; the last target is held",
    Reason.POSITION: "the target would drive a joint out of its limits; it was moved back",
    Reason.CHANGE: "the target jumps too far in one tick; it was slowed down",
    Reason.TORQUE: "the target asks for more torque than the drive may give; it was moved back",
    Reason.POWER: "the targets ask for more power than the battery may give; they were moved back",
    Reason.STATE_NOT_FINITE: "the state holds something that is not a number",
    Reason.COMMAND_NOT_FINITE: "the command holds something that is not a number",
    Reason.GAINS: "the command's gains are negative or beyond what the drives take",
    Reason.CLOCK: "a state or command is stamped in the future; the clocks disagree",
    Reason.EXPIRED: "the newest command has expired; is the policy's process alive?",
    Reason.NO_STATE: "no state for 50 ms",
    Reason.STATE_LOST: "no state for 100 ms; the link or the robot's program has stopped",
    Reason.LAG: "the command answers a state more than three policy steps old",
    Reason.OVERRUN: "a joint is beyond its mechanical limits; its encoder may have slipped",
    Reason.TILT: "the trunk is tilted too far",
    Reason.SPEED: "a joint turns faster than it can",
    Reason.TEMPERATURE: "a motor is too hot",
    Reason.IMPOSSIBLE: "no target meets all limits at once",
    Reason.DEAD_MAN: "the dead-man button is not held",
    Reason.ENDED: "the program that the operator sits at has gone",
    Reason.LINK: "the link reports a fault",
}
