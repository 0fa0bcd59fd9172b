"""A robot behind Unitree's DDS messages: a Go2, or the virtual robot.

A Go2 reads domain 0. Nothing reaches a real network, or domain 0, without an interface that the
user named. The command in force is repeated, because Unitree's drives are written to all the time
and it is not published what they do when that stops.

Unitree's services are a request and its response on two topics, in JSON. A request carries an id of
its own and the number of a function (`api_id`); the response carries both again, and a code, 0 for
done. `motion_switcher` reports which of the robot's own controllers holds the joints, and releases
it. Older firmware has `robot_state` instead.
"""

from __future__ import annotations

import contextlib
import json
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any
from xml.sax.saxutils import quoteattr

from cyclonedds import core
from cyclonedds.core import DDSException, Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from pronk.deploy.links.dds import messages
from pronk.deploy.links.dds.codec import (
    STATE_RATE_HZ,
    DdsStateDecoder,
    encode_dds_command,
    joint_map,
)
from pronk.deploy.links.link import RESPONSE_S, LinkSettings, NetworkLink, port_or_domain
from pronk.deploy.links.writer import Encode, Publish
from pronk.errors import HardwareError
from pronk.robots.machine import damping_command
from pronk.robots.robot import RobotSpec

COMMANDS = "rt/lowcmd"
"""Topic of commands."""
STATES = "rt/lowstate"
"""Topic of states."""
LOOPBACK_DOMAIN = 77
"""pronk's own domain; Unitree's robots use 0, unitree_mujoco 1."""
ROBOT_DOMAIN = 0
_DOMAINS = range(233)
"""Possible domains; the ports of higher ones would exceed 65535."""
_QUEUE = 64
"""Messages kept between two reads; at 500 Hz an eighth of a second."""
_WRITE_NS = 1_000_000
"""Longest time that a slow reader may hold a writer up [ns]."""

_ON_INTERFACE = """<CycloneDDS><Domain Id="any"><General>
<Interfaces><NetworkInterface name={}/></Interfaces></General></Domain></CycloneDDS>"""
# Loopback often has no multicast: query the ports of the first participants one by one.
ON_LOOPBACK = """<CycloneDDS><Domain Id="any"><General>
<Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General>
<Discovery><ParticipantIndex>auto</ParticipantIndex>
<MaxAutoParticipantIndex>30</MaxAutoParticipantIndex>
<Peers><Peer address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>"""

# Domains that this process has opened; the library holds one configuration for each.
_domains: dict[int, tuple[DdsNetwork, Any]] = {}

# Services, and numbers of their functions, as in unitree_sdk2.
SWITCHER = "motion_switcher"
CHECK_MODE = 1001
SELECT_MODE = 1002
RELEASE_MODE = 1003
ROBOT_STATE = "robot_state"
"""Service of older firmware."""
SERVICE_SWITCH = 1001
BENCH = "pronk_bench"
"""Service of the virtual robot alone: clamps, and the hands at the wireless remote."""
CLAMP = 1
REMOTE = 2
"""Function of that service: the bytes of the wireless remote, in hexadecimal."""
# Codes of a response, as in unitree_sdk2.
DONE = 0
UNKNOWN_API = 3203
BAD_PARAMETER = 3204

_POLL_S = 0.002
_RELEASE_TRIES = 10
_RELEASE_PAUSE_S = 0.2
_LONGEST_BURST_S = 0.1
"""Longest time over which samples that arrived together were sent [s]."""
_LONGEST_PAUSE_S = 0.05
"""Longest wait for a sample [s]."""


@dataclass(frozen=True, kw_only=True)
class DdsNetwork:
    """A domain on an interface."""

    interface: str | None = None
    """Name of the interface, for instance `eth0`; None for loopback only."""
    domain: int | None = None
    """Number of the domain; None for 0 where an interface is named, else pronk's own, 77."""

    def __post_init__(self) -> None:
        """Choose the domain; HardwareError for one that is not allowed."""
        domain = port_or_domain(
            "DDS domain",
            self.domain,
            self.interface,
            real=ROBOT_DOMAIN,
            virtual=LOOPBACK_DOMAIN,
            allowed=_DOMAINS,
        )
        object.__setattr__(self, "domain", domain)

    def __str__(self) -> str:
        return f"DDS domain {self.domain} on {self.interface or 'loopback'}"


class RawSample:
    """A sample that stays bytes, header and payload."""

    def __init__(self, data: bytes) -> None:
        self.data = data

    def serialize(self, use_version_2: bool | None = None) -> bytes:
        """The bytes for the wire, whichever version of CDR the library asks for."""
        return self.data

    @classmethod
    def deserialize(cls, data: bytes) -> RawSample:
        """A sample of the bytes from the wire."""
        return cls(data)


