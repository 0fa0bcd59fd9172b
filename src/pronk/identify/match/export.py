"""Matched gains as configuration of a simulator, as text to read and to paste.

Gains hold for one drive law at one step (`pronk.identify.simulators.profiles`): a target with
another law or step is refused. Every text says what must be set beside it, which joints were not
matched, which delay and friction it does not have, and how far the drives are from the law's
stability limit.

Arguments of other frameworks, with their sources (read in November 2026):

- mjlab 1.6: `mjlab.actuator`, installed with `pronk[train]`.
- Isaac Lab: `isaaclab/actuators/actuator_base_cfg.py` and `actuator_pd_cfg.py` of v2.3.2 and of
  release 3.0.0, which has new names for limits and drops the old ones in 4.0.
- Newton: `generatedSchema.usda` of newton-usd-schemas 0.6.0. A `NewtonActuator` is in radians, a
  `NewtonJointAPI` in degrees.
- Genesis: `set_dofs_*` of `RigidEntity`, as its example `locomotion/go2_env.py` calls them.
- MuJoCo Playground: Go1, whose derivative gain is `dof_damping` under Euler without eulerdamp.
"""

from __future__ import annotations

import math
import textwrap
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pronk.errors import PronkError, RobotError
from pronk.identify.match.gains import MatchedGains
from pronk.identify.simulators.profiles import Profile, load_profiles, profile, profile_of
from pronk.identify.simulators.stability import require_stable
from pronk.robots import load_robot
from pronk.robots.model import add_drives, free_spec, set_law
from pronk.robots.robot import Drive, RobotSpec

Per = Literal["group", "joint"]


@dataclass(frozen=True, kw_only=True)
class Actuator:
    """Joints with the same parameters: a group, or one joint."""

    name: str
    joints: tuple[str, ...]
    own_joints: tuple[str, ...]
    """The same in the models of the robot's maker."""
    unmatched: tuple[str, ...]
    """Those without a match of their own; they have the group's gains."""
    stiffness: float
    """[N m/rad]"""
    damping: float
    """[N m s/rad]"""
    stiffness_range: tuple[float, float]
    """Lowest and highest of the uniform randomization [N m/rad]."""
    damping_range: tuple[float, float]
    """Lowest and highest of the uniform randomization, not below 0 [N m s/rad]."""
    armature: float
    """[kg m^2]"""
    frictionloss: float
    """Dry friction at rest [N m]."""
    stribeck: float
    """Share of it that motion takes away."""
    delay_s: float
    """Command delay [s]."""
    drive: Drive
    """Its limits and viscous friction."""

    def value(self, name: str) -> float:
        """A parameter by its name: a field, one of the drive, or what is computed of both."""
        computed = {
            # Dry friction in motion [N m].
            "sliding_friction": self.frictionloss * (1.0 - self.stribeck),
            # For an engine with one parameter for damping and viscous friction [N m s/rad].
            "all_damping": self.damping + self.drive.viscous_damping,
            # [N m s/degree]
            "viscous_per_degree": math.radians(self.drive.viscous_damping),
        }
        return float({**vars(self.drive), **vars(self), **computed}[name])


