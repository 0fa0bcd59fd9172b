"""Refusals of every command: status 2, one sentence, and the folder is as it was before.

`test_bad_input` has bad words of the command line; here the files are sound, damaged, or of
another robot, joint or kind.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import yaml

import report_cases
from chirp_logs import chirp_log
from command_line import invoke
from log_files import write_csv, write_mcap, write_npz
from pronk.cli.export import TargetName
from pronk.identify.match.gains import load_gains, save_gains
from pronk.robots import load_robot

ROOT = Path(__file__).parents[2]
POLICY = ROOT / "policies" / "matched" / "policy.onnx"
JOINT = "FR_knee"
STATED = f"--unit rad --drive-gains {JOINT}=17,.4"
URDF = """<robot name="r"><link name="base"/><link name="leg"><inertial><origin xyz="0 0 -0.1"/>
<mass value="1.0"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>
</link><joint name="knee" type="revolute"><parent link="base"/><child link="leg"/>
<axis xyz="0 1 0"/><limit lower="-1.0" upper="1.5" effort="10" velocity="20"/></joint></robot>
"""


@dataclass(frozen=True)
class FileState:
    """What is compared of a file or folder."""

    data: bytes
    modified_ns: int


def state_of(folder: Path) -> dict[str, FileState]:
    """Return every file and folder below a folder, hidden ones too, with its bytes and time."""
    states = {}
    for path in sorted(folder.rglob("*")):
        data = path.read_bytes() if path.is_file() else b""
        states[str(path.relative_to(folder))] = FileState(data, path.stat().st_mtime_ns)
    return states


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sound files of every kind, and the same cut, emptied, of other robots, joints and schemas."""
    folder = tmp_path_factory.mktemp("inputs")
    robot = load_robot("mini_cheetah")
    log = chirp_log(robot, JOINT, (17.0, 0.4), (0.2, 0.1), noise_rad=1e-4)
    write_csv(folder / "good.csv", log)
    write_npz(folder / "good.npz", log)
    write_mcap(folder / "good.mcap", log)
    write_mcap(folder / "other.mcap", replace(log, robot="go2"))
    write_csv(folder / "strange.csv", replace(log, joints=("tail",), segments=()))
    rows = (folder / "good.csv").read_text().splitlines()
    (folder / "header.csv").write_text(rows[0] + "\n")
    (folder / "short.csv").write_text("\n".join(rows[:40]) + "\n")
    (folder / "holes.csv").write_text("\n".join([*rows[:900], rows[900] + ",7", *rows[901:]]))
    (folder / "words.csv").write_text("\n".join([*rows[:900], "a,b,c", *rows[901:]]))
    still = replace(log, command=0.0 * log.command, position=0.0 * log.position)
    write_csv(folder / "still.csv", replace(still, segments=()))
    backward = np.array(rows[1:])[::-1]
    (folder / "backward.csv").write_text("\n".join([rows[0], *backward]) + "\n")
    (folder / "empty.csv").write_text("")
    data = (folder / "good.npz").read_bytes()
    (folder / "cut.npz").write_bytes(data[: len(data) // 2])
    data = (folder / "good.mcap").read_bytes()
    (folder / "cut.mcap").write_bytes(data[:300])
    (folder / "noise.mcap").write_bytes(bytes(range(256)) * 4)
    (folder / "empty").mkdir()

    report_cases.write_match(folder / "matched", report_cases.match(legs=1))
    gains = folder / "gains.yaml"
    shutil.copy(folder / "matched" / "gains.yaml", gains)
    sound = load_gains(gains)
    unmatched = {}
    for name, joint in sound.joints.items():
        unmatched[name] = replace(joint, matched=False, reasons=("10 dB from the log",))
    save_gains(folder / "unmatched.yaml", replace(sound, joints=unmatched))
    save_gains(folder / "unknown_robot.yaml", replace(sound, robot="spot"))
    text = gains.read_text()
    (folder / "cut.yaml").write_text(text[: len(text) // 2])
    (folder / "schema.yaml").write_text(text.replace("pronk/gains/", "pronk/toes/", 1))
    (folder / "number.yaml").write_text("schema: 7\n")
    (folder / "list.yaml").write_text("- 1\n- 2\n")
    raw = yaml.safe_load(text)
    joint = next(iter(raw["joints"]))
    raw["joints"][joint]["stiffness"] = "stiff"
    (folder / "word.yaml").write_text(yaml.safe_dump(raw))

    policy = POLICY.read_bytes()
    (folder / "policy.onnx").write_bytes(policy)
    (folder / "cut.onnx").write_bytes(policy[: len(policy) // 2])
    (folder / "text.onnx").write_text("a policy")
    (folder / "model.urdf").write_text(URDF)
    (folder / "robot.yaml").write_text("schema: pronk/robot/1\nname: r\nmodel: none.xml\n")
    (folder / "cut.urdf").write_text(URDF[:120])
    (folder / "fixed.urdf").write_text(URDF.replace("revolute", "fixed"))
    (folder / "text.yaml").write_text("not: [closed\n")
    return folder


@pytest.fixture
def folder(inputs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the inputs as the working directory."""
    work = tmp_path / "work"
    shutil.copytree(inputs, work)
    monkeypatch.chdir(work)
    return work


MATCH = "--robot mini_cheetah --out out/gains.yaml"
SWEEP = f"sweep mini_cheetah --joints {JOINT} --repeats 1 --out"
TRANSLATE = "translate --robot mini_cheetah --from mjlab"
REFUSED = [
    # Logs that are not there, damaged, of another robot or joint, or hold no excitation.
    f"match none.csv {MATCH} {STATED}",
    f"match empty {MATCH} {STATED}",
    f"match empty.csv {MATCH} {STATED}",
    f"match header.csv {MATCH} {STATED}",
    f"match short.csv {MATCH} {STATED}",
    f"match holes.csv {MATCH} {STATED}",
    f"match words.csv {MATCH} {STATED}",
    f"match still.csv {MATCH} {STATED}",
    f"match backward.csv {MATCH} {STATED}",
    f"match cut.npz {MATCH} {STATED}",
    f"match cut.mcap {MATCH}",
    f"match noise.mcap {MATCH}",
    f"match other.mcap {MATCH}",
    f"match strange.csv {MATCH} --unit rad --drive-gains default",
    f"match gains.yaml {MATCH}",
    f"match policy.onnx {MATCH}",
    # Options of a match that do not fit.
    f"match good.csv --robot spot --out out/gains.yaml {STATED}",
    f"match good.csv --robot text.yaml --out out/gains.yaml {STATED}",
    f"match good.csv {MATCH} --drive-gains {JOINT}=17,.4",
    f"match good.csv {MATCH} --unit rad --drive-gains {JOINT}=-17,.4",
    f"match good.csv {MATCH} --unit rad --drive-gains {JOINT}=nan,.4",
    f"match good.csv {MATCH} --unit rad --drive-gains tail=17,.4",
    f"match good.csv {MATCH} {STATED} --for gazebo",
    f"match good.csv {MATCH} {STATED} --for mjlab --for gazebo",
    f"match good.csv {MATCH} {STATED} --for mjlab,timestep_s=9",
    f"match good.csv {MATCH} {STATED} --fit toes",
    f"match good.csv {MATCH} {STATED} --segment-s -1",
    f"match good.csv {MATCH} {STATED} --segment-s 1e9",
    f"match good.csv {MATCH} {STATED} --time-unit ms",
    f"match good.csv {MATCH} {STATED} --simulator none.py:Engine",
    f"match good.csv --robot mini_cheetah --out good.csv/gains.yaml {STATED}",
    f"match good.csv --robot mini_cheetah --out out/gains.txt {STATED}",
    f"match good.csv --robot mini_cheetah --out empty {STATED}",
    # Responses and predictions.
    "response cut.npz --unit rad --out out",
    "response still.csv --unit rad --out out",
    "response good.csv --unit rad --segment-s 0 --out out",
    "response good.csv --unit rad --out good.npz",
    "predict good.csv --gains none.yaml --unit rad --out out",
    "predict good.csv --gains cut.yaml --unit rad --out out",
    "predict good.csv --gains word.yaml --unit rad --out out",
    "predict good.csv --gains unmatched.yaml --unit rad --out out",
    "predict strange.csv --gains gains.yaml --robot mini_cheetah --unit rad --out out",
    "predict other.mcap --gains gains.yaml --robot mini_cheetah --out out",
    "predict good.csv --gains gains.yaml --robot go2 --unit rad --out out",
    "predict good.csv --gains gains.yaml --robot mini_cheetah --unit rad --out good.npz",
    # Gains files.
    "export cut.yaml --to mjlab --out out/a.py",
    "export schema.yaml --to mjlab --out out/a.py",
    "export number.yaml --to mjlab --out out/a.py",
    "export list.yaml --to mjlab --out out/a.py",
    "export word.yaml --to mjlab --out out/a.py",
    "export text.yaml --to mjlab --out out/a.py",
    "export good.csv --to mjlab --out out/a.py",
    "export empty --to mjlab --out out/a.py",
    "export unmatched.yaml --to mjlab --out out/a.py",
    "export unknown_robot.yaml --to mjlab --out out/a.py",
    "export gains.yaml --to mjlab --robot go2 --out out/a.py",
    "export gains.yaml --to mjlab --out good.csv/a.py",
    "export gains.yaml --to mjlab --out empty",
    "translate cut.yaml --to mjlab-builtin --out out/t.yaml",
    "translate unmatched.yaml --to mjlab-builtin --out out/t.yaml",
    "translate gains.yaml --to gazebo --out out/t.yaml",
    "translate gains.yaml --to mjlab-builtin --to gazebo --out out/t.yaml",
    "translate gains.yaml --to mjlab-builtin --to mjlab,timestep_s=0.05 --out out/t.yaml",
    "translate gains.yaml --to mjlab-builtin --robot go2 --out out/t.yaml",
    "translate gains.yaml --to mjlab-builtin --out good.csv/t.yaml",
    "translate gains.yaml --to mjlab-builtin --out empty",
    f"{TRANSLATE} --drive-gains {JOINT}=0,0 --to drake --out t.yaml",
    f"{TRANSLATE} --drive-gains {JOINT}=x,1 --to drake --out t.yaml",
    # Sweeps and simulators.
    f"{SWEEP} out --amplitude 1000000",
    f"{SWEEP} out --amplitude -0.1",
    f"{SWEEP} out --amplitude nan",
    f"{SWEEP} good.csv",
    f"{SWEEP} good.csv/out",
    f"{SWEEP} out --sim-params text.yaml",
    f"{SWEEP} out --sim-params none.yaml",
    "sweep mini_cheetah --joints tail --out out",
    "sweep mini_cheetah --repeats 0 --out out",
    "sweep robot.yaml --out out",
    "sweep cut.urdf --out out",
    "probe mujoco --robot spot",
    "probe mujoco --robot mini_cheetah --joint tail",
    "probe none.py:Engine --robot mini_cheetah",
    # Robots.
    "robot new cut.urdf",
    "robot new fixed.urdf --overwrite",
    "robot new model.urdf",
    "robot new empty",
    "robot new text.onnx",
    "robot check robot.yaml",
    "robot check text.yaml",
    "robot check gains.yaml",
    "robot check spot",
    # Descriptions of logs.
    "log inspect none.csv",
    "log inspect cut.npz --yes",
    "log inspect empty.csv --yes",
    "log inspect good.csv --robot spot --yes",
    # Policies.
    "trial cut.onnx --out out",
    "trial text.onnx --out out",
    "trial policy.onnx --commands 9 --out out",
    "trial policy.onnx --conditions none.yaml --out out",
    "trial policy.onnx --conditions text.yaml --out out",
    "trial policy.onnx --sim-params text.yaml --out out",
    "play cut.onnx",
    "play policy.onnx --robot go2",
    "deploy cut.onnx --log out/a.mcap",
    "deploy policy.onnx --robot go2 --script 1,0,0 --log out/a.mcap",
    "deploy policy.onnx --script walk --log out/a.mcap",
    "deploy policy.onnx --script 1,0,0 --log good.csv/a.mcap",
    "deploy policy.onnx --script 1,0,0 --capture good.csv/a.npz",
    "deploy policy.onnx --script 1,0,0 --seconds -1",
    "deploy policy.onnx --script 1,0,0 --seconds nan",
    "simulate spot",
    "simulate --base ground --duration 1 --capture good.csv/a.npz",
    "simulate --duration nan",
    "simulate --sim-params text.yaml",
    "simulate --duration -1",
    # Pages.
    "report empty",
    "report none",
    "report good.csv",
    "demo --out good.csv",
    "demo --out out --policies empty",
]
"""Command lines; each is refused."""


@pytest.mark.parametrize("words", REFUSED)
def test_a_refusal_is_one_sentence_and_leaves_the_folder_as_it_was(
    folder: Path, words: str
) -> None:
    before = state_of(folder)
    command = invoke(words.split())
    assert command.exit_code == 2, command.output
    assert "Traceback" not in command.output
    assert "Error:" not in command.stderr
    lines = command.stderr.strip().splitlines()
    sentences = [line for line in lines if line.startswith("pronk: ")]
    assert sentences == lines[-1:], command.stderr
    assert sentences[0].rstrip().endswith("."), sentences[0]
    assert state_of(folder) == before


def test_targets_are_refused_alike(folder: Path) -> None:
    """Every target of an export refuses a joint that is no match and writes nothing."""
    before = state_of(folder)
    for target in TargetName.__args__:  # type: ignore[attr-defined]
        words = ["export", "unmatched.yaml", "--to", target, "--out", f"out/{target}.txt"]
        assert invoke(words).exit_code == 2
    assert state_of(folder) == before
