"""The hidden parameters of a virtual robot: how it differs from the model of match and training.

Joint quantities are in joint coordinates (through the gear) unless noted otherwise. Vectors are in
the trunk's frame: x forward, y left, z up.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import msgspec
import mujoco
import numpy as np
from msgspec import Meta

from pronk.errors import RobotError
from pronk.files import read_yaml
from pronk.jump.virtual.bounds import Bounded, read_bounded
from pronk.jump.virtual.ground import Ground
from pronk.robots.model import bench_spec
from pronk.robots.robot import Joint, RobotSpec

SCHEMA = "pronk/sim_params/2"
SHIPPED_ROBOT = "mini_cheetah"
"""Robot whose parameters are taken where none is named."""
SHIPPED = Path(__file__).with_name("mini_cheetah_sim_params.yaml")
"""File of the shipped parameters."""
SHIPPED_FILES = {SHIPPED_ROBOT: SHIPPED, "go2": Path(__file__).with_name("go2_sim_params.yaml")}
"""Files of parameters of the robots that have one."""

# Bounds exclude errors by a factor of ten or more in a file. Those of joints hold for every size,
# from the whisker of a rodent to a leg of fifty kilograms, so that what must not be 0 has no other
# lower bound; `Plant` refuses what does not suit the links.
_Spring = Annotated[float, Meta(gt=0.0, le=1e11)]
_Torque = Annotated[float, Meta(ge=0.0, le=1e5)]
_Share = Annotated[float, Meta(ge=0.1, le=10.0)]
_UpTo10 = Annotated[float, Meta(ge=0.0, le=10.0)]
_Delay = Annotated[float, Meta(ge=0.0, le=0.5)]
_Jitter = Annotated[float, Meta(ge=0.0, le=1e-3)]
_Span = Annotated[float, Meta(ge=1e-6, le=0.1)]
_Rate = Annotated[float, Meta(ge=-1.0, le=1.0)]
_Force = Annotated[float, Meta(ge=-5.0, le=5.0)]
_Offset = Annotated[float, Meta(ge=-0.2, le=0.2)]
_Angle = Annotated[float, Meta(ge=-0.5, le=0.5)]


@dataclass(frozen=True, kw_only=True)
class JointParams(Bounded):
    """One joint of the virtual robot."""

    torque_scale: _Share
    """Torque that the motor gives per torque that its drive computes [1]."""
    link_inertia_scale: _Share
    """Mass and inertia of the link this joint moves, relative to the model's [1]."""
    rotor_inertia: Annotated[float, Meta(gt=0.0, le=1e3)]
    """Inertia of the rotor about its own axis, motor side [kg m^2]."""
    belt_stiffness: _Spring
    """Stiffness of the belt between rotor (reflected) and link [N m/rad]."""
    belt_damping: _Torque
    """Damping of the belt between rotor (reflected) and link [N m s/rad]."""
    coulomb: _Torque
    """Dry friction of the rotor while it slips [N m]."""
    breakaway: _Torque
    """Dry friction at the onset of slip; the Stribeck peak, not below `coulomb` [N m]."""
    stribeck_speed: Annotated[float, Meta(ge=1e-6, le=100.0)]
    """Speed at which the peak has fallen to 1/e of its height over `coulomb` [rad/s]."""
    presliding_stiffness: Annotated[float, Meta(gt=0.0, le=1e9)]
    """Stiffness of the bristles before slip, LuGre sigma_0 [N m/rad]."""
    presliding_damping: _Torque
    """Damping of the bristles, LuGre sigma_1 [N m s/rad]."""
    viscous: _Torque
    """Viscous friction of the rotor [N m s/rad]."""
    load_friction: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0
    """Dry friction that the torque through the gear adds, per torque of the motor [1]."""
    encoder_offset: Annotated[float, Meta(ge=-0.1, le=0.1)]
    """Reading minus true angle; the drive closes its loop on the reading [rad]."""
    gain_scale: _Share = 1.0
    """Stiffness and damping that the drive applies per those commanded; its torque limits stay [1].
    """

    def __post_init__(self) -> None:
        """Refuse a joint that cannot exist."""
        super().__post_init__()
        if self.breakaway < self.coulomb:
            raise RobotError(
                f"breakaway is {self.breakaway:g}, below coulomb = {self.coulomb:g}; "
                "friction at the onset of slip is never below that while slipping."
            )