def actuators(gains: MatchedGains, robot: RobotSpec, per: Per = "group") -> list[Actuator]:
    """The matched groups or their joints, in the robot's order; a group has its joints' means.

    Raises:
        PronkError: The gains are of another robot, or hold no group.
    """
    if gains.robot != robot.name:
        raise PronkError(f"the gains are those of {gains.robot}, not of {robot.name}.")
    if not gains.groups:
        raise PronkError(
            f"the gains of {gains.robot} hold no joint group; match some joints first."
        )
    out = []
    for group_name in (name for name in robot.groups if name in gains.groups):
        group, members = gains.groups[group_name], robot.group(group_name)
        for part in [members] if per == "group" else [(one,) for one in members]:
            matched = [gains.joints[j.name] for j in part if j.name in gains.joints]
            of_group = [gains.joints[j.name] for j in members if j.name in gains.joints]
            drive = part[0].drive
            known = matched or of_group
            friction = [joint.frictionloss.value for joint in known]
            dry = [value for value in friction if not np.isnan(value)]
            stiffness = group.stiffness
            damping = group.damping
            if per == "joint" and matched:
                stiffness = matched[0].stiffness.value
                damping = matched[0].damping.value
            out.append(
                Actuator(
                    name=group_name if per == "group" else part[0].name,
                    joints=tuple(j.name for j in part),
                    own_joints=tuple(j.own_name or j.name for j in part),
                    unmatched=tuple(j.name for j in part if j.name not in gains.joints),
                    stiffness=stiffness,
                    damping=damping,
                    stiffness_range=_about(stiffness, group.stiffness_range),
                    damping_range=_about(damping, group.damping_range),
                    armature=_mean([joint.armature.value for joint in known], drive.armature),
                    frictionloss=_mean(dry, drive.frictionloss),
                    stribeck=_mean([joint.stribeck.value for joint in known], 0.0),
                    delay_s=_mean([joint.delay_s.value for joint in known], 0.0),
                    drive=drive,
                )
            )
    return out


@dataclass(frozen=True, kw_only=True)
class Target:
    """What reads an exported text."""

    profile: str = ""
    """The profile that gains must hold for, up to frameworks of the same law and step; empty for
    any."""
    body: Callable[[Target, list[Actuator], Profile, RobotSpec], str]
    settings: str
    """What must be set beside the text; {timestep}, {decimation}, {iterations} are filled in."""
    parameters: str = ""
    """What the text sets: words `ARGUMENT=NAME`, or `ARGUMENT` of that name (`Actuator.value`)."""
    call: str = ""
    """Class of the configuration."""
    delay: tuple[str, ...] = ()
    """Arguments that take a delay in physics steps."""
    no_delay: str = "delay the actions in the environment"
    """What to do about a delay that the target cannot express."""
    stribeck: bool = False
    """True if friction can fall with speed."""
    xml: bool = False
    """True if the text is XML of MuJoCo, which also takes delays in seconds."""

    @property
    def arguments(self) -> dict[str, str]:
        """Names of arguments to those of `Actuator.value`."""
        pairs = (word.partition("=") for word in self.parameters.split())
        return {argument: name or argument for argument, _, name in pairs}


def _fields(target: Target, one: Actuator, form: str) -> str:
    """The arguments of an actuator, each in a form."""
    pairs = target.arguments.items()
    return "".join(form.format(argument, _number(one.value(name))) for argument, name in pairs)


def _lines(target: Target, one: Actuator, profile: Profile) -> str:
    """The arguments of an actuator with its delay, one a line."""
    steps, form = round(one.delay_s / profile.timestep_s), "        {}={},\n"
    delay = [form.format(name, steps) for name in target.delay if steps]
    return _fields(target, one, form) + "".join(delay)


def _mjlab(target: Target, drives: list[Actuator], profile: Profile, _robot: RobotSpec) -> str:
    """`ACTUATORS`, a tuple of configs, and `EVENTS`, which draw absolute gains (D3, D4).

    The events address the actuators by their place in `ACTUATORS`, so their order matters.
    """
    entries = "".join(
        f"    {target.call}(  # {one.name}\n"
        f"        target_names_expr={_names(one.own_joints)},\n"
        f"{_lines(target, one, profile)}    ),\n"
        for one in drives
    )
    events = "".join(
        f'    "{one.name}_gains": EventTermCfg(\n'
        f"        func=dr.pd_gains,\n"
        f'        mode="startup",\n'
        f"        params={{\n"
        f'            "asset_cfg": SceneEntityCfg("robot", actuator_ids=[{index}]),\n'
        f'            "kp_range": {_pair(one.stiffness_range)},\n'
        f'            "kd_range": {_pair(one.damping_range)},\n'
        f'            "operation": "abs",\n'
        f"        }},\n"
        f"    ),\n"
        for index, one in enumerate(drives)
    )
    return (
        f"from mjlab.actuator import {target.call}\n"
        "from mjlab.envs.mdp import dr\n"
        "from mjlab.managers.event_manager import EventTermCfg\n"
        "from mjlab.managers.scene_entity_config import SceneEntityCfg\n\n"
        f"ACTUATORS = (\n{entries})\n\nEVENTS = {{\n{events}}}\n"
    )


