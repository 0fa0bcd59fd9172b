"""The table of LCM messages against lcm-gen itself."""

from __future__ import annotations

import importlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from pronk.errors import HardwareError
from pronk.links.lcm.messages import MESSAGES, SPI_DATA, Message
from pronk.links.machine import RefusedError

# Fingerprints and lengths as lcm-gen 1.5.3 gave them for the two stacks' own .lcm files.
KNOWN = {
    "cheetah.leg_control_command_lcmt": (0x277F792B531376CF, 488),
    "cheetah.microstrain_lcmt": (0xE21531EA1392FAAA, 76),
    "cheetah.spi_data_t": (0x3A5F506B524D7E4F, 124),
    "cheetah.control_parameter_request_lcmt": (0xD04FD3ECA4A52D73, 146),
    "wtw.leg_control_data_lcmt": (0x5352516A697F890F, 272),
    "wtw.pd_tau_targets_lcmt": (0xDB10251DE2523982, 544),
    "wtw.state_estimator_lcmt": (0xD50F90505DFFCB6D, 160),
}
ALL = sorted(MESSAGES, key=lambda message: message.name)


@pytest.fixture(scope="module")
def generated(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ModuleType]:
    """What lcm-gen makes of the same fields, as a package with one class per message."""
    pytest.importorskip("lcm")
    folder = tmp_path_factory.mktemp("lcmgen")
    source = "package made;\n" + "".join(
        f"struct {class_name(message)} {{ {message.layout}; }}\n" for message in ALL
    )
    (folder / "all.lcm").write_text(source, encoding="ascii")
    tool = Path(sys.executable).with_name("lcm-gen")
    subprocess.run([tool, "-p", "--ppath", folder, folder / "all.lcm"], check=True)
    sys.path.insert(0, str(folder))
    try:
        yield importlib.import_module("made")
    finally:
        sys.path.remove(str(folder))


def class_name(message: Message) -> str:
    return message.name.replace(".", "_")


def some_values(message: Message) -> dict[str, np.ndarray]:
    """Another value for every number of a message, exact in its wire type."""
    rng = np.random.default_rng(len(message.name))
    return {
        field.name: rng.integers(-100, 100, () if field.count is None else field.count)
        for field in message.fields
    }


def test_every_message_of_both_stacks_is_in_the_table() -> None:
    stacks = {message.name: message for message in ALL if not message.name.startswith("pronk.")}
    assert {name: (m.fingerprint, m.size) for name, m in stacks.items()} == KNOWN
    assert all(m.computed_fingerprint == m.fingerprint for m in ALL)


@pytest.mark.parametrize("message", ALL, ids=class_name)
def test_bytes_are_those_of_lcm_gen(message: Message, generated: ModuleType) -> None:
    kind = getattr(generated, class_name(message))
    other, values = kind(), some_values(message)
    for name, value in values.items():
        setattr(other, name, value.tolist())
    golden = other.encode()
    assert message.encode(**values) == golden
    decoded = message.decode(golden)
    for name, value in values.items():
        np.testing.assert_array_equal(decoded[name], value)


def test_golden_bytes() -> None:
    # Written out by hand: fingerprint, then big-endian floats and integers, nothing between.
    values = {f"{kind}_{name}": 0.0 for kind in ("q", "qd") for name in ("abad", "hip", "knee")}
    values["q_abad"] = 1.0
    values["qd_knee"] = -2.0
    data = SPI_DATA.encode(**values, flags=[1, 0, 0, 2], spi_driver_status=-1)
    assert data.hex() == (
        "3a5f506b524d7e4f"
        + "3f800000" * 4
        + "00000000" * 16
        + "c0000000" * 4
        + "00000001000000000000000000000002"
        + "ffffffff"
    )


def test_a_wrong_table_is_refused() -> None:
    with pytest.raises(HardwareError, match="a name, type or length in the table is wrong"):
        Message("cheetah.vectornav_lcmt", 0xEAF20DBD97EFD7B9, "float q[4]; float w[3]; float b[3]")
    with pytest.raises(HardwareError, match="'float32 q' is not"):
        Message("none", 0, "float32 q")
    with pytest.raises(HardwareError, match="has no field 'q'; it has q_abad"):
        SPI_DATA.encode(q=0.0)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "fingerprint"),
        (b"\x3a", "fingerprint"),
        (bytes(124), "fingerprint"),
        (SPI_DATA.encode()[:-1], "length"),
        (SPI_DATA.encode() + b"\0", "length"),
    ],
)
def test_what_is_not_a_message_is_refused(data: bytes, reason: str) -> None:
    with pytest.raises(RefusedError) as met:
        SPI_DATA.decode(data)
    assert met.value.reason == reason


def test_a_message_of_the_other_stack_is_named() -> None:
    ours = next(m for m in ALL if m.name == "cheetah.spi_data_t")
    theirs = next(m for m in ALL if m.name == "wtw.leg_control_data_lcmt")
    with pytest.raises(RefusedError, match=r"\(wtw.leg_control_data_lcmt\), expected"):
        ours.decode(theirs.encode())
