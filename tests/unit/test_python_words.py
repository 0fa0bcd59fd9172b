"""Errors of the Python API name parameters, and those of the command line options."""

from __future__ import annotations

from pathlib import Path

import pytest

import pronk
from command_line import refused
from pronk.errors import PronkError
from pronk.python_words import python_words

ROWS = "t,des,act\n" + "".join(f"{0.01 * n:.2f},0.0,{0.001 * n:.4f}\n" for n in range(300))


@pytest.mark.parametrize(
    ("option", "parameter"),
    [
        ("give --unit rad or --unit deg.", 'give unit="rad" or unit="deg".'),
        ("(--time-unit ms, or convert)", '(time_unit="ms", or convert)'),
        ("give --drive-gains knee=STIFFNESS,DAMPING", 'drive_gains={"knee": (STIFFNESS, DAMPING)}'),
        ("leave --rate-hz out", "leave rate_hz out"),
        ("as a--b and x -- y", "as a--b and x -- y"),
    ],
)
def test_options_become_parameters(option: str, parameter: str) -> None:
    assert parameter in python_words(option)


def test_a_log_without_a_unit_names_the_parameter(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text(ROWS)
    with pytest.raises(PronkError) as caught:
        pronk.read_log(path, robot=pronk.load_robot("mini_cheetah"))
    assert "--" not in str(caught.value)
    assert "columns" in str(caught.value)
    assert "--columns" in refused("match", path, "--robot", "mini_cheetah", "--out", "x.yaml")


def test_functions_keep_their_signature_and_help() -> None:
    assert "drive_gains" in str(pronk.match.__doc__)
    assert pronk.match.__name__ == "match"