def _isaaclab(target: Target, drives: list[Actuator], profile: Profile, _robot: RobotSpec) -> str:
    """`ACTUATORS`, a dict of configs by group."""
    entries = "".join(
        f'    "{one.name}": {target.call}(\n'
        f"        joint_names_expr={list(one.own_joints)!r},\n"
        f"{_lines(target, one, profile)}"
        f"    ),  # draw stiffness from {_pair(one.stiffness_range)}, "
        f"damping from {_pair(one.damping_range)}\n"
        for one in drives
    )
    return f"from isaaclab.actuators import {target.call}\n\nACTUATORS = {{\n{entries}}}\n"


def _by_joint(target: Target, drives: list[Actuator]) -> str:
    """`JOINTS`, a dict of parameters by joint name."""
    lines = "".join(
        f'    "{name}": dict({_fields(target, one, "{}={}, ").strip()}),\n'
        for one in drives
        for name in one.own_joints
    )
    return f"JOINTS = {{\n{lines}}}\n"


def _genesis(target: Target, drives: list[Actuator], _p: Profile, _robot: RobotSpec) -> str:
    """`apply`, to be called after `scene.build`."""
    setters = "".join(
        f'    robot.set_dofs_{name}([one["{name}"] for one in JOINTS.values()], dofs)\n'
        for name in target.arguments
        if name != "force_range"
    )
    return (
        f"{_by_joint(target, drives)}\n\n"
        "def apply(robot):\n"
        '    """Give an entity its drives; call it after scene.build()."""\n'
        "    dofs = [robot.get_joint(name).dofs_idx_local[0] for name in JOINTS]\n"
        '    limits = [one["force_range"] for one in JOINTS.values()]\n'
        f"{setters}    robot.set_dofs_force_range([-limit for limit in limits], limits, dofs)\n"
    )


def _playground(target: Target, drives: list[Actuator], profile: Profile, _r: RobotSpec) -> str:
    """`apply`, for an MjModel with a position actuator a joint."""
    return (
        f"import mujoco\n\n{_by_joint(target, drives)}\n\n"
        "def apply(model):\n"
        '    """Set drives and step of an MjModel; call it before mjx.put_model(model)."""\n'
        f"    model.opt.timestep = {profile.timestep_s!r}\n"
        "    model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER\n"
        "    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP\n"
        "    for name, one in JOINTS.items():\n"
        "        joint = model.joint(name)\n"
        "        dof = joint.dofadr[0]\n"
        '        for field in ("damping", "armature", "frictionloss"):\n'
        '            getattr(model, "dof_" + field)[dof] = one[field]\n'
        "        (drive,) = (model.actuator_trnid[:, 0] == joint.id).nonzero()[0]\n"
        '        model.actuator_gainprm[drive, :3] = one["kp"], 0.0, 0.0\n'
        '        model.actuator_biasprm[drive, :3] = 0.0, -one["kp"], 0.0\n'
        "        model.actuator_forcelimited[drive] = 1\n"
        '        model.actuator_forcerange[drive] = -one["effort_limit"], one["effort_limit"]\n'
        "    mujoco.mj_setConst(model, mujoco.MjData(model))\n"
    )


