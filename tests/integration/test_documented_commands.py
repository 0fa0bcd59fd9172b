"""Every documented command runs: in pages, help texts, `next:` lines and the pages of a match.

Commands stand in the documentation as a reader would type them. They are run in a folder with what
the pages name: recordings, robots, policies, matches. Words in upper case are replaced, and what
would take long is made short. Commands that need what a test has not are parsed.
"""

from __future__ import annotations

import io
import re
import shlex
import shutil
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path

import pytest

from command_line import FinishedCommand, accepted, invoke
from documented_commands import (
    LABEL,
    PAGES,
    ROOT,
    DocumentedCommand,
    commands_of_help,
    commands_of_page,
    following_commands,
    help_of,
    mentions_of_source,
    unique,
    usage_of_page,
)
from pronk.cli import console
from pronk.cli.main import COMMANDS, parsed_command
from pronk.exit_status import ExitStatus
from pronk.tables import Table

PLACEHOLDERS = {
    "DIR": "made",
    "JOINT": "FR_knee",
    "LOG": "logs",
    "LOGS": "logs",
    "MODEL": "my_robot.urdf",
    "MODEL.xml": "my_robot.urdf",
    "NAME": "isaaclab-implicit",
    "PATH": "robot.yaml",
    "POLICY": "policies/matched/policy.onnx",
    "ROBOT": "mini_cheetah",
}
"""What stands for the words that a reader replaces, in the folder of the Mini Cheetah."""
LEG_PLACEHOLDERS = {"JOINT": "hip", "ROBOT": "robot.yaml"}
"""The same in the folder of an own leg."""
LEG_PLACES = ("docs/your-log.md", "docs/your-robot.md", "CONTRIBUTING.md")
"""Pages about a robot of the reader's own; help texts are read in its folder as well."""
PARSED = {
    "train": "needs a GPU",
    "study": "trains for hours",
    "runs/": "needs the folder of a training",
    "evaluate": "needs a GPU",
    "play": "serves a browser until it is ended",
    "simulate": "runs until it is ended",
    "deploy": "takes the time of the run",
    "--link lcm": "needs a second process",
    "dds://eth0": "needs a robot",
    "recording.mcap": "needs a recording of a robot",
    "lcm://eth0": "needs a robot",
    "--link dds": "needs a second process",
    "--interface": "needs a robot",
    "--simulator-python": "needs an engine in another Python",
    "examples/engines/": "needs an engine",
    "--walk": "walks for minutes",
    "--crossing": "crosses for minutes",
    "--conditions": "jumps for minutes",
    "chirp_sweep": "needs recordings that are not in the repository",
    "step_response": "needs recordings that are not in the repository",
    "menagerie:NAME": "needs a robot that is downloaded",
    "traj_0.pt": "needs a recording that is not in the repository",
    "--deploy": "needs a policy that was trained elsewhere",
    "match logs --robot go2": "needs logs of a Go2",
    "match chirp.csv --robot go2": "needs a log of a Go2",
    "OLD.yaml": "needs an earlier match",
    "NET.pt": "needs an actuator network",
}
"""Words of commands that are parsed and not run, and why."""
OTHER_PROGRAMS = (
    "pip",
    "ray",
    "pipx",
    "uvx",
    "python3",
    ".",
    "physx/bin/pip",
    "pip-compile",
    "pip-audit",
    "cyclonedx-py",
)
"""Programs of other people, which set up an environment."""


