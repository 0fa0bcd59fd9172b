"""The plant of the virtual robot: rotors behind compliant belts, driven by DC motors.

Every joint of the robot's model has two degrees of freedom here: the link, and the rotor with the
inertia reflected through the gear. A belt (spring and damper) couples them. Motor, encoder and
friction are on the rotor. All of it is in joint coordinates. On the bench the base is fixed to its
stand and there are no contacts; on the ground the trunk is free.

Drive. MuJoCo's `dcmotor`, whose controller outputs volts. A drive that regulates current demands
tau = stiffness (target - q) - damping qdot and assumes a motor constant K0; the motor has
K = torque_scale K0, in torque as in back-EMF (one magnetic flux). The voltage that drives the
current tau / K0 through R against the back-EMF is

    V = R tau / K0 + K qdot,    torque = K (V - K qdot) / R = torque_scale tau,

so the controller gains are R stiffness / K0 and R damping / K0 - K, and the clip of V at the bus
gives the torque-speed line of the true motor. At that clip the back-EMF is a damping of K^2 / R,
explicit and late by the lag of the drive, which the step cannot follow on a rotor that is light
for its motor (a URDF states torque and speed of a large motor at a link of grams). There the line
is made as flat as the step needs: same torque at standstill, higher speed without load. Below the
clip nothing changes, and the plan of a sweep keeps every joint below the line that its file states.
Friction is LuGre with a Stribeck peak:
dz/dt = v - sigma0 |v| z / g(v), g = F_C + (F_S - F_C) exp(-(v/v_S)^2), torque sigma0 z +
sigma1 dz/dt, outside the limits of the motor.

Time stepping. MuJoCo's Euler step is symplectic: positions use the new speed, torques the old one.
With the drive's derivative torque explicit, q_{n+1} - 2 q_n + q_{n-1} = -(h/I) kd (q_n - q_{n-1})
+ ..., in which the backward difference stands for qdot - (h/2) qddot: the joint responds as if its
inertia were smaller by kd h / 2, an error of first order in the step h (0.13 dB at 0.25 ms). The
rotor is therefore given that much more inertia, which leaves an error of second order; passive
damping is implicit in MuJoCo, so its share has the other sign. The same effect, uncorrected and
at 5 ms, is what makes gains matched in the training simulator differ from those on the drive.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from pronk.arrays import Array
from pronk.errors import RobotError
from pronk.jump.virtual.ground import Ground
from pronk.jump.virtual.sim_params import FixtureParams, JointParams, SimParams, TrunkParams
from pronk.robots.robot import Drive, RobotSpec

Indices = NDArray[np.intp]

# Largest angular frequency of a spring times the step; the symplectic step is stable below 2.
_STABLE = 1.0
# Largest damping of a drive times the step over the inertia of its rotor, for the second-order
# correction of the inertia to suffice.
_DAMPED = 0.5
# Share of the largest back-EMF damping at which a step is stable that is simulated at most.
_BACK_EMF = 0.25
# Lowest frequency at which rotor and link may swing on their belt [Hz].
_SOFTEST_HZ = 1.0
# The rotor's inertia is the armature of its hinge; MuJoCo requires a body with mass and inertia as
# well [kg, kg m^2]: at most a millionth of the rotor's.
_ROTOR_MASS = 1e-9
_ROTOR_SHARE = 1e-6
# Time in which a joint that has run into its stop is pushed back, 8 physics steps [s].
_STOP_S = 2e-3
# Joints of a compliant stand, and their axes.
_STAND_AXES = {"stand_roll": (1, 0, 0), "stand_pitch": (0, 1, 0), "stand_yaw": (0, 0, 1)}
# Places in MuJoCo's parameter vectors of a dcmotor (MuJoCo 3.11).
_KP = 4
_KD = 6
_VMAX = 7
_COULOMB = 3
_BREAKAWAY = 4
_STATE = mujoco.mjtState.mjSTATE_QPOS | mujoco.mjtState.mjSTATE_QVEL | mujoco.mjtState.mjSTATE_ACT


class RawStates(NamedTuple):
    """Views of raw states of a plant at n instants."""

    position: Array
    """Positions, MuJoCo's qpos. (n, nq)"""
    velocity: Array
    """Velocities, MuJoCo's qvel. (n, nv)"""
    torque: Array
    """Torques of the motors [N m]. (n, joints of the plant)"""
    voltage: Array
    """Voltages of the bus [V]. (n,)"""