@dataclass(frozen=True, kw_only=True)
class MachineParams(Bounded):
    """What the joints share: timing, supply and the sensors of the drives."""

    command_delay_s: _Delay
    """Time from sending a command to the drives acting on it [s]."""
    measurement_delay_s: _Delay
    """Time from the instant a state was measured to its timestamp [s]."""
    sampling_jitter_s: _Jitter
    """Standard deviation of the sampling instant about its tick, contained in timestamps [s]."""
    timestamp_error_s: _Jitter
    """Standard deviation of the timestamp about the sampling instant plus delay [s]."""
    drive_lag_s: _Span
    """Time constant from a drive's torque command to its motor's torque: sampling, averaging of
    the speed, current loop [s]."""
    bus_voltage: Annotated[float, Meta(ge=1.0, le=1e3)]
    """Open-circuit voltage of the battery [V]."""
    bus_resistance: _UpTo10
    """Resistance of battery and wiring [ohm]."""
    encoder_bits: Annotated[int, Meta(ge=4, le=32)]
    """Resolution of the absolute encoder on each rotor, motor side [bit per revolution]."""
    velocity_window_s: _Span
    """Span over which a drive differentiates its encoder [s]."""
    velocity_noise: _UpTo10
    """Standard deviation of the drives' speed, white [rad/s]."""
    position_noise: Annotated[float, Meta(ge=0.0, le=0.1)]
    """Standard deviation of the angle, coloured (vibration of the encoder mount) [rad]."""
    position_noise_corner_hz: Annotated[float, Meta(ge=0.1, le=1e5)]
    """Corner of the first-order low-pass that colours it [Hz]."""
    torque_noise: _UpTo10
    """Standard deviation of the current measurement as torque, white [N m]."""


@dataclass(frozen=True, kw_only=True)
class ImuParams(Bounded):
    """Errors of the gyroscope and the accelerometer."""

    gyro_noise: _UpTo10
    """Standard deviation of a sample of the gyroscope, white [rad/s]."""
    gyro_bias: tuple[_Rate, _Rate, _Rate]
    """Constant error of the gyroscope [rad/s]."""
    accelerometer_noise: _UpTo10
    """Standard deviation of a sample of the accelerometer, white [m/s^2]."""
    accelerometer_bias: tuple[_Force, _Force, _Force]
    """Constant error of the accelerometer [m/s^2]."""


@dataclass(frozen=True, kw_only=True)
class FixtureParams(Bounded):
    """What holds the robot on the bench."""

    clamp_stiffness: _Spring
    """Stiffness of the fixture that holds a clamped link [N m/rad]."""
    clamp_damping: _Torque
    """Damping of that fixture [N m s/rad]."""
    stand_stiffness: Annotated[float, Meta(ge=100.0)]
    """Stiffness of the stand under the body, about each axis; .inf is rigid [N m/rad]."""
    stand_damping: Annotated[float, Meta(ge=0.0, le=1e3)]
    """Damping of the stand, without effect if it is rigid [N m s/rad]."""


@dataclass(frozen=True, kw_only=True)
class TrunkParams(Bounded):
    """How the trunk differs from the model's; of no effect on the bench."""

    mass_offset: Annotated[float, Meta(ge=-50.0, le=50.0)] = 0.0
    """Added to the trunk's mass; its inertia grows alike [kg]."""
    com_offset: tuple[_Offset, _Offset, _Offset] = (0.0, 0.0, 0.0)
    """Added to its centre of mass [m]."""
    inertia_scale: tuple[_Share, _Share, _Share] = (1.0, 1.0, 1.0)
    """Its principal moments (about x, y, z) relative to the model's, beyond `mass_offset` [1].
    Together they must still be those of a body: the largest not above the sum of the others."""


@dataclass(frozen=True, kw_only=True)
class AttitudeParams(Bounded):
    """Errors of the machine's own attitude filter."""

    bias: tuple[_Angle, _Angle, _Angle] = (0.0, 0.0, 0.0)
    """Constant part, as a small rotation about the trunk's axes [rad]."""
    noise: Annotated[float, Meta(ge=0.0, le=0.5)] = 0.0
    """Slowly varying part about each axis, standard deviation [rad]."""
    noise_corner_hz: Annotated[float, Meta(ge=1e-3, le=1e3)] = 0.3
    """Corner of the first-order low-pass that colours it [Hz]."""
    yaw_drift: Annotated[float, Meta(ge=-1.0, le=1.0)] = 0.0
    """Drift of the heading, which no sensor corrects [rad/s]."""