class Workspace:
    """The folders in which commands run, and which of them have run."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.finished: dict[tuple[Path | str, ...], FinishedCommand] = {}

    def folder_of(self, command: DocumentedCommand) -> Path:
        """Return where a command is run."""
        if command.folder == "examples/csv_to_isaaclab":
            return self.root / "leg"  # which has the files of that folder
        is_own = command.place in LEG_PLACES or command.place.endswith("--help")
        if "chirp.csv" in command.words and not command.folder:
            is_own = True
        if {"demo", "trial", "mini_cheetah"} & set(command.words):
            is_own = False
        return self.root / ("leg" if is_own else "quadruped") / command.folder

    def run(self, words: Sequence[str], folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """Run a command and all that it names as next; fail where one does not run."""
        line = " ".join(words)
        bounded_words = bounded(words, folder)
        key = (folder, *arguments_in_order(bounded_words))
        if key in self.finished:
            return
        if any(word in line.split() or word in line for word in PARSED):
            parsed_command(words[1:])
            return
        monkeypatch.chdir(folder)
        tables: list[Table] = []
        show = console.show

        def show_and_keep(table: Table, *, wide: bool = False) -> None:
            tables.append(table)
            show(table, wide=wide)

        robot_file = folder / "robot.yaml"
        described = robot_file.read_bytes() if robot_file.exists() else b""
        with monkeypatch.context() as patch:
            patch.setattr(console, "show", show_and_keep)
            command = invoke(bounded_words[1:])
        if described:  # That of a new robot has values to be checked by a person.
            robot_file.write_bytes(described)
        self.finished[key] = command
        assert command.exit_code == ExitStatus.DONE, f"{line}\n{command.output}"
        assert not LABEL.findall(command.output.replace(str(self.root), "")), command.output
        if "--wide" not in words:
            for table in tables:
                check_width(table, monkeypatch)
        for following in following_commands(command.stdout):
            # A log of the same kind stands for a fresh one.
            self.follow(following.replace("FRESH_LOG", bounded_words[2]), folder, monkeypatch)
        for page in re.findall(r"^wrote (\S+\.html)$", command.stdout, re.MULTILINE):
            path = (folder / page).resolve()
            for usage in usage_of_page(path):
                self.run(replaced(shlex.split(usage), path.parent), path.parent, monkeypatch)

    def follow(self, line: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """Do what a line below `next:` says."""
        if line.startswith("open "):
            assert (folder / line.split()[1]).exists(), line
            return
        words = shlex.split(line, comments=True)
        if words[0] == "pronk":
            self.run(replaced(words, folder), folder, monkeypatch)


def replaced(words: Sequence[str], folder: Path) -> list[str]:
    """Put what exists in a folder for the words that a reader replaces."""
    placeholders = dict(PLACEHOLDERS)
    if (folder / "fresh.csv").exists():
        placeholders |= LEG_PLACEHOLDERS
    return [placeholders.get(word, word) for word in words]


def arguments_in_order(words: Sequence[str]) -> list[str]:
    """Return the words of a command with its options sorted, each with what follows it."""
    before = []
    options: list[str] = []
    for word in words:
        if word.startswith("--"):
            options.append(word)
        elif options:
            options[-1] = f"{options[-1]} {word}"
        else:
            before.append(word)
    return before + sorted(options)


def bounded(words: Sequence[str], folder: Path) -> list[str]:
    """Make a command short, and let it replace what it made before."""
    bounded_words = list(words)
    name = words[1]
    if name == "trial":
        if "--jumps" in words:
            bounded_words[words.index("--jumps") + 1] = "1"
        else:
            bounded_words += ["--jumps", "1"]
        if "paper" in words:  # five commands
            bounded_words[words.index("paper")] = "1,0"
        elif not any(word.startswith("--commands") for word in words):
            bounded_words += ["--commands", "1,0"]
        bounded_words += ["--no-video", "--overwrite"]
    elif name == "sweep":
        if "--joints" not in words:
            bounded_words += ["--joints", "FR_knee"]
        elif "mini_cheetah" in words:
            # One knee stands for another, so that no later match has two of them.
            bounded_words[words.index("--joints") + 1] = "FR_knee"
        if "--repeats" not in words:
            # Mode drive needs two.
            bounded_words += ["--repeats", "2" if "mini_cheetah" in words else "1"]
        if "--amplitude" not in words:
            bounded_words += ["--amplitude", "0.2"]
        if "--plan-only" not in words:
            bounded_words.append("--overwrite")
    elif words[1:3] in (["robot", "new"], ["log", "foxglove"]):
        bounded_words.append("--overwrite")
    elif name == "match" and "paper" in words:
        bounded_words.append("--no-zero-armature")
        if "--out" not in words:
            bounded_words += ["--out", "out/paper/gains.yaml"]
        # The chirps of the quick demo are half as long as the usual ones.
        for logs in ("out/demo/logs", words[2]):
            knee = folder / logs / "FR_knee.mcap"
            if knee.exists():
                bounded_words[2] = str(knee.relative_to(folder))
                break
    elif name == "demo":
        if "--quick" not in words:
            bounded_words.append("--quick")
        bounded_words += ["--repeats", "1"]
    return bounded_words


def check_width(table: Table, monkeypatch: pytest.MonkeyPatch) -> None:
    """Require that a table fits 80 columns, with no word of it cut, broken or left out."""
    printed = {}
    for width in (80, 300):
        monkeypatch.setenv("COLUMNS", str(width))
        text = io.StringIO()
        with redirect_stdout(text):
            console.show(replace(table, notes=()))
        printed[width] = text.getvalue().replace("─", "")
    for line in printed[80].splitlines():
        assert len(line) <= 80, line
    assert set(printed[80].split()) == set(printed[300].split()), printed[80]


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """Make the folders that the pages speak of.

    In `quadruped` there is what a reader in the repository has after a sweep of one knee, in `leg`
    what one with a robot of his own has.
    """
    root = tmp_path_factory.mktemp("documented")
    quadruped = root / "quadruped"
    leg = root / "leg"
    for folder in ("policies", "examples"):
        shutil.copytree(ROOT / folder, quadruped / folder)
    shutil.copytree(ROOT / "policies", leg / "policies")
    for name in ("chirp.csv", "fresh.csv", "leg.urdf", "robot.yaml"):
        shutil.copy(ROOT / "examples" / "csv_to_isaaclab" / name, leg / name)
    for folder in (quadruped, leg):
        shutil.copy(ROOT / "examples" / "csv_to_isaaclab" / "leg.urdf", folder / "my_robot.urdf")
    shutil.copy(ROOT / "tests" / "ak80.xml", quadruped / "ak80.xml")

    knee = ("sweep", "mini_cheetah", "--joints", "FR_knee")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(quadruped)
        accepted(*knee, "--out", "logs", "--repeats", "2", "--amplitude", ".2")
        once = ("--repeats", "1", "--amplitude", ".2", "--seed", "1")
        accepted(*knee, "--out", "fresh", "--signal", "log-chirp", *once)
        shutil.copy("fresh/FR_knee.mcap", "fresh.mcap")
        shutil.copytree("logs", "out/demo/logs")
        accepted("match", "logs", "--robot", "mini_cheetah", "--out", "gains.yaml")
        for run in ("runs/matched", "runs/m1"):
            shutil.copytree("policies/matched", run)
        patch.chdir(leg)
        accepted("log", "inspect", "chirp.csv", "--robot", "robot.yaml", "--yes")
        accepted("log", "inspect", "fresh.csv", "--robot", "robot.yaml", "--yes")
    return Workspace(root)


def documented() -> list[DocumentedCommand]:
    """Return the commands of all pages and help texts, in the order of reading."""
    commands = []
    for page in PAGES:
        commands += commands_of_page(page)
    return unique(commands + commands_of_help())


def complete(command: DocumentedCommand) -> bool:
    """Return whether a command in a sentence names what it is to be done to."""
    if not command.is_mention:
        return True
    words = command.words[2:]
    if command.words[1] in ("robot", "log", "policy"):
        words = words[1:]
    return bool(words) and not words[0].startswith("-") and "..." not in command.text


def check_mention(command: DocumentedCommand) -> None:
    """Require that the command and the options of a part of a command line exist."""
    name = command.words[1]
    if name in ("--help", "--version", "COMMAND"):
        return
    assert name in COMMANDS, command
    for word in command.words[2:]:
        if word.startswith("--") and word != "--help":
            assert word.partition("=")[0] in help_of(name).split(), command


def check_benchmark(name: str, words: Sequence[str]) -> None:
    """Require that a benchmark and its options exist; benchmarks are not imported by tests."""
    folder = ROOT / "benchmarks"
    summaries = (folder / "__main__.py").read_text(encoding="utf-8")
    assert f'    "{name}": ' in summaries
    module = folder / f"{name.replace('-', '_')}.py"
    if not module.exists():
        module = folder / name / "command.py"
    source = module.read_text(encoding="utf-8")
    for word in words:
        if word.startswith("--"):
            parameter = word[2:].replace("-", "_")
            assert re.search(rf"\b{parameter}\b", source), (name, word)


def check_other_program(words: Sequence[str]) -> None:
    """Require that the script, benchmark or target of a command exists."""
    if words[:3] == ("python", "-m", "benchmarks"):
        if len(words) > 3 and words[3] != "NAME":
            check_benchmark(words[3], words[4:])
        return
    if words[0] == "make":
        makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
        for target in words[1:]:
            if "=" not in target and target != "TARGET":
                assert re.search(rf"^{re.escape(target)}:", makefile, re.MULTILINE), words
        return
    if words[0] == "python" and words[1] != "-m":
        assert (ROOT / words[1]).exists(), words
        return
    assert words[0] in (*OTHER_PROGRAMS, "python"), words


@pytest.mark.parametrize("command", documented(), ids=lambda command: command.place)
def test_a_documented_command_runs(
    command: DocumentedCommand, workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    if command.words[0] != "pronk":
        check_other_program(command.words)
    elif complete(command):
        folder = workspace.folder_of(command)
        workspace.run(replaced(command.words, folder), folder, monkeypatch)
    else:
        check_mention(command)


def test_commands_in_messages_exist() -> None:
    mentions = mentions_of_source()
    assert len(mentions) > 20
    for command in mentions:
        check_mention(command)
