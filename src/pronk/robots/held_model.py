"""The model of a robot as a new MJCF: bodies, hinges and simple geoms, other joints held.

A model that MuJoCo compiles has much that a robot on the bench does not need, and each of its
elements may name others. So the MJCF is written anew from the numbers of the compiled model:
bodies with explicit inertias, the joints that stay, geoms without meshes, sites, excludes, and the
equalities between what stays. Joints that are held at a position are no joints any more; their
bodies stand where they would stand there.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping, Sequence

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from pronk.arrays import Array
from pronk.robots.source_model import SourceModel

GEOMS = {
    mujoco.mjtGeom.mjGEOM_PLANE: "plane",
    mujoco.mjtGeom.mjGEOM_SPHERE: "sphere",
    mujoco.mjtGeom.mjGEOM_CAPSULE: "capsule",
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: "ellipsoid",
    mujoco.mjtGeom.mjGEOM_CYLINDER: "cylinder",
    mujoco.mjtGeom.mjGEOM_BOX: "box",
}
"""Geoms that need no file."""
JOINTS = {
    mujoco.mjtJoint.mjJNT_BALL: "ball",
    mujoco.mjtJoint.mjJNT_SLIDE: "slide",
    mujoco.mjtJoint.mjJNT_HINGE: "hinge",
}
"""Joints in a branch of the tree."""
POSITIONS = {
    mujoco.mjtJoint.mjJNT_FREE: 7,
    mujoco.mjtJoint.mjJNT_BALL: 4,
    mujoco.mjtJoint.mjJNT_SLIDE: 1,
    mujoco.mjtJoint.mjJNT_HINGE: 1,
}
"""Coordinates of a joint."""
CONES = {mujoco.mjtCone.mjCONE_PYRAMIDAL: "pyramidal", mujoco.mjtCone.mjCONE_ELLIPTIC: "elliptic"}
"""Names of the friction cones of contacts."""


def held_mjcf(source: SourceModel, held_joints: Mapping[int, ArrayLike]) -> str:
    """Write the MJCF of a model whose joints are held_joints in part.

    Args:
        source: The model.
        held_joints: Index of a joint to the position at which it is held: of a slide [m], of a
            hinge [rad], of a ball joint a quaternion, of a free joint position and quaternion.

    Returns:
        The MJCF: angles in radians, explicit inertias, no actuators, meshes, keyframes or sensors.
    """
    model = source.model
    root = ET.Element("mujoco", {"model": _model_name(source)})
    ET.SubElement(
        root, "compiler", {"angle": "radian", "inertiafromgeom": "false", "autolimits": "false"}
    )
    option = model.opt
    ET.SubElement(
        root,
        "option",
        {
            "timestep": _text(option.timestep),
            "gravity": _text(option.gravity),
            "wind": _text(option.wind),
            "density": _text(option.density),
            "viscosity": _text(option.viscosity),
            "impratio": _text(option.impratio),
            "cone": CONES[mujoco.mjtCone(option.cone)],
        },
    )
    elements = [ET.SubElement(root, "worldbody")]
    _add_geoms(elements[0], model, 0)
    for body in range(1, model.nbody):
        element = ET.SubElement(elements[model.body_parentid[body]], "body")
        elements.append(element)
        _fill_body(element, source, body, held_joints)
        _add_geoms(element, model, body)
    _add_relations(root, source, held_joints)
    return ET.tostring(root, encoding="unicode")


def _model_name(source: SourceModel) -> str:
    """Return the name of the model; that of its file if it has none."""
    end = bytes(source.model.names).find(b"\0")
    name = bytes(source.model.names)[:end].decode(errors="replace")
    return name or source.path.stem


def _fill_body(
    element: ET.Element, source: SourceModel, body: int, held_joints: Mapping[int, ArrayLike]
) -> None:
    """Write the frame, the inertia and the joints of a body."""
    model = source.model
    position = model.body_pos[body].copy()
    quat = model.body_quat[body].copy()
    first = model.body_jntadr[body]
    indices = range(first, first + model.body_jntnum[body])
    moved: list[tuple[int, Array, Array]] = []
    for index in indices:
        if index not in held_joints:
            moved.append((index, model.jnt_pos[index].copy(), model.jnt_axis[index].copy()))
            continue
        values = np.atleast_1d(np.asarray(held_joints[index], dtype=np.float64))
        if model.jnt_type[index] == mujoco.mjtJoint.mjJNT_FREE:
            position = values[:3]
            quat = values[3:]
            continue
        shift, rotation = _displacement(model, index, values)
        # The body's frame moves by a shift and a rotation, both in the body's frame.
        step = np.zeros(3)
        mujoco.mju_rotVecQuat(step, shift, quat)
        position = position + step
        turned = np.zeros(4)
        mujoco.mju_mulQuat(turned, quat, rotation)
        quat = turned
        # Joints before this one stay where they are, so that in the moved frame they move back.
        back = np.zeros(4)
        mujoco.mju_negQuat(back, rotation)
        for number, (other, anchor, axis) in enumerate(moved):
            new_anchor = np.zeros(3)
            new_axis = np.zeros(3)
            mujoco.mju_rotVecQuat(new_anchor, anchor - shift, back)
            mujoco.mju_rotVecQuat(new_axis, axis, back)
            moved[number] = (other, new_anchor, new_axis)
    element.set("name", source.body_names[body])
    element.set("pos", _text(position))
    element.set("quat", _text(quat))
    if model.body_gravcomp[body]:
        element.set("gravcomp", _text(model.body_gravcomp[body]))
    if model.body_mass[body] or np.any(model.body_inertia[body]):
        ET.SubElement(
            element,
            "inertial",
            {
                "mass": _text(model.body_mass[body]),
                "pos": _text(model.body_ipos[body]),
                "quat": _text(model.body_iquat[body]),
                "diaginertia": _text(_possible(model.body_inertia[body])),
            },
        )
    for index, anchor, axis in moved:
        _add_joint(element, source, index, anchor, axis)


def _displacement(model: mujoco.MjModel, index: int, values: Array) -> tuple[Array, Array]:
    """Return how a joint moves its body's frame: shift [m] and rotation, in the frame at zero."""
    rotation = np.array([1.0, 0.0, 0.0, 0.0])
    address = model.jnt_qposadr[index]
    if model.jnt_type[index] == mujoco.mjtJoint.mjJNT_SLIDE:
        return model.jnt_axis[index] * (values[0] - model.qpos0[address]), rotation
    if model.jnt_type[index] == mujoco.mjtJoint.mjJNT_BALL:
        rotation = values / np.linalg.norm(values)
    else:
        angle = values[0] - model.qpos0[address]
        mujoco.mju_axisAngle2Quat(rotation, model.jnt_axis[index], angle)
    turned_anchor = np.zeros(3)
    mujoco.mju_rotVecQuat(turned_anchor, model.jnt_pos[index], rotation)
    return model.jnt_pos[index] - turned_anchor, rotation


