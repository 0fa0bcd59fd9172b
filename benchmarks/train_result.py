"""What `pronk bench train` found: rates side by side, stage by stage, as JSON and as tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from rich.table import Table
from rich.text import Text

from benchmarks.train_stages import StageCost

SCHEMA = "pronk/bench-train/1"


@dataclass(frozen=True, kw_only=True)
class Rate:
    """Environment steps per second of all blocks of one kind, in the order they were run."""

    blocks: tuple[float, ...]

    @property
    def median(self) -> float:
        """Of the blocks [1/s]."""
        return float(np.median(self.blocks))

    @property
    def span(self) -> tuple[float, float]:
        """Slowest and fastest block [1/s]."""
        return min(self.blocks), max(self.blocks)


@dataclass(frozen=True, kw_only=True)
class TaskSpeed:
    """One task at one number of environments."""

    task: str
    envs: int
    stepping: Rate
    """Environments alone, random actions."""
    training: Rate
    """The task's own PPO, everything included but checkpoints."""
    physics_per_step: float
    """Physics steps in a step of the environment, mean over the blocks of stepping."""
    step_stages: tuple[StageCost, ...]
    """Of one step of all environments."""
    iteration_stages: tuple[StageCost, ...]
    """Of one iteration of training."""
    horizon: int
    """Steps of every environment in one iteration."""
    memory_mb: float
    """What the device gives to the task, its first iteration included [MB]; NaN on the CPU."""
    cuda_graphs: bool
    """Whether the simulation runs as captured CUDA graphs."""
    build_s: float
    """Time to build, compile and warm up [s]."""


@dataclass(frozen=True, kw_only=True)
class Scaling:
    """Training on one GPU and on several of one host."""

    task: str
    envs: int
    """Environments on each GPU."""
    rates: dict[int, Rate]
    """By number of GPUs; environment steps of all of them together."""

    @property
    def ratio(self) -> float:
        """Rate of the most GPUs over that of one."""
        return self.rates[max(self.rates)].median / self.rates[1].median


@dataclass(frozen=True, kw_only=True)
class TrainBench:
    """Both tasks at every number of environments."""

    pairs: tuple[tuple[TaskSpeed, TaskSpeed], ...]
    """pronk and its peer, for each number of environments."""
    scaling: Scaling | None
    steps: int
    """Steps of every environment in a block of stepping."""
    iterations: int
    """Iterations in a block of training."""
    machine: dict[str, str]
    seconds: float
    """Wall time of the whole run [s]."""

    def figures(self) -> dict[str, Any]:
        """All figures, and the ratios, for JSON."""
        ratios = [
            {
                "envs": ours.envs,
                "stepping": ratio(ours.stepping, peer.stepping),
                "training": ratio(ours.training, peer.training),
            }
            for ours, peer in self.pairs
        ]
        body = asdict(self) | {"ratios": ratios}
        if self.scaling is not None:
            body["scaling"]["ratio"] = self.scaling.ratio
        return {"schema": SCHEMA, **body}


def ratio(ours: Rate, peer: Rate) -> tuple[float, float, float]:
    """Ratio of two rates whose blocks were run in turn: median, least and greatest.

    Each block is compared with the one run beside it, so that a device that slows down does not
    decide.
    """
    each = np.array(ours.blocks) / np.array(peer.blocks)
    return float(np.median(each)), float(each.min()), float(each.max())


