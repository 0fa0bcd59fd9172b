"""Pages of the report: whole, self-contained, escaped; damaged and missing artefacts."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from html import unescape
from pathlib import Path

import numpy as np
import pytest

from command_line import accepted
from fine_joint import JOINT, FineJoint
from pronk.errors import ArtefactError
from pronk.identify.match import gains as gains_file
from pronk.identify.match.export.targets import export
from pronk.identify.match.predict import Prediction, save_prediction
from pronk.identify.match.result import MatchResult
from pronk.identify.simulators.info import SimulatorInfo
from pronk.identify.simulators.profiles import load_profiles
from pronk.jump.trial import tables
from pronk.jump.trial.jumps import JumpFigures
from pronk.jump.trial.results import load_results, save_results
from pronk.report import build, charts, match_page
from pronk.robots import load_robot
from report_cases import (
    CASES,
    joint_prediction,
    joint_result,
    match,
    write_match,
    write_tree,
    write_trial,
)

NASTY = "<img src=x onerror=alert(1)>"


class Checker:
    """Anchors, pictures and text of a page that is whole and needs no network."""

    def __init__(self, html: str) -> None:
        # The library of the plots is known, and names its own address in a comment.
        html = html.replace(charts.chart_library(), "")
        scripts: list[tuple[str, str]] = re.findall(r"(?s)<script([^>]*)>(.*?)</script>", html)
        self.charts = []
        own_scripts = 0
        for attributes, script in scripts:
            if attributes:
                assert attributes == ' type="application/json"'
                self.charts.append(json.loads(script))
            else:
                own_scripts += 1
        assert own_scripts == bool(self.charts)
        html = re.sub(r"(?s)<script[^>]*>.*?</script>", "", html)
        opened: list[str] = []
        for end, tag in re.findall(r"<(/?)(\w+)", html):
            if end:
                assert opened.pop() == tag
            elif tag not in ("meta", "link", "img", "br"):
                opened.append(tag)
        assert opened == []
        self.ids = re.findall(r' id="([^"]*)"', html)
        assert len(self.ids) == len(set(self.ids))
        links = re.findall(r' href="#([^"]*)"', html)
        assert set(links) <= set(self.ids)
        # Each address is an anchor or holds what it is of.
        addresses = re.findall(r' (?:src|href)="([^"]*)"', html)
        for address in addresses:
            assert address.startswith(("data:", "#"))
        for word in ("<script", "@import", "http://", "https://", "<iframe", "<object", "url("):
            assert word not in html
        self.pictures: list[tuple[str, str]] = re.findall(r'<img src="([^"]*)" alt="([^"]*)"', html)
        text = unescape(re.sub(r"(?s)<style>.*?</style>|<[^>]*>", " ", html))
        assert "nan" not in re.sub(r"[A-Za-z]+nan|nan[a-z]+", "", text).lower()
        self.text = re.sub(r"\s+", " ", text)


def report(folder: Path) -> Checker:
    return Checker(build.write_report(folder)[0].read_text(encoding="utf-8"))


def match_report(folder: Path) -> Checker:
    return Checker(build.write_artefact_page(folder / "match.npz").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tree(tmp_path_factory.mktemp("tree"))


@pytest.fixture(scope="module")
def html(tree: Path) -> str:
    return build.write_report(tree)[0].read_text(encoding="utf-8")


def test_the_page_of_everything(tree: Path, html: str) -> None:
    page = Checker(html)
    assert {"trial", "match"} < set(page.ids)
    for section in ("films", "jumps-beside-those-of-the-paper", "figures"):
        assert f"trial-{section}" in page.ids
    assert "match-matched-gains" in page.ids
    assert page.ids.index("match") < page.ids.index("trial")
    assert len(html.encode()) < 8e6
    assert len(page.pictures) > 7
    # The film of the nominal policy stands beside that of the matched one.
    films = [text for address, text in page.pictures if address.startswith("data:image/gif")]
    assert films
    image_types = set()
    for address, alternative_text in page.pictures:
        assert len(alternative_text) > 20
        image_types.add(address.split(";")[0])
    assert image_types == {"data:image/svg+xml", "data:image/png", "data:image/gif"}


def test_tables_hashes_seeds_and_versions_are_on_the_page(tree: Path, html: str) -> None:
    text = Checker(html).text.replace("_", " ")
    trial = load_results(tree / "trial")
    scatter = {tables.scatter_table(trial, other.name).title for other in trial.subjects[1:]}
    for table in tables.trial_tables(trial):
        if table.title in scatter:  # There are three jumps a command, too few for statistics.
            continue
        for row in table.text_rows():
            for cell in row:
                printed = cell.replace("+-", "±").replace(">=", "≥").replace("<=", "≤")
                printed = "–" if printed == "-" else printed.split(": ")[-1].replace("_", " ")
                assert printed in text, (table.title, cell)
    for subject in trial.subjects:
        assert subject.sha256 in html
    for word in ("ab" * 32, "seed 3", "pronk 0.1.0"):
        assert word in html


def test_numbers_of_the_virtual_robot_are_called_so(html: str, tmp_path: Path) -> None:
    assert 'class="badge">virtual robot<' in html
    real = match_report(write_match(tmp_path, match(virtual=False, legs=1), prediction=True))
    assert "virtual robot" not in real.text


def test_outcomes_of_the_parts(html: str) -> None:
    text = Checker(html).text
    for words in (
        "matched, virtual robot",
        "paper, matched",
        "hardware",
        "a simulated machine",
    ):
        assert words in text


def test_the_page_of_a_match(tmp_path: Path) -> None:
    result = match()
    page = match_report(write_match(tmp_path, result, prediction=True))
    optional = {"match-prediction-of-logs-that-the-match-did-not-use"}
    assert {"match-bode-plots", "match-what-it-rests-on", *optional} < set(page.ids)
    assert len(page.charts) == 12
    assert len(result.matched_joints) == len(result.joints) == 12
    squared_errors = []
    for joint in result.joints.values():
        squared_errors.append(joint.gains.quality.error_db**2)
    expected = np.sqrt(np.mean(squared_errors))
    assert result.error_db == pytest.approx(expected)
    numbers = ("12 joints matched", f"{expected:.2f} dB", "3.11.0", "dc_motor_pd", "0.516")
    for words in (*numbers, *result.gains.logs.values(), *result.joints):
        assert words.replace("_", " ") in page.text.replace("_", " ")
    result = match(legs=1)
    bare = {}
    for name, joint in result.joints.items():
        bare[name] = replace(joint, zero_armature=None)
    (tmp_path / "fresh.prediction.npz").unlink()
    ids = match_report(write_match(tmp_path, replace(result, joints=bare))).ids
    assert not optional & set(ids)


def test_replays_of_other_gains_and_of_logs_that_were_used_are_no_predictions(
    tmp_path: Path,
) -> None:
    result = match(legs=1)
    write_match(tmp_path, result)
    knee = result.gains.joints["FR_knee"]
    used_gains = {"FR_knee": (knee.stiffness.value, knee.damping.value)}
    replay = Prediction(
        joints=(joint_prediction(),), virtual=True, source="fresh.mcap", gains=used_gains
    )
    prediction_id = "match-prediction-of-logs-that-the-match-did-not-use"
    replay_id = "match-replay-of-logs-that-the-match-used"
    path = tmp_path / "a.prediction.npz"
    save_prediction(path, replay)
    ids = match_report(tmp_path).ids
    assert prediction_id in ids
    assert replay_id not in ids
    save_prediction(path, replace(replay, fitted=True))
    ids = match_report(tmp_path).ids
    assert replay_id in ids
    assert prediction_id not in ids
    other_gains = {"FR_knee": (1.01 * knee.stiffness.value, knee.damping.value)}
    save_prediction(path, replace(replay, gains=other_gains))
    page = match_report(tmp_path)
    assert not {prediction_id, replay_id} & set(page.ids)
    assert path.name in page.text


@pytest.mark.parametrize("name", load_profiles())
def test_the_page_names_exports_that_take_the_gains(tmp_path: Path, name: str) -> None:
    result = replace(match(legs=1), simulator=load_profiles()[name].info)
    write_match(tmp_path, result)
    exports = match_page.match_part(tmp_path / "match.npz").content["exports"]
    assert exports
    for target, _ in exports:
        assert export(result.gains, target)


def test_no_export_is_named_for_a_simulator_of_an_unknown_law(tmp_path: Path) -> None:
    result = replace(match(legs=1), simulator=SimulatorInfo(engine="my engine"))
    page = match_report(write_match(tmp_path, result))
    assert "pronk export" not in page.text
    assert "pronk translate" not in page.text


def test_a_robot_of_its_own_is_read_from_its_file(tmp_path: Path) -> None:
    """Groups are those of the robot's file, which has the gains of the drives too."""
    robot = load_robot(FineJoint().write_robot(tmp_path / "robot"))
    joint = joint_result("knee")
    gains = MatchResult(
        robot="fine",
        simulator=SimulatorInfo(),
        joints={JOINT: replace(joint, joint=JOINT)},
        groups={JOINT: match(legs=1).groups["knee"]},
        robot_path=robot.source,
    )
    write_match(tmp_path, gains)
    content = match_page.match_part(tmp_path / "match.npz").content
    stiffness = robot.joint(JOINT).stiffness
    assert content["scale"].rows[0][1] == pytest.approx(joint.gains.stiffness.value / stiffness)
    stated_joint = replace(joint, joint=JOINT, drive_gains=(30.0, 0.6))
    write_match(tmp_path, replace(gains, joints={JOINT: stated_joint}))
    content = match_page.match_part(tmp_path / "match.npz").content
    assert content["scale"].rows[0][1] == pytest.approx(joint.gains.stiffness.value / 30.0)


