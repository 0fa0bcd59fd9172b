r"""Search for the jump that training shows to a policy, `jump_demonstration.yaml`.

    python tools/find_jump.py walk1.onnx walk2.onnx --gains policies/gains.yaml --out jump.yaml

CMA-ES over joint targets from the jump command to lift-off, for each of `COMMANDS` on its own.
A candidate is tried on robots that walk by the policies given, each told to jump at another moment
of its stride; from then on all targets are the candidate's, whatever the policy says. Robots are
nominal, on a battery as training draws them in the middle. What counts is the ground covered in
flight, with the trunk at standing height again at its end, then the speed upwards; tilting,
turning, lying low, a late lift-off and targets far from standing cost. Then, with batteries of
all kinds, a pose of the legs in flight is searched with which the policies, left to themselves
again shortly before touchdown, land and walk on. Physics is that of `cpu_engine.py`; commands are
searched side by side, a process each. Needs `pronk[bench]` for `cma`.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import cma
import cpu_engine
import mjlab.envs.manager_based_rl_env as mjlab_env
import numpy as np
import torch
import yaml
from tensordict import TensorDict

from pronk.files import sha256
from pronk.robots import load_robot
from pronk.robots.mini_cheetah.constants import LEG_JOINTS as PARTS
from pronk.robots.robot import Joint
from pronk.train.environment.commands import MotionCommandCfg, motion_command
from pronk.train.environment.demonstration import JOINTS, SCHEMA_VERSION
from pronk.train.environment.randomization import Randomization
from pronk.train.evaluation.subject import Subject, load_subject
from pronk.train.gains import training_gains
from pronk.train.phases import phase
from pronk.train.tasks import env_cfg

COMMANDS = ((0.0, 0.0), (1.0, 0.0), (2.0, 0.0), (-1.0, 0.0), (-2.0, 0.0), (0.0, -1.0))
"""Forward and left [m/s]: the paper's, and those between; to the left it is the mirror image."""
LEAP = float(MotionCommandCfg.__dataclass_fields__["leap"].default)
"""How much faster than told a jump may go [m/s], for commands below 1 m/s in proportion: ground
covered faster is not paid in training either."""
STEP_S = 0.02
PUSH = 14
"""Rows of what is found up to lift-off: the last is for 0.26 s after the command."""
ROWS = 36
"""All: the last is for 0.7 s after the command, a few hundredths before touchdown."""
TUCK = 5
"""Rows in which the legs go over into the pose in which they land."""
FASTEST = 2.6
"""More speed upwards is worth nothing [m/s]: 2.5 is asked for."""
KNOTS = np.linspace(0.0, 0.26, 9)
"""Moments between which targets go evenly [s]."""
GUESS = {"hip_pitch": (-0.35, 0.5), "knee": (0.8, -1.0)}
"""What the search begins with, beyond standing [rad]: legs fold for 0.1 s, and then stretch."""
VOLTAGE, RESISTANCE = 24.0, 0.07
"""Battery [V], with wires [ohm]: training draws 22.2 to 25.2 and 0.03 to 0.1."""
WALK, STRIDE, JUMP, LAND = 60, 16, 18, 65
"""Policy steps to get under way, over which the commands to jump are spread, of a jump up to
lift-off, and of one that is landed and walked on from."""
CANDIDATES, MOMENTS = 24, 16
"""Tried together, the first being the mean; and on so many robots each."""
STANDING = 0.30
"""Trunk over ground [m]."""


