"""The page and its figures, from a match whose numbers are known in closed form."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from pronk.errors import ArtefactError
from pronk.match import gains as gains_file
from pronk.match import prediction as prediction_file
from pronk.match import result as result_file
from pronk.match.diagnostics import command_delay
from pronk.match.gains import GroupGains, JointGains, MatchedGains
from pronk.match.result import JointFit, MatchResult
from pronk.report import figures, match_page, style
from pronk.report.paper import published
from pronk.response.response import FrequencyResponse
from pronk.simulators.simulator import SimulatorInfo

LEGS = ("FR", "FL", "HR", "HL")
# Inertia of leg and rotor about the joint [kg m^2] and the gains that a match finds.
GROUPS = {
    "hip_roll": (0.0300, 19.5, 0.48, (1.0, 10.0)),
    "hip_pitch": (0.0260, 17.5, 0.40, (1.0, 10.0)),
    "knee": (0.0070, 21.9, 0.54, (0.1, 15.0)),
}
NAIVE = (17.0, 0.4)


def second_order(omega, stiffness, damping, inertia, viscous=0.01):
    """The joint of the paper's equation M2 with a still target velocity."""
    s = 1j * omega
    return stiffness / (inertia * s**2 + (damping + viscous) * s + stiffness)


def error_db(measured, simulated, band):
    gap = 20.0 * np.log10(np.abs(measured) / np.abs(simulated))
    return float(np.sqrt(np.mean(gap[band] ** 2)))


def joint_match(name, leg, *, virtual=True, amplitudes=(0.25, 0.125), grid=21, seed=0):
    rng = np.random.default_rng(seed)
    inertia, stiffness, damping, band_hz = GROUPS[name]
    stiffness *= 1.0 + 0.02 * (leg - 1.5)
    omega = 2.0 * np.pi * np.arange(0.25, 22.6, 0.25)
    expected = second_order(omega, stiffness, damping, inertia)
    responses = []
    for amplitude in amplitudes:
        noise = 0.01 * (rng.normal(size=(3, omega.size)) + 1j * rng.normal(size=(3, omega.size)))
        repeats = expected * np.exp(-1j * omega * 0.002) + noise * 0.25 / amplitude
        coherence = 1.0 - 0.3 * (omega / omega[-1]) ** 3
        responses.append(
            FrequencyResponse(
                joint=f"{LEGS[leg]}_{name}",
                amplitude=amplitude,
                omega=omega,
                response=repeats.mean(axis=0),
                coherence=coherence,
                averages=np.full(omega.size, 12.0),
                repeats=repeats,
                estimator="H1",
                window="hann 4 s, 75 % overlap",
                segment_s=4.0,
                delay_s=0.002,
                third_harmonic=0.02,
                virtual=virtual,
                source="synthetic",
            )
        )
    first = responses[0]
    band = first.band(*band_hz)
    axis_k, axis_d = np.linspace(13, 27, grid), np.linspace(0.1, 0.7, grid)
    surface = np.array(
        [
            [
                error_db(first.response, second_order(omega, k, d, inertia), band) ** 2
                for d in axis_d
            ]
            for k in axis_k
        ]
    )
    naive = second_order(omega, *NAIVE, inertia)
    return JointFit(
        joint=first.joint,
        responses=tuple(responses),
        grid_stiffness=axis_k,
        grid_damping=axis_d,
        grid_error=surface,
        stiffness=stiffness,
        damping=damping,
        covariance=np.array([[0.09, 0.0015], [0.0015, 1e-4]]),
        band_hz=band_hz,
        matched=expected,
        naive=naive,
        error_db=error_db(first.response, expected, band),
        naive_error_db=error_db(first.response, naive, band),
        zero_armature_error_db=2.9 if name == "knee" else float("nan"),
        zero_armature=second_order(omega, 27.0, 0.62, 0.0012) if name == "knee" else None,
        repeat_gains=np.array([[stiffness, damping]] * 3),
        amplitude_gains=np.array(
            [[0.25, stiffness, damping], [0.125, stiffness * 0.98, damping * 1.03]]
        ),
        flags=(
            *(("3 of 60 frequencies left out for low coherence",) if name == "knee" else ()),
            "zero armature: no match, the best node misses by 2.9 dB RMS, 30 times the match",
        ),
    )


