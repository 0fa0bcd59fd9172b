"""Write the virtual robots of the study, and match each by its own sweep.

    python examples/studies/match_worth/make_robots.py            # robots/*.yaml from their seeds
    python examples/studies/match_worth/make_robots.py --match    # and gains/*.yaml: 5 minutes each

Every robot is drawn about the parameters of the virtual Mini Cheetah that ships with pronk. The
same seeds give the same files. `--robot NAME` does it for one robot alone. A robot that its drives
do not hold up is refused, since no policy could start on it.
"""

from __future__ import annotations

import argparse
import math
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from pronk.errors import HardwareError
from pronk.jump.trial.condition_trial import save_sim_params
from pronk.jump.virtual.robot import VirtualRobot
from pronk.jump.virtual.sim_params import JointParams, SimParams, load_sim_params
from pronk.policy.rollout import check_standing
from pronk.robots import load_robot

FOLDER = Path(__file__).resolve().parent
ROBOT = "mini_cheetah"
WEAK_SEED = 4301
STRONG_SEED = 4302
RANDOM_SEEDS = (4311, 4314, 4315)
"""The first three seeds from 4311 whose robots their drives hold up in the default pose."""

WEAK_TORQUE = (0.68, 0.85)
"""Torque constants of the weak robot; the shipped one has 0.99 to 1.43 [1]."""
STRONG_TORQUE = (1.35, 1.6)
"""Torque constants of the strong robot [1]."""
GROUP_TORQUE = (0.8, 1.45)
"""Part of the torque constant that the joints of a group of a random robot share [1]."""
JOINT_TORQUE = (0.9, 1.1)
"""Part of the torque constant that a joint of a random robot has by itself [1]."""
FRICTION = (0.5, 2.5)
"""Dry and viscous friction of a joint of a random robot, times that of the shipped one [1]."""
BELT = (0.5, 2.0)
"""Stiffness of its belts, times that of the shipped ones, drawn by its logarithm [1]."""
INERTIA = (0.9, 1.1)
"""Inertia of its links and rotors, times that of the shipped ones [1]."""
DELAY_S = (0.001, 0.009)
"""Command delay of a random robot [s]."""
MASS_OFFSET = (-0.4, 1.6)
"""Mass of its trunk over the model's, as training draws it [kg]."""
CENTRE_OFFSET = 0.01
"""Largest offset of its centre of mass along each axis [m]."""
_DIGITS = 5


def rounded(value: float) -> float:
    """Return a number as the files hold it."""
    return float(f"{value:.{_DIGITS}g}")


def changed_joint(
    joint: JointParams,
    *,
    torque_scale: float,
    friction: float,
    belt: float,
    link: float = 1.0,
    rotor: float = 1.0,
) -> JointParams:
    """Return a joint with another torque constant and with factors on its other parameters.

    Bristles break away at the same deflection, and belts stay as damped as they were.
    """
    return replace(
        joint,
        torque_scale=rounded(torque_scale),
        link_inertia_scale=rounded(link * joint.link_inertia_scale),
        rotor_inertia=rounded(rotor * joint.rotor_inertia),
        belt_stiffness=rounded(belt * joint.belt_stiffness),
        belt_damping=rounded(math.sqrt(belt) * joint.belt_damping),
        coulomb=rounded(friction * joint.coulomb),
        breakaway=rounded(friction * joint.breakaway),
        presliding_stiffness=rounded(friction * joint.presliding_stiffness),
        presliding_damping=rounded(math.sqrt(friction) * joint.presliding_damping),
        viscous=rounded(friction * joint.viscous),
    )


def scaled_robot(
    *, seed: int, torque: tuple[float, float], friction: float, belt: float, delay_s: float
) -> SimParams:
    """Return a robot whose torque constants are drawn, with the same factors on all joints.

    Args:
        seed: Seed of the draws.
        torque: Range of the torque constants [1].
        friction: Factor on dry and viscous friction [1].
        belt: Factor on the stiffness of the belts [1].
        delay_s: Command delay [s].
    """
    shipped = load_sim_params()
    rng = np.random.default_rng(seed)
    joints = {}
    for name, joint in shipped.joints.items():
        torque_scale = rng.uniform(*torque)
        joints[name] = changed_joint(joint, torque_scale=torque_scale, friction=friction, belt=belt)
    machine = replace(shipped.machine, command_delay_s=rounded(delay_s))
    return replace(shipped, joints=joints, machine=machine)


