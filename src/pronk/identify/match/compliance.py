"""A compliance between motor and link, told from everything else that a response may be made by.

Where no gains match, the measured response is compared with closed forms: a rigid joint, and what
else is linear (`OTHER_FORMS`), and a motor that drives its link through a spring (`TWO_MASSES`).
Every form has stiffness, damping, dry friction and delay free, and one or two numbers of its own.
Dry friction F is a relay, with the describing function `4 F / (pi omega |q|)` at the measured
amplitude |q| (Gelb and Vander Velde, *Multiple-Input Describing Functions*, 1968, appendix B).

A compliance is named only where it explains what the others do not: every second block of
frequencies is kept out of the fits, and there it misses by `EXPLAINED_DB` at most and by less than
`CLEARLY` of the best of the others, and its stiffness is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from pronk.arrays import Array, ComplexArray, Mask
from pronk.identify.match.measured import DB
from pronk.identify.match.result import NO_MATCH
from pronk.identify.response.response import FrequencyResponse

COMPLIANCE = "compliance: "
"""Beginning of the flag on a compliance between motor and link."""
OTHER_FORMS = (
    "rigid",
    "scale of the position",
    "filter of position or command",
    "filter in the loop",
    "slow speed",
    "slow torque",
    "integral part",
    "feed-forward of the speed",
    "pull of gravity",
)
"""Linear mechanisms that a compliance is told from."""
TWO_MASSES = ("motor", "link", "link and its speed", "link beside the loop")
"""Where the encoder is: at the motor, at the link with the speed of the motor or of the link, or at
the link while the drive uses another at the motor."""
EXPLAINED_DB = 0.8
"""Error of a compliance on the held-out frequencies below which it explains the response [dB]:
below what counts as no match."""
CLEARLY = 0.33
"""Error of a compliance over that of the best other form, below which it is told from it. Over the
mechanisms of `tests/joint_mechanisms.py` (63, seed 2) it is 0.02 to 0.25 for a compliance in the
band, 0.47 or more for anything else."""
LEAST_OTHER_DB = 0.1
"""Error of the best other form below which nothing needs to be explained [dB]: the hold of the
command and the jitter of a log are as large."""
KNOWN = 0.2
"""Largest relative deviation of a stiffness that is known."""
BLOCK = 3
"""Frequencies in a block: those within a window of the estimator share its noise."""
FEWEST = 18
"""Fewest frequencies that tell forms of six numbers apart: twice as many in the fit as numbers."""
LEAST_DEVIATION = 0.02
"""Least relative deviation of a response: friction and sampling are not in the closed forms."""
SPRINGS = (0.3, 1.0, 3.0)
"""Stiffnesses at which the search of a compliance begins, over that of the drive."""


@dataclass(frozen=True, kw_only=True)
class JointDynamics:
    """What the robot's model says of a joint, and the gains stated for its drive."""

    motor_inertia: float
    """Inertia of the rotor at the joint [kg m^2]."""
    link_inertia: float
    """Inertia of what it moves [kg m^2]."""
    pull: float
    """How much gravity pulls the link back [N m/rad]."""
    stiffness: float
    """Nominal stiffness of the drive [N m/rad]."""
    damping: float
    """Nominal damping of the drive [N m s/rad]."""


@dataclass(frozen=True, kw_only=True)
class FormFit:
    """A closed form fitted to a response."""

    x: Array
    """Numbers of the fit, as `form_response` takes them."""
    error_db: float
    """Root mean square error on the held-out frequencies, phase included [dB]."""
    deviation: Array
    """Standard deviation of the numbers."""


def form_response(
    form: str, x: Array, omega: Array, q: Array, joint: JointDynamics
) -> ComplexArray:
    """Compute the response of a closed form.

    Args:
        form: One of `OTHER_FORMS` or `TWO_MASSES`.
        x: Logarithms of stiffness and damping over the nominal ones, of the dry friction over the
            nominal stiffness [rad], and delay [s]; then the logarithms of the form's own numbers.
        omega: Angular frequencies [rad/s], shape (f,).
        q: Measured amplitude of the position [rad], shape (f,).
        joint: The joint.

    Returns:
        The response, shape (f,).
    """
    s = 1j * omega
    stiffness = joint.stiffness * np.exp(x[0])
    damping = joint.damping * np.exp(x[1])
    relay = 4.0 * joint.stiffness * np.exp(x[2]) / (np.pi * omega * q)
    late = np.exp(-s * x[3])
    inertia = joint.motor_inertia + joint.link_inertia
    if form in TWO_MASSES:
        spring = joint.stiffness * np.exp(x[4]) + s * joint.damping * np.exp(x[5])
        link = joint.link_inertia * s**2 + joint.pull + spring
        motor = joint.motor_inertia * s**2 + s * (damping + relay) + spring
        if form == "link":
            # The drive has the position of the link and the speed of the motor.
            determinant = link * motor + spring * (stiffness - spring)
            return np.asarray(late * stiffness * spring / determinant)
        if form == "link and its speed":
            free_motor = motor - s * damping
            determinant = link * free_motor + spring * (stiffness + s * damping - spring)
            return np.asarray(late * stiffness * spring / determinant)
        determinant = link * (motor + stiffness) - spring**2
        if form == "motor":
            return np.asarray(late * stiffness * link / determinant)
        return np.asarray(late * stiffness * spring / determinant)
    own = float(np.exp(x[4])) if len(x) > 4 else 0.0
    forward = stiffness + 0.0 * s
    back = stiffness + s * damping
    pull = joint.pull
    factor = late
    lag = 1.0 / (1.0 + s * own * damping / stiffness)
    if form == "scale of the position":
        factor = late * own
    elif form == "filter of position or command":
        factor = late * lag
    elif form == "filter in the loop":
        back = back * lag
        factor = late * lag
    elif form == "slow speed":
        back = stiffness + s * damping * lag
    elif form == "slow torque":
        back = back * lag
        forward = forward * lag
    elif form == "integral part":
        forward = forward + own * stiffness**2 / damping / s
        back = back + own * stiffness**2 / damping / s
    elif form == "feed-forward of the speed":
        forward = forward + s * damping * own
    elif form == "pull of gravity":
        pull = joint.stiffness * own
    return np.asarray(factor * forward / (inertia * s**2 + s * relay + back + pull))


