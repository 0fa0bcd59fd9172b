"""PPO of the jump task, for any quadruped."""

from __future__ import annotations

from pronk.jump.train.phases import STEPS_PER_ITERATION
from pronk.jump.train.rl.networks import EstimatorActorCfg, JumpCriticCfg
from pronk.jump.train.rl.ppo import EstimatorPpoCfg, EstimatorTrainingCfg
from pronk.jump.train.rl.runner import JumpRunnerCfg


def jump_rl_cfg(*, iterations: int, seed: int = 0) -> JumpRunnerCfg:
    """Actor and critic of the paper (N2), and PPO with mjlab's settings for its quadrupeds.

    The phases set the entropy bonus and the estimator's learning rate (`pronk.jump.train.phases`);
    `iterations` are of all of them.
    """
    return JumpRunnerCfg(
        seed=seed,
        actor=EstimatorActorCfg(),
        critic=JumpCriticCfg(),
        algorithm=EstimatorPpoCfg(
            # The first; it follows the KL divergence of an update.
            learning_rate=1e-3,
            # With the mirror image an epoch has every sample twice: three of them are six.
            num_learning_epochs=3,
            # A clipped value moves by 0.2 at most in an update; a jump earns ten.
            use_clipped_value_loss=False,
            # Squared errors of 0.02 m^2/s^2 stand beside 0.1 nat of the contacts.
            estimator=EstimatorTrainingCfg(velocity_coef=4.0),
            # Robot and task are symmetric left and right.
            symmetry_cfg={
                "data_augmentation_func": "pronk.jump.train.rl.symmetry:with_mirror_image",
                "use_data_augmentation": True,
            },
        ),
        obs_groups={"actor": ("measured", "jump"), "critic": ("critic", "critic_jump")},
        experiment_name="pronk_jump",
        logger="tensorboard",
        num_steps_per_env=STEPS_PER_ITERATION,
        save_interval=50,
        max_iterations=iterations,
        upload_model=False,
    )
