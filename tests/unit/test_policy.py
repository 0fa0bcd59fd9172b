"""The contract, the measured vector and the runtime of a policy, without training."""

from __future__ import annotations

import hashlib
import json
import math
import resource
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from hopper import DEFAULT, ROBOT, contract, write_hopper
from pronk.errors import ArtefactError, PronkError
from pronk.policy.contract import METADATA_KEY, check, from_json, measured_layout, to_json
from pronk.policy.observation import MEASURED_SIZE, History, Measurement, finite
from pronk.policy.runtime import Policy, load_policy

SCALE = np.full(12, 0.5)
WALK: dict[str, Any] = {"jump": False}


def measurement(**changes: Any) -> Measurement:
    fields: dict[str, Any] = {
        "angular_velocity": np.zeros(3),
        "projected_gravity": [0.0, 0.0, -1.0],
        "position": DEFAULT,
        "velocity": np.zeros(12),
    }
    fields.update(changes)
    return Measurement(**fields)


# --- Contract -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "changes", [{}, WALK, {"gains": "naive", "gains_sha256": ""}, {"versions": {"torch": "2.13"}}]
)
def test_json_gives_the_same_contract_back(changes: dict[str, Any]) -> None:
    before = contract(**changes)
    old = json.loads(to_json(before)) | {"waits_for_stride": False}
    assert from_json(json.dumps(old), source="here") == before


BEYOND = {"vx": (-300.0, 3.0), "vy": (-1.0, 1.0), "yaw_rate": (-2.0, 2.0)}


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        # Contradictions.
        ({"default_position": (0.0,) * 11}, "default_position"),
        ({"action_scale": (0.35,) * 11 + (0.0,)}, "action_scale"),
        ({"damping": (0.4,) * 11 + (-0.1,)}, "damping"),
        ({"gains": "best"}, "gains"),
        ({"gains_sha256": ""}, "gains_sha256"),
        ({"gains": "naive", "gains_sha256": "xyz"}, "gains_sha256"),
        ({"policy_rate_hz": 100.0}, "policy_rate_hz"),
        ({"decimation": 0}, "policy_rate_hz"),
        ({"delay_range_s": (0.02, 0.01)}, "delay_range_s"),
        ({"delay_range_s": (-0.1, 0.0)}, "delay_range_s"),
        ({"command_ranges": {"vx": (-1.0, 1.0)}}, "command_ranges"),
        ({"command_ranges": {"vx": (1, -1), "vy": (0, 0), "yaw_rate": (0, 0)}}, "of vx"),
        ({"jump": False}, "lift_off_velocity"),
        ({"lift_off_velocity": None}, "lift_off_velocity"),
        # Beyond every robot.
        ({"action_scale": (1e6,) * 12}, "action_scale"),
        ({"delay_range_s": (0.0, 10.0)}, "delay_range_s"),
        ({"stiffness": (1e9,) * 12}, "stiffness"),
        ({"default_position": (1e3,) * 12}, "default_position"),
        ({"lift_off_velocity": 1e3}, "lift_off_velocity"),
        ({"command_ranges": BEYOND}, "command_ranges"),
        ({"joint_names": ("..", *"abcdefghijk")}, "name"),
        # Other types, fields and schemas.
        ({"schema": "pronk/policy/9"}, "pronk/policy/9"),
        ({"mass": 1.0}, "mass"),
        ({"stiffness": [True] * 12}, "stiffness"),
        ({"jump": 1}, "jump"),
        ({"decimation": 4.5}, "decimation"),
        ({"observation": [{"name": "command"}]}, "observation"),
        ({"waits_for_stride": True}, "waits_for_stride"),
    ],
)
def test_a_contract_that_cannot_be_run_is_refused(changes: dict[str, Any], name: str) -> None:
    text = json.dumps(json.loads(to_json(contract())) | changes)
    with pytest.raises(ArtefactError, match=f"^policy.onnx: .*{name}"):
        from_json(text, source="policy.onnx")


@pytest.mark.parametrize("name", ["stiffness", "damping"])
def test_numbers_that_are_not_finite_are_refused(name: str) -> None:
    with pytest.raises(ArtefactError, match=name):
        contract(**{name: (math.nan,) * 12})


@pytest.mark.parametrize("text", ["", "{", "[]", "{}"])
def test_text_that_is_no_contract_is_refused(text: str) -> None:
    with pytest.raises(ArtefactError, match=r"^policy.onnx: .*pronk/policy/1"):
        from_json(text, source="policy.onnx")


