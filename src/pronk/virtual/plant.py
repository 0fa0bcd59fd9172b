"""The different machine: rotors behind compliant belts, driven by DC motors.

From the robot's own structure (`Robot.build_spec`) comes a plant in which every joint has two
degrees of freedom: the link, and the rotor with the inertia reflected through the gear. A belt
(spring and damper) couples them. Motor, encoder and friction sit on the rotor, as on the robot.
All of it is in joint coordinates.

`rotor.py` has the drive. On the bench the base is fixed to its stand and nothing touches anything;
on the ground the trunk is free.

Time stepping. MuJoCo's Euler step is symplectic: positions see the new speed, torques the old one.
With the drive's derivative torque explicit, q_{n+1} - 2 q_n + q_{n-1} = -(h/I) kd (q_n - q_{n-1})
+ ..., in which the backward difference stands for qdot - (h/2) qddot: the joint answers as if its
inertia were smaller by kd h / 2, an error of first order in the step h (0.13 dB at 0.25 ms). The
rotor is therefore given that much more inertia, which leaves an error of second order; passive
damping is implicit in MuJoCo, so its share has the other sign. The same effect, uncorrected and
at 5 ms, is what makes gains matched in the training simulator differ from those on the drive.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from pronk.errors import RobotError
from pronk.robots.robot import Robot
from pronk.virtual.ground import Ground
from pronk.virtual.rotor import ROTOR_MASS, MotorConstants, add_rotor
from pronk.virtual.sim_params import SimParams

Array = NDArray[np.float64]

# Largest angular frequency of a spring times the step; the symplectic step is stable below 2.
_STABLE = 1.0

# Places in MuJoCo's parameter vectors of a dcmotor (MuJoCo 3.11).
_KP, _KD, _VMAX = 4, 6, 7
_STATE = mujoco.mjtState.mjSTATE_QPOS | mujoco.mjtState.mjSTATE_QVEL | mujoco.mjtState.mjSTATE_ACT


@dataclass(frozen=True)
class Plant:
    """A compiled plant and where to find its parts. Arrays are in the order of `joints`."""

    model: Any
    """mujoco.MjModel"""
    joints: tuple[str, ...]
    """Joints that are in the plant, in file order."""
    rotor: NDArray[np.intp]
    """Index of each rotor in qvel."""
    rotor_qpos: NDArray[np.intp]
    """Index of each rotor in qpos."""
    link: NDArray[np.intp]
    """Index of each link in qvel."""
    link_qpos: NDArray[np.intp]
    """Index of each link in qpos."""
    actuator: NDArray[np.intp]
    """Index of each motor in ctrl."""
    current: NDArray[np.intp]
    """Index of each motor's current in act."""
    stand: NDArray[np.intp]
    """Indices of the stand's roll, pitch and yaw in qpos and qvel; empty if it is rigid, and on the
    ground."""
    feet: NDArray[np.intp]
    """Geom of each leg's foot, on the ground; empty on the bench."""
    base: int
    """Id of the trunk's body."""
    constant: Array
    """True motor constants K [V s/rad]."""
    believed: Array
    """Motor constants K0 that the drives believe [V s/rad]."""
    resistance: Array
    """[ohm]"""
    effort_limit: Array
    """Largest torque that the motors give when the drives believe to be at theirs [N m]."""
    rotor_inertia: Array
    """True, reflected through the gear [kg m^2]."""
    viscous: Array
    """[N m s/rad]"""

    @cached_property
    def state_size(self) -> int:
        """Numbers in a raw state: positions, velocities, activations."""
        return int(self.model.nq + self.model.nv + self.model.na)

    @cached_property
    def aside(self) -> Any:
        """A mujoco.MjData to compute in, beside the run's: making one takes longer than a look."""
        return mujoco.MjData(self.model)

    def read(self, data: Any, row: Array) -> None:
        """Copy the raw state of a mujoco.MjData into a row, shape (state_size,)."""
        mujoco.mj_getState(self.model, data, row, _STATE)

    def parts(self, rows: Array) -> tuple[Array, Array, Array]:
        """Views of positions, velocities and activations in raw states, shape (..., state_size)."""
        nq, nv = self.model.nq, self.model.nv
        return rows[..., :nq], rows[..., nq : nq + nv], rows[..., nq + nv :]

    def set_gains(self, stiffness: Array, damping: Array) -> None:
        """Put gains [N m/rad, N m s/rad] on the drives, in force from the next physics step."""
        volts = self.resistance / self.believed
        self.model.actuator_gainprm[self.actuator, _KP] = volts * stiffness
        self.model.actuator_gainprm[self.actuator, _KD] = volts * damping - self.constant
        # Second-order time stepping; see the module's docstring.
        explicit = self.constant / self.believed * damping - self.viscous
        half_step = 0.5 * self.model.opt.timestep
        inertia = self.rotor_inertia + half_step * explicit
        self.model.dof_armature[self.rotor] = inertia
        # What MuJoCo reads in its place for a rotor whose parent cannot move.
        self.model.dof_M0[self.rotor] = inertia + ROTOR_MASS

    def set_bus_voltage(self, voltage: float) -> None:
        """Set the voltage at which the inverters clip [V]."""
        # Every actuator of the plant is a motor.
        self._inverters[:] = voltage

    @cached_property
    def _inverters(self) -> Array:
        """View of the voltages at which they clip."""
        view: Array = self.model.actuator_gainprm[:, _VMAX]
        return view

    def motor_torque(self, act: Array) -> Array:
        """Motor torque without friction [N m], (..., joints), from activations (..., na)."""
        torque = self.constant * act.take(self.current, axis=-1)
        np.maximum(torque, self._least_torque, out=torque)
        limited: Array = np.minimum(torque, self.effort_limit, out=torque)
        return limited

    @cached_property
    def _least_torque(self) -> Array:
        return -self.effort_limit

    def electrical_power(self, torque: Array, speed: Array) -> Array:
        """Power from the bus, mechanical and heat, summed over joints [W].

        Args:
            torque: Of the motors [N m], shape (..., joints).
            speed: Of the rotors [rad/s], shape (..., joints).
        """
        current = torque / self.constant
        power: Array = (torque * speed + current * current * self.resistance).sum(axis=-1)
        return power

    def set_clamps(
        self, joints: tuple[str, ...], q: Array, stiffness: float, damping: float
    ) -> None:
        """Hold links where they are with a fixture; release all others.

        The fixture is a spring and damper between link and body, not a constraint: its stiffness
        has a unit that can be looked up, and it costs no solver iterations.

        Args:
            joints: Joints whose links are held; () releases all.
            q: Generalized positions of the plant [rad].
            stiffness: [N m/rad]
            damping: [N m s/rad]
        """
        for name, dof, index in zip(self.joints, self.link, self.link_qpos, strict=True):
            held = name in joints
            self.model.jnt_stiffness[self.model.dof_jntid[dof]] = stiffness if held else 0.0
            self.model.dof_damping[dof] = damping if held else 0.0
            self.model.qpos_spring[index] = q[index] if held else 0.0


