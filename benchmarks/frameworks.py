"""`python -m benchmarks frameworks`: gains of each framework, put into its real engine.

One leg of the virtual Mini Cheetah is swept, once, and matched for every framework. Its dry
friction is taken away, as PhysX's joints in SAPIEN and Drake's have none in N m. Each engine then
gets the gains of its framework and the command of the log; its response is compared with the
recorded one, with the delay that goes with the gains.
"""

from __future__ import annotations

import inspect
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.runner import finish
from pronk.cli import console
from pronk.errors import PronkError
from pronk.evaluation.virtual_sweep import sweep_virtual
from pronk.excitation.plan import make_plan
from pronk.logs.readers import read_logs
from pronk.match.measured_joint import DB, measured_joints
from pronk.match.pipeline import match_frameworks
from pronk.match.settings import MatchSettings
from pronk.match.simulated import SimRequest, responses
from pronk.robots import load_robot
from pronk.robots.robot import RobotSpec
from pronk.simulators.engines.drake import Drake
from pronk.simulators.engines.engine import EngineSimulator
from pronk.simulators.engines.mujoco import Mjx, Mujoco
from pronk.simulators.engines.newton import Newton
from pronk.simulators.engines.sapien import Sapien
from pronk.simulators.profiles import profile
from pronk.simulators.simulator import RolloutRigs, load_simulator
from pronk.virtual.sim_params import load_sim_params

ROBOT = "mini_cheetah"
JOINTS = ("FR_hip_roll", "FR_hip_pitch", "FR_knee")
ENGINES: Mapping[str, type[EngineSimulator]] = {
    "mjlab": Mujoco,
    "mjlab-builtin": Mujoco,
    "isaaclab-implicit": Sapien,
    "isaaclab-explicit": Sapien,
    "maniskill": Sapien,
    "drake": Drake,
    "isaaclab-newton": Newton,
    "newton-featherstone": Newton,
    "playground": Mjx,
}
"""Engine of each profile. Isaac Lab's PhysX is that of SAPIEN, with other iterations."""


def in_engine(
    robot: RobotSpec, engine: type[EngineSimulator], pythons: tuple[Path, ...]
) -> RolloutRigs:
    """Rigs in an engine, in this Python or the first of others that has it; else PronkError."""
    choice = f"{inspect.getfile(engine)}:{engine.__name__}"
    for python in (None, *pythons):
        try:
            return RolloutRigs(load_simulator(choice, robot, python=python), robot)
        except PronkError as error:
            last = error
    raise last


def frameworks(python: tuple[Path, ...] = ()) -> console.Outcome:
    """Match one leg for each framework, and put the gains into its engine.

    Args:
        python: A Python that has engines; repeat it.
    """
    known = load_robot(ROBOT)
    still = {"frictionloss": 0.0, "stribeck_speed": 0.0}
    joints = tuple(replace(one, drive=replace(one.drive, **still)) for one in known.joints)
    robot, params = replace(known, joints=joints), load_sim_params()
    smooth = {n: replace(p, coulomb=0.0, breakaway=0.0) for n, p in params.joints.items()}
    settings, rows, figures = MatchSettings(), [], {}
    with tempfile.TemporaryDirectory() as folder, console.progress() as report:
        plan = make_plan(known, JOINTS)
        files = sweep_virtual(plan, replace(params, joints=smooth), Path(folder))
        logs = read_logs(files, robot=robot)
        results = match_frameworks(logs, robot, list(ENGINES), settings=settings)
        for k, (name, engine) in enumerate(ENGINES.items(), start=1):
            simulated = profile(name).robot(robot)
            try:
                rigs = in_engine(simulated, engine, python)
            except PronkError:
                rows.append(
                    (name, f"not run: {engine.package} is in none of the Pythons", *[""] * 6)
                )
                continue
            with rigs:
                for log, joint in zip(logs, JOINTS, strict=True):
                    gains = results[name].gains.joints[joint]
                    goal = measured_joints(log, joint, simulated, settings)[0]
                    both = SimRequest(goal, gains.stiffness, gains.damping, delay=gains.delay_s)
                    plain = replace(both, stiffness=known.joint(joint).stiffness)
                    plain = replace(plain, damping=known.joint(joint).damping)
                    there, same = np.array(responses(rigs, [both, plain], whole=True))
                    found = _compared(there, goal) | {
                        "equal_gains_rms_db": _compared(same, goal)["rms_db"],
                        "engine": f"{rigs.info.engine} {rigs.info.version}",
                        "law": profile(name).drive_law.label,
                        **{n: getattr(gains, n) for n in ("stiffness", "damping", "delay_s")},
                    }
                    figures[f"{name} {joint}"] = found
                    rows.append(
                        (
                            *(name, f"{found['engine']}, {found['law']}", joint),
                            f"{gains.stiffness:.2f} / {gains.damping:.3f}",
                            f"{1e3 * gains.delay_s:.2f}",
                            f"{found['equal_gains_rms_db']:.2f}",
                            f"{found['rms_db']:.3f}",
                            f"{found['late_ms']:+.2f}",
                        )
                    )
            report("frameworks", k / len(ENGINES))
    columns = ["framework", "engine, law", "joint", "gains", "delay [ms]"]
    columns += ["with the drive's gains, RMS [dB]", "matched, RMS [dB]", "late by [ms]"]
    title = "Gains of one log set in the engine of each framework, virtual Mini Cheetah"
    return finish(figures, console.table(title, columns, rows))


def _compared(response: Any, goal: Any) -> dict[str, float]:
    """RMS of the magnitude [dB] and delay [ms] of a response over the measured one, in the band."""
    ratio = (response / goal.measured.response)[goal.fit_mask]
    level, omega = DB * np.log(np.abs(ratio)), goal.omega
    late = -(np.angle(ratio) @ omega) / (omega @ omega)
    return {"rms_db": float(np.sqrt(np.mean(level**2))), "late_ms": float(1e3 * late)}