def table(result: TrainBench) -> Table:
    """Rates and ratios as one table for a terminal."""
    first = result.pairs[0]
    made = Table(
        title=Text("Environment steps per second, in thousands: median (slowest to fastest block)"),
        caption=Text(_caption(result)),
        title_justify="left",
        caption_justify="left",
    )
    made.add_column(Text("environments"))
    made.add_column(Text("what"))
    for speed in first:
        made.add_column(Text(speed.task), justify="right")
    made.add_column(Text("ratio"), justify="right")
    for pair in result.pairs:
        made.add_section()
        for what in ("stepping", "training"):
            ours, peer = (getattr(speed, what) for speed in pair)
            middle, least, most = ratio(ours, peer)
            made.add_row(
                f"{pair[0].envs:,}",
                what,
                _rate(ours),
                _rate(peer),
                f"{middle:.2f} ({least:.2f} to {most:.2f})",
            )
        made.add_row("", "physics steps a step", *(f"{s.physics_per_step:.2f}" for s in pair), "")
        made.add_row(
            "", "GPU memory [GB]", *(_number(speed.memory_mb / 1024.0, 2) for speed in pair), ""
        )
        made.add_row("", "build and warm up [s]", *(f"{speed.build_s:.1f}" for speed in pair), "")
    if result.scaling is not None:
        made.add_section()
        for count, rate in result.scaling.rates.items():
            ours = f"x{rate.median / result.scaling.rates[1].median:.2f}"
            what = f"training, {count} GPU{'s' if count > 1 else ''}"
            made.add_row(f"{result.scaling.envs:,} each", what, _rate(rate), "", ours)
    return made


def stage_table(result: TrainBench) -> Table:
    """What each stage of a step and of an iteration costs."""
    made = Table(
        title=Text("Stages [ms], waited for one by one; operations and host waits per step"),
        caption=Text(
            "The wait after each stage takes away the overlap of host and device, so that the sums "
            "are more than a step takes. Operations: of PyTorch, views left out, counted apart "
            "from the times; waits: for a result of the device."
        ),
        title_justify="left",
        caption_justify="left",
    )
    speeds = [speed for pair in result.pairs for speed in pair]
    made.add_column(Text("stage"))
    for speed in speeds:
        made.add_column(Text(f"{_short(speed.task)}\n{speed.envs:,}"), justify="right")
    for speed in result.pairs[-1]:
        made.add_column(Text(f"{_short(speed.task)}\noperations / waits"), justify="right")
    for what, title in (
        ("step_stages", "one step"),
        ("iteration_stages", f"one iteration of {speeds[0].horizon} steps"),
    ):
        made.add_section()
        tables = [{cost.stage: cost for cost in getattr(speed, what)} for speed in speeds]
        names = dict.fromkeys(name for one in tables for name in one if name != "rest")
        sums = [sum(cost.milliseconds for cost in one.values()) for one in tables]
        made.add_row(
            Text(title, style="bold"),
            *(f"{value:.2f}" for value in sums),
            *(_counts(one.values()) for one in map(dict, tables[-2:])),
        )
        for name in (*names, "rest"):
            cells = [f"{one[name].milliseconds:.2f}" if name in one else "" for one in tables]
            counts = [_counts([one[name]]) if name in one else "" for one in tables[-2:]]
            made.add_row(f"  {name}", *cells, *counts)
    return made


def _counts(found: Any) -> str:
    many: Sequence[StageCost] = list(found)
    operations = sum(cost.operations for cost in many)
    return f"{operations:.0f} / {sum(cost.waits for cost in many):.0f}"


def _short(task: str) -> str:
    """`Pronk-Jump-MiniCheetah` is enough as `MiniCheetah`."""
    return task.rsplit("-", 1)[-1]


def _rate(rate: Rate) -> str:
    low, high = rate.span
    return f"{rate.median / 1e3:.1f} ({low / 1e3:.1f} to {high / 1e3:.1f})"


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if np.isfinite(value) else "-"


def _caption(result: TrainBench) -> str:
    blocks = len(result.pairs[0][0].stepping.blocks)
    machine = result.machine
    captured = all(speed.cuda_graphs for pair in result.pairs for speed in pair)
    graphs = "with CUDA graphs" if captured else "WITHOUT CUDA graphs"
    return (
        f"{blocks} blocks of {result.steps} steps and {blocks} of {result.iterations} iterations "
        "for each task, in turn; the ratio is of neighbouring blocks. Stepping: small random "
        "actions, nothing but the environment. Training: the task's own networks and PPO, with "
        "logging, without checkpoints.\n"
        f"{machine['device']}, {graphs}, mjlab {machine['mjlab']}, MuJoCo Warp "
        f"{machine['mujoco-warp']}, rsl_rl {machine['rsl-rl-lib']}, PyTorch {machine['torch']}; "
        f"{result.seconds:.0f} s in all."
    )
