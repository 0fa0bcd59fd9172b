"""Delay by phase: the lag of the measured response behind the matched simulation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pronk.match.pipeline import command_delay
from report_cases import joint_fit


@pytest.mark.parametrize("name", ["knee", "hip_roll"])
def test_delay_is_the_lag_of_the_phase(name: str) -> None:
    fit = joint_fit(name)
    # The synthetic joint responds 2 ms late, with noise of a quarter per cent.
    delay = command_delay(fit.responses[0], fit.matched, fit.band_hz)
    assert delay == pytest.approx(0.002, abs=2e-4)


def test_an_incoherent_joint_has_no_delay() -> None:
    fit = joint_fit("knee")
    response = fit.responses[0]
    incoherent = replace(response, coherence=np.zeros_like(response.coherence))
    assert command_delay(incoherent, fit.matched, fit.band_hz) == 0.0
