"""The hosts of one training: what `pronk train --hosts` asks each of before anything is written.

torchrunx starts a process for each GPU of each host, on this machine or over SSH, with the Python
of this process in this working directory. `check_hosts` runs this module in the same way first, on
all hosts at once, and refuses what would otherwise end in a timeout or in a training of two kinds
of robots: a host that cannot be reached, other versions, no shared folder, other GPUs.
"""

from __future__ import annotations

import contextlib
import fnmatch
import hashlib
import ipaddress
import logging
import os
import re
import shlex
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec

from pronk.errors import PronkError
from pronk.jump.train import devices

COPIED_VARIABLES = (
    *("PATH", "LD_LIBRARY*", "LIBRARY_PATH", "PYTHON*", "CUDA*", "TORCH*", "PYTORCH*", "NCCL*"),
    *("GLOO*", "OMP*", "MKL*", "MUJOCO*", "MJLAB*", "WARP*", "WANDB*"),
)
"""Environment variables that the processes of a training get; the first line is torchrunx's."""
CONNECT_S = 15
"""Longest wait for a connection over SSH or back to this machine [s]."""
ANSWER_S = 300
"""Longest wait for a host's answer [s]; importing PyTorch from a network drive takes a while."""
BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
"""File that tells two machines apart: random, drawn by Linux as it starts."""


@dataclass(frozen=True, kw_only=True)
class HostQuestion:
    """What a host is asked, in JSON on its command line."""

    robot: str
    """Name or robot.yaml of the robot."""
    device: str
    """`auto`, `cpu` or `cuda`."""
    gpu_ids: str | None
    """GPUs as in `--gpu-ids`; None for the first."""
    mark: str
    """File in the folder that all hosts share."""
    launcher: str
    """Name under which this machine is to be reached."""
    port: int
    """Port on which this machine listens."""


@dataclass(frozen=True, kw_only=True)
class HostFacts:
    """What a host answers, in JSON on its standard output."""

    host_name: str
    """Name under which the host knows itself, and the others reach it."""
    error: str = ""
    """Why it cannot train; the other fields then say nothing."""
    gpus: tuple[str, ...] = ()
    """Its GPUs for the training, as `CUDA_VISIBLE_DEVICES` names them; none for the CPU."""
    gpu_uuids: tuple[str, ...] = ()
    """Identity of each, the same from every system that sees the card."""
    device: dict[str, Any] = field(default_factory=dict)
    """Description of its devices, for the record."""
    versions: dict[str, str] = field(default_factory=dict)
    """Versions of the packages that it computes with."""
    sources_sha256: str = ""
    """Hash of the sources of its pronk."""
    robot_sha256: str = ""
    """Hash of the model of its robot."""
    boot_id: str = ""
    """Identity of the machine; empty where the system has none."""
    address: str = ""
    """Address to which its own name resolves."""
    shares_folder: bool = False
    """Whether it sees the marked folder and may write to it."""
    connection_error: str = ""
    """Why it cannot connect to this machine; empty if it can."""


@dataclass(frozen=True, kw_only=True)
class Host:
    """A host that is ready to train."""

    name: str
    """Its name as given."""
    facts: HostFacts

    @property
    def processes(self) -> int:
        """Number of its processes: one a GPU, or one on the CPU."""
        return max(len(self.facts.gpus), 1)

    def record(self) -> dict[str, Any]:
        """Return what provenance holds of it."""
        return {
            "name": self.name,
            "host_name": self.facts.host_name,
            "processes": self.processes,
            "device": self.facts.device,
        }


def parse_hosts(text: str) -> tuple[str, ...]:
    """Read the names of hosts.

    Args:
        text: Names or addresses with commas between them.

    Raises:
        PronkError: One is empty, is given twice, or has a user or a port.
    """
    names = tuple(name.strip() for name in text.split(","))
    for name in names:
        if name == "":
            raise PronkError(f"--hosts {text!r}: one name is empty; expected node1,node2.")
        if not _is_address(name) and re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", name) is None:
            raise PronkError(
                f"--hosts {text!r}: {name!r} is no host name; expected names or addresses alone, "
                "as in node1,node2. User, port and key belong in ~/.ssh/config."
            )
    if len({name.lower() for name in names}) != len(names):
        raise PronkError(f"--hosts {text!r}: one is given twice; once is enough.")
    return names


