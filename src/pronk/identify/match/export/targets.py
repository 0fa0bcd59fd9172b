"""The targets of an export, and `export`, which writes the text for one of them.

Gains hold for one drive law at one step (`pronk.identify.simulators.profiles`): a target with
another law or step is refused. Every text says what must be set beside it, which joints were not
matched, which delay and friction it does not have, and how far the drives are from the law's
stability limit.

Arguments of the frameworks, with their sources (read in November 2026):

- mjlab 1.6: `mjlab.actuator`, installed with `pronk[train]`.
- Isaac Lab: `isaaclab/actuators/actuator_base_cfg.py` and `actuator_pd_cfg.py` of v2.3.2 and of
  release 3.0.0, which has new names for limits and drops the old ones in 4.0.
- Newton: `generatedSchema.usda` of newton-usd-schemas 0.6.0.
- Genesis: `set_dofs_*` of `RigidEntity`, as its example `locomotion/go2_env.py` calls them.
- MuJoCo Playground: Go1, whose derivative gain is `dof_damping` under Euler without eulerdamp.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import replace

from pronk.errors import PronkError
from pronk.identify.match.export.actuators import (
    Actuator,
    Per,
    exported_actuators,
    profile_held,
    robot_of,
)
from pronk.identify.match.export.mjcf import mjcf_robot, mjcf_snippet
from pronk.identify.match.export.newton_usd import newton_layer
from pronk.identify.match.export.python_config import (
    genesis_config,
    isaaclab_config,
    mjlab_config,
    playground_config,
)
from pronk.identify.match.export.target import ExportTarget
from pronk.identify.match.gains import MatchedGains, require_matched
from pronk.identify.match.ranges import range_notes
from pronk.identify.simulators.profiles import Profile, profile
from pronk.identify.simulators.stability import require_stable
from pronk.robots.robot import RobotSpec

LINE_LENGTH = 98
"""Longest line of the header, without its comment sign."""
SHORTEST_DELAY_S = 1e-6
"""Shortest delay that the header names [s]; shorter ones are rounding."""

GAIN_ARGUMENTS = {"stiffness": "stiffness", "damping": "damping", "armature": "armature"}
ISAACLAB_FRICTION = {
    "friction": "frictionloss",
    "dynamic_friction": "sliding_friction",
    "viscous_friction": "viscous_damping",
}
TORQUE_SPEED_LINE = {"saturation_effort": "stall_torque"}
"""Arguments of Isaac Lab and mjlab for a drive's torque at standstill."""
MJLAB_ARGUMENTS = {
    **GAIN_ARGUMENTS,
    "frictionloss": "frictionloss",
    "viscous_damping": "viscous_damping",
    "effort_limit": "effort_limit",
}
SET_STEP = "Set sim.dt to {timestep} s and decimation to {decimation}"
SET_PHYSX = (
    f"{SET_STEP}, PhysX's solver to TGS. Friction is a torque since Isaac Sim 5.0; before it was "
    "a coefficient."
)
SET_PHYSX_EXPLICIT = f"{SET_PHYSX} Set enable_external_forces_every_iteration to False."

MJLAB_IDEAL_PD = ExportTarget(
    profile="mjlab",
    write=mjlab_config,
    config_class="IdealPdActuatorCfg",
    arguments=MJLAB_ARGUMENTS,
    delay_arguments=("delay_min_lag", "delay_max_lag"),
    settings=f"{SET_STEP}. IdealPdActuator has no torque-speed line.",
)
ISAACLAB_IMPLICIT = ExportTarget(
    profile="isaaclab-implicit",
    write=isaaclab_config,
    config_class="ImplicitActuatorCfg",
    arguments={**GAIN_ARGUMENTS, **ISAACLAB_FRICTION, "joint_effort_limit": "effort_limit"},
    settings=f"{SET_PHYSX} Set solver_position_iteration_count to {{iterations}}, that of "
    "velocity to 0.",
    stribeck=True,
)
ISAACLAB_DC_MOTOR = ExportTarget(
    profile="isaaclab-explicit",
    write=isaaclab_config,
    config_class="DCMotorCfg",
    arguments={
        **GAIN_ARGUMENTS,
        **ISAACLAB_FRICTION,
        "actuator_effort_limit": "effort_limit",
        **TORQUE_SPEED_LINE,
        "actuator_velocity_limit": "no_load_speed",
    },
    settings=SET_PHYSX_EXPLICIT,
    stribeck=True,
    without_delay="delay the actions in the environment, or take isaaclab-delayed",
)
ISAACLAB_DELAYED = ExportTarget(
    profile="isaaclab-explicit",
    write=isaaclab_config,
    config_class="DelayedPDActuatorCfg",
    arguments={**GAIN_ARGUMENTS, **ISAACLAB_FRICTION, "actuator_effort_limit": "effort_limit"},
    delay_arguments=("min_delay", "max_delay"),
    settings=f"{SET_PHYSX_EXPLICIT} DelayedPDActuator has no torque-speed line.",
    stribeck=True,
)
ISAACLAB_2_3_NAMES = {
    "joint_effort_limit": "effort_limit_sim",
    "actuator_effort_limit": "effort_limit",
    "actuator_velocity_limit": "velocity_limit",
}
"""Arguments of Isaac Lab 3.0 that have another name in 2.3."""


