"""Figures of responses, matches and predictions. Gains are in dB here alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse, Patch, Rectangle
from matplotlib.ticker import LogLocator, NullLocator
from scipy import stats

from pronk.arrays import Array, ComplexArray, Mask
from pronk.identify.match.compared import ComparedResponses
from pronk.identify.match.gains import MatchedGains
from pronk.identify.match.predict import JointPrediction
from pronk.identify.match.result import JointResult, MatchResult
from pronk.identify.response.response import FrequencyResponse
from pronk.report import style
from pronk.report.paper import RANGES, ROBOT, TABLE_I, TRAINING
from pronk.report.style import drawing, key, legend

_Curves = Sequence[tuple[ComplexArray, dict[str, Any]]]

_LOWEST_HZ = 0.1
_MIN_COHERENCE = 0.5
"""Measured points below are not drawn: they are mostly noise."""
_CHI2_95 = float(stats.chi2.ppf(0.95, 2))
"""Squared radius of the 95 % ellipse of a bivariate normal distribution."""


def measured_words(virtual: bool) -> str:
    """Return the name of the measured curve."""
    return "measured on the virtual robot" if virtual else "measured"


def _coherent(response: FrequencyResponse) -> Mask:
    coherent = (response.coherence >= _MIN_COHERENCE) & (response.frequency_hz > 0.0)
    return coherent if coherent.any() else response.frequency_hz > 0.0


def _limits_hz(responses: Sequence[FrequencyResponse]) -> tuple[float, float]:
    hz = np.concatenate([r.frequency_hz[_coherent(r)] for r in responses])
    return max(_LOWEST_HZ, float(hz.min())), float(hz.max())


def _measured(
    axes: Axes, response: FrequencyResponse, look: dict[str, Any], *, phase: bool = False
) -> None:
    """Draw the measured gain [dB] or phase [deg] with its 95 % interval."""
    bounds = response.phase_interval() if phase else response.gain_interval()
    curves = (*bounds, response.phase if phase else response.gain)
    scale, inside = np.degrees if phase else style.decibel, _coherent(response)
    low, high, middle = (np.where(inside, scale(one), np.nan) for one in curves)
    shade = {"color": look["color"], "alpha": 0.35 if look is style.MEASURED_LINE else 0.15}
    axes.fill_between(response.frequency_hz, low, high, linewidth=0, **shade)
    axes.plot(response.frequency_hz, middle, **look)


def compared(fit: JointResult) -> ComparedResponses:
    """Return the responses of a joint that has some."""
    if fit.responses is None:
        raise ValueError(f"{fit.joint} has no response to draw")
    return fit.responses


def _panel(axes: Axes, fit: JointResult, curves: _Curves, *, phase: bool = False) -> None:
    """Draw measured and simulated gain [dB] or phase [deg] of a joint, the compared band tinted."""
    response = compared(fit).measured[0]
    axes.axvspan(*compared(fit).band_hz, color=style.BAND, zorder=0, linewidth=0)
    style.frequency_axis(axes, *_limits_hz([response]))
    _measured(axes, response, style.MEASURED_LINE, phase=phase)
    for curve, look in curves:
        values = np.degrees(np.unwrap(np.angle(curve))) if phase else style.decibel(curve)
        axes.plot(response.frequency_hz, np.where(_coherent(response), values, np.nan), **look)


def _simulated(fit: JointResult) -> _Curves:
    responses = compared(fit)
    return [(responses.nominal, style.NAIVE_LINE), (responses.matched, style.MATCHED_LINE)]


def _coherence(axes: Axes, response: FrequencyResponse, **look: Any) -> None:
    axes.plot(response.frequency_hz, response.coherence, **look)
    axes.axhline(0.95, color="#666666", linewidth=0.8, linestyle=":")
    axes.set(ylim=(0.0, 1.05), ylabel="coherence")


def _keys(virtual: bool, matched: str = "", naive: str = "") -> list[Line2D | Patch]:
    """Legend of a Bode plot; the texts are added to the names of the simulated curves."""
    return [
        key(f"{measured_words(virtual)} (shaded: 95 %)", **style.MEASURED_LINE),
        key(f"simulator, matched gains{matched}", **style.MATCHED_LINE),
        key(f"simulator, nominal gains{naive}", **style.NAIVE_LINE),
        Patch(facecolor=style.BAND, label="frequencies compared"),
    ]


def bode(fit: JointResult, *, title: str | None = None, coherence: bool = True) -> Figure:
    """Draw the Bode plot of one joint: measured with its 95 % interval, matched, nominal."""
    response = compared(fit).measured[0]
    ratios = [3.0, 2.0, 0.8] if coherence else [3.0, 2.0]
    options: dict[str, Any] = {"sharex": True, "height_ratios": ratios}
    with drawing(len(ratios), height=1.0 + 1.0 * sum(ratios), **options) as (figure, grid):
        gain, phase = grid[:2, 0]
        gain.set_ylabel("gain [dB]")
        phase.set_ylabel("phase [deg]")
        _panel(gain, fit, _simulated(fit))
        _panel(phase, fit, _simulated(fit), phase=True)
        gain.set_title(title or style.joint_words(fit.joint))
        if fit.grid is not None:
            # Reading F9: the paper discards the phase, because the links' delay is in it.
            note = "not compared: contains the delay of command and measurement"
            phase.text(0.01, 0.06, note, transform=phase.transAxes, fontsize=8.5, color="#333333")
        if coherence:
            _coherence(grid[2, 0], response, color=style.MEASURED, linewidth=1.0)
        grid[-1, 0].set_xlabel("frequency [Hz]")
        errors = (
            f": error {db:.2f} dB"
            for db in (compared(fit).error_db, compared(fit).nominal_error_db)
        )
        legend(figure, _keys(response.virtual, *errors), 2)
    return figure


def knees_first(names: Sequence[str]) -> list[str]:
    """Sort joint names, those of knees first: rotor inertia and mismatch are largest there."""
    return sorted(names, key=lambda name: not name.endswith("knee"))


def hero(result: MatchResult) -> Figure:
    """Draw the Bode plot of one joint, a knee where there is one, without coherence."""
    fit = result.joints[knees_first(list(result.joints))[0]]
    where = "the virtual robot" if result.virtual else "the robot"
    title = (
        f"{style.joint_words(fit.joint)} of {where} ({result.robot.replace('_', ' ')}): "
        f"matched at {fit.gains.stiffness.value:.1f} N m/rad, "
        f"{fit.gains.damping.value:.3f} N m s/rad"
    )
    return bode(fit, title=title, coherence=False)


def overview(fits: Mapping[str, JointResult]) -> Figure:
    """Draw the gain of every joint; rows are joint groups, columns are legs."""
    labels = ("frequency [Hz]", "gain [dB]")
    with style.joint_panels(list(fits), *labels, height=2.0, sharey="row") as (figure, panels):
        for name, axes in panels.items():
            fit = fits[name]
            _panel(axes, fit, _simulated(fit))
            axes.margins(y=0.2)
            errors = f"{compared(fit).nominal_error_db:.2f} → {compared(fit).error_db:.2f} dB"
            axes.text(0.03, 0.05, errors, transform=axes.transAxes, fontsize=8.5, color="#333333")
        legend(figure, _keys(any(compared(fit).measured[0].virtual for fit in fits.values())), 4)
    return figure


def zero_armature(fit: JointResult) -> Figure:
    """Draw the gain of one joint with the best match without rotor inertia (paper Fig. 3)."""
    assert fit.zero_armature is not None
    responses = compared(fit)
    curves = [
        (fit.zero_armature.response, style.ZERO_LINE),
        (responses.matched, style.MATCHED_LINE),
    ]
    with drawing(height=3.9) as (figure, grid):
        axes = grid[0, 0]
        _panel(axes, fit, curves)
        # An antiresonance would leave the rest of the curves no room.
        shallow = style.decibel(responses.matched).min() - 20.0
        axes.set(xlabel="frequency [Hz]", ylabel="gain [dB]")
        axes.set_ylim(max(shallow, axes.get_ylim()[0]), None)
        axes.set_title(f"{style.joint_words(fit.joint)}: with and without rotor inertia")
        best = f"best without rotor inertia: error {fit.zero_armature.error_db:.2f} dB"
        keys = _keys(responses.measured[0].virtual, f": error {responses.error_db:.2f} dB")
        legend(figure, [*keys[:2], key(best, **style.ZERO_LINE)])
    return figure


def responses(found: Sequence[FrequencyResponse]) -> Figure:
    """Draw the Bode plot of one joint as measured, one curve per amplitude."""
    colours = (style.MEASURED, style.MATCHED, style.NAIVE, style.ZERO_ARMATURE)
    dashes = ("-", (0, (5, 2)), (0, (6, 2, 1, 2)), ":")
    options: dict[str, Any] = {"sharex": True, "height_ratios": [3.0, 2.0, 1.0]}
    keys = []
    with drawing(3, height=6.2, **options) as (figure, grid):
        gain, phase, coherence = grid[:, 0]
        gain.set_ylabel("gain [dB]")
        phase.set_ylabel("phase [deg]")
        for response, color, dash in zip(found, cycle(colours), cycle(dashes), strict=False):
            look: dict[str, Any] = {"color": color, "linestyle": dash, "linewidth": 1.4}
            _measured(gain, response, look)
            _measured(phase, response, look, phase=True)
            _coherence(coherence, response, **look)
            keys.append(key(f"{response.amplitude:.3g} rad", **look))
        for axes in grid[:, 0]:
            style.frequency_axis(axes, *_limits_hz(found))
        coherence.set_xlabel("frequency [Hz]")
        words = f"{measured_words(found[0].virtual)} (shaded: 95 %)"
        gain.set_title(f"{style.joint_words(found[0].joint)}, {words}")
        legend(figure, keys, 4)
    return figure


def ellipse(
    center: tuple[float, float], covariance: Array, squared: float = _CHI2_95, **look: Any
) -> Ellipse:
    """Return the ellipse {x : (x - center)^T covariance^-1 (x - center) = squared}, unfilled."""
    values, vectors = np.linalg.eigh(np.asarray(covariance, dtype=float))
    radii = np.sqrt(np.maximum(values, 0.0) * squared)
    angle = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
    return Ellipse(center, 2.0 * radii[1], 2.0 * radii[0], angle=angle, fill=False, **look)


def _mark(marker: str, color: str, size: float, **look: Any) -> dict[str, Any]:
    return {"marker": marker, "color": color, "markersize": size, "linestyle": "none", **look}


_HOLLOW = {"markerfacecolor": "none", "markeredgecolor": "white", "markeredgewidth": 1.3}
_MARKS = {
    "best of the grid": _mark("s", "white", 8.0, **_HOLLOW),
    "refined, with 95 % ellipse": _mark("o", "#56B4E9", 5.0, markeredgecolor="white", zorder=6),
    "gains of the real drive": _mark("x", style.NAIVE, 8.0, markeredgewidth=2.0, zorder=5),
    "paper, Table I": _mark("+", "white", 11.0, markeredgewidth=2.0, zorder=5),
}
"""Marks of the error maps."""


def error_maps(result: MatchResult, drive: Mapping[str, tuple[float, float]]) -> Figure:
    """Draw the gain error over the grid for every joint, with the optimum and known gains.

    `drive` has stiffness [N m/rad] and damping [N m s/rad] of the real drive by joint.
    """
    grids = {name: joint.grid for name, joint in result.joints.items() if joint.grid is not None}
    paper = TABLE_I if result.robot == ROBOT else {}
    errors = {name: np.sqrt(grid.error) for name, grid in grids.items()}
    low = max(min(float(np.nanmin(e)) for e in errors.values()), 0.05)
    high = max(float(np.nanmax(e)) for e in errors.values())
    norm, drawn = LogNorm(vmin=low, vmax=max(high, low * 1.01)), set()
    labels = ("stiffness [N m/rad]", "damping [N m s/rad]")
    with style.joint_panels(list(grids), *labels, height=2.35) as (figure, panels):
        for name, axes in panels.items():
            gains = result.joints[name].gains
            k = grids[name].stiffness
            d = grids[name].damping
            look: dict[str, Any] = {"cmap": "viridis", "shading": "nearest", "rasterized": True}
            image = axes.pcolormesh(k, d, errors[name].T, norm=norm, **look)
            axes.grid(False)
            axes.set(xlim=(k[0], k[-1]), ylim=(d[0], d[-1]))
            refined = (gains.stiffness.value, gains.damping.value)
            covariance = np.asarray(gains.covariance)
            if np.isfinite(covariance).all():
                axes.add_patch(ellipse(refined, covariance, edgecolor="white", zorder=4))
            points = (grids[name].gains, refined, drive.get(name), paper.get(name))
            for (words, mark), point in zip(_MARKS.items(), points, strict=True):
                if point is not None:
                    axes.plot(*point, **mark)
                    drawn.add(words)
        bar = figure.colorbar(image, ax=list(panels.values()), aspect=40, pad=0.01)
        bar.set_label("gain error in the band, RMS [dB]")
        bar.ax.yaxis.set_major_locator(LogLocator(base=10.0, subs=(1.0, 2.0, 5.0)))
        bar.ax.yaxis.set_major_formatter("{x:g}")
        bar.ax.yaxis.set_minor_locator(NullLocator())
        keys = [key(words, **mark) for words, mark in _MARKS.items() if words in drawn]
        legend(figure, keys, facecolor="#8a9a9a", frameon=True, edgecolor="none")
    return figure


def ranges(gains: MatchedGains, groups: Mapping[str, Sequence[str]]) -> Figure:
    """Draw the gains of the joints of each group, the training range and the ellipse."""
    paper, columns = TRAINING if gains.robot == ROBOT else {}, min(3, len(groups))
    rows = -(-len(groups) // columns)
    box: dict[str, Any] = {"facecolor": "#dbeaf4", "edgecolor": style.MATCHED}
    outline: dict[str, Any] = {"edgecolor": style.MATCHED, "linestyle": ":", "linewidth": 1.4}
    dashed: dict[str, Any] = {"fill": False, "edgecolor": style.PAPER, "linestyle": "--"}
    with drawing(rows, columns, height=3.4 * rows + 0.8) as (figure, grid):
        for axes in grid.flat[len(groups) :]:
            axes.set_visible(False)
        for axes, (name, joints) in zip(grid.flat, groups.items(), strict=False):
            group, shape = gains.groups[name], np.asarray(gains.groups[name].ellipsoid)
            half = (group.stiffness_range, group.damping_range)
            axes.add_patch(_box((group.stiffness, group.damping), half, **box))
            axes.plot(group.stiffness, group.damping, **_mark("+", style.MATCHED, 9))
            if np.isfinite(shape).all() and shape.any():
                axes.add_patch(ellipse(group.ellipsoid_center, shape, squared=1.0, **outline))
            if name in paper:
                axes.add_patch(_box(paper[name], RANGES, **dashed))
            for joint in joints:
                _draw_gains(axes, gains, joint)
            axes.autoscale_view()
            axes.margins(0.12)
            axes.set(title=style.joint_words(name), xlabel="stiffness [N m/rad]")
        for axes in grid[:, 0]:
            axes.set_ylabel("damping [N m s/rad]")
        legs = any(style.leg_of(joint) for joint in gains.joints)
        marks = style.LEG_MARKERS if legs else {"joint, 95 %": "o"}
        keys: list[Line2D | Patch] = [
            *(key(words, **_mark(marker, style.MEASURED, 5)) for words, marker in marks.items()),
            Patch(label="training range", **box),
            key("smallest ellipse", color=style.MATCHED, linestyle=":"),
        ]
        keys += [key("paper's range", color=style.PAPER, linestyle="--")] if paper else []
        legend(figure, keys, 7)
    return figure


def _box(center: Sequence[float], half: Sequence[float], **look: Any) -> Rectangle:
    corner = (center[0] - half[0], center[1] - half[1])
    return Rectangle(corner, 2.0 * half[0], 2.0 * half[1], **look)


def _draw_gains(axes: Axes, gains: MatchedGains, joint: str) -> None:
    """Mark the gains of one joint with their intervals, and name it if it is of no leg."""
    one, leg = gains.joints[joint], style.leg_of(joint)
    point = (one.stiffness.value, one.damping.value)
    ends = np.array([one.stiffness.repeat95, one.damping.repeat95])
    x_bar, y_bar = np.nan_to_num(np.abs(ends.T - point).T, nan=0.0, posinf=0.0)[..., None]
    look: dict[str, Any] = {"color": style.MEASURED, "markersize": 5, "elinewidth": 1.0}
    axes.errorbar(*point, y_bar, x_bar, fmt=style.LEG_MARKERS.get(leg, "o"), **look)
    if not leg:
        place: dict[str, Any] = {"textcoords": "offset points", "xytext": (7, 7)}
        axes.annotate(style.joint_words(joint), point, **place)


def busiest_window(prediction: JointPrediction, seconds: float) -> slice:
    """Return the window of this length in which the nominal simulation's error varies most."""
    rate = (len(prediction.time) - 1) / float(prediction.time[-1] - prediction.time[0])
    width = min(max(2, round(seconds * rate)), len(prediction.time))
    error = prediction.nominal - prediction.measured
    total, power = (np.concatenate(([0.0], np.cumsum(error**n))) for n in (1, 2))
    mean, square = ((one[width:] - one[:-width]) / width for one in (total, power))
    start = int(np.argmax(square - mean**2))
    return slice(start, start + width)


