"""`pronk probe NET.pt`: networks of known gains are read as those gains, and no file runs code."""

from __future__ import annotations

import json
import os
import pickle
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq

torch = pytest.importorskip("torch")

from command_line import invoke, refused

pytestmark = [
    pytest.mark.train,
    pytest.mark.filterwarnings("ignore:.*torch.jit.*deprecated:DeprecationWarning"),
]

GO1 = Path(__file__).resolve().parents[3] / "shared" / "data" / "actuator_net" / "unitree_go1.pt"


class Saturated(torch.nn.Module):
    """Torque `limit tanh(linear / limit)`, linear in the inputs near rest."""

    def __init__(self, weights: Sequence[float], limit: float, bias: float = 0.0) -> None:
        super().__init__()
        self.linear = torch.nn.Linear(len(weights), 1)
        self.limit = limit
        with torch.no_grad():
            self.linear.weight.copy_(torch.tensor([list(weights)]))
            self.linear.bias.fill_(bias)

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        return self.limit * torch.tanh(self.linear(inputs) / self.limit)


class Writer(torch.nn.Module):
    """A network that writes a file as it runs."""

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        torch.save(inputs, "written")
        return inputs.sum(dim=1)


class Loop(torch.nn.Module):
    """A network that never returns."""

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        total = inputs.sum(dim=1)
        while bool(torch.isfinite(total).all()):
            total = total * 1.0
        return total


class Recurrent(torch.nn.Module):
    """A network with a state of its own."""

    def __init__(self) -> None:
        super().__init__()
        self.lstm = torch.nn.LSTM(2, 8)
        self.out = torch.nn.Linear(8, 1)

    def forward(
        self, inputs: torch.Tensor, state: tuple[torch.Tensor, torch.Tensor]
    ) -> torch.Tensor:
        hidden, _ = self.lstm(inputs, state)
        return self.out(hidden)


