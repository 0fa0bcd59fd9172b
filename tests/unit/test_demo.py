"""The demo's choice of policies."""

from __future__ import annotations

from pathlib import Path

import pytest

from hopper import ROBOT, write_hopper
from pronk.cli.demo import find_policies
from pronk.errors import ArtefactError, PronkError

pytest.importorskip("onnxruntime")


def test_the_repository_has_a_policy_that_fits() -> None:
    assert find_policies(None, ROBOT)[0].parts[-3:] == ("policies", "matched", "policy.onnx")


def test_matched_comes_first_and_a_policy_of_another_robot_is_refused(tmp_path: Path) -> None:
    with pytest.raises(PronkError, match=r"policy\.onnx"):
        find_policies(tmp_path, ROBOT)
    for name in ("naive", "matched", "a"):
        (tmp_path / name).mkdir()
    naive = {"gains": "naive", "gains_sha256": ""}
    own = {"stiffness": (17.0,) * 12, "damping": (0.4,) * 12}
    write_hopper(tmp_path / "naive" / "policy.onnx", 0.5, **naive, **own)
    write_hopper(tmp_path / "matched" / "policy.onnx")
    found = find_policies(tmp_path, ROBOT)
    assert [path.parent.name for path in found] == ["matched", "naive"]
    write_hopper(tmp_path / "a" / "policy.onnx", robot="go2")
    with pytest.raises(ArtefactError, match="go2"):
        find_policies(tmp_path, ROBOT)
