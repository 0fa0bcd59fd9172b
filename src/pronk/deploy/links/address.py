"""Address of a robot: `lcm://eth0?layout=wtw`, `dds://eth0`, `sim://ground`, or a short name.

The scheme names a link: one of `BUILT_IN`, or an entry point of the group `pronk.links`. After `//`
follows the network interface to a real robot; without one nothing leaves this computer. A link is a
callable `(robot, *, interface=None, settings=None) -> Machine`, with `LinkSettings`; its other
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

from pronk.deploy.links.link import LinkSettings
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
ENTRY_POINT_GROUP = "pronk.links"
_COMMON_PARAMETERS = ("robot", "interface", "settings")
"""Parameters of every link, which are no options of an address."""


def find_link(name: str) -> Callable[..., Machine]:
    """Import a link; HardwareError for an unknown name or a library that is not installed."""
    if name in BUILT_IN:
        entry_point = EntryPoint(name, BUILT_IN[name], ENTRY_POINT_GROUP)
        try:
            return entry_point.load()  # type: ignore[no-any-return]
        except ImportError as error:
            raise HardwareError(
                f"the link {name} cannot be loaded ({error}); install what it needs with "
                "`pip install 'pronk[hardware]'`."
            ) from None
    installed = entry_points(group=ENTRY_POINT_GROUP)
    if name not in installed.names:
        names = ", ".join((*BUILT_IN, *sorted(installed.names)))
        raise HardwareError(f"no link {name!r}; the links are {names}.")
    return load_entry_point(installed[name])  # type: ignore[no-any-return]


@dataclass(frozen=True, kw_only=True)
class Address:
    """Link to a robot and its options."""

    scheme: str = SIM
    """Name of the link."""
    interface: str | None = None
    """Network interface to a real robot (`lo` for LCM on the robot itself), None for loopback; of
    `sim`, `bench` or `ground`."""
    options: Mapping[str, str | int] = field(default_factory=dict)
    """`layout` and `port` (lcm), `domain` (dds), `params` and `seed` (sim)."""

    @classmethod
    def parse(cls, text: str, interface: str | None = None, **options: str | int | None) -> Address:
        """Parse a URI or a short name.

        Args:
            text: The URI or the name of a link.
            interface: Network interface, where the text names none.
            options: Options of the link besides those of the text; those that are None are left
                out.

        Raises:
            HardwareError: The text is no URI, the link or an option is unknown, or an option has
                another type or is given twice.
        """
        scheme = text
        named_interface = ""
        query = ""
        if "://" in text:
            scheme, named_interface, query = _split(text)
        if named_interface and interface not in (None, named_interface):
            raise HardwareError(
                f"{text} names the interface {named_interface}; leave out {interface}."
            )
        types = _option_types(find_link(scheme))
        texts: dict[str, str | int] = {}
        for name, value in [*parse_qsl(query, keep_blank_values=True), *options.items()]:
            if value is None:
                continue
            if str(texts.get(name, value)) != str(value):
                raise HardwareError(
                    f"{name} of {text} is both {texts[name]} and {value}; give one of them."
                )
            texts[name] = value
        converted = {}
        for name, value in texts.items():
            if name not in types:
                raise HardwareError(
                    f"link {scheme} has no {name}; its options are {', '.join(types) or 'none'}."
                )
            try:
                converted[name] = msgspec.convert(value, types[name], strict=False)
            except msgspec.ValidationError:
                raise HardwareError(
                    f"{name} of link {scheme} is {value!r}; expected {types[name]}."
                ) from None
        return cls(scheme=scheme, interface=named_interface or interface, options=converted)

    @property
    def local(self) -> bool:
        """True where nothing leaves this computer, so that no real robot can move."""
        return self.scheme == SIM or self.interface is None

    def __str__(self) -> str:
        """The URI of this address."""
        uri = f"{self.scheme}://{self.interface or ''}"
        if self.options:
            query = "&".join(f"{name}={quote(str(value))}" for name, value in self.options.items())
            uri += f"?{query}"
        return uri

    def machine(self, robot: RobotSpec, settings: LinkSettings | None = None) -> Machine:
        """Make the machine, not yet connected, with the usual settings if there are none."""
        link = find_link(self.scheme)
        return link(robot, interface=self.interface, settings=settings, **self.options)


def _split(uri: str) -> tuple[str, str, str]:
    """Return scheme, interface and query of a URI; HardwareError for one with other parts.

    A part that was passed over, as the number in `dds://eth0/5`, would choose another robot.
    """
    example = "expected one such as dds://eth0 or lcm://eth0?layout=wtw&port=7668"
    try:
        parts = urlsplit(uri)
    except ValueError as error:
        raise HardwareError(f"{uri!r} is no address of a robot ({error}); {example}.") from None
    if parts.path.strip("/") or parts.fragment:
        raise HardwareError(
            f"{uri!r} has {(parts.path + parts.fragment)!r} behind the interface, which an address "
            f"does not have; {example}."
        )
    return parts.scheme, parts.netloc, parts.query


def _option_types(link: Callable[..., Machine]) -> dict[str, Any]:
    """Types of a link's options by name: of its keyword-only parameters but the common ones."""
    hints = get_type_hints(link.__init__ if inspect.isclass(link) else link)
    types = {}
    for name, parameter in inspect.signature(link).parameters.items():
        if parameter.kind is parameter.KEYWORD_ONLY and name not in _COMMON_PARAMETERS:
            types[name] = hints.get(name, str | NoneType)
    return types
