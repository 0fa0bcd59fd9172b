"""`pronk train` from random weights to `policy.onnx`, on Warp's CPU device, small.

16 robots and one or two iterations a phase: the whole way is walked, nothing is learned.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import mujoco
import pytest
import yaml

from pronk.cli import main as cli
from pronk.match.gains import GroupGains, JointGains, MatchedGains, save
from pronk.simulators.simulator import SimulatorInfo
from pronk.train.runner import checkpoint
from pronk.train.runner.run_folder import RunFolder

torch = pytest.importorskip("torch")
pytest.importorskip("mjlab")
from pronk.train.phases import PHASES, enter_phase

pytestmark = [pytest.mark.train, pytest.mark.slow]

SMALL = ("--envs", "16", "--seed", "3", "--device", "cpu", "--logger", "none")
ALL = ("all", "--gains", "naive", *SMALL, "--phase", "walk=2")
ALL += ("--phase", "jump_a=1", "--phase", "jump_b=2")


@pytest.fixture(autouse=True)
def one_thread():
    """Batches this small lose more by waiting for each other's threads than they gain."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def save_gains(path: Path) -> None:
    """Gains as `pronk match` writes them."""
    joint = JointGains(
        stiffness=21.5,
        damping=0.55,
        grid_stiffness=21.5,
        grid_damping=0.55,
        stiffness_ci95=(21.4, 21.6),
        damping_ci95=(0.54, 0.56),
        covariance=((1e-4, 0.0), (0.0, 1e-6)),
        band_hz=(0.1, 15.0),
        error_db=0.1,
        naive_error_db=2.0,
        coherence_min=0.99,
        armature=0.0063,
        delay_s=0.004,
    )
    groups = {
        name: GroupGains(stiffness=k, damping=d, stiffness_range=2.0, damping_range=0.05)
        for name, k, d in (("hip_roll", 20.0, 0.45), ("hip_pitch", 17.5, 0.4), ("knee", 21.5, 0.55))
    }
    simulator = SimulatorInfo(version=mujoco.__version__)
    gains = MatchedGains(
        robot="mini_cheetah",
        simulator=simulator,
        joints={"FR_knee": joint},
        groups=groups,
        virtual=True,
    )
    save(path, gains)


def train(*arguments: str | Path) -> int:
    return cli.run(["train", *map(str, arguments)])


def provenance(folder: RunFolder) -> dict:
    return json.loads(folder.provenance.read_text())


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory) -> RunFolder:
    """A run through all phases in one go."""
    torch.set_num_threads(1)
    folder = RunFolder(tmp_path_factory.mktemp("train") / "all")
    assert train(*ALL, "--out", folder.path) == 0
    return folder


@pytest.fixture(scope="module")
def walked(tmp_path_factory) -> RunFolder:
    """A run through phase 1, logged to TensorBoard, with the gains of a file."""
    torch.set_num_threads(1)
    folder = RunFolder(tmp_path_factory.mktemp("train") / "walk")
    gains = folder.path.parent / "matched.yaml"
    save_gains(gains)
    words = ("walk", "--gains", gains, *SMALL[:-2], "--phase", "walk=2", "--json")
    assert train(*words, folder.path.parent / "figures.json", "--out", folder.path) == 0
    return folder


# --- All phases ----------------------------------------------------------------------------------


def test_all_phases_leave_the_whole_folder(uninterrupted):
    inside = {p.name for p in uninterrupted.path.iterdir()}
    wanted = {"config.yaml", "provenance.json", "checkpoints", "train.log"}
    assert inside == wanted | {"walk.onnx", "policy.onnx"}
    found = provenance(uninterrupted)
    assert found["finished"]
    assert list(found["phases"]) == ["walk", "jump_a", "jump_b"]
    # 16 robots, 24 steps an iteration.
    steps = {name: phase["env_steps"] for name, phase in found["phases"].items()}
    assert steps == {"walk": 768, "jump_a": 384, "jump_b": 768}
    assert all(phase["non_finite"] == 0 for phase in found["phases"].values())
    (session,) = found["sessions"]
    assert session["versions"]["mjlab"]
    assert 0.0 < session["build_s"] < session["seconds"]
    about = checkpoint.about(checkpoint.latest(uninterrupted.checkpoints))
    assert (about["iteration"], about["phase"], about["env_steps"]) == (5, "jump_b", 1920)


