"""The page of everything: trials made by hand, whose figures are known in closed form."""

from __future__ import annotations

import base64
import io
import json
import math
import re
from dataclasses import asdict, replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pronk.cli import main as cli
from pronk.errors import ArtefactError
from pronk.evaluation import bodies, published, results, tables, variation, walk
from pronk.evaluation.bodies import Bodies, Body, GainsError
from pronk.evaluation.course import CrossingFigures
from pronk.evaluation.crossing import CROSSING, climbs
from pronk.evaluation.jumps import JumpRules
from pronk.evaluation.metrics import JumpFigures, measure
from pronk.evaluation.protocol import PAPER_COMMANDS, RATES, Case
from pronk.evaluation.results import Kind, Results, Row, Subject
from pronk.evaluation.variation import NOMINAL, VARIATION
from pronk.evaluation.walk import WALK, walk_script
from pronk.evaluation.walk_metrics import WalkFigures
from pronk.match import gains as gains_file
from pronk.match import result as match_file
from pronk.match.result import MatchResult
from pronk.report import build, extra_pages, style, trial_page
from pronk.report.trial_figures import (
    Line,
    Panel,
    Trace,
    argument,
    cells,
    heights,
    lines,
    rates,
    rms,
    scatter,
    torque_speed,
)
from pronk.report.trial_page import bode_errors_db, joint_error_db, match_near
from pronk.robots import load_robot
from pronk.virtual import capture as captures
from pronk.virtual.capture import Capture
from seen_jump import DT, SCRIPT, STANDING, Z_OFF, G, seen_jump
from test_report import synthetic

ROBOT = load_robot("mini_cheetah")
RULES = JumpRules(standing_height=STANDING)
CASES = (PAPER_COMMANDS[0], PAPER_COMMANDS[1], RATES)
# Time in the air [ms] of the jumps of each policy: the naive ones differ twice as much.
FLIGHTS = {"matched": (400, 410, 420), "naive": (380, 400, 420)}
GAINS = {"matched": ((20.0, 17.5, 21.5), (0.45, 0.40, 0.55)), "naive": ((17.0,) * 3, (0.4,) * 3)}
RATE, TURN = 3.0, 25.0
"""Amplitude [rad/s] and omega [rad/s] of the roll rate that is seen."""


def up(flight: int) -> float:
    """Lift-off velocity of a flight of so many milliseconds [m/s]."""
    return G * flight / 2000.0


def seen(flight: int, scale: float) -> Capture:
    made = seen_jump(up=up(flight))
    rate = np.zeros_like(made.angular_velocity)
    rate[:, 0] = scale * RATE * np.sin(TURN * (made.time - SCRIPT.start))
    turning = np.tile(np.linspace(-10.0, 10.0, len(made.time))[:, None], (1, 12))
    return replace(made, angular_velocity=rate, joint_velocity=turning, torque=0.5 * turning)


def subject(name: str, **contract: Any) -> Subject:
    stiffness, damping = GAINS.get(name, GAINS["matched"])
    fields = {
        "gains": name,
        "joint_names": ROBOT.joint_names,
        "stiffness": stiffness * 4,
        "damping": damping * 4,
    }
    return Subject(name=name, path=f"{name}.onnx", sha256=name[0] * 64, contract=fields | contract)


def made(
    folder: Path,
    policies: tuple[str, ...] = ("matched", "naive"),
    cases: tuple[Case, ...] = CASES,
    *,
    keep: bool = True,
    times: int = 1,
) -> Results:
    """A trial in a folder, measured by `pronk.evaluation.metrics` on jumps made by hand."""
    rows = []
    for name in policies:
        for case in cases:
            script = replace(SCRIPT, command=case.command)
            for number, flight in enumerate(times * FLIGHTS[name]):
                taken = seen(flight, 2.0 if name == "naive" else 1.0)
                where = f"captures/{name}_{case.name}_{number:03d}.npz".replace(" ", "_")
                if keep:
                    captures.save(folder / where, taken)
                rows.append(
                    Row(
                        policy=name,
                        case=case.name,
                        number=number,
                        seed=number,
                        figures=measure(taken, script, ROBOT, began=0.0, mass=12.0, rules=RULES),
                        script=script,
                        capture=where if keep else "",
                    )
                )
    trial = Results(
        robot=ROBOT.name,
        virtual=True,
        subjects=tuple(subject(name) for name in policies),
        cases=cases,
        rows=tuple(rows),
        joint_names=ROBOT.joint_names,
        seed=3,
        sim_params={"file": "shipped with pronk", "sha256": "ab" * 32},
        script=SCRIPT,
        spread_s=0.0,
        rules=asdict(RULES),
        mass=12.0,
        versions={"pronk": "0.1.0"},
        timing={"seconds": 2.0, "simulated_s": 9.0, "processes": 1},
    )
    results.save(folder, trial)
    return results.load(folder)