class Plant:
    """A compiled plant and indices of its parts. Arrays are in the order of `joints`."""

    def __init__(
        self,
        robot: RobotSpec,
        sim_params: SimParams,
        legs: tuple[str, ...],
        timestep_s: float,
        ground: Ground | None = None,
        *,
        checked: bool = True,
    ) -> None:
        """Build the plant.

        Args:
            robot: Structure, masses, drives.
            sim_params: How the machine differs from `robot`.
            legs: Limbs that are simulated, of `legs_of(robot)`.
            timestep_s: Physics step [s].
            ground: The ground under a free trunk; None on the bench, without contacts.
            checked: False to build it even if the step is too large; see `largest_timestep`.

        Raises:
            RobotError: Parameters of another robot, or a robot that cannot be simulated.
        """
        if sim_params.robot != robot.name:
            raise RobotError(
                f"the parameters are of {sim_params.robot!r}, the robot is {robot.name!r}; give a "
                "file written for that robot."
            )
        sim_params.check_joints(robot.joint_names)
        names: list[str] = []
        drives: list[Drive] = []
        params: list[JointParams] = []
        columns: list[int] = []
        for column, joint in enumerate(robot.joints):
            if limb_of(robot, joint.name) in legs:
                names.append(joint.name)
                drives.append(joint.drive)
                params.append(sim_params.joints[joint.name])
                columns.append(column)
        model = _compiled_model(robot, sim_params, names, timestep_s, ground)
        self.model: Any = model  # mujoco.MjModel
        self.feet = _ids([])
        """Geoms of the feet; none on the bench."""
        if ground is not None:
            self.feet = _ids([model.geom(f"{leg}_foot_collision").id for leg in legs])
            ground.set_contact(model, self.feet)
        self.scratch = mujoco.MjData(model)
        """Data to compute in, beside those of the run."""
        self.joints = tuple(names)
        """Joints in the plant, in file order."""
        self.columns = _ids(columns)
        """Places of the plant's joints among those of the robot."""
        rotors = [model.joint(f"{name}/rotor").id for name in names]
        self.rotor = _ids(model.jnt_dofadr[rotors])
        """Places of the rotors in qvel."""
        self.rotor_qpos = _ids(model.jnt_qposadr[rotors])
        """Places of the rotors in qpos."""
        links = [model.joint(name).id for name in names]
        self.link = _ids(model.jnt_dofadr[links])
        """Places of the links in qvel."""
        self.link_qpos = _ids(model.jnt_qposadr[links])
        """Places of the links in qpos."""
        # Stiffness [N m/rad] and angle [rad] of the springs of the model's own joints.
        self._spring = model.jnt_stiffness[links].copy()
        self._spring_angle = model.qpos_spring[self.link_qpos].copy()
        self.actuator = _ids([model.actuator(f"{name}/motor").id for name in names])
        """Places of the motors in ctrl."""
        # Places of the currents in act. LuGre's bristle comes first among a motor's states, its
        # current last.
        states = model.actuator_actadr + model.actuator_actnum
        self._current = _ids(states[self.actuator] - 1)
        self.stand = _ids([])
        """Places of the stand's roll, pitch, yaw in qpos and qvel; none of a rigid stand, and on
        the ground."""
        if ground is None and math.isfinite(sim_params.fixture.stand_stiffness):
            self.stand = _ids([model.joint(name).dofadr[0] for name in _STAND_AXES])
        count = len(names)
        # Motor constants K0 that the drives assume [V s/rad].
        self._believed = np.zeros(count)
        self.constant = np.zeros(count)
        """Constant K of each motor [V s/rad]."""
        self.resistance = np.zeros(count)
        """Resistance of each motor [ohm]."""
        self._effort_limit = np.zeros(count)
        # Reflected through the gear [kg m^2], and viscous friction [N m s/rad].
        self._rotor_inertia = np.zeros(count)
        self._viscous = np.zeros(count)
        self._load_friction = np.zeros(count)
        self._gain_scale = np.ones(count)
        self.encoder_offset = np.zeros(count)
        """Reading of each encoder minus the true angle [rad]."""
        for k, (drive, joint_params) in enumerate(zip(drives, params, strict=True)):
            believed, resistance = _motor(
                drive, joint_params, sim_params.machine.drive_lag_s, timestep_s
            )
            self._believed[k] = believed
            self.constant[k] = joint_params.torque_scale * believed
            self.resistance[k] = resistance
            self._effort_limit[k] = joint_params.torque_scale * drive.effort_limit
            self._rotor_inertia[k] = joint_params.rotor_inertia * drive.gear_ratio**2
            self._viscous[k] = joint_params.viscous
            self._gain_scale[k] = joint_params.gain_scale
            self.encoder_offset[k] = joint_params.encoder_offset
            self._load_friction[k] = joint_params.load_friction
        self._lowest_torque = -self._effort_limit
        self._dry_friction = model.actuator_biasprm[self.actuator, _COULOMB : _BREAKAWAY + 1].copy()
        self.has_load_friction = bool(self._load_friction.any())
        """Whether the dry friction of a joint grows with its torque."""
        self.inverters = model.actuator_gainprm[:, _VMAX]
        """Voltages at which the inverters clip, a view; every actuator of the plant is a motor
        [V]."""
        self.state_size = int(model.nq + model.nv + model.na + 1)
        """Numbers in a raw state: positions, velocities, activations, bus voltage."""
        self._rotor_mass = model.body_mass[model.dof_bodyid[self.rotor]].copy()
        damping = np.array([robot.joint(name).damping for name in names])
        self.largest_timestep = self._largest_timestep(params, damping * self._gain_scale)
        """Largest physics step at which belts, friction and drives can be simulated [s]."""
        self._params = params
        if checked:
            self.check_springs()

    def _mobilities(self) -> tuple[Array, Array]:
        """Return what a torque accelerates, of rotors and belts [1 / (kg m^2)], (joints,) each."""
        model = self.model
        data = mujoco.MjData(model)
        inertia = np.zeros((model.nv, model.nv))
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, inertia)
        mobility = np.diag(np.linalg.inv(inertia))
        return mobility[self.rotor], mobility[self.rotor] + mobility[self.link]

    def _largest_timestep(self, joints: list[JointParams], damping: Array) -> float:
        """Compute `largest_timestep` from the drives' nominal damping [N m s/rad], (joints,)."""
        rotors, belts = self._mobilities()
        largest = math.inf
        for k, joint in enumerate(joints):
            fastest = math.sqrt(
                max(joint.belt_stiffness * belts[k], joint.presliding_stiffness * rotors[k])
            )
            largest = min(largest, _STABLE / fastest)
            if damping[k]:
                largest = min(largest, _DAMPED / (damping[k] * rotors[k]))
        return largest

    def check_springs(self) -> None:
        """Refuse springs that the physics step cannot follow, and belts that hold no link.

        Raises:
            RobotError: There is one; the message names field and limit.
        """
        rotors, belts = self._mobilities()
        for name, joint, rotor, belt in zip(self.joints, self._params, rotors, belts, strict=True):
            self._check_spring(f"{name}.belt_stiffness", joint.belt_stiffness, belt)
            self._check_spring(f"{name}.presliding_stiffness", joint.presliding_stiffness, rotor)
            lowest = (2.0 * math.pi * _SOFTEST_HZ) ** 2 / belt
            if joint.belt_stiffness < lowest:
                raise RobotError(
                    f"joints.{name}.belt_stiffness is {joint.belt_stiffness:g}; rotor and link "
                    f"would swing on it at less than {_SOFTEST_HZ:g} Hz; expected at least "
                    f"{lowest:.3g} N m/rad."
                )

    def _check_spring(self, field: str, stiffness: float, mobility: float) -> None:
        """Refuse a spring [N m/rad] on a mobility [1 / (kg m^2)] that is too stiff for the step."""
        timestep = self.model.opt.timestep
        highest = (_STABLE / timestep) ** 2 / mobility
        if stiffness > highest:
            raise RobotError(
                f"joints.{field} is {stiffness:g}; at a physics step of {timestep:g} s at most "
                f"{highest:.3g} N m/rad can be simulated."
            )

    def read(self, data: Any, voltage: float, row: Array) -> None:
        """Copy the raw state of a mujoco.MjData into a row, shape (state_size,)."""
        mujoco.mj_getState(self.model, data, row[:-1], _STATE)
        row[-1] = voltage

    def unpack(self, rows: Array) -> RawStates:
        """Split raw states (n, state_size)."""
        nq = self.model.nq
        nv = self.model.nv
        return RawStates(
            position=rows[:, :nq],
            velocity=rows[:, nq : nq + nv],
            torque=self.motor_torque(rows[:, nq + nv : -1]),
            voltage=rows[:, -1],
        )

    def set_gains(self, stiffness: Array, damping: Array) -> None:
        """Command the drives' gains [N m/rad, N m s/rad] from the next physics step."""
        stiffness = stiffness * self._gain_scale
        damping = damping * self._gain_scale
        volts = self.resistance / self._believed
        self.model.actuator_gainprm[self.actuator, _KP] = volts * stiffness
        self.model.actuator_gainprm[self.actuator, _KD] = volts * damping - self.constant
        # Second-order time stepping; see the module's docstring.
        explicit = self.constant / self._believed * damping - self._viscous
        half_step = 0.5 * self.model.opt.timestep
        inertia = self._rotor_inertia + half_step * explicit
        self.model.dof_armature[self.rotor] = inertia
        # MuJoCo reads this in its place for a rotor whose parent cannot move.
        self.model.dof_M0[self.rotor] = inertia + self._rotor_mass

    def motor_torque(self, act: Array) -> Array:
        """Compute motor torques without friction.

        Args:
            act: Activations, (..., na).

        Returns:
            Torques [N m], (..., joints).
        """
        torque = self.constant * act.take(self._current, axis=-1)
        np.maximum(torque, self._lowest_torque, out=torque)
        limited: Array = np.minimum(torque, self._effort_limit, out=torque)
        return limited

    def set_load(self, torque: Array) -> None:
        """Add the friction that torques of the motors [N m], (joints,), press out of the gears.

        Friction while slipping and at the onset of slip grow by the same torque.
        """
        added = self._load_friction * np.abs(torque)
        friction = self.model.actuator_biasprm
        friction[self.actuator, _COULOMB] = self._dry_friction[:, 0] + added
        friction[self.actuator, _BREAKAWAY] = self._dry_friction[:, 1] + added

    def set_clamps(
        self, joints: tuple[str, ...], q: Array, stiffness: float, damping: float
    ) -> None:
        """Hold some links where they are; release all others.

        A spring and damper between link and body cost no solver iterations. They take the place of
        the joint's own spring, beside which a fixture is stiff.

        Args:
            joints: Joints whose links are held.
            q: Positions, MuJoCo's qpos.
            stiffness: Stiffness of the spring [N m/rad].
            damping: Damping of the damper [N m s/rad].
        """
        for k, name in enumerate(self.joints):
            dof = self.link[k]
            index = self.link_qpos[k]
            is_clamped = name in joints
            link_joint = self.model.dof_jntid[dof]
            self.model.jnt_stiffness[link_joint] = stiffness if is_clamped else self._spring[k]
            self.model.dof_damping[dof] = damping if is_clamped else 0.0
            self.model.qpos_spring[index] = q[index] if is_clamped else self._spring_angle[k]


