"""The delay that the phase shows beyond the matched simulator.

The paper disregards the phase, because the links' delay is in it (F9). The magnitude then gives
the gains, and what the phase of the measured response lags behind that of the matched simulation
is the delay: phase = -omega * delay, a straight line through zero.
"""

from __future__ import annotations

import numpy as np

from pronk.match.result import JointMatch


def command_delay(joint: JointMatch, *, coherence_min: float = 0.8) -> float:
    """Delay of the measured response behind the matched one [s], never negative.

    Least squares through zero over the joint's band: every frequency with enough coherence counts
    alike. Zero where none has.
    """
    measured = joint.responses[0]
    band = measured.band(*joint.band_hz, coherence_min)
    if not band.any():
        return 0.0
    omega = measured.omega[band]
    lag = -np.unwrap(np.angle(measured.response[band] / joint.matched[band]))
    return max(0.0, float(omega @ lag / (omega @ omega)))