def test_joints_belong_to_the_groups_of_the_robot_where_it_is_known() -> None:
    result = match(legs=2)
    robot = load_robot("mini_cheetah")
    members = result.joints_of_groups({joint.name: joint for joint in robot.joints})
    assert list(members) == list(result.groups)
    for group, names in members.items():
        assert names == [joint.name for joint in robot.group(group) if joint.name in result.joints]
    # Joints of the robot's file may be called anything.
    renamed = {}
    for joint in robot.joints:
        renamed[joint.name] = replace(joint, group="knee")
    assert result.joints_of_groups(renamed)["knee"] == list(result.joints)
    # Without the file the names alone tell.
    assert result.joints_of_groups({}) == members


def test_the_curves_of_a_chart_are_those_of_the_responses(tmp_path: Path) -> None:
    result = match(legs=1)
    page = match_report(write_match(tmp_path, result))
    responses = result.joints["FR_knee"].responses
    assert responses is not None
    chart = next(chart for chart in page.charts if chart["title"] == "FR knee")
    gain, error, _ = chart["panels"]
    hz = np.array(chart["frequency_hz"])
    measured = responses.measured[0]
    expected_db = np.interp(hz, measured.frequency_hz, 20.0 * np.log10(measured.gain))
    np.testing.assert_allclose(gain["curves"]["measured"], expected_db, atol=0.02)
    difference_db = np.subtract(gain["curves"]["matched"], gain["curves"]["measured"])
    np.testing.assert_allclose(error["curves"]["matched"], difference_db, atol=0.02)
    assert chart["band_hz"] == list(responses.band_hz)


