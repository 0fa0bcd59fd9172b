"""Connecting, states, commands, clamps and closing, common to all links."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from pronk.deploy.links.writer import CommandWriter, Encode, Publish
from pronk.errors import HardwareError
from pronk.robots.machine import Command, RefusedError, State, TorqueKind, damping_command
from pronk.robots.robot import RobotSpec

ClampOperator = Callable[[tuple[str, ...]], None]
"""A person at the bench: receives the joints to fix and returns when they are fixed."""

RESPONSE_S = 2.0
"""Time for a robot's first state, or for its response to a request [s]."""
_WINDOW_S = 0.2
"""How long states are watched before a robot is commanded [s]."""
_POLL_S = 0.002
_SHORTEST_DAMPING_S = 1.0
"""Time for which a robot is damped at the end in any case [s]."""
_LONGEST_DAMPING_S = 3.0
"""Time for which a robot that does not come to rest is damped at the end [s]."""
_REST_SPEED = 0.5
"""Joint speed below which a damped robot counts as at rest [rad/s]."""
_KEPT_STATES = 10_000
_LARGEST_RATE = 1.2
"""Largest share of the robot's rate at which states may come."""
_RATE_S = 1.0
"""Time over which the rate is counted: a pause of this computer of 0.2 s with the burst after it
passes [s]."""
_LARGEST_DISORDER = 0.2
"""Largest share of the states that may be out of order before a robot is commanded."""


@dataclass(frozen=True, kw_only=True)
class Freshness:
    """How fresh states must be before anything moves."""

    share: float = 0.9
    """Share of the expected number of states that must have come."""
    longest_gap_s: float = 0.02
    """Longest time between two states [s]."""


@dataclass(frozen=True, kw_only=True)
class LinkSettings:
    """Settings of every link, whatever its wire."""

    clamp_operator: ClampOperator | None = None
    """The person at the bench, who fixes joints; None if there is none."""
    release: bool = False
    """Whether the robot's own controller is switched off first; a standing robot falls then."""
    exclusive_s: float = 1.0
    """Time for which no other program may command before pronk does [s]."""
    fresh: Freshness = field(default_factory=Freshness)
    """How fresh states must be before anything moves."""


def wait_for(done: Callable[[], bool], seconds: float = RESPONSE_S) -> bool:
    """Wait at most `seconds` until a condition holds; return whether it does."""
    end = time.monotonic() + seconds
    while not done():
        if time.monotonic() >= end:
            return False
        time.sleep(_POLL_S)
    return True


def await_rest(latest: Callable[[], State | None]) -> None:
    """Wait 1 to 3 s until the newest state is at rest; no state counts as at rest."""

    def at_rest() -> bool:
        state = latest()
        return state is None or bool(np.abs(state.velocity).max() < _REST_SPEED)

    time.sleep(_SHORTEST_DAMPING_S)
    wait_for(at_rest, _LONGEST_DAMPING_S - _SHORTEST_DAMPING_S)


def port_or_domain(
    label: str,
    number: int | None,
    interface: str | None,
    *,
    real: int,
    virtual: int,
    allowed: range,
) -> int:
    """Choose the number of a port or a domain.

    Args:
        label: What the number is, for errors.
        number: The number requested; None for the usual one.
        interface: Network interface to a real robot, None for this computer only.
        real: Number of the real robots, the usual one with an interface.
        virtual: Number of the virtual robot, the usual one without an interface.
        allowed: Possible numbers.

    Raises:
        HardwareError: The number is not allowed, or is the real robots' without an interface.
    """
    if number is None:
        return virtual if interface is None else real
    if number not in allowed:
        raise HardwareError(f"{label} {number}; expected {allowed[0]} to {allowed[-1]}.")
    if interface is None and number == real:
        raise HardwareError(
            f"{label} {number} is the real robots'; take another, such as {virtual}, or name the "
            "network interface to the robot as well (for instance eth0)."
        )
    return number


