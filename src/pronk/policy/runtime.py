"""Run `policy.onnx` in ONNX Runtime on one thread: in trials and on a machine alike."""

from __future__ import annotations

import functools
import hashlib
import math
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pronk.errors import ArtefactError, PronkError
from pronk.policy.contract import METADATA_KEY, Contract, from_json, measured_layout
from pronk.policy.observation import (
    ESTIMATE,
    JOINTS,
    MEASURED_SIZE,
    Floats,
    History,
    Measurement,
    finite,
)

WRITER = "`pronk train` writes one"
_OPERATORS = frozenset(
    (
        *("Add", "Cast", "Clip", "Concat", "Constant", "Div", "Elu", "Gather", "Gemm", "Identity"),
        *("LeakyRelu", "MatMul", "Mul", "Relu", "Reshape", "Selu", "Shape", "Sigmoid", "Slice"),
        *("Softplus", "Split", "Sqrt", "Squeeze", "Sub", "Tanh", "Transpose", "Unsqueeze"),
    )
)
"""What feed-forward networks need: no loops, no branches, no tensors made of a number."""
_MOST_BYTES, _MOST_NODES, _MOST_MEMORY, _MOST_S = 2**25, 2000, 2**27, 10.0
"""Largest file [bytes], most nodes, most memory for tensors of this process's networks [bytes], and
longest first inference [s]; pronk's own take 3 MB, 57 nodes, 4 MB and 1 ms."""
_OUTPUTS = {"action": JOINTS, **ESTIMATE}
"""Names and sizes."""


@dataclass(frozen=True, kw_only=True)
class Inference:
    """Outputs of the network for N observations."""

    action: Floats
    """(N, 12)"""
    contact: Floats
    """Probability that each foot (FR, FL, HR, HL) touches the ground. (N, 4)"""
    linear_velocity: Floats
    """Estimate for the trunk, in its frame [m/s]. (N, 3)"""


class Policy:
    """A network, its contract, and the history of the one robot that `step` runs."""

    def __init__(self, session: Any, contract: Contract, *, sha256: str = "") -> None:
        """Wrap an ONNX Runtime session that `load_policy` has checked."""
        self.contract = contract
        self.sha256 = sha256
        self.inference: Inference | None = None
        """Outputs of the last `step`; None before the first."""
        self.network_s = math.nan
        """Time that ONNX Runtime took last [s]; NaN before the first."""
        self._session = session
        self._jumps = contract.jump
        self._default = np.asarray(contract.default_position)
        self._scale = np.asarray(contract.action_scale)
        self._history = History(contract.default_position)

    def sibling(self) -> Self:
        """The same network with a history of its own."""
        return type(self)(self._session, self.contract, sha256=self.sha256)

    def reset(self) -> None:
        """Begin anew: the next measurement fills the history, past actions are zero."""
        self._history.reset()
        self.inference = None

    def step(
        self, measurement: Measurement, command: ArrayLike, jump: bool = False
    ) -> NDArray[np.float64]:
        """One policy step, at `contract.policy_rate_hz`: joint position targets [rad]. (12,).

        The command is forward and left [m/s], yaw rate [rad/s], in the trunk's frame (3,). Targets
        are absolute, in the order of the contract. ArtefactError for a number that is not finite,
        and for `jump` of a policy without jump input.
        """
        self._refuse_jump(jump)
        measured = self._history.observe(measurement, command)
        self.inference = self._run(measured[None], np.array([[jump]], dtype=np.float32))
        action = self.inference.action[0]
        self._history.acted(action)
        target: NDArray[np.float64] = self._default + self._scale * action
        return target

    def infer(self, measured: ArrayLike, jump: ArrayLike | None = None) -> Inference:
        """The network alone, for N observations.

        `measured` is laid out as `contract.observation`, (N, 105); `jump` is 0 or 1, (N, 1), None 0
        for all. ArtefactError for a wrong shape, a number that is not finite, and a refused jump.
        """
        count = len(np.atleast_1d(measured))
        read = finite('the input "measured"', measured, (count, MEASURED_SIZE))
        jumps = np.zeros((count, 1)) if jump is None else jump
        jumps = finite('the input "jump"', jumps, (count, 1))
        self._refuse_jump(bool(jumps.any()))
        return self._run(read, jumps)

    def _run(self, measured: Floats, jump: Floats) -> Inference:
        """The network, for inputs that have been checked."""
        feeds = {"measured": measured, "jump": jump} if self._jumps else {"measured": measured}
        begun = time.monotonic()
        found = self._session.run(list(_OUTPUTS), feeds)
        self.network_s = time.monotonic() - begun
        return Inference(
            **{
                name: finite(f'the policy\'s output "{name}"', value, (len(measured), size))
                for (name, size), value in zip(_OUTPUTS.items(), found, strict=True)
            }
        )

    def _refuse_jump(self, jump: bool) -> None:
        if jump and not self._jumps:
            raise ArtefactError(
                "this policy was trained to walk only and has no jump input; "
                "`pronk train jump` adds one."
            )


