"""Unitree's services: a request and its response on two topics, in JSON.

A request carries an id of its own and the number of a function (`api_id`); the response carries
both again, and a code, 0 for done. `motion_switcher` (1001 CheckMode, 1003 ReleaseMode) reports
which of the robot's own controllers holds the joints, and releases it. Older firmware has
`robot_state` (1001 ServiceSwitch) instead.
"""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

from pronk.errors import HardwareError
from pronk.links.dds import messages
from pronk.links.dds.address import Participant, take

SWITCHER, CHECK_MODE, SELECT_MODE, RELEASE_MODE = "motion_switcher", 1001, 1002, 1003
STATES, SERVICE_SWITCH = "robot_state", 1001
BENCH, CLAMP = "pronk_bench", 1
"""Of the virtual robot alone: requests for clamps."""

DONE, UNKNOWN_API, BAD_PARAMETER = 0, 3203, 3204
"""Codes of a response; the errors are unitree_sdk2's for an unknown function and for an impossible
parameter."""

_POLL_S = 0.002
_RELEASE_TRIES, _RELEASE_PAUSE_S = 10, 0.2

Handler = Callable[[int, Any], tuple[int, Any]]
"""From a function's number and its parameter to the code and the data of the response."""


class Client:
    """Calls a service."""

    def __init__(self, participant: Participant, service: str) -> None:
        """Prepare; nothing is sent."""
        self._service = service
        self._requests = participant.writer(f"rt/api/{service}/request", messages.Request)
        self._responses = participant.reader(f"rt/api/{service}/response", messages.Response)

    def call(self, api_id: int, parameter: Any, *, timeout_s: float = 2.0) -> Any | None:
        """Call a function, again while there is no response; its data, or None without one.

        Args:
            api_id: Number of the function.
            parameter: What JSON can hold.
            timeout_s: How long to try in all [s].

        Raises:
            HardwareError: The service responded with another code than 0.
        """
        identity = messages.RequestIdentity(id=time.monotonic_ns(), api_id=api_id)
        header = messages.RequestHeader(
            identity=identity,
            lease=messages.RequestLease(id=0),
            policy=messages.RequestPolicy(priority=0, noreply=False),
        )
        request = messages.Request(header=header, parameter=json.dumps(parameter), binary=[])
        end = time.monotonic() + timeout_s
        again = -1.0
        while time.monotonic() < end:
            if time.monotonic() >= again and self._requests.get_matched_subscriptions():
                self._requests.write(request)
                again = time.monotonic() + timeout_s / 4
            for response in take(self._responses, Counter()):
                if response.header.identity == identity:
                    return self._data(api_id, response)
            time.sleep(_POLL_S)
        return None

    def _data(self, api_id: int, response: Any) -> Any:
        code = response.header.status.code
        if code != DONE:
            raise HardwareError(
                f"the robot's service {self._service} answered {code} to function {api_id}, "
                "expected 0; switch by the robot's own remote or app instead."
            )
        try:
            return json.loads(response.data or "null") or {}
        except ValueError:
            raise HardwareError(
                f"the robot's service {self._service} answered {response.data[:60]!r} to function "
                f"{api_id}, expected JSON; is its firmware one that pronk knows?"
            ) from None


class Server:
    """A service of the virtual robot. One thread, never blocks, never raises."""

    def __init__(
        self, participant: Participant, service: str, handler: Handler, counts: Counter[str]
    ) -> None:
        """Begin to listen; refused requests are counted in `counts`."""
        self._requests = participant.reader(f"rt/api/{service}/request", messages.Request)
        self._responses = participant.writer(f"rt/api/{service}/response", messages.Response)
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
            status = messages.ResponseStatus(code=code)
            header = messages.ResponseHeader(identity=identity, status=status)
            text = "" if data is None else json.dumps(data)
            self._responses.write(messages.Response(header=header, data=text, binary=[]))


def check_own_controller(participant: Participant, *, release: bool, timeout_s: float) -> None:
    """Check that none of the robot's own controllers holds the joints.

    Args:
        participant: Of the link.
        release: Release the controller that does. A standing robot falls then.
        timeout_s: Time for each response [s].

    Raises:
        HardwareError: One holds them and may not be, or could not be, released; or the robot does
            not respond.
    """
    switcher = Client(participant, SWITCHER)
    response = switcher.call(CHECK_MODE, {}, timeout_s=timeout_s)
    if response is None:
        # Older firmware ends its sport mode by another service.
        sport = {"name": "sport_mode", "switch": 0}
        older = Client(participant, STATES)
        if release and older.call(SERVICE_SWITCH, sport, timeout_s=timeout_s) is not None:
            return
        raise HardwareError(
            f"the robot did not answer on its service {SWITCHER} within {timeout_s:g} s, so it is "
            "not known whether its own controller is off; check the network, and its firmware."
        )
    name = _name(response)
    for _ in range(_RELEASE_TRIES if release else 0):
        if not name:
            break
        switcher.call(RELEASE_MODE, {}, timeout_s=timeout_s)
        time.sleep(_RELEASE_PAUSE_S)
        name = _name(switcher.call(CHECK_MODE, {}, timeout_s=timeout_s))
    if name and release:
        raise HardwareError(
            f"the robot's own controller {name!r} did not let go of the joints after "
            f"{_RELEASE_TRIES} requests; switch it off by the robot's app."
        )
    if name:
        raise HardwareError(
            f"the robot's own controller {name!r} holds the joints; lay the robot down or hang it "
            "up, and have the controller released (--disable-onboard-controller)."
        )


def _name(response: Any) -> str:
    return str(response.get("name", "")) if isinstance(response, dict) else ""
