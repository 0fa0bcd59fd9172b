"""Export to Newton: a USD layer with actuators and the passive parameters of the joints.

The schemas are those of newton-usd-schemas 0.6.0 (`generatedSchema.usda`): a `NewtonActuator` is in
radians, a `NewtonJointAPI` in degrees.
"""

from __future__ import annotations

from collections.abc import Sequence

from pronk.identify.match.export.actuators import Actuator
from pronk.identify.match.export.target import (
    ExportTarget,
    argument_text,
    delay_steps,
    no_match_text,
)
from pronk.identify.simulators.profiles import Profile
from pronk.robots.robot import RobotSpec

PASSIVE_ARGUMENTS = {
    "armature": "armature",
    "friction": "frictionloss",
    "damping": "viscous_per_degree",
}
"""Attributes of `NewtonJointAPI`, to the names of `Actuator.quantities`."""


def newton_layer(
    target: ExportTarget, actuators: Sequence[Actuator], profile: Profile, _robot: RobotSpec
) -> str:
    """Write a USD layer: an actuator prim and the passive parameters of every joint."""
    form = "            float newton:{} = {}\n"
    joints = ""
    prims = ""
    for actuator in actuators:
        schemas = '"NewtonPDControlAPI", "NewtonDCMotorClampingAPI"'
        delay = ""
        steps = delay_steps(actuator, profile)
        if steps:
            schemas += ', "NewtonActuatorDelayAPI"'
            delay = f"            int {target.delay_arguments[0]} = {steps}\n"
        for name in actuator.maker_joints:
            joints += (
                f'        over "{name}" (\n'
                '            prepend apiSchemas = ["NewtonJointAPI"]\n'
                "        )\n"
                "        {\n"
                f"{argument_text(actuator, PASSIVE_ARGUMENTS, form)}"
                "        }\n"
            )
            mark = no_match_text(actuator, "            # ")
            if mark:
                mark += "\n"
            prims += (
                f'        def NewtonActuator "{name}_actuator" (\n'
                f"            prepend apiSchemas = [{schemas}]\n"
                "        )\n"
                "        {\n"
                f"{mark}"
                f"            rel newton:targets = </Robot/joints/{name}>\n"
                f"{argument_text(actuator, target.arguments, form)}"
                f"{delay}"
                "        }\n"
            )
    return (
        'over "Robot"\n'
        "{\n"
        '    over "joints"\n'
        "    {\n"
        f"{joints}"
        "    }\n"
        "\n"
        '    def Scope "Actuators"\n'
        "    {\n"
        f"{prims}"
        "    }\n"
        "}\n"
    )
