"""Errors of bad input: what was given, what was expected, and the way out, in one sentence.

The command line prints them and ends with exit status 2.
"""

from __future__ import annotations

_MOST_LETTERS = 2000
"""Longest message; a damaged file can have a name or a list of names of any length."""


def printable(text: str) -> str:
    """Text with control characters as escapes, so that no file can steer a terminal."""
    return "".join(c if c.isprintable() or c == "\n" else ascii(c)[1:-1] for c in text)


class PronkError(Exception):
    """Base of every error that the caller can fix."""

    def __str__(self) -> str:
        """The message, printable and of limited length."""
        text = super().__str__()
        return printable(text if len(text) < _MOST_LETTERS else f"{text[:_MOST_LETTERS]} ...")


class LogError(PronkError):
    """A log cannot be read, or its content is implausible."""


class RobotError(PronkError):
    """A robot, joint or drive is unknown or impossible."""


class PlanError(PronkError):
    """A sweep could exceed a limit of the robot."""


class IdentifiabilityError(PronkError):
    """The data cannot separate the parameters; the message names the missing experiment."""


class ArtefactError(PronkError):
    """A file that pronk wrote (or should have written) is damaged or of another schema."""


class HardwareError(PronkError):
    """A machine does not respond, or a limit was breached while it moved."""
