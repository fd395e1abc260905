"""Hosts: agents drive vehicles that another simulator, for instance SUMO, moves."""

from ethbrake_marl.extensions.hosts.protocol import (
    Host as Host,
    HostCommand as HostCommand,
    HostFailed as HostFailed,
    HostState as HostState,
    drive_host as drive_host,
)
