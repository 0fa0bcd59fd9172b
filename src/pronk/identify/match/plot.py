"""Figures of measured and simulated responses."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pronk.arrays import Array, ComplexArray, Mask
from pronk.identify.match.compared import ComparedResponses
from pronk.identify.response.response import FrequencyResponse

# Colours of Okabe and Ito (Color Universal Design, 2008), as on the pages of the report.
MEASURED_COLOR = "#909090"
MATCHED_COLOR = "#0072B2"
NOMINAL_COLOR = "#D55E00"
BAND_COLOR = "#f3efe2"
MIN_COHERENCE = 0.5
"""Coherence below which a frequency is not drawn: it is mostly noise."""
COLUMNS = 4
"""Panels in a row of the figure of all joints."""


def plot_response(responses: ComparedResponses, *, title: str) -> Figure:
    """Draw gain and phase of one joint: measured, with matched and with nominal gains.

    Args:
        responses: Responses of the joint.
        title: Title of the figure, for instance the joint's name.

    Returns:
        A matplotlib figure.
    """
    figure = Figure(figsize=(8.0, 6.0), layout="constrained")
    gain_axes, phase_axes = figure.subplots(2, 1, sharex=True, height_ratios=[3.0, 2.0])
    draw_gain(gain_axes, responses)
    gain_axes.set_title(title)
    gain_axes.set_ylabel("gain [dB]")
    gain_axes.legend(loc="lower left")
    draw_phase(phase_axes, responses)
    phase_axes.set_ylabel("phase [deg]")
    phase_axes.set_xlabel("frequency [Hz]")
    return figure


def plot_all_gains(responses: Mapping[str, ComparedResponses]) -> Figure:
    """Draw the gain of every joint, one panel a joint.

    Args:
        responses: Responses by joint.

    Returns:
        A matplotlib figure.
    """
    columns = min(COLUMNS, len(responses))
    rows = -(-len(responses) // columns)
    figure = Figure(figsize=(3.0 * columns + 1.0, 2.2 * rows + 0.8), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, sharex=True).ravel()
    for axes, (name, joint_responses) in zip(panels, responses.items(), strict=False):
        draw_gain(axes, joint_responses)
        axes.set_title(name)
    for axes in panels[len(responses) :]:
        axes.set_visible(False)
    for axes in panels[: len(responses)]:
        axes.set_xlabel("frequency [Hz]")
    for axes in panels[::columns]:
        axes.set_ylabel("gain [dB]")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


def draw_gain(axes: Axes, responses: ComparedResponses) -> None:
    """Draw measured gain with its 95 % interval and both simulated gains [dB]."""
    measured = responses.measured[0]
    coherent = coherent_frequencies(measured)
    low, high = measured.gain_interval()
    shown_low = np.where(coherent, decibel(low), np.nan)
    shown_high = np.where(coherent, decibel(high), np.nan)
    axes.fill_between(
        measured.frequency_hz, shown_low, shown_high, color=MEASURED_COLOR, alpha=0.35, linewidth=0
    )
    curves = {
        "measured": decibel(measured.gain),
        f"nominal gains: error {responses.nominal_error_db:.2f} dB": decibel(responses.nominal),
        f"matched gains: error {responses.error_db:.2f} dB": decibel(responses.matched),
    }
    _draw_curves(axes, responses, curves, coherent)


def draw_phase(axes: Axes, responses: ComparedResponses) -> None:
    """Draw measured phase and both simulated phases [deg]."""
    measured = responses.measured[0]
    curves = {
        "measured": np.degrees(measured.phase),
        "nominal gains": np.degrees(np.unwrap(np.angle(responses.nominal))),
        "matched gains": np.degrees(np.unwrap(np.angle(responses.matched))),
    }
    _draw_curves(axes, responses, curves, coherent_frequencies(measured))


def decibel(gain: Array | ComplexArray) -> Array:
    """Return `20 log10(|gain|)`, floored at -200 dB so that a zero can be drawn."""
    return np.asarray(20.0 * np.log10(np.maximum(np.abs(gain), 1e-10)))


def _draw_curves(
    axes: Axes, responses: ComparedResponses, curves: Mapping[str, Array], coherent: Mask
) -> None:
    """Draw the measured, the nominal and the matched curve over frequency, in this order."""
    frequency_hz = responses.measured[0].frequency_hz
    axes.axvspan(*responses.band_hz, color=BAND_COLOR, zorder=0, linewidth=0)
    looks = ((MEASURED_COLOR, "-", 3.0), (NOMINAL_COLOR, "--", 1.5), (MATCHED_COLOR, "-", 1.4))
    for (label, values), (color, style, width) in zip(curves.items(), looks, strict=True):
        drawn_values = np.where(coherent, values, np.nan)
        axes.plot(frequency_hz, drawn_values, style, color=color, linewidth=width, label=label)
    axes.set_xscale("log")
    axes.set_xlim(max(0.1, float(frequency_hz[coherent].min())), float(frequency_hz.max()))
    axes.grid(color="#e3e3e3", linewidth=0.7)


def coherent_frequencies(response: FrequencyResponse) -> Mask:
    """Return the frequencies that are drawn, shape (f,): all where none is coherent."""
    positive = response.frequency_hz > 0.0
    coherent = positive & (response.coherence >= MIN_COHERENCE)
    return coherent if coherent.any() else positive
