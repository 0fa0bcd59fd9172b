"""Exit statuses of the `pronk` command; docs/commands.md has the same table."""

from __future__ import annotations

from enum import IntEnum


class ExitStatus(IntEnum):
    """What the exit status of a command says. A shell takes every status but 0 for a failure."""

    DONE = 0
    """The command did what it was asked to do."""
    DEFECT = 1
    """An error that pronk does not expect: a defect of pronk."""
    REFUSED = 2
    """The input was refused, the machine could not do it (a full disk, a closed output, too little
    memory), or a Python file of the user's raised an exception. One sentence on standard error says
    why."""
    NOT_BETTER = 3
    """`match`: every joint was matched, and at least one is no better on what was held out of the
    fit than less fitting. The files are written."""
    NO_MATCH = 4
    """`match`: at least one joint is no match. The files are written, with the joint marked."""
    RUN_FAULT = 5
    """`deploy`: a safety rule ended the run, a check refused it, or its log or capture was lost."""
    DRIFTED = 6
    """`drift`: at least one gain, friction or delay has changed by more than its intervals."""
    NOT_RESOLVED = 7
    """`drift`: none has changed by more than its intervals, and of at least one stiffness or
    damping a change that matters would not show."""
    POLICY_FELL = 8
    """`policy check`: the policy fell on the virtual robot."""
    INTERRUPTED = 130
    """The command was interrupted, by Ctrl-C or by a signal to end."""