def test_the_configuration_says_what_was_trained(uninterrupted):
    config = yaml.safe_load(uninterrupted.config.read_text())
    assert config["settings"]["iterations"] == {"walk": 2, "jump_a": 1, "jump_b": 2}
    groups = config["gains"]["groups"]
    assert {(g["stiffness"], g["damping"]) for g in groups.values()} == {(17.0, 0.4)}
    assert config["randomization"]["friction"] == [0.05, 3.0]
    rows = {phase: terms["table"]["rows"] for phase, terms in config["rewards"].items()}
    assert rows["walk"].keys() == rows["jump_b"].keys()
    assert rows["walk"]["tracking_linear"]["term"] == "pronk.train.mdp.rewards:tracking_linear"
    # A tenth of the dense reward is left in phase 2b (Table II).
    dense = [rows[phase]["dense_jump"]["jump"] for phase in ("walk", "jump_a", "jump_b")]
    assert dense[0] == 0.0
    assert dense[2] == pytest.approx(0.1 * dense[1])
    assert dense[1] < 0.0
    assert config["learning"]["jump_a"]["obs_groups"]["actor"] == ["measured", "jump"]
    assert config["learning"]["walk"]["actor"]["hidden_dims"] == [1024, 512, 256]
    assert config["environment"]["scene"]["num_envs"] == 16


def test_the_libraries_talk_to_the_log(uninterrupted, capsys, tmp_path):
    words = ("walk", "--gains", "naive", *SMALL, "--phase", "walk=1", "--out", tmp_path / "run")
    assert train(*words) == 0
    shown = capsys.readouterr()
    log = (tmp_path / "run" / "train.log").read_text()
    for said in ("Actor Model", "Base Environment", "Active Reward Terms"):
        assert said in log
        assert said not in shown.out + shown.err
    assert "walk 1/1" in shown.err
    assert "for tests only" in shown.err
    assert f"wrote {tmp_path / 'run' / 'policy.onnx'}" in shown.out
    assert "pronk train jump --init-checkpoint" in shown.out


def test_the_last_policy_reads_the_jump_input_and_the_first_does_not(uninterrupted):
    onnx = pytest.importorskip("onnx")
    for path, inputs in (
        (uninterrupted.walk, ["measured"]),
        (uninterrupted.policy, ["measured", "jump"]),
    ):
        model = onnx.load(path)
        assert [entry.name for entry in model.graph.input] == inputs
        (contract,) = (json.loads(p.value) for p in model.metadata_props)
        assert contract["jump"] == (len(inputs) == 2)
        assert contract["provenance"]["seed"] == 3
    assert contract["provenance"]["phases"] == {"walk": 2, "jump_a": 1, "jump_b": 2}


# --- Interrupted and resumed ---------------------------------------------------------------------


def test_stopped_after_every_iteration_it_has_the_same_phases(
    uninterrupted, tmp_path, capsys, monkeypatch
):
    folder = RunFolder(tmp_path / "run")
    stops, noise, entered = 0, [], []

    def enter(env, phase, done=0.0):
        if phase.name == "jump_b":
            entered.append(done)
        enter_phase(env, phase, done)

    monkeypatch.setattr("pronk.train.runner.run.enter_phase", enter)
    words = (*ALL, "--minutes", "1e-9")
    while not folder.provenance.exists() or not provenance(folder)["finished"]:
        assert train(*words, "--out", folder.path) == 0
        # The settings are those of the run.
        words = ("all", "--minutes", "1e-9", "--resume", "--logger", "none")
        stops += 1
        noise.append(largest_noise(checkpoint.latest(folder.checkpoints)))
        assert stops <= 5
    assert stops == 5
    # The network begins with 1. A phase without a limit leaves it about there; that of 2a is below
    # that, the last one's lower after the first of its two iterations, and after the second.
    limits = [PHASES[1].largest_noise(1.0)]
    limits += [PHASES[2].largest_noise(done) for done in (0.5, 1.0)]
    assert min(noise[:2]) > 0.9 > limits[0] > limits[1] > limits[2]
    assert noise[2:] == pytest.approx(limits, rel=1e-6)
    # Its weights go on from where they were: it begins, half is over; it is resumed, all is over.
    assert entered == [0.0, 0.0, 0.5, 0.5, 0.5, 1.0]
    shown = capsys.readouterr().out
    assert "minutes are over" in shown
    assert f"pronk train all --resume --out {folder.path}" in shown
    assert checkpoint.about(folder.last_of("jump_b"))["iteration"] == 5
    assert folder.policy.read_bytes() != b""
    found = provenance(folder)
    assert len(found["sessions"]) == 5
    before = provenance(uninterrupted)["phases"]
    for name, phase in found["phases"].items():
        assert phase["env_steps"] == before[name]["env_steps"]


def largest_noise(path: Path) -> float:
    """Largest standard deviation of an action, in a checkpoint."""
    actor = checkpoint.load(path).tree["algorithm"]["actor_state_dict"]
    return float(actor["distribution.std_param"].max())


