"""A robot behind Unitree's DDS messages: a Go2, or the virtual robot.

The command in force is repeated, because Unitree's drives are written to all the time and it is not
published what they do when that stops.

Unitree's services are a request and its response on two topics, in JSON. A request carries an id of
its own and the number of a function (`api_id`); the response carries both again, and a code, 0 for
done. `motion_switcher` (1001 CheckMode, 1003 ReleaseMode) reports which of the robot's own
controllers holds the joints, and releases it. Older firmware has `robot_state` (1001 ServiceSwitch)
instead.
"""

from __future__ import annotations

import json
import time
from collections import Counter
from typing import Any

from pronk.errors import HardwareError
from pronk.links.dds import messages
from pronk.links.dds.address import COMMANDS, STATES, DdsNetwork, Participant, take, write
from pronk.links.dds.codec import STATE_RATE_HZ, StateDecoder, encode_command, joint_map
from pronk.links.link import ANSWER_S, CommandWriter, NetworkLink
from pronk.robots.robot import RobotSpec

SWITCHER, CHECK_MODE, SELECT_MODE, RELEASE_MODE = "motion_switcher", 1001, 1002, 1003
OLDER, SERVICE_SWITCH = "robot_state", 1001
BENCH, CLAMP = "pronk_bench", 1
"""Of the virtual robot alone: requests for clamps."""

DONE, UNKNOWN_API, BAD_PARAMETER = 0, 3203, 3204
"""Codes of a response; the errors are unitree_sdk2's for an unknown function and for an impossible
parameter."""

_POLL_S = 0.002
_RELEASE_TRIES, _RELEASE_PAUSE_S = 10, 0.2

_LONGEST_BURST_S = 0.1
_LONGEST_PAUSE_S = 0.05
_REPEAT_S = 0.004
"""Silence after which the command in force is written again; Unitree's examples write every 1 to
10 ms."""


class Client:
    """Calls a service."""

    def __init__(self, participant: Participant, service: str) -> None:
        """Prepare; nothing is sent."""
        self._service = service
        self._requests = participant.writer(f"rt/api/{service}/request", messages.Request)
        self._responses = participant.reader(f"rt/api/{service}/response", messages.Response)

    def call(self, api_id: int, parameter: Any, *, timeout_s: float = 2.0) -> Any | None:
        """Call a function by its number, again while there is no response.

        Returns:
            The response's data; None without a response within `timeout_s` [s].

        Raises:
            HardwareError: The service responded with another code than 0.
        """
        identity = messages.RequestIdentity(id=time.monotonic_ns(), api_id=api_id)
        header = messages.RequestHeader(
            identity=identity,
            lease=messages.RequestLease(id=0),
            policy=messages.RequestPolicy(priority=0, noreply=False),
        )
        request = messages.Request(header=header, parameter=json.dumps(parameter), binary=[])
        end = time.monotonic() + timeout_s
        again = -1.0
        while time.monotonic() < end:
            if time.monotonic() >= again and self._requests.get_matched_subscriptions():
                self._requests.write(request)
                again = time.monotonic() + timeout_s / 4
            for response in take(self._responses, Counter()):
                if response.header.identity == identity:
                    return self._data(api_id, response)
            time.sleep(_POLL_S)
        return None

    def _data(self, api_id: int, response: Any) -> Any:
        code = response.header.status.code
        if code != DONE:
            raise HardwareError(
                f"the robot's service {self._service} returned {code} for function {api_id}, "
                "expected 0; switch by the robot's own remote or app instead."
            )
        try:
            return json.loads(response.data or "null") or {}
        except ValueError:
            raise HardwareError(
                f"the robot's service {self._service} returned {response.data[:60]!r} for function "
                f"{api_id}, expected JSON; is its firmware supported?"
            ) from None