def of_kind(kind: Kind, names: tuple[str, ...], **rest: Any) -> Results:
    kept: dict[str, Any] = {"script": SCRIPT, "joint_names": ROBOT.joint_names}
    return Results(
        kind=kind,
        robot=ROBOT.name,
        subjects=tuple(map(subject, names)),
        sim_params={"sha256": "cd" * 32},
        seed=1,
        versions={"pronk": "0.1.0"},
        **(kept | rest),
    )


def row(policy: str, case: Case, number: int, figures: Any, **rest: Any) -> Row:
    script = replace(SCRIPT, command=case.command)
    return Row(
        policy=policy,
        case=case.name,
        number=number,
        seed=number,
        figures=figures,
        script=script,
        **rest,
    )


def walked() -> Results:
    """Two walks a policy; the naive one falls once."""
    case = walk.WALKS[0]
    kept: dict[str, Any] = {"non_foot_contact": False, "lasted": 20.0, "forward": 1.9}
    rows = tuple(
        row(
            name,
            case,
            i,
            WalkFigures(
                fell=name == "naive" and i == 0, speed_error_averaged=0.1 + 0.02 * i, **kept
            ),
        )
        for name in ("matched", "naive")
        for i in range(2)
    )
    script = walk_script((0.0, 0.0, 0.0))
    return of_kind(WALK, ("matched", "naive"), cases=(case,), rows=rows, script=script)


def crossed() -> Results:
    """Gaps of 0.2 m crossed 4 times of 5, of 0.4 m never."""
    case = PAPER_COMMANDS[1]
    rows = tuple(
        row(
            "matched",
            case,
            i,
            CrossingFigures(
                obstacle="gap",
                size=size,
                lead=0.4,
                why="" if size < 0.3 and i else "a foot was in the gap",
                take_off=0.1,
                landing=0.1,
                reach=0.3,
                speed=2.0,
            ),
        )
        for size in (0.2, 0.4)
        for i in range(5)
    )
    settings = {"kinds": ["gap", "up"], "runs": 5, "enough": 4}
    return of_kind(CROSSING, ("matched",), cases=(case,), rows=rows, settings=settings)


def varied() -> Results:
    """Heights of 0.4 m, and 0.3 m with 1 kg more mass, with which the naive policy falls."""
    mass = replace(variation.PARAMETERS[0], values=(1.0,))
    rows = []
    for parameter, value, height in ((NOMINAL, 0.0, 0.4), (mass.name, 1.0, 0.3)):
        for name in ("matched", "naive"):
            for case in CASES[:2]:
                for number in range(3):
                    good = name == "matched" or parameter != mass.name
                    known = dict.fromkeys(variation.VARIED_FIGURES, 0.5 + 0.1 * number)
                    known["height"] = height + 0.01 * (number - 1)
                    figures = JumpFigures(
                        standing=True, found=True, upright=good, fell=not good, **known
                    )
                    rows.append(row(name, case, number, figures, parameter=parameter, value=value))
    settings = {"parameters": [asdict(mass)], "nominal": {mass.name: 0.0}}
    names = ("matched", "naive")
    return of_kind(VARIATION, names, cases=CASES[:2], rows=tuple(rows), settings=settings)


def embodied(folder: Path) -> Bodies:
    """Two bodies with trials of their own."""
    gains = synthetic(legs=1).gains
    found = []
    for i in (1, 2):
        where = f"bodies/body_{i}"
        gains_file.save(folder / where / "gains.yaml", gains)
        errors = {"training gains of matched": 0.1 * i, "training gains of naive": 0.6 * i}
        found.append(
            Body(
                name=f"body {i}",
                folder=where,
                seed=i,
                sha256="ef" * 32,
                joints=gains.joints,
                groups=gains.groups,
                errors=tuple(
                    GainsError(
                        gains=name,
                        rms_db=error,
                        joints_db={"FR_knee": error},
                        pairs={"FR_knee": (17.0, 0.4)},
                    )
                    for name, error in (errors | {bodies.MATCHED: 0.02 * i}).items()
                ),
                trial=made(folder / where / "trial", cases=CASES[:2], keep=False),
            )
        )
    return Bodies(
        robot=ROBOT.name,
        subjects=tuple(map(subject, ("matched", "naive"))),
        sim_params={"sha256": "cd" * 32},
        seed=1,
        versions={"pronk": "0.1.0"},
        bodies=tuple(found),
    )


