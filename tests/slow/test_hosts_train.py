"""One training on several hosts, over a real SSH server where there is one, and on this one."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("mjlab")
from mjlab.scripts.train import TrainConfig

from command_line import FinishedCommand, invoke
from pronk.jump.train.gains import training_gains
from pronk.jump.train.launch import LOCAL_HOST, launch
from pronk.jump.train.phases import TASKS
from pronk.jump.train.provenance import RunFolder
from pronk.jump.train.rl import checkpoint
from pronk.jump.train.tasks import load_task
from termination import terminated

pytestmark = [pytest.mark.train, pytest.mark.xdist_group("hosts")]

HOSTS = ("198.51.100.1", "198.51.100.2")
"""Addresses that documentation may use (RFC 5737), which no machine has; ~/.ssh/config leads both
to the server of this test."""
ITERATIONS = 2
WORDS = ("train", "walk", "--device", "cpu")
NEW = ("--gains", "naive", "--envs", "8", "--save-interval", "1", "--phase", f"walk={ITERATIONS}")
SSHD = shutil.which("sshd", path=f"{os.environ.get('PATH', '')}:/usr/sbin:/usr/local/sbin")


def free_port() -> int:
    """Return a port of this machine on which nothing listens."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return int(listener.getsockname()[1])


def write_ssh_config(home: Path, port: int) -> None:
    """Write the ~/.ssh/config that leads the names of the hosts to a port of this machine."""
    (home / ".ssh").mkdir()
    (home / ".ssh" / "config").write_text(
        f"Host {' '.join(HOSTS)}\n  HostName 127.0.0.1\n  Port {port}\n"
        f"  IdentityFile {home / 'key'}\n"
    )


@pytest.fixture
def ssh_home(tmp_path: Path) -> Iterator[Path]:
    """A home folder from which both hosts are reached over SSH without a password."""
    keygen = shutil.which("ssh-keygen")
    if SSHD is None or keygen is None:
        pytest.skip("needs an SSH server (openssh-server)")
    home = tmp_path / "home"
    home.mkdir()
    for name in ("key", "host_key"):
        subprocess.run([keygen, "-q", "-t", "ed25519", "-N", "", "-f", home / name], check=True)
    port = free_port()
    write_ssh_config(home, port)
    if os.geteuid() == 0:
        Path("/run/sshd").mkdir(exist_ok=True)  # into which sshd locks itself before the login
    (home / "sshd_config").write_text(
        f"Port {port}\nListenAddress 127.0.0.1\nHostKey {home / 'host_key'}\n"
        f"AuthorizedKeysFile {home / 'key.pub'}\nStrictModes no\nPidFile none\n"
        "PasswordAuthentication no\nKbdInteractiveAuthentication no\nUsePAM no\n"
    )
    with (home / "sshd.log").open("w") as log:
        server = subprocess.Popen([SSHD, "-D", "-e", "-f", home / "sshd_config"], stderr=log)
    try:
        while server.poll() is None:
            try:
                socket.create_connection(("127.0.0.1", port), timeout=5).close()
                break
            except OSError:
                time.sleep(0.05)
        if server.poll() is not None:
            pytest.skip(f"sshd does not start: {(home / 'sshd.log').read_text()}")
        yield home
    finally:
        server.terminate()
        server.wait()


@pytest.fixture(autouse=True)
def one_core(monkeypatch: pytest.MonkeyPatch) -> None:
    """Train on the CPU, each process on one core."""
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    monkeypatch.setenv("OMP_NUM_THREADS", "1")


def trained(*arguments: str | Path) -> FinishedCommand:
    """Run `pronk train` of a small walking policy in this process, and what it starts."""
    return invoke([*WORDS, *arguments])


def weights(path: Path) -> dict[str, torch.Tensor]:
    """Return the tensors of the actor and the critic in a checkpoint, by name."""
    state = checkpoint.read_checkpoint(path)
    tensors = {}
    for part in ("actor_state_dict", "critic_state_dict"):
        for name, tensor in state[part].items():
            tensors[f"{part} {name}"] = tensor
    return tensors


