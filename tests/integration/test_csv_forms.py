"""CSV as people write it: each form gives the numbers that were written, or one sentence."""

from __future__ import annotations

import csv
import gzip
import io
import os
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from command_line import accepted, refused
from pronk.errors import LogError
from pronk.files import SIZE_LIMIT
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.logs.options import ReadOptions
from pronk.identify.logs.readers import find_logs, read_log

RATE_HZ = 100.0
TIME = np.arange(1200) / RATE_HZ
COMMAND = 0.3 * np.sin(2.0 * np.pi * (0.4 * TIME + 0.1 * TIME**2))
POSITION = 0.9 * np.interp(TIME - 0.02, TIME, COMMAND)
NAMED = {"time": "t", "command.knee": "u", "position.knee": "q"}
NUMBERED = {"time": "0", "command.knee": "1", "position.knee": "2"}


def body(
    delimiter: str = ",",
    *,
    decimal: str = ".",
    header: Sequence[str] = ("t", "u", "q"),
    end: str = "\n",
    times: Sequence[str] = (),
) -> str:
    """The example as text, numbers with six digits."""
    lines = [delimiter.join(header)] if header else []
    for k in range(len(TIME)):
        cells = [f"{TIME[k]:.6f}", f"{COMMAND[k]:.6f}", f"{POSITION[k]:.6f}"]
        if times:
            cells[0] = times[k]
        lines.append(delimiter.join(cell.replace(".", decimal) for cell in cells))
    return end.join(lines) + end


def savetxt(**options: str) -> str:
    """The example as numpy.savetxt writes it."""
    stream = io.StringIO()
    np.savetxt(stream, np.stack([TIME, COMMAND, POSITION], axis=1), fmt="%.6f", **options)
    return stream.getvalue()


def columns_of(values: np.ndarray) -> list[str]:
    return [f"{value:.6f}" for value in values]


def quoted() -> str:
    """Quoted names and decimal commas between commas, as a German Excel exports."""
    stream = io.StringIO()
    writer = csv.writer(stream, quoting=csv.QUOTE_ALL)
    writer.writerow(["t", "u", "q"])
    for row in zip(columns_of(TIME), columns_of(COMMAND), columns_of(POSITION), strict=True):
        writer.writerow([cell.replace(".", ",") for cell in row])
    return stream.getvalue()


def with_index(name: str) -> str:
    lines = []
    for k, line in enumerate(body().splitlines()):
        lines.append(f"{k - 1 if k else name},{line}")
    return "\n".join(lines)


FORMS: dict[str, str] = {
    "plain": body(),
    "savetxt": savetxt(header="t,u,q", delimiter=","),
    "savetxt whitespace": savetxt(header="t u q"),
    "savetxt lines": savetxt(header="made by a rig\nkt = 0.11\nt,u,q", delimiter=","),
    "percent": "% t,u,q\n" + body(header=()),
    "comments above": "# Test of Friday\n# kt = 0.11\n#\n" + body(),
    "comments below": body() + "# aborted by the operator\n",
    "preamble": "Rig 3\nOperator;Ada\n\nDate;2026-01-01\n" + body(";"),
    "title of the same width": "Rig 3,,\n" + body(),
    "units": body().replace("\n", "\ns,rad,rad\n", 1),
    "units in brackets": body().replace("\n", "\n[s],[rad],[rad]\n", 1),
    "footer": body() + "End of recording\nsamples,1200\n",
    "whitespace": body(" "),
    "aligned": savetxt(header="t u q", delimiter="   ", comments="   "),
    "tabs": body("\t"),
    "semicolons": body(";"),
    "decimal commas": body(";", decimal=","),
    "tabs and decimal commas": body("\t", decimal=","),
    "whitespace and decimal commas": body(" ", decimal=","),
    "quoted decimal commas": quoted(),
    "carriage returns": body(end="\r"),
    "dos": body(end="\r\n"),
    "blank lines": body(end="\n\n"),
    "spaces": body(" , "),
    "quoted names after spaces": body(", ").replace("t, u, q", '"t", "u", "q"'),
    "trailing delimiter": body(end=",\n"),
    "sep of Excel": "sep=;\n" + body(";"),
    "index": with_index(""),
    "named index": with_index("n"),
    "reversed": "\n".join(",".join(line.split(",")[::-1]) for line in body().splitlines()),
}
NUMBERED_FORMS: dict[str, str] = {
    "no header": body(header=()),
    "no header, whitespace": body(" ", header=()),
    "no header, decimal commas": body(";", decimal=",", header=()),
    "no header, comment": "# recorded on Friday\n" + body(header=()),
    "no header, a comment of as many words": "# kt = 0.11\n" + body(" ", header=()),
    "header with other names": body(),
    "pandas without names": body(header=("0", "1", "2")),
    "savetxt without header": savetxt(),
}
ENCODINGS: dict[str, Callable[[str], bytes]] = {
    "bom": lambda text: text.encode("utf-8-sig"),
    "utf-16": lambda text: text.encode("utf-16"),
    "utf-16 without mark": lambda text: text.encode("utf-16-le"),
    "windows": lambda text: text.replace("q", "q", 1).encode("cp1252") + "# 20 °C".encode("cp1252"),
    "gzip": lambda text: gzip.compress(text.encode()),
    "gzip of two members": lambda text: (
        gzip.compress(text[:9000].encode()) + gzip.compress(text[9000:].encode())
    ),
}


