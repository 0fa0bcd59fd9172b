"""The command line: good input comes out as files and tables, bad input as one sentence."""

from __future__ import annotations

import io
import json
import pickle
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from pronk.cli import main as cli
from pronk.errors import PronkError
from pronk.logs.readers import find_logs

COMMANDS = (
    "sweep",
    "response",
    "match",
    "predict",
    "train",
    "evaluate",
    "export",
    "trial",
    "play",
    "deploy",
    "simulate",
    "report",
    "demo",
)


def refused(capsys, *arguments: str | Path) -> str:
    """Run a command that must be refused; return its one sentence."""
    status = cli.run([str(a) for a in arguments])
    shown = capsys.readouterr()
    assert status == 2, shown
    lines = shown.err.strip().splitlines()
    said = [line for line in lines if line.startswith("pronk: ")]
    assert len(said) == 1, shown.err
    assert "Traceback" not in shown.err + shown.out
    assert said[0] == lines[-1], shown.err
    return said[0]


def accepted(capsys, *arguments: str | Path) -> str:
    status = cli.run([str(a) for a in arguments])
    shown = capsys.readouterr()
    assert status == 0, shown.err
    return shown.out


# --- The frame ----------------------------------------------------------------------------------


def test_help_names_every_command(capsys):
    shown = accepted(capsys, "--help")
    for name in COMMANDS:
        assert re.search(rf"\b{name}\b", shown), name


def test_help_loads_no_heavy_library():
    code = (
        "import sys, pronk.cli.main; heavy = ('numpy', 'scipy', 'matplotlib', 'mujoco', 'jinja2');"
        "print([name for name in heavy if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(capsys, command):
    shown = accepted(capsys, command, "--help")
    assert len(shown) > 200


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_takes_json(capsys, command):
    assert "--json" in accepted(capsys, command, "--help")


def test_misspelled_command_and_option_are_one_sentence(capsys):
    assert "mach" in refused(capsys, "mach")
    said = refused(capsys, "match", ".", "--robot", "mini_cheetah", "--grids", "3")
    assert "--grids" in said
    assert "pronk match --help" in said


def test_a_value_that_was_a_command_once_is_no_renamed_option(capsys):
    said = refused(capsys, "match", "bench", "--robot", "twin", "--grids", "3")
    assert "--grids" in said
    assert "simulate" not in said


def test_version(capsys):
    from pronk import __version__

    assert accepted(capsys, "--version").strip() == f"pronk {__version__}"


def test_a_defect_is_called_a_defect(capsys, monkeypatch):
    def broken(*_, **__):
        raise ZeroDivisionError("division by zero")

    monkeypatch.setattr(cli, "_dispatch", broken)
    assert cli.run(["report", "x"]) == 1
    shown = capsys.readouterr().err
    assert "This is a defect of pronk" in shown
    assert "Traceback" not in shown
    monkeypatch.setenv("PRONK_DEBUG", "1")
    assert cli.run(["report", "x"]) == 1
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("raised", "status"), [(PronkError("got this,\nexpected that."), 2), (KeyboardInterrupt(), 130)]
)
def test_exit_statuses(capsys, monkeypatch, raised, status):
    def stop(*_, **__):
        raise raised

    monkeypatch.setattr(cli, "_dispatch", stop)
    assert cli.run(["match"]) == status
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


# --- Bad input ----------------------------------------------------------------------------------


def a_csv(
    path: Path, rows: int = 3000, *, joint: str = "FR_knee", nan_at: int | None = None
) -> Path:
    """A knee that answers a chirp perfectly, as CSV."""
    stamps = np.arange(rows) / 500.0
    command = 1.6 + 0.2 * np.sin(2.0 * np.pi * (0.5 + stamps) * stamps)
    lines = [f"time,command.{joint},position.{joint}"]
    for i, (t, u) in enumerate(zip(stamps, command, strict=True)):
        position = "nan" if i == nan_at else f"{u:.6f}"
        lines.append(f"{t:.6f},{u:.6f},{position}")
    path.write_text("\n".join(lines) + "\n")
    return path


class _Bomb:
    def __reduce__(self):
        return (Path.touch, (Path("/tmp/pronk_bomb_went_off"),))


def pickle_bomb(path: Path) -> Path:
    """What looks like a PyTorch file and would run code if it were unpickled."""
    inside = io.BytesIO()
    pickle.dump(_Bomb(), inside)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("log/data.pkl", inside.getvalue())
        archive.writestr("log/version", "3")
    return path


MATCH = ("--robot", "mini_cheetah", "--quick")


