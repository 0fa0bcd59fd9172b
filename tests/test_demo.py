"""The demo's policies: which are taken, in which order, and what is said where there are none."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from hopper import ROBOT, write_hopper
from pronk.cli import console, demo_trial
from pronk.errors import ArtefactError, PronkError

pytest.importorskip("onnxruntime")


def test_the_repository_has_a_policy_that_fits() -> None:
    found, lack = demo_trial.find(None, ROBOT)
    assert not lack
    assert found[0] == demo_trial.shipped() / "matched" / "policy.onnx"


def test_matched_comes_first_and_a_policy_that_does_not_fit_is_refused(tmp_path: Path) -> None:
    for name in ("naive", "matched", "a"):
        (tmp_path / name).mkdir()
    naive = {"gains": "naive", "gains_sha256": ""}
    own = {"stiffness": (17.0,) * 12, "damping": (0.4,) * 12}
    write_hopper(tmp_path / "naive" / "policy.onnx", 0.5, **naive, **own)
    write_hopper(tmp_path / "matched" / "policy.onnx")
    found, lack = demo_trial.find(tmp_path, ROBOT)
    assert [path.parent.name for path in found] == ["matched", "naive"]
    assert not lack
    write_hopper(tmp_path / "a" / "policy.onnx", robot="go2")
    with pytest.raises(ArtefactError, match="go2"):
        demo_trial.find(tmp_path, ROBOT)


def test_a_folder_without_policies_is_refused(tmp_path: Path) -> None:
    with pytest.raises(PronkError, match=r"no policy\.onnx in it"):
        demo_trial.find(tmp_path, ROBOT)


def test_without_shipped_policies_the_demo_goes_on_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # As in an installed package, which has no repository around it.
    monkeypatch.setattr(demo_trial, "shipped", lambda: tmp_path)
    found, lack = demo_trial.find(None, ROBOT)
    assert not found
    assert lack.startswith("no jumps: ")
    assert "--policies" in lack


def test_without_onnxruntime_the_demo_goes_on_and_names_the_extra(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    found, lack = demo_trial.find(None, ROBOT)
    assert not found
    assert "pip install 'pronk[policy]'" in lack


class Told(console.Reporter):
    """Keeps what it is told."""

    def __init__(self) -> None:
        self.stages: list[str] = []

    def __call__(self, stage: str, share: float) -> None:
        self.stages.append(stage)


def test_a_policy_that_changes_is_told_of_by_whoever_waits_for_the_jumps(tmp_path: Path) -> None:
    policy = tmp_path / "policy.onnx"
    policy.write_bytes(b"none")
    with (
        demo_trial.beside(
            [policy], tmp_path / "out", robot=ROBOT, jumps=1, seed=0, report=Told()
        ) as done,
        pytest.raises(ArtefactError, match="not a network"),
    ):
        done()


def test_without_policies_nothing_is_done_beside(tmp_path: Path) -> None:
    with demo_trial.beside([], tmp_path, robot=ROBOT, jumps=1, seed=0, report=Told()) as done:
        assert done() == demo_trial.Jumped()
    assert not list(tmp_path.iterdir())


def test_what_goes_wrong_elsewhere_stops_the_jumps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shares: list[float] = []

    def forever(*_: object, report: console.Reporter, **__: object) -> None:
        while True:
            shares.append(0.0)
            report("jump", 0.0)

    monkeypatch.setattr(demo_trial, "jump", forever)

    def fail() -> None:
        with demo_trial.beside([tmp_path], tmp_path, robot=ROBOT, jumps=1, seed=0, report=Told()):
            while not shares:
                pass
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
