r"""Train several policies one after another on one GPU, unattended; start one series for each GPU.

    python tools/train_series.py OUT --gpu 0 --trial m1:1:matched n1:1:naive
    python tools/train_series.py OUT --gpu 1 --trial v1:1:matched:/elsewhere/src \
        m2:2:matched:best=m1,v1

A job is NAME:SEED:GAINS[:SOURCE]. GAINS are `matched` (--gains) or `naive` with their ranges and
delay; SOURCE is the src folder of another checkout, a variant of what is here. With `best=NAMES`
the job waits for those runs, of any series with the same OUT, and takes the source of the one that
passes most bars; so waits what comes after it.

A job leaves OUT/NAME.tgz: both policies, settings, provenance, curves, and with --trial the figures
of `pronk trial`. One that fails leaves OUT/NAME.failed, and the next begins. All of a run stays in
OUT/NAME.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tarfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
FIGURES = "trial.json"
KEPT = ("*.onnx", "config.yaml", "provenance.json", FIGURES, "events.*", "source")


@dataclass(frozen=True)
class Job:
    """One training."""

    name: str
    seed: str
    gains: str
    source: str

    @classmethod
    def parse(cls, text: str) -> Job:
        """From NAME:SEED:GAINS[:SOURCE].

        Raises:
            ValueError: It is something else.
        """
        name, seed, gains, *source = text.split(":", 3)
        if not name or not seed.isdigit() or gains not in ("matched", "naive"):
            raise ValueError(f"{text}: expected NAME:SEED:matched or NAME:SEED:naive")
        return cls(name, seed, gains, source[0] if source else str(ROOT / "src"))


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
    parser.add_argument("--trial", action="store_true", help="Try every policy as well.")
    parser.add_argument("--options", default="", help='More for `pronk train`, as in "--envs 64".')
    asked = parser.parse_args()
    try:
        jobs = [Job.parse(text) for text in asked.jobs]
    except ValueError as error:
        parser.error(str(error))
    asked.out = asked.out.resolve()
    asked.out.mkdir(parents=True, exist_ok=True)
    for job in jobs:
        if job.source.startswith("best="):
            names = job.source.removeprefix("best=").split(",")
            job = replace(job, source=best(asked.out, names))
        train(job, asked)


def train(job: Job, asked: argparse.Namespace) -> None:
    """One training, and its trial if asked for."""
    run, log = asked.out / job.name, asked.out / f"{job.name}.log"
    policy, gains = str(run / "policy.onnx"), str(asked.gains.resolve())
    drives = ["--gains", gains] if job.gains == "matched" else ["--gains", "naive", "--like", gains]
    training = ["train", asked.task, *drives, "--seed", job.seed, "--out", str(run)]
    done = pronk([*training, *asked.options.split()], job, asked, log)
    if done and asked.trial:
        words = ["trial", policy, "--no-video", "--out", str(run / "trial")]
        done = pronk([*words, "--json", str(run / FIGURES)], job, asked, log)
    if (run / "policy.onnx").is_file():
        (run / "source").write_text(job.source)
        keep(run, asked.out / f"{job.name}.tgz")
    if not done:
        log.rename(log.with_suffix(".failed"))


def pronk(words: list[str], job: Job, asked: argparse.Namespace, log: Path) -> bool:
    """Run a command of pronk; whether it did not fail."""
    environment = {
        **os.environ,
        "CUDA_VISIBLE_DEVICES": asked.gpu,
        "PYTHONPATH": os.pathsep.join(filter(None, [job.source, os.environ.get("PYTHONPATH")])),
    }
    with log.open("a") as file:
        # The working folder is first on the path of `python -m`; it must not be a src folder.
        command = [sys.executable, "-m", "pronk.cli.main", *words]
        done = subprocess.run(command, env=environment, stdout=file, stderr=file, cwd=asked.out)
    return done.returncode == 0


def keep(run: Path, path: Path) -> None:
    """Pack what is worth keeping of a run."""
    aside = path.with_suffix(".aside")
    with tarfile.open(aside, "w:gz") as archive:
        for file in sorted({file for pattern in KEPT for file in run.glob(pattern)}):
            archive.add(file, f"{run.name}/{file.name}")
    aside.rename(path)


def best(out: Path, names: list[str]) -> str:
    """The source of the run that passes most bars, once all are over; the first of equals."""
    while not all(over(out, name) for name in names):
        time.sleep(1.0)
    passed = {name: bars(out / name) for name in names}
    name = max(names, key=lambda name: passed[name])
    (out / f"best-of-{'-'.join(names)}.txt").write_text(f"{name} {passed}\n")
    source = out / name / "source"
    return source.read_text() if source.is_file() else str(ROOT / "src")


def over(out: Path, name: str) -> bool:
    """Whether a run has come to its end, good or bad."""
    return any((out / f"{name}.{end}").is_file() for end in ("tgz", "failed"))


def bars(run: Path) -> int:
    """Bars that a run passes in its trial."""
    file = run / FIGURES
    checks = json.loads(file.read_text())["checks"] if file.is_file() else []
    return sum(check["passed"] for check in checks)


if __name__ == "__main__":
    main()
