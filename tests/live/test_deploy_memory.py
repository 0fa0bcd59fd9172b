"""Memory of a run: a small /dev/shm is refused, and the servo's does not grow."""

from __future__ import annotations

import gc
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from hopper import write_hopper
from pronk.errors import HardwareError
from pronk.links.address import Address
from pronk.runtime.ipc import Shared
from pronk.runtime.plan import Link, Plan
from pronk.runtime.servo import Servo

pytestmark = pytest.mark.live


def test_too_little_shared_memory_is_one_sentence(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    small = "mount -t tmpfs -o size=64k tmpfs /dev/shm && exec "
    unshare = ["unshare", "--mount", "--map-root-user", "sh", "-c"]
    if shutil.which("unshare") is None or subprocess.run([*unshare, small + "true"]).returncode:
        pytest.skip("file systems cannot be mounted here")
    policy = write_hopper(tmp_path / "policy.onnx")
    words = f"{sys.executable} -m pronk.cli.main deploy {policy} --script 0,0"
    done = subprocess.run([*unshare, small + words], capture_output=True, text=True)
    assert done.returncode == 2, done.stdout + done.stderr
    assert "/dev/shm" in done.stderr
    assert "Traceback" not in done.stderr


def test_nothing_is_kept_of_a_virtual_robot_that_is_not_captured(tmp_path: Path) -> None:
    link = Link(robot="mini_cheetah", address=Address.parse("sim://ground"))
    for capture in (None, tmp_path / "seen.npz"):
        shared = Shared()
        plan = Plan(link=link, policy=Path("none"), capture=capture, real_time=False)
        servo = Servo(plan, shared, (0.0, 1.0))
        servo.stop()
        servo.run()
        shared.close()
        gc.unfreeze()
        gc.enable()
        machine: Any = servo.machine
        if capture is None:
            with pytest.raises(HardwareError, match="nothing was captured"):
                machine.inner.capture()
        else:
            assert capture.exists()