def synthetic(*, virtual: bool = True, robot: str = "mini_cheetah", legs: int = 4) -> MatchResult:
    joints = {
        f"{leg}_{name}": joint_match(name, i, virtual=virtual, seed=i)
        for i, leg in enumerate(LEGS[:legs])
        for name in GROUPS
    }
    per_joint = {
        name: JointGains(
            stiffness=m.stiffness,
            damping=m.damping,
            grid_stiffness=m.stiffness + 0.1,
            grid_damping=m.damping,
            stiffness_ci95=(m.stiffness - 0.6, m.stiffness + 0.6),
            damping_ci95=(m.damping - 0.02, m.damping + 0.02),
            covariance=((0.09, 0.0015), (0.0015, 1e-4)),
            band_hz=m.band_hz,
            error_db=m.error_db,
            naive_error_db=m.naive_error_db,
            coherence_min=0.91,
            armature=0.0063 if name.endswith("knee") else 0.0026,
            amplitude_spread=0.02,
            flags=tuple(f for f in m.flags if not f.startswith("zero")),
        )
        for name, m in joints.items()
    }
    groups = {
        name: GroupGains(
            stiffness=round(k * 2) / 2,
            damping=round(d * 20) / 20,
            stiffness_range=2.0,
            damping_range=0.05,
            ellipsoid=((1.2, 0.0), (0.0, 0.001)),
            ellipsoid_center=(k, d),
        )
        for name, (_, k, d, _) in GROUPS.items()
    }
    gains = MatchedGains(
        robot=robot,
        simulator=SimulatorInfo(version="3.11.0"),
        joints=per_joint,
        groups=groups,
        logs={f"{name}.mcap": f"{i:064x}" for i, name in enumerate(joints)},
        virtual=virtual,
    )
    return MatchResult(
        gains=gains,
        joints=joints,
        seconds={"estimate": 1.2, "grid": 31.0, "refine": 4.0},
        grid_steps_per_second=6.1e5,
    )


def a_replay(joint="FR_knee", signal="log_chirp") -> prediction_file.JointPrediction:
    time = np.arange(0.0, 6.0, 0.002)
    command = 0.25 * np.sin(2.0 * np.pi * 0.8 * time**2)[(np.arange(time.size) // 10) * 10]
    # The naive simulation is wrong between 4 and 5 s alone.
    naive = np.where((time > 4.0) & (time < 5.0), 1.3, 1.0) * command
    return prediction_file.JointPrediction(
        joint=joint,
        time=time,
        command=command,
        measured=command,
        naive=naive,
        naive_delayed=1.1 * command,
        matched=1.01 * command,
        signal=signal,
    )


def written(folder: Path, result: MatchResult, *, predictions: bool = True) -> Path:
    gains_file.save(folder / "gains.yaml", result.gains)
    result_file.save(folder / "match.npz", result)
    if predictions:
        prediction_file.save(
            folder / "fresh.prediction.npz",
            prediction_file.Prediction(
                joints=(a_replay(),), virtual=result.gains.virtual, source="fresh.mcap"
            ),
        )
    return folder


@pytest.fixture(scope="module")
def match() -> MatchResult:
    return synthetic()


@pytest.fixture(scope="module")
def html(match, tmp_path_factory) -> str:
    folder = written(tmp_path_factory.mktemp("match"), match)
    return match_page.write_page(folder).read_text(encoding="utf-8")


def pixels(figure: Figure) -> np.ndarray:
    with style.styled():
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3]


def colours_in(image: np.ndarray, colour: str) -> int:
    wanted = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])
    return int((np.abs(image.astype(int) - wanted).max(axis=-1) < 12).sum())


# --- Figures ------------------------------------------------------------------------------------


def test_bode_shows_all_three_curves_and_the_band(match):
    image = pixels(figures.bode(match.joints["FR_knee"]))
    for colour in (style.MEASURED_WIDE, style.NAIVE, style.MATCHED, style.BAND):
        assert colours_in(image, colour) > 200, colour


def test_the_measured_curve_is_called_virtual_only_if_it_is(match):
    def words(figure):
        return " ".join(text.get_text() for text in figure.legends[0].get_texts())

    real = joint_match("knee", 0, virtual=False)
    assert "virtual robot" in words(figures.bode(match.joints["FR_knee"]))
    assert "virtual" not in words(figures.bode(real))
    assert "virtual robot" in figures.hero(match).axes[0].get_title(loc="left")
    assert "virtual robot" in words(figures.overview(match))


