"""How commands end: statuses, full disks, closed pipes, plain terminals, signals, two at once."""

from __future__ import annotations

import os
import re
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from command_line import refused
from process_tree import children_of
from pronk.errors import PronkError
from pronk.exit_status import ExitStatus
from pronk.files import locked_folder

DOCS = Path(__file__).parents[2] / "docs" / "commands.md"
COMMAND = [sys.executable, "-m", "pronk.cli.main"]
SWEEP = ["sweep", "mini_cheetah", "--joints", "FR_knee", "--repeats", "1", "--amplitude", "0.1"]


def sentences(stderr: str) -> list[str]:
    """Return the lines of standard error that are the last word of a command."""
    assert "Traceback" not in stderr
    assert "defect" not in stderr
    return [line for line in stderr.splitlines() if line.startswith("pronk: ")]


def test_the_table_has_every_status() -> None:
    rows = re.findall(r"^\| (\d+) \|", DOCS.read_text(encoding="utf-8"), re.M)
    assert [int(row) for row in rows] == [int(status) for status in ExitStatus]


@pytest.mark.parametrize("words", [["--help"], ["--version"], ["profiles"]])
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_standard_output_is_one_sentence(words: list[str]) -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [*COMMAND, *words], stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    assert done.returncode == ExitStatus.REFUSED
    assert len(sentences(done.stderr)) == 1
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize("words", [["--help"], ["profiles"]])
def test_a_closed_pipe_is_one_sentence(words: list[str]) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run(
        [*COMMAND, *words], stdout=writing, stderr=subprocess.PIPE, text=True, check=False
    )
    os.close(writing)
    assert done.returncode == ExitStatus.REFUSED
    assert len(sentences(done.stderr)) == len(done.stderr.splitlines()) == 1


def test_a_closed_standard_output_is_one_sentence() -> None:
    shell = ["sh", "-c", '"$@" >&-', "sh", *COMMAND, "profiles"]
    done = subprocess.run(shell, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == ExitStatus.REFUSED
    assert len(sentences(done.stderr)) == len(done.stderr.splitlines()) == 1


def test_a_plain_terminal_gets_plain_characters() -> None:
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    words = [*SWEEP, "--out", "nowhere", "--plan-only"]
    done = subprocess.run(
        [*COMMAND, *words], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == ExitStatus.DONE, done.stderr
    assert done.stdout.isascii()
    assert "FR_knee" in done.stdout


def small_files() -> None:
    """Let a process write no file of more than 64 KiB, as on a disk that is nearly full."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2**16, 2**16))


def test_a_sweep_on_a_full_disk_leaves_nothing(tmp_path: Path) -> None:
    out = tmp_path / "logs"
    done = subprocess.run(
        [*COMMAND, *SWEEP, "--out", str(out)],
        preexec_fn=small_files,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == ExitStatus.REFUSED, done.stderr
    (sentence,) = sentences(done.stderr)
    assert str(out) in sentence
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_sweep_that_is_interrupted_leaves_nothing(tmp_path: Path, number: int) -> None:
    out = tmp_path / "logs"
    words = [*COMMAND, *SWEEP, "--repeats", "40", "--out", str(out)]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    while process.poll() is None and not list(out.glob("*.mcap")):
        time.sleep(0.05)
    process.send_signal(number)
    _, stderr = process.communicate()
    assert process.returncode == ExitStatus.INTERRUPTED, stderr
    assert len(sentences(stderr)) == 1
    assert list(tmp_path.iterdir()) == []


def test_a_second_sweep_into_a_folder_is_refused(tmp_path: Path) -> None:
    out = tmp_path / "logs"
    with locked_folder(out):
        sentence = refused(*SWEEP, "--out", out)
        assert str(out) in sentence
        assert list(out.iterdir()) == []
    with pytest.raises(PronkError, match="stopped"), locked_folder(tmp_path / "new"):
        raise PronkError("stopped")
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    "words",
    [
        "response {pipe} --unit rad --out x",
        "match {pipe} --unit rad --robot mini_cheetah --out x/gains.yaml",
        "export {pipe} --to mjlab --out x.py",
        "translate {pipe} --to drake --out x.yaml",
        "predict {pipe} --unit rad --gains {pipe}",
        "robot check {pipe}",
    ],
)
def test_a_pipe_is_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: str) -> None:
    monkeypatch.chdir(tmp_path)
    for suffix in ("csv", "yaml", "mcap"):
        os.mkfifo(f"pipe.{suffix}")
    before = sorted(tmp_path.rglob("*"))
    suffix = "csv" if words.split()[0] in ("response", "match") else "yaml"
    refused(*words.format(pipe=f"pipe.{suffix}").split())
    assert sorted(tmp_path.rglob("*")) == before


def test_a_killed_process_of_a_trial_is_no_defect(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    policy = Path(__file__).parents[2] / "policies" / "matched" / "policy.onnx"
    words = [*COMMAND, "trial", policy, "--commands=1,0", "--jumps", "500", "--no-video"]
    words += ["--processes", "2", "--out", tmp_path / "out"]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    worker = 0
    while not worker and process.poll() is None:
        for pid, command in children_of(process.pid).items():
            if "spawn_main" in command:
                worker = pid
    assert worker
    os.kill(worker, signal.SIGKILL)
    _, stderr = process.communicate()
    assert process.returncode == ExitStatus.REFUSED
    (sentence,) = sentences(stderr)
    assert "SIGKILL" in sentence
    assert "--processes" in sentence
    assert not (tmp_path / "out" / "summary.json").exists()