@dataclass(frozen=True, kw_only=True)
class SimParams:
    """All hidden parameters of a virtual robot."""

    robot: str
    """Name of the robot."""
    machine: MachineParams
    """What the joints share."""
    imu: ImuParams
    """Errors of gyroscope and accelerometer."""
    fixture: FixtureParams
    """What holds the robot on the bench."""
    joints: Mapping[str, JointParams]
    """Each joint by name."""
    trunk: TrunkParams = field(default_factory=TrunkParams)
    """How the trunk differs from the model's."""
    attitude: AttitudeParams = field(default_factory=AttitudeParams)
    """Errors of the attitude filter."""
    ground: Ground = field(default_factory=Ground)
    """The ground that it stands on."""

    def check_joints(self, names: Sequence[str], source: str = "sim_params") -> None:
        """Refuse parameters that do not hold exactly these joints."""
        for name in names:
            if name not in self.joints:
                raise RobotError(
                    f"{source}: joints.{name} is missing; the joints of {self.robot} are "
                    f"{', '.join(names)}."
                )
        for name in self.joints:
            if name not in names:
                raise RobotError(
                    f"{source}: joints.{name} is unknown; the joints of {self.robot} are "
                    f"{', '.join(names)}."
                )


class _File(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """Content of a parameter file."""

    schema: Annotated[str, Meta(pattern=f"^{SCHEMA}$")]
    robot: str
    machine: Any
    imu: Any
    fixture: Any
    joints: Annotated[dict[str, Any], Meta(min_length=1)]
    trunk: Any = {}
    attitude: Any = {}
    ground: Any = {}


def parse_sim_params(body: Any, source: str) -> SimParams:
    """Read parameters from the content of a YAML file.

    Args:
        body: The content.
        source: Name of the file, for errors.

    Raises:
        RobotError: Content that is not a valid file of parameters.
    """
    if isinstance(body, Mapping) and body.get("schema") == "pronk/sim_params/1":
        raise RobotError(
            f"{source}: schema pronk/sim_params/1; this pronk reads {SCHEMA}, in which gyro_* and "
            "accelerometer_* have left `machine` for a section `imu`, and clamp_* and stand_* for "
            "a section `fixture`."
        )
    try:
        file = msgspec.convert(body, _File)
    except msgspec.ValidationError as error:
        entries = ", ".join(_File.__struct_fields__)
        raise RobotError(f"{source}: {error}; the entries are {entries}.") from None
    joints = {}
    for name, entry in file.joints.items():
        joints[name] = read_bounded(JointParams, f"{source}: joints.{name}", entry)
    # Terrain belongs to a scene, not to a machine.
    ground = read_bounded(Ground, f"{source}: ground", file.ground, excluded=("terrain", "floor"))
    return SimParams(
        robot=file.robot,
        machine=read_bounded(MachineParams, f"{source}: machine", file.machine),
        imu=read_bounded(ImuParams, f"{source}: imu", file.imu),
        fixture=read_bounded(FixtureParams, f"{source}: fixture", file.fixture),
        joints=joints,
        trunk=read_bounded(TrunkParams, f"{source}: trunk", file.trunk),
        attitude=read_bounded(AttitudeParams, f"{source}: attitude", file.attitude),
        ground=ground,
    )


def load_sim_params(path: Path | str | None = None, robot: RobotSpec | None = None) -> SimParams:
    """Read a parameter file.

    Args:
        path: The file; None for the one shipped for the robot. Without a robot it is the Mini
            Cheetah's, whose match is the paper's Table I.
        robot: The robot, of which `default_sim_params` are returned where there is no file.

    Raises:
        RobotError: The file is missing or not a valid file of parameters.
    """
    if path is not None:
        return _parse_file(Path(path))
    if robot is None:
        return _parse_file(SHIPPED)
    file = shipped_file(robot)
    return default_sim_params(robot) if file is None else _parse_file(file)


def shipped_file(robot: RobotSpec) -> Path | None:
    """Return the file of parameters that is shipped for a robot; None without one.

    A robot of the same name with other joints, so another model, has none.
    """
    file = SHIPPED_FILES.get(robot.name)
    if file is None or set(_parse_file(file).joints) != set(robot.joint_names):
        return None
    return file


def _parse_file(path: Path) -> SimParams:
    """Read one file of parameters."""
    body = read_yaml(path, RobotError, f"copy {SHIPPED} and edit it")
    return parse_sim_params(body, str(path))


_RING_HZ = 100.0
"""Frequency of rotor and link against each other, above all excitation, at least [Hz]."""
_BELT_SHARE = 25.0
"""Stiffness of the belt over that of the drive, at least, for the share of the inertia that the
belt carries: the link swings on its belt at five times the frequency of the joint on its drive, or
more. That of the shipped robots is 90 to 650."""
_BELT_S = 0.7e-3
"""Damping of a drive over the stiffness of the belt, at most, for the share of the inertia that the
belt carries [s]: the time for which a step of the command turns a light rotor ahead of its link, at
a speed that the plan of a rigid joint does not have. That of the shipped robots is below 0.3 ms."""
_LIGHT = 8.0
"""Stiffness of the belt over that of the drive, times the inertia of the rotor over that of the
link, at least: of a step of the command the rotor then runs ahead of its link no faster than the
joint itself turns."""
_STIFFEST = 100.0
"""Largest stiffness of the belt over that of the drive that is taken for this, so that the physics
step need not follow rotors far lighter than any motor's."""
_ROTOR_S = 0.25e-3
"""Least inertia of a rotor over the damping of its drive [s]. A drive stops a lighter rotor within
less than its own lag, which no real drive can. At 25 Hz the inertia that this adds to a joint takes
4 % of the torque of the damping."""
_FASTEST_RAD_S = 1e3
"""Largest angular frequency of a joint on the spring of its drive, six times the highest of a
sweep: below it, inertia is added to the rotor."""
_PRESLIDING_RAD = 1e-3
"""Deflection at which dry friction breaks away [rad]."""
_FRICTION_RAD = 0.001
"""Angle at which the spring of the drive has the dry friction of a joint, at most, where the
robot's file has no friction [rad]: a fortieth of the smaller amplitude of a sweep that the speed
limit of an arm keeps small. With five times as much, dry friction and its Stribeck peak are what
such a sweep shows, and no gains fit it."""
_SPEED_NOISE = 0.004
"""Noise of the speed over the lowest no-load speed, at most: a sweep ends where a measured speed
exceeds it, and a plan may use all of it."""
_SPEED_QUANTUM = 0.01
"""Quantum of the speed over the no-load speed of a joint, at most."""
_CLAMP_HZ = (30.0, 300.0)
"""Frequencies between which a link swings in the fixture that clamps it [Hz]."""


def default_sim_params(robot: RobotSpec) -> SimParams:
    """Derive the hidden parameters of a robot that has no file of its own, for the bench.

    Tolerances are of the size that the virtual Mini Cheetah has. Timing and noise are those of the
    shipped file, the encoders as fine at the joint as its hips'. Slow joints have finer encoders
    and less noise. What depends on the size of a link (belt, rotor, friction, fixture) is derived
    from it and from the gains of its drive.
    """
    shipped = load_sim_params(SHIPPED)
    drives = [joint.drive for joint in robot.joints]
    smallest_gear_ratio = min(drive.gear_ratio for drive in drives)
    smallest_effort_limit = min(drive.effort_limit for drive in drives)
    slowest = min(drive.no_load_speed for drive in drives)
    window_s = shipped.machine.velocity_window_s
    encoder_bits = 14 + max(0, math.ceil(math.log2(6.0 / smallest_gear_ratio)))
    for drive in drives:
        # Counts of a turn of the motor, whose speed is measured in counts in the window.
        quantum = _SPEED_QUANTUM * drive.no_load_speed * window_s * drive.gear_ratio
        encoder_bits = max(encoder_bits, math.ceil(math.log2(2.0 * math.pi / quantum)))
    links = {}
    joints = {}
    lag_s = shipped.machine.drive_lag_s
    for joint in robot.joints:
        link = _link_inertia(robot, joint)
        links[joint.name] = link
        joints[joint.name] = _default_joint(joint, link)
        rotor = joints[joint.name].rotor_inertia * joint.drive.gear_ratio**2
        # The lag of a drive is shorter than the time in which its damping stops its rotor.
        if joint.damping:
            lag_s = min(lag_s, 0.5 * rotor / joint.damping)
    machine = replace(
        shipped.machine,
        drive_lag_s=lag_s,
        bus_voltage=max(drive.bus_voltage for drive in drives),
        bus_resistance=0.0,
        encoder_bits=min(24, encoder_bits),
        velocity_noise=min(shipped.machine.velocity_noise, _SPEED_NOISE * slowest),
        torque_noise=min(shipped.machine.torque_noise, 0.003 * smallest_effort_limit),
    )
    return SimParams(
        robot=robot.name,
        machine=machine,
        imu=shipped.imu,
        fixture=_default_fixture(robot, links, shipped.fixture),
        joints=joints,
    )


def _link_inertia(robot: RobotSpec, joint: Joint) -> float:
    """Compute the inertia of a joint's link at its belt, without the rotor [kg m^2]."""
    model = bench_spec(robot, joint.name).compile()
    data = mujoco.MjData(model)
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_resetDataKeyframe(model, data, model.key("default").id)
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, inertia)
    dof = int(model.joint(joint.name).dofadr[0])
    # The others of its chain are free to move.
    link = 1.0 / float(np.linalg.inv(inertia)[dof, dof]) - float(model.dof_armature[dof])
    return max(link, 0.1 * float(inertia[dof, dof] - model.dof_armature[dof]))


