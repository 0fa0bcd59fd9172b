"""The log of a real, hanging Go2: matched on one half, better than the nominal gains on the other.

The log is other people's and is not in the repository: the test is skipped without the folder
`shared` beside the checkout (docs/evidence/go2.md).
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from command_line import accepted, invoke
from pronk.exit_status import ExitStatus

LOG = Path(__file__).parents[3] / "shared" / "data" / "go2_log" / "traj_0.pt"
LEGS = ("FL", "FR", "RL", "RR")
GROUPS = ("hip_roll", "hip_pitch", "knee")
ORDER = ",".join(f"{leg}_{group}" for leg in LEGS for group in GROUPS)


@pytest.mark.slow
@pytest.mark.skipif(not LOG.exists(), reason=f"needs {LOG}")
def test_a_real_go2_is_predicted_better_than_by_the_nominal_gains(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    log = torch.load(LOG, weights_only=True)
    middle = len(log["time"]) // 2
    halves = {}
    for name, part in (("first", slice(0, middle)), ("second", slice(middle, None))):
        half = {key: values[part].clone() for key, values in log.items()}
        half["time"] = half["time"] - half["time"][0]
        halves[name] = tmp_path / f"{name}.pt"
        torch.save(half, halves[name])
    reading = ["--joint-order", ORDER]
    for group in GROUPS:
        reading += ["--drive-gains", f"{group}=20,1.5"]
    gains = tmp_path / "gains.yaml"
    report = tmp_path / "report.json"
    # The second half has the higher frequencies, which tell stiffness from dry friction.
    done = invoke(["match", halves["second"], "--robot", "go2", "--out", gains, *reading])
    assert done.exit_code in (ExitStatus.DONE, ExitStatus.NOT_BETTER), done.stderr
    accepted("predict", halves["first"], "--gains", gains, "--json", report, *reading)
    predictions = json.loads(report.read_text())["predictions"]
    ratios = []
    for prediction in predictions:
        ratio = prediction["rmse_matched"] / prediction["rmse_nominal_delayed"]
        assert ratio < 1.0, prediction["joint"]
        ratios.append(ratio)
    assert len(ratios) == 12
    assert np.exp(np.mean(np.log(ratios))) < 0.6
