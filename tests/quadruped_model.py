"""A quadruped of spheres and capsules under any names, of about the size of ANYmal."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

ANYMAL = {"LF": (0.36, 0.2), "LH": (-0.36, 0.2), "RF": (0.36, -0.2), "RH": (-0.36, -0.2)}
"""Legs of ANYmal in the order of Isaac Lab's messages, and where their thighs begin: forwards and
to the left [m]."""
SPOT = {"fl": (0.3, 0.17), "fr": (0.3, -0.17), "hl": (-0.3, 0.17), "hr": (-0.3, -0.17)}
"""Legs of Spot, alike."""
JOINTS = ("hip_roll", "hip_pitch", "knee")
COLLISION = 'contype="0" conaffinity="1"'


def write_quadruped(
    folder: Path,
    legs: Mapping[str, tuple[float, float]] = ANYMAL,
    joints: tuple[str, str, str] = JOINTS,
) -> Path:
    """Write a quadruped that can be trained to a new folder.

    The knees of all legs bend backwards.

    Args:
        folder: The folder.
        legs: Prefixes of the legs in the order of the model, and where their thighs begin, forwards
            and to the left [m].
        joints: Names of the joints of a leg without the prefix, from the trunk down.

    Returns:
        Its robot.yaml.
    """
    bodies = ""
    for leg, (x, y) in legs.items():
        side = 1.0 if y > 0.0 else -1.0
        roll, pitch, knee = (f"{leg}_{joint}" for joint in joints)
        bodies += f"""
      <body name="{leg}_HIP" pos="{x} {y - 0.1 * side} 0">
        <joint name="{roll}" axis="1 0 0" range="-0.6 0.6"/>
        <geom type="sphere" size="0.05" mass="2.8" contype="0" conaffinity="0"/>
        <body name="{leg}_THIGH" pos="0 {0.1 * side} 0">
          <joint name="{pitch}" axis="0 1 0" range="-2 2.5"/>
          <geom name="{leg}_thigh_collision" type="capsule" fromto="0 0 -0.05 0 0 -0.285"
                size="0.03" mass="3" {COLLISION}/>
          <body name="{leg}_SHANK" pos="0 0 -0.285">
            <joint name="{knee}" axis="0 1 0" range="-2.6 0.6"/>
            <geom name="{leg}_shank_collision" type="capsule" fromto="0 0 -0.05 0 0 -0.27"
                  size="0.018" mass="0.5" {COLLISION}/>
            <geom name="{leg}_foot_collision" type="sphere" pos="0 0 -0.32" size="0.03" mass="0.1"
                  priority="1" {COLLISION}/>
            <site name="{leg}_foot" pos="0 0 -0.32"/>
          </body>
        </body>
      </body>"""
    folder.mkdir()
    (folder / "model.xml").write_text(f"""
<mujoco model="quadruped">
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    <body name="base" pos="0 0 0.6">
      <freejoint/>
      <geom name="trunk_collision" type="box" size="0.3 0.1 0.08" mass="19" {COLLISION}/>{bodies}
    </body>
  </worldbody>
</mujoco>
""")
    drive = (
        "{bus_voltage: 48.0, no_load_speed: 12.0, effort_limit: 80.0, stall_torque: 160.0, "
        "armature: 0.1, frictionloss: 0.5, viscous_damping: 0.5}"
    )
    groups = ""
    for joint in joints:
        groups += f'  {joint}: {{joints: "*_{joint}", drive: drive}}\n'
    default = dict(zip(joints, (0.0, 0.5, -1.0), strict=True))
    path = folder / "robot.yaml"
    path.write_text(f"""
schema: pronk/robot/1
name: quadruped
model: model.xml
base_body: base
legs: [{", ".join(legs)}]
drives:
  drive: {drive}
defaults: {{stiffness: 120.0, damping: 3.0, band_hz: [0.5, 10.0]}}
groups:
{groups}
poses:
  default: {{{", ".join(f"{joint}: {angle}" for joint, angle in default.items())}}}
""")
    return path
