"""A URDF as MuJoCo can read it: links, inertias, joints and limits, without what is only drawn."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pronk.errors import RobotError

PRIMITIVES = ("box", "cylinder", "sphere")
"""Geometries of a collision that need no file."""
MESH_SUFFIXES = (".stl", ".obj", ".msh")
"""Endings of meshes that MuJoCo reads."""
INERTIA = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
"""Attributes of an inertia."""
END = b"</robot>"
"""End of a URDF; what follows is no part of it."""
BALL_RADIUS = 0.01
"""Radius of the ball in place of an inertia that is missing or that no body has [m]."""
SMALLEST_MOMENT = 1e-13
"""Smallest principal moment of inertia that MuJoCo takes for positive, with a margin [kg m^2]."""
COMPILER = {"strippath": "false", "discardvisual": "true", "fusestatic": "false"}
"""Options of MuJoCo's reader: paths as they stand, and no link merged into its parent."""


@dataclass(frozen=True, kw_only=True)
class PlainUrdf:
    """What MuJoCo gets of a URDF, and what of its joints it does not read."""

    text: str
    """The URDF without visuals, materials, cameras, plugins and meshes that are not needed."""
    speed_limits: dict[str, float]
    """Joint to the `velocity` of its limit, where it is positive and finite [rad/s, or m/s]."""
    mimics: dict[str, str]
    """Joint to the joint that it follows (`mimic`)."""
    mimic_ratios: dict[str, float]
    """Joint to how far it moves for each radian of the joint that it follows."""
    notes: tuple[str, ...]
    """Sentences on what was left out and matters."""


def plain_urdf(path: Path, *, with_meshes: bool = True) -> PlainUrdf:
    """Read a URDF and remove what a model without drives and pictures does not need.

    Links with an inertia keep the boxes, cylinders and spheres of their collisions. A link without
    one gets its mass from all its collisions, as MuJoCo does; of the meshes among them those that
    are there and that MuJoCo reads.

    Args:
        path: File of the URDF.
        with_meshes: Whether links without an inertia keep the meshes of their collisions.

    Raises:
        RobotError: The file is no URDF.
    """
    try:
        content = path.read_bytes()
        end = content.rfind(END)
        if end >= 0:
            content = content[: end + len(END)]
        root = ET.fromstring(content.lstrip())
    except ET.ParseError as error:
        raise RobotError(f"{path}: not a URDF: its XML is broken ({error}).") from None
    if root.tag != "robot":
        raise RobotError(f"{path}: not a URDF; its outermost element must be `robot`.")
    if path.suffix == ".xacro" or any("xacro" in str(element.tag) for element in root.iter()):
        raise RobotError(
            f"{path}: holds xacro macros; expand them first: `xacro FILE > robot.urdf`."
        )
    notes = []
    for element in list(root):
        if element.tag not in ("link", "joint", "mujoco"):
            root.remove(element)
    for link in root.iter("link"):
        note = _strip_link(link, path, with_meshes=with_meshes)
        if note:
            notes.append(note)
    speed_limits = {}
    mimics = {}
    mimic_ratios = {}
    for element in root.iter():
        for attribute in ("xyz", "rpy"):
            if attribute in element.attrib:
                element.set(attribute, _three_numbers(element.get(attribute, "")))
    for joint in root.findall("joint"):
        for axis in joint.findall("axis")[1:]:
            joint.remove(axis)
        name = joint.get("name", "")
        limit = joint.find("limit")
        speed = _number(limit.get("velocity") if limit is not None else None)
        if 0.0 < speed < math.inf:
            speed_limits[name] = speed
        mimic = joint.find("mimic")
        if mimic is not None:
            mimics[name] = mimic.get("joint", "")
            mimic_ratios[name] = _number(mimic.get("multiplier", "1"))
    extension = root.find("mujoco")
    if extension is None:
        extension = ET.SubElement(root, "mujoco")
    compiler = extension.find("compiler")
    if compiler is None:
        compiler = ET.SubElement(extension, "compiler")
    for name, value in COMPILER.items():
        compiler.set(name, value)
    compiler.attrib.pop("meshdir", None)
    return PlainUrdf(
        text=ET.tostring(root, encoding="unicode"),
        speed_limits=speed_limits,
        mimics=mimics,
        mimic_ratios=mimic_ratios,
        notes=tuple(notes),
    )


