"""Data frames of results hold the numbers of the results, with units in the names of columns."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from chirp_logs import chirp_log
from pronk.errors import PronkError
from pronk.identify.match.match import match
from pronk.identify.match.predict import Prediction, predict
from pronk.identify.match.result import MatchResult
from pronk.identify.response.estimate import estimate_response
from pronk.robots import load_robot

pytest.importorskip("pandas", reason="needs pronk[pandas]")

ROBOT = load_robot("mini_cheetah")
JOINT = "FR_knee"
GAINS = (22.0, 0.55)
LOG = chirp_log(ROBOT, JOINT, GAINS, noise_rad=1e-4)


@pytest.fixture(scope="module")
def result() -> MatchResult:
    return match([LOG], ROBOT)


@pytest.fixture(scope="module")
def prediction(result: MatchResult) -> Prediction:
    return predict(LOG, ROBOT, result.gains)


def test_match(result: MatchResult) -> None:
    frame = result.to_dataframe()
    assert list(frame["joint"]) == [JOINT]
    row = frame.iloc[0]
    gains = result.joints[JOINT].gains
    assert row["stiffness_nm_per_rad"] == gains.stiffness.value == pytest.approx(22.0, rel=0.02)
    assert row["damping_nms_per_rad"] == gains.damping.value
    assert row["armature_kgm2"] == gains.armature.value
    assert row["delay_s"] == gains.delay_s.value
    low, high = row["stiffness_low_nm_per_rad"], row["stiffness_high_nm_per_rad"]
    assert (low, high) == gains.stiffness.total95
    assert low <= row["stiffness_nm_per_rad"] <= high
    assert row["error_db"] == gains.quality.error_db
    assert row["matched"] == gains.matched


def test_response() -> None:
    response = estimate_response(LOG, JOINT)[0]
    frame = response.to_dataframe()
    assert set(frame["joint"]) == {JOINT}
    complex_response = frame["gain"] * np.exp(1j * frame["phase_rad"])
    np.testing.assert_allclose(complex_response, response.response, rtol=1e-9)
    np.testing.assert_array_equal(2.0 * np.pi * frame["frequency_hz"], response.omega)
    np.testing.assert_array_equal(frame["coherence"], response.coherence)
    assert (frame["gain_low"] <= frame["gain"]).all()
    assert (frame["gain"] <= frame["gain_high"]).all()


def test_prediction(prediction: Prediction) -> None:
    frame = prediction.to_dataframe()
    (joint,) = prediction.joints
    rmse = np.sqrt(np.mean((frame["matched_rad"] - frame["measured_rad"]) ** 2))
    assert rmse == pytest.approx(joint.rmse_matched, rel=1e-12)
    np.testing.assert_array_equal(frame["time_s"], joint.time)
    np.testing.assert_array_equal(frame["command_rad"], joint.command)
    assert not frame["nominal_rad"].equals(frame["matched_rad"])


def test_frames_are_written_and_read(result: MatchResult, tmp_path: Path) -> None:
    import pandas

    path = tmp_path / "gains.csv"
    result.to_dataframe().to_csv(path, index=False)
    read = pandas.read_csv(path)
    assert read["stiffness_nm_per_rad"][0] == result.joints[JOINT].gains.stiffness.value


def test_missing_pandas_is_one_sentence(
    result: MatchResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(PronkError, match=r"pronk\[pandas\]"):
        result.to_dataframe()
