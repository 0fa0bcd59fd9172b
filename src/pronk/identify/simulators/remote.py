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
from dataclasses import asdict, replace
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import IO, Any

import numpy as np

from pronk.arrays import Array
from pronk.errors import PronkError, RobotError
from pronk.identify.simulators.engines.links import Links, SentRobot, links_of
from pronk.identify.simulators.simulator import (
    ENTRY_POINTS,
    Closing,
    Simulator,
    SimulatorInfo,
    factory,
)
from pronk.plugins import load_entry_point
from pronk.robots.drive_law import DriveLaw
from pronk.robots.robot import Drive, Joint, RobotSpec

Message = tuple[dict[str, Any], dict[str, Array]]
"""Header, and arrays by name."""

_START = """
import importlib.util, sys
if sys.version_info < (3, 11):
    sys.exit("it is Python %d.%d" % sys.version_info[:2])
spec = importlib.util.spec_from_file_location(
    "pronk", sys.argv[1] + "/__init__.py", submodule_search_locations=[sys.argv[1]]
)
sys.modules["pronk"] = module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
from pronk.identify.simulators.remote import serve
serve()
"""
"""What the child runs. Its own packages are used, so only pronk comes from here."""
_CLOSING_S = 5.0  # time that a child has to end after its standard input was closed [s]


def send(stream: IO[bytes], header: Mapping[str, Any], arrays: Mapping[str, Array]) -> None:
    """Write one message."""
    listed = [[name, np.shape(array)] for name, array in arrays.items()]
    text = json.dumps({**header, "arrays": listed}).encode()
    stream.write(struct.pack("<I", len(text)) + text)
    for array in arrays.values():
        stream.write(np.asarray(array, dtype="<f8").tobytes())
    stream.flush()


def receive(stream: IO[bytes]) -> Message:
    """Read one message; EOFError where the stream ends before or in it."""

    def exactly(count: int) -> bytes:
        data = stream.read(count)
        if len(data) < count:
            raise EOFError
        return data

    header = json.loads(exactly(struct.unpack("<I", exactly(4))[0]))
    arrays = {}
    for name, shape in header.pop("arrays"):
        data = exactly(8 * math.prod(shape))
        arrays[name] = np.frombuffer(data, dtype="<f8").reshape(shape).astype(np.float64)
    return header, arrays


class RemoteSimulator(Closing):
    """A `Simulator` that runs in another Python."""

    def __init__(self, choice: str, robot: RobotSpec, python: Path) -> None:
        """Start the program `python` and make the simulator there; PronkError if that fails.

        The choice is `FILE.py:NAME` or an entry point in `pronk.simulators`, of this installation
        or of the other one.
        """
        self._choice, self._python = choice, python
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
        known = entry_points(group=ENTRY_POINTS)
        entry = known[choice].value if choice in known.names else ""
        start = {"choice": choice, "entry": entry, **_as_json(robot)}
        try:
            made, _ = self._ask(start, {})
        except PronkError:
            self.close()
            raise
        self.info = SimulatorInfo(**made["info"])
        self.joints, self.parameters = tuple(made["joints"]), frozenset(made["parameters"])

    def rollout(
        self, command: Array, values: Mapping[str, Array], *, locked: Sequence[str] = ()
    ) -> Array:
        """See `Simulator.rollout`; PronkError says what went wrong in the other Python."""
        return self._ask({"locked": list(locked)}, {"command": command, **values})[1]["position"]

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
        where = f"simulator {self._choice} in {self._python}"
        try:
            send(self._child.stdin, header, arrays)  # type: ignore[arg-type]
            answer = receive(self._child.stdout)  # type: ignore[arg-type]
        except (OSError, EOFError):
            status = self._child.wait()
            self._messages.seek(0)
            lines = self._messages.read().decode(errors="replace").split("\n")
            last = next((line.strip() for line in reversed(lines) if line.strip()), "")
            raise PronkError(
                f"{where} ended with status {status}{last and f': {last}'}; it needs Python 3.11 "
                "or later, NumPy and the engine."
            ) from None
        if error := answer[0].get("error"):
            raise PronkError(f"{where}: {error}")
        return answer


def _as_json(robot: RobotSpec) -> dict[str, Any]:
    """A robot and its chains as JSON has them."""
    chains = {}
    for name in robot.joint_names:
        # What has no links is refused where it is used.
        with suppress(RobotError):
            links = vars(links_of(robot, name))
            chains[name] = {field: np.asarray(one).tolist() for field, one in links.items()}
    fields = asdict(replace(robot, build_spec=_no_model))
    del fields["build_spec"]
    return {"robot": fields, "links": chains}


def _from_json(robot: Mapping[str, Any], chains: Mapping[str, Any]) -> SentRobot:
    """The opposite of `_as_json`."""

    def tuples(fields: Mapping[str, Any]) -> dict[str, Any]:
        return {n: tuple(v) if isinstance(v, list) else v for n, v in fields.items()}

    def links(fields: Mapping[str, Any]) -> Links:
        arrays: dict[str, Any] = {n: np.array(v) for n, v in fields.items()}
        return Links(**arrays | {n: tuple(fields[n]) for n in ("joints", "parent")})

    joints = [Joint(**tuples({**one, "drive": Drive(**one["drive"])})) for one in robot["joints"]]
    made = {**robot, "joints": joints, "law": DriveLaw(**robot["law"])}
    known = {name: links(fields) for name, fields in chains.items()}
    return SentRobot(**tuples(made), build_spec=_no_model, links=known)


def _no_model() -> Any:
    raise RobotError(
        "a robot's MuJoCo model is not sent to another Python; use its chains "
        "(pronk.identify.simulators.engines.links.links_of)."
    )


def serve() -> None:
    """Be the child: make the simulator of the first message, then answer the others."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # What engines print must not reach the pipe.
    messages: queue.SimpleQueue[Message] = queue.SimpleQueue()

    def read() -> None:
        try:
            while True:
                messages.put(receive(sys.stdin.buffer))
        finally:
            os._exit(0)

    threading.Thread(target=read, daemon=True).start()
    simulator: Simulator | None = None
    while True:
        header, arrays = messages.get()
        try:
            if simulator is None:
                choice, entry = header["choice"], header["entry"]
                point = EntryPoint(choice, entry, ENTRY_POINTS)
                own = load_entry_point(point) if entry else factory(choice)
                simulator = own(_from_json(header["robot"], header["links"]))
                answer = {
                    "info": asdict(simulator.info),
                    "joints": list(simulator.joints),
                    "parameters": sorted(simulator.parameters),
                }
                arrays = {}
            else:
                command = arrays.pop("command")
                position = simulator.rollout(command, arrays, locked=header["locked"])
                answer, arrays = {}, {"position": position}
        except PronkError as error:
            answer, arrays = {"error": str(error)}, {}
        except Exception as error:  # Code of others may fail in any way.
            answer, arrays = {"error": f"{type(error).__name__}: {error}."}, {}
        send(answers, answer, arrays)
