"""The operator with the robot's own wireless remote, whose bytes come with every state."""

from __future__ import annotations

from collections.abc import Mapping

from pronk.deploy.links.remote import RemoteButton, RemoteInput, decode_remote
from pronk.deploy.runtime.modes import Mode, OperatorRequest, deciding_request
from pronk.deploy.runtime.teleop import Operator, OperatorCommand, Ranges
from pronk.policy.contract import COMMANDS
from pronk.policy.gamepad import JUMP_S, stick_command
from pronk.robots.machine import RefusedError

_REQUESTS: Mapping[RemoteButton, OperatorRequest] = {
    RemoteButton.A: OperatorRequest.STAND,
    RemoteButton.X: OperatorRequest.SIT,
    RemoteButton.Y: OperatorRequest.WALK,
    RemoteButton.START: OperatorRequest.RESET,
    RemoteButton.SELECT: OperatorRequest.QUIT,
    RemoteButton.B: OperatorRequest.DAMP,
}
"""Requests by button. Of buttons that are pressed together, the last of these counts, unless one of
them damps or quits (`deciding_request`)."""
_NEVER = -1e9
"""Time of a button that was not pressed yet [s]."""

REMOTE_HELP = """\
  hold L1      dead-man: releasing it while the policy runs damps the joints
  A stand up   Y start the policy   X sit down   B damp at once   START reset a fault   SELECT quit
  left stick forward and sideways   right stick turn   R1 jump"""
"""Buttons of the remote."""


class Remote(Operator):
    """The robot's wireless remote; one that is switched off counts as released."""

    def __init__(self, ranges: Ranges) -> None:
        """Begin without a remote.

        Args:
            ranges: Smallest and largest commands.
        """
        self._ranges = ranges
        self._input: RemoteInput | None = None
        """Newest input; None without a remote, or with bytes that are none of it."""
        self._held_before: frozenset[RemoteButton] | None = None
        """Buttons that were held at the last reading; None before a remote was heard, so that a
        button that is held from the begin requests nothing."""
        self._jump_pressed = _NEVER
        """Time at which the jump button was pressed last [s]."""
        self._left = False
        """Whether the program was interrupted."""

    def leave(self) -> None:
        """End, because the program was interrupted."""
        self._left = True

    def sensed(self, remote: bytes) -> None:
        """Take the bytes of the remote that came with the newest state."""
        try:
            self._input = decode_remote(remote)
        except RefusedError:
            self._input = None

    def command(self, now: float, mode: Mode) -> OperatorCommand:
        """Return the input of sticks and buttons."""
        if self._left:
            return OperatorCommand(request=OperatorRequest.QUIT)
        remote = self._input
        if remote is None:
            self._held_before = None
            return OperatorCommand()
        pressed: frozenset[RemoteButton] = frozenset()
        if self._held_before is not None:
            pressed = remote.held - self._held_before
        self._held_before = remote.held
        requests = [request for button, request in _REQUESTS.items() if button in pressed]
        if RemoteButton.R1 in pressed:
            self._jump_pressed = now
        forward, left, yaw_rate = COMMANDS
        return OperatorCommand(
            command=(
                stick_command(remote.left_forward, self._ranges[forward]),
                stick_command(-remote.left_right, self._ranges[left]),
                stick_command(-remote.right_right, self._ranges[yaw_rate]),
            ),
            jump=now - self._jump_pressed < JUMP_S,
            dead_man=RemoteButton.L1 in remote.held,
            request=deciding_request(requests),
        )
