"""Figures of responses, matches and predictions. Gains are in dB here alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse, Patch, Rectangle
from matplotlib.ticker import LogLocator, NullLocator
from scipy import special

from pronk.arrays import Array, ComplexArray
from pronk.identify.match.compared import ComparedResponses
from pronk.identify.match.gains import MatchedGains
from pronk.identify.match.plot import coherent_frequencies, decibel
from pronk.identify.match.predict import JointPrediction
from pronk.identify.match.result import JointResult, MatchResult
from pronk.identify.response.response import FrequencyResponse
from pronk.report import style
from pronk.report.paper import RANGES, ROBOT, TABLE_I, TRAINING
from pronk.report.style import Look, drawing, key, legend

_LOWEST_HZ = 0.1
"""Lowest frequency that is drawn [Hz]."""
_CHI2_95 = float(special.chdtri(2, 1.0 - 0.95))
"""Squared radius of the 95 % ellipse of a bivariate normal distribution."""
_AMPLITUDE_COLOURS = (style.MEASURED, style.MATCHED, style.NAIVE, style.ZERO_ARMATURE)
_AMPLITUDE_DASHES = ("-", (0, (5, 2)), (0, (6, 2, 1, 2)), ":")
"""Looks of the curves of several amplitudes, in turn."""
_PREDICTED_S = 1.5
"""Length of the part of a prediction that is drawn [s]."""


@dataclass(frozen=True, kw_only=True)
class Curve:
    """A simulated response and its look."""

    response: ComplexArray
    """Values at the frequencies of the measured response, shape (f,)."""
    look: Look


def measured_words(virtual: bool) -> str:
    """Return the name of the measured curve."""
    return "measured on the virtual robot" if virtual else "measured"


def knees_first(names: Sequence[str]) -> list[str]:
    """Sort joint names, those of knees first: rotor inertia and mismatch are largest there."""
    return sorted(names, key=lambda name: not name.endswith("knee"))


def compared_responses(joint: JointResult) -> ComparedResponses:
    """Return the responses of a joint that has some.

    Raises:
        ValueError: No response of the joint was estimated.
    """
    if joint.responses is None:
        raise ValueError(f"{joint.joint} has no response to draw")
    return joint.responses


def _frequency_limits_hz(responses: Sequence[FrequencyResponse]) -> tuple[float, float]:
    """Return the lowest and the highest frequency that is drawn of some responses [Hz]."""
    drawn_hz = [response.frequency_hz[coherent_frequencies(response)] for response in responses]
    frequencies_hz = np.concatenate(drawn_hz)
    return max(_LOWEST_HZ, float(frequencies_hz.min())), float(frequencies_hz.max())


def _draw_measured(
    axes: Axes, response: FrequencyResponse, look: Look, *, shade: float, phase: bool
) -> None:
    """Draw the measured gain [dB] or phase [deg], and its 95 % interval shaded."""
    drawn = coherent_frequencies(response)
    if phase:
        lower, upper = np.degrees(response.phase_interval())
        middle = np.degrees(response.phase)
    else:
        lower, upper = decibel(np.array(response.gain_interval()))
        middle = decibel(response.gain)
    axes.fill_between(
        response.frequency_hz,
        np.where(drawn, lower, np.nan),
        np.where(drawn, upper, np.nan),
        color=look["color"],
        alpha=shade,
        linewidth=0,
    )
    axes.plot(response.frequency_hz, np.where(drawn, middle, np.nan), **look)


def _draw_panel(
    axes: Axes, responses: ComparedResponses, curves: Sequence[Curve], *, phase: bool = False
) -> None:
    """Draw measured and simulated gain [dB] or phase [deg], the compared band tinted."""
    measured = responses.measured[0]
    axes.axvspan(*responses.band_hz, color=style.BAND, zorder=0, linewidth=0)
    style.frequency_axis(axes, *_frequency_limits_hz([measured]))
    _draw_measured(axes, measured, style.MEASURED_LINE, shade=0.35, phase=phase)
    drawn = coherent_frequencies(measured)
    for curve in curves:
        if phase:
            values = np.degrees(np.unwrap(np.angle(curve.response)))
        else:
            values = decibel(curve.response)
        axes.plot(measured.frequency_hz, np.where(drawn, values, np.nan), **curve.look)


def _draw_coherence(axes: Axes, response: FrequencyResponse, look: Look) -> None:
    """Draw the coherence over frequency, with the usual limit of 0.95."""
    axes.plot(response.frequency_hz, response.coherence, **look)
    axes.axhline(0.95, color="#666666", linewidth=0.8, linestyle=":")
    axes.set(ylim=(0.0, 1.05), ylabel="coherence")


def _simulated_curves(responses: ComparedResponses) -> list[Curve]:
    """Return the responses with nominal and with matched gains."""
    return [
        Curve(response=responses.nominal, look=style.NAIVE_LINE),
        Curve(response=responses.matched, look=style.MATCHED_LINE),
    ]


def _response_keys(virtual: bool, matched: str = "", nominal: str = "") -> list[Line2D | Patch]:
    """Return the legend of a Bode plot; texts are added to the names of the simulated curves."""
    return [
        key(f"{measured_words(virtual)} (shaded: 95 %)", **style.MEASURED_LINE),
        key(f"simulator, matched gains{matched}", **style.MATCHED_LINE),
        key(f"simulator, nominal gains{nominal}", **style.NAIVE_LINE),
        Patch(facecolor=style.BAND, label="frequencies compared"),
    ]


def bode(joint: JointResult, *, title: str | None = None, coherence: bool = True) -> Figure:
    """Draw the Bode plot of one joint: measured with its 95 % interval, matched, nominal.

    Args:
        joint: The joint, with responses.
        title: Title of the figure; the joint's name if None.
        coherence: Whether the coherence is drawn below.
    """
    responses = compared_responses(joint)
    curves = _simulated_curves(responses)
    ratios = [3.0, 2.0, 0.8] if coherence else [3.0, 2.0]
    height = 1.0 + sum(ratios)
    with drawing(
        len(ratios), height=height, sharex=True, height_ratios=ratios, fixed_margins=True
    ) as (figure, grid):
        gain_axes = grid[0, 0]
        phase_axes = grid[1, 0]
        gain_axes.set_ylabel("gain [dB]")
        phase_axes.set_ylabel("phase [deg]")
        _draw_panel(gain_axes, responses, curves)
        _draw_panel(phase_axes, responses, curves, phase=True)
        gain_axes.set_title(title or style.joint_words(joint.joint))
        if joint.grid is not None:
            # The paper discards the phase (reading F9), because the links' delay is in it.
            phase_axes.text(
                0.01,
                0.06,
                "not compared: contains the delay of command and measurement",
                transform=phase_axes.transAxes,
                fontsize=8.5,
                color="#333333",
            )
        if coherence:
            look: Look = {"color": style.MEASURED, "linewidth": 1.0}
            _draw_coherence(grid[2, 0], responses.measured[0], look)
        grid[-1, 0].set_xlabel("frequency [Hz]")
        keys = _response_keys(
            responses.measured[0].virtual,
            matched=f": error {responses.error_db:.2f} dB",
            nominal=f": error {responses.nominal_error_db:.2f} dB",
        )
        legend(figure, keys, 2)
    return figure


def hero(result: MatchResult) -> Figure:
    """Draw the Bode plot of one joint, a knee where there is one, without coherence."""
    joint = result.joints[knees_first(list(result.joints))[0]]
    robot = "the virtual robot" if result.virtual else "the robot"
    title = (
        f"{style.joint_words(joint.joint)} of {robot} ({style.joint_words(result.robot)}): "
        f"matched at {joint.gains.stiffness.value:.1f} N m/rad, "
        f"{joint.gains.damping.value:.3f} N m s/rad"
    )
    return bode(joint, title=title, coherence=False)


def overview(joints: Mapping[str, JointResult]) -> Figure:
    """Draw the gain of every joint; rows are joint groups, columns are legs."""
    virtual = False
    with style.joint_panels(
        list(joints), "frequency [Hz]", "gain [dB]", height=2.0, sharey="row"
    ) as (figure, panels):
        for name, axes in panels.items():
            responses = compared_responses(joints[name])
            virtual = virtual or responses.measured[0].virtual
            _draw_panel(axes, responses, _simulated_curves(responses))
            axes.margins(y=0.2)
            axes.text(
                0.03,
                0.05,
                f"{responses.nominal_error_db:.2f} → {responses.error_db:.2f} dB",
                transform=axes.transAxes,
                fontsize=8.5,
                color="#333333",
            )
        legend(figure, _response_keys(virtual), 4)
    return figure


def zero_armature(joint: JointResult) -> Figure:
    """Draw the gain of one joint with the best match without rotor inertia (paper Fig. 3).

    Raises:
        ValueError: The joint was not searched without rotor inertia.
    """
    if joint.zero_armature is None:
        raise ValueError(f"{joint.joint} was not searched without rotor inertia")
    responses = compared_responses(joint)
    curves = [
        Curve(response=joint.zero_armature.response, look=style.ZERO_LINE),
        Curve(response=responses.matched, look=style.MATCHED_LINE),
    ]
    with drawing(height=3.9) as (figure, grid):
        axes = grid[0, 0]
        _draw_panel(axes, responses, curves)
        # An antiresonance would leave the rest of the curves no room.
        lowest_db = decibel(responses.matched).min() - 20.0
        axes.set(xlabel="frequency [Hz]", ylabel="gain [dB]")
        axes.set_ylim(max(lowest_db, axes.get_ylim()[0]), None)
        axes.set_title(f"{style.joint_words(joint.joint)}: with and without rotor inertia")
        keys = _response_keys(
            responses.measured[0].virtual, matched=f": error {responses.error_db:.2f} dB"
        )
        label = f"best without rotor inertia: error {joint.zero_armature.error_db:.2f} dB"
        legend(figure, [*keys[:2], key(label, **style.ZERO_LINE)])
    return figure


def measured_responses(responses: Sequence[FrequencyResponse]) -> Figure:
    """Draw the Bode plot of one joint as measured, one curve for each amplitude."""
    keys = []
    with drawing(3, height=6.2, sharex=True, height_ratios=[3.0, 2.0, 1.0]) as (figure, grid):
        gain_axes, phase_axes, coherence_axes = grid[:, 0]
        gain_axes.set_ylabel("gain [dB]")
        phase_axes.set_ylabel("phase [deg]")
        for number, response in enumerate(responses):
            look: Look = {
                "color": _AMPLITUDE_COLOURS[number % len(_AMPLITUDE_COLOURS)],
                "linestyle": _AMPLITUDE_DASHES[number % len(_AMPLITUDE_DASHES)],
                "linewidth": 1.4,
            }
            _draw_measured(gain_axes, response, look, shade=0.15, phase=False)
            _draw_measured(phase_axes, response, look, shade=0.15, phase=True)
            _draw_coherence(coherence_axes, response, look)
            keys.append(key(f"{response.amplitude:.3g} rad", **look))
        for axes in grid[:, 0]:
            style.frequency_axis(axes, *_frequency_limits_hz(responses))
        coherence_axes.set_xlabel("frequency [Hz]")
        joint = style.joint_words(responses[0].joint)
        gain_axes.set_title(f"{joint}, {measured_words(responses[0].virtual)} (shaded: 95 %)")
        legend(figure, keys, 4)
    return figure


# ---- gains ----


def ellipse(
    center: tuple[float, float],
    shape: Array,
    *,
    squared_radius: float = _CHI2_95,
    edgecolor: str,
    linestyle: str = "-",
) -> Ellipse:
    """Return an ellipse that is not filled.

    Args:
        center: Its centre c.
        shape: Its matrix E, shape (2, 2), for instance a covariance.
        squared_radius: The number r in (x - c)^T E^-1 (x - c) = r.
        edgecolor: Colour of the line.
        linestyle: Dashes of the line.
    """
    values, vectors = np.linalg.eigh(np.asarray(shape, dtype=float))
    radii = np.sqrt(np.maximum(values, 0.0) * squared_radius)
    angle_deg = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
    return Ellipse(
        center,
        2.0 * radii[1],
        2.0 * radii[0],
        angle=angle_deg,
        fill=False,
        edgecolor=edgecolor,
        linestyle=linestyle,
        linewidth=1.4,
        zorder=4,
    )


_GRID_MARK: Look = {
    "marker": "s",
    "color": "white",
    "markersize": 8.0,
    "linestyle": "none",
    "markerfacecolor": "none",
    "markeredgecolor": "white",
    "markeredgewidth": 1.3,
}
_REFINED_MARK: Look = {
    "marker": "o",
    "color": "#56B4E9",
    "markersize": 5.0,
    "linestyle": "none",
    "markeredgecolor": "white",
    "zorder": 6,
}
_DRIVE_MARK: Look = {
    "marker": "x",
    "color": style.NAIVE,
    "markersize": 8.0,
    "linestyle": "none",
    "markeredgewidth": 2.0,
    "zorder": 5,
}
_PAPER_MARK: Look = {
    "marker": "+",
    "color": "white",
    "markersize": 11.0,
    "linestyle": "none",
    "markeredgewidth": 2.0,
    "zorder": 5,
}


def error_maps(result: MatchResult, drive_gains: Mapping[str, tuple[float, float]]) -> Figure:
    """Draw the gain error over the grid for every joint, with the optimum and known gains.

    Args:
        result: A match with grids.
        drive_gains: Stiffness [N m/rad] and damping [N m s/rad] of the real drive by joint.
    """
    grids = {}
    errors_db = {}
    for name, joint in result.joints.items():
        if joint.grid is not None:
            grids[name] = joint.grid
            errors_db[name] = np.sqrt(joint.grid.error)
    all_errors_db = np.concatenate([error_db.ravel() for error_db in errors_db.values()])
    lowest_db = max(float(np.nanmin(all_errors_db)), 0.05)
    highest_db = max(float(np.nanmax(all_errors_db)), 1.01 * lowest_db)
    norm = LogNorm(vmin=lowest_db, vmax=highest_db)
    published = TABLE_I if result.robot == ROBOT else {}
    keys = [
        key("best of the grid", **_GRID_MARK),
        key("refined, with 95 % ellipse", **_REFINED_MARK),
    ]
    if any(name in drive_gains for name in grids):
        keys.append(key("gains of the real drive", **_DRIVE_MARK))
    if any(name in published for name in grids):
        keys.append(key("paper, Table I", **_PAPER_MARK))
    with style.joint_panels(
        list(grids), "stiffness [N m/rad]", "damping [N m s/rad]", height=2.35
    ) as (figure, panels):
        for name, axes in panels.items():
            grid = grids[name]
            image = axes.pcolormesh(
                grid.stiffness,
                grid.damping,
                errors_db[name].T,
                norm=norm,
                cmap="viridis",
                shading="nearest",
                rasterized=True,
            )
            axes.grid(False)
            axes.set_xlim(grid.stiffness[0], grid.stiffness[-1])
            axes.set_ylim(grid.damping[0], grid.damping[-1])
            gains = result.joints[name].gains
            refined = (gains.stiffness.value, gains.damping.value)
            covariance = np.asarray(gains.covariance)
            if np.isfinite(covariance).all():
                axes.add_patch(ellipse(refined, covariance, edgecolor="white"))
            axes.plot(*grid.gains, **_GRID_MARK)
            axes.plot(*refined, **_REFINED_MARK)
            if name in drive_gains:
                axes.plot(*drive_gains[name], **_DRIVE_MARK)
            if name in published:
                axes.plot(*published[name], **_PAPER_MARK)
        bar = figure.colorbar(image, ax=list(panels.values()), aspect=40, pad=0.01)
        bar.set_label("gain error in the band, RMS [dB]")
        bar.ax.yaxis.set_major_locator(LogLocator(base=10.0, subs=(1.0, 2.0, 5.0)))
        bar.ax.yaxis.set_major_formatter("{x:g}")
        bar.ax.yaxis.set_minor_locator(NullLocator())
        legend(figure, keys, facecolor="#8a9a9a")
    return figure


def ranges(gains: MatchedGains, groups: Mapping[str, Sequence[str]]) -> Figure:
    """Draw the gains of the joints of each group, the training range and the ellipse.

    Args:
        gains: Matched gains.
        groups: Names of the joints of each group.
    """
    published = TRAINING if gains.robot == ROBOT else {}
    columns = min(3, len(groups))
    rows = -(-len(groups) // columns)
    with drawing(rows, columns, height=3.4 * rows + 0.8) as (figure, grid):
        for axes in grid.flat[len(groups) :]:
            axes.set_visible(False)
        for axes, (name, joints) in zip(grid.flat, groups.items(), strict=False):
            _draw_range(axes, gains, name, published.get(name))
            for joint in joints:
                _draw_joint_gains(axes, gains, joint)
            axes.autoscale_view()
            axes.margins(0.12)
            axes.set(title=style.joint_words(name), xlabel="stiffness [N m/rad]")
        for axes in grid[:, 0]:
            axes.set_ylabel("damping [N m s/rad]")
        legend(figure, _range_keys(gains, bool(published)), 7)
    return figure


def _draw_range(
    axes: Axes, gains: MatchedGains, name: str, published: tuple[float, float] | None
) -> None:
    """Draw the box that training draws from, the smallest ellipse, and the paper's box."""
    group = gains.groups[name]
    center = (group.stiffness, group.damping)
    half_widths = (group.stiffness_range, group.damping_range)
    axes.add_patch(_box(center, half_widths, facecolor="#dbeaf4", edgecolor=style.MATCHED))
    axes.plot(*center, marker="+", color=style.MATCHED, markersize=9, linestyle="none")
    shape = np.asarray(group.ellipsoid)
    if np.isfinite(shape).all() and shape.any():
        outline = ellipse(
            group.ellipsoid_center,
            shape,
            squared_radius=1.0,
            edgecolor=style.MATCHED,
            linestyle=":",
        )
        axes.add_patch(outline)
    if published is not None:
        axes.add_patch(_box(published, RANGES, edgecolor=style.PAPER, linestyle="--"))


