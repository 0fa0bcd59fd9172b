"""Count what makes code hard to read, and list what the project does not use at all.

    python scripts/plain_code.py                       # src and tests, with the bars
    python scripts/plain_code.py src/pronk/identify    # one row for each path

CONTRIBUTING.md has the rules with examples. Rates are per 1,000 lines that are neither blank nor
comments nor docstrings.
"""

from __future__ import annotations

import argparse
import ast
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

BARS = {
    "comprehensions": 20.0,
    "nested comprehensions": 0.3,
    "packed assignments": 3.0,
    "assignment expressions": 0.5,
}
"""Largest rates per 1,000 lines of code."""
VAGUE_NAMES_BAR = 0.5
"""Largest share of names that do not say what they hold [%]."""
MAX_FIELDS = 15
"""Most fields of a dataclass."""
TASK_FUNCTIONS = ("env_cfg", "rl_cfg")
"""Functions of `env_cfgs.py` and `rl_cfg.py` beside the `robot.yaml` of a robot."""
EXEMPT_DATACLASSES = {
    "TrialResults": "the artefact summary.json",
    "LowState": "a message whose fields Unitree declares",
}
"""Dataclasses with more fields, and why: what is on disk or on a wire is declared in one piece."""
VAGUE_NAMES = frozenset(
    {
        "one",
        "own",
        "found",
        "mine",
        "known",
        "each",
        "left",
        "held",
        "aside",
        "every",
        "theirs",
        "rest",
        "whole",
        "others",
        "both",
        "kind",
        "where",
        "what",
        "last",
        "made",
        "given",
        "here",
        "there",
        "much",
        "most",
        "least",
        "even",
        "wanted",
        "shown",
        "wrong",
    }
)
"""Pronouns, adjectives and participles that do not say what a variable holds."""
COMPREHENSIONS = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)


@dataclass
class Count:
    """Counts of some files."""

    code_lines: int = 0
    comprehensions: int = 0
    nested_comprehensions: int = 0
    packed_assignments: int = 0
    assignment_expressions: int = 0
    names: int = 0
    vague_names: int = 0

    def rates(self) -> dict[str, float]:
        """Return the counts per 1,000 lines of code, by the names of `BARS`."""
        thousands = max(self.code_lines, 1) / 1000.0
        return {
            "comprehensions": self.comprehensions / thousands,
            "nested comprehensions": self.nested_comprehensions / thousands,
            "packed assignments": self.packed_assignments / thousands,
            "assignment expressions": self.assignment_expressions / thousands,
        }

    def vague_percent(self) -> float:
        """Return the share of vague names [%]."""
        return 100.0 * self.vague_names / max(self.names, 1)


def python_files(path: Path) -> list[Path]:
    """Return a file, or all Python files below a folder."""
    return [path] if path.is_file() else sorted(path.rglob("*.py"))


def count(path: Path) -> Count:
    """Count statements and names in a file or below a folder."""
    total = Count()
    for file in python_files(path):
        text = file.read_text(encoding="utf-8")
        tree = ast.parse(text)
        docstrings = _docstring_lines(tree)
        for number, line in enumerate(text.splitlines(), start=1):
            stripped = line.strip()
            is_code = bool(stripped) and not stripped.startswith("#")
            total.code_lines += is_code and number not in docstrings
        for node in ast.walk(tree):
            _count_node(node, total)
    return total


def _docstring_lines(tree: ast.AST) -> set[int]:
    """Return the numbers of the lines that texts by themselves take."""
    lines: set[int] = set()
    for node in ast.walk(tree):
        is_text = (
            isinstance(node, ast.Expr)
            and isinstance(node.value, ast.Constant)
            and isinstance(node.value.value, str)
        )
        if is_text:
            lines.update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return lines


def _count_node(node: ast.AST, total: Count) -> None:
    """Add one node of a syntax tree to the counts."""
    if isinstance(node, COMPREHENSIONS):
        total.comprehensions += 1
        inner = [child for child in ast.walk(node) if child is not node]
        total.nested_comprehensions += any(isinstance(child, COMPREHENSIONS) for child in inner)
    elif isinstance(node, ast.NamedExpr):
        total.assignment_expressions += 1
    elif isinstance(node, ast.Assign):
        total.packed_assignments += isinstance(node.targets[0], ast.Tuple) and isinstance(
            node.value, ast.Tuple
        )
    elif isinstance(node, ast.arg):
        _count_name(node.arg, total)
    elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
        _count_name(node.id, total)


