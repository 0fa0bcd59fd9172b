"""The contract, the measured vector and the runtime of a policy, without training."""

from __future__ import annotations

import hashlib
import json
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pronk.errors import ArtefactError, PronkError
from pronk.policy.contract import Contract, check, measured_layout
from pronk.policy.contract_json import METADATA_KEY, SCHEMA, from_json, to_json
from pronk.policy.layout import MEASURED, MEASURED_SIZE
from pronk.policy.observation import History, Measurement, finite
from pronk.policy.runtime import Policy, load_policy
from pronk.robots import load_robot

ROBOT = load_robot("mini_cheetah")
DEFAULT = np.array([joint.default_position for joint in ROBOT.joints])
SCALE = 0.25 + 0.01 * np.arange(12)


def contract(**changes: Any) -> Contract:
    kept: dict[str, Any] = {
        "robot": ROBOT.name,
        "joint_names": ROBOT.joint_names,
        "default_position": tuple(DEFAULT.tolist()),
        "action_scale": tuple(SCALE.tolist()),
        "stiffness": (20.0, 17.5, 21.5) * 4,
        "damping": (0.45, 0.4, 0.55) * 4,
        "gains": "matched",
        "gains_sha256": "0f" * 32,
        "virtual": True,
        "observation": measured_layout(50.0),
        "policy_rate_hz": 50.0,
        "timestep_s": 0.005,
        "decimation": 4,
        "delay_range_s": (0.0, 0.01),
        "command_ranges": {"vx": (-3.0, 3.0), "vy": (-1.0, 1.0), "yaw_rate": (-2.0, 2.0)},
        "jump": True,
        "lift_off_velocity": 2.5,
        "provenance": {"phases": {"walk": 400}, "seed": 3, "run": None},
        "versions": {"pronk": "0.1.0", "torch": "2.13.0"},
    }
    return Contract(**(kept | changes))


WALK: dict[str, Any] = {"jump": False, "lift_off_velocity": None}


def measurement(**changes: Any) -> Measurement:
    kept: dict[str, Any] = {
        "angular_velocity": np.zeros(3),
        "projected_gravity": [0.0, 0.0, -1.0],
        "position": DEFAULT,
        "velocity": np.zeros(12),
    }
    return Measurement(**(kept | changes))


def one_sentence(message: str) -> bool:
    return "\n" not in message and message.endswith(".") and "Traceback" not in message


# --- Contract -----------------------------------------------------------------------------------


def test_layout_by_hand() -> None:
    layout = measured_layout(50.0)
    three, two = (-0.04, -0.02, 0.0), (-0.04, -0.02)
    assert [(part.name, part.size, part.times_s) for part in layout] == [
        ("angular_velocity", 3, (0.0,)),
        ("projected_gravity", 3, (0.0,)),
        ("joint_position", 36, three),
        ("joint_velocity", 36, three),
        ("action", 24, two),
        ("command", 3, (0.0,)),
    ]
    assert sum(part.size for part in layout) == MEASURED_SIZE == 105


