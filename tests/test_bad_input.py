"""Bad input: one sentence of a PronkError, whatever the file holds, and nothing of it runs."""

from __future__ import annotations

import io
import os
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from pronk.errors import LogError, PronkError, RobotError
from pronk.logs.csv_reader import write_csv
from pronk.logs.joint_log import JointLog
from pronk.logs.mcap_log import write_mcap
from pronk.logs.npz_reader import write_npz
from pronk.logs.readers import read_log, read_logs
from pronk.robots import load_robot

ROBOT = load_robot("mini_cheetah")
OPTIONS: dict[str, dict[str, Any]] = {
    ".csv": {"unit": "rad"},
    ".mcap": {},
    ".npz": {"unit": "rad", "joint_names": ["FR_knee"]},
    ".pt": {"joint_names": ["FR_knee"]},
}
quick = settings(
    max_examples=int(os.environ.get("PRONK_FUZZ", "80")),
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)


def small_log() -> JointLog:
    time = np.arange(60) / 500.0
    return JointLog(
        robot="mini_cheetah",
        joints=("FR_knee",),
        time=time,
        command=np.sin(time)[:, None],
        position=np.cos(time)[:, None],
    )


def check_sentence(error: PronkError, path: Path) -> None:
    text = str(error)
    assert "\n" not in text
    assert path.name in text
    assert text.rstrip().endswith(".")


def reads_or_says_why(path: Path, **options: Any) -> JointLog | None:
    """A log, or one sentence; anything else escapes and fails the test."""
    try:
        return read_log(path, **options)
    except PronkError as error:
        check_sentence(error, path)
        return None


@pytest.mark.parametrize("suffix", list(OPTIONS))
@quick
@given(data=st.binary(max_size=400))
@example(data=b"")
@example(data=b"\x89MCAP0\r\n")
@example(data=b"PK\x03\x04")
@example(data=b"time,position.a,command.a\n0,0,0\n")
def test_random_bytes(tmp_path: Path, suffix: str, data: bytes) -> None:
    path = tmp_path / f"a{suffix}"
    path.write_bytes(data)
    reads_or_says_why(path, **OPTIONS[suffix])


cell = st.one_of(
    st.floats().map(repr),
    st.integers(-5, 5).map(str),
    st.text("0123456789.,;eE-+nai\"'\t", max_size=8),
)