def test_bad_logs_are_one_sentence_and_leave_nothing(capsys, tmp_path):
    empty = tmp_path / "empty.csv"
    empty.write_text("")
    noise = tmp_path / "noise.mcap"
    noise.write_bytes(b"\x00" * 500)
    cases = {
        "empty.csv": (empty, "rad"),
        "not finite|finite number": (a_csv(tmp_path / "nan.csv", nan_at=77), "rad"),
        "there is no joint|no joint": (a_csv(tmp_path / "who.csv", joint="FR_elbow"), "rad"),
        "unit": (a_csv(tmp_path / "unit.csv"), None),
        "noise.mcap": (noise, None),
        "no such file": (tmp_path / "nowhere.mcap", None),
        "bomb.pt": (pickle_bomb(tmp_path / "bomb.pt"), None),
        "known format": (tmp_path / "notes.txt", None),
    }
    (tmp_path / "notes.txt").write_text("hello")
    before = set(tmp_path.iterdir())
    for words, (path, unit) in cases.items():
        options = ["--unit", unit] if unit else []
        out = tmp_path / "out" / "gains.yaml"
        said = refused(capsys, "match", path, *MATCH, "--out", out, *options)
        assert re.search(words, said), (words, said)
    assert set(tmp_path.iterdir()) == before
    assert not Path("/tmp/pronk_bomb_went_off").exists()


def test_wrong_robot_joint_and_file_names_list_what_there_is(capsys, tmp_path):
    log = a_csv(tmp_path / "a.csv")
    said = refused(capsys, "match", log, "--robot", "mini_cheeta", "--unit", "rad")
    assert "mini_cheetah" in said
    said = refused(capsys, "sweep", "mini_cheetah", "--out", tmp_path, "--joints", "FR_ankle")
    assert "FR_knee" in said
    said = refused(capsys, "match", log, *MATCH, "--unit", "rad", "--out", tmp_path / "gains.txt")
    assert ".yaml" in said
    said = refused(capsys, "match", log, *MATCH, "--unit", "furlong")
    assert "rad" in said
    said = refused(capsys, "match", log, *MATCH, "--unit", "rad", "--columns", "nonsense")
    assert "NAME=VALUE" in said
    said = refused(capsys, "report", tmp_path / "nowhere")
    assert "no such folder" in said
    said = refused(capsys, "export", tmp_path / "no.yaml", "--to", "mjlab", "--out", "x.py")
    assert "pronk match" in said
    said = refused(capsys, "export", tmp_path / "no.yaml", "--to", "gazebo", "--out", "x.py")
    assert "mjlab" in said


def test_a_sweep_by_wire_is_refused_with_the_way_out(capsys, tmp_path):
    asked = ("sweep", "mini_cheetah", "--out", tmp_path / "x")
    assert "has no port" in refused(capsys, *asked, "--port", "7801")
    assert "no port" in refused(capsys, *asked, "--link", "dds", "--port", "7801")
    assert "no domain" in refused(capsys, *asked, "--link", "lcm", "--domain", "3")
    assert "pronk simulate" in refused(capsys, *asked, "--link", "lcm", "--sim-params", "t.yaml")
    assert not (tmp_path / "x").exists()


def test_a_sweep_that_could_break_the_robot_is_refused_before_it_moves(capsys, tmp_path):
    said = refused(
        capsys, "sweep", "mini_cheetah", "--out", tmp_path / "x", "--joints", "FR_knee",
        "--amplitude", "1.4",
    )  # fmt: skip
    assert re.search(r"an amplitude of [0-9.]+ rad fits", said)
    assert not (tmp_path / "x").exists()


def test_a_broken_truth_is_refused(capsys, tmp_path):
    truth = tmp_path / "sim_params.yaml"
    truth.write_text("schema: pronk/sim_params/1\nrobot: mini_cheetah\n")
    said = refused(
        capsys, "sweep", "mini_cheetah", "--out", tmp_path / "x", "--joints", "FR_knee",
        "--sim-params", truth,
    )  # fmt: skip
    assert "sim_params.yaml" in said


# --- The way of the data ------------------------------------------------------------------------


@pytest.fixture(scope="module")
def swept(tmp_path_factory) -> Path:
    """One knee of the virtual robot, swept by the command line."""
    folder = tmp_path_factory.mktemp("sweep")
    status = cli.run(
        ["sweep", "mini_cheetah", "--out", str(folder), "--joints", "FR_knee", "--repeats", "2",
         "--amplitude", "0.25", "--json", str(folder / "sweep.json")]
    )  # fmt: skip
    assert status == 0
    return folder


@pytest.fixture(scope="module")
def matched(swept) -> Path:
    gains = swept / "gains.yaml"
    status = cli.run(
        ["match", str(swept), *MATCH, "--out", str(gains), "--json", str(swept / "match.json")]
    )
    assert status == 0
    return swept


def test_sweep_writes_a_log_and_says_it_is_virtual(swept):
    figures = json.loads((swept / "sweep.json").read_text())
    assert figures["virtual"] is True
    assert [Path(p).name for p in figures["logs"]] == ["FR_knee.mcap"]
    assert (swept / "FR_knee.mcap").stat().st_size > 1e5
    assert figures["plan"][0]["torque_nm"] < figures["plan"][0]["effort_limit_nm"]


