"""Driving worlds that another simulator moves; SUMO."""

from ethbrake_marl.extensions.hosts.protocol import (
    Host as Host,
    HostCommand as HostCommand,
    HostFailed as HostFailed,
    HostState as HostState,
    drive_host as drive_host,
)