def _default_fixture(
    robot: RobotSpec, links: Mapping[str, float], shipped: FixtureParams
) -> FixtureParams:
    """Return a fixture that holds the links of a robot; the shipped one where it does."""
    clamped: set[str] = set()
    for joint in robot.joints:
        clamped.update(joint.clamped)
    if not clamped:
        return shipped
    slowest, fastest = 2.0 * math.pi * np.array(_CLAMP_HZ)
    # The lightest link bounds the stiffness, which must not be too much for the physics step.
    stiffness = max(shipped.clamp_stiffness, slowest**2 * max(links[name] for name in clamped))
    stiffness = min(stiffness, fastest**2 * min(links[name] for name in clamped))
    if stiffness == shipped.clamp_stiffness:
        return shipped
    damping = shipped.clamp_damping * stiffness / shipped.clamp_stiffness
    return replace(shipped, clamp_stiffness=stiffness, clamp_damping=damping)


def _default_joint(joint: Joint, link: float) -> JointParams:
    """Derive the hidden parameters of a joint from the inertia of its link [kg m^2]."""
    rotor = 0.9 * joint.drive.armature
    if rotor == 0.0:  # the model has none
        rotor = 0.1 * link
    rotor = max(rotor, _ROTOR_S * joint.damping, joint.stiffness / _FASTEST_RAD_S**2 - link)
    reduced = rotor * link / (rotor + link)
    belt = (2.0 * math.pi * _RING_HZ) ** 2 * reduced
    carried = link / (rotor + link)
    share = max(_BELT_SHARE, min(_STIFFEST, _LIGHT * link / rotor))
    belt = max(belt, share * joint.stiffness * carried, joint.damping / _BELT_S * carried)
    coulomb = min(0.002 * joint.drive.effort_limit, _FRICTION_RAD * joint.stiffness)
    coulomb = max(0.8 * joint.drive.frictionloss, coulomb)
    # No stiffer than the belt's ring allows a light rotor to be simulated.
    bristles = min(1.25 * coulomb / _PRESLIDING_RAD, (2.0 * math.pi * 2.0 * _RING_HZ) ** 2 * rotor)
    return JointParams(
        torque_scale=1.1,
        link_inertia_scale=0.97,
        rotor_inertia=rotor / joint.drive.gear_ratio**2,
        belt_stiffness=belt,
        belt_damping=0.08 * math.sqrt(belt * reduced),  # 4 % of critical
        coulomb=coulomb,
        breakaway=1.25 * coulomb,
        stribeck_speed=0.15,
        presliding_stiffness=bristles,
        presliding_damping=0.67 * math.sqrt(bristles * rotor),
        viscous=1.2 * joint.drive.viscous_damping,
        encoder_offset=1e-3,
    )