def check_hosts(
    names: Sequence[str], *, robot: str, device: str, gpu_ids: str | None, out: Path
) -> tuple[Host, ...]:
    """Ask all hosts whether they can train together; nothing is left written.

    Args:
        names: The hosts.
        robot: Name or robot.yaml of the robot.
        device: `auto`, `cpu` or `cuda`.
        gpu_ids: GPUs of each host, as in `--gpu-ids`.
        out: Folder of the run.

    Returns:
        The hosts in the same order.

    Raises:
        PronkError: They cannot; the message names the host.
    """
    launcher = socket.getfqdn()
    with _marked_folder(out) as mark, socket.create_server(("", 0), backlog=64) as listener:
        question = HostQuestion(
            robot=robot,
            device=device,
            gpu_ids=gpu_ids,
            mark=str(mark),
            launcher=launcher,
            port=listener.getsockname()[1],
        )
        command = probe_command(question)
        with ThreadPoolExecutor(max_workers=min(len(names), 32)) as pool:
            answers = list(pool.map(_ask, names, [command] * len(names)))
    hosts = []
    for name, facts in zip(names, answers, strict=True):
        hosts.append(Host(name=name, facts=facts))
    check_answers(hosts, own_facts(robot), question)
    return tuple(hosts)


def check_answers(hosts: Sequence[Host], own: HostFacts, question: HostQuestion) -> None:
    """Refuse hosts that cannot train together.

    Args:
        hosts: The hosts with their answers.
        own: What this machine computes with.
        question: What they were asked.

    Raises:
        PronkError: They cannot; the message names the host.
    """
    for host in hosts:
        _check_host(host.name, host.facts, own, question)
    _check_network(hosts, own, question)
    _check_gpus(hosts)


def probe_command(question: HostQuestion) -> str:
    """Return the command that asks a host, which starts Python as torchrunx does."""
    exports = []
    for name, value in os.environ.items():
        if any(fnmatch.fnmatch(name, pattern) for pattern in COPIED_VARIABLES):
            exports.append(shlex.quote(f"{name}={value}"))
    steps = [f"cd {shlex.quote(str(Path.cwd()))}"]
    if exports:
        steps.append(f"export {' '.join(exports)}")
    text = shlex.quote(msgspec.json.encode(question).decode())
    steps.append(f"{shlex.quote(sys.executable)} -m pronk.jump.train.hosts {text}")
    return " && ".join(steps)


def answer(question: HostQuestion) -> HostFacts:
    """Answer for the host that this process runs on."""
    try:
        facts = own_facts(question.robot)
        gpus = devices.find_devices(question.device, question.gpu_ids)
    except PronkError as error:
        return HostFacts(host_name=socket.getfqdn(), error=str(error))
    uuids = []
    if gpus:
        import torch

        visible = devices.visible_gpus()
        for name in gpus:
            properties = torch.cuda.get_device_properties(visible.index(name))
            uuids.append(str(properties.uuid))
    mark = Path(question.mark)
    connection_error = ""
    try:
        socket.create_connection((question.launcher, question.port), timeout=CONNECT_S).close()
    except OSError as error:
        connection_error = str(error) or type(error).__name__
    return replace(
        facts,
        gpus=gpus,
        gpu_uuids=tuple(uuids),
        device=devices.device_facts("cuda" if gpus else "cpu", len(gpus)),
        shares_folder=mark.is_file() and os.access(mark.parent, os.W_OK),
        connection_error=connection_error,
    )


