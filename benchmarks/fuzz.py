"""Mutated inputs of every reader: no exception but PronkError, no hang, no other numbers."""

from __future__ import annotations

import collections
import math
import shutil
import signal
import tempfile
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import pronk.match.gains as gains_file
from pronk.cli import console
from pronk.errors import PronkError
from pronk.logs.joint_log import JointLog
from pronk.logs.mcap_log import LogHeader, McapLogWriter
from pronk.logs.readers import read_log
from pronk.response import response as response_file
from pronk.robots.load import read_robot
from pronk.simulators.simulator import SimulatorInfo
from pronk.virtual.sim_params import SHIPPED, load_sim_params

LIMIT_S = 5
"""Longest that a file may take [s]."""
_TOKENS = (b"-1", b"1e999", b"nan", b"[[[[", b"'", b"\x00", b"\xff", b"*a", b"null", b"../" * 5)


@dataclass
class _Input:
    path: Path
    read: Callable[[Path], Any]
    checked: bool
    """Whether the format has checksums, so that other numbers must not pass silently."""


def _inputs(folder: Path) -> list[_Input]:
    """One sound file of each kind."""
    t = np.arange(600) / 500.0
    wave = np.sin(6.0 * t)[:, None] * [0.3, 0.2]
    names = ("FR_hip_pitch", "FR_knee")
    np.savez_compressed(
        folder / "a.npz", time=t, command=wave, position=0.9 * wave, joints=np.array(names)
    )
    columns = np.column_stack([t, wave, 0.9 * wave])
    header = ["time", *(f"{q}.{n}" for q in ("command", "position") for n in names)]
    np.savetxt(folder / "a.csv", columns, delimiter=",", header=",".join(header), comments="")
    with_header = LogHeader(robot="mini_cheetah", joints=names)
    writer = McapLogWriter(folder / "a.mcap", with_header)
    for now, row in zip(t, wave, strict=True):
        writer.sample(now, row, 0.9 * row)
    writer.end()
    knee = gains_file.JointGains(stiffness=20.0, damping=0.5, armature=0.01)
    gains_file.save(
        folder / "gains.yaml",
        gains_file.MatchedGains(
            robot="r", simulator=SimulatorInfo(), joints={"FR_knee": knee}, groups={}
        ),
    )
    omega = np.arange(1.0, 40.0)
    response_file.save(
        folder / "a.response.npz",
        [
            response_file.FrequencyResponse(
                joint="FR_knee",
                amplitude=0.1,
                omega=omega,
                response=np.asarray(1.0 / (1.0 + 0.1j * omega), np.complex128),
                coherence=np.ones(39),
                averages=np.ones(39),
                repeats=np.ones((3, 39), complex),
                estimator="H1",
                window="hann",
                segment_s=8.0,
            )
        ],
    )
    robot = Path(gains_file.__file__).parents[1] / "robots" / "mini_cheetah"
    shutil.copytree(robot, folder / "robot")
    shutil.copy(SHIPPED, folder / "sim_params.yaml")

    def log(path: Path) -> JointLog:
        return read_log(path) if path.suffix == ".mcap" else read_log(path, unit="rad")

    return [
        _Input(folder / "a.npz", log, True),
        _Input(folder / "a.csv", log, False),
        _Input(folder / "a.mcap", log, True),
        _Input(folder / "gains.yaml", gains_file.load, False),
        _Input(folder / "a.response.npz", response_file.load, True),
        _Input(folder / "robot" / "robot.yaml", read_robot, False),
        _Input(folder / "sim_params.yaml", load_sim_params, False),
    ]


def _mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """Change bytes, put in tokens, cut, repeat or move pieces."""
    out = bytearray(data)
    for _ in range(rng.integers(1, 5)):
        at, size = int(rng.integers(len(out) + 1)), int(2 ** rng.uniform(0, 9))
        match rng.integers(5):
            case 0:
                out[at : at + 1] = rng.bytes(1)
            case 1:
                out[at:at] = _TOKENS[rng.integers(len(_TOKENS))]
            case 2:
                del out[at : at + size]
            case 3:
                out[at:at] = out[at : at + size] * int(rng.integers(1, 20))
            case _:
                out[at:] = out[at + size :] + out[at : at + size]
    return bytes(out)


def _numbers(found: Any) -> list[np.ndarray]:
    if isinstance(found, JointLog):
        return [found.time, found.command, found.position]
    return [array for one in found for array in (one.omega, one.response, one.repeats)]


def _same(found: list[np.ndarray], right: list[np.ndarray]) -> bool:
    return len(found) == len(right) and all(map(np.array_equal, found, right))


class _LateError(BaseException):
    """A file took too long; no `except Exception` or `OSError` of a reader catches it."""


def _late(*_: object) -> None:
    raise _LateError


def fuzz(count: int = 2000, seed: int = 0) -> console.Outcome:
    """Read mutated files of seven kinds.

    Args:
        count: Files, all kinds together.
        seed: Of the mutations.
    """
    rng, worst = np.random.default_rng(seed), 0.0
    tally: collections.Counter[str] = collections.Counter()
    faults: list[str] = []
    signal.signal(signal.SIGALRM, _late)
    with tempfile.TemporaryDirectory() as name, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        inputs = _inputs(Path(name))
        sound = [(one.path.read_bytes(), one.read(one.path)) for one in inputs]
        for i in range(count):
            one, (data, right) = inputs[i % len(inputs)], sound[i % len(inputs)]
            one.path.write_bytes(_mutated(data, rng))
            begun = time.process_time()
            signal.alarm(LIMIT_S)
            try:
                found = one.read(one.path)
            except PronkError as error:
                tally[f"{one.path.name} refused"] += 1
                if not str(error).isprintable():
                    faults.append(f"{one.path.name} {i}: message not printable")
            except (Exception, _LateError) as error:
                faults.append(f"{one.path.name} {i}: {type(error).__name__} {error}"[:200])
            else:
                tally[f"{one.path.name} read"] += 1
                said = isinstance(found, JointLog) and not found.complete
                same = not one.checked or _same(_numbers(found), _numbers(right))
                if not (said or same):
                    faults.append(f"{one.path.name} {i}: other numbers without a word")
            finally:
                signal.alarm(0)
            worst = max(worst, time.process_time() - begun)
    for fault in faults[:40]:
        console.say(fault)
    tally["faults"] = len(faults)
    console.say(f"{count} files, seed {seed}: {dict(tally)}; longest {worst:.2f} s of processor")
    return console.Outcome(
        figures={"count": count, **tally, "longest_s": worst if math.isfinite(worst) else None},
        status=1 if faults else 0,
    )
