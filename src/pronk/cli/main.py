"""The command line: each command is a function whose parameters tyro makes into options.

A command that returns an `Outcome` also has the option `--json`. Bad input ends with one sentence
on standard error and exit status 2, and so do what the machine cannot do and an exception of a
user's own code, whose file and line are named. Any other exception is a defect of pronk, is named
so, and ends with 1 (`PRONK_DEBUG=1` prints the traceback). All exit statuses are in
`pronk.exit_status`.
"""

from __future__ import annotations

import codecs
import contextlib
import dataclasses
import errno
import inspect
import io
import os
import pkgutil
import re
import signal
import sys
import sysconfig
import traceback
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_type_hints

from pronk.errors import PronkError
from pronk.exit_status import ExitStatus
from pronk.garbage import collect_less_often, end_without_collection
from pronk.opengl import keep_opengl_out
from pronk.signals import interrupt
from pronk.version import VERSION

if TYPE_CHECKING:
    from pronk.cli.console import Outcome

COMMANDS: Mapping[str, tuple[str, str]] = {
    "sweep": ("pronk.cli.sweep:sweep", "Plan a sweep, check it against the limits, record it."),
    "record": ("pronk.cli.record:record", "Record a robot under another program; sends nothing."),
    "log": ("pronk.cli.log:log", "Guess how a log is read; write it down beside the log."),
    "response": ("pronk.cli.response:response", "Estimate frequency responses; Bode plots."),
    "match": (
        "pronk.cli.match:match_command",
        "Find the gains with which the simulator responds alike.",
    ),
    "profiles": ("pronk.cli.match:profiles", "List the frameworks that gains can be matched for."),
    "predict": ("pronk.cli.predict:predict_logs", "Replay logs that the fit has not used."),
    "drift": ("pronk.cli.drift:drift", "Say which gains have changed since an earlier match."),
    "export": ("pronk.cli.export:export_gains", "Write gains as configuration of a simulator."),
    "translate": (
        "pronk.cli.translate:translate_gains",
        "Translate gains for a framework of another drive law.",
    ),
    "probe": ("pronk.cli.probe:probe", "Name what a simulator or a network makes of a joint."),
    "train": ("pronk.cli.train:train_command", "Train a policy that walks and jumps."),
    "evaluate": (
        "pronk.cli.evaluate:evaluate_command",
        "Evaluate a policy in the training simulator.",
    ),
    "trial": ("pronk.cli.trial:trial", "Measure the paper's jumps on the virtual robot."),
    "study": ("pronk.cli.study:study", "Train arms from many seeds, try them on many robots."),
    "play": ("pronk.cli.play:play", "Steer the virtual robot in a browser."),
    "deploy": ("pronk.cli.deploy:deploy_command", "Run a policy on a robot or the virtual robot."),
    "policy": ("pronk.cli.policy:policy", "Check a policy that was trained elsewhere."),
    "simulate": ("pronk.cli.simulate:simulate", "Run the virtual robot as a process of its own."),
    "robot": ("pronk.cli.robot:robot", "Write or check the robot.yaml of a model."),
    "report": ("pronk.cli.report:report", "Write one HTML page of matches, trials, deployments."),
    "demo": ("pronk.cli.demo:demo", "Sweep, match and jump on the virtual robot."),
}
"""Name of a command: where its function is, and what it does."""

PLAIN_CHARACTERS = {"±": "+-", "²": "^2", "°": " deg", "µ": "u", "…": "...", "–": "-", "·": "*"}
"""Characters for terminals whose encoding has no others; "?" stands for all that are not here."""
MACHINE_ERRORS = (
    errno.ENOSPC,
    errno.EDQUOT,
    errno.EFBIG,
    errno.EROFS,
    errno.EACCES,
    errno.EPERM,
    errno.EMFILE,
    errno.ENFILE,
    errno.ENOMEM,
    errno.EIO,
    errno.ENAMETOOLONG,
    errno.ELOOP,
)
"""Errors of the operating system that say what the machine or its user cannot do, whatever pronk
does: a full disk or quota, a folder without permission, too many open files, a bad disk, a name
that is too long."""
_PACKAGE_FOLDERS = frozenset({"site-packages", "dist-packages"})
"""Folders of installed packages: of Python, of a user, and of Debian."""
_JSON_PARAMETER = "json_file"
"""Parameter of the option `--json`, which commands with an `Outcome` get."""


def run(
    arguments: Sequence[str],
    commands: Mapping[str, tuple[str, str]] = COMMANDS,
    program: str = "pronk",
) -> int:
    """Run a command and return its exit status.

    Args:
        arguments: The words after the program's name.
        commands: Where the function of each command is, and what it does.
        program: The program's name, for messages.
    """
    try:
        status = _dispatch(commands, list(arguments), program)
        if sys.stdout is not None:
            sys.stdout.flush()  # A full disk or a closed pipe shows here at the latest.
        return status
    except SystemExit as stop:  # The help of a command was printed.
        return int(stop.code or 0)
    except KeyboardInterrupt:
        status = ExitStatus.INTERRUPTED
        message = "interrupted."
    except Exception as error:
        status, message = _failure(error)
        if not isinstance(error, PronkError) and os.environ.get("PRONK_DEBUG"):
            traceback.print_exc()
    with contextlib.suppress(OSError):  # Standard error may be closed or full as well.
        print(f"pronk: {' '.join(message.split())}", file=sys.stderr, flush=True)  # noqa: T201
    return status


