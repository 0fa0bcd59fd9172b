"""An MJCF or URDF as MuJoCo compiles it, with its actuators, and what of it a robot needs."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import mujoco
import numpy as np

from pronk.errors import RobotError
from pronk.robots.urdf import PlainUrdf, plain_urdf

MAX_BYTES = 64_000_000
"""Largest file of a model; humanoids with all their parts have some 1 MB."""
MAX_ELEMENTS = 20_000
"""Largest number of elements of a model with its replicates; a fruit fly with all its parts has
2,000."""
MAX_USER_NUMBERS = 100_000
"""Largest number of user data and keyframes that a model reserves."""
USER_NUMBERS = ("nuser", "nkey")
"""Beginnings of the attributes that reserve them."""
MAX_DEPTH = 400
"""Deepest nesting of elements; MuJoCo's reader calls itself for each level."""
MAX_SAMPLES = 100_000_000
"""Largest number of pixels of a texture, points of a height field, or parts of a flexible body."""
SMALLEST_MASS = 1e-4
"""Mass of a link of a URDF that moves and has none [kg]."""
SMALLEST_INERTIA = 1e-8
"""Moment of inertia of such a link, as of a ball of 0.1 g and 16 mm [kg m^2]."""
WATER = 1000.0
"""Density of a geom that states neither mass nor density, as MuJoCo assumes it [kg/m^3]."""
TURN_READ_AS_DEGREES = math.radians(2.0 * math.pi)
"""Angle that a whole turn in rad is where its number is read in degrees [rad]."""
SIZES = ("count", "width", "height", "nrow", "ncol", "gridlayout", "nsample", "num", "dim")
"""Attributes whose product is the number of samples of an element."""
FOLDERS = ("meshdir", "texturedir", "assetdir")
"""Attributes that name the folder of files."""
COMMENT = re.compile("<!--.*?-->", re.DOTALL)
"""A comment of XML."""
TAG = re.compile(r"<(/?)([A-Za-z_][\w:.-]*)((?:[^<>\"']|\"[^\"]*\"|'[^']*')*?)(/?)>")
"""A tag of XML: whether it closes, its name, its attributes, whether it is empty."""
ATTRIBUTE = re.compile(r"([\w:.-]+)\s*=\s*[\"']([^\"']*)[\"']")
"""An attribute of XML and its value."""
MUJOCO_ERRORS = (
    ValueError,
    TypeError,
    RuntimeError,
    MemoryError,
    OSError,
    mujoco.FatalError,
    mujoco.UnexpectedError,
)
"""What MuJoCo raises for files that it cannot read or compile."""