def legs_of(robot: Robot) -> tuple[str, ...]:
    """Names of the robot's limbs in file order; see `leg_of`."""
    return tuple(dict.fromkeys(leg_of(robot, joint.name) for joint in robot.joints))


def leg_of(robot: Robot, name: str) -> str:
    """Name the limb of a joint: the first part that its joints' names share, or its first joint."""
    joint = robot.joint(name)
    limb = [n for n in robot.joint_names if n in (name, *joint.chain, *joint.clamped)]
    first = {each.split("_")[0] for each in limb}
    return first.pop() if len(first) == 1 else limb[0]


def _drop_legs(spec: Any, robot: Robot, kept: set[str]) -> None:
    """Delete every subtree under the base that holds no kept joint."""
    for child in list(spec.body(robot.base_body).bodies):
        names = [joint.name for joint in child.find_all("joint")]
        names += [joint.name for joint in child.joints]
        if names and not any(name in kept for name in names):
            spec.delete(child)


def _indices(joints: list[Any], of: str) -> NDArray[np.intp]:
    return np.array([getattr(joint, of)[0] for joint in joints], dtype=np.intp)


def _check_springs(plant: Plant, sim_params: SimParams) -> None:
    """Refuse springs that the physics step cannot follow; name the field and the largest value."""
    model = plant.model
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    mobility = np.diag(np.linalg.inv(inertia))
    for k, name in enumerate(plant.joints):
        joint = sim_params.joints[name]
        rotor, link = mobility[plant.rotor[k]], mobility[plant.link[k]]
        for field, value, mobile in (
            ("belt_stiffness", joint.belt_stiffness, rotor + link),
            ("presliding_stiffness", joint.presliding_stiffness, rotor),
        ):
            most = (_STABLE / model.opt.timestep) ** 2 / mobile
            if value > most:
                raise RobotError(
                    f"joints.{name}.{field} is {value:g}; at a physics step of "
                    f"{model.opt.timestep:g} s at most {most:.3g} N m/rad can be simulated."
                )


