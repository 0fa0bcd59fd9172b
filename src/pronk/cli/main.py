"""The command line: one command per arrow of the way of the data, and nothing else.

A bad input ends with one sentence and exit status 2; anything else that escapes is a defect of
pronk, is called so, and ends with 1 (`PRONK_DEBUG=1` shows where it came from).
"""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Sequence
from typing import Annotated

import typer

from pronk import __version__, opengl
from pronk.cli import (
    demo,
    deploy,
    evaluate,
    export,
    match,
    play,
    predict,
    report,
    response,
    simulate,
    sweep,
    train,
    trial,
)
from pronk.errors import PronkError

app = typer.Typer(
    name="pronk",
    help="From a chirp to matched gains to a policy that jumps: ask every joint, write down its "
    "answer, make the simulator answer alike, train in it.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command("sweep")(sweep.sweep)
app.command("response")(response.response)
app.command("match")(match.match)
app.command("predict")(predict.predict)
app.command("train")(train.train)
app.command("evaluate")(evaluate.evaluate)
app.command("export")(export.export)
app.command("trial")(trial.trial)
app.command("play")(play.play)
app.command("deploy")(deploy.deploy)
app.command("simulate")(simulate.simulate)
app.command("report")(report.report)
app.command("demo")(demo.demo)


def _show_version(asked: bool) -> None:
    if asked:
        typer.echo(f"pronk {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Show and leave."),
    ] = False,
) -> None:
    """Options of pronk itself."""


# Misspelled options and the like: the base of BadParameter's base, wherever typer keeps it.
_UsageError: type[Exception] = typer.BadParameter.__mro__[2]


_RENAMED = {
    ("twin",): "`pronk twin` is now `pronk simulate`",
    ("--truth",): "`--truth` is now `--sim-params`",
    ("--link", "twin"): "`--link twin` is now `--link sim`",
    ("--link=twin",): "`--link twin` is now `--link sim`",
}
"""Words of earlier releases, as they follow each other on the command line, and their hints."""


def _hint(arguments: Sequence[str]) -> str:
    """What replaces the first old word on a command line; empty without one."""
    for words, hint in _RENAMED.items():
        places = range(1) if words[0][0] != "-" else range(len(arguments))
        if any(tuple(arguments[k : k + len(words)]) == words for k in places):
            return hint
    return ""


def _complain(text: str) -> None:
    typer.echo(f"pronk: {' '.join(text.split())}", err=True)


def run(arguments: Sequence[str]) -> int:
    """Run one command line and return its exit status.

    Args:
        arguments: The words after `pronk`.
    """
    return run_app(app, arguments, "pronk")


def run_app(commands: typer.Typer, arguments: Sequence[str], name: str) -> int:
    """Run a command line with pronk's error messages and return its exit status.

    Args:
        commands: The commands to choose from.
        arguments: The words after the program's name.
        name: Name of the program.
    """
    if hint := _hint(arguments):
        _complain(f"{hint}; `{name} --help` lists the commands.")
        return 2
    try:
        status = commands(list(arguments), prog_name=name, standalone_mode=False)
        return status if isinstance(status, int) else 0
    except PronkError as error:
        _complain(str(error))
        return 2
    except (KeyboardInterrupt, typer.Abort):
        _complain("interrupted.")
        return 130
    except _UsageError as error:
        message = str(getattr(error, "message", error))
        # Without arguments the message is the help itself.
        if not message.strip() or not arguments:
            return 0 if not arguments else 2
        context = getattr(error, "ctx", None)
        command = context.command_path if context is not None else "pronk"
        _complain(f"{message.rstrip('.')}; `{command} --help` lists what there is.")
        return 2
    except BrokenPipeError:
        # Whoever read the output has seen enough.
        sys.stderr.close()
        return 0
    except MemoryError:
        _complain("out of memory; give fewer logs or joints at a time.")
        return 1
    except Exception as error:
        if os.environ.get("PRONK_DEBUG"):
            traceback.print_exc()
        _complain(
            f"{type(error).__name__}: {error}. This is a defect of pronk, not of your input; "
            "PRONK_DEBUG=1 shows where it happened."
        )
        return 1


def main() -> None:
    """Entry point of the `pronk` command."""
    opengl.keep_out()
    sys.exit(run(sys.argv[1:]))


if __name__ == "__main__":
    main()