def test_gain_is_drawn_in_decibels_and_phase_in_degrees(match):
    joint = match.joints["FR_knee"]
    figure = figures.bode(joint)
    gain = next(line for line in figure.axes[0].lines if line.get_color() == style.MATCHED)
    phase = next(line for line in figure.axes[1].lines if line.get_color() == style.MATCHED)
    assert np.allclose(gain.get_ydata(), 20.0 * np.log10(np.abs(joint.matched)))
    assert np.allclose(phase.get_ydata(), np.degrees(np.unwrap(np.angle(joint.matched))))
    assert np.allclose(gain.get_xdata(), joint.responses[0].omega / (2.0 * np.pi))


def test_every_axis_of_every_figure_is_named_with_its_unit(match):
    groups = {name: [j for j in match.joints if j.endswith(name)] for name in GROUPS}
    drawn = [
        figures.bode(match.joints["FR_knee"]),
        figures.error_maps(match),
        figures.ranges(match.gains, groups),
        figures.zero_armature(match.joints["FR_knee"]),
        figures.amplitudes(match),
        figures.replay(a_replay(), virtual=True),
        figures.answers(match.joints["FR_knee"].responses),
    ]
    for figure in drawn:
        labels = [axes.get_ylabel() for axes in figure.axes] + [
            axes.get_xlabel() for axes in figure.axes
        ]
        named = [label for label in labels if label and label != "coherence"]
        assert named
        assert all(re.search(r"\[.+\]$", label) for label in named), named


def test_overview_has_a_row_per_group_and_a_column_per_leg(match):
    assert style.grid_of_joints(list(match.joints)) == [
        [f"{leg}_{name}" for leg in LEGS] for name in GROUPS
    ]
    arm = ["Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll"]
    assert style.grid_of_joints(arm) == [arm[:3], arm[3:]]
    titles = [axes.get_title(loc="left") for axes in figures.overview(match).axes]
    assert titles[:4] == ["FR hip roll", "FL hip roll", "HR hip roll", "HL hip roll"]


def test_no_text_of_the_legend_leaves_the_figure(match):
    groups = {name: [j for j in match.joints if j.endswith(name)] for name in GROUPS}
    for figure in (
        figures.bode(match.joints["FR_knee"]),
        figures.hero(match),
        figures.overview(match),
        figures.error_maps(match, dict.fromkeys(match.joints, NAIVE)),
        figures.ranges(match.gains, groups),
        figures.zero_armature(match.joints["FR_knee"]),
        figures.replay(a_replay(), virtual=True),
    ):
        pixels(figure)
        box = figure.legends[0].get_window_extent()
        assert box.x0 >= 0.0
        assert box.x1 <= figure.bbox.x1


def test_error_map_marks_the_best_node_the_optimum_and_table_one(match):
    figure = figures.error_maps(match, dict.fromkeys(match.joints, NAIVE))
    axes = figure.axes[0]
    joint = match.joints["FR_hip_roll"]
    i, j = np.unravel_index(joint.grid_error.argmin(), joint.grid_error.shape)
    marked = {line.get_marker(): line.get_xydata()[0] for line in axes.lines}
    assert np.allclose(marked["s"], (joint.grid_stiffness[i], joint.grid_damping[j]))
    assert np.allclose(marked["o"], (joint.stiffness, joint.damping))
    assert np.allclose(marked["x"], NAIVE)
    assert np.allclose(marked["+"], (20.6, 0.492))
    # The map shows RMS dB: the square root of what the artefact holds.
    shown = np.asarray(axes.collections[0].get_array()).reshape(joint.grid_error.T.shape)
    assert np.allclose(shown, np.sqrt(joint.grid_error.T))
    assert pixels(figure).std() > 20.0


def test_table_one_is_shown_for_the_robot_of_the_paper_alone():
    assert published("so101") is None
    other = synthetic(robot="so101", legs=1)
    markers = {line.get_marker() for line in figures.error_maps(other).axes[0].lines}
    assert "+" not in markers


