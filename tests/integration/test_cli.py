"""The command line: from a sweep to gains, predictions, exports; help, exit statuses, the demo."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from command_line import accepted, invoke, refused
from hopper import ROBOT, write_hopper
from pronk.cli import main as cli
from pronk.cli.demo import find_policies
from pronk.errors import ArtefactError, PronkError
from pronk.identify.match.gains import load_gains
from pronk.version import VERSION

KNEE = ("mini_cheetah", "--joints", "FR_knee", "--amplitude", "0.25")
MATCH = ("--robot", "mini_cheetah", "--method", "paper")


HEAVY_LIBRARIES = {"scipy", "matplotlib", "mujoco", "torch", "mjlab", "warp", "onnxruntime"}
"""Libraries that a command runs with."""
RESOLVE_ALL = "[pkgutil.resolve_name(location) for location, _ in main.COMMANDS.values()]"


@pytest.mark.parametrize(
    ("statement", "more_libraries"),
    [
        ("main.run(['--help'])", {"numpy", "jinja2", "tyro", "msgspec"}),
        (RESOLVE_ALL, set()),
    ],
)
def test_help_and_options_are_read_without_heavy_libraries(
    statement: str, more_libraries: set[str]
) -> None:
    libraries = sorted(HEAVY_LIBRARIES | more_libraries)
    code = (
        "import pkgutil, sys\n"
        "from pronk.cli import main\n"
        f"{statement}\n"
        f"print([name for name in {libraries} if name in sys.modules])\n"
    )
    process = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert process.stdout.splitlines()[-1] == "[]"


def test_version() -> None:
    assert accepted("--version").strip() == f"pronk {VERSION}"


@pytest.mark.parametrize("command", cli.COMMANDS)
def test_every_command_has_help(command):
    printed = accepted(command, "--help")
    assert len(printed) > 200
    assert "--json" in printed or command == "robot"
    assert f" {command} " in accepted("--help")


@pytest.mark.parametrize(
    ("raised", "status"),
    [
        (PronkError("got this,\nexpected that."), 2),
        (KeyboardInterrupt(), 130),
        (MemoryError(), 2),
        (OSError(28, "No space left on device"), 2),
        (BrokenPipeError(32, "Broken pipe"), 2),
        # Raised in this file, which is not part of pronk.
        (ZeroDivisionError("division by zero"), 2),
    ],
)
def test_exit_statuses(monkeypatch, raised, status):
    def stop(*_, **__):
        raise raised

    monkeypatch.setitem(cli.COMMANDS, "report", ("pronk.report.build:write_report", ""))
    monkeypatch.setattr("pronk.report.build.write_report", stop)
    monkeypatch.delenv("PRONK_DEBUG", raising=False)
    command = invoke(["report"])
    assert command.exit_code == status
    assert len(command.stderr.strip().splitlines()) == 1
    assert "defect" not in command.stderr
    assert (Path(__file__).name in command.stderr) == isinstance(raised, ZeroDivisionError)


def test_an_exception_in_pronk_is_named_a_defect(monkeypatch):
    monkeypatch.setattr("pronk.cli.console.show", None)
    command = invoke(["sweep", "mini_cheetah", "--joints", "FR_knee", "--plan-only"])
    assert command.exit_code == 1
    assert "defect of pronk" in command.stderr
    assert "Traceback" not in command.stderr


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One knee of the virtual robot, swept by the command line."""
    out = tmp_path_factory.mktemp("sweep")
    accepted("sweep", *KNEE, "--out", out, "--repeats", "2", "--json", out / "sweep.json")
    return out


@pytest.fixture(scope="module")
def matched(swept: Path) -> Path:
    accepted("match", swept, *MATCH, "--out", swept / "gains.yaml", "--json", swept / "match.json")
    return swept


def test_sweep_writes_a_log_of_the_virtual_robot(swept):
    figures = json.loads((swept / "sweep.json").read_text())
    assert figures["virtual"] is True
    assert [Path(p).name for p in figures["logs"]] == ["FR_knee.mcap"]
    assert (swept / "FR_knee.mcap").stat().st_size > 1e5
    assert figures["plan"][0]["torque_nm"] < figures["plan"][0]["effort_limit_nm"]
    assert "FR_knee.mcap" in refused("sweep", *KNEE, "--out", swept)


def test_plan_only_writes_nothing(tmp_path):
    printed = accepted("sweep", *KNEE, "--out", tmp_path / "x", "--plan-only")
    assert "torque" in printed
    assert "[N m]" in printed
    assert not (tmp_path / "x").exists()