def test_killed_without_warning_it_loses_one_interval(tmp_path):
    folder = RunFolder(tmp_path / "run")
    code = "import sys; from pronk.cli import main as cli; sys.exit(cli.run(sys.argv[1:]))"
    words = ["train", *ALL, "--save-interval", "1", "--out", str(folder.path)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen([sys.executable, "-c", code, *words], env=environment)
    try:
        until = time.monotonic() + 300.0
        while checkpoint.latest(folder.checkpoints) is None:
            assert process.poll() is None
            assert time.monotonic() < until
            time.sleep(0.05)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert not provenance(folder)["finished"]
    assert train("all", "--resume", "--logger", "none", "--out", folder.path) == 0
    assert provenance(folder)["finished"]
    assert checkpoint.about(folder.last_of("jump_b"))["iteration"] == 5


def test_interrupted_by_hand_it_says_how_to_go_on(tmp_path, capsys):
    folder = RunFolder(tmp_path / "run")
    over = threading.Event()

    def interrupt() -> None:
        while checkpoint.latest(folder.checkpoints) is None:
            if over.wait(0.05):
                return
        os.kill(os.getpid(), signal.SIGINT)

    watcher = threading.Thread(target=interrupt)
    watcher.start()
    words = ("walk", "--gains", "naive", *SMALL, "--phase", "walk=100000", "--save-interval", "1")
    status = train(*words, "--out", folder.path)
    over.set()
    watcher.join()
    shown = capsys.readouterr()
    assert status == 130, shown.err
    assert "stopped: SIGINT" in shown.out
    assert f"pronk train walk --resume --out {folder.path}" in shown.out
    assert shown.err.rstrip().endswith("pronk: interrupted.")
    (session,) = provenance(folder)["sessions"]
    assert session["end"]
    assert session["stopped"] == "SIGINT"


def test_a_finished_run_is_left_as_it_is(uninterrupted, capsys):
    before = uninterrupted.provenance.read_bytes()
    assert train("all", "--resume", "--out", uninterrupted.path) == 0
    assert "pronk evaluate" in capsys.readouterr().out
    assert uninterrupted.provenance.read_bytes() == before


def test_what_cannot_be_drawn_leaves_no_folder(tmp_path, capsys):
    # Naive gains on their own have no ellipsoid to draw from.
    words = ("walk", "--gains", "naive", *SMALL, "--ellipsoid", "--out", tmp_path / "run")
    assert train(*words) == 2
    assert "ellips" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


# --- One phase at a time -------------------------------------------------------------------------


def test_a_walking_run_keeps_its_gains(walked):
    found = provenance(walked)
    config = yaml.safe_load(walked.config.read_text())
    assert found["gains"]["name"] == "matched"
    assert found["gains"]["virtual"]
    assert found["gains"]["sha256"] == config["settings"]["gains_sha256"]
    assert json.loads((walked.path.parent / "figures.json").read_text()) == found
    assert not walked.walk.exists()
    assert walked.policy.exists()
    assert any(p.name.startswith("events.out") for p in walked.path.iterdir())


def test_changed_gains_are_not_resumed(walked, tmp_path, capsys):
    folder = RunFolder(tmp_path / "run")
    folder.checkpoints.mkdir(parents=True)
    found = provenance(walked) | {"finished": False}
    folder.provenance.write_text(json.dumps(found))
    folder.config.write_text(walked.config.read_text())
    folder.gains.write_text(walked.gains.read_text() + "# by hand\n")
    assert train("walk", "--resume", "--out", folder.path) == 2
    said = capsys.readouterr().err
    assert "gains.yaml: missing or changed since the run began" in said


def test_jumping_begins_where_walking_ended(walked, tmp_path, capsys):
    folder, begun = RunFolder(tmp_path / "jump"), tmp_path / "walk"
    shutil.copytree(walked.path, begun)
    last = RunFolder(begun).last_of("walk")
    found = checkpoint.load(last)
    found.tree["speed_ranges"].fill_(2500.0)
    checkpoint.save(last, found)
    words = ("jump", "--init-checkpoint", begun, "--gains", walked.gains, *SMALL)
    words += ("--phase", "jump_a=1", "--phase", "jump_b=1")
    assert train(*words, "--out", folder.path) == 0
    start, end = (checkpoint.load(path).tree for path in (last, folder.last_of("jump_a")))
    # Statistics go on: two rollouts of walking, one of jumping, 384 observations each.
    count = [int(t["algorithm"]["actor_state_dict"]["obs_normalizer.count"]) for t in (start, end)]
    assert count == [768, 1152]
    # So do the ranges of speed: as wide as they had grown, and nobody keeps up in a first rollout.
    assert end["speed_ranges"] == 2500.0
    found = provenance(folder)
    assert list(found["phases"]) == ["jump_a", "jump_b"]
    assert found["settings"]["start_sha256"] != ""
