"""Draw the figures of the documentation into docs/figures.

    python scripts/docs_figures.py            # draw all
    python scripts/docs_figures.py --check    # compare what is there with what would be drawn

`--check` compares the numbers in the files, to half a pixel, so that another build of a library
that rounds differently does not fail.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pronk.identify.simulators.actuator_network import SampleGains
from pronk.jump.study.study_results import load_study_results
from pronk.report import style
from pronk.report.study_figures import draw_robots, draw_tolerance
from pronk.report.style import key

ROOT = Path(__file__).resolve().parents[1]
OUT = ROOT / "docs" / "figures"
Response = NDArray[np.complex128]
INERTIA = 0.0093
"""Inertia of the joint of the figures, armature included [kg m^2]: examples/pendulum."""
STIFFNESS = 17.0
"""Stiffness of the joint of the figures [N m/rad]."""
DAMPING = 0.4
"""Damping of the joint of the figures [N m s/rad]."""
TIMESTEP_S = 0.005
"""Step of the training simulators [s]."""
HZ = np.geomspace(0.5, 15.0, 200)
OMEGA = 2.0 * np.pi * HZ
LAWS = (
    ("the drive itself", "continuous", style.MEASURED),
    ("mjlab, Isaac Lab explicit (law E)", "E", style.NAIVE),
    ("MuJoCo implicitfast, Genesis (law IF)", "IF", style.ZERO_ARMATURE),
    ("Isaac Lab implicit (law I4)", "I4", style.MATCHED),
    ("Drake (law I1)", "I1", style.PAPER),
)
"""Label, law and colour of each curve of the figure of drive laws."""
ARMS = (
    "nominal gains",
    "nominal gains,\nranges of 30 %",
    "matched to\nthis robot",
    "matched to the\nother robot",
)
"""Gains that the policies of the study were trained with."""
STUDY = {
    "The virtual robot": ((100, 80, 82), (80, 94, 100), (100, 96, 97), (100, 100, 99)),
    "A virtual robot with weaker drives": (
        (93, 71, 83),
        (98, 90, 80),
        (89, 99, 89),
        (67, 77, 70),
    ),
}
"""Landed jumps of 100 by robot, gains (`ARMS`) and training seed (11, 12, 13), measured at commit
989edfb; docs/results.md says how."""

GO1_NETWORK = SampleGains(
    ages=(0, 1, 2),
    error_gains=(-0.121, 18.929, 0.142),
    velocity_gains=(0.9036, -0.0085, -0.0078),
)
"""The actuator network of a Go1 of walk-these-ways (unitree_go1.pt, MIT) near rest, as `pronk probe
unitree_go1.pt --history 0.02 --step 0.005 --json` gives it."""
GO1_DRIVE = (20.0, 0.5)
"""Stiffness [N m/rad] and damping [N m s/rad] on the drives that it was trained on."""
GO1_INERTIA = 0.02
"""Inertia of a joint of the figure of networks, rotor included [kg m^2]."""


def continuous(stiffness: float, damping: float, inertia: float = INERTIA) -> Response:
    """Return the response of the second-order joint, shape (f,)."""
    s = 1j * OMEGA
    return np.asarray(stiffness / (inertia * s**2 + damping * s + stiffness))


def simulated(law: str, stiffness: float, damping: float) -> Response:
    """Return the response of the joint in a simulator of some drive law at 5 ms, shape (f,)."""
    substeps = int(law[1:]) if law[1:].isdigit() else 1
    step = TIMESTEP_S / substeps
    inertia = INERTIA
    if law == "IF":
        inertia += step * damping
    position_gain = stiffness
    speed_gain = damping
    if law.startswith("I") and law != "IF":
        inertia += step * damping + step**2 * stiffness
        speed_gain = damping + step * stiffness
    # One step of (position, speed) for a held command u: speed first, then position.
    speed_row = np.array([-step * position_gain / inertia, 1.0 - step * speed_gain / inertia])
    speed_input = step * stiffness / inertia
    transition = np.array([[1.0, 0.0], [0.0, 0.0]])
    transition[0] += step * speed_row
    transition[1] = speed_row
    command = np.array([step * speed_input, speed_input])
    whole = np.eye(2)
    whole_command = np.zeros(2)
    for _ in range(substeps):
        whole_command = transition @ whole_command + command
        whole = transition @ whole
    z = np.exp(1j * OMEGA * TIMESTEP_S)
    response = np.empty(len(z), dtype=complex)
    for index, value in enumerate(z):
        response[index] = np.linalg.solve(value * np.eye(2) - whole, whole_command)[0]
    half_turn = OMEGA * TIMESTEP_S / 2.0
    hold = np.exp(-1j * half_turn) * np.sinc(half_turn / np.pi)
    return response / hold


def decibels(response: Response) -> NDArray[np.float64]:
    """Return the gain of a response [dB]."""
    return np.asarray(20.0 * np.log10(np.abs(response)))


def degrees(response: Response) -> NDArray[np.float64]:
    """Return the phase of a response [degrees]."""
    return np.asarray(np.degrees(np.unwrap(np.angle(response))))


def drive_laws() -> Figure:
    """Draw the same gains in five drive laws, and what each differs from the drive by."""
    with style.drawing(1, 2, height=3.6, sharex=True) as (figure, axes):
        gain, difference = axes[0]
        keys = []
        true_db = decibels(continuous(STIFFNESS, DAMPING))
        for label, law, colour in LAWS:
            if law == "continuous":
                response_db = true_db
            else:
                response_db = decibels(simulated(law, STIFFNESS, DAMPING))
            width = 3.0 if law == "continuous" else 1.5
            gain.plot(HZ, response_db, color=colour, linewidth=width)
            difference.plot(HZ, response_db - true_db, color=colour, linewidth=width)
            keys.append(key(label, color=colour, linewidth=width))
        gain.set_title("17 N m/rad and 0.4 N m s/rad in five places")
        gain.set_ylabel("gain [dB]")
        difference.set_title("Difference from the drive")
        difference.set_ylabel("difference [dB]")
        for panel in (gain, difference):
            style.frequency_axis(panel, HZ[0], HZ[-1])
            panel.set_xlabel("frequency [Hz]")
        style.legend(figure, keys, columns=3)
    return figure


def stiffness_and_damping() -> Figure:
    """Draw what stiffness and damping do to a Bode plot."""
    stiffnesses = (10.0, 17.0, 30.0)
    dampings = (0.2, 0.4, 0.8)
    colours = (style.MATCHED, style.MEASURED, style.NAIVE)
    with style.drawing(2, 2, height=5.0, sharex=True, sharey="row") as (figure, axes):
        for column, (name, unit, values) in enumerate(
            (
                ("Stiffness", "N m/rad", stiffnesses),
                ("Damping", "N m s/rad", dampings),
            )
        ):
            gain = axes[0, column]
            phase = axes[1, column]
            for value, colour in zip(values, colours, strict=True):
                if column == 0:
                    response = continuous(value, DAMPING)
                else:
                    response = continuous(STIFFNESS, value)
                gain.plot(HZ, decibels(response), color=colour, label=f"{value:g} {unit}")
                phase.plot(HZ, degrees(response), color=colour)
            gain.set_title(name)
            gain.legend(loc="lower left")
            phase.set_xlabel("frequency [Hz]")
            style.frequency_axis(phase, HZ[0], HZ[-1])
        axes[0, 0].set_ylabel("gain [dB]")
        axes[1, 0].set_ylabel("phase [degrees]")
    return figure


FRICTION_MODEL = """
<mujoco>
  <option timestep="0.0005" integrator="implicitfast" gravity="0 0 0"/>
  <worldbody>
    <body>
      <joint name="joint" axis="0 1 0" frictionloss="0.3" armature="0.0063"/>
      <inertial pos="0 0 0" mass="0.2" diaginertia="0.003 0.003 0.003"/>
    </body>
  </worldbody>
  <actuator><position joint="joint" kp="17" kv="0.4"/></actuator>