def test_a_joint_without_a_match_is_a_warning(tmp_path: Path) -> None:
    result = match(legs=1)
    warning = "no match: the best gains miss the measured response by 2 dB RMS"
    knee = result.joints["FR_knee"]
    marked = replace(knee.gains, flags=(warning,), matched=False, reasons=(warning,))
    bad = replace(knee, gains=marked)
    write_match(tmp_path, replace(result, joints={**result.joints, "FR_knee": bad}))
    part = match_page.match_part(tmp_path / "match.npz")
    assert part.warning
    assert part.figures["matched"] == 2
    assert warning in part.figures["flags"]["FR_knee"]


def test_text_of_files_is_escaped(tmp_path: Path) -> None:
    result = match(legs=1)
    write_match(tmp_path, replace(result, logs={NASTY: "0" * 64}))
    write_trial(tmp_path, ("matched",), CASES[:1])
    body = json.loads((tmp_path / "summary.json").read_text())
    body["sim_params"]["file"] = body["subjects"][0]["path"] = NASTY
    (tmp_path / "summary.json").write_text(json.dumps(body))
    text = build.write_report(tmp_path)[0].read_text(encoding="utf-8")
    assert NASTY not in text
    assert text.count("&lt;img src=x onerror=alert(1)&gt;") == 3


