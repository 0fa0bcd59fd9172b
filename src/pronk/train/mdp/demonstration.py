"""A jump that is shown: joint targets for every moment from the jump command to touchdown.

A jump asks something else of twelve drives at every moment of a quarter of a second, and to learn
that by trying takes longer than training lasts. A policy that had been led through a poor one
(commit 3fa6f95, seed 2) left the ground, nominal, running at 2 m/s on 24.5 V and 0.08 ohm, with 2.2
m/s upwards and 1.8 forward; CMA-ES over what is added to its joint targets had 2.6 and 2.5 m/s
after 100 generations. So robots are led through a good jump at first, and the policy learns to do
the same (`pronk.train.rl.following`), until both let go. What is shown was found in the
training simulator by `tools/find_jump.py`; `jump_demonstration_matched.yaml` is what it wrote, and
`jump_demonstration_naive.yaml` what it wrote with naive gains: who trains with those knows of no
others.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib.resources import files
from typing import Any

import torch
import yaml
from torch import Tensor

from pronk.errors import ArtefactError
from pronk.robots import load_robot
from pronk.train.gains import GainsName

SCHEMA_VERSION = 1
JOINTS = tuple(joint.name for joint in load_robot("mini_cheetah").joints)
FILE = "jump_demonstration_{}.yaml"
BEYOND = 0.25
"""Commands faster than the fastest one shown change the jump further, up to this much faster."""


@dataclass(frozen=True, kw_only=True)
class Demonstration:
    """Joint targets by time and command."""

    step_s: float
    """Between two rows [s]; the first is for the moment of the command."""
    forward: Tensor
    """Commands forward that jumps are shown for [m/s], rising, 0 among them. Shape (K,)."""
    aside: float
    """Command to a side that jumps are shown for [m/s]."""
    targets: Tensor
    """Joint targets [rad], shape (K + 2, rows, 12): those of `forward`, to the right, the left."""

    @property
    def duration(self) -> float:
        """From the command to the end of what is shown [s]."""
        return self.step_s * (self.targets.shape[1] - 1)

    def at(self, since: Tensor, velocity: Tensor) -> Tensor:
        """What robots are shown.

        Between rows it is interpolated, and between commands forward; what a command to a side
        changes in the jump at a standstill is added to that. Later than `duration` it is the last
        row.

        Args:
            since: Time since the jump command [s], shape (N,).
            velocity: Commanded, forward and left [m/s], shape (N, 2).

        Returns:
            Joint targets [rad], shape (N, 12).
        """
        rows = self.targets.shape[1]
        place = (since / self.step_s).clamp(0.0, rows - 1)
        before = place.long().clamp_max(rows - 2)
        part = (place - before)[:, None]
        # All tables weighed, instead of some gathered for each robot.
        first, then = (self.targets[:, row] for row in (before, before + 1))
        shown = torch.lerp(first, then, part[None])
        return (self._shares(velocity).T[:, :, None] * shown).sum(dim=0)

    def _shares(self, velocity: Tensor) -> Tensor:
        """Weight of each table, which add up to one. (N, K + 2)."""
        nodes = self.forward
        least, most = (1.0 + BEYOND) * nodes[0], (1.0 + BEYOND) * nodes[-1]
        ahead = velocity[:, :1].clamp(least, most)
        below = torch.bucketize(ahead, nodes[1:-1].contiguous())
        part = (ahead - nodes[below]) / (nodes[below + 1] - nodes[below])
        shares = ahead.new_zeros(len(ahead), len(nodes) + 2)
        shares.scatter_(1, below, 1.0 - part).scatter_(1, below + 1, part)
        side = velocity[:, 1] / self.aside
        right, left = (way.clamp(0.0, 1.0 + BEYOND) for way in (-side, side))
        shares[:, -2], shares[:, -1] = right, left
        standing = nodes.abs().argmin()
        return shares - (right + left)[:, None] * torch.nn.functional.one_hot(
            standing, shares.shape[1]
        )

    def to(self, device: torch.device | str) -> Demonstration:
        """The same on another device."""
        return replace(self, forward=self.forward.to(device), targets=self.targets.to(device))


def mirrored(targets: Tensor) -> Tensor:
    """The same for the robot's mirror image: legs change sides, hips roll the other way.

    Args:
        targets: Joint targets, (..., 12): right fore, left fore, right hind, left hind leg.
    """
    legs = targets.unflatten(-1, (4, 3))[..., [1, 0, 3, 2], :]
    return (legs * legs.new_tensor([-1.0, 1.0, 1.0])).flatten(-2)


def demonstration(gains: GainsName = "matched") -> Demonstration:
    """What is shown to the Mini Cheetah.

    Args:
        gains: Kind of gains that it was found with.

    Raises:
        ArtefactError: The file is not one of this version, or its tables do not fit together.
    """
    source = files("pronk.train.mdp") / FILE.format(gains)
    return parse(yaml.safe_load(source.read_text(encoding="utf-8")), str(source))


def parse(content: Mapping[str, Any], path: str) -> Demonstration:
    """A demonstration from the content of its file.

    Args:
        content: `schema_version`, `joints`, `step_s`, and `jumps`, each with `forward`, `left`
            [m/s] and its `targets` [rad]: some forward and back, one where it stands, one aside.
        path: For messages.

    Raises:
        ArtefactError: It is not one of this version, or its tables do not fit together.
    """
    if content.get("schema_version") != SCHEMA_VERSION:
        raise ArtefactError(
            f"{path}: schema_version {content.get('schema_version')}; this pronk reads "
            f"{SCHEMA_VERSION}. Write it anew with tools/find_jump.py."
        )
    if tuple(content["joints"]) != JOINTS:
        raise ArtefactError(f"{path}: joints {content['joints']}; expected {', '.join(JOINTS)}.")
    jumps = sorted(content["jumps"], key=lambda jump: jump["forward"])
    ahead = [jump for jump in jumps if jump["left"] == 0.0]
    aside = [jump for jump in jumps if jump["left"] < 0.0 == jump["forward"]]
    nodes = [float(jump["forward"]) for jump in ahead]
    if len(aside) != 1 or len(ahead) != len(jumps) - 1:
        raise ArtefactError(
            f"{path}: jumps that are neither forward, back nor the one to the right."
        )
    if not {0.0} < set(nodes) or not min(nodes) < 0.0 < max(nodes) or len(set(nodes)) < len(nodes):
        raise ArtefactError(
            f"{path}: jumps forward at {nodes} m/s; expected each once: back, 0, and ahead."
        )
    tables = [torch.tensor(jump["targets"], dtype=torch.float32) for jump in (*ahead, *aside)]
    shapes = {tuple(table.shape) for table in tables}
    if len(shapes) != 1 or tables[0].ndim != 2 or tables[0].shape[1] != len(JOINTS):
        raise ArtefactError(
            f"{path}: tables of shape {', '.join(map(str, sorted(shapes)))}; expected one shape "
            f"(rows, {len(JOINTS)})."
        )
    return Demonstration(
        step_s=float(content["step_s"]),
        forward=torch.tensor(nodes),
        aside=-float(aside[0]["left"]),
        targets=torch.stack((*tables, mirrored(tables[-1]))),
    )