def fit_form(
    form: str,
    response: ComplexArray,
    omega: Array,
    deviation: Array,
    amplitude: float,
    joint: JointDynamics,
) -> FormFit:
    """Fit a closed form to every second block of frequencies, and judge it on the others.

    Args:
        form: One of `OTHER_FORMS` or `TWO_MASSES`.
        response: Measured response, shape (f,).
        omega: Angular frequencies [rad/s], shape (f,).
        deviation: Relative deviation of the response, shape (f,).
        amplitude: Amplitude of the command [rad].
        joint: The joint.
    """
    q = amplitude * np.abs(response)
    training = np.arange(len(omega)) // BLOCK % 2 == 0

    def difference(x: Array, chosen: Mask) -> Array:
        with np.errstate(all="ignore"):
            model = form_response(form, x, omega[chosen], q[chosen], joint)
            error = np.log(model / response[chosen])
        # The logarithm leaves whole turns of the phase out.
        parts = np.concatenate([error.real, error.imag])
        return np.asarray(np.nan_to_num(parts, nan=10.0, posinf=10.0, neginf=-10.0))

    weight = np.tile(1.0 / deviation[training], 2)

    def weighted(x: Array) -> Array:
        return np.asarray(weight * difference(x, training))

    start = [0.0, 0.0, np.log(0.02 * amplitude), 0.005]
    starts = [start]
    if form in TWO_MASSES:
        starts = []
        for spring in SPRINGS:
            starts.append([*start, np.log(spring), np.log(0.05)])
    elif form != "rigid":
        starts = [[*start, np.log(0.3)]]
        if form == "scale of the position":
            starts = [[*start, 0.0]]
    low = np.full(len(starts[0]), -5.0)
    high = np.full(len(starts[0]), 5.0)
    low[2] = np.log(1e-4 * amplitude)
    high[2] = np.log(amplitude)
    low[3] = -0.03
    high[3] = 0.1
    best = None
    for x in starts:
        fit = least_squares(
            weighted,
            x,
            bounds=(low, high),
            x_scale=np.where(np.arange(len(x)) == 3, 0.005, 0.3),
            loss="soft_l1",
            max_nfev=60,
        )
        if best is None or fit.cost < best.cost:
            best = fit
    assert best is not None
    held_out = difference(best.x, ~training)
    freedom = max(len(weight) - len(best.x), 1)
    variance = 2.0 * best.cost / freedom
    jacobian = np.asarray(best.jac)
    covariance = variance * np.linalg.pinv(jacobian.T @ jacobian)
    return FormFit(
        x=np.asarray(best.x),
        error_db=float(DB * np.sqrt(np.mean(held_out**2))),
        deviation=np.sqrt(np.abs(np.diag(covariance))),
    )


def find_compliance(measured: FrequencyResponse, used: Mask, joint: JointDynamics) -> str:
    """Say that a response is that of a compliance between motor and link, where it can be told.

    Args:
        measured: Measured response of a joint that no gains match.
        used: Frequencies that the match compares, shape (f,).
        joint: The joint.

    Returns:
        A flag that begins with `NO_MATCH` and `COMPLIANCE`; empty if the response does not tell it.
    """
    if int(used.sum()) < FEWEST:
        return ""
    response = measured.response[used]
    omega = measured.omega[used]
    deviation = np.maximum(measured.deviation()[used], LEAST_DEVIATION)

    def fits_of(forms: Sequence[str]) -> list[FormFit]:
        fits = []
        for form in forms:
            fits.append(fit_form(form, response, omega, deviation, measured.amplitude, joint))
        return fits

    compliant = min(fits_of(TWO_MASSES), key=lambda fit: fit.error_db)
    if compliant.error_db > EXPLAINED_DB:
        return ""
    other_db = min(fit.error_db for fit in fits_of(OTHER_FORMS))
    if other_db < LEAST_OTHER_DB or compliant.error_db > CLEARLY * other_db:
        return ""
    if compliant.deviation[4] > KNOWN:
        return ""
    spring = joint.stiffness * float(np.exp(compliant.x[4]))
    low = spring * float(np.exp(-2.0 * compliant.deviation[4]))
    high = spring * float(np.exp(2.0 * compliant.deviation[4]))
    return (
        f"{NO_MATCH}{COMPLIANCE}the model lacks a compliance between motor and link, of "
        f"{spring:.3g} N m/rad ({low:.3g} to {high:.3g}): with it motor and link miss the response "
        f"by {compliant.error_db:.2g} dB where they were not fitted, the best other explanation by "
        f"{other_db:.2g} dB; match below the resonance (band_hz of the robot's file), or with a "
        "model that has this joint twice"
    )