@dataclass(frozen=True)
class Jumps:
    """What robots had when they were fastest upwards. Shape (robots,) each."""

    up: torch.Tensor
    along: torch.Tensor
    turn: torch.Tensor
    height: torch.Tensor
    tilt: torch.Tensor
    after: torch.Tensor
    lowest: torch.Tensor
    fell: torch.Tensor
    last_tilt: torch.Tensor
    last_turn: torch.Tensor
    last_along: torch.Tensor

    def landing(self, told: float) -> torch.Tensor:
        """The same for how a jump is landed."""
        lost = (told - self.last_along).clamp_min(0.0)
        low = (0.15 - self.lowest).clamp_min(0.0)
        return -2.0 * self.fell - self.last_tilt - 0.1 * self.last_turn - 0.2 * lost - 5.0 * low

    def way(self, fastest: float) -> torch.Tensor:
        """Ground covered until the trunk is at standing height again, no faster than that [m]."""
        root = (self.up.square() + 2.0 * 9.81 * (self.height - STANDING)).clamp_min(0.0).sqrt()
        return self.along.clamp_max(fastest) * (self.up + root) / 9.81

    def score(self, told: float) -> torch.Tensor:
        """What the search makes as large as it can, for a commanded speed [m/s]."""
        goes = self.up.clamp_max(FASTEST)
        if told:
            goes = self.way(told + LEAP * min(told, 1.0)) + 0.25 * goes
        return (
            goes
            - 0.15 * (self.turn - 0.2).clamp_min(0.0)
            - (self.tilt - 0.05).clamp_min(0.0)
            - 3.0 * (self.after - 0.26).clamp_min(0.0)
            - 3.0 * (0.17 - self.lowest).clamp_min(0.0)
            - self.fell
        )


