"""Options that several commands share."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from pronk.errors import HardwareError, PronkError

if TYPE_CHECKING:
    from pronk.deploy.links.address import Address
    from pronk.identify.logs.joint_log import JointLog
    from pronk.robots.robot import RobotSpec

Layout = Literal["cheetah", "wtw"]
"""Messages on LCM: Cheetah-Software's, or walk-these-ways'."""
Base = Literal["bench", "ground"]
"""What the virtual robot's trunk is fixed to, or stands on."""


@dataclass(frozen=True, kw_only=True)
class LinkOptions:
    """The machine that a command moves."""

    link: str = "sim"
    """sim, the virtual robot in this program; lcm or dds, by wire; or a URI such as dds://eth0,
    lcm://eth0?layout=wtw, sim://ground."""
    interface: str | None = None
    """Network interface to a real robot; without it nothing leaves this computer."""
    layout: Layout | None = None
    """Messages on LCM; cheetah if left out."""
    port: int | None = None
    """UDP port of LCM."""
    domain: int | None = None
    """Domain of DDS."""
    release: Annotated[bool, tyro.conf.arg(name="disable-onboard-controller")] = False
    """Switch off the robot's own controller."""
    real_time: bool = True
    """Request real-time scheduling (by wire)."""
    sim_params: Path | None = None
    """Parameters of the virtual robot, instead of the shipped ones."""
    seed: int = 0
    """Of the virtual robot's noise."""
    yes: bool = False
    """No confirmation before real hardware moves."""

    def address(self, base: Base | None = None) -> Address:
        """The machine's address, with what belongs to its link; None as base for the link's own."""
        from pronk.deploy.links.address import SIM, Address

        options: dict[str, Any] = {"layout": self.layout, "port": self.port, "domain": self.domain}
        where = self.interface
        if self.link.partition(":")[0] == SIM:
            params = None if self.sim_params is None else str(self.sim_params)
            options |= {"seed": self.seed or None, "params": params}
            where = base or self.interface
        elif self.sim_params is not None:
            raise HardwareError(
                "--sim-params is of --link sim; give it to `pronk simulate` instead."
            )
        return Address.parse(self.link, where, **options)


@dataclass(frozen=True, kw_only=True)
class Reading:
    """How logs are read."""

    unit: str | None = None
    """Unit of all angles, rad or deg; required for CSV."""
    time_unit: str | None = None
    """Unit of the timestamps: s, ms, us or ns."""
    columns: tuple[str, ...] = ()
    """CSV: OURS=THEIRS, as in position.FR_knee=q3; repeat it."""
    joint_names: tuple[str, ...] = ()
    """THEIRS=OURS for joints of other names; repeat it."""
    joint_order: str | None = None
    """NAME,NAME,... of columns without joint names (PACE); default for the robot's order."""
    drop_duplicates: bool = False
    """Drop rows that repeat the one before in full."""
    scale: tuple[str, ...] = ()
    """JOINT=RADIANS per unit, for a joint that is not in radians; repeat it."""
    rate_hz: float | None = None
    """Rate that the log is expected to have; another one is an error."""
    log_format: Annotated[str | None, tyro.conf.arg(name="format")] = None
    """mcap, csv, sage, pace, npz or a plugin's; from the name if left out."""
    measured_topic: str | None = None
    """rosbag2: topic of the measured JointState; /joint_states if left out."""
    command_topic: str | None = None
    """rosbag2: topic of the commands."""
    command_field: str | None = None
    """rosbag2: field of the positions in a command message, as in points.0.positions."""
    reader_options: Annotated[tuple[str, ...], tyro.conf.arg(name="reader-option")] = ()
    """NAME=VALUE for a reader of another package; repeat it."""

    def read(self, paths: Sequence[Path], robot: RobotSpec | None) -> list[JointLog]:
        """Read every log that some paths stand for, on all cores."""
        from pronk.identify.logs.readers import read_logs

        options = vars(self) | {
            "format": self.log_format,
            "columns": _pairs("--columns", self.columns),
            "drop_duplicates": self.drop_duplicates or None,
            "joint_names": _pairs("--joint-names", self.joint_names),
            "scale": _pairs("--scale", self.scale, float),
            **_pairs("--reader-option", self.reader_options),
        }
        del options["log_format"], options["reader_options"]
        given = {name: value for name, value in options.items() if value not in (None, {})}
        return read_logs(paths, processes=os.cpu_count() or 1, robot=robot, **given)


def _pairs(option: str, entries: Sequence[str], kind: Callable[[str], Any] = str) -> dict[str, Any]:
    found = {}
    for entry in entries:
        name, _, value = entry.partition("=")
        try:
            if not (name and value):
                raise ValueError("expected NAME=VALUE")
            found[name] = kind(value)
        except ValueError as error:
            raise PronkError(f"{option} {entry!r}: {error}.") from None
    return found


def drive_gains(
    entries: Sequence[str], option: str = "--drive-gains"
) -> dict[str, tuple[float, float]] | Literal["default"] | None:
    """Gains of joints by NAME=STIFFNESS,DAMPING, or `default`; None where none was given."""
    if tuple(entries) == ("default",):
        return "default"
    return _pairs(option, entries, _gains) or None


def _gains(text: str) -> tuple[float, float]:
    words = text.split(",")
    if len(words) != 2 or not (0.0 < float(words[0]) < 1e6 and 0.0 <= float(words[1]) < 1e6):
        raise ValueError("expected NAME=STIFFNESS,DAMPING, the stiffness above 0, as in knee=25,.5")
    return float(words[0]), float(words[1])
