"""Rehearsals: what must be quick at a deadline is done for nothing just before it.

A policy's network reads 2.8 MB of weights, more than a core's second cache holds. Between two
steps, 20 ms apart, they and the code around them leave the caches, and the step pays for fetching
them: it takes five times as long as it does back to back. One rehearsal brings half of that back;
2 ms of them, all but a few hundredths of a millisecond. The clock of the core has no part in this:
as long of other work changes nothing. Nor would options of ONNX Runtime help: none of arena,
memory pattern, spinning, denormals, bound inputs and outputs gains more than 5 %, and without
prepacked weights it is slower.

`pronk bench tick` measures it: back to back, at the tick, and at the tick after rehearsals.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from pronk.links.realtime import sleep_until

LEAD_S = 2e-3
"""How long before a deadline rehearsals begin: a tenth of a policy's step [s]."""
_FIRST_S = 1e-3
"""Room that the first one is given; it fetches everything [s]."""
_SHARE = 0.5
"""Of the time one took: the room that the next is given."""
_SPIN_S = 0.2e-3
"""Shorter waits are spun away: a sleep ends up to so much late [s]."""


def warm_up_until(deadline: float, act: Callable[[], object]) -> int:
    """Wait for a deadline, and do something over and over in the last 2 ms before it.

    Nothing is begun without room for half of what it took the last time, for each is quicker than
    the one before: so the deadline is kept to some hundredths of a millisecond. Returns at once if
    it has passed.

    Args:
        deadline: Time of CLOCK_MONOTONIC [s].
        act: Done for nothing; it must change nothing that counts.

    Returns:
        How often it was done.
    """
    sleep_until(deadline - LEAD_S)
    count, needed, now = 0, _FIRST_S, time.monotonic()
    while now + needed < deadline:
        act()
        count += 1
        done = time.monotonic()
        needed, now = _SHARE * (done - now), done
    sleep_until(deadline - _SPIN_S)
    while time.monotonic() < deadline:
        pass
    return count
