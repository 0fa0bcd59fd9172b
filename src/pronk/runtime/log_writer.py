"""Writes a deployment's log as it happens; what it holds, `pronk.runtime.log` says."""

from __future__ import annotations

import time
from pathlib import Path
from typing import IO, Any

import numpy as np
import orjson
from mcap.writer import CompressionType, IndexType, Writer

from pronk.errors import LogError
from pronk.runtime.log_topics import ROOT, SCHEMA, TOPICS
from pronk.runtime.reasons import Level, Reason
from pronk.runtime.records import Mode


class DeployLogWriter:
    """Writes a log as it happens. What was flushed stays readable whatever comes after."""

    def __init__(self, path: Path, header: dict[str, Any]) -> None:
        """Open `path`, which is replaced, and write the header.

        Raises:
            LogError: The file cannot be made.
        """
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._stream: IO[bytes] = path.open("wb")
        except OSError as error:
            raise LogError(f"{path}: cannot be written ({error.strerror}).") from None
        self._writer = Writer(
            self._stream, compression=CompressionType.ZSTD, index_types=IndexType.ALL
        )
        self._writer.start(profile="", library="pronk")
        self._channels: dict[str, int] = {}
        for topic, properties in TOPICS.items():
            schema = {"title": f"pronk.runtime.{topic}", "type": "object", "properties": properties}
            number = self._writer.register_schema(
                f"pronk.runtime.{topic}", "jsonschema", orjson.dumps(schema)
            )
            self._channels[topic] = self._writer.register_channel(ROOT + topic, "json", number)
        self._wall = time.time() - time.monotonic()
        policy = header.get("policy") or {}
        facts = {"schema": SCHEMA, "robot": header.get("robot"), "link": header.get("link")}
        facts["policy_sha256"] = policy.get("sha256")
        self._writer.add_metadata("pronk", {key: str(value) for key, value in facts.items()})
        self._put("header", time.monotonic(), {"schema": SCHEMA, **header})
        self.flush()

    def tick(self, record: np.void) -> None:
        """One tick of the servo, a record of `TICK`."""
        begun, tick = float(record["begun"]), int(record["tick"])
        state = {
            "t": float(record["time"]),
            "sequence": int(record["sequence"]),
            "bus_voltage": float(record["bus_voltage"]),
            "robot_time": float(record["robot_time"]),
        }
        for name in (
            "position",
            "velocity",
            "torque",
            "gyro",
            "accelerometer",
            "orientation",
            "temperature",
        ):
            state[name] = record[name].tolist()
        self._put("state", begun, state)
        mode = Mode(int(record["mode"]))
        asked = {
            "t": begun,
            "tick": tick,
            "mode": int(mode),
            "mode_name": mode.name,
            "position": record["asked"].tolist(),
            "blend": float(record["blend"]),
            "order": int(record["order"]),
            "state_sequence": int(record["order_state"]),
        }
        self._put("asked", begun, asked)
        reason = Reason(int(record["reason"]))
        sent = {
            "t": float(record["done"]),
            "tick": tick,
            "position": record["sent"].tolist(),
            "stiffness": float(record["stiffness"]),
            "damped": bool(record["damped"]),
            "level": int(record["level"]),
            "reason": int(reason),
            "reason_name": reason.name,
        }
        self._put("sent", begun, sent)
        timing = {
            "t": begun,
            "tick": tick,
            "lateness": begun - float(record["deadline"]),
            "work": float(record["done"]) - begun,
            "state_age": begun - float(record["time"]),
            "latency": float(record["latency"]),
        }
        self._put("timing", begun, timing)

    def step(self, record: np.void) -> None:
        """One step of the policy, a record of `STEP`."""
        begun, step = float(record["begun"]), int(record["sequence"])
        observation = {
            "t": begun,
            "step": step,
            "state_sequence": int(record["state_sequence"]),
            "observation": record["observation"].tolist(),
        }
        self._put("observation", begun, observation)
        action = {
            "t": begun,
            "step": step,
            "live": bool(record["live"]),
            "command": record["command"].tolist(),
            "jump": bool(record["jump"]),
            "action": record["action"].tolist(),
            "target": record["target"].tolist(),
            "contact": record["contact"].tolist(),
            "linear_velocity": record["linear_velocity"].tolist(),
            "lateness": begun - float(record["deadline"]),
            "decision": float(record["inferred"]) - float(record["observed"]),
            "state_age": begun - float(record["state_time"]),
        }
        self._put("action", begun, action)

    def event(self, record: np.void) -> None:
        """Something that happened, a record of `EVENT`."""
        body = {
            "t": float(record["time"]),
            "kind": bytes(record["kind"]).decode("ascii"),
            "text": bytes(record["text"]).decode("ascii"),
            "reason": Reason(int(record["reason"])).name,
            "level": Level(int(record["level"])).name,
        }
        self._put("event", float(record["time"]), body)

    def flush(self) -> None:
        """Finish the chunk and hand everything to the operating system."""
        self._writer.flush()  # type: ignore[no-untyped-call]
        self._stream.flush()

    def end(self, *, complete: bool, figures: dict[str, Any]) -> None:
        """Write the end and close the file."""
        self._put("end", time.monotonic(), {"complete": complete, "figures": figures})
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._stream.close()

    def _put(self, topic: str, t: float, body: dict[str, Any]) -> None:
        stamp = round((t + self._wall) * 1e9)
        # NaN becomes null.
        self._writer.add_message(self._channels[topic], stamp, orjson.dumps(body), stamp)
