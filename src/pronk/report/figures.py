"""Figures of responses, matches and predictions. Gains are in dB here alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse, Patch, Rectangle
from matplotlib.ticker import LogLocator, NullLocator
from numpy.typing import NDArray
from scipy import stats

from pronk.match.gains import MatchedGains
from pronk.match.prediction import JointPrediction
from pronk.match.result import JointFit, MatchResult
from pronk.report import style
from pronk.report.paper import published
from pronk.report.style import drawing, key, legend
from pronk.response.response import FrequencyResponse

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

_LOWEST_HZ = 0.1
_MIN_COHERENCE = 0.5
"""Measured points below are not drawn: they are mostly noise."""
_CHI2_95 = float(stats.chi2.ppf(0.95, 2))
"""Squared radius of the 95 % ellipse of a bivariate normal distribution."""


def measured_words(virtual: bool) -> str:
    """Return the name of the measured curve."""
    return "measured on the virtual robot" if virtual else "measured"


def _coherent(response: FrequencyResponse) -> NDArray[np.bool_]:
    coherent = (response.coherence >= _MIN_COHERENCE) & (response.frequency_hz > 0.0)
    return coherent if coherent.any() else response.frequency_hz > 0.0


def _limits_hz(responses: Sequence[FrequencyResponse]) -> tuple[float, float]:
    hz = np.concatenate([r.frequency_hz[_coherent(r)] for r in responses])
    return max(_LOWEST_HZ, float(hz.min())), float(hz.max())


def _gain_limits(joint: JointFit, margin: float = 2.0) -> tuple[float, float]:
    """Limits of an axis that holds the measured, matched and nominal gains [dB]."""
    response = joint.responses[0]
    curves = (response.gain, np.abs(joint.matched), np.abs(joint.naive))
    values = np.concatenate([style.decibel(curve[_coherent(response)]) for curve in curves])
    return float(max(np.nanmin(values), -60.0)) - margin, float(np.nanmax(values)) + margin


def _plot(
    axes: Axes,
    response: FrequencyResponse,
    curve: ComplexArray,
    *,
    phase: bool = False,
    **look: Any,
) -> None:
    """Draw gain [dB] or phase [deg] of a curve at the coherent frequencies of a response."""
    values = np.degrees(np.unwrap(np.angle(curve))) if phase else style.decibel(curve)
    axes.plot(response.frequency_hz, np.where(_coherent(response), values, np.nan), **look)


def _plot_measured(
    axes: Axes, response: FrequencyResponse, *, phase: bool = False, **look: Any
) -> None:
    """Draw the measured gain [dB] or phase [deg] with its 95 % interval."""
    scale = np.degrees if phase else style.decibel
    bounds = response.phase_interval() if phase else response.gain_interval()
    value = response.phase if phase else response.gain
    low, high, middle = (
        np.where(_coherent(response), scale(one), np.nan) for one in (*bounds, value)
    )
    look = look or style.MEASURED_LINE
    shade = 0.35 if look is style.MEASURED_LINE else 0.15
    axes.fill_between(
        response.frequency_hz, low, high, color=look["color"], alpha=shade, linewidth=0
    )
    axes.plot(response.frequency_hz, middle, **look)


def _plot_coherence(axes: Axes, response: FrequencyResponse, **look: Any) -> None:
    axes.plot(response.frequency_hz, response.coherence, **look)
    axes.axhline(0.95, color="#666666", linewidth=0.8, linestyle=":")
    axes.set_ylim(0.0, 1.05)
    axes.set_ylabel("coherence")


def _keys(virtual: bool, matched: str = "", naive: str = "") -> list[Line2D | Patch]:
    """Legend of a Bode plot; the texts are added to the names of the simulated curves."""
    return [
        key(f"{measured_words(virtual)} (shaded: 95 %)", **style.MEASURED_LINE),
        key(f"simulator, matched gains{matched}", **style.MATCHED_LINE),
        key(f"simulator, nominal gains{naive}", **style.NAIVE_LINE),
        Patch(facecolor=style.BAND, label="frequencies compared"),
    ]


def bode(joint: JointFit, *, title: str | None = None, coherence: bool = True) -> Figure:
    """Draw the Bode plot of one joint: measured with its 95 % interval, matched, nominal.

    Args:
        joint: Fit of the joint.
        title: Above the plot; the joint's name if None.
        coherence: Draw the coherence below.
    """
    response = joint.responses[0]
    ratios = [3.0, 2.0, 0.8] if coherence else [3.0, 2.0]
    height = 6.2 if coherence else 5.4
    with drawing(len(ratios), height=height, sharex=True, height_ratios=ratios) as (figure, grid):
        gain, phase = grid[:2, 0]
        for axes in grid[:, 0]:
            axes.axvspan(*joint.band_hz, color=style.BAND, zorder=0, linewidth=0)
            style.frequency_axis(axes, *_limits_hz([response]))
        for axes, is_phase in ((gain, False), (phase, True)):
            _plot_measured(axes, response, phase=is_phase)
            _plot(axes, response, joint.naive, phase=is_phase, **style.NAIVE_LINE)
            _plot(axes, response, joint.matched, phase=is_phase, **style.MATCHED_LINE)
        gain.set_ylim(*_gain_limits(joint))
        gain.set_ylabel("gain [dB]")
        gain.set_title(title or style.joint_words(joint.joint))
        low, high = phase.get_ylim()
        phase.set_ylim(max(low, -720.0), min(high, 90.0))
        phase.set_ylabel("phase [deg]")
        if joint.grid_error.size:
            # Reading F9: the paper discards the phase, because the links' delay is in it.
            note = "not compared: contains the delay of command and measurement"
            phase.text(0.01, 0.06, note, transform=phase.transAxes, fontsize=8.5, color="#333333")
        if coherence:
            _plot_coherence(grid[2, 0], response, color=style.MEASURED, linewidth=1.0)
        grid[-1, 0].set_xlabel("frequency [Hz]")
        errors = (f": error {db:.2f} dB" for db in (joint.error_db, joint.naive_error_db))
        legend(figure, _keys(response.virtual, *errors), 2)
    return figure


def knees_first(names: Sequence[str]) -> list[str]:
    """Sort joint names, those of knees first: rotor inertia and mismatch are largest there."""
    return sorted(names, key=lambda name: not name.endswith("knee"))


def hero(result: MatchResult) -> Figure:
    """Draw the Bode plot of one joint, a knee where there is one, without coherence."""
    fit = result.joints[knees_first(list(result.joints))[0]]
    where = "the virtual robot" if fit.responses[0].virtual else "the robot"
    title = (
        f"{style.joint_words(fit.joint)} of {where} ({result.gains.robot.replace('_', ' ')}): "
        f"matched at {fit.stiffness:.1f} N m/rad, {fit.damping:.3f} N m s/rad"
    )
    return bode(fit, title=title, coherence=False)


def overview(fits: Mapping[str, JointFit]) -> Figure:
    """Draw the gain of every joint; rows are joint groups, columns are legs."""
    labels: dict[str, Any] = {"x_label": "frequency [Hz]", "y_label": "gain [dB]"}
    with style.joint_panels(list(fits), height=2.0, sharey="row", **labels) as (figure, panels):
        low, high = np.array([_gain_limits(fit) for fit in fits.values()]).T
        for name, axes in panels.items():
            fit, response = fits[name], fits[name].responses[0]
            axes.axvspan(*fit.band_hz, color=style.BAND, zorder=0, linewidth=0)
            style.frequency_axis(axes, *_limits_hz([response]))
            _plot_measured(axes, response)
            _plot(axes, response, fit.naive, **style.NAIVE_LINE)
            _plot(axes, response, fit.matched, **style.MATCHED_LINE)
            axes.text(
                *(0.03, 0.05, f"{fit.naive_error_db:.2f} → {fit.error_db:.2f} dB"),
                transform=axes.transAxes,
                fontsize=8.5,
                color="#333333",
            )
            axes.set_ylim(max(low.min(), -45.0) - 8.0, high.max())
        legend(figure, _keys(any(fit.responses[0].virtual for fit in fits.values())), 4)
    return figure


def zero_armature(joint: JointFit) -> Figure:
    """Draw the gain of one joint with the best match without rotor inertia (paper Fig. 3).

    Raises:
        ValueError: The match did not search with zero armature on this joint.
    """
    if joint.zero_armature is None:
        raise ValueError(f"{joint.joint} was not matched with zero armature")
    response = joint.responses[0]
    with drawing(height=3.9) as (figure, grid):
        axes = grid[0, 0]
        axes.axvspan(*joint.band_hz, color=style.BAND, zorder=0, linewidth=0)
        style.frequency_axis(axes, *_limits_hz([response]))
        _plot_measured(axes, response)
        _plot(axes, response, joint.zero_armature, **style.ZERO_LINE)
        _plot(axes, response, joint.matched, **style.MATCHED_LINE)
        axes.set_ylim(*_gain_limits(joint, margin=8.0))
        axes.set_ylabel("gain [dB]")
        axes.set_xlabel("frequency [Hz]")
        axes.set_title(f"{style.joint_words(joint.joint)}: with and without rotor inertia")
        best = f"best without rotor inertia: error {joint.zero_armature_error_db:.2f} dB"
        keys = _keys(response.virtual, f": error {joint.error_db:.2f} dB")
        legend(figure, [*keys[:2], key(best, **style.ZERO_LINE)])
    return figure


def responses(found: Sequence[FrequencyResponse]) -> Figure:
    """Draw the Bode plot of one joint as measured, one curve per amplitude."""
    colours = (style.MEASURED, style.MATCHED, style.NAIVE, style.ZERO_ARMATURE)
    dashes = ("-", (0, (5, 2)), (0, (6, 2, 1, 2)), ":")
    first, keys, gains = found[0], [], []
    options: dict[str, Any] = {"sharex": True, "height_ratios": [3.0, 2.0, 1.0]}
    with drawing(3, height=6.2, **options) as (figure, grid):
        gain, phase, coherence = grid[:, 0]
        for i, response in enumerate(found):
            look: dict[str, Any] = {
                "color": colours[i % 4],
                "linestyle": dashes[i % 4],
                "linewidth": 1.4,
            }
            _plot_measured(gain, response, **look)
            _plot_measured(phase, response, phase=True, **look)
            _plot_coherence(coherence, response, **look)
            keys.append(key(f"{response.amplitude:.3g} rad", **look))
            gains.append(style.decibel(response.gain[_coherent(response)]))
        for axes in grid[:, 0]:
            style.frequency_axis(axes, *_limits_hz(found))
        values = np.concatenate(gains)
        if np.isfinite(values).any():
            gain.set_ylim(max(np.nanmin(values), -60.0) - 2.0, np.nanmax(values) + 2.0)
        gain.set_ylabel("gain [dB]")
        phase.set_ylabel("phase [deg]")
        coherence.set_xlabel("frequency [Hz]")
        words = measured_words(first.virtual)
        gain.set_title(f"{style.joint_words(first.joint)}, {words} (shaded: 95 %)")
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
_BEST = _mark("s", "white", 8.0, **_HOLLOW)
_REFINED = _mark("o", "#56B4E9", 5.0, markeredgecolor="white", zorder=6)
_DRIVE = _mark("x", style.NAIVE, 8.0, markeredgewidth=2.0, zorder=5)
_PAPER = _mark("+", "white", 11.0, markeredgewidth=2.0, zorder=5)


def error_maps(
    result: MatchResult, drive: Mapping[str, tuple[float, float]] | None = None
) -> Figure:
    """Draw the gain error over the grid for every joint, with the optimum and known gains.

    Args:
        result: Of the match.
        drive: Stiffness [N m/rad] and damping [N m s/rad] of the real drive by joint.
    """
    fits = {name: joint for name, joint in result.joints.items() if joint.grid_error.size}
    paper, drive = published(result.gains.robot), drive or {}
    errors = {name: np.sqrt(fit.grid_error) for name, fit in fits.items()}
    low = max(min(float(np.nanmin(e)) for e in errors.values()), 0.05)
    high = max(float(np.nanmax(e)) for e in errors.values())
    norm = LogNorm(vmin=low, vmax=max(high, low * 1.01))
    labels: dict[str, Any] = {"x_label": "stiffness [N m/rad]", "y_label": "damping [N m s/rad]"}
    with style.joint_panels(list(fits), height=2.35, **labels) as (figure, panels):
        for name, axes in panels.items():
            fit, k, d = fits[name], fits[name].grid_stiffness, fits[name].grid_damping
            look: dict[str, Any] = {"cmap": "viridis", "shading": "nearest", "rasterized": True}
            image = axes.pcolormesh(k, d, errors[name].T, norm=norm, **look)
            axes.grid(False)
            axes.set(xlim=(k[0], k[-1]), ylim=(d[0], d[-1]))
            i, j = np.unravel_index(int(np.nanargmin(fit.grid_error)), fit.grid_error.shape)
            axes.plot(k[i], d[j], **_BEST)
            if np.isfinite(fit.covariance).all():
                where = (fit.stiffness, fit.damping)
                axes.add_patch(ellipse(where, fit.covariance, edgecolor="white", zorder=4))
            axes.plot(fit.stiffness, fit.damping, **_REFINED)
            if name in drive:
                axes.plot(*drive[name], **_DRIVE)
            if paper is not None and name in paper.joints:
                axes.plot(*paper.joints[name], **_PAPER)
        bar = figure.colorbar(image, ax=list(panels.values()), aspect=40, pad=0.01)
        bar.set_label("gain error in the band, RMS [dB]")
        bar.ax.yaxis.set_major_locator(LogLocator(base=10.0, subs=(1.0, 2.0, 5.0)))
        bar.ax.yaxis.set_major_formatter("{x:g}")
        bar.ax.yaxis.set_minor_locator(NullLocator())
        keys = [key("best of the grid", **_BEST), key("refined, with 95 % ellipse", **_REFINED)]
        keys += [key("gains of the real drive", **_DRIVE)] if drive else []
        keys += [key("paper, Table I", **_PAPER)] if paper is not None else []
        legend(figure, keys, facecolor="#8a9a9a", frameon=True, edgecolor="none")
    return figure


def ranges(gains: MatchedGains, groups: Mapping[str, Sequence[str]]) -> Figure:
    """Draw the gains of the joints of each group, the training range and the ellipse.

    Args:
        gains: Of the match.
        groups: Names of the joints of each group.
    """
    paper = published(gains.robot)
    columns = min(3, len(groups))
    rows = -(-len(groups) // columns)
    with drawing(rows, columns, height=3.4 * rows + 0.8) as (figure, grid):
        for axes in grid.flat[len(groups) :]:
            axes.set_visible(False)
        for axes, (name, joints) in zip(grid.flat, groups.items(), strict=False):
            _draw_group(axes, gains, name, joints)
            if paper is not None and name in paper.training:
                half = (paper.stiffness_range, paper.damping_range)
                look = {"fill": False, "edgecolor": style.PAPER, "linestyle": "--"}
                _draw_box(axes, paper.training[name], half, **look)
            axes.autoscale_view()
            axes.margins(0.12)
            axes.set_title(style.joint_words(name))
            axes.set_xlabel("stiffness [N m/rad]")
        for axes in grid[:, 0]:
            axes.set_ylabel("damping [N m s/rad]")
        legs = any(style.leg_of(joint) for joint in gains.joints)
        marks = style.LEG_MARKERS if legs else {"joint, 95 %": "o"}
        keys: list[Line2D | Patch] = [
            key(label, **_mark(marker, style.MEASURED, 5)) for label, marker in marks.items()
        ]
        keys.append(Patch(facecolor="#dbeaf4", edgecolor=style.MATCHED, label="training range"))
        keys.append(key("smallest ellipse", color=style.MATCHED, linestyle=":"))
        if paper is not None:
            keys.append(key("paper's range", color=style.PAPER, linestyle="--"))
        legend(figure, keys, 7)
    return figure


def _draw_box(axes: Axes, center: Sequence[float], half: Sequence[float], **look: Any) -> None:
    corner = (center[0] - half[0], center[1] - half[1])
    axes.add_patch(Rectangle(corner, 2.0 * half[0], 2.0 * half[1], **look))


def _draw_group(axes: Axes, gains: MatchedGains, name: str, joints: Sequence[str]) -> None:
    group = gains.groups[name]
    center, half = (group.stiffness, group.damping), (group.stiffness_range, group.damping_range)
    _draw_box(axes, center, half, facecolor="#dbeaf4", edgecolor=style.MATCHED)
    axes.plot(*center, **_mark("+", style.MATCHED, 9))
    shape = np.asarray(group.ellipsoid)
    if np.isfinite(shape).all() and shape.any():
        look = {"edgecolor": style.MATCHED, "linestyle": ":", "linewidth": 1.4}
        axes.add_patch(ellipse(group.ellipsoid_center, shape, squared=1.0, **look))
    for joint in joints:
        one, leg = gains.joints[joint], style.leg_of(joint)
        axes.errorbar(
            *(one.stiffness, one.damping),
            xerr=_error_bar(one.stiffness, one.stiffness_ci95),
            yerr=_error_bar(one.damping, one.damping_ci95),
            fmt=style.LEG_MARKERS.get(leg, "o"),
            color=style.MEASURED,
            markersize=5,
            elinewidth=1.0,
        )
        if len(joints) > 1 and not leg:
            place: dict[str, Any] = {"textcoords": "offset points", "xytext": (7, 7)}
            axes.annotate(style.joint_words(joint), (one.stiffness, one.damping), **place)


def _error_bar(value: float, interval: tuple[float, float]) -> list[list[float]]:
    """Lengths below and above the value; 0 where the interval is unknown."""
    lengths = (value - interval[0], interval[1] - value)
    return [[max(length, 0.0) if np.isfinite(length) else 0.0] for length in lengths]


def busiest_window(prediction: JointPrediction, seconds: float) -> slice:
    """Return the window of this length in which the nominal simulation's error varies most."""
    rate = (len(prediction.time) - 1) / float(prediction.time[-1] - prediction.time[0])
    width = min(max(2, round(seconds * rate)), len(prediction.time))
    error = prediction.naive - prediction.measured
    total, power = (np.concatenate(([0.0], np.cumsum(error**n))) for n in (1, 2))
    mean, square = ((one[width:] - one[:-width]) / width for one in (total, power))
    start = int(np.argmax(square - mean**2))
    return slice(start, start + width)