def own_facts(robot: str) -> HostFacts:
    """Return what this machine computes with, without its devices."""
    from pronk.jump.train.versions import package_versions, sources_sha256
    from pronk.robots import load_robot

    model_text = load_robot(robot).build_spec().to_xml()
    boot_id = ""
    with contextlib.suppress(OSError):
        boot_id = BOOT_ID.read_text(encoding="ascii").strip()
    address = ""
    with contextlib.suppress(OSError):
        address = socket.gethostbyname(socket.gethostname())
    return HostFacts(
        host_name=socket.getfqdn(),
        versions=package_versions(),
        sources_sha256=sources_sha256(),
        robot_sha256=hashlib.sha256(model_text.encode()).hexdigest(),
        boot_id=boot_id,
        address=address,
    )


@contextlib.contextmanager
def _marked_folder(out: Path) -> Iterator[Path]:
    """Put a file beside the run's folder, or above it, as long as the block runs.

    Yields:
        The file, in the next folder that exists.
    """
    folder = out.resolve()
    while not folder.is_dir():
        folder = folder.parent
    try:
        mark = tempfile.NamedTemporaryFile(prefix=".pronk-hosts-", dir=folder)  # noqa: SIM115
    except OSError as error:
        raise PronkError(f"--out {out}: {folder} cannot be written to ({error}).") from error
    with mark:
        yield Path(mark.name)


def _ask(name: str, command: str) -> HostFacts:
    """Run the command on a host, as torchrunx will run its own; returns the answer."""
    try:
        is_local = _is_this_machine(name)
    except OSError as error:
        raise PronkError(
            f"--hosts: {name} does not resolve to an address here ({error}); expected a name in "
            "DNS or /etc/hosts, or an address. An alias in ~/.ssh/config alone is not enough."
        ) from error
    if is_local:
        output, errors = _ask_here(name, command)
    else:
        output, errors = _ask_over_ssh(name, command)
    last_line = output.strip().rpartition("\n")[2]
    try:
        return msgspec.json.decode(last_line, type=HostFacts)
    except msgspec.DecodeError:
        reason = errors.strip().rpartition("\n")[2] or last_line or "it printed nothing"
        raise PronkError(
            f"--hosts: {name} cannot run {sys.executable} -m pronk.jump.train.hosts in "
            f"{Path.cwd()} ({reason}); expected the same Python environment with the same pronk "
            "and the same working directory on every host, at the same paths."
        ) from None


def _ask_here(name: str, command: str) -> tuple[str, str]:
    """Run a command on this machine; returns what it printed."""
    try:
        process = subprocess.run(
            command, shell=True, capture_output=True, text=True, timeout=ANSWER_S, check=False
        )
    except subprocess.TimeoutExpired:
        raise _no_answer(name) from None
    return process.stdout, process.stderr


def _ask_over_ssh(name: str, command: str) -> tuple[str, str]:
    """Run a command over SSH, by torchrunx's library; returns what it printed."""
    import fabric
    import invoke.exceptions
    import paramiko

    # What it logs of a failed connection is a traceback; the error below says the same.
    logging.getLogger("paramiko").setLevel(logging.CRITICAL)
    try:
        with fabric.Connection(host=name, connect_timeout=CONNECT_S) as connection:
            result = connection.run(
                command, hide=True, warn=True, in_stream=False, timeout=ANSWER_S
            )
            return result.stdout, result.stderr
    except invoke.exceptions.CommandTimedOut:
        raise _no_answer(name) from None
    except (OSError, EOFError, paramiko.SSHException) as error:
        raise PronkError(
            f"--hosts: {name} cannot be reached over SSH ({error or type(error).__name__}); "
            f"expected `ssh -o BatchMode=yes {name} true` to work from here without a password. "
            "User, port and key belong in ~/.ssh/config."
        ) from error


def _no_answer(name: str) -> PronkError:
    """Return the error of a host that can be reached and says nothing."""
    return PronkError(
        f"--hosts: {name} has not answered within {ANSWER_S} s; expected a host that imports "
        "PyTorch and MuJoCo Warp in less."
    )


