"""A learned actuator read as a drive: stiffness, damping, delay and limits of its torque.

An actuator network computes the torque of a joint from position errors and joint velocities of now
and of earlier samples (Hwangbo et al., Learning agile and dynamic motor skills for legged robots,
2019). Near rest it is linear,

    torque = sum_i k_i e(t - a_i T) - sum_i c_i v(t - a_i T),

with ages `a_i` in samples and the time `T` between two samples; an error is the target less the
position. While the target stands still the error was larger by `a_i T v` at the earlier sample, so
that to first order in `T`

    stiffness K = sum k_i,  delay = T sum a_i k_i / K,  damping = sum c_i - T sum a_i k_i,

which is the drive `torque = K (target(t - delay) - position) - damping velocity`. A network that
was trained with one `T` and is used with another has another damping and another delay. Where a
simulator computes the torque at the start of each step `T`, velocity before position, this is exact
for an age of one sample: gains of law E of `pronk.robots.drive_law` at that step.
"""

from __future__ import annotations

import math
import re
import zipfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.optimize import brentq

from pronk.arrays import Array, ComplexArray
from pronk.errors import PronkError
from pronk.files import check_archive

ErrorSign = Literal["auto", "target-less-position", "position-less-target"]
"""What a position error of a network's input is; `auto` for the one whose torque acts towards the
target."""
InputOrder = Literal["position-first", "velocity-first"]
"""Whether all position errors or all velocities come first in a network's input."""

SMALL_ERROR_RAD = 1e-3
"""Position error at which the gains at rest are taken [rad]: a hundredth of usual errors, and large
enough for a network in single precision."""
SMALL_SPEED = 1e-2
"""Joint velocity at which the damping at rest is taken [rad/s]."""
ERRORS_RAD = (0.05, 0.1, 0.2, 0.5, 1.0)
"""Position errors of the table away from rest [rad]."""
SPEEDS = (0.5, 1.0, 2.0, 5.0, 10.0)
"""Joint velocities of the table away from rest [rad/s]."""
LARGEST_ERROR_RAD = 2.0 * math.pi
"""Position error up to which the largest torque is looked for [rad]: a turn."""
LARGEST_OFFSET = 0.1
"""Torque at rest over that at an error of `OFFSET_ERROR_RAD` above which the input is taken for
misread."""
OFFSET_ERROR_RAD = 0.1
"""Position error of the torque that an offset is compared with [rad]."""
LONGEST_DECAY_S = 1.0
"""Damping over stiffness above which errors and velocities are taken for exchanged [s]; drives of
robots have 0.01 to 0.1 s."""
MOST_SAMPLES = 1000
"""Most samples in the input of a network."""

PLAIN_OPERATIONS = frozenset(
    re.findall(
        r"\w+",
        """
        abs add addmm atan batch_norm bmm cat ceil celu chunk clamp clamp_max clamp_min clone
        contiguous cos cosh detach dim div dropout elu eq erf exp expand expand_as expm1 flatten
        floor format full ge gelu glu gt hardsigmoid hardswish hardtanh layer_norm le leaky_relu len
        linear log log1p logsigmoid lt matmul max maximum mean min minimum mm mul narrow ne neg
        numel ones ones_like permute pow prelu reciprocal relu relu6 reshape rsqrt rsub select selu
        sigmoid sign silu sin sinh size slice softmax softplus softsign split sqrt square squeeze
        stack std sub sum t tan tanh tensor threshold to transpose type_as unbind unsqueeze var view
        where zeros zeros_like __and__ __contains__ __getitem__ __is__ __isnot__ __not__ __or__ Bool
        Float Int append
        """,
    )
)
"""Operations of PyTorch (namespace `aten`) that a network may contain: all of them compute numbers
from numbers. Others, such as `save`, write files when the network runs."""
PLAIN_STATEMENTS = frozenset(
    re.findall(
        r"\w+",
        """
        Constant GetAttr If ListConstruct ListUnpack TupleConstruct TupleUnpack TupleIndex
        RaiseException Uninitialized NumToTensor unchecked_cast unchecked_unwrap_optional dtype
        device layout annotate
        """,
    )
)
"""Statements of TorchScript (namespace `prim`) that a network may contain; loops are none of
them."""
RECURRENT_OPERATIONS = ("aten::lstm", "aten::gru", "aten::rnn_tanh", "aten::rnn_relu")
"""Operations of networks with a state of their own."""


