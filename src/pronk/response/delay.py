"""Delay of the command, read off the phase.

The gain of a joint fixes its own phase (a second-order joint is minimum phase); phase beyond it
that grows with frequency is delay. All four parameters are fitted at once to the complex
response,

    H = ratio exp(-s delay) / ((s / w0)^2 + 2 zeta s / w0 + 1),

by least squares on log H, so that a percent of gain and a hundredth of a radian count alike.
`ratio` takes up a stiffness ratio below one (gravity, a soft base). What else is not minimum
phase, or beyond second order (a belt, a current loop), adds to the delay found.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from pronk.response.response import FrequencyResponse

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

_COHERENT = 0.8
"""Least coherence of a frequency that takes part."""
_FLOOR = 1e-3
"""Incoherence that no frequency falls below: a perfect bin must not rule the fit."""
_FEWEST = 8
"""Fewest frequencies for four parameters: twice as many real equations as twice the unknowns."""


@dataclass(frozen=True, kw_only=True)
class DelayFit:
    """A second-order joint and the delay beyond it."""

    delay_s: float
    """[s]; NaN if too few coherent frequencies."""
    standard_error_s: float
    """Over repeats where there are three or more, else from the residual of the fit [s]."""
    ratio: float
    """Gain at standstill."""
    natural_hz: float
    """Undamped natural frequency [Hz]."""
    damping_ratio: float


_NO_FIT = DelayFit(
    delay_s=float("nan"),
    standard_error_s=float("nan"),
    ratio=float("nan"),
    natural_hz=float("nan"),
    damping_ratio=float("nan"),
)


def _model(parameters: Array, omega: Array) -> ComplexArray:
    log_ratio, log_natural, log_zeta, delay = parameters
    x = 1j * omega / np.exp(log_natural)
    return np.asarray(
        np.exp(log_ratio - 1j * omega * delay) / (x**2 + 2.0 * np.exp(log_zeta) * x + 1.0)
    )


def _fit(
    omega: Array, response: ComplexArray, weight: Array, start: Array
) -> tuple[Array, Array, Array]:
    """Parameters, residuals and Jacobian at the optimum."""

    def residual(parameters: Array) -> Array:
        off = np.log(response / _model(parameters, omega))
        return np.asarray(np.concatenate([weight * off.real, weight * off.imag]))

    found = least_squares(residual, start, x_scale=[0.1, 0.1, 0.1, 1e-3], method="trf")
    return np.asarray(found.x), np.asarray(found.fun), np.asarray(found.jac)


def fit_delay(response: FrequencyResponse, *, max_hz: float = 25.0) -> DelayFit:
    """Fit joint and delay to the coherent part of a response.

    Args:
        response: The response; frequencies of coherence below 0.8 take no part, the rest weigh
            `coherence / (1 - coherence)`.
        max_hz: Highest frequency that takes part [Hz].

    Returns:
        The fit; all NaN if fewer than eight frequencies are left.
    """
    use = (
        (response.coherence >= _COHERENT)
        & (response.frequency_hz <= max_hz + 1e-9)
        & (response.gain > 0.0)
    )
    if int(use.sum()) < _FEWEST:
        return _NO_FIT
    omega, values = response.omega[use], response.response[use]
    coherence = response.coherence[use]
    weight = np.sqrt(coherence / np.maximum(1.0 - coherence, _FLOOR))
    weight = weight / weight.mean()
    # The natural frequency is near where the phase passes -90 degrees.
    phase = np.unwrap(np.angle(values))
    natural = float(omega[int(np.argmin(np.abs(phase + np.pi / 2.0)))])
    start = np.array([np.log(abs(values[0])), np.log(natural), np.log(0.7), 0.0])
    best, residual, jacobian = _fit(omega, values, weight, start)
    if len(response.repeats) >= 3:
        each = [_fit(omega, row[use], weight, best)[0][3] for row in response.repeats]
        error = float(np.std(each, ddof=1) / np.sqrt(len(each)))
    else:
        variance = float(residual @ residual) / (len(residual) - len(best))
        error = float(np.sqrt(variance * np.linalg.pinv(jacobian.T @ jacobian)[3, 3]))
    return DelayFit(
        delay_s=float(best[3]),
        standard_error_s=error,
        ratio=float(np.exp(best[0])),
        natural_hz=float(np.exp(best[1]) / (2.0 * np.pi)),
        damping_ratio=float(np.exp(best[2])),
    )
