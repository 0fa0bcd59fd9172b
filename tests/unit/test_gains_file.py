"""gains.yaml: what is written is read again, the first schema too, and others name the way out."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import yaml

from pronk.errors import ArtefactError
from pronk.files import sha256
from pronk.identify.match.gains import (
    FittedValue,
    GroupGains,
    JointGains,
    MatchedGains,
    MatchQuality,
    TorqueParameter,
    load_gains,
    save_gains,
)
from pronk.identify.simulators.profiles import profile
from pronk.policy.runtime import load_policy

POLICIES = Path(__file__).parents[2] / "policies"
KNEE = JointGains(
    stiffness=FittedValue(value=21.5, repeat95=(21.0, 22.0), total95=(20.0, 23.0)),
    damping=FittedValue(value=0.55, repeat95=(0.54, 0.56)),
    armature=FittedValue(value=0.00627),
    frictionloss=FittedValue(value=0.3, total95=(0.25, 0.35)),
    stribeck=FittedValue(value=0.4),
    delay_s=FittedValue(value=0.005, repeat95=(0.0049, 0.0051)),
    covariance=((0.09, 0.0015), (0.0015, 0.0001)),
    quality=MatchQuality(band_hz=(0.1, 15.0), error_db=0.04, nominal_error_db=0.6),
    torque={"scale": TorqueParameter(value=0.9, ci95=(0.8, 1.0))},
    flags=("one repeat: the interval assumes white noise",),
)


def gains(joint: JointGains) -> MatchedGains:
    group = GroupGains(stiffness=21.5, damping=0.55, stiffness_range=1.0, damping_range=0.05)
    return MatchedGains(
        robot="mini_cheetah",
        simulator=profile("isaaclab-implicit").info,
        joints={"FR_knee": joint},
        groups={"knee": group},
        logs={"FR_knee.mcap": "ab" * 32},
        virtual=True,
    )


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    path = tmp_path / "gains.yaml"
    save_gains(path, gains(KNEE))
    read = load_gains(path)
    knee = read.joints["FR_knee"]
    assert knee.stiffness == KNEE.stiffness
    assert knee.delay_s == KNEE.delay_s
    assert knee.torque == KNEE.torque
    assert knee.covariance == KNEE.covariance
    assert knee.flags == KNEE.flags
    assert knee.quality.band_hz == (0.1, 15.0)
    assert math.isnan(knee.quality.coherence_min)
    assert math.isnan(knee.damping.total95[0])
    assert read.groups["knee"].stiffness_range == 1.0
    assert read.simulator == gains(KNEE).simulator
    assert read.logs == {"FR_knee.mcap": "ab" * 32}
    assert read.virtual


def test_what_is_not_known_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "gains.yaml"
    bare = JointGains(
        stiffness=FittedValue(value=20.0),
        damping=FittedValue(value=0.5),
        armature=FittedValue(value=0.0026),
    )
    save_gains(path, gains(bare))
    assert "nan" not in path.read_text().lower()
    knee = load_gains(path).joints["FR_knee"]
    assert math.isnan(knee.frictionloss.value)
    assert knee.delay_s.value == 0.0
    assert knee.stribeck.value == 0.0


def test_the_gains_of_the_shipped_policies_are_read() -> None:
    shipped = load_gains(POLICIES / "gains.yaml")
    knee = shipped.joints["FR_knee"]
    assert knee.stiffness == FittedValue(value=21.7786, repeat95=(21.7402, 21.817))
    assert knee.quality.nominal_error_db == pytest.approx(0.598826)
    assert shipped.groups["knee"].damping_range == 0.05
    # The policy's contract names this file by its hash, so it has to stay as it is.
    contract = load_policy(POLICIES / "matched" / "policy.onnx").contract
    assert contract.gains_sha256 == sha256(POLICIES / "gains.yaml")


def test_another_schema_names_what_to_do(tmp_path: Path) -> None:
    path = tmp_path / "gains.yaml"
    path.write_text("schema: pronk/gains/9\nrobot: mini_cheetah\n")
    with pytest.raises(ArtefactError, match=r"pronk/gains/9.*pronk/gains/2.*pronk match"):
        load_gains(path)


@pytest.mark.parametrize("schema", ["pronk/gains/1", "pronk/gains/2"])
def test_a_field_that_is_misspelled_is_named(tmp_path: Path, schema: str) -> None:
    path = tmp_path / "gains.yaml"
    save_gains(path, gains(KNEE))
    body = yaml.safe_load(path.read_text())
    body["schema"] = schema
    value = body["joints"]["FR_knee"]["stiffness"]
    if schema == "pronk/gains/1":
        value = 21.5
    body["joints"] = {"FR_knee": {"stiffness": value, "damping": value, "armature": value}}
    body["joints"]["FR_knee"]["dampling"] = 0.5
    path.write_text(yaml.safe_dump(body))
    with pytest.raises(ArtefactError, match="dampling"):
        load_gains(path)
