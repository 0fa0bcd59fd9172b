"""The guided jump of robots whose legs do not all stand alike."""

from __future__ import annotations

from dataclasses import replace

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("mjlab")

from pronk.jump.train.mdp.guidance import foot_sweep, guidance
from pronk.jump.train.mdp.jump import JumpSettings
from pronk.robots.legged import Legged, legged

pytestmark = pytest.mark.train

SETTINGS = JumpSettings()
DT = 0.02
STEPS = round(SETTINGS.prompt_s / DT)


def with_poses(**poses: dict[str, float]) -> Legged:
    """Return the Go2 with other angles of some joints of some legs in the default pose."""
    body = legged("go2")
    leg_poses = {}
    for leg, pose in body.leg_poses.items():
        leg_poses[leg] = {**pose, **poses.get(leg, {})}
    return replace(body, leg_poses=leg_poses)


def targets(body: Legged, torque: bool = False) -> torch.Tensor:
    """Return the guided positions of the joints without what drives add, (steps, legs, 3)."""
    stiffness = torch.full((12,), 20.0 if torque else 1e9)
    offsets = guidance(body, SETTINGS, stiffness, torch.zeros(12), DT)[:STEPS]
    default = []
    for leg in body.legs:
        default.append([body.leg_poses[leg][joint] for joint in body.leg_joints])
    return offsets.reshape(STEPS, 4, 3) + torch.tensor(default)


def foot_ahead(body: Legged, angles: torch.Tensor) -> torch.Tensor:
    """Return how far the feet are ahead of their hips [m], (steps, legs)."""
    pitch = body.forward * angles[..., 1]
    knee = body.forward * angles[..., 2]
    return body.thigh_length * pitch.sin() + body.shank_length * (pitch + knee).sin()


def test_each_leg_is_guided_from_its_own_pose() -> None:
    """Hind thighs further back, and hips turned outwards, as robots of Unitree often stand."""
    body = with_poses(
        FR={"hip_roll": -0.1},
        FL={"hip_roll": 0.1},
        RR={"hip_pitch": 1.1, "hip_roll": -0.1},
        RL={"hip_pitch": 1.1, "hip_roll": 0.1},
    )
    angles = targets(body)
    torch.testing.assert_close(angles, angles[:, :1].expand(-1, 4, -1), rtol=0.0, atol=1e-5)
    assert foot_ahead(body, angles).abs().max() < 1e-5


def test_knees_bend_to_the_side_of_their_pose() -> None:
    """Hind knees that bend forwards: the mirror image of the front legs, and of their torques."""
    hind = {"hip_pitch": -0.9, "knee": 1.8}
    body = with_poses(RR=hind, RL=hind)
    for torque in (False, True):
        angles = targets(body, torque)
        torch.testing.assert_close(angles[:, 2:], -angles[:, :2], rtol=0.0, atol=1e-5)
    assert foot_ahead(body, targets(body)).abs().max() < 1e-5


@pytest.mark.parametrize("bend", [-1.0, 1.0])
@pytest.mark.parametrize("name", ["mini_cheetah", "go2"])
def test_a_sweep_moves_feet_backwards_whatever_the_side_of_the_knees(
    name: str, bend: float
) -> None:
    body = legged(name)
    pose = {"hip_roll": 0.0, "hip_pitch": -0.9 * bend, "knee": 1.8 * bend}
    body = replace(body, leg_poses=dict.fromkeys(body.legs, pose), default_position=pose)
    swept = foot_sweep(body, SETTINGS, DT)[:STEPS].reshape(STEPS, 4, 3)
    ahead = foot_ahead(body, targets(body) + swept)
    assert (ahead[0] > 0.05).all()
    assert (ahead[-1] < -0.05).all()
