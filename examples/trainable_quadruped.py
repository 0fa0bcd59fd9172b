"""Make a URDF or MJCF of a quadruped trainable: write model, robot.yaml and task.

    python examples/trainable_quadruped.py a1.urdf my_a1 --legs FR FL RR RL --pose 0 0.8 -1.6

The legs are prefixes of joint names in the order of the model, three joints each, and their feet
are spheres; the pose is that of a leg, hip roll, hip pitch and knee [rad]. Gains and drives are
those of `pronk robot new`: correct what its file marks CHECK here, too. The model that is written
is a beginning to edit: its capsules have a share of the shank's length as their radius.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import mujoco
import numpy as np
import yaml

from pronk.errors import PronkError
from pronk.robots import load_robot
from pronk.robots.bare import describe_model
from pronk.robots.legged import joints_of_leg

THICKNESS = {"thigh": 0.1, "shank": 0.06}
"""Radii of the capsules as a share of the length of the shank."""
TASK = """\
from pronk.jump.train.tasks.jump_env_cfg import jump_env_cfg


def env_cfg(robot, gains, **options):
    return jump_env_cfg(robot, gains, **options)
"""
"""Content of env_cfgs.py: the task as it follows from the model; docs/train-your-robot.md."""


def main() -> None:
    """Read the arguments and write the folder."""
    parser = argparse.ArgumentParser(description="Make a quadruped's model trainable.")
    parser.add_argument("model", type=Path, help="URDF or MJCF")
    parser.add_argument("folder", type=Path, help="new folder for the files")
    parser.add_argument("--legs", nargs=4, required=True, help="prefixes of the joints")
    parser.add_argument("--pose", nargs=3, type=float, required=True, help="roll pitch knee [rad]")
    arguments = parser.parse_args()
    if arguments.folder.exists():
        raise SystemExit(f"{arguments.folder} exists already; give the name of a new folder.")
    try:
        spec = load_robot(arguments.model).build_spec()
    except PronkError as error:
        raise SystemExit(str(error)) from None
    base = name_parts(spec, arguments.legs)
    arguments.folder.mkdir()
    (arguments.folder / "model.xml").write_text(spec.to_xml())
    content = robot_file(arguments.model, base, arguments.legs, arguments.pose)
    text = yaml.safe_dump(content, sort_keys=False)
    (arguments.folder / "robot.yaml").write_text(text)
    (arguments.folder / "env_cfgs.py").write_text(TASK)
    print(f"next: pronk robot check {arguments.folder / 'robot.yaml'}")


def name_parts(spec: mujoco.MjSpec, legs: list[str]) -> str:
    """Add the free joint, and the geoms and sites that training names; return the base."""
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for geom in spec.geoms:  # what touches the ground is what is added below
        geom.contype = 0
        geom.conaffinity = 0
    names = [model.joint(index).name for index in range(model.njnt)]
    hips = []
    for leg in legs:
        joints = [name for name in names if name.startswith(f"{leg}_")]
        if len(joints) != 3:
            raise SystemExit(
                f"{leg} has {len(joints)} joints; expected three whose names begin with {leg}_ "
                f"among {', '.join(names)}."
            )
        roll, pitch, knee = joints
        hips.append(data.xanchor[model.joint(roll).id])
        thigh = spec.body(model.body(model.joint(pitch).bodyid[0]).name)
        shank_id = model.joint(knee).bodyid[0]
        shank = spec.body(model.body(shank_id).name)
        to_shank = data.xmat[shank_id].reshape(3, 3).T
        foot, radius = foot_of(model, data, shank_id)
        foot = to_shank @ (foot - data.xpos[shank_id])
        knee_place = model.body_pos[shank_id]
        length = abs(foot[2])
        add_capsule(thigh, f"{leg}_thigh_collision", knee_place, THICKNESS["thigh"] * length)
        along_z = np.array([0.0, 0.0, foot[2]])
        add_capsule(shank, f"{leg}_shank_collision", along_z, THICKNESS["shank"] * length)
        geom = shank.add_geom(name=f"{leg}_foot_collision", pos=foot, size=[radius, 0, 0])
        make_touching(geom)
        geom.priority = 1
        shank.add_site(name=f"{leg}_foot", pos=foot)
    base_id = model.body_rootid[model.joint(names[0]).bodyid[0]]
    base = spec.body(model.body(base_id).name)
    if mujoco.mjtJoint.mjJNT_FREE not in model.jnt_type:
        base.add_freejoint()
    size = [*np.abs(np.array(hips) - data.xpos[base_id]).max(axis=0)[:2], 0.25 * length]
    trunk = base.add_geom(name="trunk_collision", type=mujoco.mjtGeom.mjGEOM_BOX, size=size)
    make_touching(trunk)
    return str(base.name)


def foot_of(model: mujoco.MjModel, data: mujoco.MjData, shank: int) -> tuple[np.ndarray, float]:
    """Return centre and radius of the lowest sphere of a shank and of what is fixed to it."""
    best = -1
    for geom in range(model.ngeom):
        is_fixed_to_shank = model.body_weldid[model.geom_bodyid[geom]] == shank
        if model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_SPHERE or not is_fixed_to_shank:
            continue
        if best < 0 or data.geom_xpos[geom][2] < data.geom_xpos[best][2]:
            best = geom
    if best < 0:
        raise SystemExit(f"{model.body(shank).name} has no sphere as its foot; add one.")
    return data.geom_xpos[best], float(model.geom_size[best, 0])


def add_capsule(body: mujoco.MjsBody, name: str, end: np.ndarray, radius: float) -> None:
    """Add a capsule from near a body's origin to near a point."""
    geom = body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[radius, 0, 0])
    geom.fromto = [*(0.15 * end), *(0.85 * end)]
    make_touching(geom)


def make_touching(geom: mujoco.MjsGeom) -> None:
    """Let a geom touch the ground and nothing of the robot, without a mass of its own."""
    geom.contype = 0
    geom.conaffinity = 1
    geom.mass = 0.0


def robot_file(model: Path, base: str, legs: list[str], pose: list[float]) -> dict[str, object]:
    """Return the content of the robot.yaml: one group of four joints for each joint of a leg."""
    robot = load_robot(model)
    description = describe_model(model).file
    drives = {}
    groups = {}
    default = {}
    for name, angle in zip(joints_of_leg(robot, legs[0]), pose, strict=True):
        suffix = name.removeprefix(f"{legs[0]}_")
        drive = description.drives[name]
        drives[suffix] = {
            "effort_limit": drive.effort_limit,
            "stall_torque": drive.stall_torque,
            "no_load_speed": drive.no_load_speed,
            "armature": drive.armature,
            "frictionloss": drive.frictionloss,
            "viscous_damping": drive.viscous_damping,
        }
        groups[suffix] = {
            "joints": f"*_{suffix}",
            "drive": suffix,
            "servo": description.groups[name].servo,
            "stiffness": description.groups[name].stiffness,
            "damping": description.groups[name].damping,
            "band_hz": [0.2, 10.0],
        }
        default[suffix] = angle
    return {
        "schema": description.schema,
        "name": model.stem,
        "model": "model.xml",
        "base_body": base,
        "legs": legs,
        "drives": drives,
        "groups": groups,
        "poses": {"default": default},
    }


if __name__ == "__main__":
    main()
