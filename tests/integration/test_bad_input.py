"""Bad input: one sentence, exit status 2, nothing half written, nothing unpickled."""

from __future__ import annotations

import io
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

import pronk
from command_line import invoke, refused
from pronk.errors import LogError, PronkError
from pronk.identify.logs.options import ReadOptions
from pronk.identify.logs.readers import read_log, read_logs
from pronk.robots import load_robot

ROBOT = load_robot("mini_cheetah")
OPTIONS: dict[str, dict[str, Any]] = {
    ".csv": {"unit": "rad"},
    ".mcap": {},
    ".npz": {"unit": "rad", "joint_order": ["FR_knee"]},
    ".pt": {"joint_order": ["FR_knee"]},
}
GOOD = ("0.00,0.1,0.1", "0.02,0.2,0.2", "0.04,0.1,0.3", "0.06,0.0,0.1")
HEADER = "time,position.FR_knee,command.FR_knee"
quick = settings(max_examples=80, suppress_health_check=[HealthCheck.function_scoped_fixture])


def csv(path: Path, *rows: str, header: str = HEADER) -> Path:
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8", errors="replace")
    return path


# --- Commands -----------------------------------------------------------------------------------

SWEEP = "sweep mini_cheetah --out x"
OF = "--robot mini_cheetah --out x/gains.yaml"
COMMANDS = [
    ("mach", "mach"),
    ("match . --robot mini_cheetah --grids 3", "--grids"),
    ("match bench --robot go2 --grids 3", "--grids"),  # A former command as a value.
    (f"{SWEEP} --link twin", "sim, lcm, dds"),
    ("sweep mini_cheeta --out x", "mini_cheetah"),
    (f"{SWEEP} --joints FR_ankle", "FR_knee"),
    (f"{SWEEP} --joints FR_knee --amplitude 1.4", "amplitude"),
    (f"{SWEEP} --sim-params broken.yaml", "broken.yaml"),
    (f"{SWEEP} --port 7801", "port"),
    (f"{SWEEP} --link dds --port 7801", "port"),
    (f"{SWEEP} --link lcm --domain 3", "domain"),
    (f"{SWEEP} --link lcm --sim-params t", "simulate"),
    (f"{SWEEP} --link serial", "lcm"),
    (f"{SWEEP} --link sim://ground", "bench"),
    (f"{SWEEP} --joints ,", "no joint"),
    (f"{SWEEP} --seed -1", "0 or more"),
    (f"{SWEEP} --link dds --seed 3", "simulate"),
    (f"{SWEEP} --link dds://lo/5", "/5"),
    (f"sweep {300 * 'a'} --out x", "too long"),
    ("response nowhere.mcap --out x", "nowhere.mcap"),
    ("response a.csv --out x", "unit"),
    ("response a.csv copy/a.csv --unit rad --out x", "copy/a.csv"),
    ("response a.csv --unit rad --joint-order x", "by --joint"),
    ("response a.csv --command-topic /x", "command_topic"),
    ("match a.csv --robot cheetah --unit rad", "mini_cheetah"),
    ("match a.csv --robot mini_cheetah --out gains.txt --unit rad", ".yaml"),
    (f"match a.csv {OF} --unit furlong", "rad"),
    (f"match a.csv {OF} --unit rad --columns nonsense", "NAME=VALUE"),
    (f"match a.csv {OF} --unit rad --scale FR_knee=big", "big"),
    (f"match b.csv {OF} --unit rad", "FR_elbow"),
    (f"match a.csv {OF} --unit rad", "--drive-gains"),
    (f"match a.csv {OF} --unit rad --drive-gains elbow=17,.4", "hip_roll"),
    (f"match a.csv {OF} --unit rad --drive-gains knee=17", "knee=25,.5"),
    (f"match noise.mcap {OF}", "noise.mcap"),
    (f"match notes.txt {OF}", "notes.txt"),
    (f"match bomb.pt {OF}", "bomb.pt"),
    (f"match a.csv {OF} --unit rad --drive-gains default --simulator gazebo", "gazebo"),
    ("predict a.csv --robot go2 --gains no.yaml", "pronk match"),
    ("export no.yaml --to mjlab --out x.py", "pronk match"),
    ("export no.yaml --to gazebo --out x.py", "mjlab"),
    ("train run --out x", "walk"),
    ("trial no.onnx --out x", "no.onnx"),
    ("trial --out x", "no policy"),
    ("trial no.onnx --out x --commands fast", "fast"),
    ("deploy no.onnx", "no.onnx"),
    ("record go2 --link lcm://[ --out x.mcap", "lcm://["),
    ("simulate cheetah", "mini_cheetah"),
    ("simulate --faults gremlins=1", "gremlins"),
    ("simulate --domain 3", "port"),
    ("simulate --capture x.npz", "ground"),
    ("simulate --silence-after 0", "silence_after"),
    ("simulate --link dds --port 9000", "port"),
    ("simulate --port 7667", "7667"),
    ("simulate --mode dance", "dance"),
    ("simulate --seed -1", "0 or more"),
    ("simulate so101", "12"),
    ("robot new no.xml", "no.xml"),
    ("robot check none.yaml", "none.yaml"),
    ("robot check broken.xml", "broken.xml"),
    ("robot new a.csv --out x/robot.yaml", "beside"),
    ("report nowhere", "no such folder"),
    ("report .", "nothing to report"),
    ("demo --out x --jumps 0", "--jumps"),
    ("demo --out x --policies .", "policy.onnx"),
]
"""Words of a command, and what the refusal names."""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Files that are no good input, in the working directory."""
    monkeypatch.chdir(tmp_path)
    csv(tmp_path / "a.csv", *GOOD)
    (tmp_path / "copy").mkdir()
    csv(tmp_path / "copy" / "a.csv", *GOOD)
    csv(tmp_path / "b.csv", *GOOD, header="time,position.FR_elbow,command.FR_elbow")
    (tmp_path / "broken.yaml").write_text("schema: pronk/sim_params/1\nrobot: mini_cheetah\n")
    (tmp_path / "broken.xml").write_text("<mujoco><worldbody>")
    (tmp_path / "noise.mcap").write_bytes(b"\x00" * 500)
    (tmp_path / "notes.txt").write_text("hello")
    (tmp_path / "bomb.pt").write_bytes(archive(pickle.dumps({"time": Bomb(tmp_path / "boom")})))
    return tmp_path


@pytest.mark.parametrize(("words", "named"), COMMANDS)
def test_a_command_refuses_in_one_sentence_and_writes_nothing(
    folder: Path, words: str, named: str
) -> None:
    before = set(folder.rglob("*"))
    assert named in refused(*words.split())
    assert set(folder.rglob("*")) == before


@pytest.mark.parametrize(("tilt", "warned"), [("inf", True), ("3", False)])
def test_a_robot_without_a_limit_of_its_tilt_counts_as_hung(tilt: str, warned: bool) -> None:
    policy = Path(pronk.__file__).parent / "policies" / "matched" / "policy.onnx"
    command = invoke(["deploy", policy, "--link", "lcm://lo", "--tilt", tilt], typed="no")
    assert command.exit_code == 2, command.output
    assert "nothing was moved" in command.stderr
    assert ("counts as hung" in command.stderr) is warned


@pytest.mark.parametrize("option", ["--log", "--capture"])
def test_deploy_replaces_no_file_of_an_earlier_run_unless_told_to(
    tmp_path: Path, option: str
) -> None:
    policy = Path(pronk.__file__).parent / "policies" / "matched" / "policy.onnx"
    earlier = tmp_path / "earlier"
    earlier.write_bytes(b"a day's work")
    # The gamepad is missing: what passes the check of the files is refused for it.
    words = ["deploy", policy, "--gamepad", tmp_path / "js9", option, earlier]
    sentence = refused(*words)
    assert str(earlier) in sentence
    assert option in sentence
    assert "--overwrite" in sentence
    assert "js9" in refused(*words, "--overwrite")
    assert earlier.read_bytes() == b"a day's work"


# --- Random files -------------------------------------------------------------------------------


def reads_or_refuses(path: Path, **options: Any) -> None:
    """Read a log, or get one sentence with its name; anything else fails the test."""
    try:
        read_log(path, options=ReadOptions(**options))
    except PronkError as error:
        text = str(error)
        assert "\n" not in text
        assert path.name in text
        assert text.rstrip().endswith(".")


@pytest.mark.parametrize("suffix", OPTIONS)
@quick
@given(data=st.binary(max_size=400))
@example(data=b"")
@example(data=b"\x89MCAP0\r\n")
@example(data=b"PK\x03\x04")
@example(data=b"time,position.a,command.a\n0,0,0\n")
def test_random_bytes(tmp_path: Path, suffix: str, data: bytes) -> None:
    path = tmp_path / f"a{suffix}"
    path.write_bytes(data)
    reads_or_refuses(path, **OPTIONS[suffix])


cell = st.one_of(st.floats().map(repr), st.text("0123456789.,;eE-+nai\"'\t", max_size=8))


@quick
@given(
    rows=st.lists(st.lists(cell, min_size=3, max_size=3).map(",".join), max_size=8),
    header=st.one_of(st.sampled_from([HEADER, "t,q,u", "time,time,position.a"]), st.text()),
)
def test_random_csv(tmp_path: Path, rows: list[str], header: str) -> None:
    reads_or_refuses(csv(tmp_path / "a.csv", *rows, header=header), unit="rad")


@quick
@given(
    cells=st.lists(st.text("[]0123456789.,eE-\"'x() ", max_size=30), max_size=4),
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
    states = [f'STATE_MOTOR,{2000 * k},"[0.1, 0.2]","[0, 0]","[0, 0]"' for k in range(1, 6)]
    states.insert(2, f"STATE_MOTOR,{stamp},{quoted}")
    (folder / "joint_list.txt").write_text("hip\nknee\n")
    csv(folder / "state_motor.csv", *states, header="type,timestamp,positions,velocities,torques")
    csv(folder / "control.csv", 'CONTROL,0,"[0.1, 0.2]"', header="type,timestamp,positions")
    reads_or_refuses(folder)


def archive(program: bytes) -> bytes:
    """A file of torch with this pickle."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as file:
        file.writestr("archive/data.pkl", program)
    return stream.getvalue()


