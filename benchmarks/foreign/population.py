"""Robots of public packages: which count, which are drawn, and a folder with their files.

The population is every URDF and MJCF in the data files of `PACKAGES` that is a robot or another
mechanism with drives, by these rules:

1. A URDF has at least one revolute or continuous joint that mimics no other and has an effort above
   0, and its links have masses. An MJCF compiles in MuJoCo by itself, and at least one of its
   hinges is moved by an actuator whose transmission is that joint, or limits the torque of its
   actuators (`actuatorfrcrange`). So objects, tables, cloths,
   parts that other files include and toys without drives are none.
2. Files below a folder whose name has `test` in it belong to tests of their package.
3. Of variants of one robot only one counts. Two models are variants if they share half or more of
   the pairs (hinge, mass of its body to three digits) of the one that has fewer. The model with
   the most hinges counts, of these the one whose path comes first.

The models are sorted by package and path. A draw takes a number of them without replacement, and of
each the hinge to excite, uniformly of its driven ones.
"""

from __future__ import annotations

import importlib.util
import json
import shutil
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from pronk.errors import PronkError

PACKAGES = {
    "pybullet": "pybullet_data",
    "example-robot-data": "cmeel.prefix/share/example-robot-data",
    "robosuite": "robosuite",
    "dm-control": "dm_control",
    "gymnasium-robotics": "gymnasium_robotics",
    "mjlab": "mjlab",
}
"""Folder of the data files of each package, below the folder that packages are installed in."""
DRAWN = "drawn.json"
"""File of a packed folder with what was drawn."""
VARIANT_SHARE = 0.5
"""Share of common pairs from which on two models are variants of one robot."""
MAX_BYTES = 30_000_000
"""Files larger than this are no models of robots [bytes]."""


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """A model of the population."""

    package: str
    path: str
    """Of the model, below the folder that packages are installed in."""
    kind: str
    """urdf or mjcf."""
    driven: tuple[str, ...]
    """Names of the hinges that have a drive."""
    pairs: tuple[tuple[str, str], ...]
    """Each hinge with the mass of its body."""

    @property
    def label(self) -> str:
        """Name in tables."""
        parts = Path(self.path).parts
        return f"{self.package}/{'/'.join(parts[-2:])}"


def packages_folder(stated: Path | None) -> Path:
    """Return the folder that the packages are installed in.

    Raises:
        PronkError: None of the packages is there.
    """
    folders = []
    if stated is not None:
        folders.append(stated)
    else:
        for name in ("mjlab", "robosuite", "pybullet_data"):
            found = importlib.util.find_spec(name)
            if found is not None and found.origin:
                folders.append(Path(found.origin).parents[1])
    for folder in folders:
        if any((folder / data).is_dir() for data in PACKAGES.values()):
            return folder
    raise PronkError(
        f"--packages {stated}: none of {', '.join(PACKAGES)} is there; expected the folder that "
        "they are installed or unpacked in."
    )


def population(folder: Path) -> list[Candidate]:
    """Return the models that count, by the rules of this module, sorted."""
    candidates = []
    for package, data in PACKAGES.items():
        root = folder / data
        files = [*root.rglob("*.urdf"), *root.rglob("*.xml")]
        for path in sorted(files):
            inner = path.relative_to(folder)
            if any("test" in part.lower() for part in inner.parts[:-1]):
                continue
            if path.stat().st_size > MAX_BYTES:
                continue
            reader = _urdf_joints if path.suffix == ".urdf" else _mjcf_joints
            driven, pairs = reader(path)
            if driven:
                candidates.append(
                    Candidate(
                        package=package,
                        path=inner.as_posix(),
                        kind="urdf" if path.suffix == ".urdf" else "mjcf",
                        driven=driven,
                        pairs=pairs,
                    )
                )
    return without_variants(candidates)


def without_variants(candidates: list[Candidate]) -> list[Candidate]:
    """Return one model of each robot (rule 3), sorted by package and path."""
    kept: list[Candidate] = []
    order = sorted(candidates, key=lambda each: (-len(each.pairs), each.package, each.path))
    for candidate in order:
        pairs = set(candidate.pairs)
        variant = False
        for other in kept:
            shared = len(pairs & set(other.pairs))
            fewer = min(len(pairs), len(set(other.pairs)))
            variant = variant or shared >= VARIANT_SHARE * fewer
        if not variant:
            kept.append(candidate)
    return sorted(kept, key=lambda each: (each.package, each.path))


def draw(candidates: list[Candidate], seed: int, count: int) -> list[tuple[Candidate, str]]:
    """Draw models and of each the hinge to excite.

    Raises:
        PronkError: There are fewer models than that.
    """
    if not 1 <= count <= len(candidates):
        raise PronkError(f"--count {count}; expected 1 to {len(candidates)}, the population.")
    rng = np.random.default_rng(seed)
    chosen = sorted(rng.choice(len(candidates), count, replace=False).tolist())
    drawn = []
    for index in chosen:
        candidate = candidates[index]
        drawn.append((candidate, candidate.driven[int(rng.integers(len(candidate.driven)))]))
    return drawn


def _parsed(path: Path) -> ElementTree.Element | None:
    try:
        return ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, OSError, UnicodeDecodeError):
        return None