def prediction(found: JointPrediction, *, virtual: bool, seconds: float = 1.5) -> Figure:
    """Draw one joint over time: command, measured, simulated, and the errors below.

    Args:
        found: Of the joint.
        virtual: The measured curve is the virtual robot's.
        seconds: Length of the part that is drawn, by `busiest_window` [s].
    """
    window = busiest_window(found, seconds)
    time, measured = found.time[window], found.measured[window]
    simulated = (
        (found.naive[window], style.NAIVE_LINE),
        (found.matched[window], style.MATCHED_LINE),
    )
    command: dict[str, Any] = {"color": style.COMMAND, "linewidth": 0.7}
    with drawing(2, height=4.8, sharex=True, height_ratios=[3.0, 1.4]) as (figure, grid):
        top, bottom = grid[:, 0]
        top.step(time, found.command[window], where="post", **command)
        top.plot(time, measured, **style.MEASURED_LINE)
        bottom.axhline(0.0, color="#666666", linewidth=0.8)
        for values, look in simulated:
            top.plot(time, values, **look)
            bottom.plot(time, values - measured, **look)
        top.set_ylabel(f"position [{found.unit}]")
        signal = "log" if found.signal == "unknown" else found.signal.replace("_", " ")
        top.set_title(f"{style.joint_words(found.joint)}: prediction of a {signal}")
        bottom.set(ylabel=f"error [{found.unit}]", xlabel="time [s]", xlim=(time[0], time[-1]))
        keys = [
            key("command", **command),
            key(measured_words(virtual), **style.MEASURED_LINE),
            key(f"nominal: RMSE {found.rmse_naive:.4f}", **style.NAIVE_LINE),
            key(f"matched: RMSE {found.rmse_matched:.4f}", **style.MATCHED_LINE),
        ]
        legend(figure, keys, 4)
    return figure
