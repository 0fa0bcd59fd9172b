"""Bode plots of a match: one joint, all joints in small, and what a missing rotor does."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FixedLocator
from numpy.typing import NDArray

from pronk.match.result import JointFit, MatchResult
from pronk.report import style
from pronk.response.response import FrequencyResponse

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

_LOWEST_HZ = 0.1
_MIN_COHERENCE = 0.5
"""Measured points below are left out when the axes are scaled: they are mostly noise."""


def measured_words(virtual: bool) -> str:
    """What the measured curve is called: the virtual robot is always called that."""
    return "measured on the virtual robot" if virtual else "measured"


def _worth(response: FrequencyResponse) -> NDArray[np.bool_]:
    """Frequencies worth drawing: those that were asked and answered."""
    asked = (response.coherence >= _MIN_COHERENCE) & (response.frequency_hz > 0.0)
    return asked if asked.any() else response.frequency_hz > 0.0


def _hidden(response: FrequencyResponse, values: Array) -> Array:
    """Values of a curve, not a number where it is not worth drawing."""
    return np.where(_worth(response), values, np.nan)


def _limits_hz(responses: Sequence[FrequencyResponse]) -> tuple[float, float]:
    hz = np.concatenate([r.frequency_hz[_worth(r)] for r in responses])
    return max(_LOWEST_HZ, float(hz.min())), float(hz.max())


def _shade_band(axes: Axes, band_hz: tuple[float, float]) -> None:
    axes.axvspan(*band_hz, color=style.BAND, zorder=0, linewidth=0)


def _draw_measured_gain(axes: Axes, response: FrequencyResponse) -> None:
    hz = response.frequency_hz
    low, high = (_hidden(response, style.decibel(bound)) for bound in response.gain_interval())
    axes.fill_between(hz, low, high, color=style.MEASURED_WIDE, alpha=0.35, linewidth=0)
    axes.plot(hz, _hidden(response, style.decibel(response.gain)), **style.MEASURED_LINE)


def _gain(axes: Axes, response: FrequencyResponse, curve: ComplexArray, **look: Any) -> None:
    """Draw the gain of a simulated curve where the measured one is worth comparing with."""
    axes.plot(response.frequency_hz, _hidden(response, style.decibel(curve)), **look)


def _gain_limits(joint: JointFit, *, room: float = 0.0) -> tuple[float, float]:
    """Limits of the gain axis that hold every curve where the measurement is worth reading.

    Args:
        joint: Its measured, matched and naive gains are to be seen.
        room: More of it above and below, for a curve that may run out of the picture [dB].
    """
    response = joint.responses[0]
    inside = _worth(response)
    curves = (response.gain, np.abs(joint.matched), np.abs(joint.naive))
    values = np.concatenate([style.decibel(curve[inside]) for curve in curves])
    values = values[np.isfinite(values)]
    return float(max(values.min(), -60.0)) - 2.0 - room, float(values.max()) + 2.0 + room


def bode(joint: JointFit, *, title: str | None = None, coherence: bool = True) -> Figure:
    """Bode plot of one joint: measured with its 95 % interval, matched, naive, coherence below.

    Args:
        joint: What the match found for the joint.
        title: Words above the plot; the joint's name if None.
        coherence: Draw the strip of the coherence as well.
    """
    response = joint.responses[0]
    hz = response.frequency_hz
    low_hz, high_hz = _limits_hz([response])
    rows, ratios = (3, [3.0, 2.0, 0.8]) if coherence else (2, [3.0, 2.0])
    with style.styled():
        figure = Figure(
            figsize=(style.PAGE_WIDTH_IN, 6.2 if coherence else 5.4), layout="constrained"
        )
        panels = figure.subplots(rows, 1, sharex=True, height_ratios=ratios, squeeze=False)[:, 0]
        gain, phase = panels[0], panels[1]
        for panel in panels:
            _shade_band(panel, joint.band_hz)
            style.frequency_axis(panel, low_hz, high_hz)
        _draw_measured_gain(gain, response)
        _gain(gain, response, joint.naive, **style.NAIVE_LINE)
        _gain(gain, response, joint.matched, **style.MATCHED_LINE)
        gain.set_ylim(*_gain_limits(joint))
        gain.set_ylabel("gain [dB]")
        gain.set_title(title or style.joint_words(joint.joint))

        low, high = response.phase_interval()
        phase.fill_between(
            hz,
            _hidden(response, np.degrees(low)),
            _hidden(response, np.degrees(high)),
            color=style.MEASURED_WIDE,
            alpha=0.35,
            linewidth=0,
        )
        phase.plot(hz, _hidden(response, np.degrees(response.phase)), **style.MEASURED_LINE)
        for curve, line in ((joint.naive, style.NAIVE_LINE), (joint.matched, style.MATCHED_LINE)):
            phase.plot(hz, _hidden(response, np.degrees(np.unwrap(np.angle(curve)))), **line)
        phase.set_ylabel("phase [deg]")
        phase.set_ylim(*_phase_limits(joint))
        if joint.grid_error.size:
            # Reading F9: the paper discards the phase, because the links' delay is in it.
            phase.text(
                0.01,
                0.06,
                "not compared: the delay of command and measurement is in it",
                transform=phase.transAxes,
                fontsize=8.5,
                color="#333333",
            )
        if coherence:
            panels[2].fill_between(
                hz, 0.0, response.coherence, color=style.MEASURED, alpha=0.35, linewidth=0
            )
            panels[2].axhline(0.95, color="#666666", linewidth=0.8, linestyle=":")
            panels[2].set_ylim(0.0, 1.05)
            panels[2].set_yticks([0.0, 0.5, 1.0])
            panels[2].set_ylabel("coherence")
        panels[-1].set_xlabel("frequency [Hz]")
        figure.legend(handles=_bode_handles(joint), loc="outside lower center", ncols=2)
    return figure


def _phase_limits(joint: JointFit) -> tuple[float, float]:
    response = joint.responses[0]
    inside = _worth(response)
    curves = [response.phase, *(np.unwrap(np.angle(c)) for c in (joint.matched, joint.naive))]
    values = np.degrees(np.concatenate([curve[inside] for curve in curves]))
    values = values[np.isfinite(values)]
    return float(max(values.min() - 15.0, -720.0)), float(min(values.max() + 15.0, 90.0))


def _bode_handles(joint: JointFit | None, virtual: bool = False) -> list[Line2D | Patch]:
    """Legend entries; with a joint, its errors stand beside the names."""
    matched, naive = "simulator, matched gains", "simulator, naive gains"
    band = "frequencies compared"
    if joint is not None:
        virtual = joint.responses[0].virtual
        matched += f": {joint.error_db:.2f} dB off"
        naive += f": {joint.naive_error_db:.2f} dB off"
    return [
        Line2D([], [], label=f"{measured_words(virtual)} (shaded: 95 %)", **style.MEASURED_LINE),
        Line2D([], [], label=matched, **style.MATCHED_LINE),
        Line2D([], [], label=naive, **style.NAIVE_LINE),
        Patch(facecolor=style.BAND, label=band),
    ]


def hero(result: MatchResult, joint: str | None = None) -> Figure:
    """The picture for the front: one knee (or the joint named), gain only with phase below.

    Args:
        result: What the match found.
        joint: Name of a joint; the first knee, or the joint with the largest gain of match over
            naive where there is none.
    """
    if joint is None:
        knees = [name for name in result.joints if name.endswith("knee")]
        joint = (knees or sorted(result.joints, key=lambda n: -result.joints[n].naive_error_db))[0]
    match = result.joints[joint]
    where = "the virtual robot" if match.responses[0].virtual else "the robot"
    robot = result.gains.robot.replace("_", " ")
    title = (
        f"{style.joint_words(joint)} of {where} ({robot}): "
        f"matched at {match.stiffness:.1f} N m/rad, {match.damping:.3f} N m s/rad"
    )
    return bode(match, title=title, coherence=False)


def overview(result: MatchResult) -> Figure:
    """Gain of every joint in small: rows are joint groups, columns are legs."""
    rows = style.grid_of_joints(list(result.joints))
    with style.styled():
        figure, panels = style.small_multiples(rows, height=2.0, sharey="row")
        limits = {}
        for name, axes in panels.items():
            joint = result.joints[name]
            _shade_band(axes, joint.band_hz)
            style.frequency_axis(axes, *_limits_hz([joint.responses[0]]))
            _draw_measured_gain(axes, joint.responses[0])
            _gain(axes, joint.responses[0], joint.naive, **{**style.NAIVE_LINE, "linewidth": 1.2})
            _gain(
                axes, joint.responses[0], joint.matched, **{**style.MATCHED_LINE, "linewidth": 1.1}
            )
            axes.set_title(style.joint_words(name))
            low_hz, high_hz = _limits_hz([joint.responses[0]])
            if high_hz > 30.0 * low_hz:
                axes.xaxis.set_major_locator(FixedLocator([0.01, 0.1, 1.0, 10.0, 100.0]))
            axes.text(
                0.03,
                0.05,
                f"{joint.naive_error_db:.2f} → {joint.error_db:.2f} dB",
                transform=axes.transAxes,
                fontsize=8.5,
                color="#333333",
            )
            limits[name] = _gain_limits(joint)
        for row in rows:
            # The words at the lower left need room under the curves.
            low = max(min(limits[name][0] for name in row), -45.0)
            high = max(limits[name][1] for name in row)
            panels[row[0]].set_ylim(low - 0.12 * (high - low), high)
            panels[row[0]].set_ylabel("gain [dB]")
        for name in style.bottom_row(rows):
            panels[name].set_xlabel("frequency [Hz]")
            panels[name].tick_params(labelbottom=True)
        virtual = any(j.responses[0].virtual for j in result.joints.values())
        figure.legend(
            handles=_bode_handles(None, virtual=virtual), loc="outside lower center", ncols=4
        )
    return figure


def zero_armature(joint: JointFit) -> Figure:
    """Gain of one joint with the best match that a simulator without rotor inertia allows.

    The paper's Fig. 3: no gains make up for inertia that is not there.

    Raises:
        ValueError: The match did not try zero armature on this joint.
    """
    if joint.zero_armature is None:
        raise ValueError(f"{joint.joint} was not matched with zero armature")
    response = joint.responses[0]
    with style.styled():
        figure = Figure(figsize=(style.PAGE_WIDTH_IN, 3.9), layout="constrained")
        axes = figure.subplots()
        _shade_band(axes, joint.band_hz)
        style.frequency_axis(axes, *_limits_hz([response]))
        _draw_measured_gain(axes, response)
        _gain(axes, response, joint.zero_armature, **style.ZERO_LINE)
        _gain(axes, response, joint.matched, **style.MATCHED_LINE)
        axes.set_ylim(*_gain_limits(joint, room=6.0))
        axes.set_ylabel("gain [dB]")
        axes.set_xlabel("frequency [Hz]")
        axes.set_title(f"{style.joint_words(joint.joint)}: with and without rotor inertia")
        words = measured_words(response.virtual)
        handles = [
            Line2D([], [], label=f"{words}, 95 %", **style.MEASURED_LINE),
            Line2D([], [], label=f"matched: {joint.error_db:.2f} dB off", **style.MATCHED_LINE),
            Line2D(
                [],
                [],
                label=f"best without rotor inertia: {joint.zero_armature_error_db:.2f} dB off",
                **style.ZERO_LINE,
            ),
        ]
        figure.legend(handles=handles, loc="outside lower center", ncols=3)
    return figure


def answers(responses: Sequence[FrequencyResponse]) -> Figure:
    """Bode plot of what was measured alone: one joint, one curve per amplitude."""
    looks = (
        {"color": style.MEASURED, "linestyle": "-"},
        {"color": style.MATCHED, "linestyle": (0, (5, 2))},
        {"color": style.NAIVE, "linestyle": (0, (6, 2, 1, 2))},
        {"color": style.ZERO_ARMATURE, "linestyle": ":"},
    )
    with style.styled():
        figure = Figure(figsize=(style.PAGE_WIDTH_IN, 6.2), layout="constrained")
        panels = figure.subplots(3, 1, sharex=True, height_ratios=[3.0, 2.0, 1.0])
        handles = []
        lowest, highest = np.inf, -np.inf
        for i, response in enumerate(responses):
            look: dict[str, Any] = {**looks[i % len(looks)], "linewidth": 1.4}
            hz = response.frequency_hz
            gain, phase = response.gain_interval(), response.phase_interval()
            shade = {"color": look["color"], "alpha": 0.15, "linewidth": 0}
            gains = [_hidden(response, style.decibel(g)) for g in (*gain, response.gain)]
            phases = [_hidden(response, np.degrees(p)) for p in (*phase, response.phase)]
            for panel, (low, high, middle) in zip(panels, (gains, phases), strict=False):
                panel.fill_between(hz, low, high, **shade)
                panel.plot(hz, middle, **look)
            panels[2].plot(hz, response.coherence, **look)
            handles.append(Line2D([], [], label=f"{response.amplitude:.3g} rad", **look))
            worth = style.decibel(response.gain[_worth(response)])
            lowest = min(lowest, *worth, np.inf)
            highest = max(highest, *worth, -np.inf)
        for panel in panels:
            style.frequency_axis(panel, *_limits_hz(responses))
        if np.isfinite([lowest, highest]).all():
            panels[0].set_ylim(max(lowest, -60.0) - 2.0, highest + 2.0)
        panels[0].set_ylabel("gain [dB]")
        panels[1].set_ylabel("phase [deg]")
        panels[2].set_ylabel("coherence")
        panels[2].axhline(0.95, color="#666666", linewidth=0.8, linestyle=":")
        panels[2].set_ylim(0.0, 1.05)
        panels[2].set_xlabel("frequency [Hz]")
        first = responses[0]
        words = measured_words(first.virtual)
        panels[0].set_title(f"{style.joint_words(first.joint)}, {words} (shaded: 95 %)")
        figure.legend(handles=handles, loc="outside lower center", ncols=4)
    return figure