def test_two_hosts_over_ssh_train_as_two_processes_of_one_host(
    tmp_path: Path, ssh_home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hosts = ("--hosts", ",".join(HOSTS))
    folder = RunFolder(tmp_path / "ssh")
    monkeypatch.setenv("HOME", str(ssh_home))
    first = trained(*NEW, *hosts, "--minutes", "0.0001", "--out", folder.path)
    assert first.exit_code == 0, first.output
    assert (ssh_home / "sshd.log").read_text().count("Accepted publickey") >= 4
    assert not list(tmp_path.glob(".pronk-hosts-*"))
    record = folder.read()
    session = record["sessions"][0]
    assert (session["processes"], session["stopped"] != "") == (2, True)
    assert [host["name"] for host in session["hosts"]] == list(HOSTS)
    assert len(list(folder.path.glob("events.out.*"))) == 1
    assert (folder.path / "train.1.log").is_file()
    resume = next(line for line in first.stdout.splitlines() if "--resume" in line)
    assert ",".join(HOSTS) in resume

    # The same by one agent on this host, as --gpu-ids 0,1 does.
    task = load_task("mini_cheetah")
    iterations = {**TASKS["walk"], "walk": ITERATIONS}
    env = task.env_cfg(
        task.robot,
        training_gains("naive", task.robot),
        iterations=iterations,
        num_envs=8,
        seed=1,
    )
    agent = task.rl_cfg(iterations=ITERATIONS, seed=1)
    agent.save_interval = 1
    agent.stop_at = 1.0
    single_host = tmp_path / "single"
    single_host.mkdir()
    launch(TrainConfig(env=env, agent=agent), single_host, (LOCAL_HOST,), 2)
    expected = weights(single_host / "model_0.pt")
    actual = weights(folder.path / "model_0.pt")
    assert expected.keys() == actual.keys()
    for name, tensor in expected.items():
        assert torch.equal(tensor, actual[name]), name

    # One process has half as many robots.
    refused = trained("--resume", "--out", folder.path)
    assert refused.exit_code == 2
    assert "2 processes" in refused.output
    resumed = trained("--resume", *hosts, "--out", folder.path)
    assert resumed.exit_code == 0, resumed.output
    record = folder.read()
    assert record["finished"]
    assert record["phases"]["walk"]["env_steps"] == ITERATIONS * 24 * 8 * 2
    assert (folder.path / "policy.onnx").is_file()


def test_a_terminated_training_on_hosts_leaves_a_checkpoint(tmp_path: Path) -> None:
    """The names are one machine, which a CPU may do; a GPU may not."""
    folder = RunFolder(tmp_path / "run")
    long = ("--gains", "naive", "--envs", "8", "--save-interval", "1", "--phase", "walk=100000")
    with terminated(lambda: checkpoint.latest_checkpoint(folder.path) is not None):
        stopped = trained(*long, "--hosts", "localhost,127.0.0.1", "--out", folder.path)
    assert stopped.exit_code == 130, stopped.output
    assert "--hosts localhost,127.0.0.1" in stopped.output
    # Also on a busy machine, where the last iteration may take longer than it is waited for.
    assert folder.read()["sessions"][0]["stopped"] == "SIGTERM"
    assert checkpoint.read_checkpoint(folder.checkpoint())["infos"]["processes"] == 2


def test_a_host_without_an_ssh_server_is_refused_and_nothing_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    home = tmp_path / "home"
    home.mkdir()
    write_ssh_config(home, free_port())
    monkeypatch.setenv("HOME", str(home))
    refused = trained(*NEW, "--hosts", f"localhost,{HOSTS[0]}", "--out", tmp_path / "run")
    assert refused.exit_code == 2
    for word in (HOSTS[0], "SSH", "~/.ssh/config"):
        assert word in refused.output
    assert "Traceback" not in refused.output
    assert [path.name for path in tmp_path.iterdir()] == ["home"]
