"""MCAP logs: round trips, foreign readers, and what is left of a cut or damaged file."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from mcap.reader import make_reader

from chirp_logs import chirp_log
from log_files import example, write_mcap
from pronk.errors import LogError
from pronk.identify.logs import sweep_writer
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.logs.mcap_reader import read_mcap
from pronk.identify.logs.options import ReadOptions
from pronk.identify.logs.readers import read_log
from pronk.identify.logs.sweep_writer import LogHeader, McapLogWriter
from pronk.identify.response.estimate import estimate_response
from pronk.robots import load_robot

LOG = example()
ROBOT = load_robot("mini_cheetah")
NAMES = ("robot", "joints", "segments", "units")
ARRAYS = ("time", "command", "position", "velocity", "torque", "frequency", "stiffness", "pose")


def assert_same(a: JointLog, b: JointLog) -> None:
    for name in (*ARRAYS, *NAMES):
        np.testing.assert_equal(getattr(a, name), getattr(b, name), err_msg=name)
    for name in ("virtual", "metadata", "complete"):
        assert getattr(a.origin, name) == getattr(b.origin, name)


def test_round_trip_is_exact(tmp_path: Path) -> None:
    write_mcap(tmp_path / "a.mcap", LOG)
    assert_same(LOG, read_mcap(tmp_path / "a.mcap", None, ReadOptions()))
    with pytest.raises(LogError, match="leave the options out"):
        read_log(tmp_path / "a.mcap", options=ReadOptions(command_topic="/sweep/sample"))


@settings(max_examples=30, deadline=None)
@given(data=st.data())
def test_any_log_survives(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    n = data.draw(st.integers(2, 40))
    width = data.draw(st.integers(1, 4))
    matrix = arrays(float, (n, width), elements=st.floats(-1e6, 1e6, allow_nan=False))
    name = st.from_regex(r"\w[\w. -]{0,20}\w", fullmatch=True)
    names = st.lists(name, min_size=width, max_size=width, unique=True)
    log = JointLog(
        robot=data.draw(name),
        joints=tuple(data.draw(names)),
        time=np.cumsum(data.draw(arrays(float, n, elements=st.floats(1e-6, 10.0)))),
        command=data.draw(matrix),
        position=data.draw(matrix),
    )
    path = tmp_path_factory.mktemp("any") / "a.mcap"
    write_mcap(path, log)
    assert_same(log, read_mcap(path, None, ReadOptions()))


def test_another_reader_sees_named_topics_with_schemas(tmp_path: Path) -> None:
    write_mcap(tmp_path / "a.mcap", LOG)
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert summary is not None
        channels = summary.channels.values()
        assert {channel.topic for channel in channels} == set(sweep_writer.TOPICS)
        assert {channel.message_encoding for channel in channels} == {"json"}
        for schema in summary.schemas.values():
            assert schema.encoding == "jsonschema"
            assert json.loads(schema.data)["type"] == "object"
        samples = []
        order = []
        for _, channel, message in reader.iter_messages():
            body = json.loads(message.data)
            order.append((channel.topic, body.get("segment")))
            if channel.topic == sweep_writer.SAMPLE:
                samples.append(body)
    assert len(samples) == 2000
    assert samples[0]["frequency"] is None
    # In time order the excitation is announced before its first sample.
    assert order.index((sweep_writer.SEGMENT, None)) < order.index((sweep_writer.SAMPLE, 0))


@pytest.fixture(scope="module")
def sound_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("cut") / "whole.mcap"
    write_mcap(path, LOG)
    return path


def read_or_one_sentence(path: Path, data: bytes) -> JointLog | None:
    """The log of a file with these bytes, if it can be read."""
    path.write_bytes(data)
    try:
        return read_log(path)
    except LogError as error:
        message = str(error)
    assert "\n" not in message
    assert path.name in message
    return None


@settings(max_examples=150, deadline=None)
@given(share=st.floats(0.0, 1.0, exclude_max=True))
def test_a_file_cut_anywhere_is_a_shorter_log_or_one_sentence(
    sound_file: Path, share: float
) -> None:
    data = sound_file.read_bytes()
    cut = data[: int(share * len(data))]
    short = read_or_one_sentence(sound_file.with_name("cut.mcap"), cut)
    if short is None:
        # Only what lies before the second sample may be lost altogether.
        assert share < 0.25
        return
    assert not short.origin.complete
    count = len(short.time)
    np.testing.assert_array_equal(short.time, LOG.time[:count])
    np.testing.assert_array_equal(short.position, LOG.position[:count])
    # At most one chunk of half a second is lost.
    assert count >= share * len(LOG.time) - 2 * 256
    begun = [segment for segment in LOG.segments if segment.start < short.time[-1]]
    if len(short.segments) < len(begun):
        # A repeat that was cut is left out where whole ones came before it.
        assert begun.pop().stop > short.time[-1]
        assert any("left out" in note for note in short.notes)
        assert begun
    for segment, begun_segment in zip(short.segments, begun, strict=True):
        assert segment.stop <= short.time[-1]
        assert segment.repeat == begun_segment.repeat


def stopped(log: JointLog, count: int) -> JointLog:
    """Return a log that ends after some rows, in the middle of an excitation."""
    return replace(
        log,
        time=log.time[:count],
        command=log.command[:count],
        position=log.position[:count],
    )


def test_a_repeat_that_was_cut_does_not_spoil_the_whole_ones(tmp_path: Path) -> None:
    """A sweep that a person stops ends in a repeat that stands still yet, or is short."""
    log = chirp_log(ROBOT, "FR_knee", (21.0, 0.5), (0.25,), repeats=2)
    assert len(log.segments) == 2
    for seconds in (0.2, 2.0):
        count = int(np.searchsorted(log.time, log.segments[1].start + seconds))
        path = tmp_path / f"{seconds}.mcap"
        write_mcap(path, stopped(log, count))
        short = read_log(path)
        assert short.segments == log.segments[:1]
        assert any("left out" in note for note in short.notes)
        (response,) = estimate_response(short, "FR_knee")
        (expected,) = estimate_response(replace(log, segments=log.segments[:1]), "FR_knee")
        np.testing.assert_allclose(response.response, expected.response, rtol=1e-9)


def test_the_only_excitation_is_read_though_it_was_cut(tmp_path: Path) -> None:
    log = chirp_log(ROBOT, "FR_knee", (21.0, 0.5), (0.25,))
    count = int(0.7 * len(log.time))
    write_mcap(tmp_path / "a.mcap", stopped(log, count))
    (segment,) = read_log(tmp_path / "a.mcap").segments
    assert segment.stop == log.time[count - 1]


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_a_damaged_file_never_gives_wrong_numbers(sound_file: Path, data: st.DataObject) -> None:
    bad = bytearray(sound_file.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        bad[data.draw(st.integers(0, len(bad) - 1))] ^= data.draw(st.integers(1, 255))
    log = read_or_one_sentence(sound_file.with_name("bad.mcap"), bytes(bad))
    if log is not None:
        count = len(log.time)
        np.testing.assert_array_equal(log.time, LOG.time[:count])
        np.testing.assert_array_equal(log.command, LOG.command[:count])


KILLED = """
import time
from pathlib import Path
from pronk.identify.logs.segment import Segment
from pronk.identify.logs.sweep_writer import LogHeader, McapLogWriter
writer = McapLogWriter(Path({path!r}), LogHeader(robot="mini_cheetah", joints=("knee",)))
writer.segment(Segment(kind="chirp", joints=("knee",), start=0.0, stop=99.0, amplitude=0.2))
for k in range(1, 1000):
    writer.sample(k / 500.0, [0.1], [0.2], segment=0)
