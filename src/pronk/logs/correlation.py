"""Correlation of the commands of joints that move at the same time.

With correlated commands, the motion that one joint causes in another looks like a response to the
other's own command: the coherence stays near one while the response is wrong.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.signal import correlate

Array = NDArray[np.float64]

CORRELATION_LIMIT = 0.1
"""Highest absolute correlation of two simultaneous commands that passes without a warning."""

_REACH_S = 0.5
"""Lags that are searched [s]: longer than a joint's impulse response. A sine and a cosine do not
correlate at lag zero."""


def correlation(commands: Array, rate_hz: float) -> Array:
    """Largest absolute correlation of each pair of commands over lags up to half a second.

    Args:
        commands: Uniformly sampled, shape (n, joints).
        rate_hz: Rate of the samples [Hz].

    Returns:
        Symmetric matrix in 0..1 with ones on the diagonal, shape (joints, joints). A command that
        never changes correlates with nothing.
    """
    centred = commands - commands.mean(axis=0)
    energy = np.sqrt((centred**2).sum(axis=0))
    still = energy <= 1e-9 * np.sqrt(len(commands))
    unit = centred / np.where(still, 1.0, energy)
    unit[:, still] = 0.0
    reach = min(round(_REACH_S * rate_hz), len(commands) - 1)
    middle = len(commands) - 1
    width = commands.shape[1]
    found = np.eye(width)
    for i in range(width):
        for j in range(i):
            lags = correlate(unit[:, i], unit[:, j], method="fft")
            peak = np.abs(lags[middle - reach : middle + reach + 1]).max()
            found[i, j] = found[j, i] = min(float(peak), 1.0)
    return found


def correlation_note(commands: Array, joints: Sequence[str], rate_hz: float) -> str:
    """A warning naming the two most alike commands, or "" where none exceeds the limit."""
    alike = correlation(commands, rate_hz) - np.eye(len(joints))
    i, j = divmod(int(np.argmax(alike)), len(joints))
    if len(joints) < 2 or alike[i, j] <= CORRELATION_LIMIT:
        return ""
    return (
        f"the commands of {joints[j]} and {joints[i]} correlate to {alike[i, j]:.2f} (limit "
        f"{CORRELATION_LIMIT:g}): a response may contain the effect of one joint on the other; "
        "excite one joint at a time or use multisines on different harmonics"
    )
