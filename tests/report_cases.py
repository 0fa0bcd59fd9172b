"""Matches and trials for tests of the report, with numbers known in closed form."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from pronk.identify.match import gains as gains_file
from pronk.identify.match.compared import ComparedResponses
from pronk.identify.match.gains import GroupGains
from pronk.identify.match.predict import JointPrediction, Prediction, save_prediction
from pronk.identify.match.result import (
    DriveFit,
    GridSearch,
    JointResult,
    MatchResult,
    ZeroArmature,
    joint_gains,
    save_match,
)
from pronk.identify.response.response import FrequencyResponse
from pronk.identify.simulators.info import SimulatorInfo
from pronk.jump.trial import walk
from pronk.jump.trial.crossing import CROSSING, CrossingFigures
from pronk.jump.trial.jumps import JumpRules, measure_jump
from pronk.jump.trial.protocol import PAPER_COMMANDS, RATES, Case
from pronk.jump.trial.results import (
    JUMPS,
    RunKind,
    TrialResults,
    TrialRun,
    TriedPolicy,
    load_results,
    save_results,
)
from pronk.jump.trial.walk import WALK, WalkFigures, walk_script
from pronk.jump.virtual import capture as captures
from pronk.jump.virtual.capture import Capture
from pronk.robots import load_robot
from seen_jump import SCRIPT, STANDING, G, seen_jump

LEGS = ("FR", "FL", "HR", "HL")
GROUPS = {
    "hip_roll": (0.0300, 19.5, 0.48, (1.0, 10.0)),
    "hip_pitch": (0.0260, 17.5, 0.40, (1.0, 10.0)),
    "knee": (0.0070, 21.9, 0.54, (0.1, 15.0)),
}
"""Inertia of leg and rotor [kg m^2], matched stiffness and damping, band [Hz]."""
NOMINAL_GAINS = (17.0, 0.4)
ROBOT = load_robot("mini_cheetah")
CASES = (PAPER_COMMANDS[0], PAPER_COMMANDS[1], RATES)
FLIGHTS = {"matched": (400, 410, 420), "naive": (380, 400, 420)}
"""Time in the air of each policy's jumps [ms]: the naive ones differ twice as much."""
RATE = 3.0
"""Amplitude of the roll rate of the matched policy [rad/s]."""
OMEGA = 25.0
"""Angular frequency of that roll rate [rad/s]."""


def second_order(omega, stiffness, damping, inertia, viscous=0.01):
    """Return the response of the paper's equation M2 with a still target velocity."""
    s = 1j * omega
    return stiffness / (inertia * s**2 + (damping + viscous) * s + stiffness)


def error_db(measured, simulated, band):
    """Return the RMS over a band of the difference of two gains [dB]."""
    gap = 20.0 * np.log10(np.abs(measured) / np.abs(simulated))
    return np.sqrt(np.mean(gap[..., band] ** 2, axis=-1))


def joint_result(name: str, leg: int = 0, *, virtual: bool = True) -> JointResult:
    """Return the result of one joint at two amplitudes with noise of a few per cent."""
    rng = np.random.default_rng(leg)
    inertia, stiffness, damping, band_hz = GROUPS[name]
    stiffness *= 1.0 + 0.02 * (leg - 1.5)
    omega = 2.0 * np.pi * np.arange(0.25, 22.6, 0.25)
    matched = second_order(omega, stiffness, damping, inertia)
    nominal = second_order(omega, *NOMINAL_GAINS, inertia)
    joint = f"{LEGS[leg]}_{name}"
    responses = []
    for amplitude in (0.25, 0.125):
        noise = 0.01 * (rng.normal(size=(3, omega.size)) + 1j * rng.normal(size=(3, omega.size)))
        repeats = matched * np.exp(-1j * omega * 0.002) + noise * 0.25 / amplitude
        responses.append(
            FrequencyResponse(
                joint=joint,
                amplitude=amplitude,
                omega=omega,
                response=repeats.mean(axis=0),
                repeats=repeats,
                coherence=1.0 - 0.3 * (omega / omega[-1]) ** 3,
                averages=np.full(omega.size, 12.0),
                third_harmonic=0.02,
                delay_s=0.002,
                estimator="H1",
                window="hann 4 s, 75 % overlap",
                segment_s=4.0,
                virtual=virtual,
            )
        )
    first = responses[0].response
    band = responses[0].band(*band_hz)
    stiffness_axis = np.linspace(13, 27, 21)
    damping_axis = np.linspace(0.1, 0.7, 21)
    nodes = second_order(omega, stiffness_axis[:, None, None], damping_axis[None, :, None], inertia)
    flags: tuple[str, ...] = ()
    zero_armature = None
    if name == "knee":
        flags = ("3 of 60 frequencies left out for low coherence",)
        response = second_order(omega, 27.0, 0.62, 0.0012)
        zero_armature = ZeroArmature(error_db=2.9, response=response, ruled_out=True)
    fit = DriveFit(
        joint=joint,
        values={
            "stiffness": stiffness,
            "damping": damping,
            "armature": 0.0026,
            "frictionloss": float("nan"),
            "stribeck": 0.0,
            "delay": 0.0,
        },
        ci95={
            "stiffness": (stiffness - 0.6, stiffness + 0.6),
            "damping": (damping - 0.02, damping + 0.02),
        },
        covariance=np.array([[0.09, 0.0015], [0.0015, 1e-4]]),
        amplitude_gains=np.array(
            [[0.25, stiffness, damping], [0.125, stiffness * 0.98, damping * 1.03]]
        ),
        flags=flags,
    )
    compared = ComparedResponses(
        measured=tuple(responses),
        matched=matched,
        nominal=nominal,
        band_hz=band_hz,
        error_db=float(error_db(first, matched, band)),
        nominal_error_db=float(error_db(first, nominal, band)),
        coherence_min=0.91,
    )
    return JointResult(
        joint=fit.joint,
        gains=joint_gains(fit, ROBOT, compared),
        fit=fit,
        responses=compared,
        grid=GridSearch(
            stiffness=stiffness_axis,
            damping=damping_axis,
            error=error_db(first, nodes, band) ** 2,
        ),
        zero_armature=zero_armature,
    )