def test_ellipse_passes_through_the_points_of_its_equation():
    covariance = np.array([[0.09, 0.0015], [0.0015, 1e-4]])
    drawn = figures.ellipse((20.0, 0.5), covariance, squared=5.99)
    points = drawn.get_patch_transform().transform(drawn.get_path().vertices)[::3]
    away = points - (20.0, 0.5)
    assert np.allclose(np.einsum("ni,ij,nj->n", away, np.linalg.inv(covariance), away), 5.99)


def test_zero_armature_is_refused_where_it_was_not_tried(match):
    with pytest.raises(ValueError, match="FR_hip_roll was not matched with zero armature"):
        figures.zero_armature(match.joints["FR_hip_roll"])


def test_no_amplitude_figure_with_one_amplitude():
    one = joint_match("knee", 0, amplitudes=(0.25,))
    alone = JointFit(**{**vars(one), "amplitude_gains": one.amplitude_gains[:1]})
    gains = synthetic().gains
    assert figures.amplitudes(MatchResult(gains=gains, joints={"FR_knee": alone})) is None


def test_the_same_figure_gives_the_same_bytes(match):
    joint = match.joints["FL_knee"]
    assert style.svg(figures.bode(joint)) == style.svg(figures.bode(joint))


def test_drawing_leaves_the_settings_of_matplotlib_alone(match):
    import matplotlib as mpl

    before = dict(mpl.rcParams)
    style.data_uri(figures.bode(match.joints["FR_knee"]))
    assert dict(mpl.rcParams) == before


# --- Replays ------------------------------------------------------------------------------------


def test_replay_shows_where_the_naive_simulation_is_furthest_off():
    one = a_replay()
    window = figures.busiest_window(one, 1.0)
    assert one.time[window][0] == pytest.approx(4.0, abs=0.1)
    assert one.time[window][-1] == pytest.approx(5.0, abs=0.1)
    whole = figures.busiest_window(one, 100.0)
    assert whole == slice(0, len(one.time))


def test_replays_survive_a_file(tmp_path):
    path = tmp_path / "a.prediction.npz"
    both = (a_replay(), a_replay("FL_knee"))
    prediction_file.save(
        path, prediction_file.Prediction(joints=both, virtual=True, source="a.mcap")
    )
    back = prediction_file.load(path)
    assert (back.virtual, back.source) == (True, "a.mcap")
    assert [r.joint for r in back.joints] == ["FR_knee", "FL_knee"]
    assert np.array_equal(back.joints[0].naive, a_replay().naive)
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(ArtefactError, match="not a prediction of pronk"):
        prediction_file.load(path)


# --- Page ---------------------------------------------------------------------------------------


def test_page_has_its_sections_verdict_first(html):
    order = re.findall(r'<section id="([a-z]+)"', html)
    assert order[0] == "verdict"
    assert set(order) == {
        "verdict",
        "gains",
        "bode",
        "maps",
        "ranges",
        "armature",
        "amplitudes",
        "replay",
        "identifiability",
        "use",
        "excitation",
        "timings",
    }
    for target in re.findall(r'href="#([a-z]+)"', html):
        assert f'id="{target}"' in html


def test_page_loads_nothing_from_anywhere(html):
    for address in re.findall(r'(?:src|href|url)\s*[=(]\s*["\']?([^"\')>\s]+)', html):
        assert address.startswith(("data:", "#")), address
    for word in ("<script", "@import", "http://", "https://", "<iframe", "<object"):
        assert word not in html


def test_page_is_small_enough_to_pass_on(html):
    assert len(html.encode()) < 5e6


def test_page_says_the_verdict_in_numbers(html, match):
    says = match_page.verdict(match)
    assert (says["matched"], says["joints"]) == (12, 12)
    expected = np.sqrt(np.mean([j.error_db**2 for j in match.joints.values()]))
    assert says["error_db"] == pytest.approx(expected)
    assert "12 of 12 joints matched" in html
    assert f"{says['naive_error_db']:.2f} dB" in html
    assert f"{says['error_db']:.2f} dB" in html


def test_a_joint_without_match_is_counted_and_named(tmp_path):
    result = synthetic()
    name = "HL_knee"
    joint = result.joints[name]
    warning = "no match: the best gains miss the measured response by 2 dB RMS"
    bad = JointFit(**{**vars(joint), "flags": (warning,)})
    worse = MatchResult(gains=result.gains, joints={**result.joints, name: bad})
    assert match_page.verdict(worse)["matched"] == 11
    assert warning in match_page.verdict(worse)["flags"][name]