@dataclass(frozen=True, kw_only=True)
class SourceModel:
    """A model as its file has it."""

    path: Path
    """The file."""
    model: mujoco.MjModel = field(repr=False)
    """The compiled model, with its actuators and keyframes."""
    joint_names: tuple[str, ...]
    """A name for each joint: its own, or that of its body and a number where it has none."""
    body_names: tuple[str, ...]
    """A name for each body: its own, or a number where it has none."""
    speed_limits: Mapping[str, float] = field(default_factory=dict)
    """Joint to the speed limit that a URDF states [rad/s]."""
    mimics: Mapping[str, str] = field(default_factory=dict)
    """Joint to the joint that it follows."""
    mimic_ratios: Mapping[str, float] = field(default_factory=dict)
    """Joint to how far it moves for each radian of the joint that it follows."""
    notes: tuple[str, ...] = ()
    """Sentences on what was left out or replaced."""
    is_urdf: bool = False
    """Whether the file is a URDF."""

    @property
    def hinges(self) -> tuple[int, ...]:
        """Indices of the hinge joints."""
        is_hinge = self.model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE
        return tuple(int(index) for index in np.flatnonzero(is_hinge))

    def has_mass(self, joint: int) -> bool:
        """Return whether a joint carries more than links without mass."""
        if not self.is_urdf:
            return True
        body = self.model.jnt_bodyid[joint]
        subtree = [body]
        for other in range(body + 1, self.model.nbody):
            if self.model.body_parentid[other] in subtree:
                subtree.append(other)
        mass = float(self.model.body_subtreemass[body])
        return mass > 1.01 * SMALLEST_MASS * len(subtree)

    @property
    def base_joint(self) -> int:
        """Index of the free joint of the body with most hinges behind it; -1 if none has any."""
        model = self.model
        best = -1
        largest_count = 0
        for index in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE):
            root = model.body_rootid[model.jnt_bodyid[index]]
            count = 0
            for hinge in self.hinges:
                if model.body_rootid[model.jnt_bodyid[hinge]] == root:
                    count += 1
            if count > largest_count:
                best = int(index)
                largest_count = count
        return best

    def plain_text(self) -> str:
        """Return the text of an MJCF that has nothing but what a robot needs; else nothing."""
        model = self.model
        extras = (model.nu, model.nmesh, model.nsensor, model.nkey, model.ntendon, model.neq)
        more_extras = (model.ntuple, model.ncam, model.nmat, model.ntex, model.nskin, model.nhfield)
        if self.is_urdf or any(extras) or any(more_extras) or model.npair or model.nflex:
            return ""
        unnamed = [index for index in range(model.njnt) if not model.joint(index).name]
        unnamed_bodies = [index for index in range(model.nbody) if not model.body(index).name]
        if unnamed or unnamed_bodies or model.nplugin:
            return ""
        try:
            text = self.path.read_text(encoding="utf-8")
        except UnicodeDecodeError as error:
            raise RobotError(
                f"{self.path}: byte {error.start} is not UTF-8; save the model as UTF-8 text."
            ) from None
        spec = mujoco.MjSpec.from_string(text) if "<include" not in text else None
        if spec is None or spec.compiler.degree or spec.compiler.fusestatic or spec.frames:
            return ""
        if any(light.targetbody for light in spec.lights):
            return ""
        return text


def read_source(path: Path) -> SourceModel:
    """Read and compile an MJCF or URDF, once for each time of its last modification.

    Args:
        path: File of the model.

    Raises:
        RobotError: MuJoCo cannot read or compile it; the message has MuJoCo's reason.
    """
    try:
        modified_ns = path.stat().st_mtime_ns
    except OSError:
        raise RobotError(f"{path}: no such file.") from None
    return _read_source(path, modified_ns)


@lru_cache(maxsize=32)
def _read_source(path: Path, _modified_ns: int) -> SourceModel:
    """Read and compile a model; see `read_source`."""
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise RobotError(f"{path}: has {size:,} bytes; expected at most {MAX_BYTES:,}.")
    try:
        if _is_urdf(path):
            return _compiled_urdf(path)
        _check_size(path)
        spec = mujoco.MjSpec.from_file(str(path))
        model, notes = _compiled_mjcf(spec)
    except MUJOCO_ERRORS as error:
        reason = " ".join(str(error).split()).rstrip(".")
        raise RobotError(f"{path}: not a model that MuJoCo can read ({reason}).") from None
    notes = (*notes, *_degree_notes(spec, model), *_density_notes(spec, model))
    return _source(path, model, None, notes)


def _degree_notes(spec: mujoco.MjSpec, model: mujoco.MjModel) -> tuple[str, ...]:
    """Say so where the ranges of an MJCF in degrees are numbers that look like angles in rad."""
    is_limited_hinge = (model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE) & (model.jnt_limited == 1)
    ranges = model.jnt_range[is_limited_hinge]
    if not spec.compiler.degree or not len(ranges) or np.abs(ranges).max() > TURN_READ_AS_DEGREES:
        return ()
    return (
        f"no hinge has a range beyond {math.degrees(TURN_READ_AS_DEGREES):.2g} degrees: MuJoCo "
        "reads an MJCF in degrees, and these look like rad; if they are, write "
        '<compiler angle="radian"/> into it',
    )


def _density_notes(spec: mujoco.MjSpec, model: mujoco.MjModel) -> tuple[str, ...]:
    """Name the bodies of an MJCF whose mass is their volume times a density that is assumed."""
    from_geoms = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    assumed = []
    for body in spec.bodies:
        index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, body.name)
        moves = index > 0 and model.body_weldid[index] != 0
        states_inertia = body.explicitinertial and spec.compiler.inertiafromgeom != from_geoms
        if not moves or states_inertia or not model.body_mass[index] > 0.0:
            continue
        for geom in body.geoms:
            if math.isnan(geom.mass) and geom.density == WATER:
                assumed.append(f"{body.name} {model.body_mass[index]:.3g} kg")
                break
    if not assumed:
        return ()
    return (
        "the model states no mass of some bodies, so that MuJoCo took the volume of their geoms at "
        f"{WATER:g} kg/m^3 ({', '.join(assumed)}): give them an <inertial>, or their geoms a mass",
    )


