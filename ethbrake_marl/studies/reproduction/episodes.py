"""The episodes that an item lets one watch: kept beside its result as plain data, and read again with suspicion."""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.per_world import write_output
from ethbrake_marl.files.plain import read_plain
from ethbrake_marl.pages.frame import Part, shown
from ethbrake_marl.pages.player import player_of

EPISODES = "episodes.json"
_LIMIT_BYTES = 4 << 20
_MOST = 64  # vehicles

_Index = Annotated[int, Field(ge=0, lt=_MOST)]
_Impact = Annotated[list[FiniteFloat], Field(min_length=7, max_length=7)]


class _Plain(BaseModel):
    """What ``player_content`` gives, and nothing else."""

    model_config = ConfigDict(strict=True, extra="forbid")


class _Episode(_Plain):
    pieces: str
    end: FiniteFloat
    impacts: list[_Impact]
    stepped: list[FiniteFloat]
    driven: list[_Index]
    obstacle: FiniteFloat | None
    rest: bool
    passport: str


class _World(_Plain):
    number: int
    title: str
    kind: str
    why: str
    conditions: str
    episodes: list[_Episode]


class _Content(_Plain):
    vehicles: Annotated[int, Field(ge=2, le=_MOST)]
    agents: Annotated[list[str], Field(min_length=1)]
    shown: Annotated[list[_Index], Field(min_length=1)]
    worlds: Annotated[list[_World], Field(min_length=1)]


def keep_episodes(folder: Path, content: Mapping[str, Any] | None) -> None:
    """Write what ``player_content`` gave into the folder of an item; None: what was there is deleted."""
    if content is None:
        (folder / EPISODES).unlink(missing_ok=True)
    else:
        write_output(folder / EPISODES, json.dumps(content, allow_nan=False).encode(), force=True)


def kept_player(folder: Path) -> Part | None:
    """The player of the episodes that were kept; None where there are none.

    Raises ``InvalidInput`` for a file that does not hold what ``keep_episodes`` writes.
    """
    file = folder / EPISODES
    if not file.is_file():
        return None
    try:
        content = _Content.model_validate_json(read_plain(file, _LIMIT_BYTES))
    except ValidationError as error:
        where = ".".join(map(str, error.errors()[0]["loc"])) or "no JSON"
        raise _damaged(file, where) from None
    if not _fits(content):
        raise _damaged(file, "worlds")
    return player_of(_as_text(content.model_dump()))


def _fits(content: _Content) -> bool:
    """Whether every world has an episode of every agent, whole pieces in each."""
    agents, width = len(content.agents), 8 * (1 + 3 * content.vehicles)
    if not all(k < agents for k in content.shown):
        return False
    for world in content.worlds:
        if len(world.episodes) != agents:
            return False
        for episode in world.episodes:
            try:
                size = len(base64.b64decode(episode.pieces, validate=True))
            except (binascii.Error, ValueError):
                return False
            if not size or size % width or not all(i < content.vehicles for i in episode.driven):
                return False
    return True


def _as_text(value: Any) -> Any:
    """The same data with every text as a page shows it."""
    if isinstance(value, dict):
        return {key: _as_text(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_as_text(each) for each in value]
    return shown(value) if isinstance(value, str) else value


def _damaged(file: Path, where: str) -> InvalidInput:
    return InvalidInput(f"{file}: {shown(where)}: is not what a reproduction writes; make it again (--force)")