def _add_joint(
    element: ET.Element, source: SourceModel, index: int, anchor: Array, axis: Array
) -> None:
    """Write a joint that stays."""
    model = source.model
    element_type = mujoco.mjtJoint(model.jnt_type[index])
    name = source.joint_names[index]
    if element_type == mujoco.mjtJoint.mjJNT_FREE:
        ET.SubElement(element, "freejoint", {"name": name})
        return
    dof = model.jnt_dofadr[index]
    attributes = {
        "name": name,
        "type": JOINTS[element_type],
        "pos": _text(anchor),
        "armature": _text(model.dof_armature[dof]),
        "frictionloss": _text(model.dof_frictionloss[dof]),
        "damping": _coefficients(model.dof_damping[dof], model.dof_dampingpoly[dof]),
        "stiffness": _coefficients(model.jnt_stiffness[index], model.jnt_stiffnesspoly[index]),
        "limited": "true" if model.jnt_limited[index] else "false",
        "range": _text(model.jnt_range[index]),
        "margin": _text(model.jnt_margin[index]),
        "solreflimit": _text(model.jnt_solref[index]),
        "solimplimit": _text(model.jnt_solimp[index]),
        "solreffriction": _text(model.dof_solref[dof]),
        "solimpfriction": _text(model.dof_solimp[dof]),
    }
    if element_type != mujoco.mjtJoint.mjJNT_BALL:
        address = model.jnt_qposadr[index]
        attributes["axis"] = _text(axis)
        attributes["ref"] = _text(model.qpos0[address])
        attributes["springref"] = _text(model.qpos_spring[address])
    ET.SubElement(element, "joint", attributes)


