"""Numbers of the Mini Cheetah Vision, a source beside each; derived numbers are computed.

Sources:
    [CAD]    Cheetah-Software (MIT Biomimetics, MIT licence): common/include/Dynamics/MiniCheetah.h,
             Quadruped.h, ActuatorModel.h; "inertia parameters of all bodies are from CAD".
    [paper]  Guan et al., arXiv 2404.15096; S, F and A numbers are items of its checklist.
    [urdf]   mini_cheetah_simple.urdf of rapid-locomotion-rl, used for limits and foot radius only:
             the inertias of the public URDFs are wrong (trunk Iyy ten times the CAD figure, shank
             centre of mass at -.209 m for -.061 m, right legs not mirrored).

Frames: x forward, y left, z up. Link frames are parallel to the trunk at zero angles and sit on
the joint that moves the link. Figures are those of a left leg; right legs are their mirror image
about the x-z plane. Front and hind legs are equal.
"""

from __future__ import annotations

from pronk.robots.inertia import Inertia, joined
from pronk.robots.robot import Drive

LEGS = ("FR", "FL", "HR", "HL")
"""Leg order of files and tables, the original firmware's."""
LEG_JOINTS = ("hip_roll", "hip_pitch", "knee")

# --- Geometry -----------------------------------------------------------------------------------

HIP_X = 0.21
"""Trunk centre to hip_roll axis origin along x [m]. [CAD] has .19 for the original robot; the
Vision body is "slightly longer" (S1) and no number is published. Our reading: .21, because the
paper's jump distance of the CoM less the gap it cleared is the foot base 2 HIP_X, and that is
.969 - .55 = .42 m forwards and .932 - .50 = .43 m backwards (R3, Table III, A16)."""
HIP_X_ORIGINAL = 0.19  # [CAD] bodyLength / 2
HIP_Y = 0.049  # [CAD] bodyWidth / 2
ABAD_LENGTH = 0.062  # [CAD] abadLinkLength: hip_roll axis to hip_pitch origin, outwards
THIGH_LENGTH = 0.209  # [CAD] hipLinkLength
KNEE_Y = 0.004  # [CAD] kneeLinkY_offset, outwards
SHANK_LENGTH = 0.195
"""Knee axis to foot centre [m]: [CAD] kneeLinkLength, where its contact point is; the paper
randomizes .18 to .20 (D5)."""
FOOT_RADIUS = 0.0175
"""[urdf]. [CAD] has point feet; another public URDF (pkGym) has .0202."""
TRUNK_HEIGHT = 0.10  # [CAD] bodyHeight

# --- Pose and limits ----------------------------------------------------------------------------

DEFAULT_POSITION = {"hip_roll": 0.0, "hip_pitch": -0.8, "knee": 1.6}
"""[rad]. Thigh back, shank forward, foot under the hip: Cheetah-Software's stance, and the
reference pose of the public training set-ups (-0.8, 1.62 there)."""
FOLDED_POSITION = {"hip_roll": 0.0, "hip_pitch": -1.25, "knee": 2.45}
"""[rad]. Knees 0.15 rad from their limit, the foot 2 cm behind the hip and 13 cm below it."""
RANGE = {"hip_roll": (-1.6, 1.6), "hip_pitch": (-2.6, 2.6), "knee": (-2.6, 2.6)}
"""[rad] [urdf]."""
STANDING_HEIGHT = 0.30  # [paper] S1 [m]

# --- Drives -------------------------------------------------------------------------------------

ROTOR_INERTIA = 72e-6
"""[kg m^2] [paper] S6, reading A11. [CAD] has 63e-6, which would give armatures of .0023 (hips)
and .0055 (knee) where the paper gives .0026 and .0063."""
GEAR = {"hip_roll": 6.0, "hip_pitch": 6.0, "knee": 9.33}  # [CAD], and S6
BUS_VOLTAGE = 24.0  # [CAD] batteryV [V]
TORQUE_CONSTANT = 0.05  # [CAD] motorKT: flux linkage times pole pairs [N m/A]
RESISTANCE = 0.173  # [CAD] motorR, phase [ohm]
TORQUE_FACTOR = 1.5  # [CAD] ActuatorModel.h: torque = 1.5 kt i (three phases, peak current)
EMF_FACTOR = 2.0  # [CAD] ActuatorModel.h: back-EMF = 2 kt omega, to compare with the bus voltage
JOINT_DAMPING = 0.01  # [CAD] jointDamping [N m s/rad]
JOINT_FRICTION = 0.2  # [CAD] jointDryFriction [N m]
EFFORT_LIMIT_AT_SIX = 17.0
"""[N m] [paper] S1: "max output 17 N m each", reading A12: at a 6:1 output. The knee has the same
motor behind 9.33:1, so 17 * 9.33 / 6 = 26.4 N m (the hardware code limits 17 / 17 / 26)."""

