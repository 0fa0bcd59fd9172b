"""Everything of a running environment that its next step depends on, and of its process.

mjlab saves none of it. Of the physics, MuJoCo's integration state is saved, with the model's
fields that differ from robot to robot; everything else in its data follows from that. Of managers,
entities and sensors, whatever they remember (`pronk.train.runner.memory`).

Held by a test: on Warp's CPU device the steps after restoring are those of the uninterrupted run,
bit for bit.
"""

from __future__ import annotations

import random
from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np
import torch
import warp as wp

from pronk.errors import ArtefactError
from pronk.train.runner.memory import Memory, check_alike, check_same, put_back, walk

_COUNTERS = (
    "episode_length_buf",
    "common_step_counter",
    "_sim_step_counter",
    "_manual_reset_pending",
)
"""What the environment itself counts."""
_MANAGERS = (
    "event_manager",
    "command_manager",
    "action_manager",
    "observation_manager",
    "termination_manager",
    "reward_manager",
    "curriculum_manager",
    "metrics_manager",
)
INTEGRATION = (
    "time",
    "qpos",
    "qvel",
    "act",
    "history",
    "qacc_warmstart",
    "ctrl",
    "qfrc_applied",
    "xfrc_applied",
    "eq_active",
    "mocap_pos",
    "mocap_quat",
    "userdata",
)
"""MuJoCo's integration state, mjSTATE_INTEGRATION, as fields of MuJoCo Warp's data."""
_PHYSICS = "physics/"


def environment_state(env: Any) -> dict[str, Any]:
    """What the next step of an environment depends on, random generators of the process apart.

    Args:
        env: A `ManagerBasedRlEnv`, between two steps.

    Returns:
        Path to tensor (on the environment's device, a copy), array, number, tuple of numbers or
        None.
    """
    state = {name: memory.copy() for name, memory in _remembered(env).items()}
    state |= {name: there.clone() for name, there in _physics(env).items()}
    return state


def restore_environment(env: Any, state: Mapping[str, Any]) -> None:
    """Put an environment built from the same configuration where another one was.

    Args:
        env: A `ManagerBasedRlEnv` of as many environments, on any device.
        state: From `environment_state`.

    Raises:
        ArtefactError: The state is of another number of environments, or it and the environment
            do not remember the same things: another task, or another version of pronk or mjlab.
    """
    count = len(state["counter/episode_length_buf"])
    if count != env.num_envs:
        raise ArtefactError(
            f"the checkpoint is of {count} environments, this run has {env.num_envs}; resume with "
            f"{count} environments, or load the networks alone."
        )
    physics = {name: value for name, value in state.items() if name.startswith(_PHYSICS)}
    remembered = {name: value for name, value in state.items() if name not in physics}
    with torch.no_grad():
        if remembered.keys() != _remembered(env).keys():
            # Some things are made at the first step; what it changes is restored with the rest.
            actions = env.action_manager.total_action_dim
            env.step(torch.zeros(env.num_envs, actions, device=env.device))
        put_back(partial(_remembered, env), remembered, env.device)
        _restore_physics(env, physics)
    for sensor in env.scene.sensors.values():
        sensor._invalidate_cache()
    env.obs_buf = env.observation_manager.compute()  # those just restored: nothing is drawn


def _remembered(env: Any) -> dict[str, Memory]:
    return dict(_walk_environment(env))


def _walk_environment(env: Any) -> Iterator[tuple[str, Memory]]:
    for name in _COUNTERS:
        yield f"counter/{name}", Memory(getattr(env, name), partial(setattr, env, name))
    # Drawn anew in every step, but needed by the first.
    yield "counter/decimation", Memory(env.cfg.decimation, partial(setattr, env.cfg, "decimation"))
    seen: dict[int, Any] = {}
    # The configuration of a robot or sensor is spent when it is built; that of a manager's term
    # is read at every step, and curricula write to it.
    for kind in ("entities", "sensors"):
        for name, part in getattr(env.scene, kind).items():
            yield from walk(f"{kind}/{name}", part, seen, skip={"cfg"})
    for manager in _MANAGERS:
        yield from walk(manager, getattr(env, manager), seen)


def _physics(env: Any) -> dict[str, torch.Tensor]:
    """Views of the physics' memory: the state, and what may differ from the compiled model."""
    data, model, found = env.sim.wp_data, env.sim.wp_model, {}
    for name in INTEGRATION:
        found[f"data/{name}"] = getattr(data, name)
    for name in sorted(env.sim.expanded_fields):
        found[f"model/{name}"] = getattr(model, name)
    # Recomputing constants after a draw of masses changes the mean inertia, which the solver's
    # tolerance is relative to.
    for part in ("opt", "stat"):
        for name, value in vars(getattr(model, part)).items():
            if isinstance(value, wp.array):
                found[f"{part}/{name}"] = value
    return {_PHYSICS + name: wp.to_torch(array) for name, array in found.items() if array.size > 0}


def _restore_physics(env: Any, state: Mapping[str, Any]) -> None:
    there = _physics(env)
    check_same(state, there)
    for name, memory in there.items():
        check_alike(name, memory, state[name])
        memory.copy_(state[name])
    if env.sim.wp_device.is_cuda:
        torch.cuda.synchronize(env.device)  # Warp computes on a stream of its own
    # What MuJoCo derives from its state, for whoever reads it before the next step.
    env.sim.forward()
    env.sim.sense()


def random_state(device: str | torch.device) -> dict[str, Any]:
    """States of the process's random generators: torch (CPU and `device`), numpy, python."""
    version, words, spare = random.getstate()
    device = torch.device(device)
    return {
        "torch": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state(device) if device.type == "cuda" else None,
        "numpy": np.random.get_state(legacy=False),  # noqa: NPY002 (mjlab and its terms use it)
        "python": {"version": version, "words": np.array(words, dtype=np.uint32), "spare": spare},
    }


def restore_random(state: Mapping[str, Any], device: str | torch.device) -> None:
    """Set the process's random generators.

    Args:
        state: From `random_state`.
        device: The device whose generator is set, if both it and the state have one.
    """
    device = torch.device(device)
    torch.set_rng_state(state["torch"])
    if device.type == "cuda" and state["cuda"] is not None:
        torch.cuda.set_rng_state(state["cuda"], device)
    np.random.set_state(state["numpy"])  # noqa: NPY002
    python = state["python"]
    words = tuple(int(word) for word in python["words"])
    random.setstate((python["version"], words, python["spare"]))
