"""`pronk bench train`: stages add up, operations are counted, both tasks are run as registered."""

from __future__ import annotations

import io
import json

import pytest
from rich.console import Console

from benchmarks.__main__ import train
from benchmarks.train import in_turn, run
from benchmarks.train_result import Rate, Scaling, TaskSpeed, TrainBench, ratio, stage_table, table
from benchmarks.train_stages import REST, StageCost, Stages, costs, counted
from pronk.errors import PronkError


class Clock:
    """A clock that is told what time it is."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


class Work:
    """Something whose methods take a known time."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock

    def outer(self) -> str:
        self.clock.now += 1.0
        self.inner()
        self.clock.now += 2.0
        return "done"

    def inner(self) -> None:
        self.clock.now += 10.0

    def fails(self) -> None:
        self.clock.now += 5.0
        raise ValueError("on purpose")


def speed(task: str, envs: int, blocks: tuple[float, ...]) -> TaskSpeed:
    cost = StageCost(stage="physics", milliseconds=2.0, operations=7.0, waits=1.0)
    rest = StageCost(stage=REST, milliseconds=0.5, operations=1.0, waits=0.0)
    return TaskSpeed(
        task=task,
        envs=envs,
        stepping=Rate(blocks=blocks),
        training=Rate(blocks=tuple(0.5 * one for one in blocks)),
        physics_per_step=4.0,
        step_stages=(cost, rest),
        iteration_stages=(rest,),
        horizon=24,
        memory_mb=float("nan"),
        cuda_graphs=False,
        build_s=1.0,
    )


def result(scaling: Scaling | None = None) -> TrainBench:
    return TrainBench(
        pairs=((speed("Pronk-A", 8, (300e3, 200e3)), speed("Peer-B", 8, (100e3, 200e3))),),
        scaling=scaling,
        steps=5,
        iterations=1,
        machine=dict.fromkeys(("device", "mjlab", "mujoco-warp", "rsl-rl-lib", "torch"), "1"),
        seconds=1.0,
    )


def text(made: object) -> str:
    console = Console(width=160, file=io.StringIO(), record=True)
    console.print(made)
    return console.export_text()


def test_time_belongs_to_the_innermost_stage_and_all_of_it_to_some() -> None:
    clock = Clock()
    work = Work(clock)
    stages = Stages(clock=clock)
    parts = [(work, "outer", "o"), (work, "inner", "i"), (work, "no_such_method", "n")]
    with stages.measured(parts):
        clock.now += 100.0
        assert work.outer() == "done"
        work.inner()
    assert dict(stages.seconds) == {REST: 100.0, "o": 3.0, "i": 20.0}
    # Unwrapped again: nothing more is written down.
    assert set(vars(work)) == {"clock"}
    work.outer()
    assert sum(stages.seconds.values()) == 123.0


def test_a_method_that_raises_is_paid_for_and_unwrapped() -> None:
    clock = Clock()
    work = Work(clock)
    stages = Stages(clock=clock)
    with pytest.raises(ValueError, match="on purpose"), stages.measured([(work, "fails", "f")]):
        work.fails()
    assert stages.seconds["f"] == 5.0
    assert stages.current == REST
    assert set(vars(work)) == {"clock"}


def test_a_method_set_on_the_instance_comes_back() -> None:
    clock = Clock()
    work = Work(clock)

    def own() -> None:
        clock.now += 4.0

    work.inner = own  # type: ignore[method-assign]
    stages = Stages(clock=clock)
    with stages.measured([(work, "inner", "i")]):
        work.inner()
    assert stages.seconds["i"] == 4.0
    assert work.inner is own


def test_the_device_is_waited_for_at_every_border() -> None:
    clock = Clock()
    work = Work(clock)

    def wait() -> None:
        # What was launched and not waited for yet takes one more second.
        clock.now += 1.0

    stages = Stages(wait=wait, clock=clock)
    with stages.measured([(work, "inner", "i")]):
        work.inner()
    assert dict(stages.seconds) == {REST: 2.0, "i": 11.0}


def test_blocks_take_turns_and_the_first_one_changes() -> None:
    order: list[str] = []

    def block(name: str) -> float:
        order.append(name)
        return float(len(order))

    times = in_turn([lambda: block("a"), lambda: block("b")], 3)
    assert order == ["a", "b", "b", "a", "a", "b"]
    assert times == [[1.0, 4.0, 5.0], [2.0, 3.0, 6.0]]


def test_the_ratio_is_of_neighbouring_blocks() -> None:
    # A device that halves its speed after the first turn changes no ratio.
    ours, peer = Rate(blocks=(300.0, 150.0, 160.0)), Rate(blocks=(200.0, 100.0, 100.0))
    assert ratio(ours, peer) == pytest.approx((1.5, 1.5, 1.6))
    assert ours.median == 160.0
    assert ours.span == (150.0, 300.0)


def test_costs_are_means_with_the_rest_last() -> None:
    clock = Clock()
    work = Work(clock)
    stages = Stages(clock=clock)
    with stages.measured([(work, "inner", "i")]):
        clock.now += 1.0
        work.inner()
        work.inner()
    from collections import Counter

    found = costs(4, stages, Counter(i=6), Counter(i=3), 2)
    assert [one.stage for one in found] == ["i", REST]
    assert found[0].milliseconds == pytest.approx(5000.0)
    assert (found[0].operations, found[0].waits) == (3.0, 1.5)
    assert found[1].milliseconds == pytest.approx(250.0)