def match(*, virtual: bool = True, robot: str = "mini_cheetah", legs: int = 4) -> MatchResult:
    """Return a match of the three joints of some legs."""
    joints = {}
    for leg in range(legs):
        for name in GROUPS:
            result = joint_result(name, leg, virtual=virtual)
            joints[result.joint] = result
    groups = {}
    for name, (_, stiffness, damping, _) in GROUPS.items():
        groups[name] = GroupGains(
            stiffness=round(stiffness * 2) / 2,
            damping=round(damping * 20) / 20,
            stiffness_range=2.0,
            damping_range=0.05,
            ellipsoid=((1.2, 0.0), (0.0, 0.001)),
            ellipsoid_center=(stiffness, damping),
        )
    return MatchResult(
        robot=robot,
        simulator=SimulatorInfo(version="3.11.0"),
        joints=joints,
        groups=groups,
        logs={f"{name}.mcap": f"{number:064x}" for number, name in enumerate(joints)},
        virtual=virtual,
    )


def joint_prediction() -> JointPrediction:
    """Return a prediction whose nominal simulation is wrong between 4 and 5 s alone."""
    time = np.arange(0.0, 6.0, 0.002)
    command = 0.25 * np.sin(2.0 * np.pi * 0.8 * time**2)[(np.arange(time.size) // 10) * 10]
    return JointPrediction(
        joint="FR_knee",
        time=time,
        command=command,
        measured=command,
        nominal=np.where((time > 4.0) & (time < 5.0), 1.3, 1.0) * command,
        nominal_delayed=1.1 * command,
        matched=1.01 * command,
        signal="log_chirp",
    )


def write_match(folder: Path, result: MatchResult, *, prediction: bool = False) -> Path:
    gains_file.save_gains(folder / "gains.yaml", result.gains)
    save_match(folder / "match.npz", result)
    if prediction:
        fresh = Prediction(
            joints=(joint_prediction(),), virtual=result.gains.virtual, source="fresh.mcap"
        )
        save_prediction(folder / "fresh.prediction.npz", fresh)
    return folder


def lift_off(flight: int) -> float:
    """Return the lift-off velocity of a flight of so many milliseconds [m/s]."""
    return G * flight / 2000.0


def subject(name: str, **contract: Any) -> TriedPolicy:
    """Return a policy; `contract` replaces entries of its contract."""
    stiffness = (20.0, 17.5, 21.5)
    damping = (0.45, 0.40, 0.55)
    if name == "naive":
        stiffness = (17.0, 17.0, 17.0)
        damping = (0.4, 0.4, 0.4)
    fields = {
        "gains": name,
        "joint_names": ROBOT.joint_names,
        "stiffness": stiffness * 4,
        "damping": damping * 4,
        **contract,
    }
    return TriedPolicy(name=name, path=f"{name}.onnx", sha256=name[0] * 64, contract=fields)


def jump_capture(flight: int, scale: float) -> Capture:
    """Return a jump of so many milliseconds, whose roll rate is scaled."""
    capture = seen_jump(up=lift_off(flight))
    rate = np.zeros_like(capture.angular_velocity)
    rate[:, 0] = scale * RATE * np.sin(OMEGA * (capture.time - SCRIPT.start))
    velocity = np.tile(np.linspace(-10.0, 10.0, len(capture.time))[:, None], (1, 12))
    return replace(capture, angular_velocity=rate, joint_velocity=velocity, torque=0.5 * velocity)


def of_kind(run_kind: RunKind, names: tuple[str, ...], **changes: Any) -> TrialResults:
    """Return results of some policies; `changes` replace or add fields."""
    fields: dict[str, Any] = {
        "run_kind": run_kind,
        "robot": ROBOT.name,
        "subjects": tuple(subject(name) for name in names),
        "joint_names": ROBOT.joint_names,
        "seed": 3,
        "sim_params": {"file": "shipped with pronk", "sha256": "ab" * 32},
        "script": SCRIPT,
        "versions": {"pronk": "0.1.0"},
    }
    return TrialResults(**(fields | changes))


def row(policy: str, case: Case, number: int, figures: Any, capture: str = "") -> TrialRun:
    """Return one run."""
    return TrialRun(
        policy=policy,
        case=case.name,
        number=number,
        seed=number,
        script=replace(SCRIPT, command=case.command),
        figures=figures,
        capture=capture,
    )


def write_trial(
    folder: Path,
    policies: tuple[str, ...] = ("matched", "naive"),
    cases: tuple[Case, ...] = CASES,
    *,
    keep: bool = False,
) -> TrialResults:
    """Write a trial measured by `pronk.jump.trial.jumps` on closed-form jumps, and read it."""
    rules = JumpRules(standing_height=STANDING)
    rows = []
    for name in policies:
        scale = 2.0 if name == "naive" else 1.0
        for case in cases:
            script = replace(SCRIPT, command=case.command)
            for number, flight in enumerate(FLIGHTS[name]):
                capture = jump_capture(flight, scale)
                path = ""
                if keep:
                    path = f"captures/{name}_{case.name}_{number:03d}.npz".replace(" ", "_")
                    captures.save_capture(folder / path, capture)
                figures = measure_jump(capture, script, ROBOT, began=0.0, rules=rules)
                rows.append(row(name, case, number, figures, path))
    trial = of_kind(
        JUMPS,
        policies,
        cases=cases,
        rows=tuple(rows),
        rules=asdict(rules),
        timing={"seconds": 2.0, "simulated_s": 9.0, "processes": 1},
    )
    save_results(folder, trial)
    return load_results(folder)


def walks() -> TrialResults:
    """Two walks a policy; the naive one falls once."""
    case = walk.WALKS[0]
    rows = []
    for name in ("matched", "naive"):
        for number in range(2):
            figures = WalkFigures(
                fell=name == "naive" and number == 0,
                non_foot_contact=False,
                lasted=20.0,
                forward=1.9,
            )
            rows.append(row(name, case, number, figures))
    return of_kind(
        WALK,
        ("matched", "naive"),
        cases=(case,),
        rows=tuple(rows),
        script=walk_script((0.0, 0.0, 0.0)),
    )


def crossings() -> TrialResults:
    """Gaps of 0.2 m crossed 4 times of 5, of 0.4 m never."""
    case = PAPER_COMMANDS[1]
    rows = []
    for size in (0.2, 0.4):
        for number in range(5):
            crossed = size < 0.3 and number > 0
            figures = CrossingFigures(
                obstacle="gap",
                why="" if crossed else "a foot was in the gap",
                size=size,
                lead=0.4,
                take_off=0.1,
                landing=0.1,
                reach=0.3,
                speed=2.0,
            )
            rows.append(row("matched", case, number, figures))
    return of_kind(
        CROSSING,
        ("matched",),
        cases=(case,),
        rows=tuple(rows),
        settings={"shapes": ["gap", "up"], "runs": 5, "enough": 4},
    )


def write_tree(root: Path) -> Path:
    """Write a match, and below it a trial with all that may lie beside it."""
    result = match(legs=1)
    write_match(root, replace(result, joints={"FR_knee": result.joints["FR_knee"]}))
    write_trial(root / "trial", keep=True)
    save_results(root / "trial", walks())
    save_results(root / "trial", crossings())
    frames = [Image.new("RGB", (64, 40), (index * 60, 90, 120)) for index in range(4)]
    film = root / "trial" / "videos" / "matched_forward_2"
    film.parent.mkdir()
    frames[0].save(film.with_suffix(".gif"), save_all=True, append_images=frames[1:], duration=40)
    frames[0].save(film.with_suffix(".png"))
    film.with_suffix(".mp4").write_bytes(b"a film")
    return root
