r"""pronk's commands with MuJoCo's C engine in place of MuJoCo Warp: experiments without a GPU.

    python tools/cpu_engine.py evaluate policies/matched/policy.onnx --gains policies/gains.yaml
    python tools/cpu_engine.py --net 256x128x64 train all --gains policies/gains.yaml \
        --envs 1024 --device cpu --out out/small

Environment, rewards and learning are pronk's and mjlab's own; only what `Simulation.step` and
`forward` compute comes from `mj_step` and `mj_forward`, on all cores. States agree with Warp's to
single precision (a test holds it). `--net` trains networks of another size than the paper's, which
would take most of the time. Needs gcc; the engine is compiled into a temporary folder.
"""

from __future__ import annotations

import copy
import ctypes
import os
import subprocess
import sys
import tempfile
from functools import cache, partial
from pathlib import Path
from typing import Any

os.environ.setdefault("MUJOCO_GL", "disable")
os.environ.setdefault("MJLAB_WARP_QUIET", "1")

import mjlab.envs.manager_based_rl_env as mjlab_env
import mujoco
import numpy as np
import torch
from mjlab.sim.sim import Simulation

SOURCE = Path(__file__).with_suffix(".c")
FIELDS = (
    "geom_friction",
    "geom_pos",
    "geom_size",
    "geom_rbound",
    "geom_aabb",
    "site_pos",
    "body_mass",
    "body_inertia",
    "body_subtreemass",
    "body_invweight0",
    "dof_invweight0",
    "dof_M0",
)
"""Of the model, those that robots may have of their own; as in cpu_engine.c."""
WITHOUT = {"actuator_acc0", "tendon_length0", "tendon_invweight0"}
"""Expanded by mjlab as well, read by nothing that steps."""
STATE = ("qpos", "qvel", "ctrl", "qfrc_applied", "qacc_warmstart")
DERIVED = (
    "xpos",
    "xquat",
    "xmat",
    "site_xpos",
    "subtree_com",
    "cvel",
    "qfrc_actuator",
    "actuator_force",
    "sensordata",
    "qacc",
)


class Arrays(ctypes.Structure):
    """Addresses of the arrays that come in and go out."""

    _fields_ = [(name, ctypes.c_void_p) for name in STATE + DERIVED]


@cache
def library() -> ctypes.CDLL:
    """The engine, compiled."""
    mujoco_folder = Path(mujoco.__file__).parent
    (shared,) = mujoco_folder.glob("libmujoco.so.*")
    path = Path(tempfile.mkdtemp()) / "cpu_engine.so"
    flags = ["-O3", "-march=native", "-shared", "-fPIC", "-fopenmp"]
    link = [f"-L{mujoco_folder}", f"-l:{shared.name}", f"-Wl,-rpath,{mujoco_folder}"]
    include = f"-I{mujoco_folder / 'include'}"
    subprocess.run(["gcc", *flags, include, str(SOURCE), "-o", str(path), *link], check=True)
    found = ctypes.CDLL(str(path))
    found.engine_new.restype = ctypes.c_void_p
    return found


class CpuSimulation(Simulation):
    """mjlab's simulation, stepped by MuJoCo's C engine."""

    threads = os.cpu_count() or 1

    def _finish_init(self) -> None:
        super()._finish_init()
        model = ctypes.c_void_p(self._mj_model._address)
        self._engine = ctypes.c_void_p(library().engine_new(model, self.threads))
        # Warp's arrays of the CPU are the host's own memory.
        views = {name: getattr(self._wp_data, name).numpy() for name in STATE + DERIVED}
        assert all(v.flags.c_contiguous and v.dtype == np.float32 for v in views.values())
        self._arrays = Arrays(**{name: view.ctypes.data for name, view in views.items()})
        self._values: dict[str, np.ndarray] = {}
        self._given = False

    def expand_model_fields(self, fields: tuple[str, ...]) -> None:
        """Robots get fields of their own; they are read before the next step."""
        super().expand_model_fields(fields)
        unknown = self.expanded_fields - {*FIELDS, *WITHOUT}
        assert not unknown, f"cpu_engine.c does not copy {sorted(unknown)}"
        self._given = False

    def recompute_constants(self, level: Any) -> None:
        """Done robot by robot before the next step."""
        self._given = False

    def step(self) -> None:
        """One physics step of all robots."""
        self._advance(1)

    def forward(self) -> None:
        """Derived quantities of all robots."""
        self._advance(0)

    def reset(self, env_ids: torch.Tensor | None = None) -> None:
        """The state that the model begins with."""
        ids = slice(None) if env_ids is None else env_ids
        self.data.qpos[ids] = torch.as_tensor(self._mj_model.qpos0, dtype=torch.float32)
        for name in (*STATE[1:], "qacc"):
            getattr(self.data, name)[ids] = 0.0

    def _advance(self, step: int) -> None:
        if not self._given:
            self._give_fields()
        library().engine_advance(self._engine, self.num_envs, step, ctypes.byref(self._arrays))

    def _give_fields(self) -> None:
        """Read what was drawn; MuJoCo works out the constants that follow."""
        model = copy.copy(self._mj_model)
        data = mujoco.MjData(model)
        drawn = {
            name: getattr(self._wp_model, name).numpy()
            for name in self.expanded_fields.intersection(FIELDS)
        }
        self._values = {
            name: np.empty((self.num_envs, getattr(model, name).size)) for name in FIELDS
        }
        for robot in range(self.num_envs):
            for name, values in drawn.items():
                field = getattr(model, name)
                field[...] = values[robot].reshape(field.shape)
            mujoco.mj_setConst(model, data)
            for name, values in self._values.items():
                values[robot] = getattr(model, name).ravel()
        for i, values in enumerate(self._values.values()):
            address = ctypes.c_void_p(values.ctypes.data)
            library().engine_field(self._engine, i, values.shape[1], address)
        self._given = True

    def __del__(self) -> None:
        """The engine goes with the simulation."""
        if hasattr(self, "_engine"):
            library().engine_free(self._engine)


def main() -> None:
    """The command line of pronk, behind `--net` if it is given."""
    from pronk.cli import main as cli
    from pronk.train import tasks
    from pronk.train.runner import kernels

    words = sys.argv[1:]
    if words[:1] == ["--net"]:
        sizes = tuple(int(size) for size in words[1].split("x"))
        tasks.EstimatorActorCfg = partial(tasks.EstimatorActorCfg, hidden_dims=sizes)  # type: ignore[misc, assignment]
        tasks.JumpCriticCfg = partial(tasks.JumpCriticCfg, hidden_dims=sizes)  # type: ignore[misc, assignment]
        words = words[2:]
    mjlab_env.Simulation = CpuSimulation
    kernels.MODULES = ()  # Warp steps nothing here
    sys.argv = ["pronk", *words]
    cli.main()


if __name__ == "__main__":
    main()
