"""The contract as text: JSON in one entry of an ONNX file's metadata.

Anything that reads ONNX can read it: in ONNX Runtime
`json.loads(session.get_modelmeta().custom_metadata_map["pronk.contract"])`.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from pronk.errors import ArtefactError
from pronk.policy.contract import Contract, ObservationPart

SCHEMA = "pronk/policy/1"
METADATA_KEY = "pronk.contract"


def to_json(contract: Contract) -> str:
    """The contract as JSON, `schema` first."""
    return json.dumps({"schema": SCHEMA, **asdict(contract)}, allow_nan=False)


def from_json(text: str, *, source: object) -> Contract:
    """Read what `to_json` wrote.

    Args:
        text: The JSON.
        source: Where it is from, for errors.

    Raises:
        ArtefactError: Not JSON, of another schema, with fields missing, misspelled or of another
            kind, or contradicting itself.
    """
    try:
        body = json.loads(text)
    except ValueError as error:
        raise ArtefactError(f"{source}: the contract is not JSON ({error}).") from None
    if not isinstance(body, dict) or body.get("schema") != SCHEMA:
        got = body.get("schema") if isinstance(body, dict) else type(body).__name__
        raise ArtefactError(f"{source}: schema {got!r}; this pronk reads {SCHEMA!r}.")
    # Some older files have this field: the jump input had to wait for a moment of the stride.
    if body.pop("waits_for_stride", False) is not False:
        raise ArtefactError(
            f"{source}: waits_for_stride is set; this pronk passes jump commands on at "
            "once. Train the policy again, or use one without this field."
        )
    odd = (set(_READERS) | {"schema"}) ^ set(body)
    if odd:
        raise ArtefactError(
            f"{source}: fields of the contract are missing or unknown: {', '.join(sorted(odd))}."
        )
    values: dict[str, Any] = {}
    for name, read in _READERS.items():
        try:
            values[name] = read(body[name])
        except (TypeError, ValueError, KeyError) as error:
            raise ArtefactError(
                f"{source}: the contract's {name} cannot be read: {error}."
            ) from None
    try:
        return Contract(**values)
    except ArtefactError as error:
        raise ArtefactError(f"{source}: {error}") from None


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{value!r} is not text")
    return value


def _flag(value: Any) -> bool:
    if not isinstance(value, bool):
        raise TypeError(f"{value!r} is neither true nor false")
    return value


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise TypeError(f"{value!r} is not a number")
    return float(value)


def _whole(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise TypeError(f"{value!r} is not a whole number")
    return value


def _items(value: Any) -> list[Any]:
    if not isinstance(value, list):
        raise TypeError(f"{value!r} is not a list")
    return value


def _numbers(value: Any) -> tuple[float, ...]:
    return tuple(_number(v) for v in _items(value))


def _pair(value: Any) -> tuple[float, float]:
    if len(_items(value)) != 2:
        raise ValueError(f"{value!r} is not a pair")
    return _number(value[0]), _number(value[1])


def _mapping(value: Any, read: Callable[[Any], Any] = lambda v: v) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise TypeError(f"{value!r} is not a mapping")
    return {k: read(v) for k, v in value.items()}


def _part(value: Any) -> ObservationPart:
    entry = _mapping(value)
    return ObservationPart(
        name=_text(entry["name"]),
        size=_whole(entry["size"]),
        times_s=_numbers(entry["times_s"]),
        unit=_text(entry["unit"]),
    )


_READERS: dict[str, Callable[[Any], Any]] = {
    "robot": _text,
    "joint_names": lambda value: tuple(_text(v) for v in _items(value)),
    "default_position": _numbers,
    "action_scale": _numbers,
    "stiffness": _numbers,
    "damping": _numbers,
    "gains": _text,
    "gains_sha256": _text,
    "virtual": _flag,
    "observation": lambda value: tuple(_part(v) for v in _items(value)),
    "policy_rate_hz": _number,
    "timestep_s": _number,
    "decimation": _whole,
    "delay_range_s": _pair,
    "command_ranges": lambda value: _mapping(value, _pair),
    "jump": _flag,
    "lift_off_velocity": lambda value: None if value is None else _number(value),
    "provenance": _mapping,
    "versions": lambda value: _mapping(value, _text),
}
"""How each field is read back from JSON."""
