"""`python -m benchmarks probe`: name the laws, parameters and faults of random simulators, blind.

A simulator is drawn with its law, step, armature, friction, delay and hold, and half of them with a
fault. It is an integrator of its own in NumPy, MuJoCo, or an engine of
`pronk.identify.simulators.engines` that is installed. `pronk.identify.simulators.probe` sees the
`Simulator` only.
"""

from __future__ import annotations

import importlib.util
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.runner import finish, in_parallel
from pronk.arrays import Array
from pronk.cli import console
from pronk.errors import PronkError
from pronk.identify.simulators.engines.drake import Drake
from pronk.identify.simulators.engines.engine import EngineSimulator, delayed
from pronk.identify.simulators.engines.links import links_of
from pronk.identify.simulators.engines.pybullet import PyBullet
from pronk.identify.simulators.engines.sapien import Sapien
from pronk.identify.simulators.mujoco import Chain
from pronk.identify.simulators.probe import Probe
from pronk.identify.simulators.probe import probe as look
from pronk.identify.simulators.simulator import SimulatorInfo
from pronk.robots import load_robot
from pronk.robots.drive_law import DriveLaw
from pronk.robots.robot import RobotSpec

ROBOTS = (
    (str(Path(__file__).parents[1] / "examples" / "pendulum"), "swing"),
    ("mini_cheetah", "FR_knee"),
    ("go2", "RL_knee"),
)
ENGINES: tuple[type[EngineSimulator], ...] = (Sapien, Drake, PyBullet)
FAULTS = ("ignored", "armature", "twice", "degrees", "law", "beside", "hold")
"""Words of `Probe.wrong`; each second simulator has one of them."""
DEFAULT_ARMATURE = 0.1
"""Genesis's, of a URDF that names none [kg m^2]."""


@dataclass(frozen=True, kw_only=True)
class Truth:
    """What is drawn."""

    kind: str
    robot: RobotSpec
    joint: str
    law: DriveLaw
    stated: DriveLaw
    armature: float
    """That acts [kg m^2]."""
    frictionloss: float
    delay_s: float
    hold: int
    scale: float
    """Gains that act over those that are set."""
    fault: str


