"""The files that a robot is read from, and a hash of what they say."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from pathlib import Path

import msgspec

from pronk.errors import RobotError
from pronk.robots import MODEL_SUFFIXES, ROBOT_NAMES, robot_file_path
from pronk.robots.load import Model, read_robot_file
from pronk.robots.robot import RobotSpec
from pronk.robots.source_model import ATTRIBUTE, COMMENT, FOLDERS, TAG
from pronk.robots.urdf import mesh_path


def robot_files(robot: str | Path) -> tuple[Path, ...]:
    """Return the files that a robot is read from, with all that its model names.

    Args:
        robot: A robot, as of `load_robot`.

    Returns:
        First its robot.yaml, or its model where it has none; then the model, and the models,
        meshes, textures and height fields that it names and that are there.

    Raises:
        RobotError: There is no such robot, or its robot.yaml cannot be read.
    """
    path = robot_file_path(robot).resolve()
    if path.suffix in MODEL_SUFFIXES:
        return model_files(path)
    file = read_robot_file(path)
    return (path, *model_files(_whole(path.parent / file.model)))


def model_files(path: Path) -> tuple[Path, ...]:
    """Return an MJCF or URDF, and the files that it names and that are there.

    A name is looked for in every folder that any of the models names, since MuJoCo's rules for
    included models depend on their order. So there may be a file more than MuJoCo reads.

    Args:
        path: File of the model.

    Raises:
        RobotError: The model is missing.
    """
    models = [path]
    named_files = []
    meshes_of_urdf = []
    folders = [""]
    for model in models:  # which grows by the models that it includes
        for element, attributes in _elements(model):
            for attribute, value in attributes.items():
                if attribute in FOLDERS:
                    folders.append(value)
                if attribute == "filename":
                    meshes_of_urdf.append(value)
                    continue
                # `file`, and `fileup` and so on of the sides of a texture.
                if not attribute.startswith("file"):
                    continue
                named_files.append((model, value))
                if element in ("include", "model"):
                    for included in _candidates(path, model, [""], value):
                        if included not in models:
                            models.append(included)
    files = dict.fromkeys(models)
    for model, value in named_files:
        for candidate in _candidates(path, model, folders, value):
            files[candidate] = None
    for value in meshes_of_urdf:
        mesh = mesh_path(value, path)
        if mesh is not None:
            files[mesh] = None
    return tuple(files)


def _elements(model: Path) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield the name and the attributes of each element of a model."""
    try:
        text = model.read_text(encoding="utf-8", errors="replace")
    except OSError:
        raise RobotError(f"{model}: no such file.") from None
    for match in TAG.finditer(COMMENT.sub("", text)):
        _, element, attribute_text, _ = match.groups()
        yield element, dict(ATTRIBUTE.findall(attribute_text))


def _candidates(path: Path, model: Path, folders: list[str], value: str) -> list[Path]:
    """Return the files that a name in a model may stand for.

    Args:
        path: File of the outermost model.
        model: File that has the name.
        folders: Folders that the models name.
        value: The name.
    """
    files = []
    for parent in (path.parent, model.parent):
        for folder in folders:
            # MuJoCo drops the folder of a name where the option `strippath` says so.
            for name in (value, Path(value).name):
                candidate = _whole(parent / folder / name)
                if name and candidate.is_file() and candidate not in files:
                    files.append(candidate)
    return files


def _whole(path: Path) -> Path:
    """Return a path from the root without `..`; links stay, since names are relative to them."""
    return Path(os.path.abspath(path))  # noqa: PTH100


def robot_key(robot: RobotSpec) -> str:
    """Return what stands for a robot in keys: a shipped name, or the hash of what its files say.

    The hash is of the robot as it was read, with its model, and not of where its files lie. A
    shipped robot changes with the version of pronk alone.
    """
    if robot.source in ROBOT_NAMES:
        return robot.name
    if isinstance(robot.build_spec, Model):
        model_text = robot.build_spec.xml
    else:
        model_text = robot.build_spec().to_xml()
    content = {
        "name": robot.name,
        "joints": robot.joints,
        "model": model_text,
        "base_body": robot.base_body,
        "held_joints": robot.held_joints,
        "legs": robot.legs,
        "policy_rate_hz": robot.policy_rate_hz,
        "timestep_s": robot.timestep_s,
        "decimation": robot.decimation,
        "law": robot.law,
        "limits": robot.limits,
    }
    return hashlib.sha256(msgspec.json.encode(content, order="sorted")).hexdigest()
