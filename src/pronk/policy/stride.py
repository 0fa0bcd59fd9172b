"""When in the stride a jump begins: the jump input waits until the legs change over.

In a trot the front right and the hind left leg go together, and so do the other two. A jump begins
as the knees of that pair bend beyond those of the other one, wherever in its stride the robot was
as the jump was asked for: in trials, evaluations and on the robot alike. How far a jump goes and
whether it is landed depends on that moment more than on anything else that differs between two
jumps of one robot (docs/training.md has the figures), and the wait for it is a stride at most. In
training jumps begin at any moment; three trainings that waited, too, landed fewer. The moment at
which the other pair bends beyond that one would do as well for a robot whose left side is its right
side mirrored; none is.

Works on arrays of NumPy and of PyTorch, of one robot and of many.
"""

from __future__ import annotations

from typing import Any

MOST_S = 0.26
"""Nobody waits longer [s]: a stride takes 0.16 s at 2 m/s, 0.20 s at 1 m/s and 0.27 s at 0.5 m/s,
and a robot that stands has none."""
_FIRST, _SECOND = (2, 11), (5, 8)
"""Knees of the front right and the hind left leg, and of the front left and the hind right one, in
the order of joints that `pronk.policy.layout` has."""


def apart(position: Any) -> Any:
    """How far front right and hind left knee are bent beyond the other two, together [rad]. (...,).

    Args:
        position: Of the joints, absolute or relative to a pose alike on all legs [rad]. (..., 12)
    """
    first, second = (sum(position[..., knee] for knee in pair) for pair in (_FIRST, _SECOND))
    return first - second


def changes_over(before: Any, now: Any) -> Any:
    """Whether the legs change over from one policy step to the next. Bool, (...,).

    Args:
        before: `apart` at the first. (...,)
        now: At the second. (...,)
    """
    return (before < 0.0) & (now >= 0.0)


class StrideGate:
    """Lets the jump inputs of one robot or several pass when their strides come to the moment."""

    def __init__(self, like: Any, *, policy_rate_hz: float) -> None:
        """Begin as after `reset`.

        Args:
            like: Zeros, one for each robot: an array of NumPy or PyTorch, of any shape.
            policy_rate_hz: How often it will be called.
        """
        self._most = round(MOST_S * policy_rate_hz)
        self._apart, self._waited, self._passed = 0.0 * like, 0.0 * like, like > 0.0

    def reset(self, which: Any = ...) -> None:
        """Forget the stride and what was asked.

        Args:
            which: Index of the robots; all of them if left out.
        """
        self._apart, self._waited, self._passed = (
            _zeroed(value, which) for value in (self._apart, self._waited, self._passed)
        )

    def __call__(self, position: Any, asked: Any) -> Any:
        """The jump input that the network gets; call it once a policy step.

        Once it has passed, it stays until nobody asks any more; who lets go before does not jump.

        Args:
            position: Of the joints, as `apart` takes them [rad]. (..., 12)
            asked: Whether a jump is asked for. Bool, (...,).

        Returns:
            Bool, (...,).
        """
        now = apart(position)
        late = self._waited >= self._most
        self._passed = asked & (self._passed | changes_over(self._apart, now) | late)
        self._waited = (self._waited + 1.0) * asked
        self._apart = now
        return self._passed


def _zeroed(value: Any, which: Any) -> Any:
    """A copy with zeros (or False) at an index."""
    found = value.clone() if hasattr(value, "clone") else value.copy()
    found[which] = 0
    return found
