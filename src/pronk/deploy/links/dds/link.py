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
from pronk.deploy.links.link import RESPONSE_S, Encode, NetworkLink, Publish, port_or_domain
from pronk.errors import HardwareError
from pronk.robots.machine import damping_command
from pronk.robots.robot import RobotSpec

COMMANDS, STATES = "rt/lowcmd", "rt/lowstate"  # topics
LOOPBACK_DOMAIN = 77  # pronk's own; Unitree's robots use 0, unitree_mujoco 1
ROBOT_DOMAIN = 0
_DOMAINS = range(233)  # the ports of higher ones would exceed 65535
_QUEUE = 64  # messages kept between two reads; at 500 Hz an eighth of a second
_WRITE_NS = 1_000_000  # longest time that a slow reader may hold a writer up

_NAMED = """<CycloneDDS><Domain Id="any"><General>
<Interfaces><NetworkInterface name={}/></Interfaces></General></Domain></CycloneDDS>"""
# Loopback often has no multicast: query the ports of the first participants one by one.
_LOCAL = """<CycloneDDS><Domain Id="any"><General>
<Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General>
<Discovery><ParticipantIndex>auto</ParticipantIndex>
<MaxAutoParticipantIndex>30</MaxAutoParticipantIndex>
<Peers><Peer address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>"""

# Domains that this process has opened; the library holds one configuration for each.
_domains: dict[int, tuple[DdsNetwork, Any]] = {}

SWITCHER, CHECK_MODE, SELECT_MODE, RELEASE_MODE = "motion_switcher", 1001, 1002, 1003
OLDER, SERVICE_SWITCH = "robot_state", 1001
BENCH, CLAMP = "pronk_bench", 1  # of the virtual robot alone: requests for clamps
DONE, UNKNOWN_API, BAD_PARAMETER = 0, 3203, 3204  # codes of a response, as in unitree_sdk2

_POLL_S = 0.002
_RELEASE_TRIES, _RELEASE_PAUSE_S = 10, 0.2
_LONGEST_BURST_S, _LONGEST_PAUSE_S = 0.1, 0.05


@dataclass(frozen=True, kw_only=True)
class DdsNetwork:
    """A domain on an interface."""

    interface: str | None = None  # by name, for instance `eth0`; None for loopback only
    domain: int | None = None  # None for 0 where an interface is named, else pronk's own, 77

    def __post_init__(self) -> None:
        domain = port_or_domain(
            "DDS domain", self.domain, self.interface, ROBOT_DOMAIN, LOOPBACK_DOMAIN, _DOMAINS
        )
        object.__setattr__(self, "domain", domain)

    def __str__(self) -> str:
        return f"DDS domain {self.domain} on {self.interface or 'loopback'}"


class RawSample:
    """A sample that stays bytes, header and payload."""

    def __init__(self, data: bytes) -> None:
        self.data = data

    def serialize(self, **_: Any) -> bytes:
        """The bytes for the wire."""
        return self.data

    @classmethod
    def deserialize(cls, data: bytes) -> RawSample:
        """A sample of the bytes from the wire."""
        return cls(data)


class Participant:
    """One member of a domain. Samples of `LowCmd` and `LowState` stay bytes (`RawSample`)."""

    def __init__(self, network: DdsNetwork) -> None:
        """Join; HardwareError for a missing interface, or a domain in use with another."""
        domain, interface = network.domain, network.interface
        assert domain is not None
        known = _domains.get(domain)
        if known is not None and known[0] != network:
            raise HardwareError(
                f"this process already uses {known[0]}; close it and start anew for {network}."
            )
        try:
            if known is None:
                configuration = _NAMED.format(quoteattr(interface)) if interface else _LOCAL
                _domains[domain] = (network, Domain(domain, configuration))
            self.entity = DomainParticipant(domain)
        except DDSException as error:
            _domains.pop(domain, None)
            raise HardwareError(
                f"cannot join {network}: {error.msg}; is there such an interface, is it up, and "
                "has it an address? (`ip addr` lists them)"
            ) from None

    def reader(self, topic: str, message: Any, *, own: bool = True) -> Any:
        """Make a reader of an IDL type; `own` samples are of this participant."""
        policies = [Policy.History.KeepLast(_QUEUE)]
        if not own:
            policies.append(Policy.IgnoreLocal.Participant)
        return DataReader(self.entity, self._topic(topic, message), Qos(*policies))

    def writer(self, topic: str, message: Any) -> Any:
        """Make a writer, which fits every reader and waits for none."""
        waits = Policy.Reliability.Reliable(_WRITE_NS)
        return DataWriter(self.entity, self._topic(topic, message), Qos(waits))

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
        """Call a function by its number, repeatedly while there is no response.

        None without one within `RESPONSE_S`; HardwareError for a code other than 0, or no object.
        """
        identity = messages.RequestIdentity(id=time.monotonic_ns(), api_id=api_id)
        header = messages.RequestHeader(
            identity=identity,
            lease=messages.RequestLease(id=0),
            policy=messages.RequestPolicy(priority=0, noreply=False),
        )
        request = messages.Request(header=header, parameter=json.dumps(parameter), binary=[])
        end = time.monotonic() + RESPONSE_S
        again = -1.0
        while time.monotonic() < end:
            if time.monotonic() >= again and self._requests.get_matched_subscriptions():
                self._requests.write(request)
                again = time.monotonic() + RESPONSE_S / 4
            for response in take_samples(self._responses, Counter()):
                if response.header.identity == identity:
                    return self._data(api_id, response)
            time.sleep(_POLL_S)
        return None

    def _data(self, api_id: int, response: Any) -> dict[str, Any]:
        code, data = response.header.status.code, None
        got = f"code {code}"
        if code == DONE:
            got = f"{response.data[:60]!r}"
            with contextlib.suppress(ValueError):
                data = json.loads(response.data or "{}") or {}
            if isinstance(data, dict):
                return data
        raise HardwareError(
            f"the robot's service {self._service} returned {got} for function {api_id}, expected "
            "code 0 and a JSON object; switch by the robot's own remote or app instead."
        )