def _urdf_joints(path: Path) -> tuple[tuple[str, ...], tuple[tuple[str, str], ...]]:
    """Return the driven hinges of a URDF, and each hinge with the mass of its link."""
    root = _parsed(path)
    if root is None or root.tag != "robot":
        return (), ()
    masses = {}
    for link in root.iter("link"):
        mass = link.find("inertial/mass")
        masses[link.get("name")] = float(mass.get("value", 0.0)) if mass is not None else 0.0
    driven = []
    pairs = []
    for joint in root.findall("joint"):
        if joint.get("type") not in ("revolute", "continuous"):
            continue
        name = joint.get("name", "")
        child = joint.find("child")
        mass_kg = masses.get(child.get("link"), 0.0) if child is not None else 0.0
        pairs.append((name, f"{mass_kg:.3g}"))
        limit = joint.find("limit")
        effort = float(limit.get("effort", 0.0)) if limit is not None else 0.0
        if effort > 0.0 and joint.find("mimic") is None:
            driven.append(name)
    if not any(masses.values()):
        return (), ()
    return tuple(driven), tuple(pairs)


def _mjcf_joints(path: Path) -> tuple[tuple[str, ...], tuple[tuple[str, str], ...]]:
    """Return the driven hinges of an MJCF, and each hinge with the mass of its body."""
    root = _parsed(path)
    if root is None or root.tag != "mujoco":
        return (), ()
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError:
        return (), ()
    driven = []
    pairs = []
    hinges = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE)
    for hinge in hinges:
        name = model.joint(int(hinge)).name
        mass_kg = float(model.body_mass[model.jnt_bodyid[hinge]])
        pairs.append((name, f"{mass_kg:.3g}"))
        limited = bool(model.jnt_actfrclimited[hinge])
        if name and (limited or actuators_of(model, int(hinge))):
            driven.append(name)
    return tuple(driven), tuple(pairs)


def actuators_of(model: mujoco.MjModel, joint: int) -> list[int]:
    """Return the actuators of a compiled model whose transmission is a joint."""
    transmissions = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
    found = []
    for index in range(model.nu):
        moves = model.actuator_trntype[index] in transmissions
        if moves and model.actuator_trnid[index, 0] == joint:
            found.append(index)
    return found


# ---- the files of a model ----


def files_of(path: Path) -> Iterator[Path]:
    """Yield a model and every file that it refers to and that is there."""
    yield path
    root = _parsed(path)
    if root is None:
        return
    folders = [path.parent]
    for compiler in root.iter("compiler"):
        for attribute in ("meshdir", "texturedir", "assetdir"):
            if compiler.get(attribute):
                folders.append(path.parent / str(compiler.get(attribute)))
    for element in root.iter():
        name = element.get("file") or element.get("filename")
        if not name:
            continue
        for folder in folders:
            target = folder / name
            if target.is_file():
                if element.tag == "include":
                    yield from files_of(target)
                else:
                    yield target
                break


def copy_model(packages: Path, model: str, target: Path) -> Path:
    """Copy a model and the files that it refers to; return the path of the copy.

    Files keep their places to one another: those of an include are looked for from the model that
    includes it, as MuJoCo does.
    """
    source = (packages / model).resolve()
    top = packages.resolve()
    for file in set(_all_files(source)):
        inner = file.resolve().relative_to(top)
        (target / inner).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, target / inner)
    return target / model


def pack(packages: Path, drawn: list[tuple[Candidate, str]], target: Path) -> None:
    """Copy the files of drawn models into a folder that takes the place of the packages."""
    for candidate, _ in drawn:
        copy_model(packages, candidate.path, target)
    (target / DRAWN).write_text(json.dumps(to_record(drawn), indent=1), encoding="utf-8")


def drawn_robots(
    packages: Path | None, seed: int, count: int
) -> tuple[Path, list[tuple[Candidate, str]]]:
    """Return the folder of the packages, or a packed one, and the models drawn of it.

    Raises:
        PronkError: There are no packages, or fewer models than that.
    """
    if packages is not None and (packages / DRAWN).exists():
        drawn = from_record(json.loads((packages / DRAWN).read_text(encoding="utf-8")))
        return packages, drawn[:count]
    folder = packages_folder(packages)
    return folder, draw(population(folder), seed, count)


def _all_files(model: Path) -> list[Path]:
    """Return the files of a model; of included files the assets beside the model too."""
    files = list(files_of(model))
    names = set()
    folders = {model.parent}
    for file in files:
        root = _parsed(file) if file.suffix in (".xml", ".urdf") else None
        if root is None:
            continue
        for compiler in root.iter("compiler"):
            for attribute in ("meshdir", "texturedir", "assetdir"):
                if compiler.get(attribute):
                    folders.add(model.parent / str(compiler.get(attribute)))
        for element in root.iter():
            name = element.get("file") or element.get("filename")
            if name:
                names.add(name)
    for folder in folders:
        for name in names:
            if (folder / name).is_file():
                files.append(folder / name)
    return files


def to_record(drawn: list[tuple[Candidate, str]]) -> list[dict[str, Any]]:
    """Return drawn models as JSON."""
    records = []
    for candidate, joint in drawn:
        records.append({"candidate": asdict(candidate), "joint": joint})
    return records


def from_record(records: list[dict[str, Any]]) -> list[tuple[Candidate, str]]:
    """Return what `to_record` has written."""
    drawn = []
    for record in records:
        fields = record["candidate"]
        pairs = tuple((str(name), str(mass)) for name, mass in fields["pairs"])
        candidate = Candidate(
            package=fields["package"],
            path=fields["path"],
            kind=fields["kind"],
            driven=tuple(fields["driven"]),
            pairs=pairs,
        )
        drawn.append((candidate, str(record["joint"])))
    return drawn
