"""A gamepad at this machine, through GLFW, which comes with mujoco and knows the usual models.

GLFW finds gamepads only where there is a display. Left stick: forward and sideways; right stick:
turn; A (cross): jump; Start: set down anew.
"""

from __future__ import annotations

import warnings
from typing import Any

from pronk.evaluation.live.joystick import Pad


class Gamepad:
    """The first gamepad there is, also one that is plugged in later.

    Use it from the thread that opened it, which GLFW demands to be the main one.
    """

    def __init__(self) -> None:
        """Look for gamepads."""
        self._glfw: Any = None
        with warnings.catch_warnings():
            # Without a display GLFW warns, and cannot be used.
            warnings.simplefilter("ignore")
            try:
                import glfw

                if glfw.init():
                    self._glfw = glfw
            except (ImportError, OSError):
                pass

    @property
    def name(self) -> str | None:
        """Of the gamepad; None if there is none."""
        found = self._first()
        return None if found is None else str(self._glfw.get_gamepad_name(found))

    def read(self) -> Pad:
        """Its state; at rest if there is none."""
        found = self._first()
        state = None if found is None else self._glfw.get_gamepad_state(found)
        if not state:
            return Pad()
        glfw = self._glfw
        return Pad(
            forward=-state.axes[glfw.GAMEPAD_AXIS_LEFT_Y],
            left=-state.axes[glfw.GAMEPAD_AXIS_LEFT_X],
            yaw=-state.axes[glfw.GAMEPAD_AXIS_RIGHT_X],
            jump=bool(state.buttons[glfw.GAMEPAD_BUTTON_A]),
            reset=bool(state.buttons[glfw.GAMEPAD_BUTTON_START]),
        )

    def close(self) -> None:
        """Let go."""
        if self._glfw is not None:
            self._glfw.terminate()
            self._glfw = None

    def _first(self) -> int | None:
        if self._glfw is None:
            return None
        self._glfw.poll_events()
        slots = range(self._glfw.JOYSTICK_1, self._glfw.JOYSTICK_LAST + 1)
        return next((slot for slot in slots if self._glfw.joystick_is_gamepad(slot)), None)
