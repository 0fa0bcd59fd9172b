"""Run `policy.onnx` in ONNX Runtime on one thread: in trials and on a machine alike."""

from __future__ import annotations

import functools
import hashlib
import math
import os
import threading
import time
from collections.abc import Mapping, Sequence
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

_WRITER = "`pronk train` writes one"
_MAX_FILE_BYTES = 2**25
"""Largest file; pronk's own take 3 MB."""
_MAX_MEMORY_BYTES = 2**27
"""Most memory that tensors of this process's networks take; pronk's own take 4 MB."""
_MAX_BATCH = 64
"""Most observations for which a network runs at once. A hidden layer has a row for each, and all
layers share `_MAX_MEMORY_BYTES`: pronk's own take 13 kB an observation, and are not faster with
more of them."""
_MAX_FIRST_INFERENCE_S = 10.0
"""Longest first inference; pronk's own take 1 ms."""
_NO_FOLDER = os.devnull
"""Folder of weights in other files: a path below which there can be none. The SHA-256 of a policy
then stands for all of its numbers."""
_OUTPUT_SIZES = {"action": JOINTS, **ESTIMATE}


@dataclass(frozen=True, kw_only=True)
class Inference:
    """Outputs of the network for N observations."""

    action: Floats
    """Shape (N, 12)."""
    contact: Floats
    """Probability that each foot (FR, FL, HR, HL) touches the ground, shape (N, 4)."""
    linear_velocity: Floats
    """Estimated velocity of the trunk, in its frame [m/s], shape (N, 3)."""


class Policy:
    """A network, its contract, and the history of the one robot that `step` runs."""

    def __init__(self, session: Any, contract: Contract, *, sha256: str = "") -> None:
        """Wrap an ONNX Runtime session that `load_policy` has checked."""
        self.contract = contract
        self.sha256 = sha256
        self.inference: Inference | None = None
        """Outputs of the latest `step`; None before the first."""
        self.network_s = math.nan
        """Time that ONNX Runtime took for the latest inference [s]; NaN before the first."""
        self._session = session
        self._default_position = np.asarray(contract.default_position)
        self._action_scale = np.asarray(contract.action_scale)
        self._history = History(contract.default_position)

    def __repr__(self) -> str:
        """Return the robot, the gains and the rate of the policy."""
        contract = self.contract
        jump = "with" if contract.jump else "without"
        return (
            f"Policy({contract.robot}, {contract.gains} gains, {contract.policy_rate_hz:g} Hz, "
            f"{jump} jump input)"
        )

    @property
    def rate_hz(self) -> float:
        """Steps per second [Hz]."""
        return self.contract.policy_rate_hz

    @property
    def start_position(self) -> NDArray[np.float64]:
        """Joint positions in which it starts [rad], shape (12,)."""
        return np.array(self.contract.default_position)

    @property
    def command_ranges(self) -> Mapping[str, tuple[float, float]]:
        """Smallest and largest command trained for, by the names in `contract.COMMANDS`."""
        return self.contract.command_ranges

    @property
    def jumps(self) -> bool:
        """Whether the network has a jump input."""
        return self.contract.jump

    @property
    def delay_range_s(self) -> tuple[float, float]:
        """Command delays trained for [s]."""
        return self.contract.delay_range_s

    @property
    def logs_observation(self) -> bool:
        """True: the observation is laid out as `pronk.policy.observation` says."""
        return True

    def provenance(self) -> dict[str, Any]:
        """Return what a log says of the policy."""
        contract = self.contract
        return {
            "sha256": self.sha256,
            "gains": contract.gains,
            "gains_sha256": contract.gains_sha256,
            "delay_range_s": contract.delay_range_s,
            "jump": contract.jump,
            "virtual": contract.virtual,
        }

    def sibling(self) -> Self:
        """Return the same network with a history of its own."""
        return type(self)(self._session, self.contract, sha256=self.sha256)

    def reset(self) -> None:
        """Begin anew: the next measurement fills the history, past actions are zero."""
        self._history.reset()
        self.inference = None

    def step(
        self, measurement: Measurement, command: ArrayLike, jump: bool = False
    ) -> NDArray[np.float64]:
        """Do one policy step and return joint position targets [rad], shape (12,).

        Targets are absolute, in the order of the contract. One step follows the other at
        `contract.policy_rate_hz`.

        Args:
            measurement: The sensors now.
            command: Forward and left [m/s], yaw rate [rad/s], in the trunk's frame, shape (3,).
            jump: The jump input.

        Raises:
            ArtefactError: A number is not finite, or `jump` is given to a policy without jump
                input.
        """
        self._refuse_jump(jump)
        measured = self._history.observe(measurement, command)
        self.inference = self._run(measured[None], np.array([[jump]], dtype=np.float32))
        action = self.inference.action[0]
        self._history.acted(action)
        target: NDArray[np.float64] = self._default_position + self._action_scale * action
        return target

    def infer(self, measured: ArrayLike, jump: ArrayLike | None = None) -> Inference:
        """Run the network alone, for any number N of observations.

        The network runs for some of them at a time, so that its hidden layers fit in the memory
        that it may take; an observation has the same outputs in whatever company.

        Args:
            measured: Laid out as `contract.observation`, shape (N, 105).
            jump: 0 or 1, shape (N, 1); 0 for all if None.

        Raises:
            ArtefactError: A shape is wrong, a number is not finite, the policy has no jump input,
                or its network cannot be run for several observations at once.
        """
        count = len(np.atleast_1d(measured))
        checked = finite('the input "measured"', measured, (count, MEASURED_SIZE))
        jump_input = np.zeros((count, 1)) if jump is None else jump
        checked_jump = finite('the input "jump"', jump_input, (count, 1))
        self._refuse_jump(bool(checked_jump.any()))
        parts = []
        seconds = 0.0
        # At least one batch, also of no observations.
        for start in range(0, max(count, 1), _MAX_BATCH):
            batch = slice(start, start + _MAX_BATCH)
            parts.append(self._run(checked[batch], checked_jump[batch]))
            seconds += self.network_s
        self.network_s = seconds
        if len(parts) == 1:
            return parts[0]
        return Inference(
            action=np.concatenate([part.action for part in parts]),
            contact=np.concatenate([part.contact for part in parts]),
            linear_velocity=np.concatenate([part.linear_velocity for part in parts]),
        )

    def _run(self, measured: Floats, jump: Floats) -> Inference:
        """Run the network for inputs that have been checked."""
        inputs = {"measured": measured}
        if self.contract.jump:
            inputs["jump"] = jump
        begin = time.monotonic()
        try:
            values = self._session.run(list(_OUTPUT_SIZES), inputs)
        except Exception as error:  # Operators raise errors of any kind.
            reason = " ".join(str(error).split())[-200:]
            raise ArtefactError(
                f"the policy's network ran for one observation, but not for {len(measured)} "
                f"({reason}); expected one whose inputs and outputs have a row for each "
                f"observation and whose layers take at most {_MAX_MEMORY_BYTES >> 20} MiB in all; "
                "export it with a batch axis of any size."
            ) from error
        self.network_s = time.monotonic() - begin
        outputs = {}
        for (name, size), value in zip(_OUTPUT_SIZES.items(), values, strict=True):
            outputs[name] = finite(f'the policy\'s output "{name}"', value, (len(measured), size))
        return Inference(**outputs)

    def _refuse_jump(self, jump: bool) -> None:
        if jump and not self.contract.jump:
            raise ArtefactError(
                "this policy was trained to walk only and has no jump input; "
                "`pronk train jump` adds one."
            )