def check_own_controller(participant: Participant, *, release: bool) -> None:
    """Check that none of the robot's own controllers holds the joints; `release` one that does."""
    switcher = ServiceClient(participant, SWITCHER)
    response = switcher.call(CHECK_MODE, {})
    if response is None:
        # Older firmware ends its sport mode by another service.
        sport = {"name": "sport_mode", "switch": 0}
        if release and ServiceClient(participant, OLDER).call(SERVICE_SWITCH, sport) is not None:
            return
        raise HardwareError(
            f"the robot did not respond on its service {SWITCHER} within {RESPONSE_S:g} s, so it "
            "is not known whether its own controller is off; check the network, and its firmware."
        )
    tries = _RELEASE_TRIES if release else 0
    while (name := (response or {}).get("name", "")) and tries:
        tries -= 1
        switcher.call(RELEASE_MODE, {})
        time.sleep(_RELEASE_PAUSE_S)
        response = switcher.call(CHECK_MODE, {})
    if name:
        raise HardwareError(
            f"the robot's own controller {name!r} was not switched off after {_RELEASE_TRIES} "
            "requests; switch it off by the robot's app."
            if release
            else f"the robot's own controller {name!r} holds the joints; lay the robot down or "
            "hang it up, and have the controller released (--disable-onboard-controller)."
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
        **common: Any,
    ) -> None:
        """Describe the link on a `DdsNetwork`; `common` is as of `NetworkLink`."""
        super().__init__(robot, **common)
        self._joints = joint_map(robot)
        self._sinking = damping_command(len(robot.joints), self._joints.sink_damping)
        self._network = DdsNetwork(interface=interface, domain=domain)
        self._command_topic, self._address = COMMANDS, f"{STATES} in {self._network}"

    def open_damper(self) -> Callable[[], None]:
        """Join the domain by itself, and return what writes damping."""
        out = Participant(self._network).writer(COMMANDS, messages.LowCmd)
        data = encode_dds_command(self._joints, self._sinking)
        return lambda: write_bytes(out, data, self.counts)

    def _open(self) -> tuple[Encode, Publish]:
        self._decoder = DdsStateDecoder(self._joints, self.counts)
        self._senders: set[int] = set()
        self._participant = own = Participant(self._network)
        self._states_in = own.reader(STATES, messages.LowState)
        self._others = own.reader(COMMANDS, messages.LowCmd, own=False)
        out = own.writer(COMMANDS, messages.LowCmd)
        self._bench = ServiceClient(own, BENCH)
        anything = core.SampleState.Any | core.ViewState.Any | core.InstanceState.Any
        self._wake = core.WaitSet(own.entity)
        for reader in (self._states_in, self._others):
            self._wake.attach(core.ReadCondition(reader, anything))
        encode = partial(encode_dds_command, self._joints)
        return encode, lambda data: write_bytes(out, data, self.counts)

    def _shut(self) -> None:
        del self._wake, self._states_in, self._others, self._bench, self._participant

    def _prepare(self) -> None:
        self.virtual = self._decoder.virtual
        if self._joints.virtual_only and not self.virtual:
            raise HardwareError(
                f"the robot in {self._network} is not pronk's virtual robot, and no real "
                f"{self.robot} sends Unitree's messages; give the robot's name."
            )
        check_own_controller(self._participant, release=self._release)

    @property
    def sources(self) -> int:
        """Senders of states."""
        return len(self._senders)

    def _hold(self, joints: tuple[str, ...]) -> bool:
        return self._bench.call(CLAMP, {"joints": list(joints)}) is not None

    def _receive(self) -> None:
        self._wake.wait(int(_LONGEST_PAUSE_S * 1e9))
        arrived = time.monotonic()
        if take_samples(self._others, self.counts):
            self.counts["foreign"] += 1
            if self._writer is not None and self._writer.wrote:
                self._writer.damp()
        samples = take_samples(self._states_in, self.counts)
        for sample in samples:
            # Samples that arrived together are distinguished by when they were sent.
            last, this = (each.sample_info.source_timestamp for each in (samples[-1], sample))
            stamp = arrived - min(max((last - this) * 1e-9, 0.0), _LONGEST_BURST_S)
            self._senders.add(sample.sample_info.publication_handle)
            self._take(self._decoder.take, sample.data, stamp)
