"""The description of a log, in a file beside it: the options with which it is read.

`chirp.log.yaml` describes `chirp.csv`. `pronk log inspect` writes it, a person may edit it, and
every later reading takes its options from it; options that are stated otherwise take precedence.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import yaml

from pronk.errors import LogError, PronkError
from pronk.files import read_yaml, write_text
from pronk.identify.logs.options import ReadOptions

SCHEMA = "pronk/log/1"
"""Schema of the file."""
_ENDING = ".log.yaml"
_HEADER = """\
# How pronk reads the log named below. Written by `pronk log inspect`; edit it where it is wrong.
# Options of a command take precedence. Joints, units and topics are those of the file.
"""


class _File(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    """Content of the file."""

    schema: str
    file: str
    format: str | None = None
    unit: str | None = None
    time_unit: str | None = None
    columns: dict[str, str] | list[str] | None = None
    joint_names: dict[str, str] | None = None
    joint_order: str | list[str] | None = None
    scale: dict[str, float] | None = None
    drop_duplicates: bool = False
    rate_hz: float | None = None
    measured_topic: str | None = None
    command_topic: str | None = None
    command_field: str | None = None
    reader_options: dict[str, str] | None = None


def description_path(log: Path) -> Path:
    """Path of the description of a log: its name without its ending, and `.log.yaml`."""
    name = log.name
    if name.lower().endswith(".gz"):
        name = name[: -len(".gz")]
    stem = Path(name).stem if Path(name).suffix and not log.is_dir() else name
    return log.with_name(f"{stem}{_ENDING}")


def read_description(log: Path) -> ReadOptions | None:
    """Read the options in the file beside a log; None if there is no such file.

    A description of another file of the same name, as of `chirp.npz` beside `chirp.csv`, does not
    count while that file is there.

    Raises:
        LogError: The file is damaged, has unknown fields, or describes a file that is not there.
    """
    path = description_path(log)
    if not path.exists():
        return None
    body = read_yaml(path, LogError)
    if not isinstance(body, dict) or body.get("schema") != SCHEMA:
        raise LogError(
            f"{path}: no description of a log of this version (expected `schema: {SCHEMA}`); "
            f"remove it, or write it anew with `pronk log inspect {log} --yes`."
        )
    try:
        content = msgspec.convert(body, type=_File)
    except msgspec.ValidationError as error:
        raise LogError(
            f"{path}: {' '.join(str(error).split())}; correct it, or write it anew with "
            f"`pronk log inspect {log} --yes`."
        ) from None
    if content.file != log.name:
        if log.with_name(Path(content.file).name).exists():
            return None
        raise LogError(
            f"{path}: it describes {content.file!r} and not {log.name!r}; correct `file:` if the "
            "log was renamed, or remove it."
        )
    try:
        return ReadOptions(
            format=content.format,
            rate_hz=content.rate_hz,
            unit=content.unit,
            time_unit=content.time_unit,
            joint_names=content.joint_names,
            joint_order=content.joint_order,
            drop_duplicates=content.drop_duplicates,
            scale=content.scale,
            columns=content.columns,
            measured_topic=content.measured_topic,
            command_topic=content.command_topic,
            command_field=content.command_field,
            reader_options=content.reader_options or {},
        )
    except PronkError as error:
        raise LogError(f"{path}: {error}") from None


def write_description(log: Path, options: ReadOptions) -> Path:
    """Write the options with which a log is read beside it; return the path of the file."""
    order = options.joint_order
    columns = options.columns
    content = _File(
        schema=SCHEMA,
        file=log.name,
        format=options.format,
        unit=options.unit,
        time_unit=options.time_unit,
        columns=dict(columns) if isinstance(columns, Mapping) else list(columns or ()) or None,
        joint_names=dict(options.joint_names or {}) or None,
        joint_order=order if isinstance(order, str) else list(order or ()) or None,
        scale=dict(options.scale or {}) or None,
        drop_duplicates=options.drop_duplicates,
        rate_hz=options.rate_hz,
        measured_topic=options.measured_topic,
        command_topic=options.command_topic,
        command_field=options.command_field,
        reader_options=dict(options.reader_options) or None,
    )
    body: dict[str, Any] = {"schema": SCHEMA, **msgspec.to_builtins(content)}
    path = description_path(log)
    text = yaml.safe_dump(body, sort_keys=False, allow_unicode=True, default_flow_style=False)
    write_text(path, _HEADER + text)
    return path


def with_description(stated: ReadOptions, described: ReadOptions | None) -> ReadOptions:
    """Return stated options, and those of the description where nothing is stated.

    Columns, names and scales are taken one by one.
    """
    if described is None:
        return stated
    columns = stated.columns or described.columns
    if isinstance(stated.columns, Mapping) and isinstance(described.columns, Mapping):
        columns = {**described.columns, **stated.columns}
    return replace(
        stated,
        format=stated.format or described.format,
        rate_hz=stated.rate_hz or described.rate_hz,
        unit=stated.unit or described.unit,
        time_unit=stated.time_unit or described.time_unit,
        joint_names={**(described.joint_names or {}), **(stated.joint_names or {})} or None,
        joint_order=stated.joint_order or described.joint_order,
        drop_duplicates=stated.drop_duplicates or described.drop_duplicates,
        scale={**(described.scale or {}), **(stated.scale or {})},
        columns=columns,
        measured_topic=stated.measured_topic or described.measured_topic,
        command_topic=stated.command_topic or described.command_topic,
        command_field=stated.command_field or described.command_field,
        reader_options={**described.reader_options, **stated.reader_options},
    )