def load_policy(path: Path | str) -> Policy:
    """Open a `policy.onnx`.

    `pronk.policy.contract.check` checks that it fits a robot.

    Args:
        path: The file.

    Returns:
        The policy, whose network has run once.

    Raises:
        ArtefactError: The file is missing, damaged, without a contract, or laid out in another way
            than this pronk builds observations.
        PronkError: ONNX Runtime is not installed.

    Examples:
        >>> policy = pronk.load_policy("policies/matched/policy.onnx")
        >>> policy.contract.robot
        'mini_cheetah'
    """
    path = Path(path)
    content = read_network(path)
    session = open_session(content, path)
    try:
        text = session.get_modelmeta().custom_metadata_map.get(METADATA_KEY)
    except UnicodeDecodeError:
        text = None
    if text is None:
        raise ArtefactError(
            f"{path}: a network without a contract of pronk; {_WRITER}, and with Unitree's "
            "deploy.yaml `pronk deploy --deploy` and `pronk policy check` run others."
        )
    contract = from_json(text, source=path)
    if contract.observation != measured_layout(contract.policy_rate_hz):
        raise ArtefactError(
            f"{path}: the contract's observation is laid out in another way than this pronk "
            "builds it; use the pronk it was trained with, or train again."
        )
    input_sizes = {"measured": MEASURED_SIZE}
    if contract.jump:
        input_sizes["jump"] = 1
    try:
        _check_tensors(path, "inputs", session.get_inputs(), input_sizes)
        _check_tensors(path, "outputs", session.get_outputs(), _OUTPUT_SIZES)
    except UnicodeDecodeError:
        raise ArtefactError(f"{path}: damaged: a name in its network is not text.") from None
    run_once(session, input_sizes, list(_OUTPUT_SIZES), path)
    return Policy(session, contract, sha256=hashlib.sha256(content).hexdigest())


