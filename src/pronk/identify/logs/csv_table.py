"""Tables of numbers as people write them: CSV with comments, without a header, compressed.

The delimiter, the decimal mark and the header are found from the rows of numbers, which are most of
a file. Lines above the header, comments and lines below the last row of numbers are left out. A
file that can be read in two ways is refused.
"""

from __future__ import annotations

import csv
import math
import re
import zlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np

from pronk.arrays import Array
from pronk.errors import LogError, printable
from pronk.files import check_regular, check_size, max_bytes

MAX_COLUMNS = 4096
"""Most columns of a table."""
_CELL_BYTES = 64
"""Memory that a cell of a CSV file takes, about [bytes]."""
_SAMPLE_LINES = 200
"""Lines from which the delimiter and the decimal mark are found."""
_MAX_FOOTER = 50
"""Most lines below the last row of numbers."""
_COMMENT = ("#", "%", "//")
"""Beginnings of lines that are comments."""
_SPACE = " "
"""Delimiter that stands for any run of spaces and tabs."""
_DELIMITERS = (",", ";", "\t", _SPACE)
"""Delimiters in the order in which they are tried."""
_NUMBER = re.compile(
    r"[+-]?(\d+[.,]?\d*|[.,]\d+)([eE][+-]?\d+)?|[+-]?(nan|inf|infinity)", re.IGNORECASE
)
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}(,\d{3})+")
"""A number whose commas may separate thousands."""
_DATE_AND_TIME = re.compile(
    r"(\d{4}-\d\d-\d\d)[T ](\d\d:\d\d(?::\d\d)?)(?:[.,](\d+))?\s*(Z|[+-]\d\d:?\d\d)?"
)
"""A timestamp of ISO 8601: date, time to the second, fraction of a second, time zone."""
_TIME_OF_DAY = re.compile(r"(\d\d?):(\d\d):(\d\d)(?:[.,](\d+))?")
_UNIT_WORDS = frozenset(
    (
        "s",
        "sec",
        "second",
        "seconds",
        "ms",
        "us",
        "ns",
        "rad",
        "deg",
        "degree",
        "degrees",
        "rad/s",
        "deg/s",
        "rad/sec",
        "nm",
        "n*m",
        "n.m",
        "n-m",
        "a",
        "amp",
        "-",
        "none",
        "hz",
        "count",
        "counts",
        "°",
    )
)
"""Words of a row of units below a header."""


@dataclass(frozen=True, kw_only=True)
class CsvTable:
    """Names and rows of a file, all of the same length."""

    path: Path
    """The file."""
    header: tuple[str, ...]
    """Names of the columns; empty if the file has none."""
    rows: list[list[str]]
    """Cells as text, row by row."""
    lines: list[int]
    """Line of each row in the file, from 1."""
    decimal: str = "."
    """Decimal mark of its numbers."""
    units: tuple[str, ...] = ()
    """Units in the row below the header, if there is such a row."""
    notes: tuple[str, ...] = ()
    """Remarks on what was left out."""

    @property
    def width(self) -> int:
        """Number of columns."""
        return len(self.rows[0])

    @property
    def names(self) -> str:
        """The header in words, for messages."""
        if not self.header:
            first_row = ", ".join(self.rows[0])
            return f"there is no header (its first row is {printable(first_row[:80])})"
        return f"the header is {printable(', '.join(self.header)[:600])}"

    def index(self, name: str) -> int | None:
        """Index of a column, by its name or, where no column is called so, its number from 0.

        Raises:
            LogError: Several columns have this name.
        """
        count = self.header.count(name)
        if count > 1:
            raise LogError(
                f"{self.path}: several columns are called {name!r}; name the one by its number, "
                f"from 0, as in --columns time=0; {self.names}."
            )
        if count == 1:
            return self.header.index(name)
        if name.isascii() and name.isdecimal() and int(name) < self.width:
            return int(name)
        return None

    def numbers(self, index: int) -> Array:
        """Numbers of one column, shape (n,); a LogError names the line of a cell that is none."""
        cells = [row[index].strip() for row in self.rows]
        if self.decimal == ",":
            converted = []
            for cell in cells:
                if "." in cell:
                    # A point beside decimal commas may be either mark.
                    converted.append("")
                else:
                    converted.append(cell.replace(",", "."))
        else:
            converted = cells
        values = np.array([_number(cell) for cell in converted])
        bad_rows = np.flatnonzero(~np.isfinite(values))
        if len(bad_rows):
            cell = cells[bad_rows[0]]
            name = self.header[index] if self.header else str(index)
            mark = " with a decimal comma, as in the other rows" if self.decimal == "," else ""
            raise LogError(
                f"{self.path}: row {self.lines[bad_rows[0]]} holds {cell[:40]!r} in column "
                f"{name!r}; expected a finite number{mark}; repair or remove that row."
            )
        return values

    def timestamps(self, index: int) -> tuple[Array, bool]:
        """Timestamps of one column, shape (n,), and True if they are dates or times of day.

        Dates and times of day become seconds since the first row.

        Raises:
            LogError: A cell is no timestamp; the message names its line.
        """
        first_cell = self.rows[0][index].strip()
        if not (_DATE_AND_TIME.fullmatch(first_cell) or _TIME_OF_DAY.fullmatch(first_cell)):
            return self.numbers(index), False
        seconds = []
        fractions = []
        for row, line in zip(self.rows, self.lines, strict=True):
            cell = row[index].strip()
            try:
                clock_seconds, fraction = _clock(cell)
            except ValueError:
                raise LogError(
                    f"{self.path}: row {line} holds {cell[:40]!r} in the column of the time; "
                    f"expected a timestamp as {first_cell!r}; repair or remove that row."
                ) from None
            seconds.append(clock_seconds)
            fractions.append(fraction)
        whole_seconds = np.array(seconds, dtype=np.float64)
        return whole_seconds - whole_seconds[0] + np.array(fractions), True