def _is_urdf(path: Path) -> bool:
    """Return whether a file is a URDF, by its ending or its outermost element."""
    if path.suffix in (".urdf", ".xacro"):
        return True
    text = COMMENT.sub("", path.read_text(encoding="utf-8", errors="replace"))
    first = TAG.search(text)
    return first is not None and first.group(2) == "robot"


def _source(
    path: Path, model: mujoco.MjModel, urdf: PlainUrdf | None, notes: tuple[str, ...]
) -> SourceModel:
    """Name the bodies and joints of a compiled model."""
    body_names = ["world"]
    for index in range(1, model.nbody):
        body_names.append(_unique(model.body(index).name or f"body_{index}", body_names))
    joint_names: list[str] = []
    for index in range(model.njnt):
        name = model.joint(index).name
        if not name:
            name = f"{body_names[model.jnt_bodyid[index]]}_joint"
        joint_names.append(_unique(name, joint_names))
    return SourceModel(
        path=path,
        model=model,
        joint_names=tuple(joint_names),
        body_names=tuple(body_names),
        speed_limits=urdf.speed_limits if urdf else {},
        mimics=urdf.mimics if urdf else {},
        mimic_ratios=urdf.mimic_ratios if urdf else {},
        notes=notes,
        is_urdf=urdf is not None,
    )


def _unique(name: str, names: list[str]) -> str:
    """Return a name that is not among some names, with a number behind it if need be."""
    number = 2
    unique = name
    while unique in names:
        unique = f"{name}_{number}"
        number += 1
    return unique


def _compiled_urdf(path: Path) -> SourceModel:
    """Compile a URDF: as it is, else with what MuJoCo offers for masses that no body has."""
    urdf = plain_urdf(path)
    notes = list(urdf.notes)
    try:
        return _source(path, _compiled(mujoco.MjSpec.from_string(urdf.text)), urdf, tuple(notes))
    except MUJOCO_ERRORS as error:
        first_error = error
    urdf = plain_urdf(path, with_meshes=False)
    notes = list(urdf.notes)
    spec = mujoco.MjSpec.from_string(urdf.text)
    for _attempt in range(3):
        try:
            return _source(path, _compiled(spec), urdf, tuple(notes))
        except MUJOCO_ERRORS as error:
            reason = str(error)
        # A specification that did not compile is read anew.
        balances = spec.compiler.balanceinertia or "balanceinertia" in reason
        bounds = spec.compiler.boundmass > 0.0 or "mjMINVAL" in reason
        spec = mujoco.MjSpec.from_string(urdf.text)
        spec.compiler.balanceinertia = balances
        if "balanceinertia" in reason:
            notes.append(
                "the principal moments of inertia of a link break A + B >= C, so that MuJoCo took "
                f"their mean ({' '.join(reason.split())}); correct it in the URDF"
            )
        if bounds:
            spec.compiler.boundmass = SMALLEST_MASS
            spec.compiler.boundinertia = SMALLEST_INERTIA
        if "mjMINVAL" in reason:
            notes.append(
                f"links that move have no mass, so that they got {SMALLEST_MASS:g} kg and "
                f"{SMALLEST_INERTIA:g} kg m^2; give them an inertial in the URDF"
            )
    raise first_error