def weak_robot() -> SimParams:
    """Return a robot of weak drives: friction twice, belts 0.6, 4 ms more of command delay."""
    delay_s = load_sim_params().machine.command_delay_s + 0.004
    return scaled_robot(seed=WEAK_SEED, torque=WEAK_TORQUE, friction=2.0, belt=0.6, delay_s=delay_s)


def strong_robot() -> SimParams:
    """Return a robot of strong drives: friction half, belts 1.5, 1 ms of command delay."""
    return scaled_robot(
        seed=STRONG_SEED, torque=STRONG_TORQUE, friction=0.5, belt=1.5, delay_s=0.001
    )


def random_robot(seed: int) -> SimParams:
    """Return a robot with everything drawn, wider than the built-in conditions `bodies`."""
    shipped = load_sim_params()
    robot = load_robot(ROBOT)
    rng = np.random.default_rng(seed)
    group_torque = {}
    for group in robot.groups:
        group_torque[group] = rng.uniform(*GROUP_TORQUE)
    joints = {}
    for joint in robot.joints:
        joints[joint.name] = changed_joint(
            shipped.joints[joint.name],
            torque_scale=group_torque[joint.group] * rng.uniform(*JOINT_TORQUE),
            friction=rng.uniform(*FRICTION),
            belt=math.exp(rng.uniform(*np.log(BELT))),
            link=rng.uniform(*INERTIA),
            rotor=rng.uniform(*INERTIA),
        )
    delay_s = rounded(rng.uniform(*DELAY_S))
    mass_offset = rounded(rng.uniform(*MASS_OFFSET))
    x, y, z = rng.uniform(-CENTRE_OFFSET, CENTRE_OFFSET, 3)
    trunk = replace(
        shipped.trunk, mass_offset=mass_offset, com_offset=(rounded(x), rounded(y), rounded(z))
    )
    machine = replace(shipped.machine, command_delay_s=delay_s)
    return replace(shipped, joints=joints, machine=machine, trunk=trunk)


def stands(sim_params: SimParams) -> bool:
    """Return whether the drives hold a robot up that is set down in its default pose.

    A trial sets a robot that gives way down again nearer to that pose, and counts a jump as not
    landed if it gives way there too.
    """
    robot = load_robot(ROBOT)
    machine = VirtualRobot(robot, sim_params, seed=0, base="ground")
    machine.connect()
    try:
        check_standing(robot, machine.latest())
    except HardwareError:
        return False
    return True


ROBOTS: dict[str, Callable[[], SimParams]] = {
    "shipped": load_sim_params,
    "weak": weak_robot,
    "strong": strong_robot,
    "random-1": lambda: random_robot(RANDOM_SEEDS[0]),
    "random-2": lambda: random_robot(RANDOM_SEEDS[1]),
    "random-3": lambda: random_robot(RANDOM_SEEDS[2]),
}
"""How each robot is made."""


def match_robot(name: str) -> None:
    """Sweep a virtual robot on the bench, match it, and write its gains."""
    gains = FOLDER / "gains" / f"{name}.yaml"
    gains.parent.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        logs = Path(folder) / "logs"
        drafted = Path(folder) / "gains.yaml"
        sim_params = FOLDER / "robots" / f"{name}.yaml"
        pronk = [sys.executable, "-m", "pronk"]
        sweep = [*pronk, "sweep", ROBOT, "--sim-params", str(sim_params), "--out", str(logs)]
        match = [*pronk, "match", str(logs), "--robot", ROBOT, "--out", str(drafted)]
        subprocess.run(sweep, check=True)
        subprocess.run(match, check=True)
        text = drafted.read_text(encoding="utf-8")
        comment = (
            f"# Virtual robot robots/{name}.yaml, matched by its own sweep (make_robots.py).\n"
        )
        gains.write_text(comment + text, encoding="utf-8")


def main() -> None:
    """Write the robots, and their gains if that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--match", action="store_true", help="sweep and match each robot too")
    parser.add_argument("--robot", action="append", choices=list(ROBOTS), help="this one alone")
    options = parser.parse_args()
    (FOLDER / "robots").mkdir(exist_ok=True)
    for name in options.robot or list(ROBOTS):
        path = FOLDER / "robots" / f"{name}.yaml"
        comment = f"Virtual robot {name!r} of the study; written by make_robots.py."
        sim_params = ROBOTS[name]()
        if not stands(sim_params):
            parser.exit(1, f"{name}: the drives do not hold this robot up in its default pose.\n")
        save_sim_params(path, sim_params, comment=comment)
        if options.match:
            match_robot(name)


if __name__ == "__main__":
    main()
