"""The recorder that uses Unitree's SDK alone, on the virtual Go2: its CSV file is matched as it is.

The SDK is the registry's; its bytes go over the loopback domain of the tests, whose discovery is by
addresses and not by multicast, which is the one thing that differs from a robot.
"""

from __future__ import annotations

import multiprocessing
import sys
from importlib.util import module_from_spec, spec_from_file_location
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("cyclonedds")
pytest.importorskip("unitree_sdk2py")

from dds_domain import own_domain
from pronk.deploy.bench.dds_server import DdsServerTransport
from pronk.deploy.bench.server import RobotServer
from pronk.deploy.links.dds.link import ON_LOOPBACK
from pronk.deploy.links.realtime import RealTimeSettings, enter
from pronk.deploy.runtime.sweep import SweepTask
from pronk.deploy.runtime.sweep_recorder import record_sweep
from pronk.identify.excitation.plan import make_plan
from pronk.identify.excitation.signals import Chirp
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.logs.options import ReadOptions
from pronk.identify.logs.readers import read_log
from pronk.identify.match.match import match
from pronk.identify.match.settings import MatchSettings
from pronk.jump.virtual.robot import VirtualRobot, hold_of
from pronk.jump.virtual.sim_params import load_sim_params
from pronk.robots import load_robot

pytestmark = pytest.mark.live

GO2 = load_robot("go2")
RECORDER = Path(__file__).parents[2] / "examples" / "recorders" / "unitree_go2.py"
DOMAIN = own_domain()
"""Domain of this process: two test processes on one computer must not reach each other."""
JOINT = "FL_hip_pitch"
AMPLITUDES = (0.25, 0.125)
CHIRP_S = 10.0
"""Half of the recorder's own, so that the test is short [s]."""


def serve(domain: int, mode: str, end: Connection) -> None:
    """Body of the process with the virtual Go2, hung up."""
    enter(RealTimeSettings(priority=30, lock=False))
    robot = VirtualRobot(GO2, load_sim_params(None, GO2))
    robot.connect()
    server = RobotServer(
        robot, DdsServerTransport(GO2, domain=domain, mode=mode), hold=hold_of(GO2)
    )
    end.send("ready")
    server.run(end.poll)


def record(domain: int, path: Path, end: Connection) -> None:
    """Body of the recorder's process, with fewer and shorter chirps; sends what ended it."""
    from unitree_sdk2py.core import channel

    enter(RealTimeSettings(priority=20, lock=False))
    channel.ChannelConfigHasInterface = ON_LOOPBACK
    recorder: Any = recorder_module()
    recorder.AMPLITUDES = AMPLITUDES
    recorder.CHIRP_S = CHIRP_S
    reason = ""
    try:
        recorder.record("lo", GO2.joint(JOINT).own_name, path, domain)
    except SystemExit as error:
        reason = str(error)
    end.send(reason)


def recorder_module() -> Any:
    """Load the example."""
    spec = spec_from_file_location("unitree_go2", RECORDER)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    sys.modules["unitree_go2"] = module
    spec.loader.exec_module(module)
    return module


def recorded(mode: str, path: Path) -> str:
    """Run the recorder on a virtual Go2 that a controller holds at first; return what ended it."""
    context = multiprocessing.get_context("spawn")
    end, other = context.Pipe()
    robot = context.Process(target=serve, args=(DOMAIN, mode, other), daemon=True)
    robot.start()
    try:
        assert end.recv() == "ready"
        recorder_end, recorder_other = context.Pipe()
        program = context.Process(target=record, args=(DOMAIN, path, recorder_other), daemon=True)
        program.start()
        assert recorder_end.poll(180.0)
        reason = str(recorder_end.recv())
        program.join(30.0)
        return reason
    finally:
        robot.kill()


def swept(out: Path) -> JointLog:
    """The same chirps by pronk's own sweep, on the virtual clock."""
    recorder = recorder_module()
    signal = Chirp(length_s=CHIRP_S, start_hz=recorder.LOW_HZ, stop_hz=recorder.HIGH_HZ)
    plan = make_plan(GO2, [JOINT], signal, amplitudes=AMPLITUDES, repeats=1)
    robot = VirtualRobot(GO2, load_sim_params(None, GO2), seed=1, legs=(JOINT[:2],))
    record_sweep(robot, SweepTask(plan=plan, out_dir=out))
    return read_log(out / f"{JOINT}.mcap", robot=GO2)


def test_a_motion_service_that_is_on_is_named_and_nothing_is_sent(tmp_path: Path) -> None:
    path = tmp_path / "chirp.csv"
    assert "normal" in recorded("normal", path)
    assert not path.exists()


def test_its_csv_has_the_gains_of_a_sweep(tmp_path: Path) -> None:
    path = tmp_path / "chirp.csv"
    assert recorded("", path) == ""
    log = read_log(path, robot=GO2, options=ReadOptions(unit="rad"))
    assert log.joints == (JOINT,)
    settings = MatchSettings(threads=1, zero_armature=False)
    by_sdk = match([log], GO2, settings=settings, drive_gains="default").joints[JOINT]
    by_sweep = match([swept(tmp_path / "logs")], GO2, settings=settings).joints[JOINT]
    for name in ("stiffness", "damping", "frictionloss"):
        low, high = by_sdk.fit.total95[name]
        low_of_sweep, high_of_sweep = by_sweep.fit.total95[name]
        assert max(low, low_of_sweep) <= min(high, high_of_sweep), name