@dataclass(frozen=True, kw_only=True)
class NetworkInput:
    """How the input of a network is made of position errors and joint velocities."""

    order: InputOrder = "position-first"
    """What comes first."""
    ages: tuple[int, ...] = ()
    """Ages of the samples in the order of the input [samples]; 0, 1, 2, ... if empty."""
    error: ErrorSign = "auto"
    """What a position error is."""
    position_scale: float = 1.0
    """Factor on the position errors before they enter the network, above 0."""
    velocity_scale: float = 1.0
    """Factor on the velocities before they enter the network."""
    torque_scale: float = 1.0
    """Factor on the output of the network, which makes it a torque in N m."""

    def __post_init__(self) -> None:
        """Refuse scales and ages that cannot be."""
        scales = {
            "--position-scale": self.position_scale,
            "--velocity-scale": self.velocity_scale,
            "--torque-scale": self.torque_scale,
        }
        for option, scale in scales.items():
            if not math.isfinite(scale) or scale == 0.0:
                raise PronkError(f"{option} {scale:g}; expected a finite number that is not 0.")
        if self.position_scale < 0.0:
            raise PronkError(
                f"--position-scale {self.position_scale:g}; expected a number above 0. For a "
                "position error of the other sign give --error position-less-target."
            )
        if any(age < 0 for age in self.ages) or len(set(self.ages)) < len(self.ages):
            raise PronkError(
                f"--ages {','.join(map(str, self.ages))}; expected the age of each sample once, 0 "
                "for the present one, as in 0,1,2."
            )


@dataclass(frozen=True, kw_only=True)
class GainsAtStep:
    """The drive that a network is near rest, when its samples are some time apart."""

    step_s: float
    """Time between two samples [s]."""
    stiffness: float
    """Stiffness [N m/rad]."""
    damping: float
    """Damping [N m s/rad]."""
    delay_s: float
    """Time by which the target acts late [s]."""


@dataclass(frozen=True, kw_only=True)
class SampleGains:
    """An actuator network near rest: torque by each sample of its input."""

    ages: tuple[int, ...]
    """Ages of the samples [samples]."""
    error_gains: tuple[float, ...]
    """Torque by each position error, target less position [N m/rad]."""
    velocity_gains: tuple[float, ...]
    """Torque against each velocity [N m s/rad]."""

    @property
    def stiffness(self) -> float:
        """Stiffness [N m/rad]."""
        return sum(self.error_gains)

    def at_step(self, step_s: float) -> GainsAtStep:
        """Return the drive when the samples are some time apart [s]."""
        aged = float(np.dot(self.ages, self.error_gains))
        return GainsAtStep(
            step_s=step_s,
            stiffness=self.stiffness,
            damping=sum(self.velocity_gains) - step_s * aged,
            delay_s=step_s * aged / self.stiffness,
        )

    def response(self, hz: Array, inertia: float, step_s: float) -> ComplexArray:
        """Return the response of a joint with this drive, shape (f,).

        The delays of the samples are exact here, and the joint moves in continuous time.

        Args:
            hz: Frequencies [Hz], shape (f,).
            inertia: Inertia of the joint with its rotor [kg m^2].
            step_s: Time between two samples [s].
        """
        s = 2j * np.pi * hz
        delays = np.exp(-np.outer(s, np.array(self.ages)) * step_s)
        pull = delays @ np.array(self.error_gains)
        drag = delays @ np.array(self.velocity_gains)
        return np.asarray(pull / (inertia * s**2 + drag * s + pull))