@pytest.mark.parametrize(
    "changes",
    [{}, WALK, {"gains": "naive", "gains_sha256": ""}, {"gains": "naive"}, {"versions": {}}],
)
def test_json_gives_the_same_contract_back(changes: dict[str, Any]) -> None:
    before = contract(**changes)
    text = to_json(before)
    assert from_json(text, source="here") == before
    assert next(iter(json.loads(text).items())) == ("schema", SCHEMA)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"default_position": (0.0,) * 11}, "default_position .* one number for each of the 12"),
        ({"action_scale": (0.35,) * 11 + (0.0,)}, "action_scale .* positive"),
        ({"stiffness": (float("nan"),) * 12}, "stiffness .* finite"),
        ({"damping": (0.4,) * 11 + (-0.1,)}, "damping .* not negative"),
        ({"gains": "best"}, "gains is 'best'; it must be matched or naive"),
        ({"gains_sha256": ""}, "gains_sha256 is ''; it must be 64 hex"),
        ({"gains": "naive", "gains_sha256": "xyz"}, "gains_sha256 is 'xyz'"),
        ({"policy_rate_hz": 100.0}, "policy_rate_hz is 100.0; .* 4 physics steps of 0.005 s"),
        ({"decimation": 0}, "policy_rate_hz"),
        ({"delay_range_s": (0.02, 0.01)}, "delay_range_s .* smaller number first"),
        ({"command_ranges": {"vx": (-1.0, 1.0)}}, "command_ranges .* vx, vy, yaw_rate"),
        (
            {"command_ranges": {"vx": (1.0, -1.0), "vy": (0.0, 0.0), "yaw_rate": (0.0, 0.0)}},
            "command_ranges of vx",
        ),
        ({"jump": False}, "lift_off_velocity is 2.5"),
        ({"lift_off_velocity": None}, "lift_off_velocity is None"),
    ],
)
def test_a_contract_that_contradicts_itself_is_refused(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(ArtefactError, match=said) as refusal:
        contract(**changes)
    assert one_sentence(str(refusal.value))


def edited(**changes: Any) -> str:
    return json.dumps(json.loads(to_json(contract())) | changes)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{", "is not JSON"),
        ("[]", "schema 'list'; this pronk reads 'pronk/policy/1'"),
        (edited(schema="pronk/policy/9"), "schema 'pronk/policy/9'"),
        (edited(mass=1.0), "missing or unknown: mass"),
        (to_json(contract()).replace('"stiffness"', '"stifness"'), "stiffness, stifness"),
        (edited(joint_names="FR"), "joint_names cannot be read: 'FR' is not a list"),
        (edited(stiffness=["a"] * 12), "stiffness cannot be read: 'a' is not a number"),
        (edited(stiffness=[True] * 12), "stiffness cannot be read: True is not a number"),
        (edited(jump=1), "jump cannot be read: 1 is neither true nor false"),
        (edited(robot=None), "robot cannot be read: None is not text"),
        (edited(decimation=4.0), "decimation cannot be read: 4.0 is not a whole number"),
        (edited(delay_range_s=[0.0]), r"delay_range_s cannot be read: \[0.0\] is not a pair"),
        (edited(versions=[]), r"versions cannot be read: \[\] is not a mapping"),
        (edited(observation=[{"name": "command"}]), "observation cannot be read: 'size'"),
        (edited(damping=[-1.0] * 12), "damping .* not negative"),
    ],
)
def test_a_contract_that_cannot_be_read_is_refused(text: str, said: str) -> None:
    with pytest.raises(ArtefactError, match=f"^policy.onnx: .*{said}") as refusal:
        from_json(text, source="policy.onnx")
    assert one_sentence(str(refusal.value))


def test_a_contract_whose_jumps_wait_for_the_stride_is_refused() -> None:
    body = json.loads(to_json(contract()))
    assert from_json(json.dumps(body | {"waits_for_stride": False}), source="a") == contract()
    with pytest.raises(ArtefactError, match="waits_for_stride"):
        from_json(json.dumps(body | {"waits_for_stride": True}), source="a")


