"""When a jump was asked, and when it was."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from pronk.errors import PronkError
from pronk.evaluation.jumps import JumpRules, answer
from pronk.evaluation.metrics import series_of
from pronk.runtime.script import Script
from pronk.virtual.capture import Capture


@dataclass(frozen=True, kw_only=True)
class Marks:
    """When a jump was asked and when it was."""

    on: float
    """The jump input rises [s]."""
    off: float
    """It falls [s]."""
    liftoff: float
    """[s]"""
    touchdown: float
    """[s]"""

    def __post_init__(self) -> None:
        """Refuse times that are not in order.

        Raises:
            PronkError: The input falls before it rises, or the robot lands before it lifts off.
        """
        if not (self.on < self.off and self.on <= self.liftoff < self.touchdown):
            raise PronkError(
                f"Marks are {asdict(self)}; expected on < off and on <= liftoff < touchdown [s]."
            )


def marks_of(
    capture: Capture, script: Script, *, began: float = 0.0, rules: JumpRules | None = None
) -> Marks | None:
    """Return the events of the main flight, by the rules of `evaluation.jumps`, or None.

    Args:
        capture: What was seen.
        script: What was asked.
        began: When the policy took over, on the capture's clock [s].
        rules: Of the definitions.
    """
    series, rise = series_of(capture), began + script.on
    on = int(np.searchsorted(capture.time, rise - 1e-3 * capture.dt))
    main = answer(series, on, rules or JumpRules()).main if on < len(series.position) else None
    if main is None:
        return None
    return Marks(
        on=rise,
        off=began + script.off,
        liftoff=float(capture.time[main.liftoff]),
        touchdown=float(capture.time[main.touchdown]),
    )