@dataclass(frozen=True, kw_only=True)
class NetworkDrive:
    """An actuator network, read as a drive."""

    error: ErrorSign
    """What a position error of its input is: as stated, or as found."""
    gains: SampleGains
    """Torque by each sample near rest."""
    offset: float
    """Torque at rest without an error [N m]."""
    stiffness_at: dict[float, float]
    """Stiffness by the size of a lasting error [rad]: half of the difference of the torques at plus
    and minus the error, over the error [N m/rad]."""
    damping_at: dict[float, float]
    """Damping by a lasting speed [rad/s], at the step of the simulator [N m s/rad]."""
    lowest_torque: float
    """Lowest torque of a joint at rest, at any error up to a turn [N m]."""
    highest_torque: float
    """Highest torque of a joint at rest, at any error up to a turn [N m]."""
    linear_to_rad: float
    """Error at which the torque has fallen to 0.9 of stiffness times error [rad]; NaN where it does
    not within a turn."""
    trained: GainsAtStep
    """The drive near rest with the time between two samples of its training."""
    used: GainsAtStep
    """The drive near rest with the time between two samples that it is used with."""

    @property
    def by_step(self) -> tuple[GainsAtStep, ...]:
        """The drive with the time of the training, of the use, and half of each, longest first."""
        steps = {self.trained.step_s, self.used.step_s}
        for step_s in tuple(steps):
            steps.add(0.5 * step_s)
        return tuple(self.gains.at_step(step_s) for step_s in sorted(steps, reverse=True))


def compared_db(
    network: SampleGains, gains: tuple[float, float], inertia: float, step_s: float
) -> float:
    """Return by how much a joint with the network differs from one with gains, from 0.5 to 15 Hz.

    Args:
        network: The network near rest.
        gains: Stiffness [N m/rad] and damping [N m s/rad] of the other drive, without delay.
        inertia: Inertia of the joint with its rotor [kg m^2].
        step_s: Time between two samples [s].

    Returns:
        Root mean square of the difference of the gains over logarithmic frequency [dB].
    """
    hz = np.geomspace(0.5, 15.0, 200)
    s = 2j * np.pi * hz
    stiffness, damping = gains
    other = stiffness / (inertia * s**2 + damping * s + stiffness)
    difference_db = 20.0 * np.log10(np.abs(network.response(hz, inertia, step_s) / other))
    return float(np.sqrt(np.mean(difference_db**2)))


def probe_network(
    path: Path,
    *,
    history_s: float,
    step_s: float,
    network_input: NetworkInput | None = None,
) -> NetworkDrive:
    """Read an actuator network as a drive.

    Args:
        path: The network, TorchScript with one input of shape (n, 2 samples).
        history_s: Time between two samples that it was trained with [s].
        step_s: Time between two samples that it is used with [s].
        network_input: How its input is made; as of walk-these-ways if None.

    Raises:
        PronkError: The file is no such network, or its torque does not act like that of a drive.
    """
    for option, seconds in (("--history", history_s), ("--step", step_s)):
        if not 0.0 < seconds <= 1.0:
            raise PronkError(
                f"{option} {seconds:g}; expected the time between two samples in s, above 0 and at "
                "most 1, as in 0.02."
            )
    stated = network_input or NetworkInput()
    torque = _Torque(load_torchscript(path), path, stated)
    offset = torque.at_rest(np.zeros(1))[0]
    sides = np.array([SMALL_ERROR_RAD, -SMALL_ERROR_RAD])
    slope = float(np.diff(torque.at_rest(sides))[0] / np.diff(sides)[0])
    error: ErrorSign = stated.error
    if error == "auto":
        error = "target-less-position" if slope > 0.0 else "position-less-target"
    torque.error_sign = 1.0 if error == "target-less-position" else -1.0
    _check_sign(torque, path, error, stated)

    samples = torque.samples
    error_gains = []
    velocity_gains = []
    for sample in range(samples):
        one = np.zeros(samples)
        one[sample] = 1.0
        none = np.zeros(samples)
        pulls = torque(
            np.array([SMALL_ERROR_RAD * one, -SMALL_ERROR_RAD * one]), np.array([none, none])
        )
        drags = torque(np.array([none, none]), np.array([SMALL_SPEED * one, -SMALL_SPEED * one]))
        error_gains.append(float(pulls[0] - pulls[1]) / (2.0 * SMALL_ERROR_RAD))
        velocity_gains.append(float(drags[1] - drags[0]) / (2.0 * SMALL_SPEED))
    torques = torque.at_rest(np.linspace(-LARGEST_ERROR_RAD, LARGEST_ERROR_RAD, 1257))
    gains = SampleGains(
        ages=torque.ages,
        error_gains=tuple(error_gains),
        velocity_gains=tuple(velocity_gains),
    )
    if not gains.stiffness > 0.0:
        raise PronkError(
            f"{path}: its stiffness near rest is {gains.stiffness:.3g} N m/rad with --error "
            f"{error}; expected one above 0. Give --error auto, or another --order."
        )
    return NetworkDrive(
        error=error,
        gains=gains,
        offset=float(offset),
        stiffness_at=_stiffness_at(torque),
        damping_at=_damping_at(torque, step_s),
        lowest_torque=float(torques.min()),
        highest_torque=float(torques.max()),
        linear_to_rad=_linear_to(torque, gains.stiffness),
        trained=gains.at_step(history_s),
        used=gains.at_step(step_s),
    )


