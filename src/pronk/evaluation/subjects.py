"""The policies of a trial: opened, checked and named before anything moves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pronk.errors import ArtefactError, PronkError
from pronk.evaluation.result import Subject
from pronk.policy.contract import Contract, check
from pronk.policy.runtime import load_policy
from pronk.robots.robot import Robot


def load_subjects(paths: Sequence[Path], robot: Robot, *, jump: bool = True) -> tuple[Subject, ...]:
    """Open and check policies, before anything moves.

    A policy is called after the gains of its training; two of a kind, after their files.

    Raises:
        ArtefactError: Missing, damaged, its contract does not fit the robot, or it cannot jump;
            the sentence names file and field.
        PronkError: The same policy twice.
    """
    found = []
    for path in paths:
        policy = load_policy(path)
        try:
            check(policy.contract, robot)
        except ArtefactError as error:
            raise ArtefactError(f"{path}: {error}") from None
        if jump and not policy.contract.jump:
            raise ArtefactError(
                f"{path}: this policy was trained to walk only and has no jump input; "
                "`pronk train jump` teaches it."
            )
        found.append((path, policy))
    hashes = [policy.sha256 for _, policy in found]
    if len(set(hashes)) != len(hashes):
        raise PronkError(
            f"{', '.join(map(str, paths))}: the same policy twice; give each policy once."
        )
    names = _names([(path, policy.contract) for path, policy in found])
    return tuple(
        Subject(name=name, path=str(path), sha256=policy.sha256, contract=_summary(policy.contract))
        for name, (path, policy) in zip(names, found, strict=True)
    )


def _names(policies: Sequence[tuple[Path, Contract]]) -> list[str]:
    gains = [contract.gains for _, contract in policies]
    choices = (
        gains,
        [path.stem for path, _ in policies],
        [path.parent.name for path, _ in policies],
    )
    for names in choices:
        if len(set(names)) == len(names) and all(names):
            return names
    return [f"{name} {i}" for i, name in enumerate(gains, start=1)]


def _summary(contract: Contract) -> dict[str, Any]:
    names = (
        "robot",
        "gains",
        "gains_sha256",
        "virtual",
        "policy_rate_hz",
        "timestep_s",
        "decimation",
        "delay_range_s",
        "command_ranges",
        "jump",
        "lift_off_velocity",
        "waits_for_stride",
        "joint_names",
        "stiffness",
        "damping",
        "action_scale",
        "default_position",
        "versions",
    )
    values = {name: getattr(contract, name) for name in names}
    return {k: dict(v) if isinstance(v, Mapping) else v for k, v in values.items()}
