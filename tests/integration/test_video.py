"""Films of a capture: moments, camera and labels; the files, where there is a GL."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from hopper import DEFAULT, ROBOT, write_hopper
from pronk.errors import PronkError
from pronk.jump.trial.films import record, render
from pronk.jump.trial.films.film import FPS, Film, JumpEvents, plan_film
from pronk.jump.trial.protocol import Case
from pronk.jump.trial.trial import TrialPlan, TrialSetup, run_trial
from pronk.jump.virtual.capture import Capture
from pronk.jump.virtual.sim_params import load_sim_params
from pronk.opengl import keep_opengl_out, requested_opengl
from pronk.policy.script import STILL, Script
from seen_jump import STANDING, G, motion

RATE = 200.0
LIFTOFF = 1.0
RISE_SPEED = 2.0
FLIGHT = 2.0 * RISE_SPEED / G
EVENTS = JumpEvents(on=0.8, off=1.3, liftoff=LIFTOFF, touchdown=LIFTOFF + FLIGHT)
SIZE = (640, 400)


def captured(*, direction: float = 0.0, yaw: float = 0.0, speed: float = 1.0) -> Capture:
    """Three seconds at standing height and constant speed, in ballistic flight from 1 s on."""
    time = np.arange(0.0, 3.0, 1.0 / RATE)
    t = np.where((time >= LIFTOFF) & (time < LIFTOFF + FLIGHT), time - LIFTOFF, 0.0)
    position = np.outer(speed * time, (math.cos(direction), math.sin(direction), 0.0))
    position[:, 2] = STANDING + RISE_SPEED * t - 0.5 * G * t**2
    return motion(
        time,
        position=position,
        orientation=np.tile([math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)], (len(time), 1)),
        joint_position=np.tile(DEFAULT, (len(time), 1)),
    )


def planned(capture: Capture | None = None, **changes: Any) -> Film:
    kept: dict[str, Any] = {"robot": ROBOT.name, "title": "forward 1", "events": EVENTS}
    kept["span"] = (LIFTOFF - 1.0, LIFTOFF + FLIGHT + 1.2)
    return plan_film(capture or captured(), **(kept | changes))


def test_only_the_flight_is_slowed_down() -> None:
    real = planned(span=(0.2, 2.5))
    slow = planned(span=(0.2, 2.5), slow=4.0)
    assert real.time == pytest.approx(0.2 + np.arange(len(real.time)) / FPS)
    flying = (slow.time > LIFTOFF) & (slow.time < LIFTOFF + FLIGHT)
    assert (slow.rate[flying] == 0.25).all()
    assert np.count_nonzero(flying) == pytest.approx(4.0 * FLIGHT * FPS, abs=1.5)
    far = (slow.time < LIFTOFF - 0.1) | (slow.time > LIFTOFF + FLIGHT + 0.1)
    assert (slow.rate[far] == 1.0).all()
    assert np.diff(slow.time) == pytest.approx(slow.rate[:-1] / FPS)


def test_frames_are_of_the_capture_and_the_camera_follows_smoothly() -> None:
    source = captured(yaw=0.4)
    film = planned(source, span=(0.2, 2.8))
    rows = np.rint(film.time * RATE).astype(int)
    qpos = np.hstack([source.position, source.orientation, source.joint_position])
    assert film.qpos == pytest.approx(qpos[rows])
    assert (film.jumping == ((film.time >= 0.8) & (film.time < 1.3))).all()
    middle = (film.time > 0.8) & (film.time < 2.2)
    assert film.look[middle, 0] == pytest.approx(film.qpos[middle, 0], abs=0.01)
    assert np.ptp(film.look[:, 2]) < 0.5 * np.ptp(film.qpos[:, 2])


@given(direction=st.floats(-math.pi, math.pi), yaw=st.floats(-math.pi, math.pi))
def test_the_robot_travels_to_the_right_and_shows_its_face(direction: float, yaw: float) -> None:
    film = planned(captured(direction=direction, yaw=yaw), span=(0.9, 1.1))
    assert math.cos(film.direction - direction) == pytest.approx(1.0)
    ahead = np.array([math.cos(direction), math.sin(direction), 0.0])
    points = np.array([-0.1 * ahead, 0.1 * ahead])
    pixels = render.project(points, np.zeros(3), film.azimuth, SIZE)
    assert pixels[1, 0] > pixels[0, 0]
    # The view is more against the heading than at a right angle to the direction of travel.
    if abs(math.cos(direction - yaw)) > 0.51:
        assert math.cos(film.azimuth - yaw) < math.cos(film.direction + 0.5 * math.pi - yaw)


def test_a_robot_that_stands_is_seen_by_its_heading() -> None:
    film = planned(captured(speed=0.0, yaw=0.7), events=None, span=(0.0, 0.5))
    assert film.direction == pytest.approx(0.7)
    assert (film.labels, film.jumping.any()) == ((), False)


def test_the_strip_has_the_moments_of_the_jump() -> None:
    film = planned()
    at = dict(zip(film.labels, film.pose_time, strict=True))
    assert list(at) == ["crouch", "lift-off", "", "apex", "touchdown", "landed"]
    assert at["lift-off"] == pytest.approx(0.0)
    assert at["apex"] == pytest.approx(RISE_SPEED / G, abs=1.0 / RATE)
    assert at["touchdown"] == pytest.approx(FLIGHT, abs=1.0 / RATE)
    apex = film.pose_qpos[film.labels.index("apex"), 2]
    assert apex == pytest.approx(STANDING + RISE_SPEED**2 / (2.0 * G), abs=1e-3)
    assert (np.diff(film.pose_time) > 0.0).all()


def test_every_frame_says_that_the_robot_is_virtual() -> None:
    image = Image.new("RGB", SIZE, (120, 120, 120))
    render.draw_frame(image, planned(), 3)
    assert (np.asarray(image.crop((SIZE[0] - 110, 0, SIZE[0], 40))) != 120).any()


@pytest.fixture(scope="module")
def backend() -> str:
    try:
        return record.find_gl()
    except PronkError as error:
        pytest.skip(str(error))


def test_files_are_rendered(backend: str, tmp_path: Path) -> None:
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    film = planned(span=(0.95, 1.15))
    warnings: list[str] = []
    files = record.record_film(film, tmp_path / "jump", warn=warnings.append)
    assert [path.name for path in files] == ["jump.mp4", "jump.gif", "jump.png"]
    assert sorted(tmp_path.iterdir()) == sorted(files)
    assert not warnings
    count = len(film.time)
    reader = imageio_ffmpeg.read_frames(str(files[0]))
    assert next(reader)["fps"] == FPS
    images = []
    for raw in reader:
        images.append(np.frombuffer(raw, np.uint8).reshape(*SIZE[::-1], 3))
    assert len(images) == count
    assert (images[0] != images[-1]).any()
    # The orange tape at the place of lift-off is where `project` puts it.
    end = render.tape_points(film, -0.9)[0]
    ((x, y),) = render.project(end[None], film.look[0], film.azimuth, SIZE)
    red, green, blue = images[0][round(y), round(x)].astype(int)
    assert red > green + 40 > blue + 80
    with Image.open(files[1]) as gif:
        assert gif.n_frames == math.ceil(count / 2)
        assert gif.info["duration"] == 80
    with Image.open(files[2]) as strip:
        assert strip.width > 2 * strip.height


def test_a_failed_rendering_is_one_warning(backend: str, tmp_path: Path) -> None:
    warnings: list[str] = []
    film = planned(span=(0.9, 1.0), robot="so101")
    assert record.record_film(film, tmp_path / "x", warn=warnings.append) == ()
    (warning,) = warnings
    assert "MUJOCO_GL" in warning
    assert "\n" not in warning
    assert not list(tmp_path.iterdir())


def test_without_gl_or_encoder_one_warning_names_what_to_install(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Rendering processes die at once, as they do where the GL library is broken."""
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    assert "pronk[video]" in str(record.missing_encoder())
    dying = tmp_path / "python"
    dying.write_text("#!/bin/sh\nexit 139\n", encoding="utf-8")
    dying.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(dying))
    record.find_gl.cache_clear()
    warnings: list[str] = []
    nothing: Any = None
    options: Any = {"robot": ROBOT, "cases": (), "warn": warnings.append}
    assert record.record_trial(nothing, tmp_path, tmp_path / "out", **options) == ()
    record.find_gl.cache_clear()
    (warning,) = warnings
    assert "libosmesa6" in warning
    assert "\n" not in warning
    assert not (tmp_path / "out").exists()