def legs_of(robot: RobotSpec) -> tuple[str, ...]:
    """Return the names of the robot's limbs in file order; see `limb_of`."""
    legs: list[str] = []
    for joint in robot.joints:
        leg = limb_of(robot, joint.name)
        if leg not in legs:
            legs.append(leg)
    return tuple(legs)


def limb_of(robot: RobotSpec, name: str) -> str:
    """Return the limb of a joint: its leg, else what its joints' names begin with or its first."""
    for leg in robot.legs:
        if name.startswith(f"{leg}_"):
            return leg
    joint = robot.joint(name)
    limb_joints = (name, *joint.chain, *joint.clamped)
    limb = [joint_name for joint_name in robot.joint_names if joint_name in limb_joints]
    prefix = limb[0].split("_")[0]
    for joint_name in limb:
        if joint_name.split("_")[0] != prefix:
            return limb[0]
    return prefix


def _compiled_model(
    robot: RobotSpec,
    sim_params: SimParams,
    names: list[str],
    timestep_s: float,
    ground: Ground | None,
) -> Any:
    """Compile the model of a plant with the joints `names`; arguments are those of `Plant`."""
    spec = robot.build_spec()
    spec.option.timestep = timestep_s
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    for key in list(spec.keys):
        spec.delete(key)
    if ground is None:
        _fix_base(spec, robot, sim_params.fixture)
    else:
        _free_base(spec, robot, ground)
    _drop_legs(spec, robot, names)
    for name in names:
        drive = robot.joint(name).drive
        _add_rotor(spec, name, drive, sim_params.joints[name], sim_params.machine.drive_lag_s)
    model = spec.compile()
    free_joints = 0 if ground is None else 1
    if model.nq != model.nv + free_joints:
        raise RobotError(f"{robot.name}: the virtual robot has hinge joints only.")
    # Mass and inertia by the same factor: a body that was possible stays possible.
    for name in names:
        scale = sim_params.joints[name].link_inertia_scale
        body = int(model.jnt_bodyid[model.joint(name).id])
        model.body_mass[body] *= scale
        model.body_inertia[body] *= scale
    if ground is not None:
        _change_trunk(model, model.body(robot.base_body).id, sim_params.trunk)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def _motor(
    drive: Drive, params: JointParams, lag_s: float, timestep_s: float
) -> tuple[float, float]:
    """Return constant [V s/rad] and resistance [ohm] with which the step is stable at the clip.

    The current follows the voltage over the lag t, in each step h by 1 - a, a = t / (t + h). With
    the back-EMF damping d on the rotor's inertia I, the two states are stable below
    h d / I = 2 (1 + a) / (1 - a). Where d is larger than a share of that, constant and resistance
    are both divided by what it is larger, which leaves the torque at standstill as it is.
    """
    constant, resistance = drive.motor
    rotor_inertia = params.rotor_inertia * drive.gear_ratio**2
    largest_damping = 2.0 * (2.0 * lag_s / timestep_s + 1.0) * rotor_inertia / timestep_s
    back_emf_damping = (params.torque_scale * constant) ** 2 / resistance
    excess = back_emf_damping / (_BACK_EMF * largest_damping)
    if excess <= 1.0:
        return constant, resistance
    return constant / excess, resistance / excess


