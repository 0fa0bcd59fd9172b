"""Checks the terms of a robot's own `env_cfgs.py` before anything is built.

mjlab calls the function of a term with the parameters of its configuration. Where they do not fit,
Python says so in the first step only, long after the robots were built, and does not name the term.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mjlab.envs import ManagerBasedRlEnvCfg

from pronk.errors import PronkError

_EVENT_ARGUMENTS = 2
"""Arguments that mjlab itself gives to functions of events and curricula: environment, robots."""
_OTHER_ARGUMENTS = 1
"""Arguments that mjlab itself gives to other functions: the environment."""


def check_terms(cfg: ManagerBasedRlEnvCfg, path: Path) -> None:
    """Refuse terms whose parameters are not those of their functions.

    Args:
        cfg: The configuration of the environment.
        path: The file that made it, for the message.

    Raises:
        PronkError: A parameter is unknown to its function, or is missing.
    """
    _check_section(cfg.events, "events", _EVENT_ARGUMENTS, path)
    _check_section(cfg.curriculum, "curriculum", _EVENT_ARGUMENTS, path)
    _check_section(cfg.rewards, "rewards", _OTHER_ARGUMENTS, path)
    _check_section(cfg.terminations, "terminations", _OTHER_ARGUMENTS, path)
    for name, group in cfg.observations.items():
        if group is not None:
            _check_section(group.terms, f"observations[{name!r}].terms", _OTHER_ARGUMENTS, path)


def _check_section(
    terms: Mapping[str, Any], section: str, mjlab_arguments: int, path: Path
) -> None:
    """Check the terms of one section.

    Args:
        terms: The terms by name; mjlab leaves out those that are None.
        section: Name of the terms in the configuration.
        mjlab_arguments: Number of arguments that mjlab itself gives.
        path: `check_terms`.
    """
    for name, term in terms.items():
        if term is None:
            continue
        if not callable(term.func):
            raise PronkError(
                f"{path}: cfg.{section}[{name!r}]: func is a {type(term.func).__name__}; expected "
                "a function, or a class whose objects can be called."
            )
        is_class = inspect.isclass(term.func)
        function = term.func.__call__ if is_class else term.func
        parameters = list(inspect.signature(function).parameters.values())
        # Of a class the first one is the object itself.
        own_parameters = parameters[mjlab_arguments + is_class :]
        takes_any = any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters)
        names = []
        missing = []
        for parameter in own_parameters:
            if parameter.kind in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL):
                continue
            names.append(parameter.name)
            if parameter.default is parameter.empty and parameter.name not in term.params:
                missing.append(parameter.name)
        unknown = [] if takes_any else [word for word in term.params if word not in names]
        if unknown or missing:
            problems = []
            if unknown:
                problems.append(f"has no parameter {', '.join(unknown)}")
            if missing:
                problems.append(f"needs {', '.join(missing)}")
            raise PronkError(
                f"{path}: cfg.{section}[{name!r}]: its function {' and '.join(problems)}; its "
                f"parameters are {', '.join(names) or 'none'}."
            )
