"""The figures of a match, drawn from its artefacts alone.

Each takes a `MatchResult`, or a part of one, and returns a `matplotlib.figure.Figure` at page
width; `pronk.report.style` turns it into a file or into the page. Gains are absolute in the
artefacts and in dB only here.
"""

from pronk.report.bode import answers, bode, hero, measured_words, overview, zero_armature
from pronk.report.maps import amplitudes, ellipse, error_maps, ranges
from pronk.report.replay import figure as replay

__all__ = [
    "amplitudes",
    "answers",
    "bode",
    "ellipse",
    "error_maps",
    "hero",
    "measured_words",
    "overview",
    "ranges",
    "replay",
    "zero_armature",
]