class NetworkLink(ABC):
    """A robot behind a network. Implements `Machine`; subclasses add the wire.

    A thread receives, timestamps and keeps states, so that their times do not depend on the caller.
    """

    torque_kind: TorqueKind
    state_rate_hz: float
    _writer: CommandWriter | None = None  # None while the link is closed
    _command_topic = ""  # of commands, in error messages
    _address = ""  # of states, in error messages
    _repeat_s: float | None = None  # silence after which a command is written again [s]

    def __init__(self, robot: RobotSpec, settings: LinkSettings | None = None) -> None:
        """Describe the link, with the usual settings if there are none."""
        self.robot = robot.name
        self._robot = robot
        self._settings = LinkSettings() if settings is None else settings
        self._sinking = damping_command(len(robot.joints))
        self.virtual = False
        """Known once connected, when the virtual robot identifies itself."""
        self.counts: Counter[str] = Counter()
        """`states`, `commands`, `repeats`, `expired`, `foreign`, and why messages were dropped."""
        self._latest: State | None = None
        self._last_error = ""
        self._states: deque[State] = deque(maxlen=_KEPT_STATES)
        self._arrivals: deque[float] = deque()

    def connect(self) -> None:
        """Open the link; HardwareError unless fresh states come and no other program commands.

        It takes 1 or 2 s, in which nothing is written to the joints.
        """
        self.close()
        self.virtual = False
        self._latest = None
        self._last_error = ""
        self.counts.clear()
        self._states.clear()
        largest_count = 1 + round(_LARGEST_RATE * _RATE_S * self.state_rate_hz)
        self._arrivals = deque(maxlen=largest_count)
        encode, publish = self._open()
        self._writer = CommandWriter(
            encode,
            publish,
            damping=self._sinking,
            repeat_s=self._repeat_s,
            counts=self.counts,
        )
        self._reading = True
        self._thread = threading.Thread(target=self._read, name="pronk reader", daemon=True)
        self._thread.start()
        try:
            self._preflight()
        except BaseException:
            self.close()
            raise

    def now(self) -> float:
        """The local monotonic clock [s]."""
        return time.monotonic()

    def latest(self) -> State:
        """The newest state."""
        self._opened()
        assert self._latest is not None
        return self._latest

    def wait(self, until: float) -> list[State]:
        """Sleep to `until` [s]; return the states that arrived since the last call."""
        delay = until - time.monotonic()
        if delay > 0.0:
            time.sleep(delay)
        return [self._states.popleft() for _ in range(len(self._states))]

    def send(self, command: Command) -> None:
        """Put a command into force until the next or its expiry; refuse where others command."""
        writer = self._opened()
        self.check_exclusive()
        writer.send(command)

    def clamp(self, joints: tuple[str, ...]) -> None:
        """Have joints fixed: by the virtual robot itself, or by a person; () frees all."""
        for name in joints:
            self._robot.joint(name)
        if self.virtual and self._writer is not None:
            if not self._hold(joints):
                raise HardwareError(
                    f"the virtual robot did not confirm its clamps within {RESPONSE_S:g} s; check "
                    "that `pronk simulate` still runs."
                )
        elif self._settings.clamp_operator is not None:
            self._settings.clamp_operator(joints)
        elif joints:
            raise HardwareError(
                f"{', '.join(joints)} must be fixed mechanically and no person is at the bench; "
                "choose joints that need no clamp, or have someone there who confirms it."
            )

    def damp(self) -> None:
        """Write damping now and repeat it until the next command. Never raises."""
        if self._writer is not None:
            self._writer.damp()

    def open_damper(self) -> Callable[[], None] | None:
        """Open the wire to write damping beside the process that commands, once a call.

        None where the wire has one writer.
        """
        return None

    def close(self) -> None:
        """Leave the robot damped and at rest (1 to 3 s if anything was sent), and close."""
        writer = self._writer
        if writer is None:
            return
        if writer.wrote:
            writer.damp()
            await_rest(lambda: self._latest)
        writer.stop()
        self._reading = False
        self._thread.join()
        self._shut()
        self._writer = None

    def fresh_states(self, *, until: float) -> list[State]:
        """Return the first window of states that is fresh; HardwareError if none is by `until`."""
        expected = self.state_rate_hz * _WINDOW_S
        fresh = self._settings.fresh
        while True:
            self.wait(0.0)  # drops earlier states
            states = self.wait(time.monotonic() + _WINDOW_S)
            gap = np.inf
            if len(states) > 1:
                gap = float(np.diff([state.time for state in states]).max())
            if len(states) >= fresh.share * expected and gap <= fresh.longest_gap_s:
                return states
            # A busy computer may miss a window; a robot that is too slow misses all.
            if time.monotonic() > until:
                raise HardwareError(
                    f"{self.robot} sent {len(states)} fresh states in {_WINDOW_S * 1e3:.0f} ms "
                    f"with a longest gap of {gap * 1e3:.0f} ms, expected about {expected:.0f} with "
                    f"none above {fresh.longest_gap_s * 1e3:.0f} ms; check the network and that "
                    "this computer is not busy."
                )

    def check_exclusive(self) -> None:
        """Raise HardwareError if another program has commanded, or another robot sent states."""
        foreign_commands = self.foreign_commands
        if foreign_commands:
            raise HardwareError(
                f"another program commands the joints: {foreign_commands} commands on "
                f"{self._command_topic}; stop that program, or release the robot's own controller, "
                "and connect again."
            )
        excess = ""
        sources = self.sources
        if sources > 1:
            excess = f"{sources} robots or programs send states"
        elif self.counts["crowded"]:
            excess = f"more than {_LARGEST_RATE * self.state_rate_hz:.0f} states a second come"
        if excess:
            raise HardwareError(
                f"{excess} on {self._address}, expected one that sends "
                f"{self.state_rate_hz:.0f} a second; switch the others off, or take another port "
                "or domain, and connect again."
            )

    @property
    def sources(self) -> int:
        """Senders of states since the link was opened; 1 where the wire does not identify them."""
        return 1

    @property
    def foreign_commands(self) -> int:
        """Commands of other programs since the link was opened."""
        return self.counts["foreign"]

    def _opened(self) -> CommandWriter:
        """Return the writer; HardwareError while the link is closed."""
        if self._writer is None:
            raise HardwareError(f"the link to {self.robot} is not open; call connect() first.")
        return self._writer

    def _preflight(self) -> None:
        """Raise HardwareError unless fresh states come and no other program commands."""
        begun = time.monotonic()
        if not wait_for(lambda: self._latest is not None):
            reason = ""
            if self._last_error:
                reason = f"; what came was refused: {self._last_error}"
            raise HardwareError(
                f"{self.robot} sent no state on {self._address} within {RESPONSE_S:g} s{reason}; "
                "check that its program or the virtual robot runs, the link's options and the "
                "network."
            )
        self._prepare()
        self.counts["foreign"] = 0
        silent_until = time.monotonic() + self._settings.exclusive_s
        self.fresh_states(until=begun + 2.0 * RESPONSE_S)
        time.sleep(max(0.0, silent_until - time.monotonic()))
        self.check_exclusive()
        if self.counts["out of order"] > max(10.0, _LARGEST_DISORDER * self.counts["states"]):
            raise HardwareError(
                f"{self.counts['out of order']} of {self.counts['states']} states on "
                f"{self._address} are out of order, as of two robots; switch one off, or take "
                "another port or domain."
            )
        self._confirm()
        self.wait(0.0)

    def _read(self) -> None:
        """Receive until the link is closed; the body of the reading thread."""
        while self._reading:
            self._receive()

    def _take(
        self, decode: Callable[[bytes, float], State | None], data: bytes, arrived: float
    ) -> None:
        """Decode a message and keep the state that it makes, if any; count a refused one.

        Args:
            decode: Decodes a message that arrived at a time [s].
            data: The message.
            arrived: When it arrived [s].
        """
        try:
            state = decode(data, arrived)
        except RefusedError as error:
            self.counts[f"refused: {error.reason}"] += 1
            self._last_error = str(error).rstrip(".")
            return
        if state is not None:
            self._latest = state
            self._states.append(state)
            self.counts["states"] += 1
            now = time.monotonic()
            self._arrivals.append(now)
            counted = len(self._arrivals) == self._arrivals.maxlen
            if counted and now - self._arrivals[0] < _RATE_S:
                self.counts["crowded"] += 1

    # --- the wire -------------------------------------------------------------------------------

    @abstractmethod
    def _open(self) -> tuple[Encode, Publish]:
        """Open the wire; return what encodes a command and what puts its bytes on the wire."""

    @abstractmethod
    def _receive(self) -> None:
        """Wait at most 50 ms for messages and `_take` them; called by the reading thread."""

    @abstractmethod
    def _shut(self) -> None:
        """Close the wire; the writer and the reading thread have stopped."""

    def _prepare(self) -> None:  # noqa: B027
        """Release the robot's own controller, after the first state and before all checks."""

    def _confirm(self) -> None:  # noqa: B027
        """Identify the virtual robot, after all other checks."""

    def _hold(self, joints: tuple[str, ...]) -> bool:
        """Make the virtual robot fix joints; return whether it confirmed."""
        return False
