"""Results of a study name the versions of software that its trainings and trials ran with."""

from __future__ import annotations

import json
from pathlib import Path

from pronk.jump.study.config import ArmConfig, StudyConfig
from pronk.jump.study.schedule import TaskStatus
from pronk.jump.study.study import collect_results, plan_study
from pronk.jump.study.study_results import load_study_results
from pronk.jump.study.tasks import StudyState, TaskRecord
from pronk.jump.study.trainings import TrainingArm, training_folder, training_name
from pronk.jump.train.settings import TrainSettings


def test_versions_of_trainings_are_those_of_all_their_sessions(tmp_path: Path) -> None:
    """One training went on under another PyTorch, and one was run by another commit."""
    config = StudyConfig(
        schema="pronk/study/1", title="Two", seeds="1-2", arms={"a": ArmConfig(gains="naive")}
    )
    settings = TrainSettings(task="all", out=Path("trainings"), gains="naive")
    arm = TrainingArm(name="a", settings=settings)
    plan = plan_study(config, tmp_path, {"a": arm})
    state = StudyState(tmp_path)
    statuses = {}
    for seed, sources, torch_versions in ((1, "first", ("2.9", "2.10")), (2, "second", ("2.9",))):
        name = training_name("a", seed)
        state.set(name, TaskRecord(key="", status="done", sources=(sources,)))
        statuses[name] = TaskStatus(name=name, kind="training", state="done")
        sessions = []
        for version in torch_versions:
            sessions.append({"versions": {"torch": version, "mjlab": "1.6", "numpy": version}})
        folder = tmp_path / training_folder(arm, seed)
        folder.mkdir(parents=True)
        (folder / "provenance.json").write_text(json.dumps({"sessions": sessions}))

    results = collect_results(plan, tmp_path, statuses)
    assert results.versions["training torch"] == "2.10 and 2.9"
    assert results.versions["training mjlab"] == "1.6"
    assert results.versions["training sources"] == "first and second"
    sentences = load_study_results(tmp_path / "study.json").mixed_versions
    assert "trainings are not all of one version" in sentences
    assert "torch 2.10 and 2.9" in sentences
    assert "sources first and second" in sentences
    # It decides no number by itself.
    assert "numpy" not in sentences

    # A copy that has the policies alone: what is not known is not mixed.
    for path in tmp_path.rglob("provenance.json"):
        path.unlink()
    assert "torch" not in collect_results(plan, tmp_path, statuses).mixed_versions
