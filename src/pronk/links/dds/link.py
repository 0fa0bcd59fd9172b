"""A robot behind Unitree's DDS messages: a Go2, or the virtual robot.

A Go2 listens on domain 0. Nothing reaches a real network, or domain 0, without an interface that
the user named. The command in force is repeated, because Unitree's drives are written to all the
time and it is not published what they do when that stops.

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
from dataclasses import dataclass, field
from typing import Any
from xml.sax.saxutils import quoteattr

from cyclonedds.core import (
    DDSException,
    InstanceState,
    Policy,
    Qos,
    ReadCondition,
    SampleState,
    ViewState,
    WaitSet,
)
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from pronk.errors import HardwareError
from pronk.links.dds import messages
from pronk.links.dds.codec import STATE_RATE_HZ, StateDecoder, encode_command, joint_map
from pronk.links.link import ANSWER_S, CommandWriter, NetworkLink
from pronk.robots.robot import RobotSpec

COMMANDS, STATES = "rt/lowcmd", "rt/lowstate"
"""Topics."""
LOOPBACK_DOMAIN = 77
"""pronk's own; Unitree's robots use 0, unitree_mujoco 1."""
ROBOT_DOMAIN = 0
_MOST_DOMAIN = 232  # the ports of higher ones would exceed 65535
_QUEUE = 64  # messages kept between two looks; at 500 Hz an eighth of a second
_WRITE_NS = 1_000_000  # longest time that a reader who does not keep up may hold a writer up

_NAMED = """<CycloneDDS><Domain Id="any"><General>
<Interfaces><NetworkInterface name={}/></Interfaces></General></Domain></CycloneDDS>"""
# Loopback often has no multicast: query the ports of the first participants one by one.
_LOCAL = """<CycloneDDS><Domain Id="any"><General>
<Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General>
<Discovery><ParticipantIndex>auto</ParticipantIndex>
<MaxAutoParticipantIndex>30</MaxAutoParticipantIndex>
<Peers><Peer address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>"""

_domains: dict[int, tuple[DdsNetwork, Any]] = {}
"""Domains that this process has opened; the library holds one set-up for each."""

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


@dataclass(frozen=True, kw_only=True)
class DdsNetwork:
    """Which domain on which interface."""

    interface: str | None = None
    """Network interface by name, for instance `eth0`; None for loopback only."""
    domain: int | None = None
    """DDS domain; None for 0 where an interface is named, else pronk's own, 77."""

    def __post_init__(self) -> None:
        if self.domain is None:
            own = LOOPBACK_DOMAIN if self.interface is None else ROBOT_DOMAIN
            object.__setattr__(self, "domain", own)
        elif not 0 <= self.domain <= _MOST_DOMAIN:
            raise HardwareError(f"DDS domain {self.domain}; expected 0 to {_MOST_DOMAIN}.")
        elif self.interface is None and self.domain == ROBOT_DOMAIN:
            raise HardwareError(
                "DDS domain 0 is where real robots listen; name the network interface to the robot "
                f"as well (for instance eth0), or take another domain, such as {LOOPBACK_DOMAIN}."
            )

    @property
    def loopback(self) -> bool:
        """True where nothing can leave this computer."""
        return self.interface is None

    def __str__(self) -> str:
        return f"DDS domain {self.domain} on {self.interface or 'loopback'}"

    @property
    def configuration(self) -> str:
        """The set-up as Cyclone DDS reads it."""
        if self.interface is not None:
            return _NAMED.format(quoteattr(self.interface))
        return _LOCAL


@dataclass
class Message:
    """A sample that stays bytes: header and payload."""

    data: bytes
    sample_info: Any = field(default=None, repr=False)

    def serialize(self, **_: Any) -> bytes:
        """What goes on the wire."""
        return self.data

    @classmethod
    def deserialize(cls, data: bytes) -> Message:
        """What came from the wire."""
        return cls(data)


class Participant:
    """One member of a domain, with readers and writers of its own."""

    def __init__(self, network: DdsNetwork) -> None:
        """Join; refuse a missing interface, and a domain that this process uses elsewhere."""
        domain = network.domain
        assert domain is not None
        known = _domains.get(domain)
        if known is not None and known[0] != network:
            raise HardwareError(
                f"this process already uses {known[0]}; close it and start anew for {network}."
            )
        try:
            if known is None:
                _domains[domain] = (network, Domain(domain, network.configuration))
            self.entity = DomainParticipant(domain)
        except DDSException as error:
            _domains.pop(domain, None)
            raise HardwareError(
                f"cannot join {network}: {error.msg}; is there such an interface, is it up, and "
                "has it an address? (`ip addr` lists them)"
            ) from None

    def reader(self, topic: str, message: Any, *, raw: bool = False, own: bool = True) -> Any:
        """Make a reader of an IDL type; `raw` samples stay bytes, `own` are of this participant."""
        policies = [Policy.History.KeepLast(_QUEUE)]
        if not own:
            policies.append(Policy.IgnoreLocal.Participant)
        return DataReader(self.entity, self._topic(topic, message, raw), Qos(*policies))

    def writer(self, topic: str, message: Any, *, raw: bool = False) -> Any:
        """Make a writer, arguments as for `reader`. Fits every reader, and waits for none."""
        waits = Policy.Reliability.Reliable(_WRITE_NS)
        return DataWriter(self.entity, self._topic(topic, message, raw), Qos(waits))

    def _topic(self, name: str, message: Any, raw: bool) -> Any:
        topic = Topic(self.entity, name, message)
        if raw:  # the type's name and description stay, only Python sees bytes
            topic.data_type = Message
        return topic

    def wake_on(self, *readers: Any) -> Any:
        """Something whose `wait(nanoseconds)` ends when one of the readers has something."""
        waiting = WaitSet(self.entity)
        for reader in readers:
            anything = SampleState.Any | ViewState.Any | InstanceState.Any
            waiting.attach(ReadCondition(reader, anything))
        return waiting


def take(reader: Any, counts: Counter[str]) -> list[Any]:
    """The samples that have come, oldest first; what cannot be read is counted and dropped."""
    try:
        met = reader.take(_QUEUE)
    except Exception:  # the library's decoder, of bytes that are no such message
        counts["refused: unreadable"] += 1
        return []
    return [sample for sample in met if sample.sample_info.valid_data]


def write(writer: Any, data: bytes, counts: Counter[str]) -> None:
    """Write bytes; what the library would not take in time is counted and dropped."""
    try:
        writer.write(Message(data))
    except DDSException:
        counts["not written"] += 1


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
