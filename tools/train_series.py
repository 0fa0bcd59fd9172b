"""Train several policies one after another on one GPU, unattended; start one series for each GPU.

    python tools/train_series.py OUT --gpu 0 m1:1:matched n1:1:naive
    python tools/train_series.py OUT --gpu 1 m2:2:matched v1:1:matched:/elsewhere/src --evaluate

A job is NAME:SEED:GAINS[:SOURCE]. GAINS are `matched` (--gains) or `naive` with their ranges and
delay; SOURCE is the src folder of another checkout, where a variant is compared with what is here.
A job leaves OUT/NAME.tgz: both policies, settings, provenance, curves, and with --evaluate the
figures of `pronk evaluate`. One that fails leaves OUT/NAME.failed, and the next begins. All of a
run stays in OUT/NAME.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tarfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
KEPT = ("policy.onnx", "walk.onnx", "config.yaml", "provenance.json", "*.json", "events.*", "*.txt")


def main() -> None:
    """Run the jobs in the order given."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path, help="Folder of the runs and of what is kept.")
    parser.add_argument("jobs", nargs="+", metavar="NAME:SEED:GAINS[:SOURCE]")
    parser.add_argument("--gpu", default="0", help="What CUDA_VISIBLE_DEVICES shall say.")
    parser.add_argument("--gains", type=Path, default=ROOT / "policies/gains.yaml")
    parser.add_argument("--task", choices=("all", "together"), default="all")
    parser.add_argument("--evaluate", action="store_true", help="Evaluate every policy as well.")
    parser.add_argument("--option", action="append", default=[], help="More for `pronk train`.")
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    for job in asked.jobs:
        name, seed, gains, *source = job.split(":", 3)
        if gains not in ("matched", "naive") or not seed.isdigit():
            parser.error(f"{job}: expected NAME:SEED:matched or NAME:SEED:naive")
        drives = [str(asked.gains)] if gains == "matched" else ["naive", "--like", str(asked.gains)]
        run = asked.out / name
        train = ["train", asked.task, "--gains", *drives, "--seed", seed, "--out", str(run)]
        commands = [train + [word for option in asked.option for word in option.split()]]
        if asked.evaluate:
            evaluate = ["evaluate", str(run / "policy.onnx"), "--gains", *drives, "--out"]
            commands += [
                [*evaluate, str(run / "full.json")],
                [*evaluate, str(run / "noise.json"), "--randomization", "noise"],
            ]
        log = asked.out / f"{name}.log"
        # The working folder would come first on the path of `python -m`, before a variant's.
        done = all(_pronk(words, log, asked.gpu, *source) for words in commands)
        if (run / "policy.onnx").is_file():
            _keep(run, asked.out / f"{name}.tgz")
        if not done:
            log.rename(log.with_suffix(".failed"))


def _pronk(words: list[str], log: Path, gpu: str, source: str = str(ROOT / "src")) -> bool:
    """Whether a command of pronk did what it was asked for."""
    path = os.pathsep.join([source, *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = {**os.environ, "CUDA_VISIBLE_DEVICES": gpu, "PYTHONPATH": path}
    call = [sys.executable, "-m", "pronk.cli", *words]
    with log.open("a") as file:
        return subprocess.run(call, env=environment, stdout=file, stderr=file).returncode == 0


def _keep(run: Path, path: Path) -> None:
    aside = path.with_suffix(".aside")
    with tarfile.open(aside, "w:gz") as archive:
        for file in sorted({file for pattern in KEPT for file in run.glob(pattern)}):
            archive.add(file, f"{run.name}/{file.name}")
    aside.rename(path)


if __name__ == "__main__":
    main()
