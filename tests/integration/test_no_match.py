"""A match that is none: its exit status, its marks, and who refuses it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from command_line import accepted, invoke, refused
from compliant_joint import DAMPING, STIFFNESS, write_log, write_model
from pronk.cli.export import TargetName
from pronk.errors import PronkError, UnmatchedError
from pronk.exit_status import ExitStatus
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.match.checks import check_explained_motion
from pronk.identify.match.export.targets import TARGETS, export
from pronk.identify.match.gains import load_gains
from pronk.identify.match.match import compared_flags, match
from pronk.identify.match.predict import predict
from pronk.identify.match.result import NO_MATCH
from pronk.identify.match.translate import translate
from pronk.identify.simulators.profiles import profile
from pronk.robots import load_robot

GAINS = f"j={STIFFNESS},{DAMPING}"


def match_words(folder: Path, log: Path) -> list[str | Path]:
    robot = folder / "bench.xml"
    gains = ("--drive-gains", GAINS, "--out", folder / "gains.yaml")
    return ["match", log, "--unit", "rad", "--robot", robot, *gains]


@pytest.fixture(scope="module")
def compliant(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the gains of a joint whose gear is a spring, and how the match ended."""
    folder = tmp_path_factory.mktemp("compliant")
    write_model(folder / "bench.xml")
    log = write_log(folder / "log.csv")
    command = invoke(match_words(folder, log))
    (folder / "status").write_text(str(command.exit_code))
    return folder


def test_a_match_that_is_none_has_a_status_and_a_mark(compliant: Path) -> None:
    assert int((compliant / "status").read_text()) == ExitStatus.NO_MATCH
    gains = load_gains(compliant / "gains.yaml")
    assert not gains.joints["j"].matched
    assert list(gains.unmatched) == ["j"]
    reason = " ".join(gains.joints["j"].reasons)
    assert f"{gains.joints['j'].quality.error_db:.2g} dB" in reason


def test_a_rigid_joint_is_a_match(tmp_path: Path) -> None:
    write_model(tmp_path / "bench.xml")
    log = write_log(tmp_path / "log.csv", gear=float("inf"))
    command = invoke(match_words(tmp_path, log))
    assert command.exit_code in (ExitStatus.DONE, ExitStatus.NOT_BETTER), command.output
    gains = load_gains(tmp_path / "gains.yaml")
    assert gains.joints["j"].matched
    assert gains.joints["j"].reasons == ()
    # The robot is found beside the gains, also from another folder.
    out = tmp_path / "out.py"
    accepted("export", tmp_path / "gains.yaml", "--to", "mjlab", "--out", out)
    assert "NO MATCH" not in out.read_text()


@pytest.mark.parametrize(
    "words",
    [
        ("export", "{gains}", "--to", "mjlab", "--out", "{out}/e.py"),
        ("export", "{gains}", "--to", "mjcf", "--per", "joint", "--out", "{out}/e.xml"),
        ("translate", "{gains}", "--to", "mjlab-builtin", "--out", "{out}/t.yaml"),
        ("predict", "{folder}/log.csv", "--unit", "rad", "--gains", "{gains}", "--out", "{out}"),
    ],
)
def test_commands_refuse_marked_joints_and_write_nothing(
    compliant: Path, tmp_path: Path, words: tuple[str, ...]
) -> None:
    gains = compliant / "gains.yaml"
    filled = [word.format(gains=gains, out=tmp_path, folder=compliant) for word in words]
    sentence = refused(*filled)
    reason = load_gains(gains).joints["j"].reasons[0]
    for part in ("gains.yaml", "j (", reason[:40], "--allow-unmatched"):
        assert part in sentence
    assert list(tmp_path.iterdir()) == []
    if words[0] == "predict":
        filled += ["--drive-gains", GAINS]
    accepted(*filled, "--allow-unmatched")
    assert list(tmp_path.iterdir())


@pytest.mark.parametrize("target", list(TARGETS))
def test_every_export_carries_the_mark(compliant: Path, target: TargetName) -> None:
    gains = load_gains(compliant / "gains.yaml")
    name = TARGETS[target].profile or "mjlab"
    robot = load_robot(compliant / "bench.xml")
    gains, _ = translate(gains, robot, profile(name), allow_unmatched=True)
    with pytest.raises(UnmatchedError, match="j "):
        export(gains, target)
    for per in ("group", "joint"):
        text = export(gains, target, per=per, allow_unmatched=True)  # type: ignore[arg-type]
        assert "NO MATCH of j" in text
        assert "matched by pronk" not in text.replace("not matched by pronk", "")