# --- Pickles and sizes --------------------------------------------------------------------------


class Bomb:
    """Creates a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return (Path.write_text, (self.path, "boom"))


@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
def test_a_pickle_bomb_does_not_run(tmp_path: Path, protocol: int) -> None:
    boom = tmp_path / "boom"
    path = tmp_path / "a.pt"
    bomb = pickle.dumps({"time": Bomb(boom)}, protocol=protocol)
    pickle.loads(bomb)
    assert boom.read_text() == "boom"  # so the bomb works
    boom.unlink()
    for data in (archive(bomb), bomb):
        path.write_bytes(data)
        with pytest.raises(LogError, match=r"a\.pt"):
            read_log(path, robot=ROBOT)
    np.savez(tmp_path / "a.npz", time=np.array([Bomb(boom)], dtype=object))
    with pytest.raises(LogError, match="pickle"):
        read_log(tmp_path / "a.npz", options=ReadOptions(**OPTIONS[".npz"]))
    assert not boom.exists()


@pytest.mark.parametrize(
    "program",
    [
        b"cos\nsystem\n(S'true'\ntR.",
        b"cbuiltins\neval\n(S'1'\ntR.",
        b"\x80\x04\x8c\x02os\x8c\x06system\x93.",
        b"(ios\nsystem\n.",
        b"N.",
        b"\x80\x02}.",
        b"r\xff\xff\xff\x7f.",
        b"",
        # Sixty nested pairs of one tuple: 2^60 steps to hash, 200 bytes to write.
        b"\x80\x02})" + b"2\x86" * 60 + b"Ns.",
    ],
)
def test_programs_that_are_no_tensors_are_refused(tmp_path: Path, program: bytes) -> None:
    path = tmp_path / "a.pt"
    path.write_bytes(archive(program))
    with pytest.raises(LogError, match=r"a\.pt") as caught:
        read_log(path, robot=ROBOT)
    assert str(caught.value).isprintable()


def test_a_file_of_pytorch_without_the_tensors_is_refused(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    torch.save({"time": torch.zeros(3)}, tmp_path / "few.pt")
    torch.save(torch.zeros(3), tmp_path / "tensor.pt")
    with pytest.raises(LogError, match="no tensor dof_pos, des_dof_pos; it holds time"):
        read_log(tmp_path / "few.pt", robot=ROBOT)
    with pytest.raises(LogError, match="it holds a Tensor"):
        read_log(tmp_path / "tensor.pt", robot=ROBOT)


def test_files_that_promise_more_than_they_hold(tmp_path: Path) -> None:
    header = io.BytesIO()
    huge = {"descr": "<f8", "fortran_order": False, "shape": (10**12,)}
    np.lib.format.write_array_header_1_0(header, huge)
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as file:
        file.writestr("time.npy", header.getvalue() + bytes(80))
    chunk = bytes(16 + 8 + 4 + 4) + (2**64 - 16).to_bytes(8, "little")
    mcap = b"\x89MCAP0\r\n\x06" + len(chunk).to_bytes(8, "little") + chunk
    (tmp_path / "a.mcap").write_bytes(mcap)
    for suffix in (".npz", ".mcap"):
        with pytest.raises(LogError, match=f"a{suffix}"):
            read_log(tmp_path / f"a{suffix}", options=ReadOptions(**OPTIONS[suffix]))


def test_tensors_whose_numbers_are_cut(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    wave = torch.sin(torch.arange(60) / 400.0)[:, None]
    path = tmp_path / "a.pt"
    torch.save({"time": wave[:, 0], "dof_pos": wave, "des_dof_pos": wave}, path)
    with zipfile.ZipFile(path) as file:
        parts = {name: file.read(name) for name in file.namelist()}
    for size in (240, 40):
        with zipfile.ZipFile(path, "w") as file:
            for name, data in parts.items():
                file.writestr(name, data[:size] if "/data/" in name else data)
        if size == 240:
            assert len(read_log(path, options=ReadOptions(**OPTIONS[".pt"])).time) == 60
    with pytest.raises(LogError, match=r"a\.pt"):
        read_log(path, options=ReadOptions(**OPTIONS[".pt"]))


# --- Mistakes in logs and options ---------------------------------------------------------------


@pytest.mark.parametrize(
    ("rows", "named"),
    [
        ((), "samples"),
        (GOOD[:1], "at least 2"),
        ((*GOOD[:2], "0.04,nan,0.3"), "row 4 .*nan.*position.FR_knee"),
        ((*GOOD[:2], "0.04,,0.3"), "row 4"),
        ((*GOOD[:2], "0.04,1e999,0.3"), "row 4 .*1e999"),
        ((*GOOD[:2], "0.04,0.3"), "row 4 .*2 cells"),
        ((*GOOD, "0.05,0.0,0.0"), "row 6"),
        ((*GOOD, "0.06,0.0,0.0"), r"row 6 .*0\.06"),
        (tuple(f"{k * 20000},{k % 3},{k % 2}" for k in range(5)), " us"),
        (tuple(f"{k * 20},{k % 3},{k % 2}" for k in range(5)), " ms"),
        (tuple(f"{k * 0.02},{20 * (k % 3)},{20 * (k % 2)}" for k in range(5)), "degrees"),
    ],
)
def test_mistakes_in_a_csv_are_located(tmp_path: Path, rows: tuple[str, ...], named: str) -> None:
    with pytest.raises(LogError, match=named) as caught:
        read_log(csv(tmp_path / "a.csv", *rows), options=ReadOptions(unit="rad"))
    assert "\n" not in str(caught.value)
    assert "a.csv" in str(caught.value)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"unit": None}, "unit"),
        ({"unit": "grad"}, "rad, deg"),
        ({"time_unit": "h"}, "s, ms, us, ns"),
        ({"columns": {"time": "t"}}, "'t'"),
        ({"columns": {"speed.FR_knee": "x"}}, "speed.FR_knee"),
        ({"rate_hz": 100.0}, r"50\.00 Hz"),
        ({"joint_order": ["a", "b"]}, "by the file"),
        ({"command_topic": "/x"}, "command_topic"),
        ({"reader_options": {"units": "rad"}}, "units"),
        ({"format": "hdf5"}, "mcap, rosbag, csv, sage, pace, npz"),
    ],
)
def test_wrong_options_are_named(tmp_path: Path, options: dict[str, Any], named: str) -> None:
    with pytest.raises(LogError, match=named):
        read_log(csv(tmp_path / "a.csv", *GOOD), options=ReadOptions(**{"unit": "rad"} | options))


def test_files_that_are_not_there(tmp_path: Path) -> None:
    (tmp_path / "a.doc").touch()
    for path in (tmp_path / "a.mcap", tmp_path, tmp_path / "a.doc"):
        with pytest.raises(LogError, match=path.name):
            read_log(path)
    for paths in ([tmp_path], []):
        with pytest.raises(LogError, match="no logs"):
            read_logs(paths)
    with pytest.raises(LogError, match=r"control\.csv"):
        read_log(tmp_path, options=ReadOptions(format="sage"))