def test_a_contract_that_fits_is_accepted() -> None:
    check(contract(), ROBOT)
    check(contract(), ROBOT, gains_sha256="0f" * 32)
    naive = {"stiffness": (17.0,) * 12, "damping": (0.4,) * 12}
    check(contract(gains="naive", gains_sha256="", **naive), ROBOT)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"robot": "so101"}, "robot is 'so101'; it must be 'mini_cheetah'"),
        ({"joint_names": ROBOT.joint_names[::-1]}, "joint_names is .* as the robot has it"),
        ({"policy_rate_hz": 100.0, "decimation": 2}, "policy_rate_hz is 100.0; it must be 50.0"),
        ({"timestep_s": 0.002, "decimation": 10}, "timestep_s is 0.002; it must be 0.005"),
        ({"default_position": (0.0, 0.0, 3.0) * 4}, "default_position of FR_knee is 3.0"),
        (
            {"stiffness": (20.0,) * 11 + (21.0,)},
            "stiffness of HL_knee is 21.0; it must be 20, as in all of knee",
        ),
        (
            {"gains": "naive", "stiffness": (17.0,) * 12},
            "damping of FR_hip_roll is 0.45; it must be 0.4, that of the drive",
        ),
    ],
)
def test_a_contract_for_another_robot_is_refused(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(ArtefactError, match=said) as refusal:
        check(contract(**changes), ROBOT)
    assert one_sentence(str(refusal.value))


def test_a_contract_of_other_gains_is_refused() -> None:
    with pytest.raises(ArtefactError, match=r"gains_sha256 .* that of the gains in hand"):
        check(contract(), ROBOT, gains_sha256="1e" * 32)


# --- The measured vector ------------------------------------------------------------------------


def part(vector: np.ndarray[Any, Any], name: str) -> np.ndarray[Any, Any]:
    return vector[MEASURED[name].start :][: MEASURED[name].size]


def test_history_by_hand() -> None:
    history = History(DEFAULT)
    command = (1.0, -0.5, 0.25)
    ones = np.ones(12)
    for again in range(2):  # the second time after a reset
        vectors = []
        for k in range(4):
            now = measurement(position=DEFAULT + k + 1.0, velocity=-10.0 * (k + 1) * ones)
            vectors.append(history.observe(now, command))
            history.acted(np.full(12, 100.0 + k, np.float32))
        # The first sample stands for the past; no action came before it.
        expected = [(1, 1, 1), (1, 1, 2), (1, 2, 3), (2, 3, 4)]
        actions = [(0, 0), (0, 100), (100, 101), (101, 102)]
        for vector, samples, before in zip(vectors, expected, actions, strict=True):
            repeated = np.repeat(samples, 12)
            np.testing.assert_allclose(part(vector, "joint_position"), repeated, atol=1e-6)
            np.testing.assert_array_equal(part(vector, "joint_velocity"), -10.0 * repeated)
            np.testing.assert_array_equal(part(vector, "action"), np.repeat(before, 12))
            np.testing.assert_array_equal(part(vector, "projected_gravity"), (0, 0, -1))
            np.testing.assert_array_equal(part(vector, "command"), command)
            assert vector.dtype == np.float32
        if again == 0:
            history.reset()


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"position": np.zeros(11)}, r"measured position has the shape \(11,\); expected \(12,\)"),
        ({"velocity": [np.nan] * 12}, r"measured velocity is nan at \[0\]"),
        ({"angular_velocity": [0.0, np.inf, 0.0]}, r"measured angular_velocity is inf at \[1\]"),
    ],
)
def test_a_measurement_that_is_none_is_refused(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(ArtefactError, match=said):
        measurement(**changes)


# --- Runtime ------------------------------------------------------------------------------------

WEIGHTS = 0.1 * np.random.default_rng(7).normal(size=(MEASURED_SIZE + 1, 19)).astype(np.float32)


def write_network(path: Path, metadata: dict[str, str], *, jump: bool, width: int = 105) -> Path:
    """A linear network: action, contact and velocity are columns of (measured, jump) WEIGHTS."""
    onnx = pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    helper, kind = onnx.helper, onnx.TensorProto.FLOAT
    inputs = {"measured": width} | ({"jump": 1} if jump else {})
    outputs = {"action": 12, "contact": 4, "linear_velocity": 3}
    rows = width + jump
    weights = np.concatenate([WEIGHTS[:width], WEIGHTS[MEASURED_SIZE:]])[:rows]
    graph = helper.make_graph(
        [
            helper.make_node("Concat", list(inputs), ["x"], axis=1),
            helper.make_node("MatMul", ["x", "weights"], ["y"]),
            helper.make_node("Split", ["y", "sizes"], list(outputs), axis=1),
        ],
        "linear",
        [helper.make_tensor_value_info(k, kind, ["batch", n]) for k, n in inputs.items()],
        [helper.make_tensor_value_info(k, kind, ["batch", n]) for k, n in outputs.items()],
        [
            onnx.numpy_helper.from_array(weights, "weights"),
            onnx.numpy_helper.from_array(np.array([12, 4, 3]), "sizes"),
        ],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    helper.set_model_props(model, metadata)
    path.write_bytes(model.SerializeToString())
    return path


def write_policy(folder: Path, **changes: Any) -> Path:
    made = contract(**changes)
    metadata = {METADATA_KEY: to_json(made)}
    return write_network(folder / "policy.onnx", metadata, jump=made.jump)


@pytest.fixture
def jumper(tmp_path: Path) -> Policy:
    return load_policy(write_policy(tmp_path))


@pytest.fixture
def walker(tmp_path: Path) -> Policy:
    return load_policy(write_policy(tmp_path, **WALK))


def test_metadata_is_read_without_pronk(tmp_path: Path) -> None:
    path = write_policy(tmp_path)
    onnxruntime = pytest.importorskip("onnxruntime")
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    body = json.loads(session.get_modelmeta().custom_metadata_map["pronk.contract"])
    assert body["schema"] == "pronk/policy/1"
    assert body["joint_names"][2] == "FR_knee"
    assert body["observation"][2] == {
        "name": "joint_position",
        "size": 36,
        "times_s": [-0.04, -0.02, 0.0],
        "unit": "rad",
    }


def test_a_loaded_policy_knows_its_contract_and_its_file(tmp_path: Path) -> None:
    path = write_policy(tmp_path)
    policy = load_policy(path)
    assert policy.contract == contract()
    assert policy.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()


def test_steps_are_default_plus_scaled_action_of_the_history(jumper: Policy) -> None:
    random = np.random.default_rng(1)
    history = History(DEFAULT)
    for k in range(6):
        if k == 4:
            jumper.reset()
            history.reset()
            assert jumper.inference is None
        now = measurement(position=random.normal(size=12), velocity=random.normal(size=12))
        jump = k % 2 == 1
        command = random.normal(size=3)
        target = jumper.step(now, command, jump)
        output = np.append(history.observe(now, command), np.float32(jump)) @ WEIGHTS
        history.acted(output[:12])
        np.testing.assert_allclose(target, DEFAULT + SCALE * output[:12], atol=1e-5)
        assert jumper.inference is not None
        np.testing.assert_allclose(jumper.inference.contact, output[None, 12:16], atol=1e-5)
        np.testing.assert_allclose(jumper.inference.linear_velocity, output[None, 16:], atol=1e-5)


def test_a_batch_is_its_rows(jumper: Policy) -> None:
    random = np.random.default_rng(2)
    measured = random.normal(size=(9, 105)).astype(np.float32)
    jump = (random.random((9, 1)) < 0.5).astype(np.float32)
    together = jumper.infer(measured, jump)
    for i in range(9):
        alone = jumper.infer(measured[i : i + 1], jump[i : i + 1])
        np.testing.assert_allclose(alone.action[0], together.action[i], atol=1e-5)
    still = jumper.infer(measured, np.zeros((9, 1)))
    np.testing.assert_array_equal(jumper.infer(measured).action, still.action)


def test_who_walks_is_not_told_to_jump(walker: Policy) -> None:
    measured = np.zeros((2, 105))
    with pytest.raises(ArtefactError, match="walk only"):
        walker.step(measurement(), np.zeros(3), jump=True)
    with pytest.raises(ArtefactError, match="walk only"):
        walker.infer(measured, np.array([[0.0], [1.0]]))
    assert walker.infer(measured, np.zeros((2, 1))).action.shape == (2, 12)
    assert walker.step(measurement(), np.zeros(3)).shape == (12,)


def test_a_refused_step_leaves_no_trace(walker: Policy) -> None:
    first = walker.step(measurement(), np.ones(3))
    walker.reset()
    with pytest.raises(ArtefactError, match=r"the command is nan at \[2\]"):
        walker.step(measurement(position=DEFAULT + 1.0), [0.0, 0.0, np.nan])
    with pytest.raises(ArtefactError, match="walk only"):
        walker.step(measurement(position=DEFAULT + 1.0), np.ones(3), jump=True)
    np.testing.assert_array_equal(walker.step(measurement(), np.ones(3)), first)


def test_what_is_no_number_is_refused(jumper: Policy) -> None:
    measured = np.zeros((3, 105), np.float32)
    measured[1, 7] = np.nan
    with pytest.raises(ArtefactError, match=r'input "measured" is nan at \[1, 7\]'):
        jumper.infer(measured)
    with pytest.raises(ArtefactError, match=r'input "jump" is inf'):
        jumper.infer(np.zeros((1, 105)), [[1e300]])
    with pytest.raises(ArtefactError, match=r"shape \(3, 104\); expected \(3, 105\)"):
        jumper.infer(np.zeros((3, 104)))
    with pytest.raises(ArtefactError, match=r'output "action" is'):
        jumper.infer(np.full((1, 105), 3e38, np.float32))


@pytest.mark.parametrize("kind", [np.float32, np.float64, np.int64])
def test_finite_numbers_of_any_size_and_kind_are_read(kind: type) -> None:
    # Squares of the largest have no room in a float32.
    most = 2**62 if kind is np.int64 else kind(3.4e38)
    for value in ([0, 1, -2], [most, 1, -most]):
        read = finite("it", np.array(value, kind), (3,))
        assert read.dtype == np.float32
        np.testing.assert_array_equal(read, np.array(value, np.float32))
    for bad in (math.nan, math.inf, -math.inf, 1e39):
        with pytest.raises(ArtefactError, match=r"it is (nan|-?inf) at \[1\]; a policy reads"):
            finite("it", [0.0, bad, 1e300], (3,))


def test_files_that_are_no_policy_are_refused(tmp_path: Path) -> None:
    whole = write_policy(tmp_path).read_bytes()
    (tmp_path / "half.onnx").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "text.onnx").write_text("not a network")
    (tmp_path / "empty.onnx").write_bytes(b"")
    write_network(tmp_path / "foreign.onnx", {"author": "someone"}, jump=False)
    write_network(tmp_path / "odd.onnx", {METADATA_KEY: "{}"}, jump=True)
    walks = to_json(contract(**WALK))
    write_network(tmp_path / "jumps.onnx", {METADATA_KEY: walks}, jump=True)
    write_network(tmp_path / "narrow.onnx", {METADATA_KEY: walks}, jump=False, width=45)
    mixed = replace(contract(), observation=measured_layout(50.0)[::-1])
    write_network(tmp_path / "mixed.onnx", {METADATA_KEY: to_json(mixed)}, jump=True)
    for name, said in {
        "none.onnx": "no such file; `pronk train` writes one",
        "": "cannot be read",
        "half.onnx": "not a network that ONNX Runtime can run",
        "text.onnx": "not a network that ONNX Runtime can run",
        "empty.onnx": "not a network that ONNX Runtime can run",
        "foreign.onnx": "a network without a contract of pronk",
        "odd.onnx": "schema None",
        "jumps.onnx": r"inputs are .*jump.* needs measured \(batch, 105\)",
        "narrow.onnx": r"inputs are .*45.* needs measured \(batch, 105\)",
        "mixed.onnx": "laid out in another way",
    }.items():
        with pytest.raises(ArtefactError, match=said) as refusal:
            load_policy(tmp_path / name)
        assert str(tmp_path / name) in str(refusal.value)
        assert one_sentence(str(refusal.value))


def test_without_onnx_runtime_the_way_out_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_policy(tmp_path)
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(PronkError, match=r"pip install 'pronk\[policy\]'"):
        load_policy(path)
