"""`*.response.npz`: round trip, damage, whole or not at all."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pronk.errors import ArtefactError
from pronk.response import FrequencyResponse, estimate, load, save
from synthetic_joint import KNEE, chirp_command, linear_joint, make_log, multisine_command


def responses() -> list[FrequencyResponse]:
    chirp = make_log(
        [chirp_command("chirp", 200.0)] * 2, linear_joint(**KNEE), kind="chirp", noise=1e-4
    )
    sines = make_log(
        [(*multisine_command(200.0), None)], linear_joint(**KNEE), kind="multisine", period=4.0
    )
    return [*estimate(chirp, "knee"), *estimate(sines, "knee")]


def test_round_trip(tmp_path: Path) -> None:
    path, written = tmp_path / "knee.response.npz", responses()
    save(path, written)
    read = load(path)
    assert len(read) == 2
    for a, b in zip(written, read, strict=True):
        for name in a.__dataclass_fields__:
            mine, theirs = getattr(a, name), getattr(b, name)
            np.testing.assert_array_equal(mine, theirs, err_msg=name)


def test_damage_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "knee.response.npz"
    with pytest.raises(ArtefactError, match="no such file"):
        load(path)
    path.write_bytes(b"not a zip")
    with pytest.raises(ArtefactError, match="not a response file"):
        load(path)
    save(path, responses())
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(ArtefactError, match="not a response file"):
        load(path)
    np.savez(path, header=np.array(json.dumps({"schema": "pronk/response/0"})))
    with pytest.raises(ArtefactError, match="this pronk reads"):
        load(path)
    np.savez(path, header=np.array([{"schema": "pronk/response/1"}], dtype=object))
    with pytest.raises(ArtefactError, match="not a response file"):
        load(path)


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    path, written = tmp_path / "knee.response.npz", responses()
    save(path, written)
    before = path.read_bytes()
    bad = FrequencyResponse(**{**vars(written[0]), "source": object()})  # type: ignore[arg-type]
    with pytest.raises(TypeError):
        save(path, [bad])
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