@quick
@given(
    rows=st.lists(st.lists(cell, min_size=3, max_size=3), max_size=8),
    header=st.sampled_from(
        ["time,position.a,command.a", "time,position.a", "t,q,u", "time,time,position.a", ""]
    ),
)
def test_random_csv(tmp_path: Path, rows: list[list[str]], header: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text("\n".join([header, *(",".join(row) for row in rows)]), encoding="utf-8")
    reads_or_says_why(path, unit="rad")


@quick
@given(text=st.text(max_size=300))
def test_random_text_as_csv(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text(text, encoding="utf-8", errors="replace")
    reads_or_says_why(path, unit="deg")


def tensors(**arrays: np.ndarray) -> bytes:
    """What torch.save writes of a dictionary of tensors, put together by hand."""
    out = [b"\x80\x02}("]
    storages = []
    kinds = {"<f4": b"FloatStorage", "<f8": b"DoubleStorage"}
    for key, (name, array) in enumerate(arrays.items()):
        flat = np.ascontiguousarray(array)
        strides = [s // flat.itemsize for s in flat.strides]

        def number(n: int) -> bytes:
            return b"J" + n.to_bytes(4, "little")

        def text(value: str) -> bytes:
            return b"X" + len(value).to_bytes(4, "little") + value.encode()

        def numbers(values: list[int]) -> bytes:
            return b"(" + b"".join(number(v) for v in values) + b"t"

        out += [
            text(name),
            b"ctorch._utils\n_rebuild_tensor_v2\n((",
            text("storage") + b"ctorch\n" + kinds[flat.dtype.str] + b"\n" + text(str(key)),
            text("cpu") + number(flat.size) + b"tQ" + number(0),
            numbers(list(flat.shape)) + numbers(strides),
            b"\x89ccollections\nOrderedDict\n)RtR",
        ]
        storages.append(flat.tobytes())
    out.append(b"u.")
    return archive(b"".join(out), storages)


def archive(program: bytes, storages: list[bytes]) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as file:
        file.writestr("archive/data.pkl", program)
        for key, data in enumerate(storages):
            file.writestr(f"archive/data/{key}", data)
    return stream.getvalue()


def pace() -> bytes:
    time = np.arange(60) / 400.0
    wave = np.sin(time)[:, None]
    return tensors(time=time, dof_pos=wave.astype(np.float32), des_dof_pos=wave)


class Files(dict[str, bytes]):
    """Valid files by suffix, short to print."""

    def __repr__(self) -> str:
        return "Files"


def valid_files(folder: Path) -> Files:
    log = small_log()
    write_csv(folder / "v.csv", log)
    write_npz(folder / "v.npz", log)
    write_mcap(folder / "v.mcap", log)
    (folder / "v.pt").write_bytes(pace())
    return Files({suffix: (folder / f"v{suffix}").read_bytes() for suffix in OPTIONS})


@pytest.fixture(scope="module")
def valid(tmp_path_factory: pytest.TempPathFactory) -> Files:
    return valid_files(tmp_path_factory.mktemp("valid"))


@pytest.mark.parametrize("suffix", list(OPTIONS))
def test_the_valid_files_are_valid(tmp_path: Path, valid: Files, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    path.write_bytes(valid[suffix])
    options = {"unit": "rad"} if suffix == ".csv" else {}
    options |= {"joint_names": ["FR_knee"]} if suffix == ".pt" else {}
    log = read_log(path, robot=ROBOT, **options)  # type: ignore[arg-type]
    assert len(log.time) == 60


@pytest.mark.parametrize("suffix", list(OPTIONS))
@quick
@given(data=st.data())
def test_mutated_files(tmp_path: Path, valid: Files, suffix: str, data: st.DataObject) -> None:
    mutated = bytearray(valid[suffix])
    for _ in range(data.draw(st.integers(1, 5))):
        where = data.draw(st.integers(0, len(mutated) - 1))
        match data.draw(st.sampled_from(["flip", "cut", "insert", "drop"])):
            case "flip":
                mutated[where] ^= data.draw(st.integers(1, 255))
            case "cut":
                mutated = mutated[: max(where, 1)]
            case "insert":
                mutated[where:where] = data.draw(st.binary(min_size=1, max_size=8))
            case "drop":
                del mutated[where : where + data.draw(st.integers(1, 8))]
        if not mutated:
            break
    path = tmp_path / f"a{suffix}"
    path.write_bytes(bytes(mutated))
    reads_or_says_why(path, **OPTIONS[suffix])


@quick
@given(data=st.data())
def test_mutated_pickles_behind_a_sound_archive(tmp_path: Path, data: st.DataObject) -> None:
    """The checksum of the zip hides the pickle from the mutations above; this one does not."""
    with zipfile.ZipFile(io.BytesIO(pace())) as file:
        program = bytearray(file.read("archive/data.pkl"))
        storages = [file.read(f"archive/data/{key}") for key in range(3)]
    for _ in range(data.draw(st.integers(1, 4))):
        where = data.draw(st.integers(0, len(program) - 1))
        program[where : where + data.draw(st.integers(0, 2))] = data.draw(st.binary(max_size=3))
        if not program:
            break
    path = tmp_path / "a.pt"
    path.write_bytes(archive(bytes(program), storages))
    reads_or_says_why(path, joint_names=["FR_knee"])


SAGE_STATE = 'STATE_MOTOR,{t},"[0.1, 0.2]","[0, 0]","[0, 0]"'


@quick
@given(
    cells=st.lists(
        st.one_of(st.just(""), st.text("[]0123456789.,eE-\"'x() ", max_size=30)), max_size=4
    ),
    stamp=st.one_of(st.floats(), st.text(max_size=5)),
)
@example(cells=["__import__('os').getcwd()"], stamp=0.0)
@example(cells=["[1, NaN]"], stamp=0.0)
@example(cells=["[[1, 2], [3, 4]]"], stamp=0.0)
@example(cells=['["a", "b"]'], stamp=0.0)
def test_random_sage_rows(tmp_path: Path, cells: list[str], stamp: float | str) -> None:
    folder = tmp_path / "s"
    folder.mkdir(exist_ok=True)
    quoted = ",".join('"' + c.replace('"', '""') + '"' for c in cells)
    states = [SAGE_STATE.format(t=2000 * k) for k in range(1, 6)]
    states.insert(2, f"STATE_MOTOR,{stamp},{quoted}")
    (folder / "joint_list.txt").write_text("hip\nknee\n")
    header = "type,timestamp,positions,velocities,torques"
    (folder / "state_motor.csv").write_text(
        "\n".join([header, *states]), encoding="utf-8", errors="replace"
    )
    (folder / "control.csv").write_text('type,timestamp,positions\nCONTROL,0,"[0.1, 0.2]"\n')
    reads_or_says_why(folder)


# --- pickles ------------------------------------------------------------------------------------


class Bomb:
    """Creates a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return (Path.write_text, (self.path, "boom"))


@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
def test_a_pickle_bomb_as_pt_does_not_run(tmp_path: Path, protocol: int) -> None:
    boom = tmp_path / "boom.txt"
    bomb = pickle.dumps({"time": Bomb(boom)}, protocol=protocol)
    # The bomb works where it is let loose.
    pickle.loads(bomb)
    assert boom.read_text() == "boom"
    boom.unlink()
    path = tmp_path / "a.pt"
    for data in (archive(bomb, []), bomb):
        path.write_bytes(data)
        with pytest.raises(LogError) as caught:
            read_log(path, robot=ROBOT)
        assert "\n" not in str(caught.value)
        assert not boom.exists()
    path.write_bytes(archive(bomb, []))
    with pytest.raises(LogError, match="a dictionary of tensors does not need"):
        read_log(path, robot=ROBOT)


@pytest.mark.parametrize(
    ("program", "words"),
    [
        (b"cos\nsystem\n(S'true'\ntR.", "names os.system"),
        (b"cbuiltins\neval\n(S'1'\ntR.", "names builtins.eval"),
        (b"cnumpy.core.multiarray\n_reconstruct\n.", "names numpy.core.multiarray"),
        (b"\x80\x04\x8c\x02os\x8c\x06system\x93.", "names os.system"),
        (b"(S'x'\nios\nsystem\n.", "opcode INST"),
        (b"ccollections\nOrderedDict\n}b.", "opcode BUILD"),
        (b"\x80\x02ccollections\nOrderedDict\n)\x81.", "opcode NEWOBJ"),
        (b"N.", "it holds a NoneType"),
        (b"}.", "no tensor time, dof_pos, des_dof_pos"),
        (b"r\xff\xff\xff\x7f.", "not a readable .pt"),
        (b"", "not a readable .pt"),
    ],
)
def test_programs_that_are_no_tensors(tmp_path: Path, program: bytes, words: str) -> None:
    path = tmp_path / "a.pt"
    path.write_bytes(archive(program, []))
    with pytest.raises(LogError, match=words) as caught:
        read_log(path, robot=ROBOT)
    assert "\n" not in str(caught.value)


def test_a_key_that_takes_for_ever_to_hash_is_refused(tmp_path: Path) -> None:
    """Sixty nested pairs of one tuple: 2^60 steps to hash, 200 bytes to write."""
    nested = b")" + b"2\x86" * 60
    path = tmp_path / "a.pt"
    path.write_bytes(archive(b"\x80\x02}" + nested + b"Ns.", []))
    with pytest.raises(LogError, match=r"not a readable \.pt"):
        read_log(path, robot=ROBOT)


def test_a_tensor_that_reaches_beyond_its_storage_is_refused(tmp_path: Path) -> None:
    good = tensors(
        time=np.arange(10.0) / 400.0, dof_pos=np.zeros((10, 1)), des_dof_pos=np.zeros((10, 1))
    )
    with zipfile.ZipFile(io.BytesIO(good)) as file:
        program = file.read("archive/data.pkl")
        storages = [file.read(f"archive/data/{key}") for key in range(3)]
    path = tmp_path / "a.pt"
    path.write_bytes(archive(program, [storages[0][:40], *storages[1:]]))
    with pytest.raises(LogError, match=r"not a readable \.pt"):
        read_log(path, joint_names=["FR_knee"])


def test_pickled_objects_in_npz_are_not_read(tmp_path: Path) -> None:
    boom = tmp_path / "boom.txt"
    path = tmp_path / "a.npz"
    np.savez(path, time=np.array([Bomb(boom)], dtype=object))
    with pytest.raises(LogError, match="pickled objects"):
        read_log(path, **OPTIONS[".npz"])
    assert not boom.exists()


def test_an_npz_that_promises_more_than_it_holds(tmp_path: Path) -> None:
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)}
    )
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("time.npy", header.getvalue() + bytes(80))
    with pytest.raises(LogError, match="more than the file holds"):
        read_log(path, **OPTIONS[".npz"])


def test_an_mcap_record_longer_than_any_file(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    chunk = bytes(16 + 8 + 4 + 4) + (2**64 - 16).to_bytes(8, "little")
    path.write_bytes(b"\x89MCAP0\r\n\x06" + len(chunk).to_bytes(8, "little") + chunk)
    with pytest.raises(LogError, match="not a readable MCAP file"):
        read_log(path)


# --- what people really do ----------------------------------------------------------------------


def csv(tmp_path: Path, *rows: str, header: str = "time,position.FR_knee,command.FR_knee") -> Path:
    path = tmp_path / "a.csv"
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


GOOD = ("0.00,0.1,0.1", "0.02,0.2,0.2", "0.04,0.1,0.3", "0.06,0.0,0.1")


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ((), "1 rows; expected a header and samples"),
        (GOOD[:1], "1 samples; a log needs at least 2"),
        ((*GOOD[:2], "0.04,nan,0.3"), "row 4 holds 'nan' in column 'position.FR_knee'"),
        ((*GOOD[:2], "0.04,,0.3"), "row 4 holds '' in column"),
        ((*GOOD[:2], "0.04,1e999,0.3"), "row 4 holds '1e999'"),
        ((*GOOD[:2], "0.04,0.3"), "row 4 has 2 cells and the header 3"),
        ((*GOOD, "0.05,0.0,0.0"), r"time goes back in row 6, from 0\.06 to 0\.05"),
        ((*GOOD, "0.06,0.0,0.0"), "row 6 repeats the timestamp 0.06"),
        (tuple(f"{k * 20000},{k % 3},{k % 2}" for k in range(5)), "probably in us"),
        (tuple(f"{k * 20},{k % 3},{k % 2}" for k in range(5)), "probably in ms"),
        (tuple(f"{k * 0.02},{20 * (k % 3)},{20 * (k % 2)}" for k in range(5)), "in degrees"),
    ],
)
def test_one_sentence_for_each_mistake_in_a_csv(
    tmp_path: Path, rows: tuple[str, ...], words: str
) -> None:
    with pytest.raises(LogError, match=words) as caught:
        read_log(csv(tmp_path, *rows), unit="rad")
    assert "\n" not in str(caught.value)
    assert "a.csv" in str(caught.value)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, "give unit='rad' or unit='deg'"),
        ({"unit": "grad"}, "expected one of rad, deg"),
        ({"unit": "rad", "time_unit": "h"}, "expected one of s, ms, us, ns"),
        ({"unit": "rad", "columns": {"time": "t"}}, "no column called 't'"),
        ({"unit": "rad", "columns": {"speed.FR_knee": "x"}}, "columns names 'speed.FR_knee'"),
        ({"unit": "rad", "rate_hz": 100.0}, "50.00 Hz"),
        ({"unit": "rad", "joint_names": ["a", "b"]}, "2 joint names for 1 columns"),
        ({"unit": "rad", "command_topic": "/x"}, "command_topic means nothing"),
        ({"format": "hdf5"}, "expected one of mcap, csv, sage, pace, npz"),
    ],
)
def test_wrong_options_name_the_right_ones(
    tmp_path: Path, options: dict[str, Any], words: str
) -> None:
    with pytest.raises(LogError, match=words):
        read_log(csv(tmp_path, *GOOD), **options)


def test_wrong_joint_names_list_the_robots(tmp_path: Path) -> None:
    path = csv(tmp_path, *GOOD, header="time,position.knee,command.knee")
    with pytest.raises(RobotError, match="no joint 'knee'; its joints are FR_hip_roll"):
        read_log(path, unit="rad", robot=ROBOT)


def test_misspelled_options_are_refused(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="units"):
        read_log(csv(tmp_path, *GOOD), units="rad")


def test_files_that_are_not_there(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="no such file or folder"):
        read_log(tmp_path / "a.mcap")
    with pytest.raises(LogError, match="no SAGE recording"):
        read_log(tmp_path)
    with pytest.raises(LogError, match="no logs in this folder"):
        read_logs([tmp_path])
    with pytest.raises(LogError, match="no logs were named"):
        read_logs([])
    (tmp_path / "a.doc").touch()
    with pytest.raises(LogError, match=r"'\.doc' names no known format"):
        read_log(tmp_path / "a.doc")
    with pytest.raises(LogError, match=r"no control\.csv; a SAGE recording is a folder with"):
        read_log(tmp_path, format="sage")


def test_names_in_a_file_cannot_break_the_sentence(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    time = np.arange(50) / 500.0
    wave = np.sin(time)[:, None]
    np.savez(path, time=time, command=wave, position=wave, joints=np.array(["FR\nknee"]))
    with pytest.raises(RobotError) as caught:
        read_log(path, unit="rad", robot=ROBOT)
    assert "\n" not in str(caught.value)