def _number(cell: str) -> float:
    """The number in a cell; NaN if it is none."""
    if "_" in cell:  # Python takes 1_000 for a number.
        return math.nan
    try:
        return float(cell)
    except ValueError:
        return math.nan


def _clock(cell: str) -> tuple[float, float]:
    """Whole seconds and fraction of a date with time, or of a time of day; ValueError if neither.

    They are kept apart, as nanoseconds since 1970 do not fit into one number.
    """
    match = _DATE_AND_TIME.fullmatch(cell)
    if match:
        date, time, digits, zone = match.groups()
        text = f"{date}T{time}{zone or '+00:00'}"
        return datetime.fromisoformat(text).timestamp(), float(f"0.{digits or 0}")
    match = _TIME_OF_DAY.fullmatch(cell)
    if match is None:
        raise ValueError(cell)
    hours, minutes, seconds, digits = match.groups()
    clock_seconds = 3600.0 * int(hours) + 60.0 * int(minutes) + int(seconds)
    return clock_seconds, float(f"0.{digits or 0}")


def read_text(path: Path) -> str:
    """Read a text file in UTF-8, UTF-16 or the code page of Western Windows, which may be gzipped.

    Line ends become those of Unix.

    Raises:
        LogError: The file cannot be read, is no text, or is larger than allowed.
    """
    try:
        check_regular(path, LogError)
        check_size(path, path.stat().st_size, LogError)
        data = path.read_bytes()
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror or error}).") from None
    if data.startswith(b"\x1f\x8b"):
        data = _unzipped(path, data)
    encoding = "utf-8-sig"
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        encoding = "utf-16"
    elif b"\0" in data[:2]:
        encoding = "utf-16-be" if data[:1] == b"\0" else "utf-16-le"
    try:
        text = data.decode(encoding)
    except UnicodeDecodeError as error:
        try:
            if encoding != "utf-8-sig" or b"\0" in data:
                raise error
            text = data.decode("cp1252")
        except UnicodeDecodeError:
            raise LogError(
                f"{path}: not text (byte {error.start} is not {encoding.upper()[:6].rstrip('-')})."
            ) from None
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _unzipped(path: Path, data: bytes) -> bytes:
    """Unpack a gzip file of one or more members; a LogError if it is damaged or too large."""
    limit = max_bytes()
    parts = []
    size = 0
    remaining = data
    try:
        while remaining:
            member = zlib.decompressobj(wbits=31)
            part = member.decompress(remaining, limit - size + 1)
            parts.append(part)
            size += len(part)
            check_size(path, size, LogError)
            if not member.eof:
                raise LogError(f"{path}: the gzip file is cut short; unpack or record it again.")
            remaining = member.unused_data.lstrip(b"\0")
    except zlib.error as error:
        raise LogError(f"{path}: not a sound gzip file ({error}).") from None
    return b"".join(parts)