def _range_keys(gains: MatchedGains, published: bool) -> list[Line2D | Patch]:
    """Return the legend of the training ranges."""
    markers = {}
    for joint in gains.joints:
        leg = style.leg_of(joint)
        if leg:
            markers[leg] = style.leg_marker(leg)
    if not markers:
        markers = {"joint, 95 %": "o"}
    keys: list[Line2D | Patch] = []
    for label, marker in markers.items():
        entry = key(label, marker=marker, color=style.MEASURED, markersize=5, linestyle="none")
        keys.append(entry)
    keys.append(Patch(label="training range", facecolor="#dbeaf4", edgecolor=style.MATCHED))
    keys.append(key("smallest ellipse", color=style.MATCHED, linestyle=":"))
    if published:
        keys.append(key("paper's range", color=style.PAPER, linestyle="--"))
    return keys


def _box(
    center: tuple[float, float],
    half_widths: tuple[float, float],
    *,
    edgecolor: str,
    facecolor: str = "none",
    linestyle: str = "-",
) -> Rectangle:
    """Return a rectangle about a point."""
    corner = (center[0] - half_widths[0], center[1] - half_widths[1])
    return Rectangle(
        corner,
        2.0 * half_widths[0],
        2.0 * half_widths[1],
        edgecolor=edgecolor,
        facecolor=facecolor,
        linestyle=linestyle,
    )


