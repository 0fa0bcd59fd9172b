"""DDS domains and interfaces, readers and writers.

A Go2 listens on domain 0. Nothing reaches a real network, or domain 0, without an interface that
the user named.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any
from xml.sax.saxutils import quoteattr

from pronk.errors import HardwareError

try:
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
except ImportError:
    raise HardwareError(
        "the DDS link needs the package cyclonedds, which is not installed; "
        "install it with: pip install 'pronk[hardware]'."
    ) from None

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