class Participant:
    """One member of a domain. Samples of `LowCmd` and `LowState` stay bytes (`RawSample`)."""

    def __init__(self, network: DdsNetwork) -> None:
        """Join; HardwareError for a missing interface, or a domain in use with another."""
        domain = network.domain
        assert domain is not None
        if domain in _domains:
            opened_network, _ = _domains[domain]
            if opened_network != network:
                raise HardwareError(
                    f"this process already uses {opened_network}; close it and start anew for "
                    f"{network}."
                )
        configuration = ON_LOOPBACK
        if network.interface:
            configuration = _ON_INTERFACE.format(quoteattr(network.interface))
        try:
            if domain not in _domains:
                _domains[domain] = (network, Domain(domain, configuration))
            self.entity = DomainParticipant(domain)
        except DDSException as error:
            _domains.pop(domain, None)
            raise HardwareError(
                f"cannot join {network}: {error.msg}; is there such an interface, is it up, and "
                "has it an address? (`ip addr` lists them)"
            ) from None

    def reader(
        self, topic: str, message: Any, *, include_local: bool = True, depth: int = _QUEUE
    ) -> Any:
        """Make a reader.

        Args:
            topic: Name of the topic.
            message: Its IDL type.
            include_local: Whether samples of this participant are read too.
            depth: Messages kept between two reads.
        """
        policies = [Policy.History.KeepLast(depth)]
        if not include_local:
            policies.append(Policy.IgnoreLocal.Participant)
        return DataReader(self.entity, self._topic(topic, message), Qos(*policies))

    def writer(self, topic: str, message: Any) -> Any:
        """Make a writer, which fits every reader and waits for none."""
        reliability = Policy.Reliability.Reliable(_WRITE_NS)
        return DataWriter(self.entity, self._topic(topic, message), Qos(reliability))

    def _topic(self, name: str, message: Any) -> Any:
        topic = Topic(self.entity, name, message)
        if message in (messages.LowCmd, messages.LowState):
            topic.data_type = RawSample  # only for Python; the type's name and description stay
        return topic


def take_samples(reader: Any, counts: Counter[str]) -> list[Any]:
    """The samples that have come, oldest first; bytes that cannot be read are counted."""
    try:
        samples = reader.take(_QUEUE)
    except Exception:  # by the library's decoder
        counts["refused: unreadable"] += 1
        return []
    return [sample for sample in samples if sample.sample_info.valid_data]


def write_bytes(writer: Any, data: bytes, counts: Counter[str]) -> None:
    """Write bytes; those that the library does not take in time are counted and dropped."""
    try:
        writer.write(RawSample(data))
    except DDSException:
        counts["not written"] += 1


class ServiceClient:
    """Calls a service."""

    def __init__(self, participant: Participant, service: str) -> None:
        self._service = service
        self._requests = participant.writer(f"rt/api/{service}/request", messages.Request)
        self._responses = participant.reader(f"rt/api/{service}/response", messages.Response)

    def call(self, api_id: int, parameter: Any) -> dict[str, Any] | None:
        """Call a function, repeatedly while there is no response.

        Args:
            api_id: Number of the function.
            parameter: Its argument, which is sent in JSON.

        Returns:
            What the function returned; None without a response within `RESPONSE_S`.

        Raises:
            HardwareError: The response has a code other than 0, or no JSON object.
        """
        identity = messages.RequestIdentity(id=time.monotonic_ns(), api_id=api_id)
        header = messages.RequestHeader(
            identity=identity,
            lease=messages.RequestLease(id=0),
            policy=messages.RequestPolicy(priority=0, noreply=False),
        )
        request = messages.Request(header=header, parameter=json.dumps(parameter), binary=[])
        end = time.monotonic() + RESPONSE_S
        next_request = -1.0
        while time.monotonic() < end:
            if time.monotonic() >= next_request and self._requests.get_matched_subscriptions():
                self._requests.write(request)
                next_request = time.monotonic() + RESPONSE_S / 4
            for response in take_samples(self._responses, Counter()):
                if response.header.identity == identity:
                    return self._data(api_id, response)
            time.sleep(_POLL_S)
        return None

    def _data(self, api_id: int, response: Any) -> dict[str, Any]:
        """Return the JSON object of a response."""
        code = response.header.status.code
        result = f"code {code}"
        if code == DONE:
            result = f"{response.data[:60]!r}"
            data = None
            with contextlib.suppress(ValueError):
                data = json.loads(response.data or "{}") or {}
            if isinstance(data, dict):
                return data
        raise HardwareError(
            f"the robot's service {self._service} returned {result} for function {api_id}, "
            "expected code 0 and a JSON object; switch by the robot's own remote or app instead."
        )