def _check_sign(torque: _Torque, path: Path, error: ErrorSign, stated: NetworkInput) -> None:
    """Refuse a network whose torque does not change sign with the error."""
    for size in ERRORS_RAD[1:3]:
        forward, backward = torque.at_rest(np.array([size, -size])).tolist()
        if forward > 0.0 > backward:
            continue
        raise PronkError(
            f"{path}: at errors of {size:g} and -{size:g} rad (target less position) its torque is "
            f"{forward:.3g} and {backward:.3g} N m; expected one towards the target, of the sign "
            f"of the error. The input was made with --order {stated.order}, --error {error}, "
            f"--position-scale {stated.position_scale:g} and --torque-scale "
            f"{stated.torque_scale:g}; give others, or --ages if the samples are others."
        )


def _stiffness_at(torque: _Torque) -> dict[float, float]:
    """Return the stiffness at lasting errors of several sizes."""
    stiffness = {}
    for size in ERRORS_RAD:
        forward, backward = torque.at_rest(np.array([size, -size])).tolist()
        stiffness[size] = (forward - backward) / (2.0 * size)
    return stiffness


def _damping_at(torque: _Torque, step_s: float) -> dict[float, float]:
    """Return the damping at lasting speeds, as the joint passes a target that stands still."""
    damping = {}
    for speed in SPEEDS:
        errors = speed * step_s * np.array(torque.ages)
        speeds = np.full(torque.samples, speed)
        forward, backward = torque(np.array([errors, -errors]), np.array([speeds, -speeds]))
        damping[speed] = float(backward - forward) / (2.0 * speed)
    return damping


def _linear_to(torque: _Torque, stiffness: float) -> float:
    """Return the error at which the torque has fallen to 0.9 of stiffness times error [rad]."""

    def excess(error: float) -> float:
        forward, backward = torque.at_rest(np.array([error, -error])).tolist()
        return float(0.5 * (forward - backward) - 0.9 * stiffness * error)

    errors = np.linspace(0.02, LARGEST_ERROR_RAD, 315)
    for first, second in zip(errors[:-1].tolist(), errors[1:].tolist(), strict=True):
        if excess(first) > 0.0 >= excess(second):
            return float(brentq(excess, first, second, xtol=1e-4))
    return math.nan