def test_response_table_and_files(swept, tmp_path):
    figures = tmp_path / "response.json"
    log = swept / "FR_knee.mcap"
    printed = accepted("response", log, "--out", tmp_path, "--json", figures)
    assert "virtual robot" in printed
    row = json.loads(figures.read_text())["responses"][0]
    assert row["joint"] == "FR_knee"
    assert 5.0 < row["bandwidth_hz"] < 15.0
    assert (tmp_path / "FR_knee.response.npz").exists()
    assert (tmp_path / "FR_knee.response.svg").read_text().startswith("<?xml")


def test_match_finds_table_one(matched):
    figures = json.loads((matched / "match.json").read_text())
    knee = figures["gains"]["FR_knee"]
    # Two cells of the paper's grid are 0.57 N m/rad and 0.024 N m s/rad.
    assert knee["stiffness"]["value"] == pytest.approx(21.8, abs=0.57)
    assert knee["damping"]["value"] == pytest.approx(0.541, abs=0.024)
    quality = knee["quality"]
    assert quality["error_db"] < 0.5 * quality["nominal_error_db"]
    assert knee["zero_armature_error_db"] > 5.0 * quality["error_db"]
    assert 0.002 < knee["delay_s"]["value"] < 0.01
    assert (figures["matched"], figures["joints"]) == (1, 1)
    assert "virtual robot" in (matched / "match.html").read_text(encoding="utf-8")


def test_predict_replays_a_fresh_log_and_warns_of_a_fitted_one(matched, tmp_path):
    fresh = tmp_path / "fresh"
    figures = tmp_path / "predict.json"
    chirp = ("--signal", "log-chirp", "--repeats", "1", "--seed", "5")
    accepted("sweep", *KNEE, "--out", fresh, *chirp)
    gains = ("--robot", "mini_cheetah", "--gains", matched / "gains.yaml")
    accepted("predict", fresh, *gains, "--json", figures)
    prediction = json.loads(figures.read_text())
    (row,) = prediction["predictions"]
    assert row["rmse_matched"] < 0.5 * row["rmse_nominal"]
    assert prediction["fitted_on"] == []
    accepted("report", matched)
    assert "FR_knee" in (matched / "report.html").read_text(encoding="utf-8")
    log = matched / "FR_knee.mcap"
    again = invoke(["predict", log, *gains, "--out", tmp_path / "again", "--json", figures])
    assert again.exit_code == 0
    assert json.loads(figures.read_text())["fitted_on"] == [str(log)]
    assert "warning" in again.stderr


def test_export(matched, tmp_path):
    accepted("export", matched / "gains.yaml", "--to", "mjcf", "--out", tmp_path / "exported")
    assert len((tmp_path / "exported").read_text()) > 200


def test_drive_mode_fits_what_it_can_and_refuses_the_rest(matched, tmp_path):
    log = matched / "FR_knee.mcap"
    out = tmp_path / "gains.yaml"
    common = ("match", log, "--robot", "mini_cheetah", "--out", out)
    assert "--mode drive" in refused(*common, "--fit", "armature")
    fits = []
    for name in ("stiffness", "armature", "damping", "frictionloss"):
        fits += ["--fit", name]
    assert "FR_knee" in refused(*common, "--mode", "drive", *fits)
    assert not out.exists()
    printed = accepted(*common, "--mode", "drive", "--fit", "damping", "--fit", "delay", "--wide")
    assert "damping" in printed
    stiffness = load_gains(out).joints["FR_knee"].stiffness
    assert stiffness.value == 17.0
    assert not np.isfinite(stiffness.total95).any()


def test_the_demo_takes_the_matched_policy_first_and_refuses_another_robots(tmp_path):
    pytest.importorskip("onnxruntime")
    assert find_policies(None, ROBOT)[0].parts[-3:] == ("policies", "matched", "policy.onnx")
    nominal = {
        "gains": "naive",
        "stiffness": (17.0,) * 12,
        "damping": (0.4,) * 12,
        "gains_sha256": "",
    }
    for name in ("naive", "matched"):
        (tmp_path / name).mkdir()
    write_hopper(tmp_path / "naive" / "policy.onnx", 0.5, **nominal)
    write_hopper(tmp_path / "matched" / "policy.onnx", 0.5)
    policies = find_policies(tmp_path, ROBOT)
    assert [path.parent.name for path in policies] == ["matched", "naive"]
    (tmp_path / "a").mkdir()
    write_hopper(tmp_path / "a" / "policy.onnx", robot="go2")
    with pytest.raises(ArtefactError, match="go2"):
        find_policies(tmp_path, ROBOT)