def _add_rotor(spec: Any, name: str, drive: Drive, params: JointParams, lag_s: float) -> None:
    """Give a joint its rotor, belt and motor: `NAME/rotor`, `NAME/belt`, `NAME/motor`."""
    link = spec.joint(name)
    if link is None:
        raise RobotError(f"the robot's model has no joint {name!r}.")
    rotor_inertia = params.rotor_inertia * drive.gear_ratio**2
    rotor_mass = min(_ROTOR_MASS, _ROTOR_SHARE * rotor_inertia)
    rotor_body = link.parent.parent.add_body(
        name=f"{name}/rotor",
        pos=link.parent.pos,
        quat=link.parent.quat,
        mass=rotor_mass,
        inertia=[rotor_mass] * 3,
        ipos=link.pos,
        explicitinertial=True,
    )
    rotor_body.add_joint(
        name=f"{name}/rotor",
        type=mujoco.mjtJoint.mjJNT_HINGE,
        axis=link.axis,
        pos=link.pos,
        armature=rotor_inertia,
        damping=[params.viscous, 0, 0],
        limited=mujoco.mjtLimited.mjLIMITED_FALSE,
    )
    # Of the training model's joint its axis, its stops and its spring remain.
    link.armature = 0.0
    link.frictionloss = 0.0
    link.damping = [0.0, 0.0, 0.0]
    # A mechanical stop is hard: the model's gives way by 0.4 rad under the weight of the trunk.
    link.solref_limit = [_STOP_S, 1.0]
    belt = spec.add_tendon(
        name=f"{name}/belt",
        stiffness=[params.belt_stiffness, 0, 0],
        damping=[params.belt_damping, 0, 0],
        springlength=[0.0, 0.0],
    )
    belt.wrap_joint(f"{name}/rotor", 1.0)
    belt.wrap_joint(name, -1.0)
    believed, resistance = _motor(drive, params, lag_s, spec.option.timestep)
    # MuJoCo integrates the current exactly over a step h with time constant t, and applies it in
    # that very step: late by h / (exp(h / t) - 1) at low frequency. Solved for t.
    lag = spec.option.timestep / math.log1p(spec.option.timestep / lag_s)
    motor = spec.add_actuator(
        name=f"{name}/motor", target=f"{name}/rotor", trntype=mujoco.mjtTrn.mjTRN_JOINT
    )
    motor.set_to_dcmotor(
        # A second constant other than zero would silently become their geometric mean.
        motorconst=[params.torque_scale * believed, 0.0],
        resistance=resistance,
        saturation=[params.torque_scale * drive.effort_limit, 0.0, 0.0],
        # kp, ki, kd, slew limit, integral limit, voltage limit; gains are set by set_gains().
        controller=[0.0, 0.0, 0.0, 0.0, 0.0, drive.bus_voltage],
        lugre=[
            params.presliding_stiffness,
            params.presliding_damping,
            params.coulomb,
            params.breakaway,
            params.stribeck_speed,
        ],
        # Inductance over resistance stands for all that delays torque inside the drive.
        inductance=[0.0, lag],
        input_mode=1,  # ctrl is a position
    )