def _of_isaaclab_2_3(target: ExportTarget) -> ExportTarget:
    """Return a target of Isaac Lab 3.0 with the names of release 2.3."""
    arguments = {}
    for argument, quantity in target.arguments.items():
        arguments[ISAACLAB_2_3_NAMES.get(argument, argument)] = quantity
    return replace(target, arguments=arguments)


TARGETS: Mapping[str, ExportTarget] = {
    "isaaclab-implicit": ISAACLAB_IMPLICIT,
    "mjlab": ExportTarget(
        profile="mjlab",
        write=mjlab_config,
        config_class="DcMotorActuatorCfg",
        arguments={
            **MJLAB_ARGUMENTS,
            **TORQUE_SPEED_LINE,
            "velocity_limit": "no_load_speed",
        },
        delay_arguments=("delay_min_lag", "delay_max_lag"),
        settings=f"{SET_STEP}.",
    ),
    "mjlab-idealpd": MJLAB_IDEAL_PD,
    "mjlab-builtin": replace(
        MJLAB_IDEAL_PD,
        profile="mjlab-builtin",
        config_class="BuiltinPositionActuatorCfg",
        settings=f"{SET_STEP}, the integrator to implicitfast.",
    ),
    "isaaclab-dcmotor": ISAACLAB_DC_MOTOR,
    "isaaclab-delayed": ISAACLAB_DELAYED,
    "isaaclab-implicit-2.3": _of_isaaclab_2_3(ISAACLAB_IMPLICIT),
    "isaaclab-dcmotor-2.3": _of_isaaclab_2_3(ISAACLAB_DC_MOTOR),
    "isaaclab-delayed-2.3": _of_isaaclab_2_3(ISAACLAB_DELAYED),
    "isaaclab-newton": ExportTarget(
        profile="isaaclab-newton",
        write=isaaclab_config,
        config_class="ImplicitActuatorCfg",
        arguments={
            "stiffness": "stiffness",
            "damping": "all_damping",
            "armature": "armature",
            "joint_effort_limit": "effort_limit",
            "friction": "frictionloss",
        },
        settings=f"Isaac Lab 3.0, physics=newton_mjwarp. {SET_STEP}, the integrator to "
        "implicitfast. Damping includes the viscous friction.",
    ),
    "newton-usd": ExportTarget(
        profile="isaaclab-explicit",
        write=newton_layer,
        arguments={
            "kp": "stiffness",
            "kd": "damping",
            "maxMotorEffort": "effort_limit",
            "saturationEffort": "stall_torque",
            "velocityLimit": "no_load_speed",
        },
        delay_arguments=("newton:delaySteps",),
        settings="Replace /Robot/joints by the path of the joints. Actuators must step with the "
        "physics, each {timestep} s; commands are held for {decimation} steps. XPBD, VBD and "
        "SemiImplicit of Newton have no armature: another joint. Joint damping is per degree.",
    ),
    "genesis": ExportTarget(
        profile="genesis",
        write=genesis_config,
        arguments={
            "kp": "stiffness",
            "kv": "damping",
            "armature": "armature",
            "frictionloss": "frictionloss",
            "damping": "viscous_damping",
            "force_range": "effort_limit",
        },
        settings="Set SimOptions(dt={period}, substeps={decimation}), and command by "
        "control_dofs_position. Without apply() a URDF's joints have an armature of 0.1 kg m^2.",
    ),
    "playground": ExportTarget(
        profile="playground",
        write=playground_config,
        arguments={
            "kp": "stiffness",
            "damping": "all_damping",
            "armature": "armature",
            "frictionloss": "frictionloss",
            "effort_limit": "effort_limit",
        },
        settings="Set sim_dt to {timestep} s and ctrl_dt to {period} s. Joint damping is the "
        "derivative gain and the viscous friction.",
    ),
    "mjcf": ExportTarget(
        write=mjcf_robot,
        xml=True,
        stribeck=True,
        settings="Step and integrator are those of the drive law (E needs Euler); commands are "
        "held for {substeps} steps. Joints that were not matched have the robot's published gains.",
    ),
    "mjcf-snippet": ExportTarget(
        write=mjcf_snippet,
        xml=True,
        stribeck=True,
        settings="Put these attributes into your model; commands are held for {substeps} steps.",
    ),
}
"""What `export` can write, by name."""