class Drawn:
    """A `Simulator` as it was drawn: faults, delay and hold about `moved`."""

    def __init__(self, truth: Truth) -> None:
        robot, self.truth = truth.robot, truth
        self.joints, self.parameters = robot.joint_names, frozenset({"stiffness", "damping"})
        self.parameters |= {"armature"}
        self.info = SimulatorInfo(
            engine="unknown",
            timestep_s=robot.timestep_s,
            decimation=robot.decimation,
            law=truth.stated.kind,
            iterations=truth.stated.iterations,
        )

    def rollout(
        self, command: Array, values: Mapping[str, Array], *, locked: Sequence[str] = ()
    ) -> Array:
        """Positions of the joint; see `Simulator.rollout`."""
        truth = self.truth
        column = self.joints.index(truth.joint)
        assert truth.joint not in locked
        hold = np.arange(command.shape[1]) // truth.hold * truth.hold
        late = np.full((len(command), len(self.joints)), truth.delay_s / self.info.timestep_s)
        seen = delayed(command[:, hold], late)
        own = truth.robot.joint(truth.joint)
        kp, kd = (values[n][:, column] * truth.scale for n in ("stiffness", "damping"))
        armature = np.full(len(command), own.drive.armature)
        if "armature" in values:
            armature = values["armature"][:, column].copy()
        if truth.fault == "ignored":
            armature[:] = truth.armature
        elif truth.fault == "armature":
            armature += DEFAULT_ARMATURE
        moved = {"numpy": self._numpy, "mujoco": self._mujoco}.get(truth.kind, self._engine)
        out = np.repeat(command[:, :1], command.shape[1], axis=1)
        out[..., column] = moved(seen, kp, kd, armature)
        return out

    def _numpy(self, command: Array, kp: Array, kd: Array, armature: Array) -> Array:
        """Laws of `pronk.robots.drive_law` for a joint with Coulomb friction, shape (B, T)."""
        truth, drive = self.truth, self.truth.robot.joint(self.truth.joint).drive
        links = links_of(truth.robot, truth.joint)
        arm = np.cross(links.axis[0], links.centre[0])
        inertia = links.axis[0] @ links.inertia[0] @ links.axis[0] + links.mass[0] * arm @ arm
        inertia = inertia + armature
        u = command[..., self.joints.index(truth.joint)]
        law, h = truth.law, truth.robot.timestep_s / truth.law.iterations
        explicit = law.kind == "explicit" or truth.fault == "beside"
        viscous, friction = drive.viscous_damping, truth.frictionloss
        q, v, out = u[:, 0].copy(), np.zeros(len(u)), np.empty(u.shape)
        for k in range(u.shape[1]):
            out[:, k] = q
            before = kp * (u[:, k] - q) - kd * v if explicit else np.zeros(len(u))
            for _ in range(law.iterations):
                gravity = np.array([links.gravity_torque(np.array([angle]))[0] for angle in q])
                force, mass = before + gravity - viscous * v, inertia + h * viscous
                if law.kind != "explicit":
                    force, mass = force + kp * (u[:, k] - q) - kd * v, mass + h * kd
                if law.kind == "implicit":
                    force, mass = force - h * kp * v, mass + h * h * kp
                v = v + h * force / mass
                v = np.sign(v) * np.maximum(np.abs(v) - h * friction / mass, 0.0)
                q = q + h * v
        return out

    def _mujoco(self, command: Array, kp: Array, kd: Array, armature: Array) -> Array:
        truth = self.truth
        robot = replace(truth.robot, law=truth.law)
        names = ("stiffness", "damping", "armature")
        sets = [
            {
                truth.joint: {
                    **dict(zip(names, map(float, one), strict=True)),
                    "frictionloss": truth.frictionloss,
                }
            }
            for one in zip(kp, kd, armature, strict=True)
        ]
        column = self.joints.index(truth.joint)
        with Chain(robot, truth.joint, threads=1) as chain:
            return chain.rollout(command[..., [column]], sets)[:, :-1, 0]

    def _engine(self, command: Array, kp: Array, kd: Array, armature: Array) -> Array:
        truth, column = self.truth, self.joints.index(self.truth.joint)
        engine = next(one for one in ENGINES if one.__name__ == truth.kind)
        values = {}
        for name, one in (("stiffness", kp), ("damping", kd), ("armature", armature)):
            values[name] = np.ones((len(command), len(self.joints)))
            values[name][:, column] = one
        if truth.law.kind in engine.dry:
            values["frictionloss"] = np.full((len(command), len(self.joints)), truth.frictionloss)
        locked = [name for name in self.joints if name != truth.joint]
        out = engine(truth.robot, law=truth.law).rollout(command, values, locked=locked)
        return np.asarray(out[..., column])


def drawn(generator: np.random.Generator, kind: str, fault: str) -> Truth:
    """Draw one simulator of a kind with a fault, or none."""
    name, joint = ROBOTS[generator.integers(len(ROBOTS))]
    robot = load_robot(name)
    step = float(generator.choice([0.001, 0.002, 0.004, 0.005]))
    robot = replace(robot, timestep_s=step, decimation=round(0.02 / step))
    laws = [DriveLaw(), DriveLaw(kind="implicit_damping")]
    laws += [DriveLaw(kind="implicit", iterations=n) for n in (1, 4, 10)]
    if kind in ("Drake", "PyBullet", "Sapien"):
        engine = next(one for one in ENGINES if one.__name__ == kind)
        laws = [one for one in laws if one.kind in engine.laws]
        laws = laws if kind == "Sapien" else [one for one in laws if one.iterations == 1]
    if fault == "beside":
        laws = [one for one in laws if one.kind != "explicit"]
    law = laws[generator.integers(len(laws))]
    others = [one for one in laws if one != law] or [DriveLaw(kind="implicit_damping")]
    stated = others[generator.integers(len(others))] if fault == "law" else law
    own = robot.joint(joint)
    armature = own.drive.armature * float(generator.uniform(0.6, 1.8))
    own = replace(
        own,
        drive=replace(own.drive, rotor_inertia=armature / own.drive.gear_ratio**2),
        stiffness=own.stiffness * float(generator.uniform(0.6, 1.3)),
        damping=own.damping * float(generator.uniform(0.5, 1.2)),
    )
    robot = replace(robot, joints=tuple(own if j.name == joint else j for j in robot.joints))
    scale = 1.0
    if fault == "degrees":
        scale = float(generator.choice([180.0 / np.pi, np.pi / 180.0]))
    elif fault == "twice":
        scale = 2.0
    acts = own.drive.armature
    if fault == "ignored":
        acts = 0.0 if generator.random() < 0.5 else 0.5 * armature
    elif fault == "armature":
        acts += DEFAULT_ARMATURE
    still = kind in ("Drake", "PyBullet", "Sapien") or scale < 0.1
    return Truth(
        kind=kind,
        robot=robot,
        joint=joint,
        law=law,
        stated=stated,
        armature=acts,
        frictionloss=0.0 if still else float(generator.choice([0.0, generator.uniform(0.02, 0.3)])),
        delay_s=float(generator.choice([0.0, generator.uniform(0.0, 0.02)])),
        hold=int(generator.choice([2, 4, 5])) if fault == "hold" else 1,
        scale=scale,
        fault=fault,
    )