def _count_name(name: str, total: Count) -> None:
    total.names += 1
    total.vague_names += name.lstrip("_") in VAGUE_NAMES


def introspection(path: Path) -> Iterator[str]:
    """Yield each place that reads or sets fields by computed names."""
    for file in python_files(path):
        tree = ast.parse(file.read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                if node.func.id in ("vars", "setattr"):
                    yield f"{file}:{node.lineno} {node.func.id}()"
            elif isinstance(node, ast.FunctionDef) and node.name == "__getattr__":
                yield f"{file}:{node.lineno} __getattr__"
            elif (
                isinstance(node, ast.Attribute)
                and node.attr == "__class__"
                and isinstance(node.ctx, ast.Store)
            ):
                yield f"{file}:{node.lineno} __class__ is replaced"
        for function in _public_functions(tree):
            keywords = function.args.kwarg
            if keywords is not None and _is_any(keywords.annotation):
                yield f"{file}:{function.lineno} **{keywords.arg}: Any of {function.name}"


def _public_functions(tree: ast.Module) -> Iterator[ast.FunctionDef]:
    """Yield public functions of a module and public methods of its classes."""
    for node in tree.body:
        members = node.body if isinstance(node, ast.ClassDef) else [node]
        for member in members:
            if isinstance(member, ast.FunctionDef) and not member.name.startswith("_"):
                yield member


def _is_any(annotation: ast.expr | None) -> bool:
    return isinstance(annotation, ast.Name) and annotation.id == "Any"


def repeated_names(path: Path) -> dict[str, list[str]]:
    """Return public classes and functions of modules that have a name in common, by name.

    Functions that each robot has for its training task have one meaning.
    """
    places: dict[str, list[str]] = {}
    for file in python_files(path):
        for node in ast.parse(file.read_text(encoding="utf-8")).body:
            if not isinstance(node, ast.ClassDef | ast.FunctionDef) or node.name.startswith("_"):
                continue
            if node.name not in TASK_FUNCTIONS:
                places.setdefault(node.name, []).append(f"{file}:{node.lineno}")
    return {name: found_at for name, found_at in places.items() if len(found_at) > 1}


def large_dataclasses(path: Path) -> dict[str, int]:
    """Return the number of fields of each dataclass that has more than `MAX_FIELDS`."""
    sizes = {}
    for file in python_files(path):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                decorators = " ".join(ast.unparse(item) for item in node.decorator_list)
                fields = sum(isinstance(item, ast.AnnAssign) for item in node.body)
                is_exempt = node.name in EXEMPT_DATACLASSES
                if "dataclass" in decorators and fields > MAX_FIELDS and not is_exempt:
                    sizes[f"{file}:{node.name}"] = fields
    return sizes


def main() -> None:
    """Print a row for each path."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("paths", type=Path, nargs="*", default=[Path("src"), Path("tests")])
    arguments = parser.parse_args()
    print(f"{'per 1,000 lines of code':40}" + "".join(f"{name:>25}" for name in BARS))
    for path in arguments.paths:
        total = count(path)
        cells = "".join(f"{rate:25.1f}" for rate in total.rates().values())
        print(f"{path!s:40}{cells}   vague names {total.vague_percent():.2f} %")
    cells = "".join(f"{bar:25.1f}" for bar in BARS.values())
    print(f"{'bar':40}{cells}   vague names {VAGUE_NAMES_BAR:.2f} %")
    for path in arguments.paths:
        if "tests" in path.parts:
            continue
        for place in introspection(path):
            print(place)
        for name, places in repeated_names(path).items():
            print(f"{name}: {', '.join(places)}")
        for name, fields in large_dataclasses(path).items():
            print(f"{name}: {fields} fields")


if __name__ == "__main__":
    sys.exit(main())