def _compiled(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile a model with every body by itself, and without the lengths of muscles."""
    spec.compiler.fusestatic = False
    spec.compiler.LRopt.mode = mujoco.mjtLRMode.mjLRMODE_NONE
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of parts that a robot on the bench does not have
        return spec.compile()


def _compiled_mjcf(spec: mujoco.MjSpec) -> tuple[mujoco.MjModel, tuple[str, ...]]:
    """Compile an MJCF; where files of it are missing, without textures, materials and meshes.

    Bodies whose mass comes from meshes that are missing still make it fail.
    """
    try:
        return _compiled(spec.copy()), ()
    except MUJOCO_ERRORS as error:
        first_error = error
    for geom in list(spec.geoms):
        geom.material = ""
        if geom.type == mujoco.mjtGeom.mjGEOM_MESH:
            if not geom.parent.explicitinertial:
                raise first_error
            spec.delete(geom)
        elif geom.meshname:
            raise first_error
    for site in spec.sites:
        site.material = ""
    for tendon in spec.tendons:
        tendon.material = ""
    for elements in (spec.pairs, spec.skins, spec.meshes, spec.materials, spec.textures):
        for element in list(elements):
            spec.delete(element)
    try:
        model = _compiled(spec)
    except MUJOCO_ERRORS:
        raise first_error from None
    return model, ("meshes or textures that are not there were left out",)


def _check_size(path: Path) -> None:
    """Refuse an MJCF that would take MuJoCo's reader minutes, gigabytes, or its whole stack.

    Tags are found as they stand, so that XML that only MuJoCo's reader accepts is checked too.
    """
    pending = [path]
    files_of: dict[Path, list[Path]] = {}
    total = 0
    while pending:
        file = pending.pop()
        if file in files_of or not file.is_file():
            continue
        files_of[file] = []
        text = COMMENT.sub("", file.read_text(encoding="utf-8", errors="replace"))
        copies = [1]  # of the elements inside each open element
        folders = [file.parent, path.parent]
        for match in TAG.finditer(text):
            closing, name, attribute_text, empty = match.groups()
            if closing:
                if len(copies) > 1:
                    copies.pop()
                continue
            attributes = dict(ATTRIBUTE.findall(attribute_text))
            total += copies[-1]
            inside = copies[-1]
            if name == "replicate":
                inside = min(inside * int(_product(attributes.get("count", "1"))), MAX_SAMPLES)
            if not empty:
                copies.append(inside)
            if len(copies) > MAX_DEPTH:
                raise RobotError(
                    f"{file}: elements are nested over {MAX_DEPTH} deep; expected a robot."
                )
            if total > MAX_ELEMENTS or _samples(name, attributes) > MAX_SAMPLES:
                raise RobotError(
                    f"{file}: element {name} makes the model too large; expected at most "
                    f"{MAX_ELEMENTS:,} elements and {MAX_SAMPLES:,} samples of an element."
                )
            for attribute in FOLDERS:
                if attribute in attributes:
                    folders.append(path.parent / attributes[attribute])
            for folder in folders:
                target = folder / attributes.get("file", "")
                if "file" in attributes and target.exists():
                    if not target.is_file():
                        raise RobotError(f"{file}: {attributes['file']} is no file.")
                    if name in ("include", "model"):
                        files_of[file].append(target.resolve())
        files_of[file.resolve()] = files_of[file]
        pending.extend(files_of[file])
    _check_cycles(path.resolve(), files_of, (path.resolve(),))


def _samples(name: str, attributes: Mapping[str, str]) -> float:
    """Return how many samples an element asks for: pixels, points, parts or user numbers."""
    samples = 1.0
    if name == "size":
        for attribute, value in attributes.items():
            if attribute.startswith(USER_NUMBERS) and _product(value) > MAX_USER_NUMBERS:
                samples = math.inf
    elif name != "replicate":
        for attribute in SIZES:
            samples *= _product(attributes.get(attribute, "1"))
        # A mesh that is computed has as many points as the square of its resolution.
        for word in attributes.get("params", "").split():
            samples = max(samples, _product(word) ** 2)
    return samples


def _check_cycles(file: Path, files_of: Mapping[Path, list[Path]], above: tuple[Path, ...]) -> None:
    """Refuse a file that includes or attaches itself, also through others."""
    for target in files_of.get(file, ()):
        if target in above or len(above) > MAX_DEPTH:
            raise RobotError(f"{file}: includes or attaches {target.name}, which leads back to it.")
        _check_cycles(target, files_of, (*above, target))


def _product(text: str) -> float:
    """Return the product of the numbers of an attribute, at least 1; 1 where it holds none."""
    product = 1.0
    for word in text.split():
        try:
            product *= float(word)
        except ValueError:
            return 1.0
    if not product >= 1.0:
        return 1.0
    return min(product, float(MAX_SAMPLES) + 1.0)