def _newton(target: Target, drives: list[Actuator], profile: Profile, _robot: RobotSpec) -> str:
    """A USD layer: an actuator prim and the passive parameters of every joint."""
    passive = replace(
        target, parameters="armature friction=frictionloss damping=viscous_per_degree"
    )
    form, joints, prims = "            float newton:{} = {}\n", "", ""
    for one in drives:
        steps = round(one.delay_s / profile.timestep_s)
        late = f"            int newton:delaySteps = {steps}\n" if steps else ""
        schemas = '"NewtonPDControlAPI", "NewtonDCMotorClampingAPI"'
        schemas += ', "NewtonActuatorDelayAPI"' if steps else ""
        for name in one.own_joints:
            joints += (
                f'        over "{name}" (\n            prepend apiSchemas = ["NewtonJointAPI"]\n'
                f"        )\n        {{\n{_fields(passive, one, form)}        }}\n"
            )
            prims += (
                f'        def NewtonActuator "{name}_actuator" (\n'
                f"            prepend apiSchemas = [{schemas}]\n        )\n        {{\n"
                f"            rel newton:targets = </Robot/joints/{name}>\n"
                f"{_fields(target, one, form)}{late}        }}\n"
            )
    return (
        'over "Robot"\n{\n    over "joints"\n    {\n'
        f'{joints}    }}\n\n    def Scope "Actuators"\n    {{\n{prims}    }}\n}}\n'
    )


def _mjcf(_t: Target, drives: list[Actuator], _p: Profile, robot: RobotSpec) -> str:
    """The whole robot with a native `dcmotor` a joint, of any drive law.

    Joints that were not matched have the robot's published gains.
    """
    by_joint = {joint: one for one in drives for joint in one.joints}
    spec = free_spec(robot)
    set_law(spec.option, robot)
    for name, one in by_joint.items():
        spec.joint(name).armature = one.armature
        spec.joint(name).frictionloss = one.frictionloss
    add_drives(
        spec,
        robot,
        robot.joint_names,
        stiffness={name: one.stiffness for name, one in by_joint.items()},
        damping={name: one.damping for name, one in by_joint.items()},
        stribeck={name: one.stribeck for name, one in by_joint.items() if one.stribeck},
    )
    for name, one in by_joint.items():
        if one.delay_s:
            # Linear between steps is the mean of a held command over a step (`held_mean`).
            actuator = spec.actuator(name)
            actuator.delay, actuator.interp = one.delay_s, 1
            actuator.nsample = math.ceil(one.delay_s / spec.option.timestep) + 1
    spec.compile()
    return str(spec.to_xml())


def _snippet(target: Target, drives: list[Actuator], profile: Profile, robot: RobotSpec) -> str:
    """What a model of one's own needs: option, joint attributes, and actuators."""
    root = ET.fromstring(_mjcf(target, drives, profile, robot))
    own = dict(zip(_flat(drives, "joints"), _flat(drives, "own_joints"), strict=True))
    integrator = "Euler" if robot.law.kind == "explicit" else "implicitfast"
    step = robot.law.substep(robot.timestep_s)
    flag = '<flag eulerdamp="disable"/>' if robot.law.passive_damping == "explicit" else ""
    lines = [f'<option timestep="{step!r}" integrator="{integrator}">{flag}</option>']
    for joint in root.iter("joint"):
        if (name := joint.get("name", "")) in own:
            passive = [f'{n}="{joint.get(n, 0)}"' for n in ("damping", "armature", "frictionloss")]
            lines.append(f'<joint name="{own[name]}" {" ".join(passive)}/>')
    lines.append("<actuator>")
    for actuator in root.iterfind("actuator/*"):
        if (name := actuator.get("joint", "")) in own:
            actuator.set("name", own[name])
            actuator.set("joint", own[name])
            actuator.tail = None
            lines.append(f"  {ET.tostring(actuator, encoding='unicode')}")
    return "\n".join([*lines, "</actuator>", ""])


