r"""Have a policy jump as its legs change over that was trained to jump at any moment.

    python tools/wait_for_stride.py RUN/policy.onnx policy.onnx

The network stays as it is, bit for bit; only `waits_for_stride` in its contract becomes true
(`pronk.policy.stride` says what that means), as `pronk train` writes it since commit f991793.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import onnx

from pronk.errors import ArtefactError, PronkError
from pronk.files import written_whole
from pronk.policy.contract_json import METADATA_KEY, to_json
from pronk.policy.runtime import load_policy


def main() -> None:
    """Write the policy once more."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("policy", type=Path)
    parser.add_argument("out", type=Path)
    asked = parser.parse_args()
    try:
        wait_for_stride(asked.policy, asked.out)
    except PronkError as error:
        parser.error(str(error))


def wait_for_stride(policy: Path, out: Path) -> None:
    """Write a policy with the same network whose jump input waits for the stride.

    Raises:
        ArtefactError: The file is no policy of pronk's, or one that does not jump.
    """
    contract = load_policy(policy).contract
    if not contract.jump:
        raise ArtefactError(f"{policy}: this policy does not jump; `policy.onnx` of a run does.")
    waiting = replace(contract, waits_for_stride=True)
    model = onnx.load(policy)
    onnx.helper.set_model_props(model, {METADATA_KEY: to_json(waiting)})
    with written_whole(out) as aside:
        onnx.save(model, aside)


if __name__ == "__main__":
    main()
