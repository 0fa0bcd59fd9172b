"""Simulators in another Python: an environment of its own that has NumPy and nothing else."""

from __future__ import annotations

import os
import subprocess
import sys
import time
import venv
from pathlib import Path

import numpy as np
import pytest

from command_line import accepted, invoke
from log_files import write_mcap
from pronk.errors import PronkError
from pronk.exit_status import ExitStatus
from pronk.identify.excitation.signals import Chirp
from pronk.identify.match.gains import load_gains
from pronk.identify.simulators.links import links_of
from pronk.identify.simulators.load import joint_rigs, load_simulator
from pronk.robots import load_robot
from pronk.testing import check_simulator
from synthetic_log import Excitation, synthetic_log

ROBOT = load_robot("mini_cheetah")
EXAMPLE = f"{Path(__file__).parents[2] / 'examples' / 'my_simulator.py'}:Pendulum"
ADAPTERS = '''
import os, time
import numpy as np
from pronk.errors import PronkError
from pronk.identify.simulators.info import SimulatorInfo
from pronk.identify.simulators.links import links_of

class Resting:
    """Positions at rest of one chain."""
    info, joints = SimulatorInfo(engine="rest"), ("FR_hip_roll", "FR_hip_pitch", "FR_knee")
    parameters = frozenset({"stiffness", "damping"})

    def __init__(self, robot):
        print("an engine prints")
        self.links = links_of(robot, "FR_hip_roll")

    def rollout(self, command, values, *, locked=()):
        os.write(1, b"more than once")
        positions = np.empty(command.shape)
        for run, step in np.ndindex(command.shape[:2]):
            positions[run, step] = self.links.rest(command[run, step], values["stiffness"][run])
        return positions

class Modelled(Resting):
    def __init__(self, robot):
        robot.build_spec()

class Failing(Resting):
    def rollout(self, command, values, *, locked=()):
        if locked:
            raise PronkError("a sentence.")
        return 1 / 0

class Ending(Resting):
    def rollout(self, command, values, *, locked=()):
        os.write(2, b"a last word\\n")
        os._exit(7)

class Endless(Resting):
    def rollout(self, command, values, *, locked=()):
        open(os.environ["PID_FILE"], "w").write(f"{os.getpid()}\\n")
        while True:
            time.sleep(0.01)
'''


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Python that can import NumPy, not SciPy or MuJoCo."""
    folder = tmp_path_factory.mktemp("other")
    venv.create(folder, symlinks=True)
    (site,) = folder.glob("lib/python*/site-packages")
    for package in Path(np.__file__).parents[1].glob("numpy*"):
        (site / package.name).symlink_to(package)
    code = "import importlib.util as u, numpy; assert not (u.find_spec('mujoco'))"
    subprocess.run([folder / "bin" / "python", "-c", code], check=True)
    return folder / "bin" / "python"


@pytest.fixture(scope="module")
def adapters(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("adapters") / "adapters.py"
    file.write_text(ADAPTERS, encoding="utf-8")
    return file


def test_it_gives_the_same_positions_to_the_last_bit(python: Path) -> None:
    local = load_simulator(EXAMPLE, ROBOT)
    generator = np.random.default_rng(0)
    command = 0.1 * generator.normal(size=(3, 50, 12)).cumsum(axis=1)
    values = {
        "stiffness": generator.uniform(1.0, 2.0, (3, 12)),
        "damping": generator.uniform(1.0, 2.0, (3, 12)),
    }
    with load_simulator(EXAMPLE, ROBOT, python=python) as remote:  # type: ignore[attr-defined]
        assert remote.info == local.info
        assert remote.joints == local.joints
        assert remote.parameters == local.parameters
        position = remote.rollout(command, values, locked=("FL_knee",))
        assert np.array_equal(position, local.rollout(command, values, locked=("FL_knee",)))
        check_simulator(remote)


def test_commands_give_the_same_gains_and_replays(python: Path, tmp_path: Path) -> None:
    chirp = Excitation(offsets=Chirp(length_s=8.0).samples())
    rigs = joint_rigs(EXAMPLE, ROBOT)
    log = synthetic_log(ROBOT, "FR_knee", [chirp], 19.3, 0.41, simulator=rigs)
    write_mcap(tmp_path / "log.mcap", log)
    gains = tmp_path / "gains.yaml"
    figures = tmp_path / "figures.json"
    local = [tmp_path / "log.mcap", "--robot", ROBOT.name, "--simulator", EXAMPLE]
    remote = [*local, "--simulator-python", python]
    assert invoke(["match", *remote, "--out", gains]).exit_code in (0, ExitStatus.NOT_BETTER)
    assert load_gains(gains).joints["FR_knee"].stiffness.value == pytest.approx(19.3, rel=2e-3)
    replays = []
    for words in (local, remote):
        accepted("predict", *words, "--gains", gains, "--json", figures)
        replays.append(figures.read_text())
    assert replays[0] == replays[1]


def test_chains_arrive_as_they_are_and_prints_do_no_harm(python: Path, adapters: Path) -> None:
    command = np.full((2, 4, 3), 0.3)
    stiffness = np.array([[10.0] * 3, [20.0] * 3])
    with load_simulator(f"{adapters}:Resting", ROBOT, python=python) as remote:  # type: ignore[attr-defined]
        position = remote.rollout(command, {"stiffness": stiffness, "damping": stiffness})
    links = links_of(ROBOT, "FR_hip_roll")
    for run in range(2):
        expected = links.rest(command[run, 0], stiffness[run])
        assert np.array_equal(position[run], np.tile(expected, (4, 1)))
    assert np.ptp(position) > 1e-3


def test_what_fails_there_is_one_sentence_here(python: Path, adapters: Path) -> None:
    command = np.zeros((1, 2, 3))
    failing = load_simulator(f"{adapters}:Failing", ROBOT, python=python)
    with pytest.raises(PronkError, match=r"Failing in .*python: a sentence\."):
        failing.rollout(command, {}, locked=("FR_knee",))
    with pytest.raises(PronkError, match="ZeroDivisionError"):  # It goes on after an error.
        failing.rollout(command, {})
    ending = load_simulator(f"{adapters}:Ending", ROBOT, python=python)
    with pytest.raises(PronkError, match="status 7: a last word"):
        ending.rollout(command, {})
    for choice, program, words in (
        (f"{adapters}:Modelled", python, "links_of"),
        (f"{adapters}:Missing", python, "Resting"),
        (f"{python.parent}/no.py:Name", python, "no file"),
        ("mujoco", python, "--simulator"),
        (EXAMPLE, Path("no/python"), "cannot be started"),
        (EXAMPLE, Path("/bin/false"), "status 1"),
    ):
        with pytest.raises(PronkError, match=words):
            load_simulator(choice, ROBOT, python=program)


def test_it_ends_with_a_killed_parent(python: Path, adapters: Path, tmp_path: Path) -> None:
    pid_file = tmp_path / "pid"
    code = (
        "import numpy as np; from pathlib import Path; from pronk.robots import load_robot\n"
        "from pronk.identify.simulators.load import load_simulator\n"
        f"s = load_simulator({str(adapters) + ':Endless'!r}, load_robot('mini_cheetah'),\n"
        f"    python=Path({str(python)!r}))\n"
        "s.rollout(np.zeros((1, 2, 3)), {})\n"
    )
    environment = {**os.environ, "PID_FILE": str(pid_file)}
    parent = subprocess.Popen([sys.executable, "-c", code], env=environment)
    while not (pid_file.exists() and pid_file.read_text().endswith("\n")):
        assert parent.poll() is None
        time.sleep(0.02)
    parent.kill()
    parent.wait()
    child = Path(f"/proc/{pid_file.read_text().strip()}/stat")
    for _ in range(1500):
        # A zombie of a container without an init has ended too.
        if not child.exists() or child.read_text().rsplit(")", 1)[1].split()[0] == "Z":
            return
        time.sleep(0.02)
    pytest.fail("the simulator outlived its parent")
