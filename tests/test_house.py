"""The house: which room may import which, and what must stay hidden."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import pronk

ROOT = Path(pronk.__file__).parent
ROOMS = (
    "robots",
    "drive",
    "jumps",
    "hardware",
    "sweep",
    "response",
    "match",
    "policy",
    "train",
    "trial",
    "deploy",
    "report",
    "bench",
    "commands",
    "cli",
)
SHARED = {"errors", "files", "bars", "opengl"}  # leaves that every room may use
# The virtual robot's truth is hidden from what is judged by it.
BLIND = ("match", "train", "response")


def room_of(path: Path) -> str:
    return path.relative_to(ROOT).parts[0].removesuffix(".py")


def imports(path: Path) -> set[str]:
    """Rooms of pronk that a file imports, anywhere in it."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import; write pronk.room.module"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        for name in names:
            parts = name.split(".")
            if parts[0] == "pronk" and len(parts) > 1 and parts[1] != "__version__":
                found.add(parts[1])
    return found


LEAVES = sorted(ROOT / f"{leaf}.py" for leaf in SHARED)
FILES = sorted(path for path in ROOT.rglob("*.py") if path not in LEAVES)


@pytest.mark.parametrize("path", LEAVES, ids=lambda p: p.name)
def test_a_leaf_imports_no_room(path: Path) -> None:
    assert imports(path) <= SHARED


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_follow_the_way_of_the_data(path: Path) -> None:
    room = room_of(path)
    if room == "__init__":
        return
    assert room in ROOMS, f"{path} is in no room of the house"
    allowed = set(ROOMS[: ROOMS.index(room) + 1]) | SHARED
    wrong = imports(path) - allowed
    assert not wrong, f"{path.relative_to(ROOT)} imports {sorted(wrong)}, which come after {room}"


@pytest.mark.parametrize("room", BLIND)
def test_no_reader_of_the_hidden_truth(room: str) -> None:
    for path in (ROOT / room).rglob("*.py"):
        assert "hardware" not in imports(path), f"{path} could read the virtual robot's truth"
        assert "truth.yaml" not in path.read_text(encoding="utf-8")


def test_matching_never_loads_the_virtual_robot() -> None:
    code = (
        "import sys, pronk.match.pipeline, pronk.match.predict, pronk.match.ranges;"
        "print([m for m in sys.modules if m.startswith('pronk.hardware')])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_core_needs_no_pytorch() -> None:
    # Walking the packages would import pronk.train itself, which begins with mjlab.
    modules = [".".join(path.relative_to(ROOT.parent).with_suffix("").parts) for path in FILES]
    core = [name for name in modules if not name.startswith(("pronk.train", "pronk.bench.train"))]
    code = (
        "import sys, importlib;"
        f"[importlib.import_module(name) for name in {core!r}];"
        "print([m for m in ('torch', 'mjlab', 'cma') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
