"""Conditions of a trial: their files, what they change, and policies under them; walks."""

from __future__ import annotations

import csv
import json
import math
import platform
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import pronk.robots
from command_line import accepted, refused
from hopper import ROBOT, write_hopper
from pronk.errors import ArtefactError, PronkError, RobotError
from pronk.jump.trial import bodies, tables, walk
from pronk.jump.trial.condition_trial import (
    CELLS,
    ConditionResults,
    run_conditions,
    save_sim_params,
)
from pronk.jump.trial.conditions import (
    Change,
    Condition,
    body_conditions,
    changed_params,
    load_conditions,
)
from pronk.jump.trial.protocol import Case
from pronk.jump.trial.results import load_results
from pronk.jump.trial.trial import TrialPlan, TrialSetup
from pronk.jump.virtual.plant import Plant
from pronk.jump.virtual.robot import VirtualRobot
from pronk.jump.virtual.sim_params import load_sim_params
from pronk.policy.script import STILL, Script
from pronk.report.trial_figures import draw_conditions
from pronk.robots import load_robot
from pronk.robots.model import bench_inertia

SIM_PARAMS = load_sim_params()
SCRIPT = Script(command=STILL, stand_s=0.1, run_s=0.1, jump_s=0.14, keep_s=0.0, stop_s=1.0)
PLAN = TrialPlan(cases=(Case(name="spot", command=STILL),), jumps=1, script=SCRIPT, spread_s=0.0)


def setup(out: Path) -> TrialSetup:
    return TrialSetup(robot=ROBOT, sim_params=SIM_PARAMS, out=out)


# --- What a condition changes -------------------------------------------------------------------


def test_a_factor_an_offset_and_a_value() -> None:
    condition = Condition(
        name="all three",
        changes=(
            Change(parameters=("joints.torque_scale",), joints=("knee",), factor=0.5),
            Change(parameters=("machine.command_delay_s",), offset=0.004),
            Change(parameters=("ground.friction",), value=1.6),
        ),
    )
    changed = changed_params(condition, SIM_PARAMS, ROBOT)
    for name, joint in changed.joints.items():
        nominal = SIM_PARAMS.joints[name].torque_scale
        expected = 0.5 * nominal if name.endswith("knee") else nominal
        assert joint.torque_scale == pytest.approx(expected)
    delay = SIM_PARAMS.machine.command_delay_s + 0.004
    assert changed.machine.command_delay_s == pytest.approx(delay)
    assert changed.ground.friction == 1.6
    assert changed.trunk == SIM_PARAMS.trunk


def test_numbers_that_are_valid_only_together_are_changed_together() -> None:
    # Friction at the onset of slip is never below that while slipping.
    dry = Change(parameters=("joints.coulomb", "joints.breakaway"), factor=3.0)
    changed = changed_params(Condition(name="dry", changes=(dry,)), SIM_PARAMS, ROBOT)
    knee = changed.joints["FR_knee"]
    assert knee.breakaway == pytest.approx(3.0 * SIM_PARAMS.joints["FR_knee"].breakaway)


def test_changes_are_applied_in_their_order() -> None:
    double = Change(parameters=("ground.friction",), factor=2.0)
    condition = Condition(name="four times", changes=(double, double))
    changed = changed_params(condition, SIM_PARAMS, ROBOT)
    assert changed.ground.friction == pytest.approx(4.0 * SIM_PARAMS.ground.friction)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (Change(parameters=("joints.torque_scale",), joints=("elbow",), factor=2.0), "elbow"),
        (Change(parameters=("joints.torque_scale",), factor=100.0), "torque_scale"),
        (Change(parameters=("joints.coulomb",), factor=3.0), "breakaway"),
    ],
)
def test_a_robot_that_cannot_exist_is_refused(change: Change, words: str) -> None:
    with pytest.raises(RobotError, match=words) as refusal:
        changed_params(Condition(name="odd", changes=(change,)), SIM_PARAMS, ROBOT)
    assert "condition odd" in str(refusal.value)


