"""The question: signals, the plan and what it will do, recording, logs and importers.

`plan` and `record` are imported by name (they bring the simulator and the machine with them).
"""

from __future__ import annotations

from pronk.sweep.log import Segment, SweepLog
from pronk.sweep.readers import read_log, read_logs
from pronk.sweep.signals import Chirp, LogChirp, Multisine, Signal, SineSteps

__all__ = [
    "Chirp",
    "LogChirp",
    "Multisine",
    "Segment",
    "Signal",
    "SineSteps",
    "SweepLog",
    "read_log",
    "read_logs",
]