def test_a_contract_that_fits_the_robot_is_accepted() -> None:
    check(contract(), ROBOT, gains_sha256="0f" * 32)
    naive = {"stiffness": (17.0,) * 12, "damping": (0.4,) * 12}
    check(contract(gains="naive", gains_sha256="", **naive), ROBOT)
    # Gains that were matched joint by joint are alike in no group.
    check(contract(stiffness=tuple(18.0 + 0.1 * index for index in range(12))), ROBOT)


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"robot": "so101"}, "robot"),
        ({"joint_names": ROBOT.joint_names[::-1]}, "joint_names"),
        ({"policy_rate_hz": 100.0, "decimation": 2}, "policy_rate_hz"),
        ({"timestep_s": 0.002, "decimation": 10}, "timestep_s"),
        ({"default_position": (0.0, 0.0, 3.0) * 4}, "default_position of FR_knee"),
        (
            {
                "gains": "naive",
                "stiffness": (17.0,) * 11 + (21.0,),
                "damping": (0.4,) * 12,
            },
            "stiffness of HL_knee",
        ),
        ({"gains": "naive", "stiffness": (17.0,) * 12}, "damping of FR_hip_roll"),
        ({"gains_sha256": "1e" * 32}, "gains_sha256"),
    ],
)
def test_a_contract_for_another_robot_or_gains_is_refused(
    changes: dict[str, Any], field: str
) -> None:
    with pytest.raises(ArtefactError, match=f"contract's {field} is"):
        check(contract(**changes), ROBOT, gains_sha256="0f" * 32)


# --- The measured vector ------------------------------------------------------------------------


def test_layout_by_hand() -> None:
    three = (-0.04, -0.02, 0.0)
    two = (-0.04, -0.02)
    assert [(part.name, part.size, part.times_s) for part in measured_layout(50.0)] == [
        ("angular_velocity", 3, (0.0,)),
        ("projected_gravity", 3, (0.0,)),
        ("joint_position", 36, three),
        ("joint_velocity", 36, three),
        ("action", 24, two),
        ("command", 3, (0.0,)),
    ]


def test_history_by_hand() -> None:
    history = History(DEFAULT)
    command = (1.0, -0.5, 0.25)
    # The first sample fills the history; no action came before it.
    samples = [(1, 1, 1), (1, 1, 2), (1, 2, 3), (2, 3, 4)]
    actions = [(0, 0), (0, 100), (100, 101), (101, 102)]
    for _ in range(2):  # the second time after a reset
        for k, (positions, before) in enumerate(zip(samples, actions, strict=True)):
            velocity = np.full(12, -10.0 * (k + 1))
            now = measurement(position=DEFAULT + k + 1.0, velocity=velocity)
            vector = history.observe(now, command)
            history.acted(np.full(12, 100.0 + k, np.float32))
            expected = [
                *np.zeros(3),
                *(0, 0, -1),
                *np.repeat(positions, 12),
                *-10.0 * np.repeat(positions, 12),
                *np.repeat(before, 12),
                *command,
            ]
            np.testing.assert_allclose(vector, expected, atol=1e-6)
            assert vector.dtype == np.float32
        history.reset()


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"position": np.zeros(11)}, r"position .*\(11,\); expected \(12,\)"),
        ({"velocity": [np.nan] * 12}, r"velocity is nan at \[0\]"),
        ({"angular_velocity": [0.0, np.inf, 0.0]}, r"angular_velocity is inf at \[1\]"),
    ],
)
def test_a_measurement_that_is_not_finite_is_refused(changes: dict[str, Any], match: str) -> None:
    with pytest.raises(ArtefactError, match=match):
        measurement(**changes)


@pytest.mark.parametrize("number_type", [np.float32, np.float64, np.int64])
def test_finite_numbers_of_any_size_and_type_are_read(number_type: type) -> None:
    largest = (
        2**62 if number_type is np.int64 else number_type(3.4e38)
    )  # its square overflows a float32
    value = np.array([largest, 1, -largest], number_type)
    np.testing.assert_array_equal(finite("it", value, (3,)), value.astype(np.float32))
    for bad in (math.nan, -math.inf, 1e39):
        with pytest.raises(ArtefactError, match=r"it is (nan|-?inf) at \[1\]"):
            finite("it", [0.0, bad, 1e300], (3,))


# --- Runtime ------------------------------------------------------------------------------------