class Stand:
    """Robots that try candidates for one command."""

    def __init__(self, told: tuple[float, float], policies: list[Path], gains: Path) -> None:
        mjlab_env.Simulation = cpu_engine.CpuSimulation
        cpu_engine.CpuSimulation.threads = 1
        torch.set_num_threads(1)
        self.count = CANDIDATES * MOMENTS
        cfg = env_cfg(
            gains=training_gains(gains, load_robot("mini_cheetah")),
            num_envs=self.count,
            phase=phase("jump_a"),
            randomization=Randomization.none(),
        )
        self.env = mjlab_env.ManagerBasedRlEnv(cfg, device="cpu")
        self.command = motion_command(self.env)
        self.command.scripted = True
        self.held = self.env.action_manager.get_term("joint_position")
        self.subjects: list[Subject] = [load_subject(path, "cpu") for path in policies]
        robot = torch.arange(self.count)
        self.asks = robot % len(policies)
        self.begins = WALK + (robot % MOMENTS) // len(policies) * STRIDE // (
            MOMENTS // len(policies)
        )
        self.told = torch.tensor([*told, 0.0]).expand(self.count, 3)
        speed = self.told.norm(dim=1, keepdim=True).clamp_min(1e-6)
        self.way = (self.told / speed)[:, :2]

    @torch.no_grad()
    def jump(self, targets: torch.Tensor, steps: int = JUMP) -> Jumps:
        """Try candidates: (candidates, rows, 12) [rad]; what counts is up to so many steps on."""
        env, command, robot = self.env, self.command, torch.arange(self.count)
        mine = targets.repeat_interleave(MOMENTS, dim=0)
        # Every candidate begins alike. mjlab's own seed would be that of the search as well.
        torch.manual_seed(0)
        observed, _ = env.reset()
        rated = load_robot("mini_cheetah").joints[0].drive.bus_voltage
        rows = targets.shape[1]
        volts, ohms = torch.full((self.count, 1), VOLTAGE), torch.full((self.count, 1), RESISTANCE)
        if steps > JUMP:
            spread = torch.linspace(-1.0, 1.0, MOMENTS)[torch.randperm(MOMENTS)]
            spread = spread.repeat(self.count // MOMENTS)[:, None]
            volts, ohms = volts + 1.0 * spread, ohms - 0.03 * spread
        self.held.supply.set(volts, ohms, rated)
        command.velocity[:] = self.told
        seen = []
        for step in range(WALK + STRIDE + steps):
            command.jump[:] = step >= self.begins
            command.compute(0.0)
            since = step - self.begins
            leads = ((since >= 0) & (since < rows)).float()[:, None]
            self.held.shown = (mine[robot, since.clamp(0, rows - 1)], leads)
            groups = TensorDict(
                {**observed, "jump": torch.zeros(self.count, 1)}, batch_size=[self.count]
            )
            action = torch.zeros(self.count, len(JOINTS))
            for number, subject in enumerate(self.subjects):
                asked = self.asks == number
                action[asked] = subject.act(groups[asked])
            observed = env.step(action)[0]
            motion = command.motion
            seen.append(
                torch.stack(
                    (
                        motion.velocity_world[:, 2],
                        (motion.velocity_heading[:, :2] * self.way).sum(dim=1),
                        motion.angular_velocity.norm(dim=1),
                        motion.height,
                        env.scene["robot"].data.projected_gravity_b[:, :2].norm(dim=1),
                        env.termination_manager.terminated.float(),
                    )
                )
            )
        window = (self.begins + torch.arange(steps)[:, None])[:, None].expand(steps, 6, -1)
        seen = torch.stack(seen).gather(0, window)
        top = seen[:JUMP, 0].argmax(dim=0)
        up, along, turn, height, tilt, _ = seen[top, :, robot].T
        return Jumps(
            up=up,
            along=along,
            turn=turn,
            height=height,
            tilt=tilt,
            after=(top + 1) * STEP_S,
            lowest=seen[:, 3].amin(dim=0),
            fell=seen[:, 5].amax(dim=0),
            last_tilt=seen[-1, 4],
            last_turn=seen[-1, 2],
            last_along=seen[-1, 1],
        )


def table(aside: bool, knots: np.ndarray) -> torch.Tensor:
    """Joint targets of candidates [rad]. (candidates, rows, 12).

    Args:
        aside: To a side, right legs and left legs have targets of their own, else fore and hind
            legs, left as right.
        knots: Beyond `GUESS`, (candidates, 2 * 3 * knots).
    """
    legs = knots.reshape(len(knots), 2, 3, len(KNOTS))
    time = STEP_S * np.arange(PUSH)
    found = np.empty((len(knots), PUSH, len(JOINTS)))
    for i, (joint, pair, part, sign) in enumerate(_places(aside)):
        folds, stretches = GUESS.get(PARTS[part], (0.0, 0.0))
        guess = np.interp(KNOTS, (0.0, 0.04, 0.1, 0.14, 0.26), (0, folds, folds, 0, stretches))
        for one in range(len(knots)):
            beyond = np.interp(time, KNOTS, guess + legs[one, pair, part])
            found[one, :, i] = joint.default_position + sign * beyond
    return torch.tensor(found, dtype=torch.float32)


def _places(aside: bool) -> Iterator[tuple[Joint, int, int, float]]:
    """Of every joint: it, where a candidate has it (pair of legs, part of a leg), and its sign."""
    for joint in load_robot("mini_cheetah").joints:
        leg, name = joint.name.split("_", 1)
        pair = int(leg[1] == "L") if aside else int(leg[0] == "H")
        sign = -1.0 if not aside and name == "hip_roll" and leg[1] == "R" else 1.0
        yield joint, pair, PARTS.index(name), sign


def flight(aside: bool, push: torch.Tensor, poses: np.ndarray) -> torch.Tensor:
    """Jumps with a pose in flight added [rad]. (candidates, rows, 12).

    Args:
        aside: As in `table`.
        push: Targets up to lift-off, (rows, 12).
        poses: Of hip roll, hip pitch and knee beyond standing, (candidates, 2 * 3).
    """
    pairs = poses.reshape(len(poses), 2, 3)
    pose = np.empty((len(poses), len(JOINTS)))
    for i, (joint, pair, part, sign) in enumerate(_places(aside)):
        pose[:, i] = joint.default_position + sign * pairs[:, pair, part]
    last = push[-1].expand(len(poses), 1, -1)
    share = (torch.arange(1, ROWS - PUSH + 1) / TUCK).clamp_max(1.0)[None, :, None]
    flown = torch.lerp(last, torch.tensor(pose, dtype=torch.float32)[:, None], share)
    return torch.cat((push.expand(len(poses), -1, -1), flown), dim=1)


def climb(
    size: int,
    step: float,
    generations: int,
    seed: int,
    score: Callable[[np.ndarray, bool], torch.Tensor],
) -> np.ndarray:
    """CMA-ES from zero: the mean it comes to. `score` is told every tenth time to say how it is."""
    options = {"popsize": CANDIDATES - 1, "seed": seed, "verbose": -9, "CMA_diagonal": 30}
    strategy = cma.CMAEvolutionStrategy(np.zeros(size), step, options)
    for generation in range(generations):
        asked = strategy.ask()
        scores = score(np.vstack([strategy.mean, *asked]), generation % 10 == 0)
        strategy.tell(asked, [-float(found) for found in scores[1:]])
    mean: np.ndarray = strategy.mean
    score(np.tile(mean, (CANDIDATES, 1)), True)
    return mean


def search(
    told: tuple[float, float], policies: list[Path], gains: Path, generations: int, seed: int
) -> list[list[float]]:
    """The best for a command: joint targets, (rows, 12)."""
    stand = Stand(told, policies, gains)
    speed, aside = float(np.hypot(*told)), told[1] != 0.0

    def say(jumps: Jumps, scores: torch.Tensor) -> None:
        figures = ", ".join(
            f"{name} {values[:MOMENTS].mean():.2f} +- {values[:MOMENTS].std():.2f}"
            for name, values in vars(jumps).items()
        )
        print(f"{told} m/s: score {scores[0]:.3f}, {figures}", file=sys.stderr, flush=True)

    def pushes(knots: np.ndarray, says: bool) -> torch.Tensor:
        jumps = stand.jump(table(aside, knots))
        # Far from standing, what is shown is hard to follow.
        far = torch.tensor(0.02 * np.square(knots).mean(axis=1)).repeat_interleave(MOMENTS)
        scores = (jumps.score(speed) - far).view(-1, MOMENTS).mean(dim=1)
        if says:
            say(jumps, scores)
        return scores

    knots = climb(2 * 3 * len(KNOTS), 0.15, generations, seed, pushes)
    (push,) = table(aside, knots[None])

    def lands(poses: np.ndarray, says: bool) -> torch.Tensor:
        jumps = stand.jump(flight(aside, push, poses), steps=LAND)
        scores = jumps.landing(speed).view(-1, MOMENTS).mean(dim=1)
        if says:
            say(jumps, scores)
        return scores

    pose = climb(2 * 3, 0.2, generations // 4, seed, lands)
    (best,) = flight(aside, push, pose[None])
    return [[round(float(target), 3) for target in row] for row in best]


def main() -> None:
    """Search all commands, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("policies", type=Path, nargs="+", help="walk.onnx of one run or several.")
    parser.add_argument("--gains", type=Path, required=True)
    parser.add_argument("--generations", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True)
    asked = parser.parse_args()
    one = partial(
        search,
        policies=asked.policies,
        gains=asked.gains,
        generations=asked.generations,
        seed=asked.seed,
    )
    with ProcessPoolExecutor(os.cpu_count(), mp_context=get_context("spawn")) as pool:
        found = dict(zip(COMMANDS, pool.map(one, COMMANDS), strict=True))
    content = {
        "schema_version": SCHEMA_VERSION,
        "found_by": f"tools/find_jump.py --generations {asked.generations} --seed {asked.seed}",
        "with": [{"policy": sha256(path)} for path in asked.policies],
        "step_s": STEP_S,
        "joints": list(JOINTS),
        "jumps": [
            {"forward": forward, "left": left, "targets": targets}
            for (forward, left), targets in found.items()
        ],
    }
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=100)
    asked.out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
