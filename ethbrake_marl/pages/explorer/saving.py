"""States of the explorer as files in one folder: a scenario as YAML, or a table of initial states with one row."""

from __future__ import annotations

import csv
import io
import os
import re
from pathlib import Path
from typing import Any, Literal, get_args

from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.files.yaml import flow_text
from ethbrake_marl.pages.explorer.state import state_of
from ethbrake_marl.physics import Worlds
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.scenario.initial_states import table_columns
from ethbrake_marl.scenario.quantities import OTHERWISE

Kind = Literal["yaml", "csv"]

_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,63}", re.ASCII)
_DRAWN = {*OTHERWISE, "vehicle_types", "types"}  # other ways to say what a state says
_DEVICES = {"con", "prn", "aux", "nul", *(f"{port}{k}" for port in ("com", "lpt") for k in range(10))}


def save_state(folder: Path, name: object, kind: object, world: Worlds, scenario: Scenario) -> str:
    """Write one world (n = 1) as a new file of the folder, and give the file's name.

    Raises ``InvalidInput`` for a name that is not 1 to 64 lower case letters, digits, - and _ or that some system keeps
    for a device, and for another kind; ``AlreadyExists`` where there is anything of that name; ``OSError``.
    """
    if not isinstance(name, str) or not _NAME.fullmatch(name) or name in _DEVICES:
        raise InvalidInput(
            f"name {name!r:.80}: must be 1 to 64 lower case letters, digits, - and _, beginning with a letter or digit,"
            " and no device (con, nul, ...)"
        )
    if kind not in get_args(Kind):
        raise InvalidInput(f"kind {kind!r:.60}: must be yaml or csv")
    text = scenario_text(name, world, scenario) if kind == "yaml" else table_text(world, scenario)
    file = f"{name}.{kind}"
    _create(folder, file, text.encode())
    return file


def scenario_text(name: str, world: Worlds, scenario: Scenario) -> str:
    """A scenario whose every world is this one; it keeps scripts, time step, horizon and channel of ``scenario``."""
    fixed = {
        **{key: value for key, value in scenario.declared().items() if key not in _DRAWN},
        "name": name,
        "title": f"One world, from {scenario.name}",
        "description": "A state that was saved in the explorer.",
        "source": "ethbrake explore",
        "early_impacts": "keep",  # this very world, whatever happens in it
        **state_of(world),
    }
    lines = [f"{key}: {flow_text(value)}" for key, value in Scenario(**fixed).declared().items()]
    return "\n".join(["# Saved by ethbrake explore.", *lines, ""])


def table_text(world: Worlds, scenario: Scenario) -> str:
    """A table of initial states with this world as its one row."""
    state: dict[str, Any] = state_of(world)
    columns = {
        column: repr(float(state[field][index] if isinstance(state[field], list) else state[field]))
        for column, (field, index) in table_columns(scenario).items()
    }
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerows([list(columns), list(columns.values())])
    return text.getvalue()


def _create(folder: Path, file: str, data: bytes) -> None:
    """A new file right in the folder: the name is looked up there, no link is followed, nothing is replaced."""
    place = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
        with os.fdopen(os.open(file, flags, 0o666, dir_fd=place), "wb") as stream:
            try:
                stream.write(data)
                stream.flush()
                os.fsync(stream.fileno())
            except OSError:
                os.unlink(file, dir_fd=place)
                raise
    except FileExistsError:
        raise AlreadyExists(f"{file}: is there already; give another name") from None
    finally:
        os.close(place)