def _add_geoms(element: ET.Element, model: mujoco.MjModel, body: int) -> None:
    """Write the geoms of a body that need no file, and its sites."""
    for index in np.flatnonzero(model.geom_bodyid == body):
        element_type = mujoco.mjtGeom(model.geom_type[index])
        if element_type not in GEOMS:
            continue
        material = model.geom_matid[index]
        rgba = model.geom_rgba[index] if material < 0 else model.mat_rgba[material]
        attributes = {
            "type": GEOMS[element_type],
            "size": _text(model.geom_size[index]),
            "pos": _text(model.geom_pos[index]),
            "quat": _text(model.geom_quat[index]),
            "contype": str(model.geom_contype[index]),
            "conaffinity": str(model.geom_conaffinity[index]),
            "condim": str(model.geom_condim[index]),
            "group": str(model.geom_group[index]),
            "priority": str(model.geom_priority[index]),
            "friction": _text(model.geom_friction[index]),
            "solmix": _text(model.geom_solmix[index]),
            "solref": _text(model.geom_solref[index]),
            "solimp": _text(model.geom_solimp[index]),
            "margin": _text(model.geom_margin[index]),
            "gap": _text(model.geom_gap[index]),
            "rgba": _text(rgba),
        }
        name = model.geom(index).name
        if name:
            attributes["name"] = name
        ET.SubElement(element, "geom", attributes)
    for index in np.flatnonzero(model.site_bodyid == body):
        attributes = {
            "pos": _text(model.site_pos[index]),
            "quat": _text(model.site_quat[index]),
            "group": str(model.site_group[index]),
            "rgba": _text(model.site_rgba[index]),
        }
        element_type = mujoco.mjtGeom(model.site_type[index])
        if element_type in GEOMS and element_type != mujoco.mjtGeom.mjGEOM_PLANE:
            attributes["type"] = GEOMS[element_type]
            attributes["size"] = _text(model.site_size[index])
        name = model.site(index).name
        if name:
            attributes["name"] = name
        ET.SubElement(element, "site", attributes)


def _add_relations(
    root: ET.Element, source: SourceModel, held_joints: Mapping[int, ArrayLike]
) -> None:
    """Write the excludes, and the equalities that bind nothing that is held."""
    model = source.model
    contact = ET.SubElement(root, "contact")
    for signature in model.exclude_signature:
        bodies = {
            "body1": source.body_names[int(signature) >> 16],
            "body2": source.body_names[int(signature) & 0xFFFF],
        }
        ET.SubElement(contact, "exclude", bodies)
    equality = ET.SubElement(root, "equality")
    for index in range(model.neq):
        _add_equality(equality, source, index, held_joints)


def _add_equality(
    parent: ET.Element, source: SourceModel, index: int, held_joints: Mapping[int, ArrayLike]
) -> None:
    """Write an equality of joints or bodies, unless a joint that it constrains is held."""
    model = source.model
    element_type = mujoco.mjtEq(model.eq_type[index])
    first = int(model.eq_obj1id[index])
    second = int(model.eq_obj2id[index])
    values = model.eq_data[index]
    attributes = {
        "active": "true" if model.eq_active0[index] else "false",
        "solref": _text(model.eq_solref[index]),
        "solimp": _text(model.eq_solimp[index]),
    }
    if element_type == mujoco.mjtEq.mjEQ_JOINT:
        if first in held_joints or second in held_joints:
            return
        attributes["joint1"] = source.joint_names[first]
        if second >= 0:
            attributes["joint2"] = source.joint_names[second]
        attributes["polycoef"] = _text(values[:5])
        ET.SubElement(parent, "joint", attributes)
        return
    binds_bodies = model.eq_objtype[index] == mujoco.mjtObj.mjOBJ_BODY
    if not binds_bodies or _passes_held_joint(model, (first, second), held_joints):
        return
    attributes["body1"] = source.body_names[first]
    attributes["body2"] = source.body_names[second]
    if element_type == mujoco.mjtEq.mjEQ_CONNECT:
        attributes["anchor"] = _text(values[:3])
        ET.SubElement(parent, "connect", attributes)
    elif element_type == mujoco.mjtEq.mjEQ_WELD:
        attributes["anchor"] = _text(values[:3])
        attributes["relpose"] = _text(values[3:10])
        attributes["torquescale"] = _text(values[10])
        ET.SubElement(parent, "weld", attributes)


def _passes_held_joint(
    model: mujoco.MjModel, bodies: Sequence[int], held_joints: Iterable[int]
) -> bool:
    """Return whether a joint between two bodies and the root of the tree is held."""
    held_bodies = {int(model.jnt_bodyid[index]) for index in held_joints}
    for body in bodies:
        while body > 0:
            if body in held_bodies:
                return True
            body = int(model.body_parentid[body])
    return False


def _possible(inertia: Array) -> Array:
    """Return principal moments of inertia, the largest at most the sum of the others.

    A flat body has exactly the sum, which rounding may exceed.
    """
    possible = np.array(inertia)
    largest = int(np.argmax(possible))
    possible[largest] = min(possible[largest], possible.sum() - possible[largest])
    return possible


def _coefficients(linear: float, higher: Array) -> str:
    """Write the coefficients of a spring or damper; the higher ones only where there are any."""
    if np.any(higher):
        return _text([linear, *higher])
    return _text(linear)


def _text(values: ArrayLike) -> str:
    """Write numbers with all their digits."""
    return " ".join(repr(float(value)) for value in np.atleast_1d(values))
