"""A robot's numbers and motion by plain MuJoCo, without pronk's import and forecast."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import mujoco.rollout
import numpy as np
from numpy.typing import NDArray

from benchmarks.foreign.joints import RigidJoint
from benchmarks.foreign.population import actuators_of

Array = NDArray[np.float64]

LOCKED = 1e9
"""Inertia and damping of a joint that cannot move [kg m^2, N m s/rad]."""
STEP_S = 2e-4
"""Physics step of the simulation [s]."""
ANGLE_TOLERANCE = 1e-4
"""Largest difference of an end of a range [rad]."""
SETTLE_S = 0.5
"""Rest before the excitation [s], as in the plan."""
CHUNK = 2000
"""Steps whose states are kept at a time."""


@dataclass(frozen=True, kw_only=True)
class Numbers:
    """What a model says of one hinge; NaN where it says nothing."""

    effort_limits: tuple[float, ...] = ()
    """Largest torque [N m]; two where the directions differ; none where no limit is stated."""
    stiffness: float = math.nan
    """Of position servos [N m/rad]."""
    damping: float = math.nan
    """Of position and velocity servos [N m s/rad]."""
    low: float = math.nan
    """Ends of the range [rad]."""
    high: float = math.nan
    speed: float = math.nan
    """Largest speed of a URDF [rad/s]."""


@dataclass(frozen=True, kw_only=True)
class Held:
    """A joint of the chain in a simulation."""

    stiffness: float
    damping: float
    effort_limit: float
    armature: float
    frictionloss: float
    viscous_damping: float


@dataclass(frozen=True, kw_only=True)
class MotionPeaks:
    """Peaks of the excited joint."""

    torque: float
    speed: float
    lowest: float
    highest: float


def spec_of(path: Path) -> mujoco.MjSpec:
    """Read a model; a URDF that MuJoCo refuses is read without visuals, collisions, materials.

    Raises:
        ValueError: MuJoCo refuses that too.
    """
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        spec.copy().compile()
    except ValueError:
        if path.suffix != ".urdf":
            raise
        root = ElementTree.parse(path).getroot()
        for parent in list(root.iter()):
            for child in list(parent):
                if child.tag in ("visual", "collision", "material", "gazebo", "transmission"):
                    parent.remove(child)
        spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
        spec.copy().compile()
    return spec


def numbers_of(path: Path) -> dict[str, Numbers]:
    """Return what a model says of its hinges: compiled numbers of an MJCF, text of a URDF.

    Raises:
        ValueError: MuJoCo refuses the MJCF.
    """
    return _urdf_numbers(path) if path.suffix == ".urdf" else _mjcf_numbers(path)


def _urdf_numbers(path: Path) -> dict[str, Numbers]:
    numbers = {}
    for joint in ElementTree.parse(path).getroot().findall("joint"):
        kind = joint.get("type")
        if kind not in ("revolute", "continuous"):
            continue
        limit = joint.find("limit")
        stated = {} if limit is None else dict(limit.attrib)
        effort = float(stated.get("effort", 0.0))
        # MuJoCo takes a revolute joint without two different ends for one without a range.
        low = float(stated.get("lower", 0.0))
        high = float(stated.get("upper", 0.0))
        limited = kind == "revolute" and low < high
        numbers[str(joint.get("name"))] = Numbers(
            effort_limits=(effort,) if effort > 0.0 else (),
            low=low if limited else math.nan,
            high=high if limited else math.nan,
            speed=float(stated.get("velocity", 0.0)) or math.nan,
        )
    return numbers


def _mjcf_numbers(path: Path) -> dict[str, Numbers]:
    model = mujoco.MjModel.from_xml_path(str(path))
    numbers = {}
    for hinge in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE):
        stiffness = 0.0
        damping = 0.0
        # Torque in each direction that all actuators together can give.
        lowest = 0.0
        highest = 0.0
        for index in actuators_of(model, int(hinge)):
            gear = float(model.actuator_gear[index, 0])
            gain = float(model.actuator_gainprm[index, 0])
            bias = model.actuator_biasprm[index]
            fixed = model.actuator_gaintype[index] == mujoco.mjtGain.mjGAIN_FIXED
            affine = model.actuator_biastype[index] == mujoco.mjtBias.mjBIAS_AFFINE
            if affine:
                stiffness -= gear**2 * float(bias[1])
                damping -= gear**2 * float(bias[2])
            force = (-math.inf, math.inf)
            direct = not affine and model.actuator_biastype[index] == mujoco.mjtBias.mjBIAS_NONE
            if fixed and direct and model.actuator_ctrllimited[index]:
                ends = gain * model.actuator_ctrlrange[index]
                force = (float(ends.min()), float(ends.max()))
            if model.actuator_forcelimited[index]:
                low, high = model.actuator_forcerange[index]
                force = (max(force[0], float(low)), min(force[1], float(high)))
            ends = np.sort(gear * np.array(force))
            lowest += float(ends[0])
            highest += float(ends[1])
        if not actuators_of(model, int(hinge)):
            lowest = -math.inf
            highest = math.inf
        if model.jnt_actfrclimited[hinge]:
            low, high = model.jnt_actfrcrange[hinge]
            lowest = max(lowest, float(low))
            highest = min(highest, float(high))
        limits = []
        for limit in (-lowest, highest):
            if math.isfinite(limit) and limit > 0.0 and limit not in limits:
                limits.append(limit)
        limited = bool(model.jnt_limited[hinge])
        numbers[model.joint(int(hinge)).name] = Numbers(
            effort_limits=tuple(limits),
            stiffness=stiffness or math.nan,
            damping=damping or math.nan,
            low=float(model.jnt_range[hinge, 0]) if limited else math.nan,
            high=float(model.jnt_range[hinge, 1]) if limited else math.nan,
        )
    return numbers


def peaks(
    spec: mujoco.MjSpec,
    joint: str,
    chain: Mapping[str, Held],
    pose: Mapping[str, float],
    base_body: str,
    offsets: Array,
    rate_hz: float,
) -> MotionPeaks:
    """Simulate the excitation of one joint with MuJoCo's position actuators and implicitfast.

    The base does not move, and neither do joints outside of the chain. There are no contacts and
    no equality constraints.

    Args:
        spec: The model; it is changed.
        joint: Name of the excited joint.
        chain: Drives of the joints that move with it, and its own, by name.
        pose: Default position of each joint [rad]; joints that it lacks are at their reference.
        base_body: Body that is held still.
        offsets: Command about the pose at each tick [rad], shape (n,).
        rate_hz: Rate of the ticks [Hz].

    Raises:
        ValueError: MuJoCo refuses the model.
    """
    spec.compiler.fusestatic = False
    spec.option.timestep = STEP_S
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for flag in (
        mujoco.mjtDisableBit.mjDSBL_CONTACT,
        mujoco.mjtDisableBit.mjDSBL_EQUALITY,
        mujoco.mjtDisableBit.mjDSBL_LIMIT,
    ):
        spec.option.disableflags |= flag
    for elements in (spec.actuators, spec.equalities, spec.tendons, spec.keys, spec.sensors):
        for element in list(elements):
            spec.delete(element)
    for name, held in chain.items():
        hinge = spec.joint(name)
        hinge.armature = held.armature
        hinge.frictionloss = held.frictionloss
        hinge.damping = [held.viscous_damping, 0.0, 0.0]
        actuator = spec.add_actuator(
            name=f"drive of {name}", target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT
        )
        # The model's defaults may have other ranges, gears, dynamics, and a constant force.
        actuator.biasprm = [0.0] * len(actuator.biasprm)
        actuator.gainprm = [0.0] * len(actuator.gainprm)
        actuator.set_to_position(kp=held.stiffness, kv=held.damping)
        actuator.forcerange = [-held.effort_limit, held.effort_limit]
        actuator.ctrllimited = mujoco.mjtLimited.mjLIMITED_FALSE
        actuator.gear = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]
        actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
    model = spec.compile()
    data = mujoco.MjData(model)
    for index in range(model.njnt):
        name = model.joint(index).name
        address = model.jnt_qposadr[index]
        hinge_or_slide = model.jnt_type[index] in (
            mujoco.mjtJoint.mjJNT_HINGE,
            mujoco.mjtJoint.mjJNT_SLIDE,
        )
        if hinge_or_slide and name in pose:
            data.qpos[address] = pose[name]
        if name not in chain:
            first = model.jnt_dofadr[index]
            width = {mujoco.mjtJoint.mjJNT_FREE: 6, mujoco.mjtJoint.mjJNT_BALL: 3}
            last = first + width.get(mujoco.mjtJoint(model.jnt_type[index]), 1)
            model.dof_armature[first:last] = LOCKED
            model.dof_damping[first:last] = LOCKED
            model.dof_frictionloss[first:last] = 0.0
            model.jnt_stiffness[index] = 0.0
    mujoco.mj_setConst(model, mujoco.MjData(model))
    names = list(chain)
    command = np.zeros((round(SETTLE_S * rate_hz) + len(offsets), len(names)))
    command += np.array([pose[name] for name in names])
    command[-len(offsets) :, names.index(joint)] += offsets
    controls = np.repeat(command, round(1.0 / (rate_hz * STEP_S)), axis=0)
    address = int(model.joint(joint).qposadr[0])
    dof = int(model.joint(joint).dofadr[0])
    return _peaks_of(model, data, controls, (names.index(joint), address, dof), chain[joint])


def _peaks_of(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    controls: Array,
    columns: tuple[int, int, int],
    held: Held,
) -> MotionPeaks:
    """Simulate, chunk by chunk, and return the peaks of the joint of some columns."""
    column, address, dof = columns
    full = mujoco.mjtState.mjSTATE_FULLPHYSICS
    state = np.zeros(mujoco.mj_stateSize(model, full))
    mujoco.mj_getState(model, data, state, full)
    torque = 0.0
    speed = 0.0
    positions: list[float] = []
    rest = round(SETTLE_S / STEP_S)
    for begin in (0, *range(rest, len(controls), CHUNK)):
        control = controls[begin : begin + CHUNK if begin else rest]
        states, _ = mujoco.rollout.rollout(model, data, state[None], control[None])
        before = np.concatenate([state[None], states[0, :-1]])
        state = states[0, -1].copy()
        if begin == 0:
            continue  # The robot has sagged into its pose before a sweep begins.
        q = before[:, 1 + address]
        v = before[:, 1 + model.nq + dof]
        forces = held.stiffness * (control[:, column] - q) - held.damping * v
        torque = max(torque, float(np.abs(forces).max()))
        speed = max(speed, float(np.abs(v).max()))
        positions += [float(q.min()), float(q.max())]
    return MotionPeaks(torque=torque, speed=speed, lowest=min(positions), highest=max(positions))


def rigid_joint(path: Path, name: str, robot: str) -> RigidJoint | None:
    """Return a hinge of a model with all other joints clamped at their reference.

    Returns:
        The joint, without rotor inertia; None where nothing with a mass moves about it.

    Raises:
        ValueError: MuJoCo refuses the model.
    """
    spec = spec_of(path)
    spec.compiler.fusestatic = False
    model = spec.compile()
    data = mujoco.MjData(model)
    joint = model.joint(name)
    dof = int(joint.dofadr[0])
    torques = []
    for angle in (0.0, 0.5 * math.pi):
        data.qpos[:] = model.qpos0
        data.qpos[joint.qposadr[0]] += angle
        mujoco.mj_forward(model, data)
        torques.append(float(data.qfrc_bias[dof]))
    mass_matrix = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass_matrix)
    link_inertia = float(mass_matrix[dof, dof] - model.dof_armature[dof])
    mass = float(model.body_subtreemass[joint.bodyid[0]])
    # The angle counts from the reference; a torque of gravity may not ask for more than the link.
    gravity_torque = math.hypot(*torques)
    if mass <= 0.0 or link_inertia <= (gravity_torque / 9.81) ** 2 / mass:
        return None
    return RigidJoint(
        robot=robot,
        mass=mass,
        link_inertia=link_inertia,
        gravity_torque=gravity_torque,
        gravity_phase=math.atan2(torques[1], torques[0]),
        armature=0.0,
    )


def differences(found: Mapping[str, float], truth: Numbers, tolerance: float) -> dict[str, str]:
    """Return the numbers of a robot.yaml that are not those of its model, in words.

    Args:
        found: `effort_limit`, `stiffness`, `damping`, `low`, `high` and `speed` of the robot.yaml.
        truth: What the model says; what it does not say is not compared.
        tolerance: Largest relative difference.
    """
    wrong = {}
    limits: Sequence[float] = truth.effort_limits
    effort = found["effort_limit"]
    if limits and not any(abs(effort - limit) <= tolerance * limit for limit in limits):
        wrong["effort_limit"] = f"{effort:.6g} for {' or '.join(f'{each:.6g}' for each in limits)}"
    pairs = {
        "stiffness": truth.stiffness,
        "damping": truth.damping,
        "low": truth.low,
        "high": truth.high,
        "speed": truth.speed,
    }
    for name, number in pairs.items():
        if math.isnan(number):
            continue
        slack = tolerance * abs(number)
        if name in ("low", "high"):
            slack = max(slack, ANGLE_TOLERANCE)
        if not abs(found[name] - number) <= slack:
            wrong[name] = f"{found[name]:.6g} for {number:.6g}"
    return wrong
