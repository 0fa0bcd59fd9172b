"""Randomized and varied robots, walks, and the error of gains on a sweep."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.synthetic_log import Excitation, synthetic_log
from hopper import ROBOT, write_hopper
from pronk.errors import ArtefactError, PronkError
from pronk.identify.excitation.signals import Chirp
from pronk.identify.match.pipeline import match_logs
from pronk.identify.match.settings import MatchSettings
from pronk.identify.response.response import Estimator
from pronk.jump.trial import bodies, results, variation, walk
from pronk.jump.trial.protocol import Case
from pronk.jump.trial.results import Results
from pronk.jump.trial.trial import Plan, Setup
from pronk.jump.trial.variation import NOMINAL, Parameter, add_variation
from pronk.jump.virtual.robot import VirtualRobot
from pronk.jump.virtual.sim_params import load_sim_params
from pronk.policy.script import STILL, Script

SIM_PARAMS = load_sim_params()
QUICK = MatchSettings(method="paper", estimator=Estimator(segment_s=4.0), zero_armature=False)


# --- Draws --------------------------------------------------------------------------------------


@settings(max_examples=25)
@given(seed=st.integers(0, 10_000))
def test_draws_stay_within_their_tolerances(seed: int) -> None:
    drawn = bodies.draw_robot(SIM_PARAMS, ROBOT, seed=seed)
    for part, tolerances in bodies.TOLERANCES.items():
        pairs = [(getattr(SIM_PARAMS, part), getattr(drawn, part))]
        if part == "joints":
            pairs = [(SIM_PARAMS.joints[name], new) for name, new in drawn.joints.items()]
        for (own, new), (field, tolerance) in itertools.product(pairs, tolerances.items()):
            if field == "breakaway":
                assert new.breakaway >= new.coulomb
            else:
                batch = bodies.GROUP_TORQUE * (1.0 + tolerance.half) * (field == "torque_scale")
                value, found = (np.atleast_1d(getattr(each, field)) for each in (own, new))
                centre = tolerance.centre if tolerance.kind == "about" else value
                half = tolerance.half + batch
                half = half * np.abs(value) if tolerance.kind == "relative" else half
                # Rounded to five digits.
                assert (np.abs(found - centre) <= half + 1e-4 * np.abs(found)).all(), field


def test_a_body_is_its_seed_and_its_file(tmp_path: Path) -> None:
    one, again, other = (bodies.draw_robot(SIM_PARAMS, ROBOT, seed=seed) for seed in (1, 1, 2))
    assert one == again != other
    assert one.joints["FR_knee"] != SIM_PARAMS.joints["FR_knee"]
    path = tmp_path / "body" / "sim_params.yaml"
    bodies.save_sim_params(path, one, says="A body.\nFrom a test.")
    assert load_sim_params(path) == one
    assert path.read_text().startswith("# A body.\n# From a test.\n")
    # What is not drawn stays.
    assert one.machine.encoder_bits == SIM_PARAMS.machine.encoder_bits
    scene = replace(one, ground=replace(one.ground, floor=-1.0))
    with pytest.raises(PronkError, match="no terrain"):
        bodies.save_sim_params(path, scene, says="")
    assert load_sim_params(path) == one
    for each in (one, other):
        VirtualRobot(ROBOT, each, base="ground")  # refuses what cannot exist


# --- The Bode error of gains --------------------------------------------------------------------


def test_gains_are_as_wrong_as_the_match_says(tmp_path: Path) -> None:
    pairs, chirp = (20.6, 0.492), Excitation(offsets=Chirp(length_s=8.0).samples())
    logs = [synthetic_log(ROBOT, "FR_hip_roll", [chirp], *pairs)]
    gains = {"naive": {"FR_hip_roll": (17.0, 0.4)}, "own": {"FR_hip_roll": pairs}}
    found = bodies.gains_errors(logs, ROBOT, gains, settings=QUICK)
    assert found["own"] < 0.01
    matched = match_logs(logs, ROBOT, settings=QUICK).gains.joints["FR_hip_roll"]
    assert found["naive"] == pytest.approx(matched.quality.nominal_error_db, rel=1e-4)


# --- Other runs than jumps ----------------------------------------------------------------------


def setup(out: Path) -> Setup:
    return Setup(robot=ROBOT, sim_params=SIM_PARAMS, out=out)


def reloaded(found: Results, folder: Path) -> Results:
    read = results.load(folder, found.kind)
    assert repr((read.rows, read.cells)) == repr((found.rows, found.cells))
    return read


def test_only_the_varied_number_differs(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    policy = write_hopper(tmp_path / "policy.onnx")
    script = Script(command=STILL, stand_s=0.1, run_s=0.1, jump_s=0.14, keep_s=0.0, stop_s=1.0)
    plan = Plan(cases=(Case(name="spot", command=STILL),), jumps=1, script=script, spread_s=0.0)
    own = SIM_PARAMS.machine.bus_voltage
    changes = {"says": "battery", "unit": "V", "trained": "24 V"}
    volts = Parameter(name="bus_voltage", values=(18.0, own), **changes)
    found = add_variation([policy], plan, setup(tmp_path), parameters=(volts,))
    nominal, low, same = found.rows
    assert nominal.parameter == NOMINAL
    # The same value again is the same jump, to the last digit; another is another.
    assert same.figures == nominal.figures
    assert low.figures.height < nominal.figures.height
    line = variation.line(found, "bus_voltage", "matched", "spot")
    assert [cell.value for cell in line] == [18.0, own, own]
    assert [cell.n for cell in line] == [1, 1, 1]
    assert variation.parameters_of(reloaded(found, tmp_path)) == (volts,)


def test_a_walking_policy_stands(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    policy = write_hopper(tmp_path / "policy.onnx", jump=False)
    cases = (Case(name="stand", command=STILL), Case(name="slow", command=(0.1, 0.0, 0.0)))
    found = walk.add_walks([policy], setup(tmp_path), cases=cases, runs=1, seconds=2.4)
    stand, slow = (found.cell("matched", case.name) for case in cases)
    assert (stand.n, stand.fell, stand.non_foot_contact) == (1, 0, 0)
    # It stands whatever the command.
    assert stand.figures["speed_error"].mean < 0.01
    assert slow.figures["speed_error"].mean == pytest.approx(0.1, abs=0.01)
    assert stand.figures["lasted"].mean == pytest.approx(2.4)
    reloaded(found, tmp_path)
    path = tmp_path / walk.WALK.summary
    path.write_text(path.read_text().replace('"rows"', '"lines"'))
    with pytest.raises(ArtefactError, match="--walk"):
        results.load(tmp_path, walk.WALK)