WEIGHTS = 0.1 * np.random.default_rng(7).normal(size=(MEASURED_SIZE + 1, 19)).astype(np.float32)


def write_network(path: Path, metadata: dict[str, str], *, jump: bool, width: int = 105) -> Path:
    """A linear network: action, contact and velocity are columns of (measured, jump) WEIGHTS."""
    onnx = pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    helper = onnx.helper
    tensor = onnx.numpy_helper.from_array
    inputs = {"measured": width}
    if jump:
        inputs["jump"] = 1
    outputs = {"action": 12, "contact": 4, "linear_velocity": 3}

    def described(sizes: dict[str, int]) -> list[Any]:
        values = []
        for name, size in sizes.items():
            shape = ["batch", size]
            values.append(helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, shape))
        return values

    weights = np.concatenate([WEIGHTS[:width], WEIGHTS[MEASURED_SIZE:]])[: width + jump]
    nodes = [
        helper.make_node("Concat", list(inputs), ["x"], axis=1),
        helper.make_node("MatMul", ["x", "weights"], ["y"]),
        helper.make_node("Split", ["y", "sizes"], list(outputs), axis=1),
    ]
    constants = [tensor(weights, "weights"), tensor(np.array([12, 4, 3]), "sizes")]
    graph = helper.make_graph(nodes, "linear", described(inputs), described(outputs), constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    helper.set_model_props(model, metadata)
    path.write_bytes(model.SerializeToString())
    return path


def write_policy(folder: Path, **changes: Any) -> Path:
    trained = contract(**changes)
    metadata = {METADATA_KEY: to_json(trained)}
    return write_network(folder / "policy.onnx", metadata, jump=trained.jump)


@pytest.fixture
def jumper(tmp_path: Path) -> Policy:
    return load_policy(write_policy(tmp_path))


def test_the_contract_can_be_read_without_pronk(tmp_path: Path) -> None:
    path = write_policy(tmp_path)
    onnxruntime = pytest.importorskip("onnxruntime")
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    body = json.loads(session.get_modelmeta().custom_metadata_map["pronk.contract"])
    assert (body["schema"], body["joint_names"][2]) == ("pronk/policy/1", "FR_knee")
    policy = load_policy(path)
    assert policy.contract == contract()
    assert policy.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()


def test_targets_are_default_plus_scaled_action_of_the_history(jumper: Policy) -> None:
    random = np.random.default_rng(1)
    history = History(DEFAULT)
    for k in range(6):
        if k == 4:
            jumper.reset()
            history.reset()
            assert jumper.inference is None
        now = measurement(position=random.normal(size=12), velocity=random.normal(size=12))
        command = random.normal(size=3)
        target = jumper.step(now, command, jump=k % 2 == 1)
        output = np.append(history.observe(now, command), np.float32(k % 2)) @ WEIGHTS
        history.acted(output[:12])
        np.testing.assert_allclose(target, DEFAULT + SCALE * output[:12], atol=1e-5)
        assert jumper.inference is not None
        np.testing.assert_allclose(jumper.inference.contact, output[None, 12:16], atol=1e-5)
        np.testing.assert_allclose(jumper.inference.linear_velocity, output[None, 16:], atol=1e-5)


def test_a_refused_step_changes_nothing(tmp_path: Path) -> None:
    walker = load_policy(write_policy(tmp_path, **WALK))
    first = walker.step(measurement(), np.ones(3))
    walker.reset()
    moved = measurement(position=DEFAULT + 1.0)
    with pytest.raises(ArtefactError, match=r"command is nan at \[2\]"):
        walker.step(moved, [0.0, 0.0, np.nan])
    with pytest.raises(ArtefactError, match="walk only"):
        walker.step(moved, np.ones(3), jump=True)
    with pytest.raises(ArtefactError, match="walk only"):
        walker.infer(np.zeros((2, 105)), np.array([[0.0], [1.0]]))
    np.testing.assert_array_equal(walker.step(measurement(), np.ones(3)), first)


def test_inputs_and_outputs_that_are_not_finite_are_refused(jumper: Policy) -> None:
    measured = np.zeros((3, 105), np.float32)
    measured[1, 7] = np.nan
    with pytest.raises(ArtefactError, match=r'"measured" is nan at \[1, 7\]'):
        jumper.infer(measured)
    with pytest.raises(ArtefactError, match='"jump" is inf'):
        jumper.infer(np.zeros((1, 105)), [[1e300]])
    with pytest.raises(ArtefactError, match=r"\(3, 104\); expected \(3, 105\)"):
        jumper.infer(np.zeros((3, 104)))
    with pytest.raises(ArtefactError, match='"action" is'):
        jumper.infer(np.full((1, 105), 3e38, np.float32))


def test_files_that_hold_no_policy_are_refused(tmp_path: Path) -> None:
    sound = write_policy(tmp_path).read_bytes()
    damaged = {"half": sound[: len(sound) // 2], "text": b"not a network", "empty": b""}
    damaged["metadata"] = sound.replace(b"mini_cheetah", b"mini_cheeta\xff")
    for name, content in damaged.items():
        (tmp_path / f"{name}.onnx").write_bytes(content)
    write_network(tmp_path / "foreign.onnx", {"author": "someone"}, jump=False)
    write_network(tmp_path / "odd.onnx", {METADATA_KEY: "{}"}, jump=True)
    walks = to_json(contract(**WALK))
    write_network(tmp_path / "jumps.onnx", {METADATA_KEY: walks}, jump=True)
    write_network(tmp_path / "narrow.onnx", {METADATA_KEY: walks}, jump=False, width=45)
    mixed = msgspec.structs.replace(contract(), observation=measured_layout(50.0)[::-1])
    write_network(tmp_path / "mixed.onnx", {METADATA_KEY: to_json(mixed)}, jump=True)
    names = [path.name for path in tmp_path.iterdir() if path.name != "policy.onnx"]
    assert len(names) == 9
    for name in (*names, "none.onnx", ""):
        with pytest.raises(ArtefactError) as refusal:
            load_policy(tmp_path / name)
        assert str(refusal.value).startswith(f"{tmp_path / name}: ")
        assert "\n" not in str(refusal.value)


def test_without_onnx_runtime_its_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_policy(tmp_path)
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(PronkError, match=r"pip install 'pronk\[policy\]'"):
        load_policy(path)


@pytest.mark.parametrize("place", ["initializer", "Constant"])
@pytest.mark.parametrize("location", ["beside.bin", "../beside.bin", "/dev/zero"])
def test_a_network_that_reads_another_file_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str, location: str
) -> None:
    onnx = pytest.importorskip("onnx")
    path = write_hopper(tmp_path / "policy.onnx")
    load_policy(path)
    folder = tmp_path / "folder"
    folder.mkdir()
    monkeypatch.chdir(folder)
    for file in (tmp_path / "beside.bin", folder / "beside.bin"):
        file.write_bytes(np.full(12, 7.0, np.float32).tobytes())
    weights = onnx.numpy_helper.from_array(np.zeros(12, np.float32), "offset")
    onnx.external_data_helper.set_external_data(weights, location, offset=0, length=48)
    weights.ClearField("raw_data")
    model = onnx.load(path)
    if place == "initializer":
        model.graph.initializer.append(weights)
    else:
        model.graph.node.append(onnx.helper.make_node("Constant", [], ["offset"], value=weights))
    model.graph.node.append(onnx.helper.make_node("Add", ["acted", "offset"], ["action"]))
    for node in model.graph.node[:-1]:
        for index, name in enumerate(node.output):
            if name == "action":
                node.output[index] = "acted"
    path.write_bytes(model.SerializeToString())
    with pytest.raises(ArtefactError) as refusal:
        load_policy(path)
    assert str(path) in str(refusal.value)


def test_a_file_larger_than_a_policy_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "policy.onnx"
    with path.open("wb") as file:
        file.truncate(2**26)
    with pytest.raises(ArtefactError, match="64 MiB"):
        load_policy(path)


def test_a_network_without_end_is_stopped(tmp_path: Path) -> None:
    onnx = pytest.importorskip("onnx")
    path = write_hopper(tmp_path / "policy.onnx")
    load_policy(path)
    helper = onnx.helper
    boolean = helper.make_tensor_value_info("go_on", onnx.TensorProto.BOOL, [])
    condition = helper.make_tensor_value_info("condition", onnx.TensorProto.BOOL, [])
    count = helper.make_tensor_value_info("count", onnx.TensorProto.INT64, [])
    again = helper.make_node("Identity", ["condition"], ["go_on"])
    body = helper.make_graph([again], "body", [count, condition], [boolean])
    model = onnx.load(path)
    yes = onnx.numpy_helper.from_array(np.array(True), "yes")
    model.graph.initializer.append(yes)
    model.graph.node.append(helper.make_node("Loop", ["", "yes"], [], body=body))
    path.write_bytes(model.SerializeToString())
    with pytest.raises(ArtefactError):
        load_policy(path)


@pytest.mark.parametrize("begin", ["acted", "straight"])
def test_a_network_that_doubles_a_tensor_is_refused_before_the_memory_is_taken(
    tmp_path: Path, begin: str
) -> None:
    onnx = pytest.importorskip("onnx")
    path = write_hopper(tmp_path / "policy.onnx")
    load_policy(path)
    model = onnx.load(path)
    graph = model.graph
    node = onnx.helper.make_node
    graph.node[-1].output[0] = "acted"
    names = [begin]
    for index in range(26):
        names.append(f"x{index}")
    for before, after in pairwise(names):
        graph.node.append(node("Concat", [before, before], [after], axis=1))
    for name, value in {"zero": 0, "twelve": 12, "axis": 1}.items():
        graph.initializer.append(onnx.numpy_helper.from_array(np.array([value]), name))
    graph.node.append(node("Slice", [names[-1], "zero", "twelve", "axis"], ["part"]))
    graph.node.append(node("Add", ["acted", "part"], ["action"]))
    onnx.save(model, path)
    peak_before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ArtefactError):
        load_policy(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak_before < 300 << 10


def widened(path: Path, width: int) -> Path:
    """The same policy with a hidden layer of zeros, of `width` numbers an observation."""
    onnx = pytest.importorskip("onnx")
    model = onnx.load(path)
    graph = model.graph
    node = onnx.helper.make_node
    graph.node[-1].output[0] = "acted"
    zeros = np.zeros((1, width), np.float32)
    graph.initializer.append(onnx.numpy_helper.from_array(zeros, "zeros"))
    graph.initializer.append(onnx.numpy_helper.from_array(np.array([1]), "axis"))
    graph.node.append(node("ReduceMax", ["acted", "axis"], ["most"], keepdims=1))
    graph.node.append(node("Mul", ["most", "zeros"], ["hidden"]))
    graph.node.append(node("ReduceSum", ["hidden", "axis"], ["nothing"], keepdims=1))
    graph.node.append(node("Add", ["acted", "nothing"], ["action"]))
    onnx.save(model, path)
    return path


@pytest.mark.parametrize("count", [0, 1, 63, 64, 65, 20_000])
def test_any_number_of_observations_is_inferred(tmp_path: Path, count: int) -> None:
    """Each has the outputs that it has alone; their hidden layers are not all there at once."""
    policy = load_policy(widened(write_policy(tmp_path), 10_000))
    rng = np.random.default_rng(count)
    measured = rng.normal(size=(count, MEASURED_SIZE)).astype(np.float32)
    jump = rng.integers(2, size=(count, 1)).astype(np.float32)
    inference = policy.infer(measured, jump)
    assert inference.action.shape == (count, 12)
    assert inference.contact.shape == (count, 4)
    assert inference.linear_velocity.shape == (count, 3)
    expected = np.hstack([measured, jump]) @ WEIGHTS
    outputs = [inference.action, inference.contact, inference.linear_velocity]
    assert np.hstack(outputs) == pytest.approx(expected, abs=1e-5)
    for index in rng.integers(count, size=min(count, 20)):
        alone = policy.infer(measured[index : index + 1], jump[index : index + 1])
        assert np.array_equal(alone.action[0], inference.action[index])
        assert np.array_equal(alone.contact[0], inference.contact[index])


def test_a_network_for_one_observation_at_a_time_says_so(tmp_path: Path) -> None:
    """Its batch axis has a name, but inside it there is one of fixed size."""
    onnx = pytest.importorskip("onnx")
    path = write_policy(tmp_path)
    model = onnx.load(path)
    graph = model.graph
    graph.node[-1].output[0] = "acted"
    graph.initializer.append(onnx.numpy_helper.from_array(np.array([1, 12]), "shape"))
    graph.node.append(onnx.helper.make_node("Reshape", ["acted", "shape"], ["row"]))
    graph.node.append(onnx.helper.make_node("Add", ["acted", "row"], ["action"]))
    onnx.save(model, path)
    policy = load_policy(path)
    policy.infer(np.zeros((1, MEASURED_SIZE)))
    with pytest.raises(ArtefactError, match="5"):
        policy.infer(np.zeros((5, MEASURED_SIZE)))
