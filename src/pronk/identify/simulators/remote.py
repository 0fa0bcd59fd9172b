"""A simulator in another Python, over a pipe.

Engines pin versions of MuJoCo that exclude each other, and some bring a Python of their own.
`RemoteSimulator` starts that Python (3.11 or later, with NumPy and the engine), which loads pronk
from this installation by its path, makes the simulator, and answers until its standard input is
closed: it ends with its parent, also in the middle of a run.

A message is the length of a header (4 bytes, little-endian), the header as JSON, and the arrays
that its field `arrays` lists as [name, shape]: float64, little-endian, in C order.

    to the child                                           from the child
    choice, entry, robot, links                            info, joints, parameters
    locked; arrays command and one a parameter             array position

Instead of an answer a field `error` may come: one sentence. Command, values and positions are as in
`Simulator.rollout`. The robot is sent without its MuJoCo model, its chains as `Links`; what an
engine prints goes to standard error, which is kept, and its last line reported if the child ends.
"""

from __future__ import annotations

import json
import math
import os
import queue
import struct
import subprocess
import sys
import tempfile
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, is_dataclass, replace
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import IO, Any, TypeVar, get_type_hints

import numpy as np

from pronk.arrays import Array
from pronk.errors import PronkError, RobotError
from pronk.identify.simulators.factory import ENTRY_POINTS, simulator_factory
from pronk.identify.simulators.info import SimulatorInfo
from pronk.identify.simulators.links import Links, SentRobot, links_of
from pronk.identify.simulators.simulator import Closing, Simulator
from pronk.plugins import load_entry_point
from pronk.robots.drive_law import DriveLaw
from pronk.robots.limits import OperatingLimits
from pronk.robots.robot import Joint, RobotSpec

_Kind = TypeVar("_Kind")
Message = tuple[dict[str, Any], dict[str, Array]]
"""Header of a message, and its arrays by name."""

_START = """
import importlib.util, sys
if sys.version_info < (3, 11):
    sys.exit("it is Python %d.%d" % sys.version_info[:2])
spec = importlib.util.spec_from_file_location(
    "pronk", sys.argv[1] + "/__init__.py", submodule_search_locations=[sys.argv[1]]
)
sys.modules["pronk"] = module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
from pronk.identify.simulators.remote import serve_simulator
serve_simulator()
"""
"""What the child runs. Its own packages are used, so only pronk comes from here."""
_CLOSING_S = 5.0
"""Time that a child has to end after its standard input was closed [s]."""


def send(stream: IO[bytes], header: Mapping[str, Any], arrays: Mapping[str, Array]) -> None:
    """Write one message."""
    listed = [[name, np.shape(array)] for name, array in arrays.items()]
    text = json.dumps({**header, "arrays": listed}).encode()
    stream.write(struct.pack("<I", len(text)) + text)
    for array in arrays.values():
        stream.write(np.asarray(array, dtype="<f8").tobytes())
    stream.flush()


def receive(stream: IO[bytes]) -> Message:
    """Read one message.

    Raises:
        EOFError: The stream ends before the message or in it.
    """
    size = struct.unpack("<I", _read_exactly(stream, 4))[0]
    header = json.loads(_read_exactly(stream, size))
    arrays = {}
    for name, shape in header.pop("arrays"):
        data = _read_exactly(stream, 8 * math.prod(shape))
        arrays[name] = np.frombuffer(data, dtype="<f8").reshape(shape).astype(np.float64)
    return header, arrays


def _read_exactly(stream: IO[bytes], count: int) -> bytes:
    """Read so many bytes; EOFError if there are fewer."""
    data = stream.read(count)
    if len(data) < count:
        raise EOFError
    return data


class RemoteSimulator(Closing):
    """A `Simulator` that runs in another Python."""

    def __init__(self, choice: str, robot: RobotSpec, python: Path) -> None:
        """Start another Python and make the simulator there.

        Args:
            choice: `FILE.py:NAME` or an entry point in `pronk.simulators`, of this installation or
                of the other one.
            robot: The robot.
            python: Path of the Python interpreter.

        Raises:
            PronkError: The interpreter cannot be started, or the simulator cannot be made.
        """
        self._choice = choice
        self._python = python
        self._messages = tempfile.TemporaryFile()  # noqa: SIM115
        try:
            self._child = subprocess.Popen(
                [str(python), "-c", _START, str(Path(__file__).parents[2])],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._messages,
            )
        except OSError as error:
            raise PronkError(
                f"--simulator-python {python} cannot be started ({error.strerror}); expected the "
                "path of a Python, as in /path/to/venv/bin/python."
            ) from None
        installed = entry_points(group=ENTRY_POINTS)
        entry = ""
        if choice in installed.names:
            entry = installed[choice].value
        try:
            answer, _ = self._ask({"choice": choice, "entry": entry, **_as_json(robot)}, {})
        except PronkError:
            self.close()
            raise
        self.info = SimulatorInfo(**answer["info"])
        self.joints = tuple(answer["joints"])
        self.parameters = frozenset(answer["parameters"])

    def rollout(
        self, command: Array, values: Mapping[str, Array], *, locked: Sequence[str] = ()
    ) -> Array:
        """See `Simulator.rollout`; PronkError says what went wrong in the other Python."""
        _, arrays = self._ask({"locked": list(locked)}, {"command": command, **values})
        return arrays["position"]

    def close(self) -> None:
        """End the other Python."""
        for stream in (self._child.stdin, self._child.stdout):
            with suppress(OSError):
                stream.close()  # type: ignore[union-attr]
        try:
            self._child.wait(_CLOSING_S)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()
        self._messages.close()

    def _ask(self, header: Mapping[str, Any], arrays: Mapping[str, Array]) -> Message:
        """Send a message and return the answer."""
        origin = f"simulator {self._choice} in {self._python}"
        try:
            send(self._child.stdin, header, arrays)  # type: ignore[arg-type]
            answer_header, answer_arrays = receive(self._child.stdout)  # type: ignore[arg-type]
        except (OSError, EOFError):
            status = self._child.wait()
            reason = f"status {status}"
            last_line = self._last_line()
            if last_line:
                reason = f"{reason}: {last_line}"
            raise PronkError(
                f"{origin} ended with {reason}; it needs Python 3.11 or later, NumPy and the "
                "engine."
            ) from None
        if "error" in answer_header:
            raise PronkError(f"{origin}: {answer_header['error']}")
        return answer_header, answer_arrays

    def _last_line(self) -> str:
        """Return the last line that the other Python has printed."""
        self._messages.seek(0)
        last_line = ""
        for line in self._messages.read().decode(errors="replace").split("\n"):
            if line.strip():
                last_line = line.strip()
        return last_line


