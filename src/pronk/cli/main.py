"""The command line: each command is a function whose parameters tyro makes into options.

A command that returns an `Outcome` also has the option `--json`. Bad input ends with one sentence
on standard error and exit status 2. Any other exception is a defect of pronk, is named so, and
ends with 1 (`PRONK_DEBUG=1` prints the traceback).
"""

from __future__ import annotations

import contextlib
import dataclasses
import inspect
import io
import os
import pkgutil
import re
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from typing import Any, get_type_hints

from pronk import __version__, opengl
from pronk.errors import PronkError

COMMANDS: Mapping[str, tuple[str, str]] = {
    "sweep": ("pronk.cli.sweep:sweep", "Plan a sweep, check it against the limits, record it."),
    "response": ("pronk.cli.response:response", "Estimate frequency responses; Bode plots."),
    "match": ("pronk.cli.match:match", "Find the gains with which the simulator responds alike."),
    "profiles": ("pronk.cli.match:profiles", "List the frameworks that gains can be matched for."),
    "predict": ("pronk.cli.predict:predict", "Replay logs that the fit has not used."),
    "export": ("pronk.cli.export:export", "Write gains as configuration of a simulator."),
    "translate": (
        "pronk.cli.translate:translate",
        "Translate gains for a framework of another drive law.",
    ),
    "probe": ("pronk.cli.probe:probe", "Name what a simulator makes of a joint's settings."),
    "train": ("pronk.cli.train:train", "Train a policy that walks and jumps."),
    "evaluate": ("pronk.cli.evaluate:evaluate", "Evaluate a policy in the training simulator."),
    "trial": ("pronk.cli.trial:trial", "Measure the paper's jumps on the virtual robot."),
    "play": ("pronk.cli.play:play", "Steer the virtual robot in a browser."),
    "deploy": ("pronk.cli.deploy:deploy", "Run a policy on a robot or the virtual robot."),
    "simulate": ("pronk.cli.simulate:simulate", "Run the virtual robot as a process of its own."),
    "robot": ("pronk.cli.robot:robot", "Write or check the robot.yaml of a model."),
    "report": ("pronk.cli.report:report", "Write one HTML page of matches, trials, deployments."),
    "demo": ("pronk.cli.demo:demo", "Sweep, match and jump on the virtual robot."),
}
"""Name of a command: where its function is, and what it does."""

RENAMED = {
    "twin": "`pronk twin` is now `pronk simulate`.",
    "bench": "`pronk bench NAME` is now `python -m benchmarks NAME`, run in a checkout.",
    "--link twin": "`--link twin` is now `--link sim`.",
    "--truth": "`--truth` is now `--sim-params`.",
    "--free": "`--free` is now `--fit`.",
    "--release": "`--release` is now `--disable-onboard-controller`.",
    "--any-delay": "`--any-delay` is now `--ignore-latency-check`.",
    "--blend": "`--blend` is now `--blend-time-s`.",
    "--like": "`--like` is now `--ranges-from`.",
}
"""Names of the release before, each with the hint that replaces it."""
_JSON = "json_file"


def run(
    arguments: Sequence[str],
    commands: Mapping[str, tuple[str, str]] = COMMANDS,
    program: str = "pronk",
) -> int:
    """Run one of `commands` with the words after the program's name; return its exit status."""
    try:
        return _dispatch(commands, list(arguments), program)
    except SystemExit as stop:  # The help of a command was printed.
        return int(stop.code or 0)
    except BrokenPipeError:
        sys.stderr.close()  # The reader of a pipe has closed it.
        return 0
    except PronkError as error:
        status, text = 2, str(error)
    except KeyboardInterrupt:
        status, text = 130, "interrupted."
    except MemoryError:
        status, text = 1, "out of memory; give fewer logs or joints at a time."
    except Exception as error:
        if os.environ.get("PRONK_DEBUG"):
            traceback.print_exc()
        status = 1
        text = (
            f"{type(error).__name__}: {error}. This is a defect of pronk, not of your input; "
            "PRONK_DEBUG=1 shows where it happened."
        )
    print(f"pronk: {' '.join(text.split())}", file=sys.stderr)  # noqa: T201
    return status


