"""Errors of bad input: what was given, what was expected, and the way out, in one sentence.

The command line prints them and ends with exit status 2.
"""

from __future__ import annotations


class PronkError(Exception):
    """Base of every error that the caller can fix."""


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
