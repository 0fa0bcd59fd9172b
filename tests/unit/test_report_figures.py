"""Figures of the report: curves, marks and axes, from data known in closed form."""

from __future__ import annotations

import math
import re
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from pronk.identify.match.gains import load_gains
from pronk.report import figures, style, trial_figures, trial_page
from pronk.report.paper import published_jumps
from report_cases import (
    CASES,
    GROUPS,
    NOMINAL_GAINS,
    OMEGA,
    RATE,
    joint_prediction,
    match,
    write_trial,
)
from seen_jump import SCRIPT


@pytest.fixture(scope="module")
def result():
    return match()


def curve(axes, colour):
    for line in axes.lines:
        if line.get_color() == colour:
            return line
    raise AssertionError(f"no line of colour {colour}")


def test_axes_have_units_and_legends_fit(result) -> None:
    groups = {}
    for name in GROUPS:
        groups[name] = [joint for joint in result.joints if joint.endswith(name)]
    knee = result.joints["FR_knee"]
    for figure in (
        figures.bode(knee),
        figures.hero(result),
        figures.overview(result.joints),
        figures.error_maps(result, dict.fromkeys(result.joints, NOMINAL_GAINS)),
        figures.ranges(result.gains, groups),
        figures.zero_armature(knee),
        figures.prediction_figure(joint_prediction(), virtual=True),
        figures.measured_responses(knee.responses.measured),
    ):
        labels = set()
        for axes in figure.axes:
            labels |= {axes.get_xlabel(), axes.get_ylabel()}
        with_unit = labels - {"", "coherence"}
        assert with_unit
        for label in with_unit:
            assert re.search(r"\[.+\]$", label), label
        FigureCanvasAgg(figure).draw()
        box = figure.legends[0].get_window_extent()
        assert box.x0 >= 0.0
        assert box.x1 <= figure.bbox.x1


def test_bode_has_gain_in_decibel_and_phase_in_degrees(result) -> None:
    fit = result.joints["FR_knee"]
    gain, phase, _ = figures.bode(fit).axes
    for colour, values in (
        (style.MATCHED, fit.responses.matched),
        (style.NAIVE, fit.responses.nominal),
    ):
        assert np.allclose(curve(gain, colour).get_ydata(), 20.0 * np.log10(np.abs(values)))
        degrees = np.degrees(np.unwrap(np.angle(values)))
        assert np.allclose(curve(phase, colour).get_ydata(), degrees)
    hz = fit.responses.measured[0].omega / (2.0 * np.pi)
    assert np.allclose(curve(gain, style.MATCHED).get_xdata(), hz)


def test_error_map_marks_grid_optimum_refined_gains_drive_and_paper(result) -> None:
    axes = figures.error_maps(result, dict.fromkeys(result.joints, NOMINAL_GAINS)).axes[0]
    joint = result.joints["FR_hip_roll"]
    marked = {}
    for line in axes.lines:
        marked[line.get_marker()] = line.get_xydata()[0]
    assert np.allclose(marked["s"], joint.grid.gains)
    assert np.allclose(marked["o"], (joint.gains.stiffness.value, joint.gains.damping.value))
    assert np.allclose(marked["x"], NOMINAL_GAINS)
    assert np.allclose(marked["+"], (20.6, 0.492))
    # The map shows RMS dB: the square root of what the artefact holds.
    mapped = np.asarray(axes.collections[0].get_array()).reshape(joint.grid.error.T.shape)
    assert np.allclose(mapped, np.sqrt(joint.grid.error.T))


def test_legs_of_another_robot_have_their_own_markers() -> None:
    """The hind legs of a Go2 are RR and RL, those of a Mini Cheetah HR and HL."""
    path = Path(__file__).parents[2] / "examples" / "studies" / "go2" / "gains.yaml"
    gains = load_gains(path)
    groups: dict[str, list[str]] = {}
    for joint in gains.joints:
        groups.setdefault(joint.partition("_")[2], []).append(joint)
    figure = figures.ranges(gains, groups)
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels[:4] == ["FR", "FL", "RR", "RL"]
    assert not any(axes.texts for axes in figure.axes), "the legend names the legs"
    assert len({style.leg_marker(leg) for leg in labels[:4]}) == 4
    assert style.grid_of_joints(list(gains.joints)) == list(groups.values())


