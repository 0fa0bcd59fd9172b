"""The robot's end of a DDS link, as of a Go2 and stricter."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from pronk.deploy.bench.server import ServerTransport
from pronk.deploy.links.dds import link, messages
from pronk.deploy.links.dds.codec import (
    decode_dds_command,
    encode_dds_command,
    encode_dds_state,
    joint_map,
)
from pronk.deploy.links.dds.link import (
    BAD_PARAMETER,
    DONE,
    UNKNOWN_API,
    take_samples,
    write_bytes,
)
from pronk.deploy.links.remote import REMOTE_BYTES
from pronk.robots.machine import Command, State
from pronk.robots.robot import RobotSpec

MODES = ("", "normal", "ai", "advanced", "mcf")
"""Controllers that can hold the joints; the first is none."""
_SERVICE_POLLS = 20
"""Polls of commands to one of requests: 10 ms at the virtual robot's rate."""

Handler = Callable[[int, Any], tuple[int, Any]]
"""Takes a function's number and its parameter, and returns a code and data."""


@dataclass(frozen=True, kw_only=True)
class _Service:
    """A service of the robot."""

    requests: Any
    """Reader of its requests."""
    responses: Any
    """Writer of its responses."""
    handler: Handler


class DdsServerTransport(ServerTransport):
    """The robot's end in Unitree's messages, on loopback only."""

    def __init__(self, robot: RobotSpec, *, domain: int | None = None, mode: str = "") -> None:
        """Join a domain, with the controller that holds the joints at first."""
        network = link.DdsNetwork(domain=domain)
        super().__init__(robot, mode, MODES)
        self._joints = joint_map(robot)
        self.remote = bytes(REMOTE_BYTES)
        """Bytes of the wireless remote; zero while none is switched on."""
        # Another writer is another participant.
        participant = link.Participant(network)
        rival = link.Participant(network)
        self._commands = participant.reader(link.COMMANDS, messages.LowCmd)
        self._states = participant.writer(link.STATES, messages.LowState)
        self._rival = rival.writer(link.COMMANDS, messages.LowCmd)
        self._services: list[_Service] = []
        handlers = {link.SWITCHER: self._switch, link.BENCH: self._bench}
        for name, handler in handlers.items():
            service = _Service(
                requests=participant.reader(f"rt/api/{name}/request", messages.Request),
                responses=participant.writer(f"rt/api/{name}/response", messages.Response),
                handler=handler,
            )
            self._services.append(service)
        self._polls = 0

    def poll(self) -> list[Command]:
        """Commands that arrived since the last poll, oldest first."""
        self._polls += 1
        if self._polls % _SERVICE_POLLS == 1:
            self._respond()
        arrived = []
        for message in take_samples(self._commands, self.counts):
            with self.refusing():
                arrived.append(decode_dds_command(self._joints, self.corrupt_in(message.data)))
                self.counts["commands"] += 1
        return arrived

    def publish(self, state: State) -> None:
        """Put a state on the wire, with the bytes of the remote."""
        data = encode_dds_state(self._joints, replace(state, remote=self.remote))
        write_bytes(self._states, self.corrupt_out(data), self.counts)
        self.counts["states"] += 1

    def contend(self, command: Command) -> None:
        """Command the joints as another program would."""
        write_bytes(self._rival, encode_dds_command(self._joints, command), self.counts)

    def close(self) -> None:
        """Leave the wire."""
        del self._commands, self._states, self._services, self._rival

    def _respond(self) -> None:
        """Handle the requests that have come, of all services."""
        for service in self._services:
            for request in take_samples(service.requests, self.counts):
                identity = request.header.identity
                try:
                    parameter = json.loads(request.parameter or "null")
                except (ValueError, RecursionError):
                    code = BAD_PARAMETER
                    data = None
                else:
                    code, data = service.handler(identity.api_id, parameter)
                if code != DONE:
                    self.counts["refused: request"] += 1
                status = messages.ResponseStatus(code=code)
                header = messages.ResponseHeader(identity=identity, status=status)
                text = "" if data is None else json.dumps(data)
                service.responses.write(messages.Response(header=header, data=text, binary=[]))

    def _switch(self, api_id: int, parameter: Any) -> tuple[int, Any]:
        """Report or change which controller holds the joints."""
        if api_id == link.CHECK_MODE:
            return DONE, {"form": "0", "name": self.mode}
        if api_id == link.RELEASE_MODE:
            mode = ""
        elif api_id == link.SELECT_MODE:
            mode = parameter.get("name", "") if isinstance(parameter, dict) else ""
            if mode not in MODES[1:]:
                return BAD_PARAMETER, None
        else:
            return UNKNOWN_API, None
        self.mode = mode
        self.counts["mode switches"] += 1
        return DONE, None

    def _bench(self, api_id: int, parameter: Any) -> tuple[int, Any]:
        """Hold joints mechanically, or take what a person does at the wireless remote."""
        if api_id == link.REMOTE:
            return self._hold_remote(parameter)
        if api_id != link.CLAMP:
            return UNKNOWN_API, None
        joints = parameter.get("joints") if isinstance(parameter, dict) else None
        if not isinstance(joints, list):
            return BAD_PARAMETER, None
        if not all(name in self._joint_names for name in joints):
            return BAD_PARAMETER, None
        self.clamps = tuple(name for name in self._joint_names if name in joints)
        return DONE, {"joints": list(self.clamps)}

    def _hold_remote(self, parameter: Any) -> tuple[int, Any]:
        """Take the bytes of the remote, which go out with every state from now on."""
        text = parameter.get("bytes") if isinstance(parameter, dict) else None
        try:
            data = bytes.fromhex(text or "")
        except (TypeError, ValueError):
            return BAD_PARAMETER, None
        if len(data) != REMOTE_BYTES:
            return BAD_PARAMETER, None
        self.remote = data
        return DONE, {"bytes": data.hex()}
