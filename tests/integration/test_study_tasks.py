"""Tasks of a study as processes of this host: order, failures, what is done, interruption."""

from __future__ import annotations

import os
import shutil
import signal
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest

from pronk.cli.study import failure_status
from pronk.errors import PronkError
from pronk.exit_status import ExitStatus
from pronk.jump.study.local import LocalExecutor
from pronk.jump.study.place import ChosenPlace
from pronk.jump.study.schedule import StudyProgress, TaskEnd, run_tasks
from pronk.jump.study.study import on_cores
from pronk.jump.study.tasks import StudyState, StudyTask, copied_input, study_folder
from pronk.jump.study.trainings import TrainingPlace
from study_cases import GAINS, Watched, export_task, finished, study_root


def test_a_task_that_fails_is_started_once_more_and_named_while_others_go_on(
    tmp_path: Path,
) -> None:
    root = study_root(tmp_path)
    tasks = [
        export_task("bad", "inputs/bad.yaml"),
        export_task("good"),
        export_task("behind good", needs=("good",)),
        export_task("behind bad", needs=("bad",)),
        export_task("far behind bad", needs=("behind bad",)),
    ]
    statuses = finished(tasks, LocalExecutor(root, cores=2.0), root)
    assert {name: status.state for name, status in statuses.items()} == {
        "bad": "failed",
        "good": "done",
        "behind good": "done",
        "behind bad": "skipped",
        "far behind bad": "skipped",
    }
    assert statuses["bad"].attempts == 2
    assert "bad.yaml" in statuses["bad"].reason
    log = (root / tasks[0].log()).read_text()
    assert log.count("$ pronk export") == 2
    record = StudyState(root).records["bad"]
    assert (record.status, record.attempts) == ("failed", 2)


def test_a_study_that_is_run_again_does_only_what_is_new(tmp_path: Path) -> None:
    root = study_root(tmp_path)
    tasks = [export_task("first"), export_task("second", needs=("first",))]
    assert finished(tasks, LocalExecutor(root, cores=2.0), root)["second"].state == "done"
    stamp = (root / tasks[0].outputs[0]).stat().st_mtime_ns

    tasks.append(export_task("third"))
    states = [status.state for status in finished(tasks, LocalExecutor(root), root).values()]
    assert states == ["kept", "kept", "done"]
    assert (root / tasks[0].outputs[0]).stat().st_mtime_ns == stamp

    # An output that was changed, one that is gone, an input that was changed: those run again.
    (root / tasks[0].outputs[0]).write_text("changed")
    (root / tasks[1].outputs[0]).unlink()
    assert [StudyState(root).is_done(task) for task in tasks] == [False, False, True]
    (root / "inputs" / "gains.yaml").write_bytes(GAINS.read_bytes() + b"# another\n")
    states = [status.state for status in finished(tasks, LocalExecutor(root), root).values()]
    assert states == ["done"] * 3


class _Full:
    """An executor that has no room, and counts how often it was asked."""

    def __init__(self) -> None:
        self.asked = 0

    def try_start(self, task: StudyTask) -> str:
        self.asked += 1
        return ""

    def poll(self) -> list[TaskEnd]:
        return []

    def stop(self) -> None:
        pass

    def rooms(self) -> int:
        return 1


def test_a_large_study_without_room_asks_once_a_look_and_reads_each_input_once(
    tmp_path: Path,
) -> None:
    """Hundreds of trials wait for a core; the policies that they read are large."""
    root = study_root(tmp_path)
    tasks = [export_task(str(number)) for number in range(300)]
    executor = _Full()
    looks = 0

    def report(progress: StudyProgress) -> None:
        nonlocal looks
        looks += 1
        assert progress.count("waiting") == 300
        # A file that has gone is noticed when a task begins, not at every look.
        (root / "inputs" / "gains.yaml").unlink(missing_ok=True)
        if looks == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_tasks(tasks, executor, root, report=report)
    assert executor.asked == 3


