"""Which wire leads to a robot, by name, and the machine at its end."""

from __future__ import annotations

from dataclasses import dataclass

from pronk.errors import HardwareError
from pronk.links.link_checks import Hand
from pronk.links.machine import Machine
from pronk.links.preflight import Freshness
from pronk.robots.robot import Robot

WIRES = ("lcm", "dds")


@dataclass(frozen=True, kw_only=True)
class Address:
    """Where a robot is reached. Without an interface nothing leaves this computer."""

    kind: str
    """One of `WIRES`."""
    interface: str | None = None
    """Network interface to a real robot (`lo` for LCM on the robot itself); None for loopback,
    where the virtual robot is."""
    layout: str | None = None
    """Of LCM's messages, `cheetah` or `wtw`; None for `cheetah`, and for DDS."""
    port: int | None = None
    """Of LCM; None for the virtual robot's on loopback, the robots' on an interface."""
    domain: int | None = None
    """Of DDS; None for the virtual robot's on loopback, the robots' on an interface."""

    def __post_init__(self) -> None:
        """Refuse what does not go together.

        Raises:
            HardwareError: An unknown wire, or what belongs to the other one.
        """
        if self.kind not in WIRES:
            raise HardwareError(f"link {self.kind!r}; the wires are {', '.join(WIRES)}.")
        if self.kind == "dds" and (self.port is not None or self.layout is not None):
            raise HardwareError("a port or a layout is LCM's; with the link dds give a domain.")
        if self.kind == "lcm" and self.domain is not None:
            raise HardwareError("a domain is DDS's; with the link lcm give a port.")

    @property
    def local(self) -> bool:
        """True where nothing leaves this computer, so that no real robot can move."""
        return self.interface is None

    def __str__(self) -> str:
        where = self.interface or "loopback"
        if self.kind == "lcm":
            number = "" if self.port is None else f", port {self.port}"
            return f"LCM, messages of {self.layout or 'cheetah'}, on {where}{number}"
        number = "" if self.domain is None else f", domain {self.domain}"
        return f"DDS on {where}{number}"

    def machine(
        self,
        robot: Robot,
        *,
        hand: Hand | None = None,
        release: bool = False,
        alone_s: float = 1.0,
        fresh: Freshness | None = None,
    ) -> Machine:
        """The machine, not yet connected.

        Args:
            robot: What shall answer.
            hand: Who fixes joints on a real bench; None if nobody.
            release: Make the robot's own controller let go of the joints first.
            alone_s: How long nobody else may have commanded before pronk does [s].
            fresh: How fresh states must be; None for what moving a robot takes.

        Raises:
            HardwareError: The wire's library is not installed, the address is impossible, or the
                robot does not fit behind its messages.
        """
        if self.kind == "lcm":
            from pronk.links.lcm.link import LcmMachine

            return LcmMachine(
                robot,
                layout=self.layout or "cheetah",
                port=self.port,
                interface=self.interface,
                hand=hand,
                release=release,
                alone_s=alone_s,
                fresh=fresh,
            )
        from pronk.links.dds.address import DdsNetwork
        from pronk.links.dds.link import DdsMachine

        return DdsMachine(
            robot,
            network=DdsNetwork(interface=self.interface, domain=self.domain),
            hand=hand,
            release=release,
            alone_s=alone_s,
            fresh=fresh,
        )
