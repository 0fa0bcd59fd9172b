"""The time of a study's trainings: closed forms, bounds, and what was measured."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from command_line import accepted, refused
from pronk.jump.study.training_time import (
    COMPILED_RATES,
    RATES,
    START_S,
    TrainingSize,
    training_rate,
    training_time,
)

RECIPE_STEPS = 1080 * 24 * 4096


def alike(
    count: int, iterations: int = 1080, envs: int = 4096, *, is_compiled: bool = False
) -> list[TrainingSize]:
    size = TrainingSize(env_steps=iterations * 24 * envs, envs=envs, is_compiled=is_compiled)
    return [size] * count


@pytest.mark.parametrize("count", sorted(RATES))
@pytest.mark.parametrize("gpus", [1, 4])
def test_trainings_that_are_alike_take_their_steps_at_the_measured_rate(
    count: int, gpus: int
) -> None:
    time = training_time(alike(count * gpus), gpus, count)
    assert time.low_s == pytest.approx(START_S[0] + RECIPE_STEPS / RATES[count])
    assert time.high_s == pytest.approx(START_S[1] + RECIPE_STEPS / RATES[count])
    assert time.gpu_hours[1] == pytest.approx(gpus * time.high_s / 3600.0)


@pytest.mark.parametrize(
    ("trainings", "gpus", "per_gpu", "seconds"),
    [
        (16, 4, 4, 1366.0),
        (12, 4, 3, 1150.0),
        (5, 1, 5, 1527.0),
        (3, 1, 3, 1100.0),
        (1, 1, 1, 702.0),
    ],
)
def test_what_was_measured_is_within_the_estimate(
    trainings: int, gpus: int, per_gpu: int, seconds: float
) -> None:
    """By docs/evidence/results.md; the time of one alone is the 11.7 minutes of issue 43."""
    time = training_time(alike(trainings), gpus, per_gpu)
    assert 0.95 * time.low_s <= seconds <= 1.05 * time.high_s
    assert time.high_s < 1.2 * time.low_s


@pytest.mark.parametrize(
    ("trainings", "gpus", "per_gpu", "seconds"), [(15, 3, 5, 1425.0), (1, 1, 1, 549.0)]
)
def test_what_was_measured_with_compile_is_within_the_estimate(
    trainings: int, gpus: int, per_gpu: int, seconds: float
) -> None:
    """By docs/evidence/training.md, "Three changes of the default recipe" and "Speed"."""
    time = training_time(alike(trainings, is_compiled=True), gpus, per_gpu)
    assert 0.95 * time.low_s <= seconds <= 1.05 * time.high_s
    assert time.high_s < training_time(alike(trainings), gpus, per_gpu).low_s


def test_compiled_trainings_beside_others_have_their_own_rate() -> None:
    """Two on one GPU: the compiled one is over first, the other goes on alone."""
    sizes = [*alike(1, is_compiled=True), *alike(1)]
    both_s = RECIPE_STEPS / training_rate(2, is_compiled=True)
    left = RECIPE_STEPS - both_s * training_rate(2)
    expected = START_S[0] + both_s + left / RATES[1]
    assert training_time(sizes, 1, 2).low_s == pytest.approx(expected)
    assert training_rate(1, is_compiled=True) == COMPILED_RATES[1]


def test_a_gpu_with_fewer_trainings_is_faster_for_each() -> None:
    """One of three trainings on one GPU waits until one of the two before it is over."""
    first, second, third = (n * 24 * 4096.0 for n in (100, 300, 200))
    sizes = [TrainingSize(env_steps=steps, envs=4096) for steps in (first, second, third)]
    rate_of_two = training_rate(2)
    start = START_S[0]
    first_over = start + first / rate_of_two
    # While the third one builds, both count as running.
    left_of_second = second - first - start * rate_of_two
    assert left_of_second > 0.0
    second_over = first_over + start + min(left_of_second, third) / rate_of_two
    alone_s = abs(third - left_of_second) / training_rate(1)
    assert training_time(sizes, 1, 2).low_s == pytest.approx(second_over + alone_s)


@given(
    st.lists(st.integers(1, 3000), min_size=1, max_size=40),
    st.integers(1, 8),
    st.integers(1, 8),
    st.sampled_from([16, 1024, 4096, 16384]),
)
def test_times_grow_with_work_and_are_no_shorter_than_all_gpus_at_their_best(
    iterations: list[int], gpus: int, per_gpu: int, envs: int
) -> None:
    sizes = [TrainingSize(env_steps=count * 24 * envs, envs=envs) for count in iterations]
    time = training_time(sizes, gpus, per_gpu)
    assert 0.0 < time.low_s <= time.high_s
    best = max(count * training_rate(count) for count in range(1, per_gpu + 1))
    low_steps = sum(size.bounds[0] for size in sizes)
    assert time.low_s >= 0.999 * low_steps / best / gpus
    longest = max(size.bounds[0] for size in sizes) / training_rate(1)
    assert time.low_s >= 0.999 * (longest + START_S[0])
    one_by_one = sum(START_S[1] + size.bounds[1] / training_rate(1) for size in sizes)
    alone = training_time(sizes, 1, 1)
    assert alone.high_s == pytest.approx(one_by_one)
    more = [*sizes, sizes[0]]
    assert training_time(more, gpus, per_gpu).high_s >= 0.999 * time.high_s


def test_another_number_of_robots_gives_bounds() -> None:
    """Between the same iterations and the same steps of the number that was measured."""
    fewer = training_time(alike(1, envs=1024), 1, 1)
    more = training_time(alike(1, envs=16384), 1, 1)
    same = training_time(alike(1), 1, 1)
    assert fewer.high_s == pytest.approx(same.high_s)
    assert fewer.low_s - START_S[0] == pytest.approx((same.low_s - START_S[0]) / 4)
    assert more.low_s == pytest.approx(same.low_s)
    assert more.high_s - START_S[1] == pytest.approx(4 * (same.high_s - START_S[1]))


def test_rates_are_those_that_were_measured_and_between_them_together_no_less() -> None:
    for count, rate in RATES.items():
        assert training_rate(count) == rate
    together = [count * training_rate(count) for count in range(1, 12)]
    for before, after in itertools.pairwise(together):
        assert after >= 0.999 * before
    largest = max(RATES)
    assert 11 * training_rate(11) == pytest.approx(largest * RATES[largest])


# ---- the plan of a study ----


def plan(tmp_path: Path, *words: str, **changes: Any) -> tuple[dict[str, Any], str]:
    """Return the figures of the plan of a study with some sections, and what was printed."""
    body = {
        "schema": "pronk/study/1",
        "title": "Planned",
        "seeds": "1-4",
        "arms": {"a": {"gains": "naive"}, "b": {"gains": "naive"}},
        **changes,
    }
    path = tmp_path / "study.yaml"
    path.write_text(yaml.safe_dump(body, sort_keys=False))
    figures = tmp_path / "plan.json"
    text = accepted("study", path, "--plan", "--out", tmp_path / "o", "--json", figures, *words)
    return json.loads(figures.read_text()), text


def test_the_plan_follows_from_the_file_and_the_gpus(tmp_path: Path) -> None:
    gpus = ("--gpus", "0,1", "--per-gpu", "4")
    plain, text = plan(tmp_path, *gpus)
    expected = training_time(alike(8), 2, 4)
    assert plain["training_seconds"] == pytest.approx([expected.low_s, expected.high_s])
    assert plain["gpu_hours"] == pytest.approx(list(expected.gpu_hours))
    assert (plain["gpus"], plain["per_gpu"]) == (2, 4)
    for word in ("1,080", "4,096", "87,000", "results.md", "H200"):
        assert word in text
    # The command that it names plans for the same GPUs.
    assert "--gpus 0,1 --per-gpu 4" in text.split("next:")[1]
    # Iterations, also of one arm alone.
    short, _ = plan(tmp_path, *gpus, training={"phases": {"walk": 10, "jump_a": 10, "jump_b": 10}})
    steps = alike(1, iterations=30)[0].env_steps
    assert short["training_seconds"][0] == pytest.approx(START_S[0] + steps / RATES[4])
    one_arm = {"a": {"gains": "naive"}, "b": {"gains": "naive", "options": "--phase jump_b=60"}}
    mixed, text = plan(tmp_path, *gpus, arms=one_arm)
    assert mixed["env_steps"] == 4 * 24 * 4096 * (1080 + 580)
    assert "580" in text
    assert plain["training_seconds"][0] >= mixed["training_seconds"][0]
    one_gpu = ("--gpus", "0", "--per-gpu", "4")
    all_long = plan(tmp_path, *one_gpu)[0]["training_seconds"][0]
    assert plan(tmp_path, *one_gpu, arms=one_arm)[0]["training_seconds"][0] < 0.9 * all_long
    # With --compile.
    compiled, text = plan(tmp_path, *gpus, training={"options": "--compile"})
    expected = training_time(alike(8, is_compiled=True), 2, 4)
    assert compiled["training_seconds"] == pytest.approx([expected.low_s, expected.high_s])
    assert "87,000" not in text
    assert f"{COMPILED_RATES[1]:,.0f}" in text
    # Robots, seeds, GPUs, trainings on each.
    robots, text = plan(tmp_path, *gpus, training={"envs": 1024})
    assert robots["training_seconds"][0] < 0.5 * plain["training_seconds"][0]
    assert robots["training_seconds"][1] == pytest.approx(plain["training_seconds"][1])
    assert "1,024" in text
    seeds, _ = plan(tmp_path, *gpus, seeds="1-8")
    assert seeds["training_seconds"][0] == pytest.approx(2 * plain["training_seconds"][0])
    four, _ = plan(tmp_path, "--gpus", "0,1,2,3", "--per-gpu", "4")
    assert four["training_seconds"][0] < plain["training_seconds"][0]
    single, _ = plan(tmp_path, "--gpus", "0,1", "--per-gpu", "1")
    rate = RATES[1]
    assert single["training_seconds"][0] == pytest.approx(4 * (START_S[0] + RECIPE_STEPS / rate))


@pytest.mark.parametrize(
    "words", [("--device", "cpu"), ("--cluster", "ray://head:10001"), ("--device", "auto")]
)
def test_no_time_is_named_where_none_was_measured(
    tmp_path: Path, words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """On the CPU, on a host without a GPU, on a cluster whose GPUs are not known."""
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    figures, text = plan(tmp_path, *words)
    assert figures["training_seconds"] is None
    assert figures["gpu_hours"] is None
    assert figures["env_steps"] == 8 * RECIPE_STEPS
    assert "minutes" not in text
    assert "steps/s" not in text
    assert "CPU" in text


def test_gpus_that_are_no_numbers_are_refused(tmp_path: Path) -> None:
    plan(tmp_path)
    for words in (("--gpus", "0,0"), ("--gpus", "x"), ("--gpus", "0", "--device", "cpu")):
        assert "--gpus" in refused("study", tmp_path / "study.yaml", "--plan", *words)


def test_a_plan_says_that_one_seed_has_no_interval(tmp_path: Path) -> None:
    assert "n = 1" in plan(tmp_path, seeds="3")[1]
    assert "n = 1" not in plan(tmp_path)[1]


def test_an_arm_has_phases_of_its_own(tmp_path: Path) -> None:
    """Also where the study names the same phase for all."""
    arms = {"a": {"gains": "naive"}, "b": {"gains": "naive", "options": "--phase jump_b=60"}}
    figures, _ = plan(tmp_path, arms=arms, training={"phases": {"jump_b": 100, "walk": 50}})
    assert figures["env_steps"] == 4 * 24 * 4096 * ((50 + 220 + 100) + (50 + 220 + 60))