print("ready", flush=True)
time.sleep(60.0)
"""


def test_a_killed_recorder_leaves_a_valid_log(tmp_path: Path) -> None:
    command = [sys.executable, "-c", KILLED.format(path=str(tmp_path / "a.mcap"))]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        process.kill()
    log = read_mcap(tmp_path / "a.mcap", None, ReadOptions())
    assert not log.origin.complete
    assert len(log.time) == 768  # Whole chunks of 256 samples.
    assert log.segments[0].kind == "chirp"
    assert log.segments[0].stop == pytest.approx(768 / 500.0)


def test_the_reason_of_an_early_end_is_kept(tmp_path: Path) -> None:
    writer = McapLogWriter(tmp_path / "a.mcap", LogHeader(robot="r", joints=("a",)))
    for k in range(5):
        writer.sample(float(k), [0.0], [0.0])
    writer.end(complete=False, reason="the belt broke")
    log = read_mcap(tmp_path / "a.mcap", None, ReadOptions())
    assert not log.origin.complete
    assert "the belt broke" in log.notes[0]


def test_a_chunk_that_claims_to_be_huge_is_not_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "bomb.mcap"
    size = 300 * 2**20
    McapLogWriter(path, LogHeader(robot="r", joints=("a",))).end()
    data = path.read_bytes()
    bomb = zstandard.compress(bytes(size))

    def number(value: int, width: int = 8) -> bytes:
        return value.to_bytes(width, "little")

    record = number(0, 16) + number(size) + bytes(4) + number(4, 4) + b"zstd" + number(len(bomb))
    start = data.index(b"\x06")  # The chunk record.
    path.write_bytes(data[:start] + b"\x06" + number(len(record + bomb)) + record + bomb)
    with pytest.raises(LogError, match="300 MiB"):
        read_mcap(path, None, ReadOptions())