def export(
    gains: MatchedGains,
    target: str,
    robot: RobotSpec | None = None,
    *,
    per: Per = "group",
    allow_unmatched: bool = False,
) -> str:
    """Write matched gains as actuator configuration of a simulator.

    Args:
        gains: Matched gains, as of `pronk.match` or `gains.yaml`.
        target: What reads the text, a name in `TARGETS`, for instance `mjlab`, `isaaclab-dcmotor`
            or `mjcf`. It must have the drive law and the step that the gains hold for.
        robot: The robot that the gains were matched for; found by the gains if left out.
        per: `group` for one actuator a joint group, with the group's gains; `joint` for one a
            joint, with its own.
        allow_unmatched: Also export joints that are no match. The header names each of them with
            its reasons.

    Returns:
        Text of a Python, USD or XML file. Its header says what must be set beside it.

    Raises:
        UnmatchedError: A joint is no match.
        PronkError: The target is unknown or has another drive law or step than the gains, the
            gains hold no group or are not stable, or the robot is unknown.

    Examples:
        >>> import pronk
        >>> robot = pronk.load_robot("mini_cheetah")
        >>> result = pronk.match([pronk.read_log("logs/FR_knee.mcap", robot=robot)], robot)
        >>> text = pronk.export(result.gains, "mjlab")
    """
    if target not in TARGETS:
        raise PronkError(f"no export to {target!r}; expected one of {', '.join(TARGETS)}.")
    require_matched(gains, allow_unmatched)
    export_target = TARGETS[target]
    gains_profile = profile_held(gains)
    _check_profile(target, gains_profile)
    simulated_robot = gains_profile.robot(robot or robot_of(gains))
    actuators = exported_actuators(gains, simulated_robot, per)
    limit_share = require_stable(gains_profile, simulated_robot, actuators)

    sentences = [
        *_no_match(actuators),
        *_conditions(gains, export_target, gains_profile, simulated_robot),
        *_stability(gains_profile, limit_share),
        *_losses(export_target, actuators, gains_profile),
        *_range_sentences(export_target, gains, simulated_robot, per),
        *_origin(gains, actuators, simulated_robot),
    ]
    lines = [
        textwrap.fill(sentence, LINE_LENGTH, break_long_words=False, break_on_hyphens=False)
        for sentence in sentences
    ]
    header = "\n".join(lines)
    if export_target.xml:
        # Two hyphens would end the comment.
        header = f"<!--\n{header.replace('--', '-')}\n-->"
    else:
        header = textwrap.indent(header, "# ")
    if target == "newton-usd":
        header = f"#usda 1.0\n{header}"
    body = export_target.write(export_target, actuators, gains_profile, simulated_robot)
    return f"{header}\n\n{body}"


def accepts(target: str, gains_profile: Profile) -> bool:
    """Return whether gains that hold for a profile have the drive law and the step of a target."""
    name = TARGETS[target].profile
    if not name or name == gains_profile.name:
        return True
    target_profile = profile(name)
    same_law = target_profile.drive_law == gains_profile.drive_law
    return same_law and target_profile.timestep_s == gains_profile.timestep_s


def _check_profile(target: str, gains_profile: Profile) -> None:
    """Refuse gains that hold for another drive law or step than the target's."""
    if accepts(target, gains_profile):
        return
    name = TARGETS[target].profile
    target_profile = profile(name)
    raise PronkError(
        f"the gains hold for {gains_profile.name} ({_law_text(gains_profile)}), and {target} has "
        f"{_law_text(target_profile)}, with which they are another joint; give `pronk match LOGS "
        f"--for {name}`, or without logs `pronk translate GAINS --to {name}`."
    )


def _law_text(held_profile: Profile) -> str:
    """Describe drive law and step of a profile."""
    return (
        f"drive law {held_profile.drive_law.label} at {1000.0 * held_profile.timestep_s:g} ms with "
        f"{held_profile.passive_damping} passive damping"
    )


def _no_match(actuators: Sequence[Actuator]) -> list[str]:
    """Name the joints that are no match, one sentence each."""
    sentences = []
    for actuator in actuators:
        for name, reasons in actuator.no_match.items():
            sentences.append(f"NO MATCH of {name}, whose gains are not to be trusted: ")
            sentences[-1] += "; ".join(reasons)
    return sentences