def read_table(path: Path) -> CsvTable:
    """Read a table of numbers: its header, if it has one, and its rows.

    Raises:
        LogError: The file is no table, its decimal mark is ambiguous, or a row, which the message
            names by its line, has another length.
    """
    text = read_text(path)
    content = []
    numbers = []
    comments = []
    for number, line in enumerate(text.split("\n"), start=1):
        stripped = line.strip()
        if stripped.startswith(_COMMENT):
            comments.append((number, stripped.lstrip("#%/").strip()))
        elif stripped:
            content.append(line)
            numbers.append(number)
    delimiter = _delimiter(path, content)
    cells = sum(line.count(delimiter) + 1 for line in content)
    check_size(path, _CELL_BYTES * cells, LogError)
    rows = []
    lines = []
    try:
        reader = csv.reader(
            _prepared(content, delimiter), delimiter=delimiter, skipinitialspace=True
        )
        for row in reader:
            if any(cell.strip() for cell in row):
                rows.append(row)
                lines.append(numbers[reader.line_num - 1])
    except csv.Error as error:
        raise LogError(f"{path}: not CSV ({' '.join(str(error).split())}).") from None

    sample = _spread(rows)
    width = Counter(len(row) for row in sample).most_common(1)[0][0]
    if width > MAX_COLUMNS:
        raise LogError(f"{path}: {width} columns; expected {MAX_COLUMNS} at most.")
    if width > 1 and all(not row[-1].strip() for row in sample if len(row) == width):
        # Every row ends with a delimiter.
        width -= 1
        for row in rows:
            if len(row) == width + 1 and not row[-1].strip():
                row.pop()
    number_columns = []
    full_rows = [row for row in sample if len(row) == width]
    for column in range(width):
        count = sum(_is_value(row[column]) for row in full_rows)
        if 2 * count >= len(full_rows) and count:
            number_columns.append(column)

    def is_text(row: Sequence[str]) -> bool:
        """Return True for a row that holds words where the table has numbers."""
        words = sum(not _is_value(row[column]) for column in number_columns)
        return 2 * words > len(number_columns)

    start = 0
    titles = []
    while start < len(rows) and (len(rows[start]) != width or is_text(rows[start])):
        if len(rows[start]) == width and sum(bool(cell.strip()) for cell in rows[start]) > 1:
            titles.append(start)
        start += 1
    if not number_columns or start == len(rows):
        raise LogError(
            f"{path}: no rows of numbers in it; expected a header and samples below it, separated "
            "by commas, semicolons, tabs or spaces."
        )
    units: tuple[str, ...] = ()
    first_above = 0
    header: tuple[str, ...] = ()
    if titles and _are_units(rows[titles[-1]]) and len(titles) > 1:
        units = tuple(cell.strip() for cell in rows[titles[-1]])
        titles.pop()
    if titles:
        header = tuple(cell.strip() for cell in rows[titles[-1]])
        first_above = titles[-1] + 1
    elif _are_ordinals(rows[start]) and start + 1 < len(rows):
        header = tuple(cell.strip() for cell in rows[start])
        start += 1
        first_above = start
    else:
        header = _header_in_comments(comments, lines[start], delimiter, width)
    for index in range(first_above, start):
        if len(rows[index]) != width and _is_value(rows[index][0]):
            _refuse_length(path, lines[index], rows[index], width, header)
    if not header and start and delimiter != ";":
        above = rows[start - 1]
        if not any(_is_value(cell) for cell in above) and len(above) > 1:
            raise LogError(
                f"{path}: the header in row {lines[start - 1]} has {len(above)} names and the rows "
                f"below have {width} cells; write one name a column (and a decimal point where a "
                "comma separates the columns)."
            )
    notes = []
    left_out = (titles[-1] if titles else start) if header or start else 0
    if titles and left_out:
        notes.append(f"{left_out} lines above the header are left out")
    elif not titles and start and not _are_ordinals(rows[start - 1]):
        notes.append(f"{start} lines above the first row of numbers are left out")
    stop = len(rows)
    while stop > start + 1 and len(rows) - stop < _MAX_FOOTER:
        row = rows[stop - 1]
        if _is_value(row[0]) or not (len(row) != width or is_text(row)):
            break
        stop -= 1
    if stop < len(rows):
        notes.append(f"{len(rows) - stop} lines below the last row of numbers are left out")
    for index in range(start, stop):
        if len(rows[index]) != width:
            _refuse_length(path, lines[index], rows[index], width, header)
    return CsvTable(
        path=path,
        header=header,
        rows=rows[start:stop],
        lines=lines[start:stop],
        decimal=_decimal(path, sample, number_columns, width),
        units=units,
        notes=tuple(notes),
    )