def test_zero_armature_without_a_match_is_no_failure_flag(match):
    assert all(
        "zero armature" not in f for fs in match_page.verdict(match)["flags"].values() for f in fs
    )


def test_virtual_is_said_on_the_page_and_only_if_it_is(html, tmp_path):
    assert html.count("virtual robot") > 5
    assert "says nothing about a real robot" in html
    real = match_page.write_page(written(tmp_path, synthetic(virtual=False, legs=1))).read_text(
        encoding="utf-8"
    )
    assert "virtual robot" not in real


def test_page_holds_every_joint_every_hash_and_the_simulator(html, match):
    for name in match.joints:
        assert name.replace("_", " ") in html
    for digest in match.gains.logs.values():
        assert digest in html
    for word in ("3.11.0", "implicitfast", "dc_motor_pd", "0.516"):
        assert word in html


def test_what_comes_from_files_is_escaped(tmp_path):
    result = synthetic(legs=1)
    nasty = "<img src=x onerror=alert(1)>"
    gains = MatchedGains(**{**vars(result.gains), "logs": {nasty: "0" * 64}})
    text = match_page.write_page(
        written(tmp_path, MatchResult(gains=gains, joints=result.joints))
    ).read_text(encoding="utf-8")
    assert nasty not in text
    assert "&lt;img src=x onerror=alert(1)&gt;" in text


def test_page_without_predictions_and_zero_armature_leaves_them_out(tmp_path):
    result = synthetic(legs=1)
    bare = {
        name: JointFit(**{**vars(j), "zero_armature": None, "zero_armature_error_db": float("nan")})
        for name, j in result.joints.items()
    }
    folder = written(tmp_path, MatchResult(gains=result.gains, joints=bare), predictions=False)
    text = match_page.write_page(folder).read_text(encoding="utf-8")
    assert 'id="replay"' not in text
    assert 'id="armature"' not in text
    assert "nan" not in re.sub(r'src="[^"]*"', "", text).lower()


def test_missing_and_damaged_artefacts_are_named(tmp_path):
    with pytest.raises(ArtefactError, match="no such folder"):
        match_page.write_page(tmp_path / "nowhere")
    with pytest.raises(ArtefactError, match=r"no gains\.yaml; `pronk match"):
        match_page.write_page(tmp_path)
    gains_file.save(tmp_path / "gains.yaml", synthetic(legs=1).gains)
    with pytest.raises(ArtefactError, match=r"match\.npz: no such file"):
        match_page.write_page(tmp_path)
    (tmp_path / "match.npz").write_bytes(b"not a zip")
    with pytest.raises(ArtefactError, match="not a match file of pronk"):
        match_page.write_page(tmp_path)
    assert not (tmp_path / match_page.PAGE_NAME).exists()


def test_gains_under_another_name_are_found(tmp_path):
    folder = written(tmp_path, synthetic(legs=1))
    (folder / "gains.yaml").rename(folder / "tuesday.yaml")
    (folder / "other.yaml").write_text("just: something\n")
    assert match_page.find_gains(folder).name == "tuesday.yaml"
    gains_file.save(folder / "wednesday.yaml", synthetic(legs=1).gains)
    with pytest.raises(ArtefactError, match="several gains files"):
        match_page.find_gains(folder)


# --- Delay beside the match ---------------------------------------------------------------------


def test_delay_is_what_the_phase_lags_behind_the_matched_simulation(match):
    for name in ("FR_knee", "HL_hip_roll"):
        one = match.joints[name]
        # The synthetic joint responds 2 ms late (noise of a quarter per cent).
        delay = command_delay(one.responses[0], one.matched, one.band_hz)
        assert delay == pytest.approx(0.002, abs=2e-4)


def test_no_delay_is_made_up_for_an_incoherent_joint(match):
    joint = match.joints["FR_knee"]
    deaf = FrequencyResponse(
        **{**vars(joint.responses[0]), "coherence": np.zeros_like(joint.responses[0].coherence)}
    )
    assert command_delay(deaf, joint.matched, joint.band_hz) == 0.0