def _strip_link(link: ET.Element, path: Path, *, with_meshes: bool) -> str:
    """Remove what is drawn of a link, and its meshes unless its mass comes from them.

    Returns:
        A sentence on a mass that is missing; empty if there is none.
    """
    name = link.get("name", "")
    note = ""
    inertial = link.find("inertial")
    has_mass = False
    if inertial is not None:
        mass = inertial.find("mass")
        has_mass = mass is not None and _number(mass.get("value")) > 0.0
        if not has_mass:
            link.remove(inertial)
        else:
            note = _correct_inertia(inertial, name)
    meshes = 0
    missing = ""
    for element in list(link):
        if element.tag == "inertial":
            continue
        shape = None
        geometry = element.find("geometry")
        if element.tag == "collision" and geometry is not None and len(geometry):
            shape = geometry[0]
        keeps = shape is not None and shape.tag in PRIMITIVES and _has_size(shape)
        if shape is not None and shape.tag == "mesh" and not has_mass:
            mesh_file = mesh_path(shape.get("filename", ""), path)
            if mesh_file is not None and with_meshes:
                shape.set("filename", str(mesh_file))
                meshes += 1
                keeps = True
            else:
                missing = shape.get("filename", "")
        if not keeps:
            link.remove(element)
            continue
        element.attrib.pop("name", None)
        for part in list(element):
            if part.tag not in ("origin", "geometry"):
                element.remove(part)
    if meshes and not missing:
        return f"the mass of link {name} is that of its meshes at 1,000 kg/m^3; it has no inertial"
    if missing:
        return f"link {name} has no inertial, and its mesh {missing} cannot be read"
    return note


def _correct_inertia(inertial: ET.Element, name: str) -> str:
    """Give an inertia that no body has the one of a ball of the same mass.

    Returns:
        A sentence on it; empty where the inertia is possible.
    """
    mass = _number(inertial.find("mass").get("value"))  # type: ignore[union-attr]
    element = inertial.find("inertia")
    if element is None:
        element = ET.SubElement(inertial, "inertia")
    xx, yy, zz, xy, xz, yz = (_number(element.get(entry)) for entry in INERTIA)
    moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    if moments[0] > SMALLEST_MOMENT:
        return ""
    moment = 0.4 * mass * BALL_RADIUS**2
    for entry in INERTIA:
        element.set(entry, repr(moment) if entry in ("ixx", "iyy", "izz") else "0")
    return (
        f"the inertia of link {name} is not that of a body (moments {moments[0]:.3g} to "
        f"{moments[2]:.3g} kg m^2); that of a ball of {BALL_RADIUS:g} m and its mass was taken"
    )


def mesh_path(filename: str, path: Path) -> Path | None:
    """Return where a mesh of a URDF is; None if it is not there or MuJoCo cannot read it.

    `package://NAME/...` is looked for in the folders above the URDF, with and without NAME.
    """
    relative = Path(filename.removeprefix("package://").removeprefix("file://"))
    if relative.suffix.lower() not in MESH_SUFFIXES:
        return None
    without_package = Path(*relative.parts[1:]) if len(relative.parts) > 1 else relative
    for folder in path.resolve().parents:
        for candidate in (folder / relative, folder / without_package):
            if candidate.is_file():
                return candidate
    return None


def _has_size(shape: ET.Element) -> bool:
    """Return whether all sizes of a primitive are positive numbers."""
    attributes = {"box": ("size",), "cylinder": ("radius", "length"), "sphere": ("radius",)}
    for attribute in attributes[shape.tag]:
        for word in shape.get(attribute, "").split() or ["0"]:
            if not 0.0 < _number(word) < math.inf:
                return False
    return True


def _three_numbers(text: str) -> str:
    """Return the first three numbers of a vector as MuJoCo reads them; the text if it has none."""
    words = text.replace(",", " ").split()[:3]
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        return text
    return " ".join(repr(number) for number in numbers) if len(numbers) == 3 else text


def _number(text: str | None) -> float:
    """Return the number of an attribute; 0 where it is missing or none."""
    try:
        return float(text or 0.0)
    except ValueError:
        return 0.0