def _drop_legs(spec: Any, robot: RobotSpec, names: list[str]) -> None:
    """Delete every subtree under the base that has joints, but none of those named."""
    for child in list(spec.body(robot.base_body).bodies):
        child_joints = [*child.find_all("joint"), *child.joints]
        child_names = {joint.name for joint in child_joints}
        if child_names and child_names.isdisjoint(names):
            spec.delete(child)


def _free_base(spec: Any, robot: RobotSpec, ground: Ground) -> None:
    """Put a model's free trunk over the ground; refuse an arm."""
    base = spec.body(robot.base_body)
    if [joint.type for joint in base.joints] != [mujoco.mjtJoint.mjJNT_FREE]:
        raise RobotError(
            f"{robot.name} has no legs to stand on; it can be simulated on the bench only."
        )
    # Visual geoms cost time in every step.
    for geom in list(spec.geoms):
        if not geom.contype and not geom.conaffinity:
            spec.delete(geom)
    ground.add_to(spec)


def _fix_base(spec: Any, robot: RobotSpec, fixture: FixtureParams) -> None:
    """Fix a model's trunk to its stand, without contacts."""
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    base = spec.body(robot.base_body)
    for joint in list(base.joints):
        spec.delete(joint)
    if math.isfinite(fixture.stand_stiffness):
        for name, axis in _STAND_AXES.items():
            base.add_joint(
                name=name,
                type=mujoco.mjtJoint.mjJNT_HINGE,
                axis=axis,
                stiffness=[fixture.stand_stiffness, 0, 0],
                damping=[fixture.stand_damping, 0, 0],
                limited=mujoco.mjtLimited.mjLIMITED_FALSE,
            )


