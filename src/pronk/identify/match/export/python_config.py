"""Exports to frameworks that are configured in Python: mjlab, Isaac Lab, Genesis, Playground."""

from __future__ import annotations

from collections.abc import Sequence

from pronk.identify.match.export.actuators import Actuator
from pronk.identify.match.export.target import (
    ExportTarget,
    argument_text,
    delay_steps,
    no_match_text,
    number_text,
)
from pronk.identify.simulators.profiles import Profile
from pronk.robots.robot import RobotSpec


def mjlab_config(
    target: ExportTarget, actuators: Sequence[Actuator], profile: Profile, _robot: RobotSpec
) -> str:
    """Write `ACTUATORS`, a tuple of configs, and `EVENTS`, which draw absolute gains (D3, D4).

    The events address the actuators by their place in `ACTUATORS`, so their order matters.
    """
    entries = ""
    events = ""
    for index, actuator in enumerate(actuators):
        entries += (
            f"    {target.config_class}(  # {actuator.name}{no_match_text(actuator, ', ')}\n"
            f"        target_names_expr={_names_text(actuator.maker_joints)},\n"
            f"{_argument_lines(target, actuator, profile)}"
            "    ),\n"
        )
        events += (
            f'    "{actuator.name}_gains": EventTermCfg(\n'
            "        func=dr.pd_gains,\n"
            '        mode="startup",\n'
            "        params={\n"
            f'            "asset_cfg": SceneEntityCfg("robot", actuator_ids=[{index}]),\n'
            f'            "kp_range": {_range_text(actuator.stiffness_range)},\n'
            f'            "kd_range": {_range_text(actuator.damping_range)},\n'
            '            "operation": "abs",\n'
            "        },\n"
            "    ),\n"
        )
    return (
        f"from mjlab.actuator import {target.config_class}\n"
        "from mjlab.envs.mdp import dr\n"
        "from mjlab.managers.event_manager import EventTermCfg\n"
        "from mjlab.managers.scene_entity_config import SceneEntityCfg\n"
        "\n"
        f"ACTUATORS = (\n{entries})\n"
        "\n"
        f"EVENTS = {{\n{events}}}\n"
    )


def isaaclab_config(
    target: ExportTarget, actuators: Sequence[Actuator], profile: Profile, _robot: RobotSpec
) -> str:
    """Write `ACTUATORS`, a dict of configs by group."""
    entries = ""
    for actuator in actuators:
        entries += (
            f'    "{actuator.name}": {target.config_class}(\n'
            f"        joint_names_expr={list(actuator.maker_joints)!r},\n"
            f"{_argument_lines(target, actuator, profile)}"
            f"    ),  # draw stiffness from {_range_text(actuator.stiffness_range)}, "
            f"damping from {_range_text(actuator.damping_range)}"
            f"{no_match_text(actuator, '; ')}\n"
        )
    return f"from isaaclab.actuators import {target.config_class}\n\nACTUATORS = {{\n{entries}}}\n"


def genesis_config(
    target: ExportTarget, actuators: Sequence[Actuator], _profile: Profile, _robot: RobotSpec
) -> str:
    """Write `apply`, to be called after `scene.build`."""
    setters = ""
    for argument in target.arguments:
        if argument != "force_range":
            setters += (
                f'    robot.set_dofs_{argument}([one["{argument}"] for one in JOINTS.values()], '
                "dofs)\n"
            )
    return (
        f"{_joints_dict(target, actuators)}\n\n"
        "def apply(robot):\n"
        '    """Give an entity its drives; call it after scene.build()."""\n'
        "    dofs = [robot.get_joint(name).dofs_idx_local[0] for name in JOINTS]\n"
        '    limits = [one["force_range"] for one in JOINTS.values()]\n'
        f"{setters}"
        "    robot.set_dofs_force_range([-limit for limit in limits], limits, dofs)\n"
    )


def playground_config(
    target: ExportTarget, actuators: Sequence[Actuator], profile: Profile, _robot: RobotSpec
) -> str:
    """Write `apply`, for an MjModel with a position actuator a joint."""
    return (
        "import mujoco\n\n"
        f"{_joints_dict(target, actuators)}\n\n"
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


def _argument_lines(target: ExportTarget, actuator: Actuator, profile: Profile) -> str:
    """Write the arguments of an actuator and its delay in physics steps, one a line."""
    form = "        {}={},\n"
    text = argument_text(actuator, target.arguments, form)
    steps = delay_steps(actuator, profile)
    if steps:
        for argument in target.delay_arguments:
            text += form.format(argument, steps)
    return text


def _joints_dict(target: ExportTarget, actuators: Sequence[Actuator]) -> str:
    """Write `JOINTS`, a dict of parameters by joint name."""
    lines = ""
    for actuator in actuators:
        arguments = argument_text(actuator, target.arguments, "{}={}, ").strip()
        for name in actuator.maker_joints:
            mark = no_match_text(actuator, "  # ")
            lines += f'    "{name}": dict({arguments}),{mark}\n'
    return f"JOINTS = {{\n{lines}}}\n"


def _range_text(ends: tuple[float, float]) -> str:
    return f"({number_text(ends[0])}, {number_text(ends[1])})"


def _names_text(names: Sequence[str]) -> str:
    quoted = [f'"{name}",' for name in names]
    return f"({' '.join(quoted)})"
