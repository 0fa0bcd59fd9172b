"""Errors of bad input: what was given, what was expected, and the way out, in one sentence.

The command line prints them and ends with exit status 2 (`pronk.exit_status`).
"""

from __future__ import annotations

_MAX_CHARACTERS = 2000
"""Longest message; a damaged file can have a name or a list of names of any length."""


def printable(text: str) -> str:
    """Return text with control characters as escapes, so that no file can steer a terminal."""
    characters = []
    for character in text:
        harmless = character.isprintable() or character == "\n"
        characters.append(character if harmless else ascii(character)[1:-1])
    return "".join(characters)


class PronkError(Exception):
    """Base of every error that the caller can fix."""

    def __str__(self) -> str:
        """Return the message, printable and of limited length."""
        text = super().__str__()
        if len(text) >= _MAX_CHARACTERS:
            text = f"{text[:_MAX_CHARACTERS]} ..."
        return printable(text)


class LogError(PronkError):
    """A log cannot be read, or its content is implausible."""


class RobotError(PronkError):
    """A robot, joint or drive is unknown or impossible."""


class PlanError(PronkError):
    """A sweep could exceed a limit of the robot."""


class IdentifiabilityError(PronkError):
    """The data cannot separate the parameters; the message names the missing experiment."""


class UnmatchedError(PronkError):
    """Gains have joints that are no match, and were to be used as if they were."""


class ArtefactError(PronkError):
    """A file that pronk wrote (or should have written) is damaged or of another schema."""


class HardwareError(PronkError):
    """A machine does not respond, or a limit was breached while it moved."""


class NotStandingError(HardwareError):
    """A robot that does not stand, so that no policy may start on it."""
