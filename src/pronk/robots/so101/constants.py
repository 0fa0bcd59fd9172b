"""Numbers of the SO-101 follower arm, a source beside each.

Sources:
    [cad]  TheRobotStudio/SO-ARM100, Simulation/SO101 (CAD export, Apache-2.0): chain, masses,
           ranges, and its estimates of the servo.
    [bam]  Rhoban/bam, params/feetech_sts3215_7_4V/m1 (Apache-2.0): servo identified on a pendulum.
    [sage] isaac-sim2real/sage, output/real/so101/custom (Apache-2.0): recordings of a real arm.
"""

from __future__ import annotations

from dataclasses import dataclass

from pronk.robots.inertia import Inertia
from pronk.robots.robot import Drive


@dataclass(frozen=True, kw_only=True)
class Link:
    """One body of the chain and the hinge, about its own z axis, that carries it."""

    body: str
    joint: str
    range: tuple[float, float]
    """Mechanical limits [rad]."""
    pos: tuple[float, float, float]
    """Origin in the parent's frame [m]."""
    quat: tuple[float, float, float, float]
    """Orientation in the parent's frame, w x y z, as printed: not quite normalized."""
    inertia: Inertia


BASE = Inertia(
    mass=0.147,
    com=(0.0137179, -5.19711e-05, 0.0334843),
    products=(0.000114686, 0.000136117, 0.000130364, -4.59787e-07, 4.97151e-06, 9.75275e-08),
)  # [cad]

# [cad], root first.
CHAIN = (
    Link(
        body="shoulder",
        joint="shoulder_pan",
        range=(-1.91986, 1.91986),
        pos=(0.0388353, 0.0, 0.0624),
        quat=(0.0, 0.0, -1.0, 0.0),
        inertia=Inertia(
            mass=0.100006,
            com=(-0.0307604, -1.66727e-05, -0.0252713),
            products=(8.3759e-05, 8.10403e-05, 2.39783e-05, 7.55525e-08, -1.16342e-06, 1.54663e-07),
        ),
    ),
    Link(
        body="upper_arm",
        joint="shoulder_lift",
        range=(-1.74533, 1.74533),
        pos=(-0.0303992, -0.0182778, -0.0542),
        quat=(0.5, -0.5, -0.5, -0.5),
        inertia=Inertia(
            mass=0.103,
            com=(-0.0898471, -0.00838224, 0.0184089),
            products=(
                4.08002e-05,
                0.000147318,
                0.000142487,
                -1.97819e-05,
                -4.03016e-08,
                8.97326e-09,
            ),
        ),
    ),
    Link(
        body="lower_arm",
        joint="elbow_flex",
        range=(-1.69, 1.69),
        pos=(-0.11257, -0.028, 0.0),
        quat=(0.707107, 0.0, 0.0, 0.707107),
        inertia=Inertia(
            mass=0.104,
            com=(-0.0980701, 0.00324376, 0.0182831),
            products=(2.87438e-05, 0.000159844, 0.00014529, 7.41152e-06, 1.26409e-06, -4.90188e-08),
        ),
    ),
    Link(
        body="wrist",
        joint="wrist_flex",
        range=(-1.65806, 1.65806),
        pos=(-0.1349, 0.0052, 0.0),
        quat=(0.707107, 0.0, 0.0, -0.707107),
        inertia=Inertia(
            mass=0.079,
            com=(-0.000103312, -0.0386143, 0.0281156),
            products=(3.68263e-05, 2.5391e-05, 2.1e-05, 1.7893e-08, -5.28128e-08, 3.6412e-06),
        ),
    ),
    Link(
        body="gripper",
        joint="wrist_roll",
        range=(-2.74385, 2.84121),
        pos=(0.0, -0.0611, 0.0181),
        quat=(0.0172091, -0.0172091, 0.706897, 0.706897),
        inertia=Inertia(
            mass=0.087,
            com=(0.000213627, 0.000245138, -0.025187),
            products=(
                2.75087e-05,
                4.33657e-05,
                3.45059e-05,
                -3.35241e-07,
                -5.7352e-06,
                -5.17847e-08,
            ),
        ),
    ),
    Link(
        body="moving_jaw",
        joint="gripper",
        range=(-0.174533, 1.74533),
        pos=(0.0202, 0.0188, -0.0234),
        quat=(0.707107, 0.707107, 0.0, 0.0),
        inertia=Inertia(
            mass=0.012,
            com=(-0.00157495, -0.0300244, 0.0192755),
            products=(
                6.61427e-06,
                1.89032e-06,
                5.28738e-06,
                -3.19807e-07,
                -5.90717e-09,
                -1.09945e-07,
            ),
        ),
    ),
)