def load_policy(path: Path | str) -> Policy:
    """Open a `policy.onnx`; `pronk.policy.contract.check` checks that it fits a robot.

    ArtefactError for a file that is missing, damaged, without a contract, or laid out in another
    way than this pronk builds observations; PronkError without ONNX Runtime.
    """
    path = Path(path)
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise ArtefactError(f"{path}: no such file; {WRITER}.") from None
    except OSError as error:
        raise ArtefactError(f"{path}: cannot be read ({error.strerror}).") from None
    _check_operators(data, path)
    session = _session(data, path)
    try:
        text = session.get_modelmeta().custom_metadata_map.get(METADATA_KEY)
    except UnicodeDecodeError:
        text = None
    if text is None:
        raise ArtefactError(f"{path}: a network without a contract of pronk; {WRITER}.")
    contract = from_json(text, source=path)
    if contract.observation != measured_layout(contract.policy_rate_hz):
        raise ArtefactError(
            f"{path}: the contract's observation is laid out in another way than this pronk "
            "builds it; use the pronk it was trained with, or train again."
        )
    inputs = {"measured": MEASURED_SIZE} | ({"jump": 1} if contract.jump else {})
    try:
        _check_graph(path, "inputs", session.get_inputs(), inputs)
        _check_graph(path, "outputs", session.get_outputs(), _OUTPUTS)
    except UnicodeDecodeError:
        raise ArtefactError(f"{path}: damaged: a name in its network is not text.") from None
    _first(session, inputs, path)
    return Policy(session, contract, sha256=hashlib.sha256(data).hexdigest())


def _session(data: bytes, path: Path) -> Any:
    try:
        import onnxruntime
    except ImportError:
        raise PronkError(
            "policies run in ONNX Runtime, which is not installed; "
            "install it with `pip install 'pronk[policy]'`."
        ) from None
    options = onnxruntime.SessionOptions()
    # A network this small is slower on several threads.
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.log_severity_level = 4  # errors come as exceptions
    options.add_session_config_entry("session.load_model_format", "ONNX")
    options.add_session_config_entry("session.use_env_allocators", "1")
    _limit_memory()
    try:
        return onnxruntime.InferenceSession(
            data,
            options,
            providers=["CPUExecutionProvider"],
            # It would build constants outside of the limit of memory.
            disabled_optimizers=["ConstantFolding"],
        )
    except Exception as error:
        raise ArtefactError(
            f"{path}: not a network that ONNX Runtime can run ({type(error).__name__}); {WRITER}."
        ) from error


