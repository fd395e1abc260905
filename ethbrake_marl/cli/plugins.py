"""The option ``--plugin`` of every command: loads a Python file, or an installed plug-in, before anything else."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

import typer
from typer.main import get_command

from ethbrake_marl.cli.late import import_late
from ethbrake_marl.cli.terminal import results_alone
from ethbrake_marl.envs.registration import register_environments
from ethbrake_marl.errors import AlreadyExists
from ethbrake_marl.files.plugins import load_plugin


def _load_all(sources: list[str] | None) -> None:
    with results_alone():
        for source in sources or ():
            register_environments()
            load_plugin(source)


PluginOption = Annotated[
    list[str] | None,
    typer.Option(
        "--plugin",
        metavar="FILE.py|NAME",
        help="Load this file, or installed plug-in, first: it is code, and can do what you can. Repeatable.",
        is_eager=True,  # before the values of other options are looked at
        expose_value=False,
        callback=_load_all,
    ),
]


def accept_plugins(command: Any) -> Any:
    """The command, or group of commands, with ``--plugin`` on it and on everything in it."""
    only_option = typer.Typer(add_completion=False)

    @only_option.command()
    def takes_plugins(plugin: PluginOption = None) -> None:
        """Nothing but the option, as Typer makes it."""

    (option,) = get_command(only_option).params
    waiting = [command]
    for each in waiting:
        each.params.append(option)
        waiting += getattr(each, "commands", {}).values()
    return command


def prepare_commands(command: Any) -> Any:
    """The command, or group of them, of which those of this package leave stdout to their results.

    Each of these registers the environments and makes its late imports first. A command of somebody's plug-in prints
    where it likes.
    """
    waiting = [command]
    for each in waiting:
        inner = getattr(each, "commands", None)
        waiting += (inner or {}).values()
        if inner is None and each.callback.__module__.startswith("ethbrake_marl."):
            each.callback = _prepared(each.callback)
    return command


def _prepared(callback: Callable[..., Any]) -> Callable[..., Any]:
    @results_alone()
    def call(*arguments: Any, **options: Any) -> Any:
        register_environments()
        import_late(callback.__module__)
        return callback(*arguments, **options)

    return call


def check_commands(app: typer.Typer) -> None:
    """Raise ``AlreadyExists`` for a command of somebody's that would take the place of another one."""
    names = [each.name or each.callback.__name__.replace("_", "-") for each in app.registered_commands if each.callback]
    names += [str(group.name) for group in app.registered_groups]
    for k, name in enumerate(names):
        if name in names[:k]:
            raise AlreadyExists(f"command {name!r} is there already; give yours another name: app.command('my-{name}')")
