"""Figures of a match, drawn from its artefacts alone; gains are in dB only here."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse, Patch, Rectangle
from matplotlib.ticker import FixedLocator, LogLocator, NullLocator
from numpy.typing import NDArray
from scipy import stats

from pronk.match.gains import MatchedGains
from pronk.match.prediction import JointPrediction
from pronk.match.result import JointFit, MatchResult
from pronk.report import style
from pronk.report.paper import published
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
    """Frequencies worth drawing: those that were excited and have a response."""
    excited = (response.coherence >= _MIN_COHERENCE) & (response.frequency_hz > 0.0)
    return excited if excited.any() else response.frequency_hz > 0.0


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


def _gain_limits(joint: JointFit, *, margin: float = 0.0) -> tuple[float, float]:
    """Limits of the gain axis that hold every curve where the measurement is worth reading.

    Args:
        joint: Its measured, matched and naive gains are to be seen.
        margin: More of it above and below, for a curve that may run out of the picture [dB].
    """
    response = joint.responses[0]
    inside = _worth(response)
    curves = (response.gain, np.abs(joint.matched), np.abs(joint.naive))
    values = np.concatenate([style.decibel(curve[inside]) for curve in curves])
    values = values[np.isfinite(values)]
    return float(max(values.min(), -60.0)) - 2.0 - margin, float(values.max()) + 2.0 + margin


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
            # The words at the lower left need space under the curves.
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
        axes.set_ylim(*_gain_limits(joint, margin=6.0))
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


_CHI2_95 = float(stats.chi2.ppf(0.95, 2))
"""Squared radius of the 95 % ellipse of a plane normal distribution."""


def ellipse(center: tuple[float, float], covariance: Array, squared: float = _CHI2_95) -> Ellipse:
    """The ellipse {x : (x - center)^T covariance^-1 (x - center) = squared}, unfilled."""
    values, vectors = np.linalg.eigh(np.asarray(covariance, dtype=float))
    radii = np.sqrt(np.maximum(values, 0.0) * squared)
    angle = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
    return Ellipse(center, 2.0 * radii[1], 2.0 * radii[0], angle=angle, fill=False)


def error_maps(
    result: MatchResult, naive_gains: dict[str, tuple[float, float]] | None = None
) -> Figure:
    """Error of the gain over the grid for every joint, with what was found and what was known.

    Args:
        result: What the match found.
        naive_gains: Gains of the real drive per joint (stiffness [N m/rad], damping
            [N m s/rad]), drawn as a cross where given.
    """
    mapped = {name: joint for name, joint in result.joints.items() if joint.grid_error.size}
    rows = style.grid_of_joints(list(mapped))
    paper = published(result.gains.robot)
    known = naive_gains or {}
    errors = {name: np.sqrt(joint.grid_error) for name, joint in mapped.items()}
    low = max(min(float(np.nanmin(e)) for e in errors.values()), 0.05)
    high = max(float(np.nanmax(e)) for e in errors.values())
    norm = LogNorm(vmin=low, vmax=max(high, low * 1.01))
    with style.styled():
        figure, panels = style.small_multiples(rows, height=2.35)
        for name, axes in panels.items():
            joint = result.joints[name]
            image = axes.pcolormesh(
                joint.grid_stiffness,
                joint.grid_damping,
                errors[name].T,
                norm=norm,
                cmap="viridis",
                shading="nearest",
                rasterized=True,
            )
            axes.grid(False)
            axes.set_title(style.joint_words(name))
            axes.set_xlim(joint.grid_stiffness[0], joint.grid_stiffness[-1])
            axes.set_ylim(joint.grid_damping[0], joint.grid_damping[-1])
            _mark_map(axes, joint)
            if name in known:
                axes.plot(*known[name], marker="x", **_cross(style.NAIVE))
            if paper is not None and name in paper.joints:
                axes.plot(*paper.joints[name], marker="+", **_cross("white", size=11.0))
        for row in rows:
            panels[row[0]].set_ylabel("damping [N m s/rad]")
        for name in style.bottom_row(rows):
            panels[name].set_xlabel("stiffness [N m/rad]")
            panels[name].tick_params(labelbottom=True)
        bar = figure.colorbar(image, ax=list(panels.values()), aspect=40, pad=0.01)
        bar.set_label("gain error in the band, RMS [dB]")
        bar.ax.yaxis.set_major_locator(LogLocator(base=10.0, subs=(1.0, 2.0, 5.0)))
        bar.ax.yaxis.set_major_formatter("{x:g}")
        bar.ax.yaxis.set_minor_locator(NullLocator())
        figure.legend(
            handles=_map_handles(bool(known), paper is not None),
            loc="outside lower center",
            ncols=5,
            facecolor="#8a9a9a",
            frameon=True,
            edgecolor="none",
        )
    return figure


def _cross(color: str, size: float = 8.0) -> dict[str, Any]:
    return {
        "color": color,
        "markersize": size,
        "markeredgewidth": 2.0,
        "linestyle": "none",
        "zorder": 5,
    }


_SQUARE: dict[str, Any] = {
    "marker": "s",
    "markerfacecolor": "none",
    "markeredgecolor": "white",
    "markersize": 8.0,
    "markeredgewidth": 1.3,
    "linestyle": "none",
}
_DOT: dict[str, Any] = {
    "marker": "o",
    "markerfacecolor": "#56B4E9",
    "markeredgecolor": "white",
    "markersize": 5.0,
    "linestyle": "none",
}


def _mark_map(axes: Axes, joint: JointFit) -> None:
    i, j = np.unravel_index(int(np.nanargmin(joint.grid_error)), joint.grid_error.shape)
    axes.plot(joint.grid_stiffness[i], joint.grid_damping[j], **_SQUARE)
    if np.isfinite(joint.covariance).all():
        shape = ellipse((joint.stiffness, joint.damping), joint.covariance)
        shape.set(edgecolor="white", linewidth=1.2, zorder=4)
        axes.add_patch(shape)
    axes.plot(joint.stiffness, joint.damping, **_DOT, zorder=6)


def _map_handles(naive: bool, paper: bool) -> list[Line2D]:
    handles = [
        Line2D([], [], label="best of the grid", **_SQUARE),
        Line2D([], [], label="refined, with 95 % ellipse", **_DOT),
    ]
    if naive:
        handles.append(
            Line2D([], [], marker="x", label="gains of the real drive", **_cross(style.NAIVE))
        )
    if paper:
        handles.append(
            Line2D([], [], marker="+", label="paper, Table I", **_cross("white", size=11.0))
        )
    return handles


def ranges(gains: MatchedGains, groups: dict[str, Sequence[str]]) -> Figure:
    """Where the joints of each group lie, the box that training draws from, and the ellipsoid.

    Args:
        gains: The artefact.
        groups: Names of the joints in each group.
    """
    paper = published(gains.robot)
    shown = [name for name in gains.groups if name in groups]
    columns = min(3, len(shown))
    rows = -(-len(shown) // columns)
    with style.styled():
        figure = Figure(figsize=(style.PAGE_WIDTH_IN, 3.4 * rows + 0.8), layout="constrained")
        panels = figure.subplots(rows, columns, squeeze=False).ravel()
        for axes in panels[len(shown) :]:
            axes.set_visible(False)
        for axes, name in zip(panels, shown, strict=False):
            _draw_group(axes, gains, name, groups[name])
            if paper is not None and name in paper.training:
                _draw_box(
                    axes,
                    paper.training[name],
                    (paper.stiffness_range, paper.damping_range),
                    edgecolor=style.PAPER,
                    linestyle="--",
                    linewidth=1.4,
                )
            axes.autoscale_view()
            axes.margins(0.12)
            axes.set_title(style.joint_words(name))
            axes.set_xlabel("stiffness [N m/rad]")
        for row in range(rows):
            panels[row * columns].set_ylabel("damping [N m s/rad]")
        legs = any(style.leg_of(joint) for joint in gains.joints)
        handles = _range_handles(legs, paper is not None)
        figure.legend(handles=handles, loc="outside lower center", ncols=min(7, len(handles)))
    return figure


def _draw_box(
    axes: Axes, center: tuple[float, float], half: tuple[float, float], **look: Any
) -> None:
    corner = (center[0] - half[0], center[1] - half[1])
    box = Rectangle(corner, 2.0 * half[0], 2.0 * half[1], **{"fill": False, **look})
    axes.add_patch(box)


def _draw_group(axes: Axes, gains: MatchedGains, name: str, joints: Sequence[str]) -> None:
    group = gains.groups[name]
    center = (group.stiffness, group.damping)
    half = (group.stiffness_range, group.damping_range)
    _draw_box(axes, center, half, fill=True, facecolor="#dbeaf4", edgecolor=style.MATCHED)
    axes.plot(*center, marker="+", color=style.MATCHED, markersize=9, linestyle="none")
    shape = np.asarray(group.ellipsoid)
    if np.isfinite(shape).all() and shape.any():
        outline = ellipse(group.ellipsoid_center, shape, squared=1.0)
        outline.set(edgecolor=style.MATCHED, linestyle=":", linewidth=1.4)
        axes.add_patch(outline)
    for joint in joints:
        one = gains.joints[joint]
        axes.errorbar(
            one.stiffness,
            one.damping,
            xerr=_arms(one.stiffness, one.stiffness_ci95),
            yerr=_arms(one.damping, one.damping_ci95),
            fmt=style.LEG_MARKERS.get(style.leg_of(joint), "o"),
            color=style.MEASURED,
            markersize=5,
            elinewidth=1.0,
        )
        if len(joints) > 1 and not style.leg_of(joint):
            axes.annotate(
                style.joint_words(joint),
                (one.stiffness, one.damping),
                textcoords="offset points",
                xytext=(7, 7),
                fontsize=8.5,
            )


def _arms(value: float, interval: tuple[float, float]) -> list[list[float]]:
    """Lengths of the two arms of an error bar; none where the interval is unknown."""
    low, high = value - interval[0], interval[1] - value
    return [
        [max(low, 0.0) if np.isfinite(low) else 0.0],
        [max(high, 0.0) if np.isfinite(high) else 0.0],
    ]


def _range_handles(legs: bool, paper: bool) -> list[Line2D | Patch]:
    dot: dict[str, Any] = {"color": style.MEASURED, "linestyle": "none", "markersize": 5}
    handles: list[Line2D | Patch] = [
        Line2D([], [], marker=marker, label=leg, **dot)
        for leg, marker in (style.LEG_MARKERS if legs else {"joint, 95 %": "o"}).items()
    ]
    handles += [
        Patch(facecolor="#dbeaf4", edgecolor=style.MATCHED, label="training range"),
        Line2D([], [], color=style.MATCHED, linestyle=":", label="smallest ellipse"),
    ]
    if paper:
        handles.append(Line2D([], [], color=style.PAPER, linestyle="--", label="paper's range"))
    return handles


def amplitudes(result: MatchResult) -> Figure | None:
    """Gains fitted at each amplitude, relative to the largest one; None with one amplitude."""
    joints = {n: j for n, j in result.joints.items() if len(j.amplitude_gains) > 1}
    if not joints:
        return None
    with style.styled():
        figure = Figure(figsize=(style.PAGE_WIDTH_IN, 3.2), layout="constrained")
        panels = figure.subplots(1, 2, sharex=True)
        position = np.arange(len(joints))
        for panel, column, what in ((panels[0], 1, "stiffness"), (panels[1], 2, "damping")):
            for place, joint in zip(position, joints.values(), strict=True):
                table = joint.amplitude_gains[np.argsort(-joint.amplitude_gains[:, 0])]
                change = 100.0 * (table[:, column] / table[0, column] - 1.0)
                panel.plot([place] * len(change), change, color="#bbbbbb", linewidth=1.2)
                for k, (amplitude, value) in enumerate(zip(table[:, 0], change, strict=True)):
                    panel.plot(
                        place,
                        value,
                        marker="os^Dv"[k % 5],
                        color=(style.MEASURED, style.MATCHED, style.NAIVE, style.PAPER)[k % 4],
                        linestyle="none",
                        markersize=5,
                        label=f"{amplitude:g} rad" if place == 0 else None,
                    )
            panel.axhline(0.0, color="#666666", linewidth=0.8)
            panel.set_xticks(
                position, [style.joint_words(n) for n in joints], rotation=60, ha="right"
            )
            panel.set_ylabel(f"change of {what} [%]")
            panel.set_title(f"{what}, relative to the largest amplitude")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    return figure


def busiest_window(replay: JointPrediction, seconds: float) -> slice:
    """The window of this length in which the error of the naive simulation varies most.

    The variance, not the mean square: a joint that rests beside its command is not the picture.
    """
    rate = (len(replay.time) - 1) / float(replay.time[-1] - replay.time[0])
    width = min(max(2, round(seconds * rate)), len(replay.time))
    error = replay.naive - replay.measured
    total = np.concatenate(([0.0], np.cumsum(error)))
    power = np.concatenate(([0.0], np.cumsum(error**2)))
    mean = (total[width:] - total[:-width]) / width
    variance = (power[width:] - power[:-width]) / width - mean**2
    start = int(np.argmax(variance))
    return slice(start, start + width)


def replay(replay: JointPrediction, *, virtual: bool, seconds: float = 1.5) -> Figure:
    """Command, measured, naive and matched in time, and what is left over, below.

    Args:
        replay: One joint's replay.
        virtual: The measured curve is the virtual robot's.
        seconds: Length of the window shown, by `busiest_window` [s].
    """
    window = busiest_window(replay, seconds)
    time = replay.time[window]
    measured = replay.measured[window]
    robot = "measured on the virtual robot" if virtual else "measured"
    with style.styled():
        drawn = Figure(figsize=(style.PAGE_WIDTH_IN, 4.8), layout="constrained")
        top, bottom = drawn.subplots(2, 1, sharex=True, height_ratios=[3.0, 1.4])
        top.step(time, replay.command[window], where="post", color=style.COMMAND, linewidth=0.7)
        top.plot(time, measured, **style.MEASURED_LINE)
        top.plot(time, replay.naive[window], **style.NAIVE_LINE)
        top.plot(time, replay.matched[window], **style.MATCHED_LINE)
        top.set_ylabel(f"position [{replay.unit}]")
        signal = "log" if replay.signal == "unknown" else replay.signal.replace("_", " ")
        top.set_title(f"{style.joint_words(replay.joint)}: a {signal} replayed")
        bottom.axhline(0.0, color="#666666", linewidth=0.8)
        bottom.plot(time, replay.naive[window] - measured, **style.NAIVE_LINE)
        bottom.plot(time, replay.matched[window] - measured, **style.MATCHED_LINE)
        bottom.set_ylabel(f"error [{replay.unit}]")
        bottom.set_xlabel("time [s]")
        bottom.set_xlim(time[0], time[-1])
        handles = [
            Line2D([], [], color=style.COMMAND, linewidth=0.7, label="command"),
            Line2D([], [], label=robot, **style.MEASURED_LINE),
            Line2D([], [], label=f"naive: RMSE {replay.rmse_naive:.4f}", **style.NAIVE_LINE),
            Line2D([], [], label=f"matched: RMSE {replay.rmse_matched:.4f}", **style.MATCHED_LINE),
        ]
        drawn.legend(handles=handles, loc="outside lower center", ncols=4)
    return drawn
