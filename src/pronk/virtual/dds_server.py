"""The robot's end of a DDS link, as of a Go2 and stricter."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from typing import Any

from pronk.links.dds import codec
from pronk.links.dds.codec import decode_command, encode_command, encode_state, joint_map
from pronk.links.dds.link import (
    BAD_PARAMETER,
    BENCH,
    CHECK_MODE,
    CLAMP,
    COMMANDS,
    DONE,
    RELEASE_MODE,
    SELECT_MODE,
    STATES,
    SWITCHER,
    UNKNOWN_API,
    DdsNetwork,
    Participant,
    take,
    write,
)
from pronk.links.machine import Command, RefusedError, State
from pronk.robots.robot import RobotSpec
from pronk.virtual.server import ServerTransport

MODES = ("", "normal", "ai", "advanced", "mcf")
"""Controllers of a Go2 that can hold its joints; the first is none."""
_SERVICE_POLLS = 20
"""Looks for commands to one for requests: 10 ms at the virtual robot's rate."""


Handler = Callable[[int, Any], tuple[int, Any]]
"""From a function's number and its parameter to the code and the data of the response."""


class Server:
    """A Unitree service of the virtual robot. One thread, never blocks, never raises."""

    def __init__(
        self, participant: Participant, service: str, handler: Handler, counts: Counter[str]
    ) -> None:
        """Begin to listen; refused requests are counted in `counts`."""
        self._requests = participant.reader(f"rt/api/{service}/request", codec.Request)
        self._responses = participant.writer(f"rt/api/{service}/response", codec.Response)
        self._handler = handler
        self._counts = counts

    def poll(self) -> None:
        """Respond to what has come."""
        for request in take(self._requests, self._counts):
            identity = request.header.identity
            try:
                parameter = json.loads(request.parameter or "null")
            except (ValueError, RecursionError):
                code, data = BAD_PARAMETER, None
            else:
                code, data = self._handler(identity.api_id, parameter)
            if code != DONE:
                self._counts["refused: request"] += 1
            status = codec.ResponseStatus(code=code)
            header = codec.ResponseHeader(identity=identity, status=status)
            text = "" if data is None else json.dumps(data)
            self._responses.write(codec.Response(header=header, data=text, binary=[]))


class DdsServerTransport(ServerTransport):
    """The robot's end in Unitree's messages, on loopback only."""

    def __init__(self, robot: RobotSpec, *, domain: int | None = None, mode: str = "") -> None:
        """Join a domain, with the controller that holds the joints at first."""
        network = DdsNetwork(domain=domain)
        super().__init__(robot, mode, MODES)
        self._joints = joint_map(robot)
        own = Participant(network)
        self._commands = own.reader(COMMANDS, codec.LowCmd)
        self._states = own.writer(STATES, codec.LowState)
        self._servers = [
            Server(own, SWITCHER, self._switch, self.counts),
            Server(own, BENCH, self._bench, self.counts),
        ]
        # Another writer is another participant.
        self._other = Participant(network).writer(COMMANDS, codec.LowCmd)
        self._polls = 0

    def poll(self) -> list[Command]:
        """Commands that arrived since the last poll, oldest first."""
        self._polls += 1
        if self._polls % _SERVICE_POLLS == 1:
            for server in self._servers:
                server.poll()
        met = (self.receive(message.data) for message in take(self._commands, self.counts))
        return [command for command in met if command is not None]

    def receive(self, data: bytes) -> Command | None:
        """Decode a command; None where it is refused. Never raises."""
        try:
            command = decode_command(self._joints, self.corrupt_in(data))
        except RefusedError as error:
            self._refuse(error)
            return None
        self.counts["commands"] += 1
        return command

    def publish(self, state: State) -> None:
        """Put a state on the wire."""
        write(self._states, self.corrupt_out(encode_state(self._joints, state)), self.counts)
        self.counts["states"] += 1

    def contend(self, command: Command) -> None:
        """Command the joints as another program would."""
        write(self._other, encode_command(self._joints, command), self.counts)

    def close(self) -> None:
        """Leave the wire."""
        del self._commands, self._states, self._servers, self._other

    def _switch(self, api_id: int, parameter: Any) -> tuple[int, Any]:
        """The service that reports and changes which controller holds the joints."""
        if api_id == CHECK_MODE:
            return DONE, {"form": "0", "name": self.mode}
        if api_id not in (RELEASE_MODE, SELECT_MODE):
            return UNKNOWN_API, None
        name = ""
        if api_id == SELECT_MODE:
            name = parameter.get("name", "") if isinstance(parameter, dict) else ""
            if name not in MODES[1:]:
                return BAD_PARAMETER, None
        self.mode = name
        self.counts["mode switches"] += 1
        return DONE, None

    def _bench(self, api_id: int, parameter: Any) -> tuple[int, Any]:
        """The service that holds joints mechanically."""
        if api_id != CLAMP:
            return UNKNOWN_API, None
        joints = parameter.get("joints") if isinstance(parameter, dict) else None
        if not isinstance(joints, list) or not all(name in self._names for name in joints):
            return BAD_PARAMETER, None
        self.clamps = tuple(name for name in self._names if name in joints)
        return DONE, {"joints": list(self.clamps)}