def network_faults(drive: NetworkDrive) -> dict[str, str]:
    """Name what says that the input of a network is not made as stated, or not as in training.

    Returns:
        A word for each fault, and a sentence.
    """
    faults = {}
    gains = drive.gains
    trained = drive.trained
    used = drive.used
    at_error = gains.stiffness * OFFSET_ERROR_RAD
    if abs(drive.offset) > LARGEST_OFFSET * at_error:
        faults["offset"] = (
            f"its torque at rest without an error is {drive.offset:.3g} N m, which is that of an "
            f"error of {drive.offset / gains.stiffness:.2g} rad; expected about 0: is the input "
            "scaled or shifted otherwise?"
        )
    velocity_gain = sum(gains.velocity_gains)
    if abs(velocity_gain) > LONGEST_DECAY_S * gains.stiffness:
        faults["order"] = (
            f"its damping, {velocity_gain:.3g} N m s/rad, is {velocity_gain / gains.stiffness:.2g} "
            "s times its stiffness, where drives have 0.01 to 0.1 s: do the velocities come first "
            "(--order velocity-first), or have --position-scale and --velocity-scale other values?"
        )
    elif velocity_gain < 0.0:
        faults["velocity"] = (
            f"its torque grows with the velocity, by {-velocity_gain:.3g} N m s/rad; a drive "
            "brakes: give --velocity-scale the other sign if the network takes it so"
        )
    if velocity_gain >= 0.0 and trained.damping < 0.0:
        faults["undamped"] = (
            f"at {1e3 * trained.step_s:g} ms, with which it was trained, its damping is "
            f"{trained.damping:.3g} N m s/rad; expected one above 0: is --history right?"
        )
    change = abs(used.damping - trained.damping)
    if trained.damping > 0.0 and change > 0.05 * trained.damping:
        faults["step"] = (
            f"it was trained with samples {1e3 * trained.step_s:g} ms apart and is used with "
            f"{1e3 * used.step_s:g} ms: the damping is {used.damping:.3g} N m s/rad instead of "
            f"{trained.damping:.3g}, and the delay {1e3 * used.delay_s:.3g} ms instead of "
            f"{1e3 * trained.delay_s:.3g}"
        )
    return faults


class _Torque:
    """Torque of a network by the position errors and velocities of a joint."""

    def __init__(self, network: Any, path: Path, stated: NetworkInput) -> None:
        """Find how many samples the network takes.

        Args:
            network: What `load_torchscript` returned.
            path: Its file, for messages.
            stated: How its input is made.
        """
        self._network = network
        self._path = path
        self._input = stated
        self.error_sign = 1.0
        """1 where the network takes the target less the position, -1 for the opposite."""
        self.samples = self._count_samples()
        """Samples of each quantity in the input."""
        self.ages = stated.ages or tuple(range(self.samples))
        """Ages of the samples [samples]."""
        if len(self.ages) != self.samples:
            raise PronkError(
                f"{path}: it takes {self.samples} position errors and as many velocities, and "
                f"--ages names {len(self.ages)} samples; expected {self.samples} ages."
            )

    def __call__(self, errors: Array, velocities: Array) -> Array:
        """Return the torque [N m], shape (n,).

        Args:
            errors: Target less position at each sample [rad], shape (n, samples).
            velocities: Joint velocity at each sample [rad/s], shape (n, samples).
        """
        stated = self._input
        errors = self.error_sign * stated.position_scale * errors
        velocities = stated.velocity_scale * velocities
        parts = [errors, velocities]
        if stated.order == "velocity-first":
            parts.reverse()
        output = self._run(np.concatenate(parts, axis=1))
        if output is None or not np.isfinite(output).all():
            raise PronkError(
                f"{self._path}: it returned no finite number for each row of its input; expected "
                "one torque a joint."
            )
        return np.asarray(stated.torque_scale * output)

    def at_rest(self, errors: Array) -> Array:
        """Return the torque of a joint at rest whose error lasts [N m], shape (n,)."""
        lasting = np.repeat(np.asarray(errors)[:, None], self.samples, axis=1)
        return self(lasting, np.zeros_like(lasting))

    def _run(self, rows: Array) -> Array | None:
        """Return the outputs of the network, shape (n,); None where it does not take the rows."""
        import torch

        try:
            with torch.no_grad():
                output = self._network(torch.tensor(rows, dtype=torch.float32))
            values = output.detach().double().numpy()
        except Exception:
            # What the interpreter of TorchScript raises depends on the operation that fails.
            return None
        return np.asarray(values).reshape(-1) if values.size == len(rows) else None

    def _count_samples(self) -> int:
        """Return how many samples the network takes: half of the width of its input."""
        widths: Iterable[int] = range(1, 65)
        if self._input.ages:
            widths = (len(self._input.ages), *widths)
        for samples in widths:
            if samples <= MOST_SAMPLES and self._run(np.zeros((3, 2 * samples))) is not None:
                return samples
        raise PronkError(
            f"{self._path}: it takes no input of shape (rows, 2 samples) and returns one number a "
            "row, for 1 to 64 samples; expected position errors and velocities of now and of "
            "earlier samples."
        )


