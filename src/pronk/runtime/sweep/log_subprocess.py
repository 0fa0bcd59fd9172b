"""A log that another process writes, so that no disk can make a servo late."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Any, Self

from pronk.logs.joint_log import Segment
from pronk.logs.mcap_format import LogHeader
from pronk.logs.mcap_writer import McapLogWriter, reason_of
from pronk.runtime.sweep.channel import Channel


class LogApart:
    """Stands for the `McapLogWriter` at the other end of a channel, and is used like it."""

    def __init__(self, channel: Channel, path: Path, header: LogHeader) -> None:
        """Have the log opened there."""
        self._channel = channel
        self._segments = 0
        channel.put("open", path, header)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """End the log: whole if the block succeeded, cut short with the reason otherwise."""
        self._channel.put("end", error is None, reason_of(error))

    def segment(self, segment: Segment) -> int:
        """Announce a question, before its samples; returns its number."""
        self._channel.put("segment", segment)
        self._segments += 1
        return self._segments - 1

    def sample(self, *values: Any) -> None:
        """Write one measured state: the arguments of `McapLogWriter.sample`, in its order."""
        self._channel.put("sample", *values)


Log = McapLogWriter | LogApart
"""What a recording writes into."""
