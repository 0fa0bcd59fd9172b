"""Find the command lines of the documentation, of help texts and of messages, where they stand."""

from __future__ import annotations

import ast
import io
import re
import shlex
from collections.abc import Iterator, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from pronk.cli.help_text import examples_of
from pronk.cli.main import COMMANDS, command_of, run

ROOT = Path(__file__).resolve().parents[1]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "policies" / "README.md",
    *sorted((ROOT / "docs").rglob("*.md")),
]
SCRIPT_BLOCK = re.compile(r"```(?:sh|bash|console)\n(.*?)```", re.DOTALL)
ANY_BLOCK = re.compile(r"```.*?```", re.DOTALL)
INDENTED_LINE = re.compile(r"^    ((?:pronk|python|make|pip) .*)$", re.MULTILINE)
INLINE_CODE = re.compile(r"`([^`]+)`")
LABEL = re.compile(r"\b[SMFNCPDERLA]\d{1,2}\b(?!-)")
"""Labels of the checklist of the paper, as in E5 or A17."""
PROGRAMS = ("pronk", "make", "python", "python3", "scripts", "uvx", "pipx", "pip")


@dataclass(frozen=True, kw_only=True)
class DocumentedCommand:
    """A command line that a reader may type."""

    place: str
    """File that it stands in."""
    folder: str
    """Folder that the lines before it changed to, relative to where the page begins."""
    words: tuple[str, ...]
    """The command and its arguments."""
    is_mention: bool = False
    """Whether it may be a part of a command, as `pronk match --wide` in a sentence."""

    @property
    def text(self) -> str:
        return shlex.join(self.words)


@cache
def help_of(name: str) -> str:
    """Return the help of a command."""
    printed = io.StringIO()
    with redirect_stdout(printed):
        assert run([name, "--help"]) == 0
    return printed.getvalue()


def commands_of_script(script: str, place: str) -> list[DocumentedCommand]:
    """Return the commands of some lines of a shell, without comments."""
    commands = []
    folder = ""
    for line in script.replace("\\\n", " ").splitlines():
        for part in re.split(r"\s&&\s", line):
            words = shlex.split(part, comments=True)
            if words and words[-1] == "&":
                words.pop()
            if words[:1] == ["cd"]:
                folder = words[1]
            elif words:
                command = DocumentedCommand(place=place, folder=folder, words=tuple(words))
                commands.append(command)
    return commands


def commands_of_page(page: Path) -> list[DocumentedCommand]:
    """Return the commands of a page: its scripts as one, then those within its sentences."""
    text = page.read_text(encoding="utf-8")
    place = str(page.relative_to(ROOT))
    script = "\n".join(SCRIPT_BLOCK.findall(text))
    sentences = ANY_BLOCK.sub("", text)
    script += "\n" + "\n".join(INDENTED_LINE.findall(sentences))
    commands = commands_of_script(script, place)
    for code in INLINE_CODE.findall(sentences):
        commands += inline_commands(code, place)
    return commands


def inline_commands(code: str, place: str) -> list[DocumentedCommand]:
    """Return the command in a sentence, if it is one of a program that is checked."""
    words = code.replace("\\|", "|").split()
    is_command = len(words) > 1 and words[0] in PROGRAMS
    if not is_command:
        return []
    words = shlex.split(code, comments=True)
    return [DocumentedCommand(place=place, folder="", words=tuple(words), is_mention=True)]


def commands_of_help() -> list[DocumentedCommand]:
    """Return the examples in the help of each command."""
    commands = []
    for name in COMMANDS:
        for example in examples_of(command_of(name)):
            words = tuple(shlex.split(example))
            commands.append(DocumentedCommand(place=f"{name} --help", folder="", words=words))
    return commands


def texts_of_module(module: Path) -> Iterator[str]:
    """Yield each text of a module; `...` stands for what is computed."""
    tree = ast.parse(module.read_text(encoding="utf-8"))
    parts_of_joined = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            text = ""
            for part in node.values:
                parts_of_joined.add(part)
                text += str(part.value) if isinstance(part, ast.Constant) else "..."
            yield text
        elif isinstance(node, ast.Constant) and node not in parts_of_joined:
            yield str(node.value)


def mentions_of_source() -> list[DocumentedCommand]:
    """Return the commands that messages, help texts and docstrings have between backquotes."""
    commands = []
    for module in sorted((ROOT / "src" / "pronk").rglob("*.py")):
        place = str(module.relative_to(ROOT))
        for text in texts_of_module(module):
            for code in INLINE_CODE.findall(text):
                if code.startswith("pronk "):
                    commands += inline_commands(code, place)
    return commands


def following_commands(output: str) -> list[str]:
    """Return the lines below `next:` of what a command printed."""
    lines = output.splitlines()
    if "next:" not in lines:
        return []
    begin = lines.index("next:") + 1
    return [line.strip() for line in lines[begin:] if line.startswith("  ")]


def usage_of_page(page: Path) -> list[str]:
    """Return the command lines on a page that a command wrote."""
    code = re.findall(r"<pre>(?:<code>)?(.*?)</", page.read_text(encoding="utf-8"), re.DOTALL)
    lines = []
    for block in code:
        for line in block.splitlines():
            if line.strip().startswith("pronk "):
                lines.append(line.strip())
    return lines


def unique(commands: Sequence[DocumentedCommand]) -> list[DocumentedCommand]:
    """Return commands without those that stand at one place twice."""
    return list(dict.fromkeys(commands))