def _as_json(robot: RobotSpec) -> dict[str, Any]:
    """Return a robot and its chains as JSON has them."""
    chains = {}
    for name in robot.joint_names:
        # What has no links is refused where it is used.
        with suppress(RobotError):
            links = links_of(robot, name)
            chains[name] = {
                "joints": links.joints,
                "parent": [int(parent) for parent in links.parent],
                "offset": links.offset.tolist(),
                "axis": links.axis.tolist(),
                "mass": links.mass.tolist(),
                "centre": links.centre.tolist(),
                "inertia": links.inertia.tolist(),
                "gravity": links.gravity.tolist(),
            }
    robot_fields = asdict(replace(robot, build_spec=_no_model))
    del robot_fields["build_spec"]
    return {"robot": robot_fields, "links": chains}


def _from_json(robot: Mapping[str, Any], chains: Mapping[str, Any]) -> SentRobot:
    """Make a robot of what `_as_json` returns."""
    joints = [_built(Joint, joint_fields) for joint_fields in robot["joints"]]
    links = {}
    for name, chain in chains.items():
        links[name] = Links(
            joints=tuple(chain["joints"]),
            parent=tuple(chain["parent"]),
            offset=np.array(chain["offset"]),
            axis=np.array(chain["axis"]),
            mass=np.array(chain["mass"]),
            centre=np.array(chain["centre"]),
            inertia=np.array(chain["inertia"]),
            gravity=np.array(chain["gravity"]),
        )
    robot_fields = {
        **robot,
        "joints": joints,
        "law": _built(DriveLaw, robot["law"]),
        "limits": _built(OperatingLimits, robot["limits"]),
    }
    return SentRobot(**_with_tuples(robot_fields), build_spec=_no_model, links=links)


def _built(kind: type[_Kind], fields: Mapping[str, Any]) -> _Kind:
    """Make a dataclass, and those inside of it, of the fields that `asdict` returns.

    Args:
        kind: The dataclass.
        fields: Its fields, as JSON has them.
    """
    types = get_type_hints(kind)
    built = _with_tuples(fields)
    for name, value in fields.items():
        if isinstance(value, Mapping) and is_dataclass(types[name]):
            built[name] = _built(types[name], value)
    return kind(**built)


def _with_tuples(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return fields with tuples in place of the lists that JSON makes of them."""
    converted = {}
    for name, value in fields.items():
        converted[name] = tuple(value) if isinstance(value, list) else value
    return converted


def _no_model() -> Any:
    """Refuse to build the model of a robot that was sent without it."""
    raise RobotError(
        "a robot's MuJoCo model is not sent to another Python; use its chains "
        "(pronk.identify.simulators.links.links_of)."
    )


def serve_simulator() -> None:
    """Be the child: make the simulator of the first message, then answer the others."""
    answers = os.fdopen(os.dup(1), "wb")
    # What engines print must not reach the pipe.
    os.dup2(2, 1)
    messages: queue.SimpleQueue[Message] = queue.SimpleQueue()
    threading.Thread(target=_read_messages, args=(messages,), daemon=True).start()
    simulator: Simulator | None = None
    while True:
        header, arrays = messages.get()
        answer: dict[str, Any] = {}
        answer_arrays: dict[str, Array] = {}
        try:
            if simulator is None:
                simulator = _made_simulator(header)
                answer = {
                    "info": asdict(simulator.info),
                    "joints": list(simulator.joints),
                    "parameters": sorted(simulator.parameters),
                }
            else:
                command = arrays.pop("command")
                position = simulator.rollout(command, arrays, locked=header["locked"])
                answer_arrays = {"position": position}
        except PronkError as error:
            answer = {"error": str(error)}
        except Exception as error:  # Code of others may fail in any way.
            answer = {"error": f"{type(error).__name__}: {error}."}
        send(answers, answer, answer_arrays)


def _read_messages(messages: queue.SimpleQueue[Message]) -> None:
    """Put all messages of the parent into a queue; end the process where they end."""
    try:
        while True:
            messages.put(receive(sys.stdin.buffer))
    finally:
        os._exit(0)


def _made_simulator(header: Mapping[str, Any]) -> Simulator:
    """Make the simulator of the first message."""
    choice = header["choice"]
    if header["entry"]:
        make = load_entry_point(EntryPoint(choice, header["entry"], ENTRY_POINTS))
    else:
        make = simulator_factory(choice)
    simulator: Simulator = make(_from_json(header["robot"], header["links"]))
    return simulator
