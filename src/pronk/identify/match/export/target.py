"""ExportTarget: what reads an exported text, and how the text names the parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from pronk.identify.match.export.actuators import Actuator
from pronk.identify.simulators.profiles import Profile
from pronk.robots.robot import RobotSpec

Writer = Callable[["ExportTarget", Sequence[Actuator], Profile, RobotSpec], str]
"""Writes the text of a target below its header: target, actuators, profile and robot to text."""


@dataclass(frozen=True, kw_only=True)
class ExportTarget:
    """What reads an exported text."""

    profile: str = ""
    """Profile that gains must hold for, up to frameworks of the same law and step; empty for
    any."""
    write: Writer
    """Function that writes the text below the header."""
    settings: str
    """What must be set beside the text. {timestep}, {decimation}, {period}, {iterations} and
    {substeps} are filled in."""
    arguments: Mapping[str, str] = field(default_factory=dict)
    """Names of arguments in the text, to the names of `Actuator.quantities`."""
    config_class: str = ""
    """Class of the actuator's configuration."""
    delay_arguments: tuple[str, ...] = ()
    """Arguments that take a delay in physics steps."""
    without_delay: str = "delay the actions in the environment"
    """What to do about a delay that the target cannot express."""
    stribeck: bool = False
    """True if friction can fall with speed."""
    xml: bool = False
    """True if the text is XML of MuJoCo, which also takes delays in seconds."""


def number_text(value: float) -> str:
    """Write a number with seven significant digits, as Python does."""
    return repr(float(f"{value:.7g}"))


def argument_text(actuator: Actuator, arguments: Mapping[str, str], form: str) -> str:
    """Write the arguments of an actuator one after another.

    Args:
        actuator: The actuator.
        arguments: Names of arguments to names of `Actuator.quantities`.
        form: Format of one argument, with a place for its name and one for its number.
    """
    quantities = actuator.quantities()
    text = ""
    for argument, quantity in arguments.items():
        text += form.format(argument, number_text(quantities[quantity]))
    return text


def no_match_text(actuator: Actuator, begin: str = "") -> str:
    """Return the mark of an actuator with joints that are no match; empty for all others.

    Args:
        actuator: The actuator.
        begin: Text before the mark.
    """
    if not actuator.no_match:
        return ""
    return f"{begin}NO MATCH: {', '.join(actuator.no_match)}"


def delay_steps(actuator: Actuator, profile: Profile) -> int:
    """Return the delay of an actuator in physics steps of a framework, to the nearest."""
    return round(actuator.delay_s / profile.timestep_s)