class CodeOnLoad:
    """An object whose pickle creates a file when it is loaded."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return (os.mkdir, (str(self.path),))


def saved(path: Path, module: torch.nn.Module) -> Path:
    torch.jit.script(module.eval()).save(str(path))
    return path


def linear(path: Path, weights: Sequence[float], limit: float = 30.0) -> Path:
    return saved(path, Saturated(weights, limit))


def figures_of(path: Path, *words: str) -> dict[str, Any]:
    out = path.with_suffix(".json")
    command = invoke(["probe", path, *words, "--json", out])
    assert command.exit_code == 0, command.output
    figures: dict[str, Any] = json.loads(out.read_text())
    figures["warnings"] = command.stderr
    return figures


@pytest.mark.parametrize("seed", range(4))
def test_gains_of_a_linear_network_are_found(tmp_path: Path, seed: int) -> None:
    """Any weights, order, sign, scales and ages; the closed form of stiffness, damping, delay."""
    rng = np.random.default_rng(seed)
    samples = int(rng.integers(1, 5))
    ages = np.sort(rng.choice(8, samples, replace=False))
    error_gains = rng.uniform(2.0, 20.0, samples)
    velocity_gains = rng.uniform(0.1, 0.3, samples) + 20.0 * samples * 0.02 * 8.0 / samples
    sign = rng.choice([-1.0, 1.0])
    position_scale, velocity_scale, torque_scale = rng.uniform(0.3, 3.0, 3)
    weights = [
        sign * error_gains / position_scale / torque_scale,
        -velocity_gains / velocity_scale / torque_scale,
    ]
    words = ["--history", "0.02", "--step", "0.005", "--ages", ",".join(map(str, ages))]
    if seed % 2:
        weights.reverse()
        words += ["--order", "velocity-first"]
    words += ["--position-scale", repr(float(position_scale))]
    words += ["--velocity-scale", repr(float(velocity_scale))]
    words += ["--torque-scale", repr(float(torque_scale))]
    path = linear(tmp_path / "network.pt", np.concatenate(weights).tolist(), limit=1e4)
    figures = figures_of(path, *words)
    aged = float(ages @ error_gains)
    for name, step_s in (("trained", 0.02), ("used", 0.005)):
        gains = figures[name]
        assert gains["step_s"] == step_s
        assert gains["stiffness"] == pytest.approx(error_gains.sum(), rel=2e-3)
        assert gains["damping"] == pytest.approx(
            velocity_gains.sum() - step_s * aged, rel=5e-3, abs=5e-3
        )
        assert gains["delay_s"] == pytest.approx(step_s * aged / error_gains.sum(), abs=2e-5)
    expected = "target-less-position" if sign > 0.0 else "position-less-target"
    assert figures["error"] == expected


def test_saturation_and_gains_away_from_rest_are_found(tmp_path: Path) -> None:
    stiffness, damping, limit = 20.0, 0.5, 12.0
    path = linear(tmp_path / "network.pt", [stiffness, 0.0, -damping, 0.0], limit)
    figures = figures_of(path, "--history", "0.01")
    assert figures["torque_limits"] == pytest.approx([-limit, limit], rel=1e-3)
    at_limit = brentq(lambda x: np.tanh(x) / x - 0.9, 1e-3, 5.0) * limit / stiffness
    assert figures["linear_to_rad"] == pytest.approx(at_limit, abs=5e-3)
    for error, secant in figures["stiffness_at"].items():
        true = limit * np.tanh(stiffness * float(error) / limit) / float(error)
        assert secant == pytest.approx(true, rel=1e-3)
    for speed, secant in figures["damping_at"].items():
        true = limit * np.tanh(damping * float(speed) / limit) / float(speed)
        assert secant == pytest.approx(true, rel=1e-3)
    assert "warning" not in figures["warnings"]


def test_a_joint_with_the_network_moves_as_one_with_the_gains(tmp_path: Path) -> None:
    """At a step of 5 ms, law E, the target a sample late."""
    weights = [0.0, 19.0, 0.0, -0.9, 0.0, 0.0]
    used = figures_of(
        linear(tmp_path / "network.pt", weights, limit=1e5), "--history", "0.02", "--step", "0.005"
    )["used"]
    step = 0.005
    inertia = 0.012
    command = 0.1 * np.sin(2.0 * np.pi * np.linspace(0.5, 8.0, 400).cumsum() * step)
    delayed = round(used["delay_s"] / step)
    positions = []
    for is_network in (True, False):
        position = 0.0
        velocity = 0.0
        error_before = 0.0
        trajectory = []
        for tick in range(len(command)):
            error = command[tick] - position
            torque = weights[1] * error_before + weights[3] * velocity
            if not is_network:
                target = command[max(tick - delayed, 0)] if tick >= delayed else 0.0
                torque = used["stiffness"] * (target - position) - used["damping"] * velocity
            error_before = error
            velocity += step * torque / inertia
            position += step * velocity
            trajectory.append(position)
        positions.append(np.array(trajectory))
    assert np.ptp(positions[0]) > 0.1
    assert np.abs(positions[0] - positions[1]).max() < 0.01 * np.ptp(positions[0])


def test_the_comparison_is_that_of_two_second_order_joints(tmp_path: Path) -> None:
    path = linear(tmp_path / "network.pt", [18.0, -0.8], limit=1e5)
    words = ("--history", "0.005", "--drive-gains", "20,.5", "--inertia", "0.015")
    (row,) = figures_of(path, *words)["compared"]
    hz = np.geomspace(0.5, 15.0, 400)
    s = 2j * np.pi * hz
    network = 18.0 / (0.015 * s**2 + 0.8 * s + 18.0)
    drive = 20.0 / (0.015 * s**2 + 0.5 * s + 20.0)
    true = np.sqrt(np.mean((20.0 * np.log10(np.abs(network / drive))) ** 2))
    assert row["inertia"] == 0.015
    assert row["used_db"] == pytest.approx(true, rel=0.02)
    assert figures_of(path, "--history", "0.005", "--drive-gains", "18,.8")["compared"][0][
        "used_db"
    ] == pytest.approx(0.0, abs=0.01)


def test_what_is_not_as_stated_is_named(tmp_path: Path) -> None:
    network = [0.0, 19.0, 0.0, -0.9, 0.0, 0.0]
    path = linear(tmp_path / "network.pt", network)
    words = ("--history", "0.02", "--step", "0.005")
    assert list(figures_of(path, *words)["faults"]) == ["step"]
    exchanged = figures_of(path, *words, "--order", "velocity-first", "--error", "auto")
    assert "order" in exchanged["faults"]
    assert "velocity-first" in exchanged["warnings"]
    pushing = linear(tmp_path / "pushing.pt", [0.0, 19.0, 0.0, 0.9, 0.0, 0.0])
    assert "velocity" in figures_of(pushing, *words)["faults"]
    shifted = saved(tmp_path / "shifted.pt", Saturated(network, 30.0, bias=0.5))
    assert "offset" in figures_of(shifted, *words)["faults"]
    # At 60 ms the error of a sample ago takes more than there is.
    assert "undamped" in figures_of(path, "--history", "0.06")["faults"]


def test_a_network_that_is_no_drive_is_refused(tmp_path: Path) -> None:
    words = ("--history", "0.02")
    path = linear(tmp_path / "network.pt", [19.0, -0.9])
    sentence = refused("probe", path, *words, "--error", "position-less-target")
    assert "--error" in sentence
    squared = saved(tmp_path / "even.pt", Saturated([19.0, -0.9], 30.0, bias=25.0))
    assert "torque" in refused("probe", squared, *words)
    two_outputs = torch.nn.Sequential(torch.nn.Linear(6, 2))
    assert "input" in refused("probe", saved(tmp_path / "two.pt", two_outputs), *words)
    assert "LSTM" in refused("probe", saved(tmp_path / "lstm.pt", Recurrent()), *words)
    assert "--ages" in refused("probe", path, *words, "--ages", "0,1,2")
    broken = Saturated([float("nan"), 1.0], 30.0)
    assert "finite" in refused("probe", saved(tmp_path / "nan.pt", broken), *words)


def test_options_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    path = linear(tmp_path / "network.pt", [19.0, -0.9])
    assert "--history" in refused("probe", path)
    assert "--history" in refused("probe", path, "--history", "0")
    assert "--step" in refused("probe", path, "--history", "0.02", "--step", "nan")
    assert "--robot" in refused("probe", path, "--history", "0.02", "--robot", "go2")
    assert "--robot" in refused("probe", "mujoco")
    assert "--history" in refused("probe", "mujoco", "--robot", "go2", "--history", "0.02")
    words = ("probe", path, "--history", "0.02")
    assert "--position-scale" in refused(*words, "--position-scale=-1")
    assert "--torque-scale" in refused(*words, "--torque-scale", "0")
    assert "--ages" in refused(*words, "--ages", "0,x")
    assert "--drive-gains" in refused(*words, "--drive-gains", "20")
    assert "--drive-gains" in refused(*words, "--inertia", "0.02")
    assert "--inertia" in refused(*words, "--drive-gains", "20,.5", "--inertia", "0")


def test_no_code_of_a_file_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pickles that call functions, networks that write files or never end, other files."""
    monkeypatch.chdir(tmp_path)
    words = ("--history", "0.02")
    trace = tmp_path / "run"
    pickled = tmp_path / "pickled.pt"
    torch.save({"weight": CodeOnLoad(trace)}, pickled)
    assert "TorchScript" in refused("probe", pickled, *words)

    good = linear(tmp_path / "good.pt", [19.0, -0.9])
    inside = tmp_path / "inside.pt"
    with zipfile.ZipFile(good) as source, zipfile.ZipFile(inside, "w") as target:
        for name in source.namelist():
            content = source.read(name)
            if name.endswith("/data.pkl"):
                content = pickle.dumps(CodeOnLoad(trace), protocol=2)
            target.writestr(name, content)
    assert "TorchScript" in refused("probe", inside, *words)
    assert not trace.exists()

    assert "save" in refused("probe", saved(tmp_path / "writer.pt", Writer()), *words)
    assert not (tmp_path / "written").exists()
    assert "Loop" in refused("probe", saved(tmp_path / "loop.pt", Loop()), *words)

    on_load = tmp_path / "on_load.pt"
    with zipfile.ZipFile(good) as source, zipfile.ZipFile(on_load, "w") as target:
        for name in source.namelist():
            content = source.read(name)
            if name.endswith(".py"):
                content += b"\n  def __setstate__(self, state: int) -> None:\n    pass\n"
            target.writestr(name, content)
    assert "__setstate__" in refused("probe", on_load, *words)

    cut = tmp_path / "cut.pt"
    cut.write_bytes(good.read_bytes()[:-100])
    assert "zip" in refused("probe", cut, *words)
    text = tmp_path / "text.pt"
    text.write_text("no network")
    assert "zip" in refused("probe", text, *words)
    assert "no such file" in refused("probe", tmp_path / "none.pt", *words)


@pytest.mark.skipif(not GO1.exists(), reason="the network of a Go1 is not here")
def test_the_network_of_a_go1(tmp_path: Path) -> None:
    """Figures by automatic differentiation of the network at rest."""
    out = tmp_path / "go1.json"
    words = ["--history", "0.02", "--step", "0.005", "--json", out]
    command = invoke(["probe", GO1, *words])
    assert command.exit_code == 0, command.output
    figures = json.loads(out.read_text())
    assert figures["trained"]["stiffness"] == pytest.approx(18.95, rel=0.01)
    assert figures["trained"]["damping"] == pytest.approx(0.50, rel=0.02)
    assert figures["used"]["damping"] == pytest.approx(0.79, rel=0.02)
    assert figures["used"]["delay_s"] == pytest.approx(0.005, rel=0.03)
