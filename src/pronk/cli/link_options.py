"""Options of the commands that move a machine."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from pronk.cli.options import check_seed
from pronk.errors import HardwareError

if TYPE_CHECKING:
    from pronk.deploy.links.address import Address

Layout = Literal["cheetah", "wtw"]
"""Messages on LCM: Cheetah-Software's, or walk-these-ways'."""
Base = Literal["bench", "ground"]
"""What the virtual robot's trunk is fixed to, or stands on."""


@dataclass(frozen=True, kw_only=True)
class LinkOptions:
    """The machine that a command moves."""

    link: str = "sim"
    """sim, the virtual robot in this program; lcm or dds, by wire; or a URI such as dds://eth0,
    lcm://eth0?layout=wtw, sim://ground."""
    interface: str | None = None
    """Network interface to a real robot; without it nothing leaves this computer."""
    layout: Layout | None = None
    """Messages on LCM; cheetah if left out."""
    port: int | None = None
    """UDP port of LCM."""
    domain: int | None = None
    """Domain of DDS."""
    release: Annotated[bool, tyro.conf.arg(name="disable-onboard-controller")] = False
    """Switch off the robot's own controller."""
    real_time: bool = True
    """Request real-time scheduling (by wire)."""
    sim_params: Path | None = None
    """Parameters of the virtual robot, instead of the shipped ones."""
    seed: int = 0
    """Seed of the virtual robot's noise."""
    yes: bool = False
    """No confirmation before real hardware moves."""

    def address(self, base: Base | None = None) -> Address:
        """Return the machine's address with the options of its link.

        Args:
            base: What the virtual robot stands on; the link's own choice if None.

        Raises:
            HardwareError: An option does not belong to this link.
        """
        from pronk.deploy.links.address import SIM, Address

        options: dict[str, Any] = {
            "layout": self.layout,
            "port": self.port,
            "domain": self.domain,
        }
        scheme = self.link.partition(":")[0]
        if scheme == SIM:
            check_seed(self.seed)
            options["seed"] = self.seed or None
            options["params"] = None if self.sim_params is None else str(self.sim_params)
            return Address.parse(self.link, base or self.interface, **options)
        of_simulation = {
            "--base": base is not None,
            "--sim-params": self.sim_params is not None,
            "--seed": self.seed != 0,
        }
        for option, is_given in of_simulation.items():
            if is_given:
                raise HardwareError(
                    f"{option} is of --link sim; give it to `pronk simulate` instead."
                )
        return Address.parse(self.link, self.interface, **options)
