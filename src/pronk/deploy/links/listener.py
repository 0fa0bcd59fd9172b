"""Listening to a robot under another program: states and commands from the wire, nothing onto it.

A listener subscribes and does no more. It opens no writer, publishes no message and asks no
service.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pkgutil import resolve_name

from pronk.arrays import Array
from pronk.deploy.links.address import Address
from pronk.errors import HardwareError
from pronk.robots.machine import RefusedError, State, TorqueKind
from pronk.robots.robot import RobotSpec

LISTENERS = {
    "lcm": "pronk.deploy.links.lcm.listener:LcmListener",
    "dds": "pronk.deploy.links.dds.listener:DdsListener",
}
"""Listener of each link that has one."""


@dataclass(frozen=True, kw_only=True, eq=False)
class WireCommand:
    """What another program commanded, as it was sent; arrays of joints have shape (joints,).

    The drives compute `stiffness (position - q) + damping (velocity - dq) + torque`. A part that
    the drives were told to leave out has no gain.
    """

    position: Array
    """Target of the position [rad]; 0 without stiffness."""
    velocity: Array
    """Target of the velocity [rad/s]; 0 without damping."""
    stiffness: Array
    """Stiffness [N m/rad]."""
    damping: Array
    """Damping [N m s/rad]."""
    torque: Array
    """Torque beside them [N m]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class HeardMessage:
    """A state or a command that came over the wire."""

    arrived: float
    """When it was received, on this computer's monotonic clock [s]."""
    sent: float | None
    """When it was sent, on the sender's clock [s]; None where the wire does not say."""
    content: State | WireCommand
    """What came."""


class Listener(ABC):
    """Receives the states and the commands of a robot; subclasses add the wire."""

    state_topic = ""
    """Topic or channels of the states."""
    command_topic = ""
    """Topic or channel of the commands."""
    torque_kind: TorqueKind = "absent"
    """What the torque of the states is."""

    def __init__(self, robot: RobotSpec) -> None:
        """Listen to no wire yet."""
        self.robot = robot
        self.counts: Counter[str] = Counter()
        """`states`, `commands`, and why messages were dropped."""
        self.virtual = False
        """Whether the virtual robot has identified itself."""
        self.command_senders: set[int] = set()
        """Programs that have sent commands, where the wire tells them apart."""
        self.last_refusal = ""
        """Why the last message that was dropped was, as a sentence without its full stop."""

    @abstractmethod
    def open(self) -> None:
        """Subscribe; HardwareError for a wire that is not there."""

    @abstractmethod
    def receive(self, timeout_s: float) -> list[HeardMessage]:
        """Return what has come, oldest first; wait at most that long for the first message."""

    @abstractmethod
    def close(self) -> None:
        """Leave the wire."""

    def decoded_state(
        self, decode: Callable[[bytes, float], State | None], data: bytes, arrived: float
    ) -> State | None:
        """Decode a message of states and count it; None for one that makes no state."""
        try:
            state = decode(data, arrived)
        except RefusedError as error:
            self.refuse(error)
            return None
        if state is not None:
            self.counts["states"] += 1
        return state

    def decoded_command(
        self, decode: Callable[[bytes], WireCommand], data: bytes
    ) -> WireCommand | None:
        """Decode a command and count it; None for one that cannot be used."""
        try:
            command = decode(data)
        except RefusedError as error:
            self.refuse(error)
            return None
        self.counts["commands"] += 1
        return command

    def refuse(self, error: RefusedError) -> None:
        """Count a message that cannot be used."""
        self.counts[f"refused: {error.reason}"] += 1
        self.last_refusal = str(error).rstrip(".")


def find_listener(address: Address, robot: RobotSpec) -> Listener:
    """Make the listener of an address, which is not open yet.

    Raises:
        HardwareError: The link has no listener.
    """
    if address.scheme not in LISTENERS:
        raise HardwareError(
            f"--link {address}: nothing can be listened to there; the links that can be recorded "
            f"are {', '.join(LISTENERS)}, as in dds://eth0."
        )
    listener = resolve_name(LISTENERS[address.scheme])
    made: Listener = listener(robot, interface=address.interface, **address.options)
    return made