def read(path: Path, columns: object = None, **options: object) -> JointLog:
    return read_log(path, options=ReadOptions(unit="rad", columns=columns, **options))  # type: ignore[arg-type]


def assert_example(log: JointLog) -> None:
    np.testing.assert_allclose(log.time, TIME, atol=2e-6)
    np.testing.assert_allclose(log.command[:, 0], COMMAND, atol=1e-6)
    np.testing.assert_allclose(log.position[:, 0], POSITION, atol=1e-6)


@pytest.mark.parametrize("form", FORMS)
def test_forms_with_names_give_the_numbers(tmp_path: Path, form: str) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(FORMS[form].encode())
    assert_example(read(path, NAMED))


@pytest.mark.parametrize("form", NUMBERED_FORMS)
def test_columns_by_number_give_the_numbers(tmp_path: Path, form: str) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(NUMBERED_FORMS[form].encode())
    assert_example(read(path, NUMBERED))
    log = read(path, ("0", "1", "2"), joint_order="knee")
    assert_example(log)
    assert log.joints == ("knee",)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_encodings_give_the_numbers(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(ENCODINGS[encoding](body()))
    assert_example(read(path, NAMED))


def test_a_gzipped_table_is_known_by_its_name(tmp_path: Path) -> None:
    path = tmp_path / "a.CSV.gz"
    path.write_bytes(gzip.compress(body().encode()))
    assert find_logs([tmp_path]) == [path]
    assert_example(read(path, NAMED))


@pytest.mark.parametrize("unit", ["ms", "us", "ns"])
@pytest.mark.parametrize("epoch_s", [0, 1_700_000_000])
def test_times_in_other_units(tmp_path: Path, unit: str, epoch_s: int) -> None:
    ticks = {"ms": 10**3, "us": 10**6, "ns": 10**9}[unit]
    times = [str(epoch_s * ticks + k * ticks // 100) for k in range(len(TIME))]
    path = tmp_path / "a.csv"
    path.write_text(body(times=times))
    log = read(path, NAMED, time_unit=unit)
    np.testing.assert_allclose(log.time, TIME, atol=1e-6)


@pytest.mark.parametrize(
    "form",
    [
        "2026-01-01T10:{m:02d}:{s:06.3f}",
        "2026-01-01 10:{m:02d}:{s:06.3f}",
        "2026-01-01T10:{m:02d}:{s:06.3f}Z",
        "2026-01-01T10:{m:02d}:{s:06.3f}000000+02:00",
        "10:{m:02d}:{s:06.3f}",
    ],
)
def test_dates_and_times_of_day(tmp_path: Path, form: str) -> None:
    times = []
    for k in range(len(TIME)):
        minute, rest = divmod(55_000 + 10 * k, 60_000)
        times.append(form.format(m=30 + minute, s=rest / 1000.0))
    path = tmp_path / "a.csv"
    path.write_text(body(times=times))
    np.testing.assert_allclose(read(path, NAMED).time - read(path, NAMED).time[0], TIME, atol=1e-9)
    with pytest.raises(LogError, match="--time-unit"):
        read(path, NAMED, time_unit="ms")


@pytest.mark.parametrize(
    ("text", "columns", "words"),
    [
        (body(header=()), NAMED, "no header"),
        (body(), {"time": "T", "command.knee": "U", "position.knee": "q"}, "'T'.*'U'.*log inspect"),
        (body(), None, "time, position.JOINT.*log inspect"),
        (body(","), {"time": "t", "position.knee": "q"}, "command.knee"),
        (body(header=("t", "u", "u")), {**NAMED, "position.knee": "u"}, "several columns"),
        (body(decimal=","), NAMED, r"3 .*6 cells|6 cells.* 3"),
        (body().replace("0.300000", "0,3"), NAMED, "cells"),
        (body(";", decimal=",").replace("3,500000", "3.500000"), NAMED, "decimal comma"),
        ("t;u;q\n" + "\n".join(f"{k};1,{k};2,{k}" for k in range(100, 200)), NAMED, "thousands"),
        (body().replace("3.500000", "3_5.00"), NAMED, "3_5"),
        (body(header=("t", "u")), NAMED, "header.* 2 names.* 3 cells"),
        ("t,u,q\n", NAMED, "samples"),
        ("", NAMED, "samples"),
        ("a letter\nfrom home\n", NAMED, "samples"),
        (body(), ("0", "1"), "three columns"),
        (body(), NUMBERED | {"position.knee": "3"}, "'3'"),
    ],
)
def test_what_can_be_read_in_two_ways_is_refused(
    tmp_path: Path, text: str, columns: object, words: str
) -> None:
    path = tmp_path / "a.csv"
    path.write_text(text)
    with pytest.raises(LogError, match=words) as caught:
        read(path, columns)
    assert "\n" not in str(caught.value)


@settings(max_examples=60, deadline=None)
@given(
    # A change of nine tenths of a turn, 5.65 rad, between two samples is a reading that wraps.
    numbers=st.lists(st.floats(-2.75, 2.75, width=32), min_size=9, max_size=60),
    delimiter=st.sampled_from([",", ";", "\t", " "]),
    comma=st.booleans(),
    header=st.booleans(),
    comments=st.integers(0, 3),
    end=st.sampled_from(["\n", "\r\n", "\r"]),
)
def test_numbers_survive_any_form(
    tmp_path_factory: pytest.TempPathFactory,
    numbers: list[float],
    delimiter: str,
    comma: bool,
    header: bool,
    comments: int,
    end: str,
) -> None:
    """A file is read as it was written, or refused; it is never read as something else."""
    lines = ["# remark"] * comments
    if header:
        lines.append(delimiter.join(("t", "u", "q")))
    rows = np.array(numbers[: 3 * (len(numbers) // 3)]).reshape(-1, 3)
    rows[:, 0] = 0.01 * np.arange(len(rows))
    for row in rows.tolist():
        text = delimiter.join(f"{number:.7f}" for number in row)
        lines.append(text.replace(".", ",") if comma and delimiter != "," else text)
    path = tmp_path_factory.mktemp("csv") / "a.csv"
    path.write_bytes(end.join(lines).encode())
    log = read(path, NAMED if header else NUMBERED)
    np.testing.assert_allclose(log.command[:, 0], rows[:, 1], atol=1e-7)
    np.testing.assert_allclose(log.position[:, 0], rows[:, 2], atol=1e-7)


def test_columns_on_the_command_line_are_repeated_or_have_commas(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text(body(header=("t", "u, set", "q")).replace("u, set", '"u, set"'))
    words = ["response", path, "--unit", "rad", "--no-plots", "--out", tmp_path / "out"]
    repeated = ["--columns", "time=t", "--columns", "command.knee=u, set"]
    first = accepted(*words, *repeated, "--columns", "position.knee=q").split("next:")[0]
    with_commas = accepted(*words, "--columns", "time=t,command.knee=u, set,position.knee=q")
    assert with_commas.split("next:")[0] == first
    by_number = accepted(*words, "--columns", "0,1,2", "--joint-order", "knee")
    assert by_number.split("next:")[0] == first
    assert "knee" in first
    sentence = refused(*words, "--columns", "time=T,command.knee=U,position.knee=q")
    assert "'T'" in sentence
    assert "'U'" in sentence


def test_a_pipe_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    for name in ("a.csv", "a.mcap", "a.npz", "a.pt"):
        os.mkfifo(tmp_path / name)
        with pytest.raises(LogError, match="regular file"):
            read(tmp_path / name)
    with pytest.raises(LogError, match="regular file"):
        read(Path("/dev/zero"), format="csv")


def test_a_gzip_file_that_unpacks_to_much_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(SIZE_LIMIT, "4")
    path = tmp_path / "a.csv.gz"
    path.write_bytes(gzip.compress(bytes(2**26)))
    with pytest.raises(LogError, match="4 MiB"):
        read(path)
    whole = gzip.compress(body().encode())
    for data in (whole[:-9], whole[:40], whole[:30] + b"\xff\xff" + whole[32:]):
        path.write_bytes(data)
        with pytest.raises(LogError, match=r"gzip"):
            read(path)
