"""A log format of another package: found by its entry point, checked, read by the command line."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from command_line import invoke
from pronk.errors import LogError
from pronk.logs.readers import read_log, readers
from pronk.testing import check_reader

READER = '''
"""Reader of semicolon-separated logs: time; command; position, angles in turns."""

import hashlib

import numpy as np

from pronk.errors import LogError
from pronk.logs.joint_log import JointLog
from pronk.logs.readers import reader


@reader("turns", ".turns")
def read_turns(path, *, robot=None, joint="knee", sign: float = 1.0):
    """Read one joint."""
    try:
        data = path.read_bytes()
        rows = np.array([[float(v) for v in line.split(b";")] for line in data.splitlines()])
        time, command, position = rows.T
    except (OSError, ValueError) as error:
        raise LogError(f"{path}: no log in turns ({error}).") from None
    scale = 2.0 * np.pi * sign
    return JointLog(
        robot="unknown" if robot is None else robot.name,
        joints=(joint,),
        time=time,
        command=scale * command[:, None],
        position=scale * position[:, None],
        source=str(path),
        sha256=hashlib.sha256(data).hexdigest(),
    )
'''


@pytest.fixture
def recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Install the reader as a package of its own and write a log of its format."""
    site = tmp_path / "site"
    info = site / "turns_reader-1.0.dist-info"
    info.mkdir(parents=True)
    (site / "turns_reader.py").write_text(READER)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: turns-reader\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[pronk.readers]\nturns = turns_reader:read_turns\n")
    monkeypatch.syspath_prepend(site)
    monkeypatch.delitem(sys.modules, "turns_reader", raising=False)
    time = np.arange(5000) / 500.0
    command = 0.04 * np.sin(2.0 * np.pi * (0.5 + 0.5 * time) * time)
    position = 0.95 * np.interp(time - 0.01, time, command)
    path = tmp_path / "chirp.turns"
    np.savetxt(path, np.stack([time, command, position], axis=1), delimiter=";", fmt="%.9f")
    return path


def test_a_reader_of_another_package_is_found_and_conforms(recording: Path) -> None:
    check_reader(readers()["turns"], recording)
    log = read_log(recording, joint="elbow", sign=-1.0)
    assert log.joints == ("elbow",)
    assert np.abs(log.command).max() == pytest.approx(2.0 * np.pi * 0.04, rel=1e-3)
    with pytest.raises(LogError, match="columns"):
        read_log(recording, columns={"time": "t"})


def test_the_command_line_reads_it(recording: Path, tmp_path: Path) -> None:
    options = ["--reader-option", "joint=elbow", "--reader-option", "sign=-1"]
    done = invoke(["response", recording, *options, "--out", tmp_path / "out", "--no-plots"])
    assert done.exit_code == 0, done.stderr
    assert "elbow" in done.stdout


def test_a_broken_package_leaves_the_other_formats(recording: Path) -> None:
    (recording.parent / "site" / "turns_reader.py").write_text("import no_such_module")
    with pytest.warns(UserWarning, match="turns_reader"):
        assert "turns" not in readers()
