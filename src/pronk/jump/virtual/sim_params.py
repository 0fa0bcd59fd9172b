"""The hidden parameters of a virtual robot: how it differs from the model of match and training.

Joint quantities are in joint coordinates (through the gear) unless noted otherwise. Vectors are in
the trunk's frame: x forward, y left, z up.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any

import msgspec
import mujoco
import numpy as np
from msgspec import Meta

from pronk.errors import RobotError
from pronk.files import read_yaml
from pronk.jump.virtual.bounds import Bounded, read
from pronk.jump.virtual.ground import Ground
from pronk.robots.model import bench_spec
from pronk.robots.robot import Joint, RobotSpec

SCHEMA = "pronk/sim_params/1"
SHIPPED_ROBOT = "mini_cheetah"
SHIPPED = Path(__file__).with_name("mini_cheetah_sim_params.yaml")

# Bounds exclude errors by a factor of ten or more in a file.
_Share = Annotated[float, Meta(ge=0.1, le=10.0)]
_UpTo10 = Annotated[float, Meta(ge=0.0, le=10.0)]
_UpTo100 = Annotated[float, Meta(ge=0.0, le=100.0)]
_Delay = Annotated[float, Meta(ge=0.0, le=0.5)]
_Jitter = Annotated[float, Meta(ge=0.0, le=1e-3)]
_Span = Annotated[float, Meta(ge=1e-6, le=0.1)]
_Spring = Annotated[float, Meta(ge=1.0, le=1e5)]
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
    rotor_inertia: Annotated[float, Meta(ge=1e-9, le=1.0)]
    """Inertia of the rotor about its own axis, motor side [kg m^2]."""
    belt_stiffness: _Spring
    """Between rotor (reflected) and link [N m/rad]."""
    belt_damping: _UpTo100
    """Between rotor (reflected) and link [N m s/rad]."""
    coulomb: _UpTo100
    """Dry friction of the rotor while it slips [N m]."""
    breakaway: _UpTo100
    """Dry friction at the onset of slip; the Stribeck peak, not below `coulomb` [N m]."""
    stribeck_speed: Annotated[float, Meta(ge=1e-6, le=100.0)]
    """Speed at which the peak has fallen to 1/e of its height over `coulomb` [rad/s]."""
    presliding_stiffness: Annotated[float, Meta(ge=1e-3, le=1e6)]
    """Of the bristles before slip, LuGre sigma_0 [N m/rad]."""
    presliding_damping: _UpTo100
    """Of the bristles, LuGre sigma_1 [N m s/rad]."""
    viscous: _UpTo100
    """Viscous friction of the rotor [N m s/rad]."""
    encoder_offset: Annotated[float, Meta(ge=-0.1, le=0.1)]
    """Reading minus true angle; the drive closes its loop on the reading [rad]."""

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
    """What the joints share: timing, supply, sensors, the stand."""

    command_delay_s: _Delay
    """From sending a command to the drives acting on it [s]."""
    measurement_delay_s: _Delay
    """From the instant a state was measured to its timestamp [s]."""
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
    """Of battery and wiring [ohm]."""
    encoder_bits: Annotated[int, Meta(ge=4, le=32)]
    """Of the absolute encoder on each rotor, motor side [bit per revolution]."""
    velocity_window_s: _Span
    """Span over which a drive differentiates its encoder [s]."""
    velocity_noise: _UpTo10
    """White, standard deviation [rad/s]."""
    position_noise: Annotated[float, Meta(ge=0.0, le=0.1)]
    """Coloured (vibration of the encoder mount), standard deviation [rad]."""
    position_noise_corner_hz: Annotated[float, Meta(ge=0.1, le=1e5)]
    """Corner of the first-order low-pass that colours it [Hz]."""
    torque_noise: _UpTo10
    """White, of the current measurement as torque, standard deviation [N m]."""
    gyro_noise: _UpTo10
    """White, standard deviation per sample [rad/s]."""
    gyro_bias: tuple[_Rate, _Rate, _Rate]
    """[rad/s]"""
    accelerometer_noise: _UpTo10
    """White, standard deviation per sample [m/s^2]."""
    accelerometer_bias: tuple[_Force, _Force, _Force]
    """[m/s^2]"""
    clamp_stiffness: _Spring
    """Of the fixture that holds a clamped link [N m/rad]."""
    clamp_damping: Annotated[float, Meta(ge=0.0, le=1e3)]
    """[N m s/rad]"""
    stand_stiffness: Annotated[float, Meta(ge=100.0)]
    """Of the stand under the body, about each axis; .inf is rigid [N m/rad]."""
    stand_damping: Annotated[float, Meta(ge=0.0, le=1e3)]
    """[N m s/rad]; of no effect with a rigid stand."""


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
    machine: MachineParams
    joints: Mapping[str, JointParams]
    trunk: TrunkParams = field(default_factory=TrunkParams)
    attitude: AttitudeParams = field(default_factory=AttitudeParams)
    ground: Ground = field(default_factory=Ground)

    def check_joints(self, names: Iterable[str], source: str = "sim_params") -> None:
        """Refuse parameters that do not hold exactly these joints."""
        wanted = tuple(names)
        for name in (*wanted, *self.joints):
            if (name in wanted) != (name in self.joints):
                wrong = "is missing" if name in wanted else "is unknown"
                raise RobotError(
                    f"{source}: joints.{name} {wrong}; the joints of {self.robot} are "
                    f"{', '.join(wanted)}."
                )


def with_changes(sim_params: SimParams, **changes: float) -> SimParams:
    """Copy parameters with other numbers; refuse an unknown name or an impossible value.

    `changes` are `trunk_mass_offset` [kg], `friction` (of the ground), or of `MachineParams`.
    """
    places = {"trunk_mass_offset": ("trunk", "mass_offset"), "friction": ("ground", "friction")}
    numbers = [f.name for f in fields(MachineParams) if not f.name.endswith("_bias")]
    places |= {name: ("machine", name) for name in numbers}
    for name, value in changes.items():
        if name not in places:
            raise RobotError(f"no parameter {name!r} to change; there are {', '.join(places)}.")
        part, entry = places[name]
        changed: Any = replace(getattr(sim_params, part), **{entry: value})
        sim_params = replace(sim_params, **{part: changed})
    return sim_params


class _File(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    schema: Annotated[str, Meta(pattern=f"^{SCHEMA}$")]
    robot: str
    machine: Any
    joints: Annotated[dict[str, Any], Meta(min_length=1)]
    trunk: Any = {}
    attitude: Any = {}
    ground: Any = {}


def parse_sim_params(body: Any, source: str) -> SimParams:
    """Read parameters from the content of a YAML file, which errors call `source`."""
    try:
        file = msgspec.convert(body, _File)
    except msgspec.ValidationError as error:
        known = ", ".join(_File.__struct_fields__)
        raise RobotError(f"{source}: {error}; the entries are {known}.") from None
    return SimParams(
        robot=file.robot,
        machine=read(MachineParams, f"{source}: machine", file.machine),
        joints={
            name: read(JointParams, f"{source}: joints.{name}", entry)
            for name, entry in file.joints.items()
        },
        trunk=read(TrunkParams, f"{source}: trunk", file.trunk),
        attitude=read(AttitudeParams, f"{source}: attitude", file.attitude),
        # Terrain belongs to a scene, not to a machine.
        ground=read(Ground, f"{source}: ground", file.ground, without=("terrain", "floor")),
    )


def load_sim_params(path: Path | str | None = None, robot: RobotSpec | None = None) -> SimParams:
    """Read a parameter file, by default the shipped one, whose match is the paper's Table I.

    Without a file, those of another `robot` are `default_sim_params`.
    """
    if path is None and robot is not None and robot.name != SHIPPED_ROBOT:
        return default_sim_params(robot)
    path = SHIPPED if path is None else Path(path)
    body = read_yaml(path, RobotError, f"copy {SHIPPED} and edit it")
    return parse_sim_params(body, str(path))


_RING_HZ = 100.0  # of rotor and link against each other; above all excitation
_PRESLIDING_RAD = 1e-3  # deflection at which dry friction breaks away


def default_sim_params(robot: RobotSpec) -> SimParams:
    """Derive the hidden parameters of a robot that has no file of its own, for the bench.

    Tolerances are of the size that the virtual Mini Cheetah has. Timing and noise are those of the
    shipped file, the encoders as fine at the joint as its hips'.
    """
    shipped = load_sim_params(SHIPPED).machine
    drives = [joint.drive for joint in robot.joints]
    gear = min(drive.gear_ratio for drive in drives)
    machine = replace(
        shipped,
        bus_voltage=max(drive.bus_voltage for drive in drives),
        bus_resistance=0.0,
        encoder_bits=min(24, 14 + max(0, math.ceil(math.log2(6.0 / gear)))),
        torque_noise=min(shipped.torque_noise, 0.003 * min(d.effort_limit for d in drives)),
    )
    joints = {joint.name: _default_joint(robot, joint) for joint in robot.joints}
    return SimParams(robot=robot.name, machine=machine, joints=joints)


def _default_joint(robot: RobotSpec, joint: Joint) -> JointParams:
    model = bench_spec(robot, joint.name).compile()
    data, full = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    mujoco.mj_resetDataKeyframe(model, data, model.key("default").id)
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, full)
    dof = int(model.joint(joint.name).dofadr[0])
    # Inertia of the link at the belt, the others of its chain free to move.
    link = 1.0 / float(np.linalg.inv(full)[dof, dof]) - float(model.dof_armature[dof])
    link = max(link, 0.1 * float(full[dof, dof] - model.dof_armature[dof]))
    rotor = 0.9 * joint.drive.armature or 0.1 * link  # where the model has none
    reduced = rotor * link / (rotor + link)
    belt = (2.0 * math.pi * _RING_HZ) ** 2 * reduced
    coulomb = max(0.8 * joint.drive.frictionloss, 0.002 * joint.drive.effort_limit)
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
