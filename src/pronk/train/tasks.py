"""The tasks: configurations of the environment and of PPO, registered with mjlab.

mjlab finds this module by its entry point, so its own `train`, `play` and `list-envs` know
`Pronk-Walk-MiniCheetah` and `Pronk-Jump-MiniCheetah`. `pronk train` builds the same
configurations with the gains that were requested.
"""

from __future__ import annotations

import math

from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.managers import EventTermCfg, RewardTermCfg, TerminationTermCfg
from mjlab.rl import RslRlOnPolicyRunnerCfg
from mjlab.tasks.registry import register_mjlab_task
from mjlab.viewer import ViewerConfig

from pronk.robots import load_robot
from pronk.train.gains import NAIVE, TrainingGains, training_gains
from pronk.train.mdp import observations, terminations
from pronk.train.mdp.actions import HeldJointPositionCfg
from pronk.train.mdp.commands import NAME, MotionCommandCfg, NominalDrive
from pronk.train.mdp.draws import draw_start
from pronk.train.mdp.drives import actuators
from pronk.train.mdp.randomization import Randomization, delay_steps, events, noise
from pronk.train.mdp.reward_sum import NAME as TABLE
from pronk.train.mdp.reward_sum import RewardSum
from pronk.train.mdp.reward_table import ROWS
from pronk.train.mdp.scene import robot_entity, scene, simulation
from pronk.train.phases import Phase, configure_phase, phase
from pronk.train.rl.actor import EstimatorActorCfg, JumpCriticCfg
from pronk.train.rl.ppo import EstimatorPpoCfg
from pronk.train.runner.runner import PronkRunner

WALK_TASK = "Pronk-Walk-MiniCheetah"
JUMP_TASK = "Pronk-Jump-MiniCheetah"

ACTION_SCALE = 0.35
"""Position target per unit of action [rad]."""
EPISODE_S = 20.0
STEPS_PER_ITERATION = 24
"""Policy steps of every robot between two updates."""


def env_cfg(
    *,
    gains: TrainingGains | None = None,
    randomization: Randomization | None = None,
    phase: Phase | None = None,
    num_envs: int = 4096,
    seed: int = 0,
    episode_s: float = EPISODE_S,
) -> ManagerBasedRlEnvCfg:
    """The environment of every phase.

    Args:
        gains: What to draw gains about; naive if None.
        randomization: What differs from robot to robot; the paper's if None.
        phase: Commands and rewards to begin with; the first if None.
        num_envs: Number of robots.
        seed: Of all draws.
        episode_s: Longest episode at the nominal policy rate [s].
    """
    robot = load_robot("mini_cheetah")
    gains = gains or training_gains(NAIVE, robot)
    randomization = randomization or Randomization.paper()
    cfg = ManagerBasedRlEnvCfg(
        seed=seed,
        decimation=robot.decimation,
        scene=scene(robot_entity(robot, actuators(robot, gains)), num_envs),
        sim=simulation(robot),
        observations=observations.groups(noise(randomization)),
        actions={
            "joint_position": HeldJointPositionCfg(
                entity_name="robot",
                actuator_names=robot.joint_names,
                scale=ACTION_SCALE,
                use_default_offset=True,
                preserve_order=True,
                delay_steps=delay_steps(robot, gains, randomization),
            )
        },
        commands={NAME: MotionCommandCfg(drive=NominalDrive.of(robot, gains))},
        events={
            "start": EventTermCfg(
                func=draw_start,
                mode="reset",
                params={"place": 0.5, "speed": 0.3, "heading": math.pi, "joints": 0.1},
            ),
            **events(robot, gains, randomization),
        },
        rewards={TABLE: RewardTermCfg(func=RewardSum, weight=1.0, params={"rows": ROWS})},
        terminations={
            "time_out": TerminationTermCfg(
                func=terminations.time_out,
                time_out=True,
                params={"steps": round(episode_s * robot.policy_rate_hz)},
            ),
            # 70 degrees; the trunk's lower face is 5 cm below its centre.
            "fell": TerminationTermCfg(
                func=terminations.fell, params={"tilt_cosine": 0.34, "height": 0.08}
            ),
            "non_finite": TerminationTermCfg(func=terminations.non_finite, params={"speed": 200.0}),
        },
        episode_length_s=episode_s,
        viewer=ViewerConfig(
            origin_type=ViewerConfig.OriginType.ASSET_BODY,
            entity_name="robot",
            body_name="trunk",
            distance=2.0,
            elevation=-10.0,
        ),
    )
    if phase is not None:
        configure_phase(cfg, phase)
    return cfg


def rl_cfg(*, jump: bool, seed: int = 0, entropy: float = 0.005) -> RslRlOnPolicyRunnerCfg:
    """PPO as it is run in a phase with or without the jump input.

    Actor and critic are the paper's (N2). The optimizer's settings are those that mjlab trains
    its own quadrupeds with.

    Args:
        jump: Whether the networks read the jump input.
        seed: Of the networks and of exploration.
        entropy: Coefficient of the entropy bonus.
    """
    return RslRlOnPolicyRunnerCfg(
        seed=seed,
        actor=EstimatorActorCfg(),
        critic=JumpCriticCfg(),
        algorithm=EstimatorPpoCfg(
            entropy_coef=entropy,
            # Mirrored, an epoch holds every sample twice: three of them are six.
            num_learning_epochs=3,
            # A clipped value may move by 0.2 an update; a jump is worth ten.
            use_clipped_value_loss=False,
            # Squared errors of 0.02 m^2/s^2 stand beside 0.1 nat of the contacts.
            estimator_velocity_coef=4.0,
            # Robot and task are alike left and right: every sample teaches two.
            symmetry_cfg={
                "data_augmentation_func": "pronk.train.rl.symmetry:with_mirror_image",
                "use_data_augmentation": True,
            },
        ),
        obs_groups={
            "actor": ("measured", "jump") if jump else ("measured",),
            "critic": ("critic", "critic_jump") if jump else ("critic",),
        },
        experiment_name="pronk_jump" if jump else "pronk_walk",
        logger="tensorboard",
        num_steps_per_env=STEPS_PER_ITERATION,
        save_interval=50,
        max_iterations=1000 if jump else 400,
    )


def _register() -> None:
    for task, name in ((WALK_TASK, "walk"), (JUMP_TASK, "jump_b")):
        begun = phase(name)
        play = env_cfg(phase=begun, randomization=Randomization.none(), num_envs=1, episode_s=1e6)
        register_mjlab_task(
            task_id=task,
            env_cfg=env_cfg(phase=begun),
            play_env_cfg=play,
            rl_cfg=rl_cfg(jump=begun.jump, entropy=begun.entropy),
            runner_cls=PronkRunner,
        )


_register()
