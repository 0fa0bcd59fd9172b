r"""What a policy that only walks does when it is led through the jump that training shows.

    python tools/led_jumps.py policies/matched/policy.onnx --gains policies/gains.yaml

Robots in which everything is drawn, batteries included, walk with each command and are then told to
jump, each at another moment of its stride. They are led all the way; a policy that knows how to
jump is not told. Physics is that of `cpu_engine.py`. Printed is what a robot had when it was
fastest upwards, up to 0.34 s after the command.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cpu_engine
import mjlab.envs.manager_based_rl_env as mjlab_env
import numpy as np
import torch
from tensordict import TensorDict

from pronk.evaluation.training_sim.subject import load_subject
from pronk.policy import paper
from pronk.robots import load_robot
from pronk.train.gains import training_gains
from pronk.train.mdp.commands import motion_command
from pronk.train.phases import enter_phase, phase
from pronk.train.tasks import env_cfg

COMMANDS = (*(told[:2] for told in paper.JUMPS.values()), (0.0, 0.0))
"""Forward and left [m/s]: the paper's, and none."""
WALK, STRIDE, JUMP = 80, 16, 17
"""Policy steps to get under way, over which the commands to jump are spread, and of a jump."""


def main() -> None:
    """Walk, jump, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("policy", type=Path, help="policy.onnx, or a run.")
    parser.add_argument("--gains", type=Path, required=True)
    parser.add_argument("--robots", type=int, default=64, help="A command.")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    for what, found in led(asked.policy, asked.gains, asked.robots, asked.seed).items():
        up, before, after, turn = found
        print(
            f"{what:>7s} m/s: {up.mean():.2f} +- {up.std():.2f} m/s up; along the command "
            f"{before.mean():.2f} m/s before, {after.mean():.2f} then; "
            f"turning with {turn.mean():.1f} rad/s"
        )


@torch.no_grad()
def led(policy: Path, gains: Path, robots: int, seed: int) -> dict[str, np.ndarray]:
    """By command, shape (4, robots): velocity up, along the command before and then, turning rate.

    Velocities in m/s, the turning rate is roll and pitch together [rad/s].
    """
    mjlab_env.Simulation = cpu_engine.CpuSimulation
    count = robots * len(COMMANDS)
    matched = training_gains(gains, load_robot("mini_cheetah"))
    cfg = env_cfg(gains=matched, num_envs=count, phase=phase("jump_a"))
    cfg.seed = seed
    env = mjlab_env.ManagerBasedRlEnv(cfg, device="cpu")
    enter_phase(env, phase("jump_a"))
    command = motion_command(env)
    command.scripted, command.led = True, 1.0
    subject = load_subject(policy, "cpu")
    untold = {"jump": torch.zeros(count, 1)}
    told = torch.tensor(COMMANDS).repeat(robots, 1)
    begins = WALK + (torch.arange(count) // len(COMMANDS)) % STRIDE
    observed, _ = env.reset()
    command.velocity[:] = torch.nn.functional.pad(told, (0, 1))
    up, along, turn = [], [], []
    way = torch.nn.functional.normalize(told, dim=1)
    for step in range(WALK + STRIDE + JUMP):
        command.jump[:] = step >= begins
        command.compute(0.0)  # leads the coming step
        action = subject.act(TensorDict({**observed, **untold}, batch_size=[count]))
        observed = env.step(action)[0]
        motion = command.motion
        up.append(motion.velocity_world[:, 2].clone())
        along.append((motion.velocity_heading[:, :2] * way).sum(dim=1))
        turn.append(torch.linalg.vector_norm(motion.angular_velocity[:, :2], dim=1))
    series = torch.stack([torch.stack(values) for values in (up, along, turn)])
    window = begins + torch.arange(JUMP)[:, None]
    of_jump = series.gather(1, window.expand(3, -1, -1))
    top = of_jump[0].argmax(dim=0).expand(3, 1, -1)
    fastest = of_jump.gather(1, top)[:, 0]
    before = series[1].gather(0, begins[None] - 1)[0]
    found = torch.stack((fastest[0], before, fastest[1], fastest[2])).numpy()
    names = [f"{forward:+g}, {left:+g}" for forward, left in COMMANDS]
    return {name: found[:, i :: len(names)] for i, name in enumerate(names)}


if __name__ == "__main__":
    main()
