"""Films of a capture: what is shown, when and from where; the files, where there is a GL."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from scipy.spatial.transform import Rotation

from hopper import ROBOT, write_hopper
from pronk import opengl
from pronk.errors import ArtefactError, PronkError
from pronk.evaluation.jump_events import JumpEvents, jump_events
from pronk.evaluation.pictures import film as films
from pronk.evaluation.pictures import overlay, video
from pronk.evaluation.pictures.film import FPS, Film, plan
from pronk.evaluation.pictures.frames import HEIGHT, WIDTH
from pronk.evaluation.pictures.render import in_gif
from pronk.evaluation.pictures.stage import FOV_DEG, TAPE_M, Tape, View
from pronk.evaluation.protocol import Case
from pronk.evaluation.trial import Plan as TrialPlan
from pronk.evaluation.trial import run_trial
from pronk.runtime.script import STILL, Script
from pronk.virtual.capture import Capture
from pronk.virtual.ground import Box, Ground
from pronk.virtual.sim_params import load_sim_params

RATE = 200.0
GRAVITY = 9.81
STAND = 0.3
LIFTOFF, RISE_SPEED = 1.0, 2.0
FLIGHT = 2.0 * RISE_SPEED / GRAVITY
MARKS = JumpEvents(on=0.8, off=1.3, liftoff=LIFTOFF, touchdown=LIFTOFF + FLIGHT)


def captured(
    *, direction: float = 0.0, yaw: float = 0.0, speed: float = 1.0, seconds: float = 3.0
) -> Capture:
    """Stands 0.3 m high while it moves on, and flies like a stone from 1 s on."""
    time = np.arange(0.0, seconds, 1.0 / RATE)
    flying = (time >= LIFTOFF) & (time < LIFTOFF + FLIGHT)
    t = np.where(flying, time - LIFTOFF, 0.0)
    position = np.zeros((len(time), 3))
    position[:, 0] = speed * time * math.cos(direction)
    position[:, 1] = speed * time * math.sin(direction)
    position[:, 2] = STAND + RISE_SPEED * t - 0.5 * GRAVITY * t**2
    n, j = len(time), len(ROBOT.joints)
    turn = Rotation.from_euler("z", yaw).as_quat()[[3, 0, 1, 2]]
    default = np.array([joint.default_position for joint in ROBOT.joints])
    return Capture(
        time=time,
        position=position,
        orientation=np.tile(turn, (n, 1)),
        velocity=np.zeros((n, 3)),
        angular_velocity=np.zeros((n, 3)),
        foot_position=np.zeros((n, 4, 3)),
        contact=np.tile(~flying[:, None], (1, 4)),
        other_contact=np.zeros(n, dtype=bool),
        joint_position=np.tile(default, (n, 1)),
        joint_velocity=np.zeros((n, j)),
        torque=np.zeros((n, j)),
        electrical_power=np.zeros(n),
        bus_voltage=np.full(n, 24.0),
    )


def planned(**changes: Any) -> Film:
    source = changes.pop("capture", None) or captured()
    kept: dict[str, Any] = {"robot": ROBOT.name, "title": "forward 1", "marks": MARKS}
    return plan(source, **(kept | changes))


# --- The plan -----------------------------------------------------------------------------------


def test_marks_are_those_of_the_jump() -> None:
    script = Script(command=(1.0, 0.0, 0.0), stand_s=0.2, run_s=0.4)
    marks = jump_events(captured(), script, began=0.2)
    assert marks is not None
    found = (marks.on, marks.off, marks.liftoff, marks.touchdown)
    expected = (MARKS.on, MARKS.off, MARKS.liftoff, MARKS.touchdown)
    assert found == pytest.approx(expected, abs=1.01 / RATE)
    late = Script(command=(1.0, 0.0, 0.0), run_s=1.0)
    assert jump_events(captured(), late) is None, "it lifted off before the jump input"


def test_real_time_is_shown_in_equal_steps() -> None:
    film = planned(start=0.5, end=2.0)
    assert film.time == pytest.approx(0.5 + np.arange(film.frames) / FPS)
    assert film.time[-1] == pytest.approx(2.0, abs=1.0 / FPS)
    assert (film.rate == 1.0).all()


def test_the_flight_is_slowed_down_and_nothing_else() -> None:
    real, slow = planned(start=0.2, end=2.5), planned(start=0.2, end=2.5, slow=4.0)
    flying = (slow.time > LIFTOFF) & (slow.time < LIFTOFF + FLIGHT)
    assert (slow.rate[flying] == 0.25).all()
    assert np.count_nonzero(flying) == pytest.approx(4.0 * FLIGHT * FPS, abs=1.5)
    far = (slow.time < LIFTOFF - 0.1) | (slow.time > LIFTOFF + FLIGHT + 0.1)
    assert (slow.rate[far] == 1.0).all()
    steps = np.diff(slow.time)
    assert steps == pytest.approx(slow.rate[:-1] / FPS)
    assert slow.frames > real.frames


def test_frames_show_the_capture() -> None:
    source = captured(yaw=0.4)
    film = planned(capture=source, start=0.0, end=2.0)
    rows = np.rint(film.time * RATE).astype(int)
    assert film.qpos[:, :3] == pytest.approx(source.position[rows])
    assert film.qpos[:, 3:7] == pytest.approx(source.orientation[rows])
    assert film.qpos[:, 7:] == pytest.approx(source.joint_position[rows])
    assert film.height == pytest.approx(source.position[rows, 2])
    assert (film.jumping == ((film.time >= 0.8) & (film.time < 1.3))).all()


def test_the_camera_follows_smoothly() -> None:
    film = planned(start=0.2, end=2.8)
    # A trunk that moves on evenly is kept in the middle, but for the ends of the capture.
    middle = (film.time > 0.8) & (film.time < 2.2)
    assert film.look[middle, 0] == pytest.approx(film.qpos[middle, 0], abs=0.01)
    # It rises 20 cm; the camera nods by less than half of it.
    assert np.ptp(film.look[:, 2]) < 0.5 * np.ptp(film.height)


@given(direction=st.floats(-math.pi, math.pi), yaw=st.floats(-math.pi, math.pi))
def test_the_robot_travels_to_the_right_and_shows_its_face(direction: float, yaw: float) -> None:
    film = planned(capture=captured(direction=direction, yaw=yaw), start=0.9, end=1.1)
    assert math.cos(film.direction - direction) == pytest.approx(1.0)
    view = View(look=np.zeros(3), azimuth=film.azimuth + film.quarter)
    ahead = np.array([math.cos(direction), math.sin(direction), 0.0])
    pixels = view.pixels(np.array([-0.1 * ahead, 0.1 * ahead]), WIDTH, HEIGHT)
    assert pixels[1, 0] > pixels[0, 0]
    # Turned by a quarter, it looks more against the heading than it would square to the way.
    if abs(math.cos(direction - yaw)) > 0.51:
        assert math.cos(film.azimuth + film.quarter - yaw) < math.cos(film.azimuth - yaw)


def test_a_robot_that_stands_is_seen_by_its_heading() -> None:
    film = planned(capture=captured(speed=0.0, yaw=0.7), marks=None, start=0.0, end=0.5)
    assert film.direction == pytest.approx(0.7)
    assert film.labels == ()
    assert not film.jumping.any()


def test_the_strip_has_the_moments_of_the_jump() -> None:
    film = planned()
    at = dict(zip(film.labels, film.pose_time, strict=True))
    assert list(at) == ["crouch", "lift-off", "", "apex", "touchdown", "landed"]
    assert at["lift-off"] == pytest.approx(0.0)
    assert at["apex"] == pytest.approx(RISE_SPEED / GRAVITY, abs=1.0 / RATE)
    assert at["touchdown"] == pytest.approx(FLIGHT, abs=1.0 / RATE)
    apex = film.pose_qpos[film.labels.index("apex"), 2]
    assert apex == pytest.approx(STAND + RISE_SPEED**2 / (2.0 * GRAVITY), abs=1e-3)
    assert (np.diff(film.pose_time) > 0.0).all()


def test_a_gif_shows_the_jump_and_every_second_frame() -> None:
    film = planned(start=0.0, end=2.9)
    shown = film.time[np.array(in_gif(film))]
    assert shown[0] == pytest.approx(LIFTOFF - 0.6, abs=1.0 / FPS)
    assert shown[-1] == pytest.approx(LIFTOFF + FLIGHT + 0.8, abs=2.0 / FPS)
    assert np.diff(shown) == pytest.approx(2.0 / FPS)


def test_what_cannot_be_shown_is_refused() -> None:
    with pytest.raises(PronkError, match=r"slow is 0\.5; expected 1"):
        planned(slow=0.5)
    with pytest.raises(PronkError, match="expected an end after the start"):
        planned(start=2.0, end=1.0)
    with pytest.raises(PronkError, match="on <= liftoff < touchdown"):
        JumpEvents(on=1.0, off=1.5, liftoff=0.5, touchdown=0.9)


def test_a_film_is_read_as_it_was_written(tmp_path: Path) -> None:
    block = Box(center=(1.0, 0.0, -0.1), half_size=(0.5, 1.0, 0.1))
    film = planned(note="a note", ground=Ground(floor=-0.5, terrain=(block,)))
    films.save(tmp_path / "film.npz", film)
    again = films.load(tmp_path / "film.npz")
    for name, value in vars(film).items():
        if isinstance(value, np.ndarray):
            assert (getattr(again, name) == value).all(), name
        else:
            assert getattr(again, name) == value, name


# --- The picture --------------------------------------------------------------------------------


def test_pixels_by_hand() -> None:
    view = View(look=np.array([1.0, 2.0, 0.3]), azimuth=0.5 * math.pi, elevation=0.0, distance=2.0)
    up, right = np.array([0.0, 0.0, 0.1]), np.array([0.1, 0.0, 0.0])
    points = np.array([view.look, view.look + up, view.look + right, view.look - (0.0, 3.0, 0.0)])
    pixels = view.pixels(points, 640, 400)
    step = 200.0 / math.tan(math.radians(0.5 * FOV_DEG)) * 0.1 / 2.0
    assert pixels[0] == pytest.approx([320.0, 200.0])
    assert pixels[1] == pytest.approx([320.0, 200.0 - step])
    assert pixels[2] == pytest.approx([320.0 + step, 200.0])
    assert np.isnan(pixels[3]).all(), "behind the camera"


def test_the_tape_lies_across_the_way_every_20_cm() -> None:
    tape = Tape((1.0, -1.0), 0.3, (-0.5, 1.2))
    along = np.array([math.cos(0.3), math.sin(0.3), 0.0])
    assert tape.place(0) == pytest.approx([1.0, -1.0, 0.0])
    assert (tape.place(3) - tape.place(0)) @ along == pytest.approx(3 * TAPE_M)
    ends = tape.place(2, 1.0) - tape.place(2, -1.0)
    assert ends @ along == pytest.approx(0.0)
    assert tape.marks[0] * TAPE_M <= -0.5
    assert tape.marks[-1] * TAPE_M >= 1.2


@pytest.mark.parametrize("virtual", [True, False])
def test_only_the_virtual_robot_is_called_so(virtual: bool) -> None:
    image = Image.new("RGB", (WIDTH, HEIGHT), (120, 120, 120))
    overlay.draw_words(image, planned(virtual=virtual), 3)
    corner = np.asarray(image.crop((WIDTH - 110, 0, WIDTH, 40)))
    assert (corner != 120).any() == virtual


@pytest.fixture(scope="module")
def backend() -> str:
    if lack := video.no_gl():
        pytest.skip(lack)
    return video.find_gl()


def test_files_are_painted(backend: str, tmp_path: Path) -> None:
    if lack := video.no_encoder():
        pytest.skip(lack)
    film = planned(start=0.95, end=1.15)
    messages: list[str] = []
    shares: list[float] = []
    made = video.record(film, tmp_path, "jump", tell=messages.append, progress=shares.append)
    assert [path.name for path in made] == ["jump.mp4", "jump.gif", "jump.png"]
    assert not messages
    assert shares == pytest.approx((np.arange(film.frames) + 1) / film.frames)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["jump.gif", "jump.mp4", "jump.png"]

    import imageio_ffmpeg

    reader = imageio_ffmpeg.read_frames(str(tmp_path / "jump.mp4"))
    about = next(reader)
    images = [np.frombuffer(raw, np.uint8).reshape(HEIGHT, WIDTH, 3) for raw in reader]
    assert about["fps"] == FPS
    assert len(images) == film.frames
    # The orange zero of the tape is where the camera's mathematics says.
    tape = Tape(film.origin, film.direction, (0.0, 0.0))
    view = View(look=film.look[0], azimuth=film.azimuth + film.quarter)
    (x, y), *_ = view.pixels(np.array([tape.place(0, 0.9), tape.place(0, -0.9)]), WIDTH, HEIGHT)
    red, green, blue = images[0][round(y), round(x)].astype(int)
    assert red > green + 40 > blue + 80
    assert (images[0] != images[-1]).any()

    with Image.open(tmp_path / "jump.gif") as gif:
        assert gif.n_frames == len(in_gif(film))
        assert gif.info["duration"] == 80
    with Image.open(tmp_path / "jump.png") as strip:
        assert strip.width > 2 * strip.height


def test_a_painter_that_fails_says_so_in_one_sentence(backend: str, tmp_path: Path) -> None:
    film = planned(start=0.9, end=1.0, robot="so101")
    with pytest.raises(video.VideoError, match=r"painting with MUJOCO_GL=.* failed \(") as caught:
        video.shoot(film, gif=tmp_path / "x.gif")
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


# --- What is missing ----------------------------------------------------------------------------


@pytest.fixture
def without_gl(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """Painting processes die at once, as they do where the GL library is broken."""
    dying = tmp_path / "python"
    dying.write_text("#!/bin/sh\nexit 139\n", encoding="utf-8")
    dying.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(dying))
    video.find_gl.cache_clear()
    yield
    video.find_gl.cache_clear()


def test_without_gl_one_line_names_the_package(without_gl: None, tmp_path: Path) -> None:
    messages: list[str] = []
    assert video.record(planned(), tmp_path / "out", "jump", tell=messages.append) == ()
    assert len(messages) == 1
    assert "`apt-get install libosmesa6`" in messages[0]
    assert "\n" not in messages[0]
    assert not (tmp_path / "out").exists()


def test_without_encoder_one_line_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    assert "pip install 'pronk[video]'" in str(video.no_encoder())
    with pytest.raises(video.VideoError, match="imageio-ffmpeg"):
        video.shoot(planned(), mp4=Path("x.mp4"))


def test_impossible_orders_are_refused(tmp_path: Path) -> None:
    walk = planned(marks=None, start=0.0, end=0.5)
    with pytest.raises(PronkError, match="a strip shows a jump"):
        video.shoot(walk, strip=tmp_path / "x.png")
    with pytest.raises(PronkError, match="641 x 400"):
        video.shoot(walk, gif=tmp_path / "x.gif", width=641)
    with pytest.raises(ArtefactError, match="no such file"):
        films.load(tmp_path / "film.npz")


def test_the_environment_names_one_backend(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    monkeypatch.setenv("PYOPENGL_PLATFORM", "egl")
    found = video.environment("osmesa")
    assert found["MUJOCO_GL"] == "osmesa"
    assert "PYOPENGL_PLATFORM" not in found
    assert "MUJOCO_GL" not in video.environment("")


def test_only_the_painter_needs_the_opengl_that_is_requested(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """MuJoCo itself cannot be imported with an unknown or a missing one."""
    monkeypatch.setenv("PRONK_GL", "")  # so that it is put back
    monkeypatch.delenv("PRONK_GL")
    monkeypatch.setenv("MUJOCO_GL", "nonsense")
    missing = tmp_path / "policy.onnx"
    command = ["trial", str(missing), "--out", str(tmp_path / "out")]
    done = subprocess.run(
        [sys.executable, "-m", "pronk.cli.main", *command],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2, done.stderr
    assert "defect" not in done.stderr
    assert str(missing) in done.stderr.replace("\n", "")
    opengl.keep_out()
    assert os.environ["MUJOCO_GL"] == "disable"
    assert opengl.requested() == "nonsense"


# --- Of a trial ---------------------------------------------------------------------------------


def test_a_trial_gives_a_film_for_each_policy_and_command(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    # A hop on the spot takes half a second.
    script = Script(command=STILL, stand_s=0.1, run_s=0.1, jump_s=0.14, keep_s=0.0, stop_s=1.0)
    cases = (Case(name="forward 1", command=(1.0, 0.0, 0.0)),)
    found = run_trial(
        [
            write_hopper(tmp_path / "policy.onnx"),
            write_hopper(tmp_path / "still.onnx", 0.0),
        ],
        TrialPlan(cases=cases, jumps=1, script=script, spread_s=0.0),
        robot=ROBOT,
        sim_params=load_sim_params(),
        out=tmp_path / "trial",
    )
    (stem, hop), (_, still) = video.films_of(found, tmp_path / "trial")
    assert stem == f"{found.subjects[0].name}_forward_1".replace(" ", "_")
    assert hop.title == "forward 1 m/s"
    assert hop.virtual
    assert hop.marks is not None
    row = found.rows[0]
    assert hop.marks.liftoff - hop.marks.on == pytest.approx(row.figures.delay, abs=0.002)
    assert hop.marks.touchdown - hop.marks.liftoff == pytest.approx(row.figures.duration, abs=0.002)
    assert (hop.rate == 1.0 / video.SLOW).any()
    assert still.marks is None
    assert still.note.endswith(", no jump")
    assert not list(video.films_of(found, tmp_path / "trial", cases=("back 2",)))


def test_a_trial_without_gl_goes_on_and_says_so_once(without_gl: None, tmp_path: Path) -> None:
    messages: list[str] = []
    nothing: Any = None
    assert video.record_all(nothing, tmp_path, tmp_path / "out", tell=messages.append) == ()
    assert len(messages) == 1