_GAINS = "stiffness damping armature"
_FRICTION = (
    "friction=frictionloss dynamic_friction=sliding_friction viscous_friction=viscous_damping"
)
_LIMIT = "actuator_effort_limit=effort_limit"
_MOTOR = "saturation_effort=stall_torque"
_STEP = "Set sim.dt to {timestep} s and decimation to {decimation}"
_PHYSX = (
    f"{_STEP}, PhysX's solver to TGS. Friction is a torque since Isaac Sim 5.0; before it was "
    "a coefficient."
)
_ONCE = f"{_PHYSX} Set enable_external_forces_every_iteration to False."
_PHYSX_TARGETS = {
    "isaaclab-implicit": Target(
        profile="isaaclab-implicit",
        body=_isaaclab,
        call="ImplicitActuatorCfg",
        parameters=f"{_GAINS} {_FRICTION} joint_effort_limit=effort_limit",
        settings=f"{_PHYSX} Set solver_position_iteration_count to {{iterations}}, that of "
        "velocity to 0.",
        stribeck=True,
    ),
    "isaaclab-dcmotor": Target(
        profile="isaaclab-explicit",
        body=_isaaclab,
        call="DCMotorCfg",
        parameters=f"{_GAINS} {_FRICTION} {_LIMIT} {_MOTOR} actuator_velocity_limit=no_load_speed",
        settings=_ONCE,
        stribeck=True,
        no_delay="delay the actions in the environment, or take isaaclab-delayed",
    ),
    "isaaclab-delayed": Target(
        profile="isaaclab-explicit",
        body=_isaaclab,
        call="DelayedPDActuatorCfg",
        parameters=f"{_GAINS} {_FRICTION} {_LIMIT}",
        delay=("min_delay", "max_delay"),
        settings=f"{_ONCE} DelayedPDActuator has no torque-speed line.",
        stribeck=True,
    ),
}


def _of_release_2_3(target: Target) -> Target:
    """An export for Isaac Lab 3.0 with the names of limits in 2.3."""
    words = target.parameters.replace("joint_effort_limit=", "effort_limit_sim=")
    return replace(target, parameters=words.replace("actuator_", ""))


_IDEAL_PD = Target(
    profile="mjlab",
    body=_mjlab,
    call="IdealPdActuatorCfg",
    parameters=f"{_GAINS} frictionloss viscous_damping effort_limit",
    delay=("delay_min_lag", "delay_max_lag"),
    settings=f"{_STEP}. IdealPdActuator has no torque-speed line.",
)
TARGETS: Mapping[str, Target] = {
    "mjlab": replace(
        _IDEAL_PD,
        call="DcMotorActuatorCfg",
        parameters=f"{_IDEAL_PD.parameters} {_MOTOR} velocity_limit=no_load_speed",
        settings=f"{_STEP}.",
    ),
    "mjlab-idealpd": _IDEAL_PD,
    "mjlab-builtin": replace(
        _IDEAL_PD,
        profile="mjlab-builtin",
        call="BuiltinPositionActuatorCfg",
        settings=f"{_STEP}, the integrator to implicitfast.",
    ),
    **_PHYSX_TARGETS,
    **{f"{name}-2.3": _of_release_2_3(one) for name, one in _PHYSX_TARGETS.items()},
    "isaaclab-newton": Target(
        profile="isaaclab-newton",
        body=_isaaclab,
        call="ImplicitActuatorCfg",
        parameters="stiffness damping=all_damping armature joint_effort_limit=effort_limit "
        "friction=frictionloss",
        settings=f"Isaac Lab 3.0, physics=newton_mjwarp. {_STEP}, the integrator to implicitfast. "
        "Damping includes the viscous friction.",
    ),
    "newton-usd": Target(
        profile="isaaclab-explicit",
        body=_newton,
        parameters="kp=stiffness kd=damping maxMotorEffort=effort_limit "
        "saturationEffort=stall_torque velocityLimit=no_load_speed",
        delay=("newton:delaySteps",),
        settings="Replace /Robot/joints by the path of the joints. Actuators must step with the "
        "physics, each {timestep} s; commands are held for {decimation} steps. XPBD, VBD and "
        "SemiImplicit of Newton have no armature: another joint. Joint damping is per degree.",
    ),
    "genesis": Target(
        profile="genesis",
        body=_genesis,
        parameters="kp=stiffness kv=damping armature frictionloss damping=viscous_damping "
        "force_range=effort_limit",
        settings="Set SimOptions(dt={period}, substeps={decimation}), and command by "
        "control_dofs_position. Without apply() a URDF's joints have an armature of 0.1 kg m^2.",
    ),
    "playground": Target(
        profile="playground",
        body=_playground,
        parameters="kp=stiffness damping=all_damping armature frictionloss effort_limit",
        settings="Set sim_dt to {timestep} s and ctrl_dt to {period} s. Joint damping is the "
        "derivative gain and the viscous friction.",
    ),
    "mjcf": Target(
        body=_mjcf,
        xml=True,
        stribeck=True,
        settings="Step and integrator are those of the drive law (E needs Euler); commands are "
        "held for {substeps} steps. Joints that were not matched have the robot's published gains.",
    ),
    "mjcf-snippet": Target(
        body=_snippet,
        xml=True,
        stribeck=True,
        settings="Put these attributes into your model; commands are held for {substeps} steps.",
    ),
}
"""What `export_text` can write."""


