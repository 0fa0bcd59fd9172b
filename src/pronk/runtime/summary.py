"""How a deployment went: figures of its processes, what was told meanwhile, who ended it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from pronk.runtime.events import Notice


@dataclass(kw_only=True)
class Outcome:
    """How a deployment went."""

    servo: dict[str, Any] = field(default_factory=dict)
    """Figures of the servo; empty if it was killed."""
    policy: dict[str, Any] = field(default_factory=dict)
    """Figures of the policy's process; empty if it was killed."""
    notices: list[Notice] = field(default_factory=list)
    interrupted: bool = False
    """Whether somebody ended it by a signal: the interrupt key, or the end of the terminal."""
    trained_delay_s: tuple[float, float] = (0.0, 0.0)
    """Command delays that the policy was trained for [s]."""

    @property
    def faults(self) -> list[str]:
        """What damped the robot."""
        return [notice.text for notice in self.notices if notice.kind == "fault"]

    @property
    def refusals(self) -> list[str]:
        """Why the robot was not moved."""
        return [notice.text for notice in self.notices if notice.kind == "refused"]

    def delay_words(self) -> str:
        """The measured delay beside the range that the policy was trained for, in one line."""
        low, high = (1e3 * edge for edge in self.trained_delay_s)
        measured = self.servo.get("state_to_command", {})
        if not measured.get("n"):
            return f"no delay was measured; the policy was trained for {low:g} to {high:g} ms."
        p50, p95 = measured["p50_ms"], measured["p95_ms"]
        where = "within" if p95 <= high else "BEYOND"
        return (
            f"state to command {p50:.1f} ms (median), {p95:.1f} ms (95 %), n = {measured['n']}: "
            f"{where} the {low:g} to {high:g} ms trained for; the drives' own delay comes on top."
        )

    def figures(self) -> dict[str, Any]:
        """For JSON and the end of the log."""
        return {
            "servo": self.servo,
            "policy": self.policy,
            "trained_delay_s": list(self.trained_delay_s),
            "faults": self.faults,
            "refusals": self.refusals,
            "interrupted": self.interrupted,
        }
