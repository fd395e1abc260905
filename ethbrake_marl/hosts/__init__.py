"""Somebody else's simulator: what a host must be able to do, the loop that drives it, and SUMO as one."""

from typing import TYPE_CHECKING

from ethbrake_marl.doors import front_door

if TYPE_CHECKING:
    from ethbrake_marl.hosts.driving import (
        Host as Host,
        HostCommand as HostCommand,
        Hosted as Hosted,
        HostFailed as HostFailed,
        HostState as HostState,
        drive_host as drive_host,
        evaluate_hosted as evaluate_hosted,
    )
    from ethbrake_marl.hosts.sumo import SumoHost as SumoHost, find_host as find_host
else:
    __getattr__ = front_door(__name__, __file__)
