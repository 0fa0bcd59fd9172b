"""Random arms with gravity, dry friction and rotor inertia, of 0.1 to 10 kg a link."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np

from pronk.robots import load_robot
from pronk.robots.model import bench_inertia, bench_spec
from pronk.robots.robot import RobotSpec

LINK = """
<body name="link{number}" pos="0 0 {offset}">
  <joint name="joint{number}" axis="{axis}" range="-170 170" damping="{viscous}"
    armature="{armature}"/>
  <geom type="capsule" fromto="0 0 0 0 0 {length}" size="0.02" mass="{mass}"/>
  {next_link}
</body>
"""


def random_arm(folder: Path, seed: int, sticking: bool = False) -> RobotSpec:
    """Draw an arm of two or three joints whose drives suit what they carry.

    Args:
        folder: Folder of its model, which is written.
        seed: Seed of the draw.
        sticking: Give each joint a dry friction just below what gravity asks of it at rest.

    Returns:
        The robot. Its joints are a rad or less off the vertical, so that gravity loads them.
    """
    rng = np.random.default_rng(seed)
    count = int(rng.integers(2, 4))
    length = float(rng.uniform(0.15, 0.4))
    mass = float(np.exp(rng.uniform(np.log(0.1), np.log(10.0))))
    text = ""
    for number in reversed(range(count)):
        text = LINK.format(
            number=number,
            offset=1.5 if number == 0 else -length,
            axis=rng.choice(["0 1 0", "0 1 0", "1 0 0"]),
            viscous=0.0,
            armature=float(rng.uniform(0.1, 0.5)) * mass * length**2,
            length=-length,
            mass=mass,
            next_link=text,
        )
    path = folder / f"arm{seed}.xml"
    path.write_text(f'<mujoco model="arm{seed}"><worldbody>{text}</worldbody></mujoco>')
    plain = load_robot(path)
    pose = {joint.name: float(rng.uniform(0.3, 1.0)) for joint in plain.joints}
    posed_joints = []
    for joint in plain.joints:
        posed_joints.append(replace(joint, default_position=pose[joint.name], range=(-2.9, 2.9)))
    posed = replace(plain, joints=tuple(posed_joints))
    joints = []
    for joint in posed.joints:
        inertia, _ = bench_inertia(posed, joint.name)
        # A natural frequency of 2.5 to 5 Hz and a damping ratio of 0.3 to 0.8.
        omega = 2.0 * np.pi * rng.uniform(2.5, 5.0)
        stiffness = inertia * omega**2
        weight = gravity_torque(posed, joint.name)
        friction = (0.98 if sticking else rng.uniform(0.0, 0.2)) * weight
        drive = replace(
            joint.drive,
            effort_limit=1e4,
            stall_torque=1e5,
            no_load_speed=1e4,
            frictionloss=float(friction),
        )
        joints.append(
            replace(
                joint,
                stiffness=float(stiffness),
                damping=float(2.0 * rng.uniform(0.3, 0.8) * inertia * omega),
                band_hz=(0.5, 10.0),
                drive=drive,
            )
        )
    return replace(posed, joints=tuple(joints))


def gravity_torque(robot: RobotSpec, joint: str) -> float:
    """Return the torque that holds a joint at the default pose against gravity [N m], positive."""
    model = bench_spec(robot, joint).compile()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    return abs(float(data.qfrc_bias[model.joint(joint).dofadr[0]]))
