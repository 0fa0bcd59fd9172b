"""Errors a user can mend.

Every error names what was got, what was expected and the way out; the command line prints it
as one sentence and ends with exit status 2. Anything else that escapes is a defect of pronk.
"""

from __future__ import annotations


class PronkError(Exception):
    """Base of every error that the caller can mend."""


class LogError(PronkError):
    """A log cannot be read, or its content is implausible."""


class RobotError(PronkError):
    """A robot, joint or drive is unknown or impossible."""


class PlanError(PronkError):
    """A sweep could exceed a limit of the robot."""


class IdentifiabilityError(PronkError):
    """The data cannot tell the parameters apart; the message names the missing experiment."""


class ArtefactError(PronkError):
    """A file that pronk wrote (or should have written) is damaged or of another schema."""


class HardwareError(PronkError):
    """A machine does not respond, or a limit was breached while it moved."""