def _conditions(
    gains: MatchedGains, target: ExportTarget, gains_profile: Profile, robot: RobotSpec
) -> list[str]:
    """Say what the gains hold for, and what must be set beside the text."""
    simulator = gains.simulator
    engine = f"{simulator.engine} {simulator.version}".strip()
    law = gains_profile.drive_law
    timestep_s = gains_profile.timestep_s
    settings = target.settings.format(
        timestep=f"{timestep_s:g}",
        decimation=robot.decimation,
        period=f"{timestep_s * robot.decimation:g}",
        iterations=law.iterations,
        substeps=robot.decimation * law.iterations,
    )
    verb = "fitted but not matched" if gains.unmatched else "matched"
    return [
        f"Gains of {gains.robot}, {verb} by pronk for {gains_profile.name} "
        f"({gains_profile.framework}).",
        f"They hold for {engine}, {simulator.actuator}, drive law {law.label}, timestep "
        f"{timestep_s:g} s, decimation {robot.decimation}.",
        settings,
    ]


def _stability(gains_profile: Profile, limit_share: float) -> list[str]:
    """Say how far the drives are from the stability limit; law I has none."""
    if gains_profile.drive_law.kind == "implicit":
        return []
    return [f"The drives use {100.0 * limit_share:.0f} % of the law's stability limit."]


def _losses(
    target: ExportTarget, actuators: Sequence[Actuator], gains_profile: Profile
) -> list[str]:
    """Say what of delay and friction the text does not have, or has rounded to steps."""
    sentences = []
    delayed = [actuator for actuator in actuators if actuator.delay_s > SHORTEST_DELAY_S]
    if delayed:
        sentences.append(_delay_sentence(target, delayed, gains_profile.timestep_s))
    falling = [
        f"{actuator.name} {actuator.stribeck:.2g}" for actuator in actuators if actuator.stribeck
    ]
    if falling and not target.stribeck:
        sentences.append(
            "Dry friction is that at rest. In motion the joints lose this share of it, which this "
            f"file does not have: {', '.join(falling)}."
        )
    if gains_profile.friction != "N m":
        sentences.append(f"No dry friction: {gains_profile.framework} has none in N m.")
    return sentences


def _range_sentences(
    target: ExportTarget, gains: MatchedGains, robot: RobotSpec, per: Per
) -> tuple[str, ...]:
    """Say which ranges of the text are wider or narrower than what the joints show."""
    if per == "joint" or target.write not in (mjlab_config, isaaclab_config):
        return ()
    members = {}
    for group in gains.groups:
        members[group] = [joint.name for joint in robot.group(group)]
    return range_notes(gains.groups, members, gains.joints)


def _delay_sentence(target: ExportTarget, delayed: Sequence[Actuator], timestep_s: float) -> str:
    """Say what becomes of the command delays of some actuators."""
    delays = []
    if target.delay_arguments:
        for actuator in delayed:
            steps = round(actuator.delay_s / timestep_s)
            remainder_s = actuator.delay_s - timestep_s * steps
            delays.append(
                f"{actuator.name} {1000.0 * actuator.delay_s:.1f} ms = {steps} steps and "
                f"{1000.0 * remainder_s:+.1f} ms"
            )
        return f"Command delays, as steps and what steps leave: {', '.join(delays)}"
    if target.xml:
        return "Commands before the first are 0 rad for the delay; mj_initCtrlHistory sets others."
    for actuator in delayed:
        steps_text = f"{actuator.delay_s / timestep_s:.1f} steps"
        delays.append(f"{actuator.name} {1000.0 * actuator.delay_s:.1f} ms ({steps_text})")
    return (
        f"Command delays that this file does not have: {', '.join(delays)}; {target.without_delay}."
    )


def _origin(gains: MatchedGains, actuators: Sequence[Actuator], robot: RobotSpec) -> list[str]:
    """Say which joints the text has, under which names, and which logs they come from."""
    sentences = []
    joints: list[str] = []
    unmatched: list[str] = []
    names: list[str] = []
    for actuator in actuators:
        joints.extend(actuator.joints)
        unmatched.extend(actuator.unmatched)
        for maker_name, name in zip(actuator.maker_joints, actuator.joints, strict=True):
            names.append(f"{maker_name} = {name}")
    if any(actuator.joints != actuator.maker_joints for actuator in actuators):
        sentences.append(f"Joint names of the maker, and in pronk: {', '.join(names)}.")
    if unmatched:
        sentences.append(f"NOT MATCHED, with the gains of their group: {', '.join(unmatched)}.")
    missing = [name for name in robot.joint_names if name not in joints]
    if missing:
        sentences.append(f"NOT MATCHED, and without gains here: {', '.join(missing)}.")
    if gains.virtual:
        sentences.append("The logs came from pronk's virtual robot, not from hardware.")
    for name, sha256 in gains.logs.items():
        sentences.append(f"Log {name}, SHA-256 {sha256}")
    return sentences
