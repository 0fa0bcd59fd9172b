"""The files of a robot among the inputs of a study, under a name with their content's hash.

Tasks read the copy, so that their keys follow what the files say and not where they lie, and a copy
of the folder of a study, or a node of a cluster, has the robot as well.
"""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass
from pathlib import Path

from pronk.errors import RobotError
from pronk.jump.study.tasks import INPUTS, store_file
from pronk.robots import ROBOT_NAMES

TASK_FILES = ("env_cfgs.py", "rl_cfg.py")
"""Files beside a robot.yaml that make its training task; docs/train-your-robot.md."""


@dataclass(frozen=True, kw_only=True)
class RobotInput:
    """A robot as the commands of tasks name it, with its files."""

    name: str
    """A shipped name, or the robot.yaml or model in the folder of the study."""
    files: tuple[str, ...] = ()
    """Files of the copy, relative to the folder of the study; none of a shipped robot."""


def robot_input(root: Path, robot: str, *, is_trained: bool = False) -> RobotInput:
    """Copy the files of a robot to the inputs of a study; a shipped robot needs none.

    Args:
        root: Folder of the study.
        robot: A robot, as of `load_robot`.
        is_trained: Copy the files of its training task as well.

    Raises:
        RobotError: There is no such robot, or a file of it cannot be read.
    """
    if robot in ROBOT_NAMES:
        return RobotInput(name=robot)
    # Not at the top: it imports MuJoCo, which the help of a command does not need.
    from pronk.robots.robot_files import robot_files

    files = list(robot_files(robot))
    first = files[0]
    if is_trained:
        for name in TASK_FILES:
            if (first.parent / name).is_file():
                files.append(first.parent / name)
    # Their places relative to one another are kept: the robot.yaml names its model by them.
    base = Path(os.path.commonpath([file.parent for file in files]))
    contents = {}
    hashes = {}
    for file in files:
        relative = file.relative_to(base).as_posix()
        try:
            contents[relative] = file.read_bytes()
        except OSError as error:
            reason = (error.strerror or "cannot be read").lower()
            raise RobotError(f"{file}: {reason}.") from None
        hashes[relative] = hashlib.sha256(contents[relative]).hexdigest()
    text = json.dumps(hashes, sort_keys=True)
    folder = f"{INPUTS}/robot-{hashlib.sha256(text.encode()).hexdigest()[:12]}"
    for relative, content in contents.items():
        store_file(root / folder / relative, content)
    return RobotInput(
        name=f"{folder}/{first.relative_to(base).as_posix()}",
        files=tuple(f"{folder}/{relative}" for relative in sorted(contents)),
    )