def prediction(found: JointPrediction, *, virtual: bool) -> Figure:
    """Draw the busiest 1.5 s of one joint: command, measured, simulated, and the errors."""
    window = busiest_window(found, 1.5)
    time, measured = found.time[window], found.measured[window]
    command: dict[str, Any] = {"color": style.COMMAND, "linewidth": 0.7}
    with drawing(2, height=4.8, sharex=True, height_ratios=[3.0, 1.4]) as (figure, grid):
        top, bottom = grid[:, 0]
        top.step(time, found.command[window], where="post", **command)
        top.plot(time, measured, **style.MEASURED_LINE)
        bottom.axhline(0.0, color="#666666", linewidth=0.8)
        for simulated, look in (
            (found.nominal, style.NAIVE_LINE),
            (found.matched, style.MATCHED_LINE),
        ):
            values = simulated[window]
            top.plot(time, values, **look)
            bottom.plot(time, values - measured, **look)
        top.set_ylabel(f"position [{found.unit}]")
        signal = "log" if found.signal == "unknown" else found.signal.replace("_", " ")
        top.set_title(f"{style.joint_words(found.joint)}: prediction of a {signal}")
        bottom.set(ylabel=f"error [{found.unit}]", xlabel="time [s]", xlim=(time[0], time[-1]))
        keys = [key("command", **command), key(measured_words(virtual), **style.MEASURED_LINE)]
        keys.append(key(f"nominal: RMSE {found.rmse_nominal:.4f}", **style.NAIVE_LINE))
        keys.append(key(f"matched: RMSE {found.rmse_matched:.4f}", **style.MATCHED_LINE))
        legend(figure, keys, 4)
    return figure
