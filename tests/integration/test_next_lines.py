"""The commands that a command names next read a log as it was read."""

from __future__ import annotations

import shlex
from pathlib import Path

import numpy as np

from chirp_logs import chirp_log
from command_line import accepted
from pronk.robots import load_robot


def following(text: str, begin: str) -> list[str]:
    """Words of the command of a "next:" line that begins so."""
    for line in text.splitlines():
        words = shlex.split(line) if line.strip().startswith("pronk ") else []
        if words[1:2] == [begin]:
            return words[1:]
    raise AssertionError(f"no {begin} in {text}")


def test_match_and_predict_keep_the_options_of_reading(tmp_path: Path) -> None:
    log = chirp_log(load_robot("mini_cheetah"), "FR_knee", (22.0, 0.55), (0.2,))
    column = log.column("FR_knee")
    table = np.column_stack(
        [1e3 * log.time, np.degrees(log.command[:, column]), np.degrees(log.position[:, column])]
    )
    for name in ("first.csv", "fresh log.csv"):
        np.savetxt(
            tmp_path / name, table, delimiter=",", comments="", header="when,wanted,had", fmt="%.9g"
        )
    columns = "time=when,command.FR_knee=wanted,position.FR_knee=had"
    reading = ("--unit", "deg", "--time-unit", "ms", "--columns", columns)
    said = accepted("response", tmp_path / "first.csv", "--robot", "mini_cheetah", *reading)
    match_words = following(said, "match")
    gains = tmp_path / "gains.yaml"
    match_words[match_words.index("--out") + 1] = str(gains)
    said = accepted(*match_words)
    predict_words = following(said, "predict")
    assert "default" in predict_words
    predict_words[predict_words.index("FRESH_LOG")] = str(tmp_path / "fresh log.csv")
    assert "FR_knee" in accepted(*predict_words)
