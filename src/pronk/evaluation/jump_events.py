"""The times of a jump: rise and fall of the jump input, lift-off, touchdown."""

from __future__ import annotations

from dataclasses import asdict, dataclass

from pronk.errors import PronkError
from pronk.evaluation.jumps import JumpRules, jump_flights
from pronk.evaluation.metrics import sample_at, series_of
from pronk.runtime.script import Script
from pronk.virtual.capture import Capture


@dataclass(frozen=True, kw_only=True)
class JumpEvents:
    """Times on the capture's clock."""

    on: float
    """Rise of the jump input [s]."""
    off: float
    """Fall of the jump input [s]."""
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
                f"JumpEvents are {asdict(self)}; expected on < off and on <= liftoff < touchdown "
                "[s]."
            )


def jump_events(
    capture: Capture, script: Script, *, began: float = 0.0, rules: JumpRules | None = None
) -> JumpEvents | None:
    """Return the events of the main flight, or None without a jump.

    Args:
        capture: The recorded run.
        script: What was commanded.
        began: When the policy took over, on the capture's clock [s].
        rules: Of the definitions.
    """
    series, rise = series_of(capture), began + script.on
    on = sample_at(capture, rise)
    ahead = on < len(series.position)
    main = jump_flights(series, on, rules or JumpRules()).main if ahead else None
    if main is None:
        return None
    return JumpEvents(
        on=rise,
        off=began + script.off,
        liftoff=float(capture.time[main.liftoff]),
        touchdown=float(capture.time[main.touchdown]),
    )
