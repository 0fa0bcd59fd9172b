"""A policy that comes to wait for its stride: the same network under another contract."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pronk.errors import ArtefactError
from pronk.policy.contract_json import METADATA_KEY, to_json
from pronk.policy.runtime import load_policy
from tools_folder import FOLDER, load_tool

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")
POLICY = FOLDER.parent / "policies" / "matched" / "policy.onnx"


def test_only_the_contract_changes(tmp_path: Path) -> None:
    tool, model = load_tool("wait_for_stride"), onnx.load(POLICY)
    contract = load_policy(POLICY).contract
    before, after = tmp_path / "before.onnx", tmp_path / "after.onnx"
    eager = replace(contract, waits_for_stride=False)
    onnx.helper.set_model_props(model, {METADATA_KEY: to_json(eager)})
    onnx.save(model, before)
    tool.wait_for_stride(before, after)
    assert load_policy(after).contract == replace(contract, waits_for_stride=True)
    assert onnx.load(after).graph == onnx.load(POLICY).graph
    measured = np.linspace(-1.0, 1.0, 105, dtype=np.float32)[None]
    inputs = {"measured": measured, "jump": np.ones((1, 1), np.float32)}
    first, second = (load_policy(path)._session.run(None, inputs) for path in (before, after))
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one, other)


def test_what_does_not_jump_is_refused(tmp_path: Path) -> None:
    tool, model = load_tool("wait_for_stride"), onnx.load(POLICY)
    with pytest.raises(ArtefactError, match="no such file"):
        tool.wait_for_stride(tmp_path / "none.onnx", tmp_path / "out.onnx")
    model.metadata_props.clear()
    onnx.save(model, tmp_path / "bare.onnx")
    with pytest.raises(ArtefactError, match="without a contract"):
        tool.wait_for_stride(tmp_path / "bare.onnx", tmp_path / "out.onnx")
    assert not (tmp_path / "out.onnx").exists()