def test_tables_and_figures_say_the_same() -> None:
    scaling = Scaling(
        task="Pronk-A", envs=8, rates={1: Rate(blocks=(100e3,)), 2: Rate(blocks=(180e3,))}
    )
    made = result(scaling)
    shown = text(table(made))
    assert "2.00 (1.00 to 3.00)" in shown
    assert "250.0 (200.0 to 300.0)" in shown
    assert "WITHOUT CUDA graphs" in shown
    assert "x1.80" in shown
    stages = text(stage_table(made))
    assert "8 / 1" in stages
    assert "2.50" in stages
    figures = made.figures()
    assert figures["schema"] == "pronk/bench-train/1"
    assert figures["ratios"] == [
        {"envs": 8, "stepping": (2.0, 1.0, 3.0), "training": (2.0, 1.0, 3.0)}
    ]
    assert figures["scaling"]["ratio"] == pytest.approx(1.8)


@pytest.mark.parametrize("wrong", [{"envs": ()}, {"envs": (0,)}, {"steps": 0}, {"repeats": 0}])
def test_impossible_numbers_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(PronkError, match="expected 1 or more"):
        run(**wrong)  # type: ignore[arg-type]


def test_numbers_of_environments_that_are_none() -> None:
    with pytest.raises(PronkError, match="--envs '16,many'"):
        train(envs="16,many")


@pytest.mark.train
def test_operations_and_waits_are_counted_by_stage() -> None:
    torch = pytest.importorskip("torch")

    class Sums:
        def add(self, x: object) -> object:
            return (x + x) * 2.0  # type: ignore[operator]

        def look(self, x: object) -> float:
            return float((x > 0.0).sum().item())  # type: ignore[operator]

        def pick(self, x: object) -> object:
            return x[x > 0.0]  # type: ignore[index]

    sums, x = Sums(), torch.ones(3, 2)
    stages = Stages()
    parts = [(sums, "add", "add"), (sums, "look", "look"), (sums, "pick", "pick")]
    with torch.no_grad(), stages.measured(parts), counted(stages) as (operations, waits):
        sums.add(x)
        sums.look(x)
        sums.pick(x)
        x.view(6)[:3].t()  # views: they compute nothing
        x.mul_(2.0)
    assert dict(operations) == {"add": 2, "look": 3, "pick": 2, REST: 1}
    assert +waits == {"look": 1, "pick": 1}
    assert x.sum() == 12.0


@pytest.fixture
def small_task() -> str:
    """The jump task with small networks and one pass over the rollout, to be quick."""
    pytest.importorskip("mjlab")
    import mjlab.tasks  # noqa: F401 - registers mjlab's own
    from mjlab.tasks.registry import list_tasks, load_env_cfg, load_rl_cfg, register_mjlab_task

    from pronk.train.runner.runner import PronkRunner
    from pronk.train.tasks import JUMP_TASK

    name = "Pronk-Bench-Small"
    if name not in list_tasks():
        learning = load_rl_cfg(JUMP_TASK)
        learning.actor.hidden_dims = learning.critic.hidden_dims = (8,)
        learning.algorithm.num_learning_epochs = 1
        learning.num_steps_per_env = 8
        env_cfg = load_env_cfg(JUMP_TASK)
        register_mjlab_task(name, env_cfg, env_cfg, learning, PronkRunner)
    return name


@pytest.mark.train
@pytest.mark.slow
def test_the_whole_bench_small(small_task: str, capsys: pytest.CaptureFixture[str]) -> None:
    told: list[str] = []
    found = run(
        told.append, envs=(4,), steps=4, repeats=1, device="cpu", tasks=(small_task, small_task)
    )
    ours, peer = found.pairs[0]
    assert (ours.task, ours.envs, ours.horizon) == (small_task, 4, 8)
    for one in (ours, peer):
        stages = {cost.stage: cost for cost in one.step_stages}
        # Everything that Warp computes is unseen by the count.
        assert stages["physics"].operations == 0.0
        assert stages["rewards"].operations > 0.0
        assert list(stages)[-1] == REST
        iteration = {cost.stage: cost for cost in one.iteration_stages}
        assert {"inference", "advantages", "PPO update", "estimator update"} <= set(iteration)
        # Resets come and go, and so do physics steps.
        step = sum(cost.operations for cost in one.step_stages)
        assert 0.5 * 8 * step < iteration["environment"].operations < 2.0 * 8 * step
        assert iteration["logging"].operations > 0.0
        assert 2.0 <= one.physics_per_step <= 6.0
    assert sum("steps/s" in line for line in told) == 2
    json.dumps(found.figures())
    # What the runner prints is none of the bench's.
    assert capsys.readouterr().out == ""


@pytest.mark.train
def test_an_unknown_task_is_named_with_those_there_are() -> None:
    pytest.importorskip("mjlab")
    with pytest.raises(PronkError, match=r"no task 'Cartwheel'.*Unitree-Go1"):
        run(envs=(2,), device="cpu", tasks=("Cartwheel", "Cartwheel"))
