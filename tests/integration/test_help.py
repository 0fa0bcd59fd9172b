"""Help texts: 80 columns, required options first, every option that is parsed, words for users."""

from __future__ import annotations

import re
import subprocess
import sys

import pytest

from command_line import accepted, refused
from documented_commands import LABEL, help_of
from pronk.cli.help_text import WIDTH, examples_of
from pronk.cli.main import COMMANDS, command_of, parsed_command
from pronk.errors import PronkError


@pytest.mark.parametrize("name", COMMANDS)
def test_help_fits_a_terminal_and_speaks_plainly(name: str) -> None:
    text = help_of(name)
    for line in text.splitlines():
        assert len(line) <= WIDTH
    for word in ("None", "(default", "(required", "MISSING", "STR\n", "…"):
        assert word not in text
    assert not LABEL.findall(text)


@pytest.mark.parametrize("name", COMMANDS)
def test_help_has_an_example_that_parses(name: str) -> None:
    examples = examples_of(command_of(name))
    assert examples
    for example in examples:
        program, *words = example.split()
        assert program == "pronk"
        assert words[0] == name
        parsed_command(words)
        assert " ".join(words[:2]) in help_of(name)


@pytest.mark.parametrize("name", COMMANDS)
def test_help_lists_required_options_first(name: str) -> None:
    text = help_of(name)
    required = re.findall(
        r"^  (--[\w-]+)", text.partition("Required:")[2].partition("\n\n")[0], re.M
    )
    usage = text.partition("\n\n")[0]
    assert required == re.findall(r"--[\w-]+", usage)
    if "Required:" in text and "Options:" in text:
        assert text.index("Required:") < text.index("Options:")


@pytest.mark.parametrize("name", COMMANDS)
def test_each_listed_option_is_one_that_is_parsed(name: str) -> None:
    """An option without its value, or with an impossible one, is never an unknown one."""
    for option in re.findall(r"^  (--[\w-]+)", help_of(name), re.M):
        message = ""
        try:
            parsed_command([name, option])
        except PronkError as error:
            message = str(error)
        assert "unrecognized" not in message.lower()


def test_an_unknown_option_is_named() -> None:
    assert "--nothing" in refused("profiles", "--nothing")


def test_module_is_the_command_line() -> None:
    words = [sys.executable, "-m", "pronk", "profiles"]
    output = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    assert output == accepted("profiles")