def check_own_controller(participant: Participant, *, release: bool, timeout_s: float) -> None:
    """Check that none of the robot's own controllers holds the joints; `release` one that does.

    Raises:
        HardwareError: One holds them and may not be, or could not be, released; or the robot does
            not respond in time.
    """
    switcher = Client(participant, SWITCHER)
    response = switcher.call(CHECK_MODE, {}, timeout_s=timeout_s)
    if response is None:
        # Older firmware ends its sport mode by another service.
        sport = {"name": "sport_mode", "switch": 0}
        older = Client(participant, OLDER)
        if release and older.call(SERVICE_SWITCH, sport, timeout_s=timeout_s) is not None:
            return
        raise HardwareError(
            f"the robot did not respond on its service {SWITCHER} within {timeout_s:g} s, so it is "
            "not known whether its own controller is off; check the network, and its firmware."
        )
    name, tries = _name(response), _RELEASE_TRIES if release else 0
    while name and tries:
        tries -= 1
        switcher.call(RELEASE_MODE, {}, timeout_s=timeout_s)
        time.sleep(_RELEASE_PAUSE_S)
        name = _name(switcher.call(CHECK_MODE, {}, timeout_s=timeout_s))
    if name and release:
        raise HardwareError(
            f"the robot's own controller {name!r} was not switched off after "
            f"{_RELEASE_TRIES} requests; switch it off by the robot's app."
        )
    if name:
        raise HardwareError(
            f"the robot's own controller {name!r} holds the joints; lay the robot down or hang it "
            "up, and have the controller released (--disable-onboard-controller)."
        )


def _name(response: Any) -> str:
    return str(response.get("name", "")) if isinstance(response, dict) else ""


class DdsMachine(NetworkLink):
    """A robot with twelve joints behind Unitree's messages. Implements `Machine`."""

    wire = "DDS"
    torque_kind = "measured"  # tau_est, by the drives from their currents
    state_rate_hz = STATE_RATE_HZ

    def __init__(
        self,
        robot: RobotSpec,
        *,
        interface: str | None = None,
        domain: int | None = None,
        **common: Any,
    ) -> None:
        """Describe the link on an interface and domain (`DdsNetwork`); nothing is opened yet.

        What else links take (`common`) is as of `NetworkLink`.
        """
        super().__init__(robot, **common)
        self._joints = joint_map(robot)
        self._network = DdsNetwork(interface=interface, domain=domain)
        self._command_topic, self._address = COMMANDS, f"{STATES} in {self._network}"

    def _open(self) -> CommandWriter:
        self._decoder = StateDecoder(self._joints, self.counts)
        self._senders: set[int] = set()
        self._participant = own = Participant(self._network)
        self._states_in = own.reader(STATES, messages.LowState, raw=True)
        self._others = own.reader(COMMANDS, messages.LowCmd, raw=True, own=False)
        out = own.writer(COMMANDS, messages.LowCmd, raw=True)
        self._bench = Client(own, BENCH)
        self._wake = own.wake_on(self._states_in, self._others)
        return CommandWriter(
            lambda command: encode_command(self._joints, command),
            lambda data: write(out, data, self.counts),
            damping=self._joints.sink_damping,
            repeat_s=_REPEAT_S,
            counts=self.counts,
        )

    def _shut(self) -> None:
        del self._wake, self._states_in, self._others, self._bench, self._participant

    def _prepare(self) -> None:
        self.virtual = self._decoder.virtual
        if self._joints.virtual_only and not self.virtual:
            raise HardwareError(
                f"the robot in {self._network} is not pronk's virtual robot, and no real "
                f"{self.robot} sends Unitree's messages; give the robot's name."
            )
        check_own_controller(self._participant, release=self._release, timeout_s=ANSWER_S)

    def _confirm(self) -> None:
        if len(self._senders) > 1:
            raise HardwareError(
                f"{len(self._senders)} robots send on {STATES} in {self._network}, expected one; "
                "switch the others off, or take another domain."
            )

    def _hold(self, joints: tuple[str, ...]) -> bool:
        request = {"joints": list(joints)}
        return self._bench.call(CLAMP, request, timeout_s=ANSWER_S) is not None

    def _receive(self) -> None:
        self._wake.wait(int(_LONGEST_PAUSE_S * 1e9))
        arrived = time.monotonic()
        if take(self._others, self.counts):
            self.counts["foreign"] += 1
            # Damp, for it is unknown which command the drives follow.
            if self._writer is not None and self._writer.wrote:
                self._writer.damp()
        samples = take(self._states_in, self.counts)
        for sample in samples:
            # Those that waited together are distinguished by when they were sent.
            last, this = (each.sample_info.source_timestamp for each in (samples[-1], sample))
            stamp = arrived - min(max((last - this) * 1e-9, 0.0), _LONGEST_BURST_S)
            self._senders.add(sample.sample_info.publication_handle)
            self._take(self._decoder.take, sample.data, stamp)