def matched(folder: Path) -> MatchResult:
    """The match of one joint in a folder."""
    result = synthetic(legs=1)
    alone = replace(result, joints={"FR_knee": result.joints["FR_knee"]})
    gains_file.save(folder / "gains.yaml", alone.gains)
    match_file.save(folder / "match.npz", alone)
    return alone


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A match, and below it a trial with all that may lie beside it."""
    root = tmp_path_factory.mktemp("tree")
    matched(root)
    made(root / "trial")
    for each in (walked(), crossed(), varied()):
        results.save(root / "trial", each)
    bodies.save(root / "trial", embodied(root / "trial"))
    frames = [Image.new("RGB", (64, 40), (i * 60, 90, 120)) for i in range(4)]
    (root / "trial" / "videos").mkdir()
    frames[0].save(
        root / "trial" / "videos" / "matched_forward_2.gif",
        save_all=True,
        append_images=frames[1:],
        duration=[40, 60, 80, 100],
    )
    frames[0].save(root / "trial" / "videos" / "matched_forward_2.png")
    (root / "trial" / "videos" / "matched_forward_2.mp4").write_bytes(b"a film")
    return root


@pytest.fixture(scope="module")
def trial(tree: Path) -> Results:
    return results.load(tree / "trial")


@pytest.fixture(scope="module")
def html(tree: Path) -> str:
    page, _ = build.write_report(tree)
    return page.read_text(encoding="utf-8")


class Checker(HTMLParser):
    """Open and closed tags, anchors, links; what lies inside figures."""

    VOID = frozenset({"meta", "link", "img", "br", "hr", "input"})

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.links: list[str] = []
        self.pictures: list[dict[str, str]] = []
        self.text: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        fields = {name: value or "" for name, value in attrs}
        if tag not in self.VOID:
            self.open.append(tag)
        if "id" in fields:
            self.ids.append(fields["id"])
        if tag == "a":
            self.links.append(fields["href"])
        if tag == "img":
            self.pictures.append(fields)
        for name in ("src", "href"):
            if name in fields:
                assert fields[name].startswith(("data:", "#")), fields[name]

    def handle_endtag(self, tag: str) -> None:
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag, f"</{tag}> closes another tag"

    def handle_data(self, data: str) -> None:
        self.text.append(data)


def checked(html: str) -> Checker:
    checker = Checker()
    checker.feed(html)
    checker.close()
    assert checker.open == []
    assert len(checker.ids) == len(set(checker.ids))
    for link in checker.links:
        assert link.removeprefix("#") in checker.ids, link
    for word in ("<script", "@import", "http://", "https://", "<iframe", "<object", "url("):
        assert word not in html
    return checker


# --- The page -----------------------------------------------------------------------------------


def test_the_page_is_whole_and_needs_nothing_else(html: str) -> None:
    checker = checked(html)
    assert {"trial", "walk", "crossing", "variation", "bodies", "match"} < set(checker.ids)
    # The trials of the bodies belong to their part.
    assert "trial1" not in checker.ids
    for section in (
        "table",
        "criteria",
        "scatter",
        "argument",
        "look",
        "gaps",
        "landings",
        "rates",
    ):
        assert f"trial-{section}" in checker.ids
    for section in ("heights", "drives", "more", "definitions", "run"):
        assert f"trial-{section}" in checker.ids
    assert "match-gains" in checker.ids
    assert len(html.encode()) < 8e6


def test_every_picture_says_what_it_is_and_of_whom(html: str) -> None:
    pictures = checked(html).pictures
    assert len(pictures) > 14
    for one in pictures:
        assert len(one["alt"]) > 20
    kinds = {one["src"].split(";")[0] for one in pictures}
    assert kinds == {"data:image/svg+xml", "data:image/png", "data:image/gif"}


def test_nobody_takes_the_virtual_robot_for_a_real_one(html: str) -> None:
    text = " ".join(checked(html).text)
    assert "a virtual robot proves nothing about a real one" in text
    assert "matched, virtual robot" in text
    assert "hardware" in text
    assert 'class="badge">virtual robot<' in html


def test_every_definition_and_every_number_of_the_tables_is_on_the_page(
    html: str, trial: Results
) -> None:
    text = re.sub(r"\s+", " ", " ".join(checked(html).text))
    for one in tables.sheets(trial):
        for row in one.rows:
            for cell in row:
                said = cell.replace("+-", "±").replace(">=", "≥").replace("<=", "≤").split(": ")[-1]
                said = "–" if said == "-" else said.replace("_", " ")
                assert said in text.replace("_", " "), (one.title, cell)
    assert "nan" not in re.sub(r"[A-Za-z]+nan|nan[a-z]+", "", text).lower()


def test_hashes_seeds_and_versions_are_on_the_page(html: str, trial: Results) -> None:
    for word in (*(s.sha256 for s in trial.subjects), "ab" * 32, "seed 3", "pronk 0.1.0"):
        assert word in html


def test_walks_and_crossings_are_summed_up_in_a_sentence(html: str) -> None:
    assert "matched, virtual robot: 0 of 2 walks ended in a fall." in html
    assert "matched, virtual robot: gaps crossed 0.20 m (forward 2)." in html
    assert "a foot was in the gap (5)" in html
    assert "matched, virtual robot: 12 of 12 jumps on varied bodies landed well." in html
    assert "2 other virtual robots: 24 of 24 jumps landed well." in html


def test_what_comes_from_files_is_escaped(tmp_path: Path) -> None:
    nasty = "<img src=x onerror=alert(1)>"
    trial = made(tmp_path, ("matched",), CASES[:1], keep=False)
    body = json.loads((tmp_path / "summary.json").read_text())
    body["sim_params"]["file"] = nasty
    body["policies"][0]["path"] = nasty
    (tmp_path / "summary.json").write_text(json.dumps(body))
    page, _ = build.write_report(tmp_path)
    text = page.read_text(encoding="utf-8")
    assert nasty not in text
    assert text.count("&lt;img src=x onerror=alert(1)&gt;") == 2
    assert trial.subjects[0].name in text


def test_the_same_folder_gives_the_same_page(tmp_path: Path) -> None:
    made(tmp_path, ("matched",), CASES[:1], keep=False)
    first = build.write_report(tmp_path)[0].read_bytes()
    assert build.write_report(tmp_path)[0].read_bytes() == first


# --- Parts missing ------------------------------------------------------------------------------


def test_one_policy_without_captures_or_match_makes_a_page(tmp_path: Path) -> None:
    made(tmp_path, ("matched",), CASES[:2], keep=False)
    page, found = build.write_report(tmp_path)
    assert [one.source for one in found] == ["summary.json"]
    checker = checked(page.read_text(encoding="utf-8"))
    for section in ("argument", "look", "rates", "heights"):
        assert f"trial-{section}" not in checker.ids
    assert "trial-scatter" in checker.ids
    assert "--also" in " ".join(checker.text)


def test_captures_that_are_gone_are_counted(tmp_path: Path) -> None:
    trial = made(tmp_path, ("matched",), CASES[:1])
    (tmp_path / trial.rows[1].capture).unlink()
    found = trial_page.see(trial, tmp_path)
    assert found is not None
    assert found.missing == 1
    assert len(found.height["matched"]["forward 1"]) == 2
    page, _ = build.write_report(tmp_path)
    text = page.read_text(encoding="utf-8")
    assert "2 of 3 jumps, those whose captures were kept" in text
    assert "1 captures are missing from the folder." in text


def test_a_policy_that_never_jumps_makes_a_page_of_dashes(tmp_path: Path) -> None:
    trial = made(tmp_path, ("matched",), CASES[:2], keep=False)
    rows = tuple(replace(row, figures=JumpFigures(standing=True, fell=True)) for row in trial.rows)
    results.save(tmp_path, replace(trial, rows=rows))
    page, _ = build.write_report(tmp_path)
    text = " ".join(checked(page.read_text(encoding="utf-8")).text)
    assert "6 jumps commanded with 2 commands, 0 jumped" in re.sub(r"\s+", " ", text)
    assert "nan" not in text.lower().replace("finance", "")


def test_a_match_alone_makes_a_page(tmp_path: Path) -> None:
    matched(tmp_path)
    page, found = build.write_report(tmp_path)
    assert page.name == "report.html"
    assert found[0].figures["joints"] == 3
    checked(page.read_text(encoding="utf-8"))


def test_two_trials_are_two_parts_with_names_of_their_own(tmp_path: Path) -> None:
    made(tmp_path / "monday", ("matched",), CASES[:1], keep=False)
    made(tmp_path / "tuesday", ("naive",), CASES[:1], keep=False)
    page, found = build.write_report(tmp_path)
    assert [one.source for one in found] == ["monday/summary.json", "tuesday/summary.json"]
    text = " ".join(checked(page.read_text(encoding="utf-8")).text)
    assert "Trial: monday" in text
    assert "Trial: tuesday" in text


# --- What cannot be read ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "bytes_kept", "said"),
    [
        ("trial/summary.json", 300, "cannot be read"),
        ("trial/trials.csv", 2000, "line [0-9]+ cannot be read|do not fit"),
        ("trial/walk.json", 200, "walk.json"),
        ("trial/crossing.json", 200, "crossing.json"),
        ("trial/variation.json", 200, "variation.json"),
        ("trial/bodies.json", 200, "bodies.json"),
        ("trial/bodies/body_2/trial/trials.csv", 2000, "line [0-9]+ cannot be read|do not fit"),
        ("trial/captures/naive_forward_1_001.npz", 500, "not a capture"),
        ("trial/videos/matched_forward_2.gif", 5, "no picture that can be opened"),
        ("match.npz", 100, "not a match file"),
    ],
)
def test_damage_is_one_sentence_and_no_page(
    tree: Path, tmp_path: Path, name: str, bytes_kept: int, said: str
) -> None:
    for path in tree.rglob("*"):
        if path.is_file() and path.name != build.NAME:
            copy = tmp_path / path.relative_to(tree)
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(path.read_bytes())
    damaged = tmp_path / name
    damaged.write_bytes(damaged.read_bytes()[:bytes_kept])
    with pytest.raises(ArtefactError, match=said) as refusal:
        build.write_report(tmp_path)
    assert "\n" not in str(refusal.value)
    assert not (tmp_path / build.NAME).exists()


def test_an_empty_folder_and_none_say_what_would_fill_them(tmp_path: Path) -> None:
    with pytest.raises(ArtefactError, match=r"nothing to report; .*pronk trial .*pronk match"):
        build.write_report(tmp_path)
    with pytest.raises(ArtefactError, match="no such folder"):
        build.write_report(tmp_path / "nowhere")


def test_the_command_writes_the_page_and_its_figures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made(tmp_path / "trial", ("matched",), CASES[:1], keep=False)
    results.save(tmp_path / "trial", walked())
    figures = tmp_path / "figures.json"
    assert cli.run(["report", str(tmp_path), "--json", str(figures)]) == 0
    said = capsys.readouterr().out
    assert f"wrote {tmp_path / 'report.html'}" in said
    assert "next:" in said
    parts = json.loads(figures.read_text())["parts"]
    assert [one["source"] for one in parts] == ["trial/summary.json", "trial/walk.json"]
    assert parts[0]["checks"][0]["what"] == "forward 1: height"
    assert cli.run(["report", str(tmp_path / "nowhere")]) == 2
    assert "no such folder" in capsys.readouterr().err


# --- What is drawn ------------------------------------------------------------------------------


def test_cells_draw_mean_spread_and_the_paper(trial: Results) -> None:
    names = [case.name for case in CASES]
    distance = trial_page.values(trial, "distance", names)
    paper = trial_page.published("distance")
    axes = cells([("distance [m]", distance, paper)]).axes[0]
    points = {
        (round(float(y), 6), round(float(np.ptp(bar.get_segments()[0][:, 1])) / 2.0, 6))
        for line, _, bars in (one.lines for one in axes.containers)
        for y in line.get_ydata()
        for bar in bars
    }
    # At 1 m/s the trunk flies its time in the air; a sample deviates by ten milliseconds.
    assert (0.41, 0.01) in points
    assert (0.40, 0.02) in points
    for gains in ("naive", "matched"):
        for case in ("forward 1", "forward 2"):
            assert paper[gains][case] in points
    assert paper["matched"]["forward 2"] == (0.969, 0.026)


def test_naive_stands_before_matched_as_in_the_paper(trial: Results) -> None:
    assert trial_page.policies(trial) == ["naive", "matched"]
    assert trial.subjects[0].name == "matched"


def test_scatter_has_a_panel_a_command(trial: Results) -> None:
    names = [case.name for case in CASES]
    height, distance = (trial_page.values(trial, what, names) for what in ("height", "distance"))
    figure = scatter(height, distance, {}, {})
    assert [axes.get_title(loc="left") for axes in figure.axes] == names
    naive = next(line for line in figure.axes[0].lines if line.get_color() == style.NAIVE)
    assert np.allclose(naive.get_xdata(), [0.38, 0.40, 0.42])
    rise = [up(flight) ** 2 / (2.0 * G) for flight in FLIGHTS["naive"]]
    assert np.allclose(naive.get_ydata() - naive.get_ydata()[0], np.subtract(rise, rise[0]))


def test_ratios_are_naive_over_matched_whichever_came_first(tmp_path: Path) -> None:
    few = made(tmp_path / "few", cases=CASES[:2], keep=False)
    assert not trial_page.naive_over_matched(few, "distance")
    forth = made(tmp_path / "a", ("matched", "naive"), CASES[:2], keep=False, times=2)
    back = made(tmp_path / "b", ("naive", "matched"), CASES[:2], keep=False, times=2)
    one, other = (trial_page.naive_over_matched(each, "distance") for each in (forth, back))
    assert [ratio.words for ratio in one] == [ratio.words for ratio in other]
    assert one[0].overall
    for ratio, same in zip(one, other, strict=True):
        assert ratio.value == pytest.approx(2.0)
        assert same.value == pytest.approx(2.0)
        assert same.interval[0] <= same.value <= same.interval[1]
    assert one[0].paper == published.PAPER_RATIOS["distance"]
    forward = next(ratio for ratio in one if ratio.words == "forward 1")
    assert forward.paper == pytest.approx(0.076 / 0.042)


def test_a_trace_begins_at_the_jump_input(trial: Results, tree: Path) -> None:
    found = trial_page.see(trial, tree / "trial")
    assert found is not None
    trace = found.height["matched"]["forward 1"][0]
    assert trace.time[0] == pytest.approx(-trial_page.BEFORE_S, abs=DT)
    assert trace.time[-1] <= trial_page.AFTER_S + 1e-9
    assert np.allclose(np.diff(trace.time), 1.0 / trial_page.TRACE_RATE_HZ)
    flight = FLIGHTS["matched"][0] / 1000.0
    inside = (trace.time > 0.2 + DT) & (trace.time < 0.2 + flight - DT)
    t = trace.time[inside] - 0.2
    expected = Z_OFF + 0.5 * G * flight * t - 0.5 * G * t**2
    assert np.allclose(trace.value[inside], expected, atol=1e-6)


def test_rates_are_those_of_the_acceleration_at_the_papers_speed_alone(
    trial: Results, tree: Path
) -> None:
    found = trial_page.see(trial, tree / "trial")
    assert found is not None
    assert set(found.roll["naive"]) == {RATES.name}
    runs = found.roll["naive"][RATES.name]
    assert len(runs) == 3
    assert runs[0].time[0] == pytest.approx(0.0)
    assert runs[0].time[-1] == pytest.approx(SCRIPT.run_s)
    assert np.allclose(runs[0].value, 2.0 * RATE * np.sin(TURN * runs[0].time), atol=1e-6)
    # A sine over nearly whole periods.
    assert rms(runs) == pytest.approx(2.0 * RATE / math.sqrt(2.0), rel=0.02)
    words = [text.get_text() for axes in rates(found.roll, found.pitch).axes for text in axes.texts]
    assert f"RMS {rms(runs):.2f} rad/s over 3 runs" in words
    assert "RMS 0.00 rad/s over 3 runs" in words


def test_torque_over_speed_stands_in_the_drives_limits(trial: Results, tree: Path) -> None:
    found = trial_page.see(trial, tree / "trial")
    assert found is not None
    hard = found.hardest
    assert hard is not None
    assert hard.row.policy == "matched"
    assert np.allclose(hard.torque, 0.5 * hard.velocity)
    figure = torque_speed(ROBOT, hard.velocity, hard.torque, look_of="matched", words="a jump")
    knee = next(axes for axes in figure.axes if axes.get_title(loc="left") == "knee")
    drive = ROBOT.joint("FR_knee").drive
    curves = [line for line in knee.lines if line.get_color() == style.MEASURED]
    above = max(curves, key=lambda line: float(np.sum(line.get_ydata())))
    at = dict(zip(np.round(above.get_xdata(), 6), above.get_ydata(), strict=True))
    assert at[0.0] == pytest.approx(drive.effort_limit)
    fast = 0.9 * drive.no_load_speed
    expected = drive.stall_torque * 0.1
    assert np.interp(fast, above.get_xdata(), above.get_ydata()) == pytest.approx(
        expected, rel=1e-3
    )
    points = max(knee.lines, key=lambda line: len(line.get_xdata()))
    assert np.allclose(points.get_ydata(), 0.5 * points.get_xdata())


def test_the_hardest_jump_has_the_least_margin(trial: Results) -> None:
    rows = [row for row in trial.rows if row.policy == "matched"]
    easy = replace(rows[0], figures=replace(rows[0].figures, torque_margin=(0.5,) * 12))
    hard = replace(rows[1], figures=replace(rows[1].figures, torque_margin=(0.9, *(0.1,) * 11)))
    missed = replace(rows[2], figures=JumpFigures(standing=True))
    assert trial_page.hardest([easy, hard, missed]) is hard
    assert trial_page.hardest([missed]) is None


def test_heights_draw_every_run_and_the_standing_height() -> None:
    time = np.linspace(-0.5, 2.0, 6)
    runs = {"matched": {"forward 1": [Trace(time=time, value=0.3 + 0.1 * time)] * 3}}
    axes = heights(runs, standing=0.29).axes[0]
    assert len(axes.lines) == 4
    assert axes.lines[-1].get_ydata()[0] == 0.29


def test_lines_are_drawn_in_order_with_their_bars_and_marks() -> None:
    x = np.array([0.4, 0.2])
    one = Line(x=x, y=np.array([0.0, 0.8]), low=np.array([0.0, 0.4]), high=np.array([0.4, 1.0]))
    panel = Panel(
        title="gap",
        x_label="size [m]",
        y_label="crossed [1]",
        lines={"matched": one},
        marks=(0.55,),
    )
    axes = lines([panel], across=1, mark="paper", bar="interval").axes[0]
    assert np.allclose(axes.lines[0].get_xydata(), [[0.2, 0.8], [0.4, 0.0]])
    assert axes.lines[-1].get_xdata()[0] == 0.55
    ends = axes.collections[0].get_segments()
    assert np.allclose(ends[0], [[0.2, 0.4], [0.2, 1.0]])


def test_crossings_become_shares_with_wilsons_interval() -> None:
    climb = climbs(crossed())[0]
    line = extra_pages.climb_line(climb)
    assert line.x.tolist() == [0.2, 0.4]
    assert line.y.tolist() == [0.8, 0.0]
    # Wilson with 4 of 5, z = 1.96.
    z2 = 1.959964**2
    middle = (0.8 + z2 / 10.0) / (1.0 + z2 / 5.0)
    half = math.sqrt(z2 * 0.8 * 0.2 / 5.0 + z2**2 / 100.0) / (1.0 + z2 / 5.0)
    assert (line.low[0], line.high[0]) == pytest.approx((middle - half, middle + half))


def test_a_varied_body_by_hand() -> None:
    found = varied()
    together = extra_pages.by_value(found, "trunk_mass_offset", "naive")
    line = extra_pages.figure_line(together, "height")
    assert line.x.tolist() == [0.0, 1.0]
    assert line.y == pytest.approx([0.4, 0.3])
    assert line.high - line.y == pytest.approx([0.01, 0.01])
    assert extra_pages.success_line(together).y.tolist() == [1.0, 0.0]
    drawn = extra_pages.variation_panels(found)
    assert [panel.marks for panel in drawn] == [(0.0,)] * 3
    assert list(drawn[0].lines) == ["naive", "matched"]


def test_a_mean_over_commands_leaves_out_what_was_not_found() -> None:
    assert extra_pages.known_mean([0.4, math.nan, 0.2]) == pytest.approx(0.3)
    assert math.isnan(extra_pages.known_mean([math.nan]))


def test_bodies_stand_side_by_side(tmp_path: Path) -> None:
    found = embodied(tmp_path)
    errors = extra_pages.errors_db(found)
    assert errors == pytest.approx(
        {"matched, body 1": 0.1, "naive, body 1": 0.6, "matched, body 2": 0.2, "naive, body 2": 1.2}
    )
    distance = extra_pages.by_body(found, "distance")
    assert set(distance) == set(errors)
    assert distance["naive, body 2"]["forward 1"] == pytest.approx([0.38, 0.40, 0.42])
    figure = argument(errors, {"distance [m]": distance}, named=False)
    assert len(figure.legends[0].get_texts()) == 3
    assert not figure.axes[0].texts


# --- The argument -------------------------------------------------------------------------------


def test_the_error_of_gains_is_the_map_between_its_nodes() -> None:
    joint = synthetic(legs=1).joints["FR_knee"]
    k, d = joint.grid_stiffness, joint.grid_damping
    # A map that cubic splines reproduce exactly.
    smooth = 0.5 * (k[:, None] - 20.0) ** 2 + 30.0 * (d[None, :] - 0.5) ** 2 + 0.01
    mapped = replace(joint, grid_error=smooth)
    expected = math.sqrt(0.5 * 1.3**2 + 30.0 * 0.07**2 + 0.01)
    assert joint_error_db(mapped, 21.3, 0.43) == pytest.approx(expected)
    assert joint_error_db(mapped, k[3], d[5]) == pytest.approx(math.sqrt(smooth[3, 5]))
    assert math.isnan(joint_error_db(mapped, 40.0, 0.43))
    assert math.isnan(joint_error_db(replace(joint, grid_error=np.empty((0, 0))), 20.0, 0.5))


def test_naive_gains_have_the_naive_error_of_the_match(trial: Results) -> None:
    match = synthetic()
    errors = bode_errors_db(trial, match)
    naive = [joint.naive_error_db for joint in match.joints.values()]
    assert errors["naive"] == pytest.approx(math.sqrt(np.mean(np.square(naive))), rel=0.02)
    assert errors["matched"] < errors["naive"]


def test_no_error_is_made_up_for_a_policy_outside_of_the_maps(trial: Results) -> None:
    far = replace(trial, subjects=(subject("matched", stiffness=(99.0,) * 12), *trial.subjects[1:]))
    assert bode_errors_db(far, synthetic()) == {}
    silent = replace(trial, subjects=(subject("matched", joint_names=()), *trial.subjects[1:]))
    assert bode_errors_db(silent, synthetic()) == {}


def test_the_nearest_match_above_a_trial_is_taken_and_none_above_the_root(tree: Path) -> None:
    found = match_near(tree / "trial", tree)
    assert found is not None
    assert set(found.joints) == {"FR_knee"}
    assert match_near(tree / "trial", tree / "trial") is None


def test_the_argument_draws_spread_over_error(trial: Results) -> None:
    distance = trial_page.values(trial, "distance", ["forward 1", "forward 2"])
    axes = argument({"matched": 0.1, "naive": 0.6}, {"distance [m]": distance}).axes[0]
    joined = [line for line in axes.lines if line.get_color() == "#b0b0b0"]
    assert len(joined) == 2
    assert np.allclose(joined[0].get_xydata(), [[0.1, 0.01], [0.6, 0.02]])
    mean = next(line for line in axes.lines if line.get_marker() == "_")
    assert mean.get_ydata()[0] in (pytest.approx(0.01), pytest.approx(0.02))
    assert [text.get_text() for text in axes.texts] == ["forward 1", "forward 2"]


# --- Films --------------------------------------------------------------------------------------


def test_films_go_into_the_page_small_and_at_their_speed(tree: Path) -> None:
    found = trial_page.clips(tree / "trial")
    assert found
    assert [one.caption for one in found.moving] == ["matched forward 2, virtual robot"]
    assert len(found.strips) == 1
    assert found.films == ("videos/matched_forward_2.mp4",)
    whole_film = (tree / "trial" / "videos" / "matched_forward_2.gif").read_bytes()
    assert base64.b64decode(found.moving[0].src.split(",")[1]) == whole_film
    wide = [Image.new("RGB", (640, 400), (i * 60, 9, 9)) for i in range(4)]
    data = io.BytesIO()
    wide[0].save(data, "GIF", save_all=True, append_images=wide[1:], duration=[40, 60, 80, 100])
    with Image.open(io.BytesIO(trial_page.smaller(data.getvalue()))) as film:
        assert film.size == (320, 200)
        times = []
        for i in range(film.n_frames):
            film.seek(i)
            times.append(film.info["duration"])
    assert times == [100, 180]


def test_a_folder_without_pictures_has_none(tmp_path: Path) -> None:
    assert not trial_page.clips(tmp_path)


# --- The paper, item by item --------------------------------------------------------------------

DOCS = Path(__file__).parents[1] / "docs"
LABELS = {"S": 7, "M": 5, "F": 13, "N": 3, "C": 4, "P": 2, "D": 10, "E": 7, "R": 8, "L": 4, "A": 23}


def test_every_label_of_the_checklist_has_its_place() -> None:
    text = (DOCS / "paper.md").read_text(encoding="utf-8")
    text += (DOCS / "readings.md").read_text(encoding="utf-8")
    said = set(re.findall(r"\b([A-Z]\d+)\b", text))
    for letter, first, last in re.findall(r"\b([A-Z])(\d+) to [A-Z](\d+)\b", text):
        said |= {f"{letter}{i}" for i in range(int(first), int(last) + 1)}
    for letter, count in LABELS.items():
        missing = {f"{letter}{i}" for i in range(1, count + 1)} - said
        assert not missing, sorted(missing)


def test_every_file_that_the_paper_page_names_exists() -> None:
    text = (DOCS / "paper.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`((?:[a-z_]+/)*[a-z_]+\.py)", text))
    assert len(named) > 40
    root = Path(build.__file__).parents[1]
    for name in named:
        assert (root / name).exists(), name
    for link in re.findall(r"\]\(([^)#]+)\)", text):
        assert (DOCS / link).exists(), link
