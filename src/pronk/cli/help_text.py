"""Help of a command in 80 columns: usage, an example, required options first, defaults in words."""

from __future__ import annotations

import argparse
import inspect
import re
import textwrap
from collections.abc import Callable, Sequence, Set
from typing import Any

WIDTH = 80
"""Characters of a line."""
_INDENT = 22
"""Characters before the text of an option."""
_EXAMPLE = re.compile(r"\nExamples?:\n(?P<lines>(?:[ \t]+\S.*\n?|\n)+)")
"""The section of a docstring that holds example commands."""
_MARK = re.compile(r"\s*\((?P<word>required|repeatable|default: ?(?P<value>.*?))\)", re.DOTALL)
"""What tyro adds to the text of an option."""
_WORDS_OF_NUMBERS = {"INT": "N", "FLOAT": "NUMBER"}
"""What stands for a value of a type."""


def examples_of(command: Callable[..., Any]) -> list[str]:
    """Return the example command lines in the docstring of a command."""
    section = _EXAMPLE.search(f"{inspect.getdoc(command) or ''}\n")
    if section is None:
        return []
    return [" ".join(line.split()) for line in section["lines"].splitlines() if line.strip()]


def without_examples(docstring: str) -> str:
    """Return a docstring without its example commands, which tyro would take for text."""
    return _EXAMPLE.sub("\n", f"{inspect.cleandoc(docstring)}\n")


def help_text(
    parser: argparse.ArgumentParser,
    program: str,
    examples: Sequence[str],
    required_options: Set[str] = frozenset(),
) -> str:
    """Return the help of a command.

    Args:
        parser: The parser that tyro makes of the command.
        program: The words before the options, as in `pronk match`.
        examples: Complete command lines.
        required_options: Options that a command cannot run without, as `--to`, beside those that
            the parser marks.
    """
    required: list[argparse.Action] = []
    groups: list[tuple[str, list[argparse.Action]]] = []
    for group in parser._action_groups:
        optional = []
        for action in group._group_actions:
            if "--help" in action.option_strings:
                continue
            if _is_required(action, required_options):
                required.append(action)
            else:
                optional.append(action)
        title = (group.description or "Options").strip().rstrip(".")
        if groups and groups[-1][0] == title:
            groups[-1][1].extend(optional)
        else:
            groups.append((title, optional))

    needed = " ".join(_typed(action) for action in required)
    usage = f"usage: {program} {needed}".rstrip() + " [OPTIONS]"
    lines = textwrap.wrap(usage, WIDTH, subsequent_indent=8 * " ")
    for paragraph in (parser.description or "").strip().split("\n\n"):
        lines.append("")
        lines += textwrap.wrap(" ".join(paragraph.split()), WIDTH)
    if examples:
        lines += ["", "Example:"]
        for example in examples:
            lines += _command_lines(example)
    if required:
        lines += ["", "Required:"]
        for action in required:
            lines += _option_lines(action)
    for title, actions in groups:
        if actions:
            lines += ["", f"{title}:"]
        for action in actions:
            lines += _option_lines(action)
    return "\n".join(lines)


def _command_lines(command: str) -> list[str]:
    """Return an example on as many lines as it needs; a backslash ends a line that goes on."""
    lines = textwrap.wrap(
        command,
        WIDTH - 4,
        initial_indent="  ",
        subsequent_indent="      ",
        break_on_hyphens=False,
        break_long_words=False,
    )
    return [f"{line} \\" for line in lines[:-1]] + lines[-1:]


def _is_required(action: argparse.Action, required_options: Set[str]) -> bool:
    """Return whether a command cannot run without an option; tyro lets a repeatable one be."""
    if "(required)" in (action.help or ""):
        return True
    is_list = "[PATH [PATH ...]]" in _metavar(action) and not action.option_strings
    return is_list or not required_options.isdisjoint(action.option_strings)


def _metavar(action: argparse.Action) -> str:
    """Return what tyro writes for a value."""
    return action.metavar if isinstance(action.metavar, str) else ""


def _value(action: argparse.Action) -> str:
    """Return the word that stands for the value of an option; empty for a switch."""
    metavar = _metavar(action).replace("{None}|", "").replace("{None,", "{")
    if metavar in ("", "{True,False}") or action.nargs == 0:
        return ""
    if metavar.startswith("{"):
        return metavar
    if metavar in _WORDS_OF_NUMBERS:
        return _WORDS_OF_NUMBERS[metavar]
    if "PATH" in metavar:
        return "PATH ..." if "..." in metavar else "PATH"
    name = action.option_strings[0] if action.option_strings else action.dest
    return name.strip("-").rpartition(".")[2].rpartition("-")[2].upper()


def _typed(action: argparse.Action) -> str:
    """Return an option as it is typed."""
    value = _value(action)
    if not action.option_strings:
        return value
    if value:
        # tyro puts other names of an option first.
        return f"{', '.join(reversed(action.option_strings))} {value}"
    names = list(action.option_strings)
    if len(names) == 1 and "True" in _metavar(action):  # tyro: --x {None,True,False}
        names.append(names[0].replace("--", "--no-", 1))
    if "default: False" in (action.help or ""):
        names = names[:1]
    return ", ".join(names)


def _option_lines(action: argparse.Action) -> list[str]:
    """Return the lines of an option: how it is typed, and beside it what it does."""
    text = action.help or ""
    default = ""
    is_repeatable = False
    for mark in _MARK.finditer(text):
        is_repeatable = is_repeatable or mark["word"] == "repeatable"
        default = mark["value"] or default
    text = " ".join(_MARK.sub("", text).split())
    if default == "True":
        text += " It is on by default."
    elif default not in ("", "''", "None", "False") and not re.search(r"if\s+left\s+out", text):
        text += f" Default: {' '.join(default.split())}."
    if is_repeatable and "repeat" not in text:
        text += " It may be repeated."
    typed = _typed(action)
    heads = textwrap.wrap(
        typed.replace(",", ", ") if "{" in typed else typed,
        WIDTH - 2,
        initial_indent="  ",
        subsequent_indent="      ",
        break_on_hyphens=False,
    )
    described = textwrap.wrap(text, WIDTH - _INDENT, break_on_hyphens=False)
    if len(heads) == 1 and len(heads[0]) < _INDENT and described:
        first = f"{heads[0]:{_INDENT}}{described[0]}"
        return [first] + [" " * _INDENT + line for line in described[1:]]
    return heads + [" " * _INDENT + line for line in described]