def test_only_rendering_needs_the_requested_opengl(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """MuJoCo itself cannot be imported with an unknown or a missing one."""
    monkeypatch.setenv("PRONK_GL", "")  # restored after the test
    monkeypatch.delenv("PRONK_GL")
    monkeypatch.setenv("MUJOCO_GL", "nonsense")
    monkeypatch.setenv("PYOPENGL_PLATFORM", "egl")
    missing = tmp_path / "policy.onnx"
    command = [sys.executable, "-m", "pronk.cli.main", "trial", str(missing), "--out", "out"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 2, done.stderr
    assert str(missing) in done.stderr.replace("\n", "")
    keep_opengl_out()
    assert os.environ["MUJOCO_GL"] == "disable"
    assert requested_opengl() == "nonsense"
    environment = record.environment("osmesa")
    assert environment["MUJOCO_GL"] == "osmesa"
    assert "PYOPENGL_PLATFORM" not in environment
    assert "MUJOCO_GL" not in record.environment("")


def test_a_trial_gives_a_film_for_each_policy_and_command(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    script = Script(command=STILL, stand_s=0.1, run_s=0.1, jump_s=0.14, keep_s=0.0, stop_s=1.0)
    cases = (Case(name="forward 1", command=(1.0, 0.0, 0.0)),)
    results = run_trial(
        [write_hopper(tmp_path / "policy.onnx"), write_hopper(tmp_path / "still.onnx", 0.0)],
        TrialPlan(cases=cases, jumps=1, script=script, spread_s=0.0),
        TrialSetup(robot=ROBOT, sim_params=load_sim_params(), out=tmp_path / "trial"),
    )
    # A robot given by its path is filmed with its own model.
    robot = replace(ROBOT, source="mine/robot.yaml")
    options: Any = {"folder": tmp_path / "trial", "robot": robot}
    (stem, hop), (_, still) = record.plan_films(results, cases=("forward 1",), **options).items()
    assert hop.robot == robot.source
    assert stem == f"{results.subjects[0].name}_forward_1".replace(" ", "_")
    assert hop.title == "forward 1 m/s"

    assert hop.events is not None
    figures = results.rows[0].figures.flight
    assert hop.events.liftoff - hop.events.on == pytest.approx(figures.delay, abs=0.002)
    flight = hop.events.touchdown - hop.events.liftoff
    assert flight == pytest.approx(figures.duration, abs=0.002)
    assert (hop.rate == 1.0 / record.SLOW).any()
    assert still.events is None
    assert not record.plan_films(results, cases=("back 2",), **options)