def test_fingers_are_of_no_leg() -> None:
    """Joints of a right hand begin with rh."""
    assert style.leg_of("rh_FFJ1") == ""
    assert style.leg_of("fl_knee") == "fl"


def test_ellipse_passes_through_the_points_of_its_equation() -> None:
    covariance = np.array([[0.09, 0.0015], [0.0015, 1e-4]])
    drawn = figures.ellipse((20.0, 0.5), covariance, squared_radius=5.99, edgecolor="black")
    points = drawn.get_patch_transform().transform(drawn.get_path().vertices)[::3]
    away = points - (20.0, 0.5)
    assert np.allclose(np.einsum("ni,ij,nj->n", away, np.linalg.inv(covariance), away), 5.99)


def test_figures_are_reproducible_and_leave_matplotlib_settings_alone(result) -> None:
    before = dict(mpl.rcParams)
    picture = style.render(figures.bode(result.joints["FL_knee"]))
    assert style.render(figures.bode(result.joints["FL_knee"])) == picture
    assert dict(mpl.rcParams) == before


def test_prediction_shows_where_the_nominal_simulation_is_worst() -> None:
    prediction = joint_prediction()
    window = figures.busiest_window(prediction, 1.0)
    assert prediction.time[window][[0, -1]] == pytest.approx([4.0, 5.0], abs=0.1)
    assert figures.busiest_window(prediction, 100.0) == slice(0, len(prediction.time))


def test_cells_draw_mean_spread_and_the_paper(tmp_path) -> None:
    trial = write_trial(tmp_path)
    distance = trial_page.jump_values(trial, "distance")
    paper = published_jumps("distance")
    assert list(distance) == ["naive", "matched"]  # as in the paper
    panel = trial_figures.JumpPanel(label="distance [m]", values=distance, published=paper)
    axes = trial_figures.draw_jumps([panel]).axes[0]
    points = set()
    for container in axes.containers:
        line, _, bars = container.lines
        for mean in line.get_ydata():
            for bar in bars:
                spread = float(np.ptp(bar.get_segments()[0][:, 1])) / 2.0
                points.add((round(float(mean), 6), round(spread, 6)))
    # At 1 m/s the trunk flies its time in the air. Three jumps are too few for a deviation.
    assert {(0.41, 0.0), (0.40, 0.0)} <= points
    for gains in ("naive", "matched"):
        for case in ("forward 1", "forward 2"):
            assert paper[gains][case] in points
    assert paper["matched"]["forward 2"] == (0.969, 0.026)


def test_five_jumps_have_a_deviation() -> None:
    values = {"matched": {"forward 1": np.array([0.38, 0.39, 0.40, 0.41, 0.42])}}
    panel = trial_figures.JumpPanel(label="distance [m]", values=values, published={})
    (container,) = trial_figures.draw_jumps([panel]).axes[0].containers
    (bars,) = container.lines[2]
    spread = float(np.ptp(bars.get_segments()[0][:, 1])) / 2.0
    assert spread == pytest.approx(np.std(values["matched"]["forward 1"], ddof=1))


def test_rates_are_of_the_acceleration_at_the_papers_speed(tmp_path) -> None:
    traces = trial_page.load_traces(write_trial(tmp_path, keep=True), tmp_path)
    assert traces.missing == 0
    assert set(traces.roll_rate["naive"]) == {CASES[2].name}
    runs = traces.roll_rate["naive"][CASES[2].name]
    time, rate = runs[0]
    assert time[[0, -1]] == pytest.approx([0.0, SCRIPT.run_s])
    assert np.allclose(rate, 2.0 * RATE * np.sin(OMEGA * time), atol=1e-6)
    # A sine over nearly whole periods.
    expected = 2.0 * RATE / math.sqrt(2.0)
    assert trial_page.rate_rms({CASES[2].name: runs}) == pytest.approx(expected, rel=0.02)