def _foreign_place(error: Exception) -> str:
    """Return the file and line in which an error was raised if that code is a user's own.

    That is the innermost frame of what is neither installed nor of Python itself, unless it is
    pronk's.
    """
    library = sysconfig.get_path("stdlib")
    package = Path(__file__).parents[1]
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        path = Path(frame.filename)
        if path.is_relative_to(package):
            return ""
        is_installed = not _PACKAGE_FOLDERS.isdisjoint(path.parts)
        if path.is_file() and not is_installed and not path.is_relative_to(library):
            return f"{path}, line {frame.lineno}"
    return ""


def _failure(error: Exception) -> tuple[ExitStatus, str]:
    """Return the exit status and the sentence of a command that ended with an error."""
    if isinstance(error, PronkError):
        return ExitStatus.REFUSED, str(error)
    if isinstance(error, BrokenPipeError):
        return ExitStatus.REFUSED, (
            "standard output was closed before everything was printed; files that were not named "
            "as written may be missing."
        )
    if isinstance(error, MemoryError):
        return ExitStatus.REFUSED, "out of memory; give fewer logs or joints at a time."
    if isinstance(error, OSError) and error.errno in MACHINE_ERRORS:
        place = f"{error.filename}: " if error.filename else "the output cannot be written: "
        return ExitStatus.REFUSED, (
            f"{place}{error.strerror}; make room or give another place, then run the command again."
        )
    place = _foreign_place(error)
    if place:
        return ExitStatus.REFUSED, (
            f"{type(error).__name__}: {error}, raised in {place}, which is not part of pronk; "
            "PRONK_DEBUG=1 prints how it was called."
        )
    return ExitStatus.DEFECT, (
        f"{type(error).__name__}: {error}. This is a defect of pronk, not of your input; "
        "PRONK_DEBUG=1 shows where it happened."
    )


def _dispatch(commands: Mapping[str, tuple[str, str]], arguments: list[str], program: str) -> int:
    """Print the help or the version, or run the command that the first word names."""
    name = arguments[0] if arguments else "--help"
    if name in ("--help", "-h"):
        print(_overview(commands, program))  # noqa: T201
        return 0
    if name == "--version":
        print(f"pronk {VERSION}")  # noqa: T201
        return 0
    if name not in commands:
        raise PronkError(f"there is no command {name!r}; the commands are {', '.join(commands)}.")
    command = command_of(name, commands)
    values = _parse(command, arguments[1:], f"{program} {name}")
    json_file = values.pop(_JSON_PARAMETER, None)
    outcome = command(**values)
    if outcome is None:
        return 0
    if outcome.pages_of:
        outcome = _with_pages(outcome)
    return int(outcome.end(json_file))


def command_of(
    name: str, commands: Mapping[str, tuple[str, str]] = COMMANDS
) -> Callable[..., Outcome | None]:
    """Return the function of a command."""
    location, _ = commands[name]
    command: Callable[..., Outcome | None] = pkgutil.resolve_name(location)
    return command


def parsed_command(arguments: Sequence[str]) -> dict[str, Any]:
    """Parse a command line without running it; return the values of the command's parameters.

    Args:
        arguments: The words after `pronk`.

    Raises:
        PronkError: There is no such command, or an option is unknown, missing or impossible.
        SystemExit: The help of the command was printed.
    """
    name = arguments[0] if arguments else ""
    if name not in COMMANDS:
        raise PronkError(f"there is no command {name!r}; the commands are {', '.join(COMMANDS)}.")
    return _parse(command_of(name), list(arguments[1:]), f"pronk {name}")


def _with_pages(outcome: Outcome) -> Outcome:
    """Write the pages of a command's artefacts, and name the first one in what to do next.

    Pages are made here, so that no command imports the report.
    """
    from pronk.report.build import write_artefact_page

    pages = [write_artefact_page(artefact) for artefact in outcome.pages_of]
    return dataclasses.replace(
        outcome,
        figures={**outcome.figures, "page": pages[0]},
        wrote=[*outcome.wrote, *pages],
        following=[f"open {pages[0]} in a browser", *outcome.following],
    )


def _overview(commands: Mapping[str, tuple[str, str]], program: str) -> str:
    """Return the list of commands with what each of them does."""
    width = max(map(len, commands))
    lines = [f"usage: {program} [--version] COMMAND ...", "", "commands:"]
    for name, (_, summary) in commands.items():
        lines.append(f"  {name:{width}}  {summary}")
    lines += ["", f"`{program} COMMAND --help` lists the options of a command."]
    return "\n".join(lines)


