"""A joint whose gear is a spring: motor and link move apart, as no rigid joint does."""

from __future__ import annotations

from pathlib import Path

import numpy as np

MODEL = """
<mujoco model="{name}">
  <compiler angle="radian"/>
  <worldbody>
    <body name="base">
      <geom type="box" size="0.1 0.1 0.1" mass="5"/>
      {joints}
    </body>
  </worldbody>
  <actuator>
    {drives}
  </actuator>
</mujoco>
"""
DRIVE = """
    <position name="{name}" joint="{name}" kp="60" kv="1.5" forcerange="-100 100"/>
"""
JOINT = """
      <body name="{name}_link" pos="0 {place} 0.2">
        <joint name="{name}" axis="0 0 1" range="-2 2" armature="0.03"/>
        <inertial pos="0 0 0" mass="1" diaginertia="0.06 0.06 0.06"/>
      </body>
"""
STIFFNESS = 60.0
"""Stiffness of the drive of the motor [N m/rad]."""
DAMPING = 1.5
"""Damping of the drive of the motor [N m s/rad]."""
ROTOR_INERTIA = 0.03
"""Inertia of the motor [kg m^2]."""
LINK_INERTIA = 0.06
"""Inertia of the link [kg m^2]."""
RATE_HZ = 200.0
"""Samples of the log a second."""
STEPS = 20
"""Steps of the integration between two samples."""


def write_model(path: Path, joints: tuple[str, ...] = ("j",), name: str = "bench") -> Path:
    """Write an MJCF whose joints turn a rigid link about the vertical, one beside the other."""
    bodies = ""
    drives = ""
    for place, joint in enumerate(joints):
        bodies += JOINT.format(name=joint, place=0.5 * place)
        drives += DRIVE.format(name=joint)
    path.write_text(MODEL.format(name=name, joints=bodies, drives=drives), encoding="utf-8")
    return path


def write_log(path: Path, joint: str = "j", gear: float = 100.0, seed: int = 0) -> Path:
    """Write a CSV of a chirp of 0.2 to 12 Hz in 20 s, commands at 50 Hz.

    Args:
        path: The file.
        joint: Name of the joint.
        gear: Stiffness of the gear between motor and link [N m/rad]; infinite for a rigid joint.
        seed: Seed of the noise of the encoder at the link, 0.2 mrad.
    """
    time = np.arange(round(21.0 * RATE_HZ)) / RATE_HZ
    tick = np.floor(time * 50.0 + 1e-9) / 50.0
    command = 0.2 * np.sin(2.0 * np.pi * (0.2 * tick + 11.8 / 40.0 * tick**2))
    command[tick >= 20.0] = 0.0
    step = 1.0 / (RATE_HZ * STEPS)
    motor = 0.0
    motor_speed = 0.0
    link = 0.0
    link_speed = 0.0
    position = np.empty(len(time))
    for sample, target in enumerate(command):
        position[sample] = link
        for _ in range(STEPS):
            torque = STIFFNESS * (target - motor) - DAMPING * motor_speed
            if np.isinf(gear):
                motor_speed += step * torque / (ROTOR_INERTIA + LINK_INERTIA)
                motor += step * motor_speed
                link = motor
                continue
            spring = gear * (motor - link) + 0.05 * (motor_speed - link_speed)
            motor_speed += step * (torque - spring) / ROTOR_INERTIA
            link_speed += step * spring / LINK_INERTIA
            motor += step * motor_speed
            link += step * link_speed
    position += 2e-4 * np.random.default_rng(seed).standard_normal(len(time))
    rows = np.column_stack([time, command, position])
    header = f"time,command.{joint},position.{joint}"
    np.savetxt(path, rows, delimiter=",", header=header, comments="", fmt="%.6f")
    return path