def read_network(path: Path, writer: str = _WRITER) -> bytes:
    """Return the bytes of a policy of limited size; errors end with what writes one."""
    try:
        size = path.stat().st_size
        if size > _MAX_FILE_BYTES:
            raise ArtefactError(
                f"{path}: {size >> 20} MiB; a policy takes {_MAX_FILE_BYTES >> 20} MiB or less; "
                f"{writer}."
            )
        return path.read_bytes()
    except FileNotFoundError:
        raise ArtefactError(f"{path}: no such file; {writer}.") from None
    except OSError as error:
        raise ArtefactError(f"{path}: cannot be read ({error.strerror}).") from None


def open_session(content: bytes, path: Path, writer: str = _WRITER) -> Any:
    """Return the ONNX Runtime session of a network on one thread; see `read_network`."""
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
    options.log_severity_level = 4  # Errors come as exceptions.
    options.add_session_config_entry("session.load_model_format", "ONNX")
    options.add_session_config_entry("session.use_env_allocators", "1")
    options.add_session_config_entry(
        "session.model_external_initializers_file_folder_path", _NO_FOLDER
    )
    _limit_memory()
    try:
        return onnxruntime.InferenceSession(
            content,
            options,
            providers=["CPUExecutionProvider"],
            # It would build constants outside of the limit of memory.
            disabled_optimizers=["ConstantFolding"],
        )
    except Exception as error:  # The parser and the optimizer raise errors of any kind.
        reason = " ".join(str(error).split())[:200]
        raise ArtefactError(
            f"{path}: not a network that ONNX Runtime can run from this one file ({reason}); "
            f"{writer}."
        ) from error


@functools.cache
def _limit_memory() -> None:
    """Limit the memory that tensors of all networks of this process take."""
    import onnxruntime

    memory = onnxruntime.OrtMemoryInfo(
        "Cpu",
        onnxruntime.OrtAllocatorType.ORT_ARENA_ALLOCATOR,
        0,
        onnxruntime.OrtMemType.DEFAULT,
    )
    limit = onnxruntime.OrtArenaCfg({"max_mem": _MAX_MEMORY_BYTES})
    onnxruntime.create_and_register_allocator(memory, limit)


def run_once(
    session: Any, input_sizes: Mapping[str, int], outputs: Sequence[str], path: Path
) -> None:
    """Run a network once on zeros, under a time limit.

    Args:
        session: Its ONNX Runtime session.
        input_sizes: Size of each input behind its batch axis, by name.
        outputs: Names of the outputs.
        path: The file, for the message.

    Raises:
        ArtefactError: It does not run.
    """
    import onnxruntime

    options = onnxruntime.RunOptions()

    def stop() -> None:
        options.terminate = True

    timer = threading.Timer(_MAX_FIRST_INFERENCE_S, stop)
    timer.daemon = True
    timer.start()
    inputs = {name: np.zeros((1, size), np.float32) for name, size in input_sizes.items()}
    try:
        session.run(list(outputs), inputs, options)
    except Exception as error:  # Operators raise errors of any kind.
        raise ArtefactError(
            f"{path}: its network cannot be run within {_MAX_FIRST_INFERENCE_S:g} s "
            f"({type(error).__name__})."
        ) from error
    finally:
        timer.cancel()


def _check_tensors(path: Path, what: str, tensors: Any, sizes: Mapping[str, int]) -> None:
    """Refuse inputs or outputs of other names, shapes or types.

    Args:
        path: The file, for the message.
        what: `inputs` or `outputs`, for the message.
        tensors: Descriptions by ONNX Runtime.
        sizes: Size of each tensor behind its batch axis, by name.
    """
    shapes = {tensor.name: tuple(tensor.shape) for tensor in tensors}
    fits = set(shapes) == set(sizes)
    for tensor in tensors:
        # The batch axis has a name in place of a size.
        any_batch = len(tensor.shape) == 2 and not isinstance(tensor.shape[0], int)
        sized = any_batch and tensor.shape[1] == sizes.get(tensor.name)
        fits = fits and sized and tensor.type == "tensor(float)"
    if not fits:
        expected = ", ".join(f"{name} (batch, {size})" for name, size in sizes.items())
        raise ArtefactError(
            f"{path}: the network's {what} are {shapes}; its contract needs {expected}, float32."
        )