DRIVE_STIFFNESS = 17.0  # [paper] S4, every joint [N m/rad]
DRIVE_DAMPING = 0.4  # [paper] S4, every joint [N m s/rad]
BAND_HZ = {"hip_roll": (1.0, 10.0), "hip_pitch": (1.0, 10.0), "knee": (0.1, 15.0)}  # [paper] F11


def drive(joint: str) -> Drive:
    """The drive of a `hip_roll`, `hip_pitch` or `knee`.

    The voltage balance of [CAD] ActuatorModel.h, at the motor, is
    torque = 1.5 kt (V - 2 kt omega) / R; hence, at the joint behind a gear n,
    stall torque = 1.5 n kt V / R (62.4 N m hips, 97.1 N m knee) and
    no-load speed = V / (2 n kt) (40 rad/s hips, 25.7 rad/s knee).
    """
    gear = GEAR[joint]
    return Drive(
        gear_ratio=gear,
        rotor_inertia=ROTOR_INERTIA,
        stall_torque=TORQUE_FACTOR * gear * TORQUE_CONSTANT * BUS_VOLTAGE / RESISTANCE,
        no_load_speed=BUS_VOLTAGE / (EMF_FACTOR * gear * TORQUE_CONSTANT),
        effort_limit=EFFORT_LIMIT_AT_SIX * gear / GEAR["hip_roll"],
        frictionloss=JOINT_FRICTION,
        viscous_damping=JOINT_DAMPING,
        bus_voltage=BUS_VOLTAGE,
        resistance=RESISTANCE,
        torque_constant=TORQUE_CONSTANT,
    )


# --- Masses and inertias ------------------------------------------------------------------------

TOTAL_MASS = 12.0  # [paper] S1 [kg]

# Links of a left leg, without rotors [CAD]. Cheetah-Software turns the thigh frame by pi about z;
# read that way the thigh's centre of mass and the knee offset would lie inwards, the knee motor
# inside the hip motor (whose centre is at y = .04) and the foot 8 mm off the leg kinematics of the
# same software. Both are therefore read outwards, as in every public URDF.
ABAD = Inertia(
    mass=0.54, com=(0.0, 0.036, 0.0), products=(381e-6, 560e-6, 444e-6, 58e-6, 0.45e-6, 0.95e-6)
)
THIGH_XY_CAD = 245e-6
"""[CAD]. With it the principal moments break the triangle inequality."""
THIGH_XY = 194.9e-6
"""The largest xy product, to .1e-6, that a distribution of mass can have beside the others."""
THIGH = Inertia(
    mass=0.634,
    com=(0.0, 0.016, -0.02),
    products=(1983e-6, 2103e-6, 408e-6, THIGH_XY, 13e-6, 1.5e-6),
)
SHANK = Inertia(mass=0.064, com=(0.0, 0.0, -0.061), products=(245e-6, 248e-6, 6e-6, 0.0, 0.0, 0.0))

# Rotors [CAD]: mass and inertia ride on the link that carries the motor. Their spin relative to
# that link is the joint's armature and is not in these figures.
ROTOR_MASS = 0.055
ROTOR_TRANSVERSE, ROTOR_AXIAL = 33e-6, 63e-6
HIP_ROTOR_Y = 0.04  # in the abad frame; the knee's rotor is at the origin of the thigh frame


def _rotor_along_y(y: float) -> Inertia:
    moments = (ROTOR_TRANSVERSE, ROTOR_AXIAL, ROTOR_TRANSVERSE, 0.0, 0.0, 0.0)
    return Inertia(mass=ROTOR_MASS, com=(0.0, y, 0.0), products=moments)


LEFT_LINKS = {
    "hip": joined([ABAD, _rotor_along_y(HIP_ROTOR_Y)]),
    "thigh": joined([THIGH, _rotor_along_y(0.0)]),
    "shank": SHANK,
}
"""Links of a left leg as MuJoCo gets them, rotors included."""

TRUNK_MASS_CAD = 3.3
TRUNK_INERTIA_CAD = (11253e-6, 36203e-6, 42673e-6)  # xx, yy, zz, original body [kg m^2]


def _trunk() -> Inertia:
    """The original's trunk made heavier and longer.

    The paper's robot weighs 12 kg with the original's legs, so all surplus (battery, computer,
    cameras, longer shell, and the hip_roll rotors) is in the trunk. Second moments of mass scale
    with the mass, the one along x also with the square of the length.
    """
    mass = TOTAL_MASS - len(LEGS) * sum(link.mass for link in LEFT_LINKS.values())
    xx, yy, zz = TRUNK_INERTIA_CAD
    heavier, longer = mass / TRUNK_MASS_CAD, HIP_X / HIP_X_ORIGINAL
    along_x = heavier * longer**2 * (yy + zz - xx) / 2
    along_y = heavier * (xx + zz - yy) / 2
    along_z = heavier * (xx + yy - zz) / 2
    moments = (along_y + along_z, along_x + along_z, along_x + along_y, 0.0, 0.0, 0.0)
    return Inertia(mass=mass, com=(0.0, 0.0, 0.0), products=moments)


TRUNK = _trunk()