@functools.cache
def _limit_memory() -> None:
    """Limit the memory that tensors of all networks of this process take."""
    import onnxruntime as ort

    kinds = ort.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, ort.OrtMemType.DEFAULT
    limit = ort.OrtArenaCfg({"max_mem": _MOST_MEMORY})
    ort.create_and_register_allocator(ort.OrtMemoryInfo("Cpu", *kinds), limit)


def _fields(data: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Number and content of each field of a protobuf message that has a length."""
    at = 0

    def number() -> int:
        nonlocal at
        value = 0
        for shift in range(0, 70, 7):
            value, at = value | (data[at] & 127) << shift, at + 1
            if data[at - 1] < 128:
                return value
        raise ValueError

    while at < len(data):
        key = number()
        size = {0: 0, 1: 8, 2: 0, 5: 4}[key & 7]
        if key & 7 == 2:
            size = number()
            yield key >> 3, data[at : at + size]
        elif key & 7 == 0:
            number()
        at += size


def _check_operators(data: bytes, path: Path) -> None:
    """Refuse a large file, and operators beside `_OPERATORS`, before ONNX Runtime sees them."""
    found, count = set[str](), 0
    try:
        if len(data) > _MOST_BYTES:
            raise ValueError
        # ModelProto.graph is 7 and .functions 25, GraphProto.node 1 and .initializer 5 (whose
        # .external_data is 13), NodeProto.op_type 4, .attribute 5 (whose .g 6 and .graphs 11 are
        # graphs) and .domain 7 (onnx.proto).
        for field, content in _fields(memoryview(data)):
            if field == 25:
                found.add("a function")
            for kind, node in _fields(content) if field == 7 else ():
                if kind == 5 and any(k == 13 for k, _ in _fields(node)):
                    found.add("weights of another file")
                if (count := count + (kind == 1)) > _MOST_NODES:
                    raise ValueError
                for part, value in _fields(node) if kind == 1 else ():
                    if part == 4 or (part == 7 and bytes(value) != b"ai.onnx" and value):
                        found.add(bytes(value).decode())
                    if part == 5 and any(k in (6, 11) for k, _ in _fields(value)):
                        found.add("a subgraph")
    except (ValueError, IndexError, KeyError):
        raise ArtefactError(
            f"{path}: not an ONNX network of at most {_MOST_BYTES >> 20} MiB and {_MOST_NODES} "
            f"nodes; {WRITER}."
        ) from None
    if unknown := sorted(found - _OPERATORS):
        raise ArtefactError(
            f"{path}: its network uses {', '.join(unknown)[:200]}; a policy may use "
            f"{', '.join(sorted(_OPERATORS))}; export it again with this pronk."
        )


def _first(session: Any, sizes: dict[str, int], path: Path) -> None:
    """Run the network once, under a time limit."""
    import onnxruntime

    options = onnxruntime.RunOptions()
    timer = threading.Timer(_MOST_S, setattr, (options, "terminate", True))
    timer.daemon = True
    timer.start()
    try:
        feeds = {name: np.zeros((1, size), np.float32) for name, size in sizes.items()}
        session.run(list(_OUTPUTS), feeds, options)
    except Exception as error:
        raise ArtefactError(
            f"{path}: its network cannot be run within {_MOST_S:g} s ({type(error).__name__})."
        ) from error
    finally:
        timer.cancel()


def _check_graph(path: Path, what: str, nodes: Any, sizes: dict[str, int]) -> None:
    found = {node.name: tuple(node.shape) for node in nodes}
    # The batch axis has a name in place of a size.
    fits = {name: shape[1:] for name, shape in found.items()} == {n: (s,) for n, s in sizes.items()}
    free = all(not isinstance(shape[0], int) for shape in found.values() if shape)
    floats = all(node.type == "tensor(float)" for node in nodes)
    if not (fits and free and floats):
        expected = ", ".join(f"{name} (batch, {size})" for name, size in sizes.items())
        raise ArtefactError(
            f"{path}: the network's {what} are {found}; its contract needs {expected}, float32."
        )
