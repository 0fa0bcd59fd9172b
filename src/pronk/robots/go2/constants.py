"""Numbers of the Unitree Go2, a source beside each.

Sources:
    [urdf]   unitreerobotics/unitree_ros, go2_description.urdf (BSD-3): geometry, masses, limits.
    [mj]     unitreerobotics/unitree_mujoco, go2.xml (BSD-3): armature, friction, home pose.
    [manual] Unitree, GO-M8010-6 motor user manual: gear.
    [gym]    unitreerobotics/unitree_rl_gym, Go2 configuration (BSD-3): gains.

Nothing here was measured by pronk, and no public figure of the electrical side holds together; see
`drive`. Signs are Unitree's: pitch axes along +y, so that the knee bends with negative angles.
"""

from __future__ import annotations

from pronk.robots.inertia import Inertia, joined
from pronk.robots.robot import Drive

LEGS = ("FR", "FL", "RR", "RL")
"""Order of every file and table, and of Unitree's messages."""
LEG_JOINTS = ("hip_roll", "hip_pitch", "knee")
"""Unitree's hip, thigh and calf."""

# --- Geometry [urdf] [m] ------------------------------------------------------------------------

HIP_X, HIP_Y = 0.1934, 0.0465
ABAD_LENGTH = 0.0955
"""hip_roll axis to hip_pitch origin, outwards."""
THIGH_LENGTH = SHANK_LENGTH = 0.213
FOOT_RADIUS = 0.022
FOOT_X = -0.002
TRUNK_HALF = (0.1881, 0.04675, 0.057)

# --- Pose, limits and gains ---------------------------------------------------------------------

DEFAULT_POSITION = {"hip_roll": 0.0, "hip_pitch": 0.9, "knee": -1.8}  # [mj], key `home` [rad]
FOLDED_POSITION = {"hip_roll": 0.0, "hip_pitch": 1.36, "knee": -2.65}
"""The lying pose of unitree_sdk2's example go2_stand_example.cpp (BSD-3) [rad]."""
_RANGE = {"hip_roll": (-1.0472, 1.0472), "knee": (-2.7227, -0.83776)}  # [urdf] [rad]
_FRONT_PITCH, _HIND_PITCH = (-1.5708, 3.4907), (-0.5236, 4.5379)  # [urdf] [rad]
DRIVE_STIFFNESS, DRIVE_DAMPING = 20.0, 0.5  # [gym] [N m/rad], [N m s/rad]
BAND_HZ = {"hip_roll": (1.0, 10.0), "hip_pitch": (1.0, 10.0), "knee": (0.1, 15.0)}
"""The Mini Cheetah's (paper F11): nobody has published a band for this robot."""


def joint_range(leg: str, joint: str) -> tuple[float, float]:
    """Mechanical limits [rad]; the thighs of front and hind legs differ."""
    if joint == "hip_pitch":
        return _FRONT_PITCH if leg.startswith("F") else _HIND_PITCH
    return _RANGE[joint]


# --- Drives -------------------------------------------------------------------------------------

GEAR = {"hip_roll": 6.33, "hip_pitch": 6.33, "knee": 9.495}
"""[manual] for the motor; the knee's linkage multiplies by 1.5, which is what its limits in [urdf]
say (35.55 / 23.7 N m, 30.1 / 20.07 rad/s). [mj] still has 1.917 (45.43 N m); the smaller is the
safer to believe."""
EFFORT_LIMIT = {"hip_roll": 23.7, "hip_pitch": 23.7, "knee": 35.55}  # [urdf] [N m]
NO_LOAD_SPEED = {"hip_roll": 30.1, "hip_pitch": 30.1, "knee": 20.07}  # [urdf] velocity [rad/s]
ARMATURE_AT_HIP = 0.01  # [mj] [kg m^2]
JOINT_FRICTION, JOINT_DAMPING = 0.2, 0.1  # [mj] [N m], [N m s/rad]
BUS_VOLTAGE = 28.8  # battery, 8 cells of 3.6 V [V]
_EMF_FACTOR, _TORQUE_FACTOR = 2.0, 1.5  # as for every drive here, see pronk.actuator.model


def drive(joint: str) -> Drive:
    """The drive of a `hip_roll`, `hip_pitch` or `knee`.

    Torque falls from the effort limit at standstill to nothing at the largest speed, the straight
    line that simulators of this robot use (stall torque equals effort limit). Torque constant and
    resistance are those that go with this line at the nominal voltage; they are no measurements,
    and electrical power computed from them is a guess.
    """
    gear, effort, speed = GEAR[joint], EFFORT_LIMIT[joint], NO_LOAD_SPEED[joint]
    constant = BUS_VOLTAGE / (_EMF_FACTOR * gear * speed)
    return Drive(
        gear_ratio=gear,
        rotor_inertia=ARMATURE_AT_HIP / GEAR["hip_roll"] ** 2,
        stall_torque=effort,
        no_load_speed=speed,
        effort_limit=effort,
        frictionloss=JOINT_FRICTION,
        viscous_damping=JOINT_DAMPING,
        bus_voltage=BUS_VOLTAGE,
        resistance=_TORQUE_FACTOR * gear * constant * BUS_VOLTAGE / effort,
        torque_constant=constant,
    )


# --- Masses and inertias [urdf] -----------------------------------------------------------------

TRUNK = Inertia(
    mass=6.921,
    com=(0.021112, 0.0, -0.005366),
    products=(0.02448, 0.098077, 0.107, 0.00012166, 0.0014849, -3.12e-05),
)
_FOOT = Inertia(
    mass=0.04, com=(0.0, 0.0, -SHANK_LENGTH), products=(9.6e-6, 9.6e-6, 9.6e-6, 0.0, 0.0, 0.0)
)
_CALF = Inertia(
    mass=0.154,
    com=(0.00548, -0.000975, -0.115),
    products=(0.00108, 0.0011, 3.29e-05, 3.4e-07, 1.72e-05, 8.28e-06),
)
FRONT_LEFT_LINKS = {
    "hip": Inertia(
        mass=0.678,
        com=(-0.0054, 0.00194, -0.000105),
        products=(0.00048, 0.000884, 0.000596, -3.01e-06, 1.11e-06, -1.42e-06),
    ),
    "thigh": Inertia(
        mass=1.152,
        com=(-0.00374, -0.0223, -0.0327),
        products=(0.00584, 0.0058, 0.00103, 8.72e-05, -0.000289, 0.000808),
    ),
    "shank": joined([_CALF, _FOOT]),
}
"""Links of the front left leg; right ones are mirrored about the x-z plane, and a hind leg's hip
about the y-z plane."""


def link(leg: str, name: str) -> Inertia:
    """A link of a leg as MuJoCo gets it."""
    inertia = FRONT_LEFT_LINKS[name]
    if name == "hip" and leg.startswith("R"):
        x, y, z = inertia.com
        xx, yy, zz, xy, xz, yz = inertia.products
        inertia = Inertia(mass=inertia.mass, com=(-x, y, z), products=(xx, yy, zz, -xy, -xz, yz))
    return inertia if leg.endswith("L") else inertia.mirrored()