@pytest.mark.parametrize("error_db", [-4.0, -1.0, 0.25, 0.5])
def test_a_gain_error_is_one_of_the_response(error_db: float) -> None:
    """Recomputed for each joint; softer with a minus, and the torque limits stay."""
    change = Change(parameters=("joints.gain_scale",), gain_error_db=error_db)
    condition = Condition(name="off", changes=(change,))
    changed = changed_params(condition, SIM_PARAMS, ROBOT)
    for joint in ROBOT.joints:
        params = changed.joints[joint.name]
        assert replace(params, gain_scale=1.0) == SIM_PARAMS.joints[joint.name]
        assert (params.gain_scale > 1.0) == (error_db > 0.0)
        inertia, _ = bench_inertia(ROBOT, joint.name)
        s = 2j * math.pi * np.linspace(*joint.band_hz, 1000)
        levels = []
        for scale in (1.0, params.gain_scale):
            stiffness = scale * params.torque_scale * joint.stiffness
            damping = scale * params.torque_scale * joint.damping + params.viscous
            levels.append(
                20.0 * np.log10(abs(stiffness / (inertia * s**2 + damping * s + stiffness)))
            )
        rms = math.sqrt(np.mean((levels[1] - levels[0]) ** 2))
        assert rms == pytest.approx(abs(error_db), rel=0.02)


def test_a_gain_error_that_no_drive_has_is_refused() -> None:
    change = Change(parameters=("joints.gain_scale",), gain_error_db=4.0)
    with pytest.raises(RobotError, match="at most") as refusal:
        changed_params(Condition(name="too stiff", changes=(change,)), SIM_PARAMS, ROBOT)
    assert "condition too stiff" in str(refusal.value)


def test_the_virtual_robot_applies_the_scale_to_the_gains_alone() -> None:
    """A joint that is held off its target gives that share of the torque."""
    torques = []
    for scale in (1.0, 0.5):
        change = Change(parameters=("joints.gain_scale",), value=scale)
        params = changed_params(Condition(name="off", changes=(change,)), SIM_PARAMS, ROBOT)
        plant = Plant(ROBOT, params, ("FR",), 2.5e-4)
        plant.set_gains(np.full(3, 20.0), np.full(3, 0.5))
        torques.append(plant.model.actuator_gainprm[plant.actuator].copy())
        limits = plant.inverters.copy()
    stiffness = 4  # place of kp in MuJoCo's parameters of a dcmotor
    np.testing.assert_allclose(torques[1][:, stiffness], 0.5 * torques[0][:, stiffness])
    np.testing.assert_array_equal(limits, plant.inverters)


# --- Files --------------------------------------------------------------------------------------


def test_the_example_of_a_battery_changes_its_resistance_alone() -> None:
    path = Path(__file__).parents[2] / "examples" / "battery.yaml"
    conditions = load_conditions(str(path), SIM_PARAMS, ROBOT)
    assumed = SIM_PARAMS.machine.bus_resistance
    resistances = []
    for condition in conditions:
        changed = changed_params(condition, SIM_PARAMS, ROBOT)
        resistances.append(changed.machine.bus_resistance)
        machine = replace(changed.machine, bus_resistance=assumed)
        assert replace(changed, machine=machine) == SIM_PARAMS
    assert resistances == sorted(set(resistances))
    assert assumed in resistances