def _parse(command: Callable[..., Any], arguments: list[str], program: str) -> dict[str, Any]:
    """Return the values of a command's parameters by name.

    Raises:
        SystemExit: The help was printed.
        PronkError: An option is unknown, missing or has an impossible value.
    """
    import tyro

    from pronk.cli import help_text
    from pronk.cli.console import JsonFile, Outcome

    signature = inspect.signature(command, eval_str=True)
    parameters = list(signature.parameters.values())
    if signature.return_annotation is Outcome:
        json_option = inspect.Parameter(
            _JSON_PARAMETER, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=JsonFile
        )
        parameters.append(json_option)

    def collect(**values: Any) -> dict[str, Any]:
        return values

    # tyro makes the options of what it finds at a function.
    annotations = {parameter.name: parameter.annotation for parameter in parameters}
    collect.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    collect.__doc__ = help_text.without_examples(command.__doc__ or "")
    collect.__annotations__ = annotations
    config = (tyro.conf.UseAppendAction, tyro.conf.OmitArgPrefixes)
    if "--help" in arguments or "-h" in arguments:
        with warnings.catch_warnings():
            # tyro has no other public way to the texts of a command line's options.
            warnings.simplefilter("ignore", DeprecationWarning)
            parser: Any = tyro.extras.get_parser(collect, config=config)
        required_options = set()
        for parameter in parameters:
            if parameter.default is inspect.Parameter.empty:
                required_options.add(f"--{parameter.name.replace('_', '-')}")
        examples = help_text.examples_of(command)
        print(help_text.help_text(parser, program, examples, required_options))  # noqa: T201
        raise SystemExit(0)
    words = _with_explicit_values(arguments, annotations)
    messages = io.StringIO()
    try:
        with contextlib.redirect_stderr(messages):
            return tyro.cli(
                collect,
                prog=program,
                args=words,
                config=config,
            )
    except SystemExit as stop:
        if not stop.code:
            raise
        raise PronkError(_sentence(messages.getvalue(), program)) from None


def _with_explicit_values(arguments: list[str], annotations: Mapping[str, Any]) -> list[str]:
    """Write `--x` and `--no-x` of options `bool | None` as `--x=True` and `--x=False`.

    tyro expects a value there.
    """
    kinds = dict(annotations)
    groups = list(annotations.values())
    while groups:
        group = groups.pop()
        if dataclasses.is_dataclass(group):
            hints = get_type_hints(group)
            kinds |= hints
            groups += hints.values()
    explicit = {}
    for name, kind in kinds.items():
        if kind == bool | None:
            option = name.replace("_", "-")
            explicit[f"--{option}"] = f"--{option}=True"
            explicit[f"--no-{option}"] = f"--{option}=False"
    return [explicit.get(word, word) for word in arguments]


def _sentence(box: str, program: str) -> str:
    """Make one sentence of the message that tyro prints in a box."""
    text = " ".join(re.sub(r"[│╭╮╰╯─]|-{3,}", " ", box).split())
    text = text.split("For full helptext")[0].rstrip(". ")
    title = r"^(Parsing error|Required options|Unrecognized options|Value error|Invalid choice) "
    return f"{re.sub(title, '', text)}; `{program} --help` lists the options."


def main() -> None:
    """Entry point of the `pronk` command."""
    collect_less_often()
    keep_opengl_out()
    # Matrices are small here, and threads of the linear algebra would take the cores from those of
    # the simulations: a match of twelve joints takes 6.8 s in place of 9.2 s on two cores.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    _print_plain_characters()
    with contextlib.suppress(ValueError):  # Signals are for the main thread alone.
        signal.signal(signal.SIGTERM, interrupt)
    if sys.stdout is None:
        if sys.stderr is not None:
            sys.stderr.write("pronk: standard output is closed; give it a place, as in >out.txt.\n")
        sys.exit(ExitStatus.REFUSED)
    status = run(sys.argv[1:])
    _abandon_broken_output()
    end_without_collection()
    sys.exit(status)


def _print_plain_characters() -> None:
    """Print characters that the terminal's encoding does not have as others that look alike."""
    codecs.register_error("pronk-plain", _plain_characters)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="pronk-plain")


def _plain_characters(error: UnicodeError) -> tuple[str, int]:
    """Return plain characters for those that cannot be encoded, and where to go on."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    text = error.object[error.start : error.end]
    return "".join(PLAIN_CHARACTERS.get(character, "?") for character in text), error.end


def _abandon_broken_output() -> None:
    """Send what a full or closed standard output did not take to nowhere.

    Python would otherwise try to write it once more as it ends, and fail with a message of its own.
    """
    for stream in (sys.stdout, sys.stderr):
        if stream is None:
            continue
        try:
            stream.flush()
        except (OSError, ValueError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            with contextlib.suppress(OSError, ValueError):
                os.dup2(nowhere, stream.fileno())


if __name__ == "__main__":
    main()
