"""Errors of the Python API: options of the command line as parameters of functions."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable
from typing import ParamSpec, TypeVar

from pronk.errors import PronkError

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")

_OPTION = re.compile(
    r"(?<![\w-])--(?P<name>[a-z][a-z-]*)"
    r"(?: (?P<word>rad|deg|s|ms|us|ns|default)\b"
    r"| (?P<key>[\w./]+)=(?P<value>[A-Za-z_]\w*(?:,[A-Z]+)*))?"
)
"""An option, with a value of a few words or of the form NAME=VALUE behind it."""
_OTHER_NAMES = {
    "for": "simulator",
    "fit": "MatchSettings.fitted",
    "segment-s": "Estimator.segment_s",
    "simulator-python": "MatchSettings.simulator_python",
}
"""Parameters whose names are not those of their options."""


def python_words(text: str) -> str:
    """Return a message with parameters of Python in place of options of the command line.

    `--unit deg` becomes `unit="deg"`, and `--scale JOINT=RADIANS` `scale={"JOINT": RADIANS}`.
    """
    return _OPTION.sub(_parameter, text)


def _parameter(option: re.Match[str]) -> str:
    """Return the parameter of an option, with its value."""
    name = _OTHER_NAMES.get(option["name"], option["name"].replace("-", "_"))
    if option["word"]:
        return f'{name}="{option["word"]}"'
    if option["key"]:
        value = option["value"]
        if "," in value:
            value = f"({value.replace(',', ', ')})"
        elif not value.isupper():  # A name, not a word that stands for a number.
            value = f'"{value}"'
        return f'{name}={{"{option["key"]}": {value}}}'
    return name


def with_python_words(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Return a function whose errors name parameters of Python."""

    @functools.wraps(function)
    def call(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        try:
            return function(*args, **kwargs)
        except PronkError as error:
            error.args = (python_words(str(error)), *error.args[1:])
            raise

    return call