def test_a_translation_keeps_the_mark(compliant: Path, tmp_path: Path) -> None:
    out = tmp_path / "t.yaml"
    gains = compliant / "gains.yaml"
    accepted("translate", gains, "--to", "drake", "--out", out, "--allow-unmatched")
    assert load_gains(out).joints["j"].reasons == load_gains(gains).joints["j"].reasons
    assert "j" in refused("export", out, "--to", "mjcf", "--out", tmp_path / "e.xml")


def test_a_file_of_an_earlier_version_counts_as_matched(compliant: Path, tmp_path: Path) -> None:
    body = yaml.safe_load((compliant / "gains.yaml").read_text())
    del body["joints"]["j"]["matched"]
    del body["joints"]["j"]["reasons"]
    del body["robot_path"]
    path = tmp_path / "gains.yaml"
    path.write_text(yaml.safe_dump(body))
    assert load_gains(path).unmatched == {}
    assert "--robot" in refused("export", path, "--to", "mjcf", "--out", tmp_path / "e.xml")
    robot = ("--robot", compliant / "bench.xml")
    accepted("export", path, "--to", "mjcf", "--out", tmp_path / "e.xml", *robot)


def test_a_robot_that_moved_away_is_named(compliant: Path, tmp_path: Path) -> None:
    path = tmp_path / "gains.yaml"
    path.write_text((compliant / "gains.yaml").read_text())
    words = ("export", path, "--to", "mjcf", "--out", tmp_path / "e.xml", "--allow-unmatched")
    sentence = refused(*words)
    assert "bench.xml" in sentence
    assert "--robot" in sentence


def test_the_python_api_refuses_alike(compliant: Path) -> None:
    gains = load_gains(compliant / "gains.yaml")
    robot = load_robot(compliant / "bench.xml")
    with pytest.raises(UnmatchedError, match="allow_unmatched"):
        export(gains, "mjlab", robot)
    with pytest.raises(UnmatchedError):
        translate(gains, robot, profile("drake"))
    log = JointLog(
        robot="bench",
        joints=("j",),
        time=np.arange(400) / 200.0,
        command=np.zeros((400, 1)),
        position=np.zeros((400, 1)),
    )
    with pytest.raises(UnmatchedError):
        predict(log, robot, gains)


def moved_together(gears: dict[str, float], folder: Path) -> JointLog:
    """A log in which two joints move at once, each by itself."""
    columns = {}
    for seed, (joint, gear) in enumerate(gears.items()):
        path = write_log(folder / f"{joint}.csv", joint, gear, seed)
        columns[joint] = np.loadtxt(path, delimiter=",", skiprows=1)
    time = columns["a"][:, 0]
    return JointLog(
        robot="bench",
        joints=tuple(gears),
        time=time,
        command=np.column_stack([rows[:, 1] for rows in columns.values()]),
        position=np.column_stack([rows[:, 2] for rows in columns.values()]),
    )


def test_joints_that_move_together_are_judged_too(tmp_path: Path) -> None:
    robot = load_robot(write_model(tmp_path / "bench.xml", ("a", "b")))
    gains = {"a": (STIFFNESS, DAMPING), "b": (STIFFNESS, DAMPING)}
    rigid = moved_together({"a": float("inf"), "b": float("inf")}, tmp_path)
    result = match([rigid], robot, drive_gains=gains)
    assert result.matched_joints == ("a", "b")
    responses = result.joints["b"].responses
    assert responses is not None
    assert compared_flags(responses) == ()
    (flag,) = compared_flags(replace(responses, matched=1.5 * responses.matched))
    assert flag.startswith(NO_MATCH)
    position = rigid.position[:, 0]
    assert check_explained_motion([position], [position + 0.1]) == ()
    (flag,) = check_explained_motion([position], [0.0 * position])
    assert flag.startswith(NO_MATCH)
    with pytest.raises(PronkError, match="method paper"):
        match([rigid], robot, method="paper", drive_gains=gains)


def test_a_robot_without_rotor_inertia_is_no_match(tmp_path: Path) -> None:
    """The gains of such a model may answer alike and be several times too small."""
    model = write_model(tmp_path / "bench.xml")
    model.write_text(model.read_text().replace('armature="0.03"', ""))
    log = write_log(tmp_path / "log.csv", gear=float("inf"))
    command = invoke(match_words(tmp_path, log))
    assert command.exit_code == ExitStatus.NO_MATCH
    assert "nan" not in command.output.lower()
    assert any(
        "armature" in reason for reason in load_gains(tmp_path / "gains.yaml").unmatched["j"]
    )