def case(number: int, *, seed: int, kinds: Sequence[str]) -> dict[str, float | bool | str]:
    """Draw and probe one simulator of a seed: its score, and the seconds that it took."""
    generator = np.random.default_rng(seed)
    for k in range(number + 1):
        kind = kinds[k % len(kinds)]
        fault = FAULTS[k // 2 % len(FAULTS)] if generator.random() < 0.5 else ""
        truth = drawn(generator, "numpy" if fault == "beside" else kind, fault)
    begin = time.perf_counter()
    found = look(Drawn(truth), truth.robot, truth.joint)
    return {"number": number, **score(truth, found), "seconds": time.perf_counter() - begin}


def score(truth: Truth, found: Probe) -> dict[str, float | bool | str]:
    """How far an answer is from the truth."""
    # A joint that is not stable with its gains is no fault that was drawn.
    named = set(found.wrong) - {"unstable"}
    inertia = (
        truth.armature if truth.armature > 0.0 else truth.robot.joint(truth.joint).drive.armature
    )
    acts = truth.armature
    if truth.kind == "PyBullet":
        # Explicit passive damping moves the joint as the implicit one of the laws does with so
        # much less armature.
        acts -= truth.robot.timestep_s * truth.robot.joint(truth.joint).drive.viscous_damping
    armature_error = abs(found.armature - acts) / inertia
    delay_error = abs(found.delay_s - truth.delay_s)
    return {
        "kind": truth.kind,
        "joint": truth.joint,
        "law": truth.law.label,
        "found": found.law.label,
        "law_right": (found.law, found.beside_explicit) == (truth.law, truth.fault == "beside"),
        "armature_error": armature_error,
        "armature_right": armature_error < 0.02,
        "delay_error_s": delay_error,
        "delay_right": delay_error < 5e-4,
        "friction_error": abs(found.frictionloss - truth.frictionloss),
        "hold_right": found.hold == truth.hold,
        "fault": truth.fault,
        "named": " ".join(sorted(named)),
        "fault_right": named == ({truth.fault} if truth.fault else set()),
        "left": found.left,
    }


def probe(
    seed: int = 0, count: int = 50, jobs: int = 1, rows: Path | None = None
) -> console.Outcome:
    """Name the law, parameters and faults of random simulators.

    Args:
        seed: Of the draw.
        count: Simulators; a quarter of them in each engine that is installed, at most.
        jobs: Processes, a simulator each.
        rows: A file to which each simulator adds a line of JSON as it is done.
    """
    kinds = ["numpy", "mujoco"]
    kinds += [e.__name__ for e in ENGINES if importlib.util.find_spec(e.module.split(".")[0])]
    if count < 1:
        raise PronkError(f"--count {count}; expected 1 or more.")
    scores = []
    work = partial(case, seed=seed, kinds=kinds)
    with console.progress() as report:
        for one in in_parallel(work, range(count), jobs):
            scores.append(one)
            if rows is not None:
                with rows.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(one) + "\n")
            report("probe", len(scores) / count)
    faulty = sum(bool(one["fault"]) for one in scores)
    checks = {
        "law": "law_right",
        "hold": "hold_right",
        f"faults named and no others; {faulty} have one": "fault_right",
        "armature within 2 %": "armature_right",
        "delay within 0.5 ms": "delay_right",
    }
    cells = [
        (name, f"{sum(bool(one[key]) for one in scores)} of {count}")
        for name, key in checks.items()
    ]
    for name, key, factor in (
        ("armature, error [%]", "armature_error", 100.0),
        ("delay, error [ms]", "delay_error_s", 1000.0),
        ("dry friction, error [N m]", "friction_error", 1.0),
        ("time [s]", "seconds", 1.0),
    ):
        values = np.array([float(one[key]) for one in scores]) * factor
        cells.append((name, f"{np.median(values):.2g} (largest {values.max():.2g})"))
    title = f"Random simulators, seed {seed}: {', '.join(kinds)}"
    figures = {str(one["number"]): one for one in scores}
    return finish(figures, console.table(title, ["of the joint", "probe"], cells))