def test_the_tolerance_is_four_series_about_the_nominal_robot() -> None:
    conditions = load_conditions("tolerance", SIM_PARAMS, ROBOT)
    series: dict[str, list[float]] = {}
    for condition in conditions:
        assert condition.place is not None
        series.setdefault(condition.series, []).append(condition.place)
    torque, delay, friction, gain_error = series.values()
    assert (min(torque), max(torque)) == (0.5, 1.7)
    assert (min(delay), max(delay)) == (0.0, 0.02)
    assert (min(friction), max(friction)) == (0.0, 5.0)
    assert (min(gain_error), max(gain_error)) == (-4.0, 0.5)
    for condition in conditions:
        if condition.name.startswith(("torque of the drives 1 ", "gain error 0 ")):
            assert changed_params(condition, SIM_PARAMS, ROBOT) == SIM_PARAMS


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("schema: pronk/gains/1", "pronk/conditions/1"),
        ("schema: pronk/conditions/1", "no conditions"),
        ("schema: pronk/conditions/1\nconditions: [{name: a}, {name: a}]", "2 conditions named"),
        ("schema: pronk/conditions/1\nconditions: [{name: ../a}]", "cannot be used"),
        ("schema: pronk/conditions/1\nconditions: [{name: a, changes: [{factor: 2}]}]", "param"),
        (
            "schema: pronk/conditions/1\nconditions: [{name: a, changes: "
            "[{parameters: [knees.torque], factor: 2}]}]",
            "the parts are joints",
        ),
        (
            "schema: pronk/conditions/1\nconditions: [{name: a, changes: "
            "[{parameters: [ground.slope], factor: 2}]}]",
            "the numbers of ground are friction",
        ),
        (
            "schema: pronk/conditions/1\nconditions: [{name: a, changes: "
            "[{parameters: [ground.friction], factor: 2, value: 1}]}]",
            "expected exactly one",
        ),
        (
            "schema: pronk/conditions/1\nseries: [{name: a, parameters: [ground.friction]}]",
            "factors, offsets, values and",
        ),
        (
            "schema: pronk/conditions/1\nconditions: [{name: a, changes: "
            "[{parameters: [ground.friction], gain_error_db: 2}]}]",
            "joints.gain_scale",
        ),
    ],
)
def test_a_file_that_holds_no_conditions_is_refused(text: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "conditions.yaml"
    path.write_text(text)
    with pytest.raises(PronkError, match=words) as refusal:
        load_conditions(str(path), SIM_PARAMS, ROBOT)
    assert str(path) in str(refusal.value)


def test_a_missing_file_names_the_built_in_sets(tmp_path: Path) -> None:
    with pytest.raises(ArtefactError, match="bodies, tolerance"):
        load_conditions(str(tmp_path / "none.yaml"), SIM_PARAMS, ROBOT)


# --- Random robots ------------------------------------------------------------------------------


@settings(max_examples=25)
@given(seed=st.integers(0, 10_000))
def test_draws_stay_within_their_tolerances(seed: int) -> None:
    for drawn in bodies.draw_body(SIM_PARAMS, ROBOT, seed=seed):
        part, name = drawn.parameter.split(".")
        tolerance = bodies.TOLERANCES[part][name]
        nominal: Any = getattr(SIM_PARAMS, part)
        if drawn.joint:
            nominal = nominal[drawn.joint]
        if name == "breakaway":
            continue  # moves with the friction while slipping
        number = np.atleast_1d(getattr(nominal, name))
        value = np.atleast_1d(drawn.value)
        half_width = tolerance.half_width
        if name == "torque_scale":
            half_width += bodies.GROUP_TORQUE * (1.0 + tolerance.half_width)
        if tolerance.about == "nominal":
            centre = number
            half_width = half_width * np.abs(number)
        else:
            centre = np.full_like(number, tolerance.centre, dtype=float)
        # Rounded to five digits.
        assert (np.abs(value - centre) <= half_width + 1e-4 * np.abs(value)).all(), drawn


def test_battery_and_trunk_are_drawn_in_proportion_to_the_robot() -> None:
    """A Go2 has eight cells, whose 24 V would be empty, and weighs a quarter more."""
    go2 = load_robot("go2")
    params = load_sim_params(None, go2)
    voltages = []
    masses = []
    for seed in range(60):
        for drawn in bodies.draw_body(params, go2, seed=seed):
            if drawn.parameter == "machine.bus_voltage":
                voltages.append(drawn.value)
            if drawn.parameter == "trunk.mass_offset":
                masses.append(drawn.value)
    nominal_voltage = params.machine.bus_voltage
    assert 0.95 * nominal_voltage < min(voltages) < 0.97 * nominal_voltage
    assert 1.03 * nominal_voltage < max(voltages) < 1.05 * nominal_voltage
    assert -0.3 * 15.017 / 12.0 <= min(masses) < 0.0
    assert 0.9 < max(masses) <= 0.9 * 1.2515
    # The Mini Cheetah's are those of the table.
    assert bodies.tolerances_of(ROBOT) == bodies.TOLERANCES


def test_a_body_is_its_seed() -> None:
    nominal, *robots = body_conditions(SIM_PARAMS, ROBOT, seed=0)
    assert changed_params(nominal, SIM_PARAMS, ROBOT) == SIM_PARAMS
    assert robots == body_conditions(SIM_PARAMS, ROBOT, seed=0)[1:]
    assert robots != body_conditions(SIM_PARAMS, ROBOT, seed=1)[1:]
    for condition in robots:
        params = changed_params(condition, SIM_PARAMS, ROBOT)
        assert params.joints["FR_knee"] != SIM_PARAMS.joints["FR_knee"]
        for joint in params.joints.values():
            assert joint.breakaway >= joint.coulomb
        # What has no tolerance stays.
        assert params.machine.encoder_bits == SIM_PARAMS.machine.encoder_bits
        VirtualRobot(ROBOT, params, base="ground")  # refuses what cannot exist


def test_changed_parameters_are_a_file_for_other_commands(tmp_path: Path) -> None:
    condition = body_conditions(SIM_PARAMS, ROBOT, seed=0)[1]
    params = changed_params(condition, SIM_PARAMS, ROBOT)
    path = tmp_path / "robots" / "body.yaml"
    save_sim_params(path, params, comment="A body.")
    assert load_sim_params(path) == params
    assert path.read_text().startswith("# A body.\n")
    scene = replace(params, ground=replace(params.ground, floor=-1.0))
    with pytest.raises(PronkError, match="no terrain"):
        save_sim_params(path, scene, comment="")
    assert load_sim_params(path) == params


# --- Policies under conditions ------------------------------------------------------------------

CONDITIONS = [
    Condition(name="nominal"),
    Condition(
        name="battery 18 V",
        changes=(Change(parameters=("machine.bus_voltage",), value=18.0),),
        series="battery [V]",
        place=18.0,
    ),
    Condition(
        name="battery as it is",
        changes=(Change(parameters=("machine.bus_voltage",), factor=1.0),),
        series="battery [V]",
        place=24.0,
    ),
]


@pytest.fixture(scope="module")
def policies(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    pytest.importorskip("onnxruntime")
    folder = tmp_path_factory.mktemp("policies")
    return [write_hopper(folder / "strong.onnx"), write_hopper(folder / "weak.onnx", 0.5)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("conditions")


@pytest.fixture(scope="module")
def results(policies: list[Path], folder: Path) -> ConditionResults:
    return run_conditions(policies, CONDITIONS, PLAN, setup(folder))


def test_only_the_changed_number_differs(results: ConditionResults) -> None:
    nominal = results.cell("strong", "nominal")
    assert results.cell("strong", "battery as it is").height == nominal.height
    assert results.cell("strong", "battery 18 V").height.mean < nominal.height.mean
    assert results.cell("weak", "nominal").height.mean < nominal.height.mean
    # No velocity is commanded.
    assert math.isnan(nominal.velocity_error.mean)


def test_conditions_that_change_nothing_share_a_cell(
    results: ConditionResults, folder: Path
) -> None:
    assert results.kept == 2  # one of each policy
    assert len(list((folder / CELLS).iterdir())) == 4


def test_an_interrupted_run_goes_on(
    results: ConditionResults, policies: list[Path], folder: Path
) -> None:
    lost = results.cell("weak", "battery 18 V")
    path = folder / CELLS / f"{lost.key}.json"
    content = path.read_bytes()
    path.unlink()
    shares: list[float] = []
    again = run_conditions(policies, CONDITIONS, PLAN, setup(folder), progress=shares.append)
    assert shares == [1.0]  # one jump was missing
    assert path.read_bytes() == content
    assert repr(again.cells) == repr(results.cells)


def test_a_robot_that_cannot_stand_has_not_landed(policies: list[Path], tmp_path: Path) -> None:
    """With a fifth of the gains it sags too far for a policy to start; the others go on."""
    soft = Change(parameters=("joints.gain_scale",), value=0.2)
    conditions = [Condition(name="soft", changes=(soft,)), Condition(name="nominal")]
    results = run_conditions(policies[:1], conditions, PLAN, setup(tmp_path))
    cell, nominal = results.cells
    assert (cell.jumps, cell.landed, cell.stood, cell.fell) == (1, 0, 0, None)
    assert (nominal.stood, nominal.fell) == (1, 0)
    assert math.isnan(cell.height.mean)
    assert nominal.height.mean > 0.0
    table = tables.condition_table(results)
    fell = [column.heading for column in table.columns].index("fell")
    assert [row[fell] for row in table.rows] == ["-", "0/1"]
    # The table says which runs these are, and of no others.
    assert any(table.rows[0][0] in note for note in table.notes)
    assert not any(table.rows[1][0] in note for note in table.notes)
    with (tmp_path / "conditions.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["fell"] for row in rows] == ["", "0"]
    again = run_conditions(policies[:1], conditions, PLAN, setup(tmp_path))
    assert again.kept == 2
    draw_conditions(again)


def test_another_plan_has_cells_of_its_own(
    results: ConditionResults, policies: list[Path], folder: Path, tmp_path: Path
) -> None:
    shutil.copytree(folder / CELLS, tmp_path / CELLS)
    plan = replace(PLAN, seed=1)
    other = run_conditions(policies[:1], CONDITIONS[:1], plan, setup(tmp_path))
    assert other.kept == 0
    assert other.cells[0].key != results.cell("strong", "nominal").key


@pytest.mark.parametrize("content", ["", "{", '{"schema": "pronk/condition-cell/1"}', "half"])
def test_a_damaged_cell_is_named_and_run_again(
    policies: list[Path], tmp_path: Path, content: str
) -> None:
    first = run_conditions(policies[:1], CONDITIONS[:1], PLAN, setup(tmp_path))
    path = tmp_path / CELLS / f"{first.cells[0].key}.json"
    content_before = path.read_bytes()
    path.write_bytes(
        content_before[: len(content_before) // 2] if content == "half" else content.encode()
    )
    again = run_conditions(policies[:1], CONDITIONS[:1], PLAN, setup(tmp_path))
    (name,) = again.damaged
    assert again.subjects[0].name in name
    assert CONDITIONS[0].name in name
    assert again.kept == 0
    assert path.read_bytes() == content_before
    assert repr(again.cells) == repr(first.cells)


@pytest.mark.parametrize("part", ["robots", "table", "summary", "nothing", "a hidden file"])
def test_a_part_of_a_run_is_completed(policies: list[Path], tmp_path: Path, part: str) -> None:
    """As in a copy without its cells; an empty folder is not copied by every program."""
    out = tmp_path / "out"
    first = run_conditions(policies[:1], CONDITIONS[:1], PLAN, setup(out))
    shutil.rmtree(out / CELLS)
    names = {"robots": "robots", "table": "conditions.csv", "summary": "conditions.json"}
    for path in list(out.iterdir()):
        if path.name != names.get(part):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    if part == "a hidden file":
        (out / ".conditions.json.part").touch()
    again = run_conditions(policies[:1], CONDITIONS[:1], PLAN, setup(out))
    assert again.kept == 0
    assert repr(again.cells) == repr(first.cells)


def test_robots_of_a_user_are_no_part_of_a_run(policies: list[Path], tmp_path: Path) -> None:
    robots = tmp_path / "robots"
    robots.mkdir()
    (robots / "nominal.yaml").write_text("# Measured by hand.\n")
    with pytest.raises(PronkError, match="not empty"):
        run_conditions(policies[:1], CONDITIONS[:1], PLAN, setup(tmp_path))
    assert (robots / "nominal.yaml").read_text() == "# Measured by hand.\n"


@pytest.mark.parametrize("state", ["finished", "interrupted", "of an earlier pronk"])
def test_cells_of_another_machine_are_kept(
    policies: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, state: str
) -> None:
    """Its Python and NumPy are newer, its folders have other names; pronk and MuJoCo are alike."""
    far_folder = tmp_path / "far"
    with monkeypatch.context() as other_machine:
        other_machine.setattr(platform, "python_version", lambda: "3.99.1")
        other_machine.setattr(np, "__version__", "9.9.9")
        first = run_conditions(policies, CONDITIONS[:2], PLAN, setup(far_folder))
    near_folder = tmp_path / "near"
    shutil.copytree(far_folder, near_folder)
    if state == "interrupted":
        for name in ("conditions.json", "conditions.csv"):
            (near_folder / name).unlink()
    if state == "of an earlier pronk":
        for path in (near_folder / CELLS).iterdir():
            body = json.loads(path.read_text())
            del body["versions"]
            path.write_text(json.dumps(body))
    moved = []
    for path in policies:
        copy = tmp_path / "moved" / path.name
        copy.parent.mkdir(exist_ok=True)
        shutil.copyfile(path, copy)
        moved.append(copy)
    cells = {path.name: path.stat().st_mtime_ns for path in (near_folder / CELLS).iterdir()}
    again = run_conditions(moved, CONDITIONS, PLAN, setup(near_folder))
    # The third condition changes nothing of the first, so that its cells are there as well.
    assert again.kept == len(again.cells) == 6
    for path in (near_folder / CELLS).iterdir():
        assert path.stat().st_mtime_ns == cells.pop(path.name)
    assert not cells
    for cell in first.cells:
        assert repr(again.cell(cell.policy, cell.condition)) == repr(cell)
    (versions,) = again.kept_versions
    assert versions["python"] == "3.99.1"
    assert again.versions["python"] == platform.python_version()
    assert again.unused_versions == ()


def test_cells_of_another_mujoco_do_not_count_and_are_not_lost(
    policies: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as other_machine:
        other_machine.setattr(mujoco, "__version__", "2.0.0")
        run_conditions(policies[:1], CONDITIONS[:1], PLAN, setup(tmp_path))
    (stored,) = (tmp_path / CELLS).iterdir()
    content = stored.read_bytes()
    again = run_conditions(policies[:1], CONDITIONS[:1], PLAN, setup(tmp_path))
    assert again.kept == 0
    (versions,) = again.unused_versions
    assert versions["mujoco"] == "2.0.0"
    assert stored.read_bytes() == content
    # With nothing to compute there is nothing to say.
    assert run_conditions(policies[:1], CONDITIONS[:1], PLAN, setup(tmp_path)).unused_versions == ()


def test_a_changed_robot_of_the_same_name_has_cells_of_its_own(
    policies: list[Path], tmp_path: Path
) -> None:
    shipped = Path(pronk.robots.__file__).parent / "mini_cheetah"
    out = tmp_path / "out"
    kept = []
    heights = []
    for name, mass in (("light", "6.607999999999999"), ("heavy", "7.608"), ("moved", "7.608")):
        folder = tmp_path / name
        shutil.copytree(shipped, folder)
        model = folder / "mini_cheetah.xml"
        model.write_text(model.read_text().replace("6.607999999999999", mass))
        robot = load_robot(folder / "robot.yaml")
        changed = replace(setup(out), robot=robot)
        results = run_conditions(policies[:1], CONDITIONS[:1], PLAN, changed)
        kept.append(results.kept)
        heights.append(results.cells[0].height.mean)
    assert kept == [0, 0, 1]
    assert heights[0] != heights[1] == heights[2]


def test_a_folder_of_something_else_is_refused(policies: list[Path], tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(PronkError, match="not empty"):
        run_conditions(policies[:1], CONDITIONS[:1], PLAN, setup(tmp_path))


def test_the_table_and_the_figure(results: ConditionResults, folder: Path) -> None:
    table = tables.condition_table(results)
    assert [row[0] for row in table.rows[:2]] == ["nominal: strong", "nominal: weak"]
    with (folder / "conditions.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["place"] for row in rows] == ["", "", "18.0", "18.0", "24.0", "24.0"]
    assert float(rows[0]["height_m"]) == results.cells[0].height.mean
    figure = draw_conditions(results)
    # Four outcomes by the nominal robot and one series.
    assert len(figure.axes) == 8
    labels = [axes.get_ylabel() for axes in figure.axes[::2]]
    assert labels == ["landed [1]", "height [m]", "distance [m]", "velocity error [m/s]"]
    assert figure.axes[7].get_xlabel() == "battery [V]"


def test_the_command_writes_table_and_figure(policies: list[Path], tmp_path: Path) -> None:
    file = tmp_path / "conditions.yaml"
    file.write_text(
        "schema: pronk/conditions/1\n"
        "conditions: [{name: slippery, changes: [{parameters: [ground.friction], value: 0.2}]}]\n"
    )
    out = tmp_path / "out"
    figures = tmp_path / "figures.json"
    words = ["trial", *policies, "--out", out, "--conditions", str(file), "--processes", "1"]
    words += ["--commands=0,1", "--jumps", "1"]
    printed = accepted(*words, "--json", figures)
    assert "slippery: strong" in printed
    assert (out / "conditions.svg").exists()
    body = json.loads(figures.read_text())
    assert [cell["policy"] for cell in body["cells"]] == ["strong", "weak"]
    assert load_sim_params(out / "robots" / "slippery.yaml").ground.friction == 0.2
    assert "2 of which were there already" in accepted(*words)
    assert "--conditions" in refused(*words, "--walk")


# --- Walks --------------------------------------------------------------------------------------


def test_a_walking_policy_stands(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    policy = write_hopper(tmp_path / "policy.onnx", jump=False)
    cases = (Case(name="stand", command=STILL), Case(name="slow", command=(0.1, 0.0, 0.0)))
    walks = walk.add_walks([policy], setup(tmp_path), cases=cases, runs=1, seconds=2.4)
    stand = walks.cell("matched", "stand")
    slow = walks.cell("matched", "slow")
    assert (stand.n, stand.fell, stand.non_foot_contact) == (1, 0, 0)
    # It stands whatever the command.
    assert stand.figures["speed_error"].mean < 0.01
    assert slow.figures["speed_error"].mean == pytest.approx(0.1, abs=0.01)
    assert stand.figures["lasted"].mean == pytest.approx(2.4)
    loaded = load_results(tmp_path, walk.WALK)
    assert repr((loaded.rows, loaded.cells)) == repr((walks.rows, walks.cells))
    path = tmp_path / walk.WALK.summary
    path.write_text(path.read_text().replace('"rows"', '"lines"'))
    with pytest.raises(ArtefactError, match="--walk"):
        load_results(tmp_path, walk.WALK)
