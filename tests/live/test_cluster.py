"""A study on a Ray cluster of two nodes, one of them killed; trials as on one host."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("torch")
pytest.importorskip("mjlab")
ray = pytest.importorskip("ray")
from ray.cluster_utils import Cluster

import pronk
from process_tree import descendants_of
from pronk.jump.study.config import load_study
from pronk.jump.study.local import LocalExecutor
from pronk.jump.study.ray_cluster import ray_executor
from pronk.jump.study.schedule import StudyProgress, run_tasks
from pronk.jump.study.study import collect_results, plan_study, study_tasks
from pronk.jump.study.trainings import TrainingArm, TrainingPlace
from pronk.jump.train.settings import SessionSettings, TrainSettings
from study_cases import cell_files, export_task, finished, study_root, write_study

pytestmark = [pytest.mark.train, pytest.mark.xdist_group("ray")]

SETTINGS = TrainSettings(
    task="all",
    out=Path("trainings"),
    gains="naive",
    envs=4,
    phase=("walk=4", "jump_a=1", "jump_b=1"),
    session=SessionSettings(save_interval=1),
)


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """A head without cores, and two nodes of one core each; the last test kills one of them."""
    source = str(Path(pronk.__file__).resolve().parents[1])
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join([source, os.environ.get("PYTHONPATH", "")]))
        patch.setenv("RAY_memory_monitor_refresh_ms", "0")
        patch.setenv("RAY_DISABLE_IMPORT_WARNING", "1")
        nodes = Cluster(
            initialize_head=True,
            head_node_args={"num_cpus": 0, "include_dashboard": False},
        )
        try:
            for _ in range(2):
                nodes.add_node(num_cpus=1)
            yield nodes
        finally:
            ray.shutdown()
            nodes.shutdown()


class NodeKiller:
    """Kills a node that trains as soon as a checkpoint of that training is at home.

    A thread stops the first training that has written a checkpoint (SIGSTOP), so that it cannot end
    before its checkpoint is at home, however slow the machine is.
    """

    def __init__(self, root: Path, cluster: Any) -> None:
        self.root = root
        self.cluster = cluster
        self.lost = ""
        """Folder of the training that ran on the node; empty until it is killed."""
        self.attempts = 0
        self.seen: set[str] = set()
        """Commands of all processes that ran below the nodes, for the message of a failure."""
        self._node: Any = None
        """Node whose training is stopped."""
        self._process = 0
        """Number of the process that is stopped."""
        self._folder = ""
        self._is_over = threading.Event()
        self._watcher = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> NodeKiller:
        self._watcher.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._is_over.set()
        self._watcher.join()
        if self._node is not None and not self.lost:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self._process, signal.SIGCONT)

    def __call__(self, progress: StudyProgress) -> None:
        for status in progress.tasks:
            self.attempts = max(self.attempts, status.attempts)
        if self.lost or self._node is None:
            return
        if any(self.root.rglob(f"{self._folder}/model_*.pt")):
            self.lost = self._folder
            self.cluster.remove_node(self._node, allow_graceful=False)
            # With a machine its processes are gone too.
            os.kill(self._process, signal.SIGKILL)

    def _watch(self) -> None:
        while self._node is None and not self._is_over.wait(0.1):
            for node in list(self.cluster.worker_nodes):
                self._stop_training_of(node)

    def _stop_training_of(self, node: Any) -> None:
        """Stop a training on a node if it has written a checkpoint and none is stopped yet."""
        raylet = node.all_processes["raylet"][0].process.pid
        for process, command in descendants_of(raylet).items():
            self.seen.add(command)
            # A task's process works in a folder of its own.
            for checkpoint in Path(f"/proc/{process}/cwd").glob("trainings/*/*/model_*.pt"):
                folder = checkpoint.parent.name
                if self._node is None and f"/{folder} " in f"{command} ":
                    os.kill(process, signal.SIGSTOP)
                    self._folder = folder
                    self._process = process
                    self._node = node


def test_failures_on_nodes_are_named_with_their_log(cluster: Any, tmp_path: Path) -> None:
    root = study_root(tmp_path)
    tasks = [export_task("bad", "inputs/bad.yaml"), export_task("good")]
    with ray_executor(root, cluster.address, per_gpu=1, say=lambda text: None) as executor:
        statuses = finished(tasks, executor, root)
    assert {name: status.state for name, status in statuses.items()} == {
        "bad": "failed",
        "good": "done",
    }
    assert "bad.yaml" in statuses["bad"].reason
    assert (root / tasks[0].log()).exists()
    assert (root / tasks[1].outputs[0]).exists()


def test_a_study_survives_the_loss_of_a_node(cluster: Any, tmp_path: Path) -> None:
    path = write_study(tmp_path / "study.yaml", seeds="1-2", arms={"nominal": {"gains": "naive"}})
    arm = TrainingArm(name="nominal", settings=SETTINGS.completed())
    plan = plan_study(load_study(path), tmp_path, {"nominal": arm})
    root = tmp_path / "out"
    tasks = study_tasks(plan, root, TrainingPlace(device="cpu"))
    with (
        ray_executor(root, cluster.address, per_gpu=1, say=lambda text: None) as executor,
        NodeKiller(root, cluster) as killer,
    ):
        statuses = run_tasks(tasks, executor, root, report=killer)
    assert {status.state for status in statuses.values()} == {"done"}, statuses
    assert killer.lost, f"no node was killed in flight; processes: {sorted(killer.seen)}"
    assert killer.attempts == 2
    sessions = {}
    for seed in (1, 2):
        folder = root / "trainings" / "nominal" / f"seed-{seed}"
        record = json.loads((folder / "provenance.json").read_text())
        assert record["finished"]
        assert record["settings"]["seed"] == seed
        sessions[folder.name] = len(record["sessions"])
    # The one that was lost went on from the checkpoint that was at home.
    assert sessions.pop(killer.lost) == 2
    assert list(sessions.values()) == [1]
    assert not collect_results(plan, root, statuses).missing

    # The same policies on one host, without Ray: the same jumps to the last digit.
    policies = []
    for seed in (1, 2):
        policies.append(str(root / "trainings" / "nominal" / f"seed-{seed}" / "policy.onnx"))
    path = write_study(tmp_path / "local.yaml", arms={"nominal": {"policies": policies}})
    local_plan = plan_study(load_study(path), tmp_path, {})
    local_root = tmp_path / "local"
    local_tasks = study_tasks(local_plan, local_root, TrainingPlace(device="cpu"))
    finished(local_tasks, LocalExecutor(local_root, cores=2.0), local_root)
    assert cell_files(local_root) == cell_files(root)