def load_torchscript(path: Path) -> Any:
    """Load a network of TorchScript, in evaluation mode, without running code of others.

    The archive of TorchScript holds the network as text in a language of its own, and PyTorch's
    reader of its pickles makes tensors and lists alone. That language can write files, so that each
    operation of the network is looked at before it runs. A file without that text, such as one of
    `torch.save`, is not opened by PyTorch at all.

    Raises:
        PronkError: PyTorch is not installed, or the file is no such network.
    """
    expected = "expected a network of TorchScript, saved by torch.jit.save"
    try:
        check_archive(path, PronkError)
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
            texts = []
            for name in names:
                if "/code/" in name and name.endswith(".py"):
                    texts.append(archive.read(name).decode())
            damaged = archive.testzip()
    except PronkError:
        raise
    except FileNotFoundError:
        raise PronkError(f"{path}: no such file.") from None
    except OSError as error:
        raise PronkError(f"{path}: cannot be read ({error.strerror or error}).") from None
    except Exception as error:
        # zipfile and zlib fail in many ways on another file.
        reason = type(error).__name__
        raise PronkError(f"{path}: not a zip archive ({reason}); {expected}.") from None
    if damaged is not None:
        raise PronkError(f"{path}: the checksum of its part {damaged!r} does not fit.")
    if not texts or not any(name.endswith("/constants.pkl") for name in names):
        raise PronkError(
            f"{path}: a file of PyTorch without TorchScript, which was not opened, as that can run "
            f"code of the file; {expected}, as of torch.jit.script(network)."
        )
    if any("__setstate__" in text or "__getstate__" in text for text in texts):
        raise PronkError(
            f"{path}: its code runs as it is loaded (__setstate__), and was not run; {expected}."
        )
    try:
        import torch
    except ImportError:
        raise PronkError(
            f"{path}: networks of TorchScript are read by PyTorch, which is not installed; install "
            "pronk[train]."
        ) from None
    try:
        network: Any = torch.jit.load(str(path), map_location="cpu")
        graph = network.inlined_graph
    except Exception as error:
        raise PronkError(
            f"{path}: PyTorch cannot load it ({type(error).__name__}: "
            f"{' '.join(str(error).split())[:80]}); {expected}."
        ) from None
    foreign = sorted(set(_foreign_operations(graph)))
    recurrent = [kind for kind in foreign if kind in RECURRENT_OPERATIONS]
    if recurrent:
        raise PronkError(
            f"{path}: it contains {', '.join(recurrent)}: a network with a state of its own (LSTM, "
            "GRU) is no function of its last samples, and cannot be read; expected a network "
            "without one."
        )
    if foreign:
        raise PronkError(
            f"{path}: it contains {', '.join(foreign[:5])}, and was not run: an actuator network "
            "computes a torque from its input by plain arithmetic, without loops or files."
        )
    return network.eval()


def _foreign_operations(block: Any) -> Sequence[str]:
    """Return the operations of a graph, or a block of it, that are no plain arithmetic."""
    foreign = []
    for node in block.nodes():
        kind = node.kind()
        namespace, _, name = kind.partition("::")
        plain = namespace == "prim" and name in PLAIN_STATEMENTS
        if namespace == "aten":
            plain = name in PLAIN_OPERATIONS or name.rstrip("_") in PLAIN_OPERATIONS
        if not plain:
            foreign.append(kind)
        for inner in node.blocks():
            foreign.extend(_foreign_operations(inner))
    return foreign
