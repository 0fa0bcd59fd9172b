"""Where LCM messages go: nowhere but this computer, unless an interface is named.

LCM is UDP multicast. With a time-to-live of 0 a packet never leaves the host; a private port keeps
it from other users of LCM here. LCM itself cannot choose an interface: the system's routes do
(a missing one is the commonest first failure on the Mini Cheetah, Cheetah-Software issue 8), so
the route is looked up and must lead out of the interface that was named.
"""

from __future__ import annotations

import ipaddress
from pathlib import Path
from typing import Any

from pronk.errors import HardwareError

GROUP = "239.255.76.67"
"""LCM's multicast group, that of every robot too."""
ROBOT_PORT = 7667
"""LCM's port, that of every robot too."""
VIRTUAL_PORT = 7768
"""The virtual robot's: private, so that nothing here ever meets a real one."""
_ROUTES = Path("/proc/net/route")


def url_of(*, port: int | None = None, interface: str | None = None) -> str:
    """The address of a link.

    Args:
        port: UDP port; `VIRTUAL_PORT` on loopback and `ROBOT_PORT` on an interface if None.
        interface: Network interface of the real robot, by the system's name; `lo` if pronk runs
            on the robot itself. None stays on this computer.

    Raises:
        HardwareError: The port is impossible, or multicast does not leave by that interface.
    """
    number = port if port is not None else (ROBOT_PORT if interface else VIRTUAL_PORT)
    if not 1024 <= number <= 65535:
        raise HardwareError(
            f"LCM port {number}; expected 1024 to 65535, for instance {VIRTUAL_PORT}."
        )
    if interface is None and number == ROBOT_PORT:
        raise HardwareError(
            f"LCM port {ROBOT_PORT} is the real robots'; take another, as {VIRTUAL_PORT}, "
            "or name the robot's network interface (lo on the robot itself)."
        )
    if interface in (None, "lo"):
        return f"udpm://{GROUP}:{number}?ttl=0"
    way = multicast_interface(_ROUTES.read_text(encoding="ascii")) if _ROUTES.exists() else None
    if way != interface:
        raise HardwareError(
            f"LCM's multicast leaves by {way or 'no interface'}, expected {interface}; set the "
            f"route: `sudo ip route add {GROUP} dev {interface}`."
        )
    # One hop: the robot's own cable, and no router.
    return f"udpm://{GROUP}:{number}?ttl=1"


def multicast_interface(table: str) -> str | None:
    """The interface by which LCM's packets leave, or None.

    Args:
        table: Routes as in /proc/net/route: hexadecimal, little-endian addresses.
    """
    group = int(ipaddress.IPv4Address(GROUP))
    best: tuple[int, int, str] | None = None
    for line in table.splitlines()[1:]:
        words = line.split()
        if len(words) < 8 or not int(words[3], 16) & 1:
            continue
        target, mask = (int.from_bytes(bytes.fromhex(words[k])[::-1], "big") for k in (1, 7))
        if group & mask == target:
            # The longest mask wins, then the smallest metric.
            found = (mask, -int(words[6]), words[0])
            best = max(best, found) if best else found
    return best[2] if best else None


def open_lcm(url: str) -> Any:
    """Open an LCM handle (`lcm.LCM`), which belongs to one thread.

    Raises:
        HardwareError: The package `lcm` is not installed, or the address cannot be opened.
    """
    try:
        import lcm
    except ImportError:
        raise HardwareError(
            'the package lcm is not installed; install it with `pip install "pronk[hardware]"`.'
        ) from None
    try:
        return lcm.LCM(url)
    except (RuntimeError, OSError) as error:
        raise HardwareError(
            f"LCM cannot open {url} ({error}); without a network, multicast needs a route: "
            f"`sudo ip route add {GROUP} dev lo`."
        ) from None
