"""What the couplings of a model do to a hinge: joints that follow it, and tendons.

Equalities of joints, tendons and bodies, and the mimics of a URDF, make some joints follow others.
A follower has no drive and stands still on the bench of pronk, but where the hinge that it follows
turns by 1 rad it moves by a ratio, and brings its inertia along. With the ratios `w` of all that
moves (1 of the hinge itself) and the mass matrix `M`, the inertia at the hinge is `w M w`.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from pronk.arrays import Array
from pronk.robots.source_model import SourceModel

SMALLEST_RATIO = 1e-6
"""Ratio of a follower's motion below which it stands still: far less than any gear's."""
TIED = 1e-3
"""Share of a coupling that no follower takes up, from which on it ties the hinge itself."""


@dataclass(frozen=True, kw_only=True)
class Followers:
    """The joints that follow a hinge, with what they add to it at the pose."""

    names: tuple[str, ...]
    """Their names."""
    inertia: float
    """Inertia, beside that of the hinge with its followers at rest; negative where they turn
    against the hinge [kg m^2]."""
    viscous_damping: float
    """Viscous damping [N m s/rad]."""
    frictionloss: float
    """Dry friction [N m]."""


@dataclass(frozen=True, kw_only=True)
class Couplings:
    """The couplings of the driven hinges of a model."""

    followers: Mapping[int, Followers]
    """Followers by the index of the hinge; of hinges that have any."""
    notes: tuple[str, ...]
    """Sentences on followers, and on what was left out."""


def couplings_of(
    source: SourceModel, hinges: Sequence[int], held_joints: Collection[str], qpos: Array
) -> Couplings:
    """Find what moves with each driven hinge of a model, and what its tendons do to it.

    Args:
        source: The model.
        hinges: Indices of the hinges that are driven.
        held_joints: Names of the joints that are held.
        qpos: The pose.
    """
    model: Any = source.model.__copy__()
    model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_EQUALITY)
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    coupling, names = _coupling_rows(source, data)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    held_dofs = []
    for dof in range(model.nv):
        joint = int(model.dof_jntid[dof])
        if source.joint_names[joint] in held_joints:
            held_dofs.append(dof)
    followers = {}
    notes = []
    for hinge in hinges:
        dof = int(model.jnt_dofadr[hinge])
        bound = coupling[:, dof]
        if not np.any(bound):
            continue
        motion = np.zeros(model.nv)
        motion[dof] = 1.0
        if held_dofs:
            motion[held_dofs] = np.linalg.lstsq(coupling[:, held_dofs], -bound, rcond=None)[0]
        hinge_name = source.joint_names[hinge]
        left_over = coupling @ motion
        tied = np.flatnonzero(np.abs(left_over) > TIED * np.abs(bound).max())
        if len(tied):
            ties = sorted({names[row] for row in tied})
            notes.append(
                f"{', '.join(ties)} ties {hinge_name} to the world or to joints that have drives "
                "of their own; a sweep moves it alone"
            )
            continue
        following = {}
        for other in held_dofs:
            if abs(motion[other]) > SMALLEST_RATIO:
                name = source.joint_names[int(model.dof_jntid[other])]
                following[name] = float(motion[other])
        if not following:
            continue
        others = motion.copy()
        others[dof] = 0.0
        followers[hinge] = Followers(
            names=tuple(following),
            inertia=float(motion @ mass @ motion - mass[dof, dof]),
            viscous_damping=float(model.dof_damping @ others**2),
            frictionloss=float(model.dof_frictionloss @ np.abs(others)),
        )
        ratios = []
        for name, ratio in following.items():
            ratios.append(f"{name} ({ratio:.3g})")
        note = (
            f"{hinge_name} moves {', '.join(ratios)} along by a coupling of the model; they stand "
            f"still in a sweep and a match, and what they add to {hinge_name} at the pose is in "
            "its drive"
        )
        lighter = -followers[hinge].inertia / (mass[dof, dof] + followers[hinge].inertia)
        if model.dof_armature[dof] + followers[hinge].inertia < 0.0 and lighter > 0.01:
            note += (
                f"; only its inertia stays {100 * lighter:.0f} % too large, as they turn against "
                "it, and so will gains that are matched"
            )
        notes.append(note)
    return Couplings(
        followers=followers, notes=(*notes, *_tendon_notes(source, hinges, model, data))
    )


def _coupling_rows(source: SourceModel, data: mujoco.MjData) -> tuple[Array, list[str]]:
    """Return what couplings hold at zero.

    Returns:
        The coefficients of each speed, shape (couplings, dofs), and what each coupling is.
    """
    model = source.model
    rows = []
    names = []
    # MuJoCo keeps room for constraints that turn out to bind nothing.
    constraints = data.efc_J[: data.nefc * model.nv].reshape(data.nefc, model.nv)
    for row in np.flatnonzero(data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY):
        rows.append(constraints[row])
        index = int(data.efc_id[row])
        names.append(f"equality {model.equality(index).name or index}")
    for name, leader in source.mimics.items():
        if name in source.joint_names and leader in source.joint_names:
            mimic = np.zeros(model.nv)
            mimic[model.jnt_dofadr[source.joint_names.index(name)]] = 1.0
            leader_dof = model.jnt_dofadr[source.joint_names.index(leader)]
            mimic[leader_dof] = -source.mimic_ratios.get(name, 1.0)
            rows.append(mimic)
            names.append(f"the mimic of {name}")
    return np.array(rows).reshape(len(rows), model.nv), names


def _tendon_notes(
    source: SourceModel, hinges: Sequence[int], model: Any, data: mujoco.MjData
) -> list[str]:
    """Say which properties of tendons act on driven hinges; a robot of pronk has no tendons."""
    properties = {
        "springs": np.asarray(model.tendon_stiffness) > 0.0,
        "dampers": np.asarray(model.tendon_damping) > 0.0,
        "dry friction": np.asarray(model.tendon_frictionloss) > 0.0,
        "limits of the length": np.asarray(model.tendon_limited) > 0,
    }
    moments = np.zeros((model.ntendon, model.nv))
    for tendon in range(model.ntendon):
        begin = model.ten_J_rowadr[tendon]
        columns = slice(begin, begin + model.ten_J_rownnz[tendon])
        moments[tendon, model.ten_J_colind[columns]] = data.ten_J[columns]
    notes = []
    for words, has_property in properties.items():
        acted_on = []
        for hinge in hinges:
            dof = model.jnt_dofadr[hinge]
            acting = has_property & (moments[:, dof] != 0.0)
            if not np.any(acting):
                continue
            text = source.joint_names[hinge]
            if words == "springs":
                stiffness = float(model.tendon_stiffness[acting] @ moments[acting, dof] ** 2)
                text += f" ({stiffness:.3g} N m/rad)"
            acted_on.append(text)
        if acted_on:
            notes.append(f"left out: {words} of tendons, which act on {', '.join(acted_on)}")
    return notes