_STAND_AXES = {"stand_roll": (1, 0, 0), "stand_pitch": (0, 1, 0), "stand_yaw": (0, 0, 1)}
"""Joints of a stand that gives a little, and their axes."""


def _free_base(spec: Any, robot: Robot, ground: Ground) -> None:
    """Put a model's free trunk over the ground; refuse an arm."""
    base = spec.body(robot.base_body)
    if [joint.type for joint in base.joints] != [mujoco.mjtJoint.mjJNT_FREE]:
        raise RobotError(
            f"{robot.name} has no legs to stand on; it can be simulated on the bench only."
        )
    # What is only drawn costs time in every step.
    for geom in [geom for geom in spec.geoms if not geom.contype and not geom.conaffinity]:
        spec.delete(geom)
    ground.add_to(spec)


def _change_trunk(model: Any, body: int, sim_params: SimParams) -> None:
    """Apply the trunk's parameters to a model; constants derived from masses are left alone.

    Raises:
        RobotError: No body could be like that.
    """
    trunk = sim_params.trunk
    mass = float(model.body_mass[body])
    if not mass + trunk.mass_offset > 0.0:
        raise RobotError(
            f"trunk.mass_offset is {trunk.mass_offset:g} kg; the trunk has {mass:.3g} kg, of which "
            "something must be left."
        )
    # MuJoCo's principal moments are sorted; those of the parameters are about x, y, z.
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, model.body_iquat[body])
    nearest = np.abs(axes.reshape(3, 3)).argmax(axis=0)
    moments = model.body_inertia[body] * np.array(trunk.inertia_scale)[nearest]
    if 2.0 * moments.max() > moments.sum():
        raise RobotError(
            f"trunk.inertia_scale is {list(trunk.inertia_scale)}; the principal moments would be "
            f"{', '.join(f'{m:.4g}' for m in moments)} kg m^2, of which the largest exceeds the "
            "sum of the others, as no body's does."
        )
    model.body_inertia[body] = moments * (1.0 + trunk.mass_offset / mass)
    model.body_mass[body] = mass + trunk.mass_offset
    model.body_ipos[body] += trunk.com_offset


def _fix_base(spec: Any, robot: Robot, sim_params: SimParams) -> None:
    """Fix a model's trunk to its stand."""
    base = spec.body(robot.base_body)
    for joint in list(base.joints):
        spec.delete(joint)
    if math.isfinite(sim_params.machine.stand_stiffness):
        for name, axis in _STAND_AXES.items():
            base.add_joint(
                name=name,
                type=mujoco.mjtJoint.mjJNT_HINGE,
                axis=axis,
                stiffness=[sim_params.machine.stand_stiffness, 0, 0],
                damping=[sim_params.machine.stand_damping, 0, 0],
                limited=mujoco.mjtLimited.mjLIMITED_FALSE,
            )