def _draw_joint_gains(axes: Axes, gains: MatchedGains, joint: str) -> None:
    """Mark the gains of one joint with their intervals, and name it if it is of no leg."""
    joint_gains = gains.joints[joint]
    point = (joint_gains.stiffness.value, joint_gains.damping.value)
    bars = []
    for fitted in (joint_gains.stiffness, joint_gains.damping):
        lower, upper = fitted.repeat95
        bar = np.array([[fitted.value - lower], [upper - fitted.value]])
        bars.append(np.nan_to_num(np.abs(bar), nan=0.0, posinf=0.0))
    leg = style.leg_of(joint)
    axes.errorbar(
        *point,
        xerr=bars[0],
        yerr=bars[1],
        fmt=style.leg_marker(leg),
        color=style.MEASURED,
        markersize=5,
        elinewidth=1.0,
    )
    if not leg:
        axes.annotate(style.joint_words(joint), point, textcoords="offset points", xytext=(7, 7))


# ---- predictions ----


def busiest_window(prediction: JointPrediction, seconds: float) -> slice:
    """Return the samples of this length in which the nominal simulation's error varies most."""
    time = prediction.time
    rate_hz = (len(time) - 1) / float(time[-1] - time[0])
    width = min(max(2, round(seconds * rate_hz)), len(time))
    error = prediction.nominal - prediction.measured
    sums = np.concatenate(([0.0], np.cumsum(error)))
    square_sums = np.concatenate(([0.0], np.cumsum(error**2)))
    means = (sums[width:] - sums[:-width]) / width
    mean_squares = (square_sums[width:] - square_sums[:-width]) / width
    start = int(np.argmax(mean_squares - means**2))
    return slice(start, start + width)