def test_one_policy_that_never_jumps_without_captures_or_match(tmp_path: Path) -> None:
    trial = write_trial(tmp_path, ("matched",), CASES[:2])
    rows = []
    for row in trial.rows:
        rows.append(replace(row, figures=JumpFigures(standing=True, fell=True)))
    save_results(tmp_path, replace(trial, rows=tuple(rows)))
    page = report(tmp_path)
    assert "0 of 6 commanded jumps landed" in page.text
    assert "6 did not leave the ground" in page.text
    assert "trial-films" not in page.ids


def test_missing_captures_are_counted(tmp_path: Path) -> None:
    trial = write_trial(tmp_path, ("matched",), CASES[:1], keep=True)
    (tmp_path / trial.rows[1].capture).unlink()
    text = report(tmp_path).text
    assert "2 of 3 jumps, those with a capture" in text
    assert "1 capture is missing" in text


@pytest.mark.parametrize(
    ("name", "bytes_kept"),
    [
        ("trial/summary.json", 300),
        ("trial/captures/naive_forward_1_001.npz", 500),
        ("trial/videos/matched_forward_2.gif", 5),
        ("match.npz", 100),
    ],
)
def test_damage_is_one_sentence_and_no_page(
    tree: Path, tmp_path: Path, name: str, bytes_kept: int
) -> None:
    ignore = shutil.ignore_patterns(build.PAGE_NAME)
    shutil.copytree(tree, tmp_path, ignore=ignore, dirs_exist_ok=True)
    damaged = tmp_path / name
    damaged.write_bytes(damaged.read_bytes()[:bytes_kept])
    with pytest.raises(ArtefactError, match=damaged.stem) as refusal:
        build.write_report(tmp_path)
    assert "\n" not in str(refusal.value)
    assert not (tmp_path / build.PAGE_NAME).exists()


def test_missing_artefacts_are_named(tmp_path: Path) -> None:
    with pytest.raises(ArtefactError, match="no such folder"):
        match_page.find_gains(tmp_path / "nowhere")
    with pytest.raises(ArtefactError, match=r"gains\.yaml"):
        match_page.find_gains(tmp_path)
    gains_file.save_gains(tmp_path / "gains.yaml", match(legs=1).gains)
    with pytest.raises(ArtefactError, match=r"match\.npz"):
        build.write_artefact_page(tmp_path / "match.npz")
    assert not (tmp_path / "match.html").exists()


def test_gains_under_another_name_are_found(tmp_path: Path) -> None:
    write_match(tmp_path, match(legs=1))
    (tmp_path / "gains.yaml").rename(tmp_path / "tuesday.yaml")
    (tmp_path / "other.yaml").write_text("just: something\n")
    assert match_page.find_gains(tmp_path).name == "tuesday.yaml"
    gains_file.save_gains(tmp_path / "wednesday.yaml", match(legs=1).gains)
    with pytest.raises(ArtefactError, match="several gains files"):
        match_page.find_gains(tmp_path)


def test_the_page_names_the_gains_of_its_match_beside_those_of_another(tmp_path: Path) -> None:
    result = match(legs=1)
    softer = {}
    for name, joint in result.gains.joints.items():
        stiffness = replace(joint.stiffness, value=0.9 * joint.stiffness.value)
        softer[name] = replace(joint, stiffness=stiffness)
    gains_file.save_gains(tmp_path / "gains.yaml", replace(result.gains, joints=softer))
    gains_file.save_gains(tmp_path / "today.yaml", result.gains)
    assert match_page.find_gains(tmp_path, result.gains).name == "today.yaml"


def test_the_command_writes_the_page_and_its_figures(tmp_path: Path) -> None:
    write_trial(tmp_path / "trial", ("matched",), CASES[:1])
    figures = tmp_path / "figures.json"
    accepted("report", tmp_path, "--json", figures)
    assert (tmp_path / "report.html").exists()
    parts = json.loads(figures.read_text())["parts"]
    assert [part["source"] for part in parts] == ["trial/summary.json"]
    assert parts[0]["checks"][0]["name"] == "forward 1: height"