</mujoco>
"""
"""The joint of the figures with 0.3 N m of dry friction."""


def sine_gain(hz: float, amplitude: float) -> float:
    """Return the gain of the joint with friction for a sine, once it has settled [dB]."""
    model = mujoco.MjModel.from_xml_string(FRICTION_MODEL)
    data = mujoco.MjData(model)
    period = 1.0 / hz
    settle_s = max(2.0 * period, 0.5)
    cross = 0.0 + 0.0j
    while data.time < settle_s + 2.0 * period:
        data.ctrl[0] = amplitude * np.sin(2.0 * np.pi * hz * data.time)
        if data.time >= settle_s:
            cross += data.qpos[0] * np.exp(-2j * np.pi * hz * data.time) * model.opt.timestep
        mujoco.mj_step(model, data)
    return float(20.0 * np.log10(abs(cross) / period / amplitude))


def dry_friction() -> Figure:
    """Draw how the response of a joint with dry friction depends on the amplitude."""
    hz = np.geomspace(0.5, 12.0, 14)
    colours = (style.NAIVE, style.PAPER, style.MATCHED)
    with style.drawing(1, 1, height=3.3) as (figure, axes):
        panel = axes[0, 0]
        for amplitude, colour in zip((0.03, 0.1, 0.3), colours, strict=True):
            gains = []
            for frequency in hz:
                gains.append(sine_gain(frequency, amplitude))
            panel.plot(hz, gains, marker="o", color=colour, label=f"sine of {amplitude:g} rad")
        panel.plot(
            HZ,
            decibels(continuous(STIFFNESS, DAMPING)),
            color=style.MEASURED,
            label="without dry friction",
        )
        panel.set_title("A joint with 0.3 N m of dry friction, 17 N m/rad and 0.4 N m s/rad")
        panel.set_xlabel("frequency [Hz]")
        panel.set_ylabel("gain [dB]")
        style.frequency_axis(panel, 0.5, 12.0)
        panel.legend(loc="lower left")
    return figure


def delays() -> Figure:
    """Draw the phase of the joint with and without a delay of its commands."""
    with style.drawing(1, 2, height=3.3, sharex=True) as (figure, axes):
        gain, phase = axes[0]
        response = continuous(STIFFNESS, DAMPING)
        for delay_ms, colour in ((0.0, style.MEASURED), (5.0, style.MATCHED), (10.0, style.NAIVE)):
            delayed = response * np.exp(-1j * OMEGA * delay_ms / 1000.0)
            width = 4.0 - 0.3 * delay_ms
            gain.plot(HZ, decibels(delayed), color=colour, linewidth=width)
            phase.plot(HZ, degrees(delayed), color=colour, label=f"delay of {delay_ms:g} ms")
        gain.set_title("The gain does not show a delay")
        gain.set_ylabel("gain [dB]")
        phase.set_title("The phase does")
        phase.set_ylabel("phase [degrees]")
        phase.legend(loc="lower left")
        for panel in (gain, phase):
            style.frequency_axis(panel, HZ[0], HZ[-1])
            panel.set_xlabel("frequency [Hz]")
    return figure


def actuator_network() -> Figure:
    """Draw the damping of an actuator network by the time between its samples, and the joint."""
    stiffness, damping = GO1_DRIVE
    with style.drawing(1, 2, height=3.6) as (figure, axes):
        by_step, gain = axes[0]
        steps_ms = np.linspace(0.5, 25.0, 50)
        dampings = []
        for step_ms in steps_ms:
            dampings.append(GO1_NETWORK.at_step(step_ms / 1000.0).damping)
        by_step.plot(steps_ms, dampings, color=style.MEASURED, linewidth=1.5)
        drive = continuous(stiffness, damping, GO1_INERTIA)
        gain.plot(HZ, decibels(drive), color=style.MEASURED_WIDE, linewidth=3.0)
        keys = [key("the drive, 20 N m/rad and 0.5 N m s/rad", color=style.MEASURED_WIDE)]
        for step_ms, role, colour in (
            (20.0, "as trained", style.MATCHED),
            (5.0, "as used", style.NAIVE),
        ):
            step_s = step_ms / 1000.0
            by_step.plot([step_ms], [GO1_NETWORK.at_step(step_s).damping], color=colour, marker="o")
            response = GO1_NETWORK.response(HZ, GO1_INERTIA, step_s)
            gain.plot(HZ, decibels(response), color=colour, linewidth=1.5)
            keys.append(key(f"the network at {step_ms:g} ms, {role}", color=colour))
        by_step.set_ylim(0.0, 1.0)
        by_step.set_title("Damping of the network near rest")
        by_step.set_xlabel("time between two samples [ms]")
        by_step.set_ylabel("damping [N m s/rad]")
        gain.set_title("A joint of 0.02 kg m²")
        gain.set_ylabel("gain [dB]")
        gain.set_xlabel("frequency [Hz]")
        style.frequency_axis(gain, HZ[0], HZ[-1])
        style.legend(figure, keys, columns=3)
    return figure


def study() -> Figure:
    """Draw landed jumps by the gains that a policy was trained with, on two robots."""
    colours = (style.NAIVE, style.PAPER, style.MATCHED, style.ZERO_ARMATURE)
    with style.drawing(1, 2, height=3.3, sharey=True) as (figure, axes):
        for panel, (robot, arms) in zip(axes[0], STUDY.items(), strict=True):
            for place, (landed, colour) in enumerate(zip(arms, colours, strict=True)):
                panel.scatter(np.full(len(landed), place), landed, s=45, color=colour, zorder=3)
                mean = float(np.mean(landed))
                panel.plot([place - 0.3, place + 0.3], [mean, mean], color=colour, linewidth=2.0)
            panel.set_xticks(range(len(ARMS)), ARMS, fontsize=8)
            panel.set_xlim(-0.5, len(ARMS) - 0.5)
            panel.set_ylim(0.0, 105.0)
            panel.set_title(robot)
        axes[0, 0].set_ylabel("jumps landed of 100, each of three policies")
    return figure


MATCH_WORTH = ROOT / "examples" / "studies" / "match_worth" / "results.json"
"""Results of the study of what a match is worth; there once it has been run."""


def match_worth() -> Figure:
    """Draw the first outcome of the study, by arm and robot."""
    results = load_study_results(MATCH_WORTH)
    return draw_robots(results, results.outcomes[:1])


def match_worth_tolerance() -> Figure:
    """Draw the tolerance curves of the study."""
    return draw_tolerance(load_study_results(MATCH_WORTH))


FIGURES: dict[str, Callable[[], Figure]] = {
    "drive-laws.svg": drive_laws,
    "stiffness-and-damping.svg": stiffness_and_damping,
    "dry-friction.svg": dry_friction,
    "delay.svg": delays,
    "study.svg": study,
    "actuator-network.svg": actuator_network,
}
"""How each file is drawn."""
if MATCH_WORTH.exists():
    FIGURES["match-worth.svg"] = match_worth
    FIGURES["match-worth-tolerance.svg"] = match_worth_tolerance
NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?![\w.])")
TOLERANCE_PX = 0.5


def agrees(drawn: str, stored: str) -> bool:
    """Return whether two SVG files differ by rounding alone."""
    drawn_numbers = np.array([float(number) for number in NUMBER.findall(drawn)])
    stored_numbers = np.array([float(number) for number in NUMBER.findall(stored)])
    same_text = NUMBER.sub("#", drawn) == NUMBER.sub("#", stored)
    if not same_text or drawn_numbers.shape != stored_numbers.shape:
        return False
    return bool(np.abs(drawn_numbers - stored_numbers).max(initial=0.0) <= TOLERANCE_PX)


def main() -> int:
    """Draw or compare the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="compare instead of drawing")
    check = parser.parse_args().check
    OUT.mkdir(exist_ok=True)
    stale = []
    for name, draw in FIGURES.items():
        path = OUT / name
        drawn = style.render(draw()).decode("utf-8")
        if not check:
            path.write_text(drawn, encoding="utf-8")
            print(path)
        elif not path.exists() or not agrees(drawn, path.read_text(encoding="utf-8")):
            stale.append(name)
    if stale:
        print(f"out of date: {', '.join(stale)}; run python scripts/docs_figures.py")
    return 1 if stale else 0


if __name__ == "__main__":
    sys.exit(main())