def test_no_more_tasks_run_at_once_than_there_are_cores(tmp_path: Path) -> None:
    root = study_root(tmp_path)
    for task_cores, at_once in ((0.5, 2), (8.0, 1)):
        shutil.rmtree(root / "work", ignore_errors=True)
        tasks = [export_task(str(number), cores=task_cores) for number in range(3)]
        watched = Watched()
        run_tasks(tasks, LocalExecutor(root, cores=1.0), root, report=watched)
        assert watched.most_running == at_once
        assert watched.last is not None
        assert watched.last.count("done") == 3
        assert watched.last.seconds_left == 0.0


def test_trials_share_the_cores_of_a_host_that_has_more_of_them() -> None:
    many = ChosenPlace(training=TrainingPlace(device="cuda"), gpus=("0",), cores=64.0)
    assert many.trial_processes(16) == 4
    assert many.trial_processes(40) == 1
    assert many.trial_processes(100) == 1
    cluster = ChosenPlace(training=TrainingPlace(device="cuda"), cluster="ray://head:10001")
    assert cluster.trial_processes(2) == 1


def test_the_result_of_a_trial_does_not_depend_on_its_processes(tmp_path: Path) -> None:
    root = study_root(tmp_path)
    trial = export_task("one")
    shared = on_cores(trial, 4)
    assert shared.key(root) == trial.key(root)
    assert shared.cores == 4.0
    assert shared.threads == 1
    assert export_task("training", cores=4.0).threads == 4


def test_a_task_is_skipped_for_the_one_that_failed_and_not_for_one_done_before(
    tmp_path: Path,
) -> None:
    root = study_root(tmp_path)
    good = export_task("good")
    finished([good], LocalExecutor(root), root)
    bad = export_task("bad", "inputs/bad.yaml")
    behind = export_task("behind", needs=("good", "bad"))
    status = finished([good, bad, behind], LocalExecutor(root), root)["behind"]
    assert (status.state, status.reason) == ("skipped", "bad has failed")


def test_a_command_that_ends_without_its_output_has_failed(tmp_path: Path) -> None:
    root = study_root(tmp_path)
    task = export_task("short", outputs=("work/short/actuators.py", "work/short/policy.onnx"))
    status = finished([task], LocalExecutor(root), root)["short"]
    assert status.state == "failed"
    assert "policy.onnx" in status.reason


def test_an_interrupted_study_leaves_no_process_behind(tmp_path: Path) -> None:
    root = study_root(tmp_path)
    # `simulate` runs until it is ended.
    task = export_task("endless", command=("simulate", "--link", "lcm", "--robot", "mini_cheetah"))

    def interrupt(progress: object) -> None:
        if (root / task.log()).exists():
            raise KeyboardInterrupt

    executor = LocalExecutor(root)
    with pytest.raises(KeyboardInterrupt):
        run_tasks([task], executor, root, report=interrupt)
    assert executor.poll() == []
    assert task_processes() == []
    assert StudyState(root).records["endless"].status == "started"


def task_processes() -> list[int]:
    """Return the processes of tasks that this one has started."""
    numbers = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            words = (folder / "cmdline").read_bytes().split(b"\0")
        except OSError:
            continue
        if str(os.getpid()).encode() in words[2:5]:
            numbers.append(int(folder.name))
    return numbers


@pytest.mark.parametrize(("task_kind", "way_out"), [("training", "--jobs"), ("trial", "cores")])
def test_a_task_that_is_killed_from_outside_says_so(
    tmp_path: Path, task_kind: str, way_out: str
) -> None:
    root = study_root(tmp_path)
    command = ("simulate", "--link", "lcm", "--robot", "mini_cheetah")
    task = export_task("endless", kind=task_kind, command=command)

    def kill(progress: StudyProgress) -> None:
        for number in task_processes():
            with suppress(ProcessLookupError):
                os.kill(number, signal.SIGKILL)

    status = dict(run_tasks([task], LocalExecutor(root), root, report=kill))["endless"]
    assert (status.state, status.attempts) == ("failed", 2)
    assert "SIGKILL" in status.reason
    assert "memory" in status.reason
    assert way_out in status.reason
    assert failure_status({"endless": status}) == ExitStatus.REFUSED