def export_text(
    gains: MatchedGains, target: str, robot: RobotSpec | None = None, *, per: Per = "group"
) -> str:
    """The gains as text for one of `TARGETS`; the robot is found by its name if not given.

    Raises:
        PronkError: The target is unknown or has another drive law or step than the gains, or the
            gains hold no group or are not stable, or the robot is unknown.
    """
    if target not in TARGETS:
        raise PronkError(f"no export to {target!r}; expected one of {', '.join(TARGETS)}.")
    chosen, holds = TARGETS[target], profile_held(gains)
    _check_profile(target, holds)
    known = holds.robot(robot or robot_of(gains))
    drives = actuators(gains, known, per)
    share = require_stable(holds, known, drives)
    text = "\n".join(
        textwrap.fill(line, 98, break_long_words=False, break_on_hyphens=False)
        for line in _header(gains, chosen, holds, known, drives, share)
    )
    text = text.replace("--", "-") if chosen.xml else textwrap.indent(text, "# ")
    head = f"<!--\n{text}\n-->" if chosen.xml else text
    if target == "newton-usd":
        head = f"#usda 1.0\n{head}"
    return f"{head}\n\n{chosen.body(chosen, drives, holds, known)}"


def profile_held(gains: MatchedGains) -> Profile:
    """The profile that gains hold for; PronkError if their simulator has none."""
    try:
        return profile_of(gains.simulator)
    except PronkError:
        raise PronkError(
            f"the gains hold for simulator {gains.simulator.engine}, whose drive law pronk does "
            f"not know; match with --for NAME, one of {', '.join(load_profiles())}."
        ) from None


def robot_of(gains: MatchedGains) -> RobotSpec:
    """Load the robot of some gains by its name; PronkError if there is none."""
    try:
        return load_robot(gains.robot)
    except RobotError:
        raise PronkError(
            f"the robot {gains.robot!r} of the gains is none that pronk knows by name; give "
            "--robot PATH, the robot.yaml or model that they were matched with."
        ) from None


def _check_profile(target: str, holds: Profile) -> None:
    """Refuse gains that hold for another drive law or step than the target's."""
    if not (name := TARGETS[target].profile) or name == holds.name:
        return
    wanted = profile(name)
    if (wanted.drive_law, wanted.timestep_s) != (holds.drive_law, holds.timestep_s):
        own, other = (
            f"drive law {one.drive_law.label} at {1000.0 * one.timestep_s:g} ms with "
            f"{one.passive_damping} passive damping"
            for one in (holds, wanted)
        )
        raise PronkError(
            f"the gains hold for {holds.name} ({own}), and {target} has {other}, with which they "
            f"are another joint; give `pronk match LOGS --for {name}`, or without logs "
            f"`pronk translate GAINS --to {name}`."
        )