def check_own_controller(participant: Participant, *, release: bool) -> None:
    """Check that none of the robot's own controllers holds the joints; `release` one that does."""
    switcher = ServiceClient(participant, SWITCHER)
    response = switcher.call(CHECK_MODE, {})
    if response is None:
        # Older firmware ends its sport mode by another service.
        if release:
            robot_state = ServiceClient(participant, ROBOT_STATE)
            sport_mode_off = {"name": "sport_mode", "switch": 0}
            if robot_state.call(SERVICE_SWITCH, sport_mode_off) is not None:
                return
        raise HardwareError(
            f"the robot did not respond on its service {SWITCHER} within {RESPONSE_S:g} s, so it "
            "is not known whether its own controller is off; check the network, and its firmware."
        )
    controller = response.get("name", "")
    if not controller:
        return
    if not release:
        raise HardwareError(
            f"the robot's own controller {controller!r} holds the joints; lay the robot down or "
            "hang it up, and have the controller released (--disable-onboard-controller)."
        )
    for _ in range(_RELEASE_TRIES):
        switcher.call(RELEASE_MODE, {})
        time.sleep(_RELEASE_PAUSE_S)
        response = switcher.call(CHECK_MODE, {})
        # Without a response the controller counts as switched off.
        controller = "" if response is None else response.get("name", "")
        if not controller:
            return
    raise HardwareError(
        f"the robot's own controller {controller!r} was not switched off after {_RELEASE_TRIES} "
        "requests; switch it off by the robot's app."
    )


class DdsMachine(NetworkLink):
    """A robot with twelve joints behind Unitree's messages. Implements `Machine`."""

    torque_kind = "measured"  # tau_est, by the drives from their currents
    state_rate_hz = STATE_RATE_HZ
    # Unitree's examples write every 1 to 10 ms.
    _repeat_s = 0.004

    def __init__(
        self,
        robot: RobotSpec,
        *,
        interface: str | None = None,
        domain: int | None = None,
        settings: LinkSettings | None = None,
    ) -> None:
        """Describe the link.

        Args:
            robot: The robot.
            interface: Network interface to a real robot, None for loopback only.
            domain: Number of the domain, as of `DdsNetwork`.
            settings: Settings of every link; the usual if None.
        """
        super().__init__(robot, settings)
        self._joints = joint_map(robot)
        self._sinking = damping_command(len(robot.joints), self._joints.sink_damping)
        self._network = DdsNetwork(interface=interface, domain=domain)
        self._command_topic = COMMANDS
        self._address = f"{STATES} in {self._network}"

    def open_damper(self) -> Callable[[], None]:
        """Join the domain by itself, and return what writes damping."""
        commands = Participant(self._network).writer(COMMANDS, messages.LowCmd)
        data = encode_dds_command(self._joints, self._sinking)
        return lambda: write_bytes(commands, data, self.counts)

    def _open(self) -> tuple[Encode, Publish]:
        self._decoder = DdsStateDecoder(self._joints, self.counts)
        self._senders: set[int] = set()
        self._participant = Participant(self._network)
        self._states_reader = self._participant.reader(STATES, messages.LowState)
        self._foreign_commands = self._participant.reader(
            COMMANDS, messages.LowCmd, include_local=False
        )
        commands = self._participant.writer(COMMANDS, messages.LowCmd)
        self._bench = ServiceClient(self._participant, BENCH)
        any_sample = core.SampleState.Any | core.ViewState.Any | core.InstanceState.Any
        self._samples_come = core.WaitSet(self._participant.entity)
        for reader in (self._states_reader, self._foreign_commands):
            self._samples_come.attach(core.ReadCondition(reader, any_sample))
        encode = partial(encode_dds_command, self._joints)
        return encode, lambda data: write_bytes(commands, data, self.counts)

    def _shut(self) -> None:
        del self._samples_come, self._states_reader, self._foreign_commands
        del self._bench, self._participant

    def _prepare(self) -> None:
        self.virtual = self._decoder.virtual
        if self._joints.virtual_only and not self.virtual:
            raise HardwareError(
                f"the robot in {self._network} is not pronk's virtual robot, and no real "
                f"{self.robot} sends Unitree's messages; give the robot's name."
            )
        check_own_controller(self._participant, release=self._settings.release)

    @property
    def sources(self) -> int:
        """Senders of states."""
        return len(self._senders)

    def _hold(self, joints: tuple[str, ...]) -> bool:
        return self._bench.call(CLAMP, {"joints": list(joints)}) is not None

    def _receive(self) -> None:
        self._samples_come.wait(int(_LONGEST_PAUSE_S * 1e9))
        arrived = time.monotonic()
        if take_samples(self._foreign_commands, self.counts):
            self.counts["foreign"] += 1
            if self._writer is not None and self._writer.wrote:
                self._writer.damp()
        samples = take_samples(self._states_reader, self.counts)
        if not samples:
            return
        newest_ns = samples[-1].sample_info.source_timestamp
        for sample in samples:
            # Samples that arrived together are distinguished by when they were sent.
            age_s = (newest_ns - sample.sample_info.source_timestamp) * 1e-9
            stamp = arrived - min(max(age_s, 0.0), _LONGEST_BURST_S)
            self._senders.add(sample.sample_info.publication_handle)
            self._take(self._decoder.take, sample.data, stamp)
