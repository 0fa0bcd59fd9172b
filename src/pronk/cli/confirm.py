"""Confirmations by a person beside a real robot."""

from __future__ import annotations

import select
import sys

from pronk.cli import console
from pronk.errors import HardwareError

_LOOK_S = 0.2


def before_it_moves(robot: str, where: str) -> None:
    """A typed word, so that no key pressed by chance moves a robot.

    Raises:
        HardwareError: Another word.
    """
    console.say(
        f"A real {robot} at {where} is about to move. Everybody out of its reach; the first time, "
        "hang it up."
    )
    try:
        typed = input(f"Type the robot's name ({robot}) to go on: ").strip()
    except EOFError:
        typed = ""
    if typed != robot:
        raise HardwareError(f"that was not {robot!r}; nothing was moved.")


class Person:
    """A person at the bench who clamps joints and confirms it."""

    def __init__(self) -> None:
        """Nothing is fixed yet."""
        self._fixed: tuple[str, ...] = ()

    def __call__(self, joints: tuple[str, ...]) -> None:
        """Ask for these joints to be fixed and all others freed; returns when they are.

        Raises:
            HardwareError: Nobody is there.
        """
        if set(joints) == set(self._fixed):
            return
        free = [name for name in self._fixed if name not in joints]
        words = [f"fix {', '.join(joints)} mechanically where they are"] if joints else []
        words += [f"free {', '.join(free)}"] if free else []
        console.say(
            f"By hand, please: {', and '.join(words)}. The drives hold the pose meanwhile; keep "
            "clear of the legs afterwards. Press Enter when it is done."
        )
        # Looking again and again, and not reading, lets a fault end the program meanwhile.
        while not select.select([sys.stdin], [], [], _LOOK_S)[0]:
            pass
        if not sys.stdin.readline():
            raise HardwareError(
                "nobody is there to fix joints by hand; sweep joints that need no clamp "
                "(--joints), or run this from a terminal."
            )
        self._fixed = joints
