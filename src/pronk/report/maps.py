"""The plane of stiffness and damping: error maps, training ranges, change with amplitude."""

from __future__ import annotations

from collections.abc import Sequence
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
from pronk.match.result import JointFit, MatchResult
from pronk.report import style
from pronk.report.paper import published

Array = NDArray[np.float64]

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
