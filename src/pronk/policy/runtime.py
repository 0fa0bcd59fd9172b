"""Run `policy.onnx` in ONNX Runtime on one thread: in trials and on a machine alike."""

from __future__ import annotations

import hashlib
import math
import time
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
        """Wrap an ONNX Runtime session that `load_policy` has checked; `sha256` is of the file."""
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
        """One policy step; call it at `contract.policy_rate_hz`.

        Args:
            measurement: The present one.
            command: Forward and left [m/s], yaw rate [rad/s], in the trunk's frame. (3,)
            jump: The jump input; refused by a policy without one.

        Returns:
            Joint position targets in the order of the contract, absolute [rad]. (12,)

        Raises:
            ArtefactError: A number is not finite, or jump is refused.
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

        Args:
            measured: Laid out as `contract.observation`. (N, 105)
            jump: The jump input, 0 or 1; None is 0 for all. (N, 1)

        Raises:
            ArtefactError: A shape is wrong, a number is not finite, or jump is refused.
        """
        count = len(np.atleast_1d(measured))
        read = finite('the input "measured"', measured, (count, MEASURED_SIZE))
        jumps = finite(
            'the input "jump"', np.zeros((count, 1)) if jump is None else jump, (count, 1)
        )
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

    Raises:
        ArtefactError: Missing, damaged, without a contract, or laid out in another way than this
            pronk builds observations.
        PronkError: ONNX Runtime is not installed.
    """
    path = Path(path)
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise ArtefactError(f"{path}: no such file; {WRITER}.") from None
    except OSError as error:
        raise ArtefactError(f"{path}: cannot be read ({error.strerror}).") from None
    session = _session(data, path)
    text = session.get_modelmeta().custom_metadata_map.get(METADATA_KEY)
    if text is None:
        raise ArtefactError(f"{path}: a network without a contract of pronk; {WRITER}.")
    contract = from_json(text, source=path)
    if contract.observation != measured_layout(contract.policy_rate_hz):
        raise ArtefactError(
            f"{path}: the contract's observation is laid out in another way than this pronk "
            "builds it; use the pronk it was trained with, or train again."
        )
    inputs = {"measured": MEASURED_SIZE} | ({"jump": 1} if contract.jump else {})
    _check_graph(path, "inputs", session.get_inputs(), inputs)
    _check_graph(path, "outputs", session.get_outputs(), _OUTPUTS)
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
    try:
        return onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise ArtefactError(
            f"{path}: not a network that ONNX Runtime can run ({type(error).__name__}); {WRITER}."
        ) from error


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