def _prepared(content: Sequence[str], delimiter: str) -> list[str]:
    """Lines as the module csv takes them; runs of spaces and tabs become one space."""
    if delimiter != _SPACE:
        return list(content)
    return [" ".join(line.split()) for line in content]


def _spread(rows: Sequence[list[str]]) -> list[list[str]]:
    """Rows that stand for all of them, spread over the table."""
    step = max(1, len(rows) // _SAMPLE_LINES)
    return list(rows[::step])


def _delimiter(path: Path, content: Sequence[str]) -> str:
    """The delimiter by which the most cells are numbers in rows of one length.

    Raises:
        LogError: There are no lines, or no delimiter gives rows of several cells.
    """
    step = max(1, len(content) // _SAMPLE_LINES)
    sample = content[::step]
    best = ","
    best_share = -1.0
    for delimiter in _DELIMITERS:
        try:
            rows = list(
                csv.reader(_prepared(sample, delimiter), delimiter=delimiter, skipinitialspace=True)
            )
        except csv.Error:
            continue
        counts = Counter(len(row) for row in rows if len(row) > 1)
        if not counts:
            continue
        width, _ = counts.most_common(1)[0]
        values = 0
        cells = 0
        for row in rows:
            cells += max(len(row), width)
            if len(row) == width:
                values += sum(_is_value(cell) for cell in row)
        share = values / cells
        if share > best_share + 1e-9:
            best = delimiter
            best_share = share
    if not content or best_share < 0.0:
        raise LogError(
            f"{path}: {len(content)} rows and no columns; expected a header and samples below it, "
            "separated by commas, semicolons, tabs or spaces."
        )
    return best


def _is_value(cell: str) -> bool:
    """Return True for the text of a number, a date or a time of day."""
    text = cell.strip()
    return bool(
        _NUMBER.fullmatch(text) or _DATE_AND_TIME.fullmatch(text) or _TIME_OF_DAY.fullmatch(text)
    )


def _are_units(row: Sequence[str]) -> bool:
    """Return True for a row of units, as `s;rad;rad` or `[s],[deg],[deg]`."""
    words = [cell.strip().strip("[]()").casefold() for cell in row if cell.strip()]
    return len(words) > 1 and all(word in _UNIT_WORDS for word in words)


def _are_ordinals(row: Sequence[str]) -> bool:
    """Return True for 0, 1, 2 ...: the header of a table of pandas whose columns have no names."""
    cells = [cell.strip() for cell in row]
    if cells[0] == "":
        cells = cells[1:]
    return len(cells) > 1 and cells == [str(k) for k in range(len(cells))]


def _header_in_comments(
    comments: Sequence[tuple[int, str]], first_line: int, delimiter: str, width: int
) -> tuple[str, ...]:
    """Names in the last comment above the numbers that has one a column, or none."""
    for number, comment in reversed(comments):
        if number > first_line:
            continue
        names = next(csv.reader([comment], delimiter=delimiter, skipinitialspace=True), [])
        if delimiter == _SPACE:
            names = re.split(r"\t|\s{2,}|,", comment)
            if len(names) != width:
                names = comment.split()
        names = [name.strip() for name in names]
        is_prose = any(_is_value(name) or name in ("=", ":") for name in names)
        if len(names) == width and len(set(names)) == width and not is_prose:
            return tuple(names)
    return ()


def _refuse_length(
    path: Path, line: int, row: Sequence[str], width: int, header: Sequence[str]
) -> None:
    """Raise a LogError for a row of another length than the others."""
    reference = "header" if header else "others"
    raise LogError(
        f"{path}: row {line} has {len(row)} cells and the {reference} {width}; repair or remove "
        "that row."
    )


def _decimal(
    path: Path, sample: Sequence[Sequence[str]], number_columns: Sequence[int], width: int
) -> str:
    """The decimal mark of the numbers; a LogError if commas may separate thousands."""
    with_comma = []
    for row in sample:
        if len(row) != width:
            continue
        for column in number_columns:
            cell = row[column].strip()
            if "," in cell and _NUMBER.fullmatch(cell):
                with_comma.append(cell)
    if not with_comma:
        return "."
    if all(_THOUSANDS.fullmatch(cell) for cell in with_comma):
        raise LogError(
            f"{path}: the comma in {with_comma[0]!r} may be a decimal mark or separate thousands; "
            "write numbers with a decimal point and without other marks."
        )
    return ","