def test_sweep_does_not_write_over_a_log(capsys, swept):
    said = refused(capsys, "sweep", "mini_cheetah", "--out", swept, "--joints", "FR_knee")
    assert "FR_knee.mcap" in said
    assert "exists" in said


def test_plan_only_moves_nothing(capsys, tmp_path):
    shown = accepted(
        capsys, "sweep", "mini_cheetah", "--out", tmp_path / "x", "--joints", "FR_knee",
        "--plan-only",
    )  # fmt: skip
    assert "torque [N m]" in shown
    assert not (tmp_path / "x").exists()


def test_response_table_and_files(capsys, swept, tmp_path):
    shown = accepted(
        capsys, "response", swept / "FR_knee.mcap", "--out", tmp_path, "--json",
        tmp_path / "response.json",
    )  # fmt: skip
    assert "virtual robot" in shown
    assert "command delay [ms]" in shown
    row = json.loads((tmp_path / "response.json").read_text())["responses"][0]
    assert row["joint"] == "FR_knee"
    assert 5.0 < row["bandwidth_hz"] < 15.0
    assert (tmp_path / "FR_knee.response.npz").exists()
    assert (tmp_path / "FR_knee.response.svg").read_text().startswith("<?xml")


def test_match_writes_gains_and_page_and_lands_on_table_one(matched):
    figures = json.loads((matched / "match.json").read_text())
    found = figures["gains"]["FR_knee"]
    # Two cells of the paper's grid are 0.57 N m/rad and 0.024 N m s/rad.
    assert found["stiffness"] == pytest.approx(21.8, abs=0.57)
    assert found["damping"] == pytest.approx(0.541, abs=0.024)
    assert found["error_db"] < 0.5 * found["naive_error_db"]
    assert found["zero_armature_error_db"] > 5.0 * found["error_db"]
    # Command and measurement of the virtual robot together lag by some milliseconds.
    assert 0.002 < found["delay_s"] < 0.01
    page = (matched / "match.html").read_text(encoding="utf-8")
    assert "1 of 1 joints matched" in page
    assert "virtual robot" in page


def test_what_was_written_beside_the_logs_is_no_log(capsys, matched, tmp_path):
    accepted(capsys, "response", matched, "--no-plots")
    assert (matched / "FR_knee.response.npz").exists()
    assert [p.name for p in find_logs([matched])] == ["FR_knee.mcap"]


def test_predict_replays_a_fresh_log_and_the_page_shows_it(capsys, matched, tmp_path):
    fresh = tmp_path / "fresh"
    accepted(
        capsys, "sweep", "mini_cheetah", "--out", fresh, "--joints", "FR_knee", "--repeats", "1",
        "--amplitude", "0.25", "--signal", "log-chirp", "--seed", "5",
    )  # fmt: skip
    shown = accepted(
        capsys, "predict", fresh, "--robot", "mini_cheetah", "--gains", matched / "gains.yaml",
        "--json", tmp_path / "predict.json",
    )  # fmt: skip
    assert "R2 matched" in shown
    row = json.loads((tmp_path / "predict.json").read_text())["predictions"][0]
    assert row["rmse_matched"] < 0.5 * row["rmse_naive"]
    accepted(capsys, "report", matched)
    assert "eplay" in (matched / "report.html").read_text(encoding="utf-8")


def test_predict_on_the_fitted_log_says_so(capsys, matched):
    status = cli.run(
        ["predict", str(matched / "FR_knee.mcap"), "--robot", "mini_cheetah", "--gains",
         str(matched / "gains.yaml"), "--out", str(matched / "again")]
    )  # fmt: skip
    assert status == 0
    assert "FR_knee.mcap was used" in capsys.readouterr().err


@pytest.mark.parametrize("target", ["mjlab", "mjcf", "isaaclab"])
def test_export(capsys, matched, tmp_path, target):
    out = tmp_path / "exported"
    accepted(capsys, "export", matched / "gains.yaml", "--to", target, "--out", out)
    assert len(out.read_text()) > 200


# --- Mode drive ---------------------------------------------------------------------------------


def test_drive_mode_finds_what_it_can_and_refuses_the_rest(capsys, matched, tmp_path):
    log = matched / "FR_knee.mcap"
    common = ("match", log, "--robot", "mini_cheetah", "--out", tmp_path / "gains.yaml")
    said = refused(capsys, *common, "--fit", "armature")
    assert "--mode drive" in said
    said = refused(capsys, *common, "--mode", "drive", "--fit", "stiffness", "--fit", "armature",
                   "--fit", "damping", "--fit", "frictionloss")  # fmt: skip
    assert "FR_knee: these data" in said
    assert "payload" in said
    assert not (tmp_path / "gains.yaml").exists()
    shown = accepted(capsys, *common, "--mode", "drive", "--fit", "damping", "--fit", "delay")
    assert "held" in shown