def test_a_policy_of_which_nothing_is_known_is_not_replaced(tmp_path: Path) -> None:
    """As in a copy of a study that has the policies, but neither its state nor their provenance."""
    root = study_root(tmp_path)
    task = export_task("run", kind="training", resume_marker="work/run/provenance.json")
    policy = root / task.outputs[0]
    policy.parent.mkdir(parents=True)
    policy.write_text("trained for hours")
    with pytest.raises(PronkError, match="how it was trained"):
        finished([task], LocalExecutor(root), root)
    assert policy.read_text() == "trained for hours"


def test_trainings_of_other_settings_are_not_mixed(tmp_path: Path) -> None:
    root = study_root(tmp_path)
    task = export_task("run", kind="training", resume_marker="work/run/actuators.py")
    finished([task], LocalExecutor(root), root)
    other = export_task(
        "run", kind="training", resume_marker="work/run/actuators.py", settings={"seed": 2}
    )
    with pytest.raises(PronkError, match="run was begun there with other settings"):
        finished([other], LocalExecutor(root), root)


def test_only_trainings_of_other_settings_are_named_to_be_deleted(tmp_path: Path) -> None:
    root = study_root(tmp_path)
    fields = {"kind": "training", "settings": {"seed": 1}}
    same = export_task("same", resume_marker="work/same/actuators.py", **fields)
    changed = export_task("changed", resume_marker="work/changed/actuators.py", **fields)
    finished([same, changed], LocalExecutor(root), root)
    changed = replace(changed, settings={"seed": 2})
    with pytest.raises(PronkError) as refusal:
        finished([same, changed], LocalExecutor(root), root)
    assert str(root / "work" / "changed") in str(refusal.value)
    assert str(root / "work" / "same") not in str(refusal.value)


def test_a_task_goes_back_to_the_sources_of_all_its_starts(tmp_path: Path) -> None:
    """A study that goes on with another commit has results of both."""
    root = study_root(tmp_path)
    task = export_task("one")
    finished([task], LocalExecutor(root), root)
    (present,) = StudyState(root).records["one"].sources

    # As if an earlier pronk had begun the task.
    state = StudyState(root)
    record = state.records["one"]
    state.set("one", replace(record, status="started", sources=("earlier",)))
    finished([task], LocalExecutor(root), root)
    assert StudyState(root).records["one"].sources == ("earlier", present)

    # Nothing of the earlier ones is left.
    shutil.rmtree(root / task.folder)
    finished([task], LocalExecutor(root), root)
    assert StudyState(root).records["one"].sources == (present,)


def test_a_policy_of_other_settings_is_not_replaced_where_its_provenance_is_missing(
    tmp_path: Path,
) -> None:
    root = study_root(tmp_path)
    fields = {"kind": "training", "resume_marker": "work/run/provenance.json"}
    task = export_task("run", **fields)
    finished([task], LocalExecutor(root), root)
    policy = root / task.outputs[0]
    content = policy.read_bytes()
    other = export_task("run", settings={"seed": 2}, **fields)
    with pytest.raises(PronkError, match="other settings"):
        finished([other], LocalExecutor(root), root)
    assert policy.read_bytes() == content


@pytest.mark.parametrize("content", ["", "{", "[]", '{"schema": "x"}'])
def test_a_damaged_state_is_refused(tmp_path: Path, content: str) -> None:
    (tmp_path / "state.json").write_text(content)
    with pytest.raises(PronkError, match=r"state\.json"):
        StudyState(tmp_path)


def test_inputs_are_named_by_their_content(tmp_path: Path) -> None:
    first = copied_input(tmp_path, GAINS, "gains")
    assert copied_input(tmp_path, GAINS, "gains") == first
    other = tmp_path / "other.yaml"
    other.write_bytes(GAINS.read_bytes() + b"\n")
    assert copied_input(tmp_path, other, "gains") != first
    assert (tmp_path / first).read_bytes() == GAINS.read_bytes()
    with pytest.raises(PronkError, match=r"nowhere\.yaml"):
        copied_input(tmp_path, tmp_path / "nowhere.yaml", "gains")


def test_a_folder_of_something_else_stays_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("kept")
    with pytest.raises(PronkError, match=r"notes\.txt"), study_folder(tmp_path):
        pass
    with pytest.raises(PronkError, match="a file"), study_folder(tmp_path / "notes.txt"):
        pass
    root = tmp_path / "new"
    with study_folder(root), pytest.raises(PronkError, match="another command"), study_folder(root):
        pass