def build_plant(
    robot: Robot,
    sim_params: SimParams,
    legs: tuple[str, ...],
    timestep_s: float,
    ground: Ground | None = None,
) -> Plant:
    """Build the plant: on the bench, base on the stand and feet in the air, or on the ground.

    Args:
        robot: Structure, masses and drives to start from.
        sim_params: In what the machine differs.
        legs: Legs to keep in the plant, of `legs_of(robot)`.
        timestep_s: Physics step [s].
        ground: What it stands on; None is the bench.

    Raises:
        RobotError: The parameters are of another robot, a joint is missing in the model or in them,
            the trunk is none that could exist, or a spring is too stiff for the step.
    """
    if sim_params.robot != robot.name:
        raise RobotError(
            f"the parameters are of {sim_params.robot!r}, the robot is {robot.name!r}; give a file "
            "written for that robot."
        )
    sim_params.check_joints(robot.joint_names)
    joints = tuple(joint for joint in robot.joints if leg_of(robot, joint.name) in legs)
    spec = robot.build_spec()
    spec.option.timestep = timestep_s
    for key in list(spec.keys):
        spec.delete(key)
    if ground is None:
        _fix_base(spec, robot, sim_params)
        spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    else:
        _free_base(spec, robot, ground)
    _drop_legs(spec, robot, {joint.name for joint in joints})
    for joint in joints:
        add_rotor(
            spec,
            joint.name,
            joint.drive,
            sim_params.joints[joint.name],
            sim_params.machine.drive_lag_s,
        )
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    model = spec.compile()
    rotors, links = ([model.joint(f"{j.name}{end}") for j in joints] for end in ("/rotor", ""))
    if model.nq != model.nv + (ground is not None):
        raise RobotError(f"{robot.name}: the virtual robot knows hinge joints only.")
    # Mass and inertia by the same factor: a body that was possible stays possible.
    for joint in joints:
        body = int(model.jnt_bodyid[model.joint(joint.name).id])
        model.body_mass[body] *= sim_params.joints[joint.name].link_inertia_scale
        model.body_inertia[body] *= sim_params.joints[joint.name].link_inertia_scale
    base = model.body(robot.base_body).id
    feet = []
    if ground is not None:
        _change_trunk(model, base, sim_params)
        feet = [model.geom(f"{leg}_foot_collision").id for leg in legs]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    if ground is not None:
        ground.set_contact(model, np.array(feet, dtype=np.intp))
    scale = np.array([sim_params.joints[joint.name].torque_scale for joint in joints])
    motors = [MotorConstants.of(joint.drive) for joint in joints]
    believed = np.array([motor.constant for motor in motors])
    rigid = ground is not None or not math.isfinite(sim_params.machine.stand_stiffness)
    plant = Plant(
        model=model,
        joints=tuple(joint.name for joint in joints),
        rotor=_indices(rotors, "dofadr"),
        rotor_qpos=_indices(rotors, "qposadr"),
        link=_indices(links, "dofadr"),
        link_qpos=_indices(links, "qposadr"),
        actuator=np.array([model.actuator(f"{j.name}/motor").id for j in joints], dtype=np.intp),
        # LuGre's bristle comes first among a motor's states, its current last.
        current=np.array(
            [
                model.actuator_actadr[motor] + model.actuator_actnum[motor] - 1
                for motor in (model.actuator(f"{joint.name}/motor").id for joint in joints)
            ],
            dtype=np.intp,
        ),
        stand=np.array(
            [] if rigid else [model.joint(name).dofadr[0] for name in _STAND_AXES], dtype=np.intp
        ),
        feet=np.array(feet, dtype=np.intp),
        base=base,
        constant=scale * believed,
        believed=believed,
        resistance=np.array([motor.resistance for motor in motors]),
        effort_limit=scale * np.array([joint.drive.effort_limit for joint in joints]),
        rotor_inertia=np.array(
            [sim_params.joints[j.name].rotor_inertia * j.drive.gear_ratio**2 for j in joints]
        ),
        viscous=np.array([sim_params.joints[joint.name].viscous for joint in joints]),
    )
    _check_springs(plant, sim_params)
    return plant
