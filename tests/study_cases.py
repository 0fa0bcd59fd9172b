"""Tasks and small studies for tests of what runs many of them."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import yaml

from pronk.jump.study.schedule import StudyProgress, TaskStatus, run_tasks
from pronk.jump.study.tasks import StudyTask

POLICIES = Path(__file__).parents[1] / "policies"
GAINS = POLICIES / "gains.yaml"


def export_task(name: str, gains: str = "inputs/gains.yaml", **changes: Any) -> StudyTask:
    """Return a task of a second: `pronk export`, which fails if its gains cannot be read."""
    folder = f"work/{name}"
    words = ("export", gains, "--to", "mjlab", "--out", f"{folder}/actuators.py")
    fields = {
        "name": name,
        "kind": "trial",
        "folder": folder,
        "command": words,
        "settings": {"to": "mjlab"},
        "inputs": (gains,),
        "outputs": (f"{folder}/actuators.py",),
        **changes,
    }
    return StudyTask(**fields)


def study_root(tmp_path: Path) -> Path:
    """Return the folder of a study with good gains and bad ones among its inputs."""
    root = tmp_path / "study"
    (root / "inputs").mkdir(parents=True)
    shutil.copyfile(GAINS, root / "inputs" / "gains.yaml")
    (root / "inputs" / "bad.yaml").write_text("schema: none\n")
    return root


def finished(tasks: list[StudyTask], executor: Any, root: Path) -> dict[str, TaskStatus]:
    """Run tasks to their end; return the last status of each."""
    return dict(run_tasks(tasks, executor, root, report=lambda progress: None))


class Watched:
    """Keeps what was reported of a study while it ran."""

    def __init__(self) -> None:
        self.most_running = 0
        self.last: StudyProgress | None = None

    def __call__(self, progress: StudyProgress) -> None:
        self.most_running = max(self.most_running, progress.count("running"))
        self.last = progress


def write_study(path: Path, **sections: Any) -> Path:
    """Write the file of a study of one command and one jump."""
    body = {
        "schema": "pronk/study/1",
        "title": "A small study",
        "trial": {"commands": ["1,0"], "jumps": 1},
        **sections,
    }
    path.write_text(yaml.safe_dump(body, sort_keys=False))
    return path


def cell_files(root: Path) -> dict[str, bytes]:
    """Return the jumps of all trials of a study, by the path of their file."""
    cells = {}
    for path in sorted((root / "trials").rglob("cells/*.json")):
        cells[path.relative_to(root).as_posix()] = path.read_bytes()
    return cells