# --- Servo: Feetech STS3215, the same at every joint --------------------------------------------

GEAR_RATIO = 345.0  # STS3215 data sheet, 1:345
ARMATURE = 0.028  # [cad] [kg m^2]; [bam] has .0284
BUS_VOLTAGE = 7.4  # supply class of the recordings and of [bam] [V]
JOINT_TORQUE_CONSTANT = 1.2116  # [bam] kt, at the output [N m/A]
RESISTANCE = 2.6762  # [bam] [ohm]
EFFORT_LIMIT = 3.35  # [cad] force range [N m]; it equals the stall torque below
FRICTIONLOSS = 0.052  # [cad] [N m]; [bam] has .0524
FRICTION_IMPEDANCE = (0.999, 0.999, 0.001, 0.5, 2.0)
"""MuJoCo's dry friction is a soft constraint: with the default impedance of 0.9 a loaded joint
that sticks creeps to its target within seconds. The recorded arm does not: in `sinusoidal_sweep`
the elbow stands 0.075 rad off a command that rests for 68 s [sage]. With 0.999 it creeps 100 times
slower."""
STIFFNESS = 17.8  # [cad] position_kp [N m/rad]
DAMPING = 0.60
"""[cad] [N m s/rad]. It already holds the passive friction: the back-EMF damping kt^2 / R = .549
and the viscous friction .0591 of [bam] add up to .608. The drive's own viscous damping is
therefore 0 here, so that nothing counts twice."""

DRIVE = Drive(
    gear_ratio=GEAR_RATIO,
    rotor_inertia=ARMATURE / GEAR_RATIO**2,
    stall_torque=JOINT_TORQUE_CONSTANT * BUS_VOLTAGE / RESISTANCE,  # 3.35 N m
    no_load_speed=BUS_VOLTAGE / JOINT_TORQUE_CONSTANT,  # 6.11 rad/s
    effort_limit=EFFORT_LIMIT,
    frictionloss=FRICTIONLOSS,
    viscous_damping=0.0,
    bus_voltage=BUS_VOLTAGE,
    resistance=RESISTANCE,
    torque_constant=JOINT_TORQUE_CONSTANT / GEAR_RATIO,
)

BAND_HZ = (0.1, 3.5)
"""[sage]: coherence of the recorded chirp falls below .95 above 3.5 Hz."""
GRID_STIFFNESS = (2.0, 60.0)
GRID_DAMPING = (0.05, 3.0)
"""Wide on purpose: nothing published brackets these gains as F7 does for the Mini Cheetah."""

DEFAULT_POSITION = {
    "shoulder_pan": 0.0,
    "shoulder_lift": 0.0,
    "elbow_flex": 0.5,
    "wrist_flex": 0.0,
    "wrist_roll": 0.0,
    "gripper": 0.0,
}
"""Pose of the recordings [rad]; the jaw's recorded 0.5 is not an angle, so it stays shut."""

# --- Recordings ---------------------------------------------------------------------------------

SAGE_JOINTS = {
    "Rotation": "shoulder_pan",
    "Pitch": "shoulder_lift",
    "Elbow": "elbow_flex",
    "Wrist_Pitch": "wrist_flex",
    "Wrist_Roll": "wrist_roll",
    "Jaw": "gripper",
}
"""Names in [sage] recordings to joint names."""
SAGE_UNITS = {name: "unknown" if name == "Jaw" else "rad" for name in SAGE_JOINTS}
"""Jaw is on a 0 to 1 scale whose travel in radians is not recorded: not an angle."""
SAGE_POSE = {"Rotation": 0.0, "Pitch": 0.0, "Elbow": 0.5, "Wrist_Pitch": 0.0, "Wrist_Roll": 0.0}
"""What the recorded signals are centred on [rad]."""

SAGE_MAPPING = {name: (1.0, 0.0) for name in SAGE_JOINTS if name != "Jaw"}
"""(sign, offset): joint position [rad] = sign * recorded position + offset.

What speaks for +1: in all four recordings about SAGE_POSE the three joints that carry weight sit
beside their mean command in the direction gravity pulls them in the [cad] model, and in
proportion: +.038, +.037, +.010 rad for gravity torques of +.49, +.40, +.10 N m (Pitch, Elbow,
Wrist_Pitch; 11 to 13 N m/rad), the other two within .003 rad. Nothing tells the sign of
Rotation and Wrist_Roll, which gravity does not load in this pose, nor small zero offsets: those
are +1 and 0 by default, not by measurement. Recorded torques are magnitudes and have no sign."""