def _change_trunk(model: Any, body: int, trunk: TrunkParams) -> None:
    """Apply the trunk's parameters; refuse an impossible body."""
    mass = float(model.body_mass[body])
    if not mass + trunk.mass_offset > 0.0:
        raise RobotError(
            f"trunk.mass_offset is {trunk.mass_offset:g} kg; the trunk has {mass:.3g} kg, of which "
            "something must be left."
        )
    # MuJoCo's principal moments are sorted; those of the parameters are about x, y, z.
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, model.body_iquat[body])
    nearest_axes = np.abs(axes.reshape(3, 3)).argmax(axis=0)
    moments = model.body_inertia[body] * np.array(trunk.inertia_scale)[nearest_axes]
    if 2.0 * moments.max() > moments.sum():
        moments_text = ", ".join(f"{moment:.4g}" for moment in moments)
        raise RobotError(
            f"trunk.inertia_scale is {list(trunk.inertia_scale)}; the principal moments would be "
            f"{moments_text} kg m^2, of which the largest exceeds the "
            "sum of the others, as no body's does."
        )
    model.body_inertia[body] = moments * (1.0 + trunk.mass_offset / mass)
    model.body_mass[body] = mass + trunk.mass_offset
    model.body_ipos[body] += trunk.com_offset


def _ids(values: Any) -> Indices:
    """Return indices as an array."""
    return np.array(values, dtype=np.intp)
