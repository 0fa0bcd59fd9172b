"""Address of a robot: `lcm://eth0?layout=wtw`, `dds://eth0`, `sim://ground`, or a short name.

The scheme names a link: one of `BUILT_IN`, or an entry point of the group `pronk.links`. After `//`
follows the network interface to a real robot; without one nothing leaves this computer. A link is a
callable `(robot, *, interface=None, **common) -> Machine`, `common` as of `NetworkLink`; its other
keyword arguments are the options of its addresses.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint, entry_points
from types import NoneType
from typing import Any, get_type_hints
from urllib.parse import parse_qsl, quote, urlsplit

import msgspec

from pronk.errors import HardwareError
from pronk.plugins import load_entry_point
from pronk.robots.machine import Machine
from pronk.robots.robot import RobotSpec

SIM = "sim"
BUILT_IN = {
    SIM: "pronk.deploy.bench.paced:open_sim",
    "lcm": "pronk.deploy.links.lcm.link:LcmMachine",
    "dds": "pronk.deploy.links.dds.link:DdsMachine",
}
GROUP = "pronk.links"
_COMMON = ("robot", "interface", "clamp_operator", "release", "exclusive_s", "fresh")


def find_link(name: str) -> Callable[..., Machine]:
    """Import a link; HardwareError for an unknown name or a library that is not installed."""
    if target := BUILT_IN.get(name):
        return EntryPoint(name, target, GROUP).load()  # type: ignore[no-any-return]
    known = entry_points(group=GROUP)
    if name not in known.names:
        names = ", ".join((*BUILT_IN, *sorted(known.names)))
        raise HardwareError(f"no link {name!r}; the links are {names}.")
    return load_entry_point(known[name])  # type: ignore[no-any-return]


@dataclass(frozen=True, kw_only=True)
class Address:
    """Link to a robot and its options."""

    kind: str = SIM
    """Name of the link."""
    interface: str | None = None
    """Network interface to a real robot (`lo` for LCM on the robot itself), None for loopback; of
    `sim`, `bench` or `ground`."""
    options: Mapping[str, str | int] = field(default_factory=dict)
    """`layout` and `port` (lcm), `domain` (dds), `params` and `seed` (sim)."""

    @classmethod
    def parse(cls, text: str, interface: str | None = None, **options: str | int | None) -> Address:
        """Parse a URI or a short name; HardwareError for an unknown link or option.

        `interface` applies where the text names none; `options` other than None are added.
        """
        kind, found, query = text, "", ""
        if "://" in text:
            parts = urlsplit(text)
            kind, found, query = parts.scheme, parts.netloc, parts.query
        if found and interface not in (None, found):
            raise HardwareError(f"{text} names the interface {found}; leave out {interface}.")
        link = find_link(kind)
        hints = get_type_hints(link.__init__ if inspect.isclass(link) else link)
        known = {
            name: hints.get(name, str | NoneType)
            for name, parameter in inspect.signature(link).parameters.items()
            if parameter.kind is parameter.KEYWORD_ONLY and name not in _COMMON
        }
        merged = dict(parse_qsl(query)) | {k: v for k, v in options.items() if v is not None}
        for name, value in merged.items():
            if name not in known:
                raise HardwareError(
                    f"link {kind} has no {name}; its options are {', '.join(known) or 'none'}."
                )
            try:
                merged[name] = msgspec.convert(value, known[name], strict=False)
            except msgspec.ValidationError:
                raise HardwareError(
                    f"{name} of link {kind} is {value!r}; expected {known[name]}."
                ) from None
        return cls(kind=kind, interface=found or interface, options=merged)

    @property
    def local(self) -> bool:
        """True where nothing leaves this computer, so that no real robot can move."""
        return self.kind == SIM or self.interface is None

    def __str__(self) -> str:
        query = "&".join(f"{name}={quote(str(value))}" for name, value in self.options.items())
        return f"{self.kind}://{self.interface or ''}" + (f"?{query}" if query else "")

    def machine(self, robot: RobotSpec, **common: Any) -> Machine:
        """Make the machine, not yet connected; `common` are keyword arguments of `NetworkLink`."""
        return find_link(self.kind)(robot, interface=self.interface, **common, **self.options)