def _dispatch(commands: Mapping[str, tuple[str, str]], arguments: list[str], program: str) -> int:
    name = arguments[0] if arguments else "--help"
    if name in ("--help", "-h"):
        width = max(map(len, commands))
        lines = [f"usage: {program} [--version] COMMAND ...", "", "commands:"]
        lines += [f"  {name:{width}}  {text}" for name, (_, text) in commands.items()]
        lines += ["", f"`{program} COMMAND --help` lists the options of a command."]
        print("\n".join(lines))  # noqa: T201
        return 0
    if name == "--version":
        print(f"pronk {__version__}")  # noqa: T201
        return 0
    if name not in commands:
        hint = RENAMED.get(name) or f"the commands are {', '.join(commands)}."
        raise PronkError(f"there is no command {name!r}; {hint}")
    command = pkgutil.resolve_name(commands[name][0])
    values = _parse(command, arguments[1:], f"{program} {name}")
    json_file = values.pop(_JSON, None)
    outcome = command(**values)
    return 0 if outcome is None else int(outcome.end(json_file))


def _parse(command: Callable[..., Any], arguments: list[str], program: str) -> dict[str, Any]:
    """Return the values of a command's parameters; SystemExit if the help was printed."""
    import tyro

    from pronk.cli.console import JsonFile, Outcome

    signature = inspect.signature(command, eval_str=True)
    options = list(signature.parameters.values())
    if signature.return_annotation is Outcome:
        known = {"default": None, "annotation": JsonFile}
        options.append(inspect.Parameter(_JSON, inspect.Parameter.KEYWORD_ONLY, **known))

    def call(**values: Any) -> dict[str, Any]:
        return values

    call.__signature__ = signature.replace(parameters=options)  # type: ignore[attr-defined]
    call.__doc__ = command.__doc__
    call.__annotations__ = {option.name: option.annotation for option in options}
    kinds = dict(call.__annotations__)
    for kind in call.__annotations__.values():
        kinds |= get_type_hints(kind) if dataclasses.is_dataclass(kind) else {}
    for name, kind in kinds.items():
        if kind == bool | None:  # tyro wants a value there: --x True.
            option = name.replace("_", "-")
            words = {f"--{option}": f"--{option}=True", f"--no-{option}": f"--{option}=False"}
            arguments = [words.get(word, word) for word in arguments]
    config = (tyro.conf.UseAppendAction, tyro.conf.OmitArgPrefixes)
    messages = io.StringIO()
    try:
        with contextlib.redirect_stderr(messages):
            return tyro.cli(call, prog=program, args=arguments, config=config)
    except SystemExit as stop:
        if not stop.code:
            raise
        raise PronkError(_sentence(messages.getvalue(), arguments, program)) from None


def _sentence(box: str, arguments: list[str], program: str) -> str:
    """Make one sentence of the message that tyro prints in a box."""
    words = " ".join(arguments)
    for old, hint in RENAMED.items():
        if old.startswith("-") and re.search(rf"(?:^| ){re.escape(old)}(?:[ =]|$)", words):
            return hint
    text = " ".join(re.sub(r"[│╭╮╰╯─]|-{3,}", " ", box).split())
    text = text.split("For full helptext")[0].rstrip(". ")
    title = r"^(Parsing error|Required options|Unrecognized options|Value error|Invalid choice) "
    return f"{re.sub(title, '', text)}; `{program} --help` lists the options."


def main() -> None:
    """Entry point of the `pronk` command."""
    opengl.keep_out()
    sys.exit(run(sys.argv[1:]))


if __name__ == "__main__":
    main()