def prediction_figure(prediction: JointPrediction, *, virtual: bool) -> Figure:
    """Draw the busiest part of one joint: command, measured, simulated, and the errors."""
    window = busiest_window(prediction, _PREDICTED_S)
    time = prediction.time[window]
    measured = prediction.measured[window]
    command_look: Look = {"color": style.COMMAND, "linewidth": 0.7}
    with drawing(2, height=4.8, sharex=True, height_ratios=[3.0, 1.4]) as (figure, grid):
        position_axes, error_axes = grid[:, 0]
        position_axes.step(time, prediction.command[window], where="post", **_plain(command_look))
        position_axes.plot(time, measured, **style.MEASURED_LINE)
        error_axes.axhline(0.0, color="#666666", linewidth=0.8)
        simulations = (
            (prediction.nominal, style.NAIVE_LINE),
            (prediction.matched, style.MATCHED_LINE),
        )
        for simulated, look in simulations:
            position_axes.plot(time, simulated[window], **look)
            error_axes.plot(time, simulated[window] - measured, **look)
        position_axes.set_ylabel(f"position [{prediction.unit}]")
        signal = "log" if prediction.signal == "unknown" else style.joint_words(prediction.signal)
        position_axes.set_title(f"{style.joint_words(prediction.joint)}: prediction of a {signal}")
        error_axes.set_ylabel(f"error [{prediction.unit}]")
        error_axes.set_xlabel("time [s]")
        error_axes.set_xlim(time[0], time[-1])
        keys = [
            key("command", **command_look),
            key(measured_words(virtual), **style.MEASURED_LINE),
            key(f"nominal: RMSE {prediction.rmse_nominal:.4f}", **style.NAIVE_LINE),
            key(f"matched: RMSE {prediction.rmse_matched:.4f}", **style.MATCHED_LINE),
        ]
        legend(figure, keys, 4)
    return figure


def _plain(look: Look) -> dict[str, Any]:
    """Return a look as keywords of a function whose types do not name them."""
    return dict(look)
