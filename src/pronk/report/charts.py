"""Bode plots that a page draws itself: their curves as numbers, for `templates/charts.js`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files

import numpy as np

from pronk.arrays import Array, ComplexArray
from pronk.identify.match.compared import ComparedResponses
from pronk.identify.match.plot import coherent_frequencies, decibel

DIGITS = 4
"""Significant digits of a number on a page; a pixel of a plot is a thousandth of its height."""

Number = float | None
"""A number of a curve; None where nothing is drawn."""


@dataclass(frozen=True, kw_only=True)
class ChartPanel:
    """One plot over frequency."""

    label: str
    """Label of the vertical axis."""
    curves: dict[str, list[Number]]
    """Values by name of the curve: `measured`, `matched`, `nominal`."""


@dataclass(frozen=True, kw_only=True)
class BodeChart:
    """Gain, error and phase of one joint over frequency."""

    title: str
    frequency_hz: list[Number]
    """Frequencies of all curves [Hz]."""
    band_hz: tuple[float, float]
    """Lowest and highest frequency that is compared [Hz]."""
    panels: tuple[ChartPanel, ...]


def bode_chart(responses: ComparedResponses, title: str) -> BodeChart:
    """Return the curves of a joint: gain [dB], error of the gain [dB], phase [deg].

    Only frequencies at which the measured response is coherent are drawn.

    Args:
        responses: Measured and simulated responses of the joint.
        title: Title of the chart.
    """
    measured = responses.measured[0]
    drawn = coherent_frequencies(measured) & (measured.frequency_hz > 0.0)
    measured_db = decibel(measured.gain)
    matched_db = decibel(responses.matched)
    nominal_db = decibel(responses.nominal)
    gain = ChartPanel(
        label="gain [dB]",
        curves={
            "measured": _numbers(measured_db[drawn]),
            "matched": _numbers(matched_db[drawn]),
            "nominal": _numbers(nominal_db[drawn]),
        },
    )
    error = ChartPanel(
        label="error [dB]",
        curves={
            "matched": _numbers((matched_db - measured_db)[drawn]),
            "nominal": _numbers((nominal_db - measured_db)[drawn]),
        },
    )
    phase = ChartPanel(
        label="phase [deg]",
        curves={
            "measured": _numbers(np.degrees(measured.phase)[drawn]),
            "matched": _numbers(_phase_deg(responses.matched)[drawn]),
            "nominal": _numbers(_phase_deg(responses.nominal)[drawn]),
        },
    )
    return BodeChart(
        title=title,
        frequency_hz=_numbers(measured.frequency_hz[drawn]),
        band_hz=responses.band_hz,
        panels=(gain, error, phase),
    )


def _phase_deg(response: ComplexArray) -> Array:
    """Return the unwrapped phase of a response [deg]."""
    return np.asarray(np.degrees(np.unwrap(np.angle(response))))


def _numbers(values: Sequence[float] | Array) -> list[Number]:
    """Return values for JSON, with the digits that a plot shows; None for NaN and infinity."""
    numbers: list[Number] = []
    for value in values:
        numbers.append(float(f"{value:.{DIGITS}g}") if np.isfinite(value) else None)
    return numbers


def chart_library() -> str:
    """Return the style and the script of uPlot, for the head of a page."""
    vendor = files("pronk.report") / "vendor"
    style = (vendor / "uplot.css").read_text("utf-8")
    script = (vendor / "uplot.js").read_text("utf-8")
    return f"<style>{style}</style><script>{script}</script>"