def _header(
    gains: MatchedGains,
    target: Target,
    holds: Profile,
    robot: RobotSpec,
    drives: list[Actuator],
    share: float,
) -> Iterator[str]:
    """What every export begins with."""
    law, info, step = holds.drive_law, gains.simulator, holds.timestep_s
    yield f"Gains of {gains.robot}, matched by pronk for {holds.name} ({holds.framework})."
    engine = f"{info.engine} {info.version}".strip()
    yield (
        f"They hold for {engine}, {info.actuator}, drive law {law.label}, timestep {step:g} s, "
        f"decimation {robot.decimation}."
    )
    yield target.settings.format(
        timestep=f"{step:g}",
        decimation=robot.decimation,
        period=f"{step * robot.decimation:g}",
        iterations=law.iterations,
        substeps=robot.decimation * law.iterations,
    )
    if law.kind != "implicit":
        yield f"The drives use {100.0 * share:.0f} % of the law's stability limit."
    late = {one.name: one.delay_s for one in drives if one.delay_s > 1e-6}
    if late and target.delay:
        yield "Command delays, as steps and what steps leave: " + ", ".join(
            f"{name} {1000.0 * delay:.1f} ms = {round(delay / step)} steps and "
            f"{1000.0 * (delay - step * round(delay / step)):+.1f} ms"
            for name, delay in late.items()
        )
    elif late and target.xml:
        yield "Commands before the first are 0 rad for the delay; mj_initCtrlHistory sets others."
    elif late:
        delays = ", ".join(
            f"{name} {1000.0 * delay:.1f} ms ({delay / step:.1f} steps)"
            for name, delay in late.items()
        )
        yield f"Command delays that this file does not have: {delays}; {target.no_delay}."
    falling = [f"{one.name} {one.stribeck:.2g}" for one in drives if one.stribeck]
    if falling and not target.stribeck:
        yield (
            "Dry friction is that at rest. In motion the joints lose this share of it, which this "
            f"file does not have: {', '.join(falling)}."
        )
    if holds.friction != "N m":
        yield f"No dry friction: {holds.framework} has none in N m."
    own = [f"{a} = {b}" for one in drives for a, b in zip(one.own_joints, one.joints, strict=True)]
    if _flat(drives, "joints") != _flat(drives, "own_joints"):
        yield f"Joint names of the maker, and in pronk: {', '.join(own)}."
    if some := _flat(drives, "unmatched"):
        yield f"NOT MATCHED, with the gains of their group: {', '.join(some)}."
    if rest := [name for name in robot.joint_names if name not in _flat(drives, "joints")]:
        yield f"NOT MATCHED, and without gains here: {', '.join(rest)}."
    if gains.virtual:
        yield "The logs came from pronk's virtual robot, not from hardware."
    for name, digest in gains.logs.items():
        yield f"Log {name}, SHA-256 {digest}"


def _flat(drives: Sequence[Actuator], name: str) -> list[str]:
    return [joint for one in drives for joint in getattr(one, name)]


def _mean(values: Sequence[float], default: float) -> float:
    return float(np.mean(values)) if values else default


def _about(centre: float, half: float) -> tuple[float, float]:
    return round(max(centre - half, 0.0), 9), round(centre + half, 9)


def _number(value: float) -> str:
    return repr(float(f"{value:.7g}"))


def _pair(values: tuple[float, float]) -> str:
    return f"({_number(values[0])}, {_number(values[1])})"


def _names(names: tuple[str, ...]) -> str:
    return "(" + " ".join(f'"{name}",' for name in names) + ")"