def _is_this_machine(name: str) -> bool:
    """Return whether torchrunx starts the processes of a host without SSH."""
    address = name if _is_address(name) else socket.gethostbyname(name)
    if ipaddress.ip_address(address).is_loopback:
        return True
    own_addresses = {entry[4][0] for entry in socket.getaddrinfo(socket.gethostname(), None)}
    return address in own_addresses


def _is_address(name: str) -> bool:
    """Return whether a name is an address of IP."""
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _check_host(name: str, facts: HostFacts, own: HostFacts, question: HostQuestion) -> None:
    """Refuse a host that cannot train as this machine would."""
    if facts.error:
        raise PronkError(f"--hosts: {name}: {facts.error}")
    for package, version in own.versions.items():
        if facts.versions.get(package) != version:
            raise PronkError(
                f"--hosts: {name} has {package} {facts.versions.get(package, 'of no version')}, "
                f"this machine {version}; install the same on every host."
            )
    if facts.sources_sha256 != own.sources_sha256:
        raise PronkError(
            f"--hosts: {name} has other sources of pronk than this machine, though of the same "
            "version; install the same on every host."
        )
    if facts.robot_sha256 != own.robot_sha256:
        raise PronkError(
            f"--hosts: the model of {question.robot} on {name} is another than on this machine; "
            "put the same files on every host."
        )
    if not facts.shares_folder:
        raise PronkError(
            f"--hosts: {name} does not see {Path(question.mark).parent} of this machine, or may "
            "not write to it; --out has to be in a folder that all hosts share, at the same path."
        )


def _check_network(hosts: Sequence[Host], own: HostFacts, question: HostQuestion) -> None:
    """Refuse machines that cannot connect to each other."""
    machines = [("this machine", own)]
    for host in hosts:
        machines.append((host.name, host.facts))
    are_several = len({facts.boot_id for _, facts in machines}) > 1
    if are_several and "GLOO_SOCKET_IFNAME" not in os.environ:
        for name, facts in machines:
            if facts.address and ipaddress.ip_address(facts.address).is_loopback:
                raise PronkError(
                    f"--hosts: {name} resolves its own name to {facts.address}, to which other "
                    "hosts cannot connect. Give its address in its /etc/hosts, or name the "
                    "network device of all hosts, as in GLOO_SOCKET_IFNAME=eth0 "
                    "NCCL_SOCKET_IFNAME=eth0 before pronk."
                )
    for host in hosts:
        if host.facts.connection_error:
            raise PronkError(
                f"--hosts: {host.name} cannot connect to this machine as {question.launcher} "
                f"({host.facts.connection_error}); expected a name that it resolves, and no "
                "firewall between the hosts: processes talk on ports that the system chooses."
            )


def _check_gpus(hosts: Sequence[Host]) -> None:
    """Refuse hosts with other GPUs than the first, and a card that two names lead to."""
    first = hosts[0]
    owners: dict[str, str] = {}
    for host in hosts:
        if host.facts.gpus != first.facts.gpus:
            raise PronkError(
                f"--hosts: {first.name} would train on {_gpus_text(first)}, {host.name} on "
                f"{_gpus_text(host)}; expected the same numbers on every host: give --gpu-ids "
                "with those that all have, or --device cpu."
            )
        for uuid in host.facts.gpu_uuids:
            if uuid in owners:
                raise PronkError(
                    f"--hosts: {owners[uuid]} and {host.name} are one machine, with the GPU "
                    f"{uuid}; give it once."
                )
            owners[uuid] = host.name


def _gpus_text(host: Host) -> str:
    """Return the GPUs of a host in words."""
    if not host.facts.gpus:
        return "its CPU"
    return f"GPU {', '.join(host.facts.gpus)}"


def _main() -> None:
    """Answer the question on the command line."""
    question = msgspec.json.decode(sys.argv[1], type=HostQuestion)
    sys.stdout.write(msgspec.json.encode(answer(question)).decode() + "\n")


if __name__ == "__main__":
    _main()
