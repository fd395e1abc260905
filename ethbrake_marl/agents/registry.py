"""Agents by name: ``name[:argument]``, for instance ``constant:3.5``, or ``name@path`` for a saved policy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ethbrake_marl.agents.e_v2x_bm.agent import EV2XBM
from ethbrake_marl.agents.planner import Planner
from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.agents.scripts import CopyLeader, GentlestFront, StateFree
from ethbrake_marl.errors import AlreadyExists, InvalidInput, unknown_name
from ethbrake_marl.harm import HarmCount, check_count
from ethbrake_marl.scenario.roles import parse_agent_spec


@dataclass(frozen=True, slots=True)
class AgentSettings:
    """What an agent may need beyond its own argument."""

    count: HarmCount = "first"  # which harm an optimising agent minimises
    horizon_s: float = 8.0  # until when it looks ahead
    most_candidates: int | None = None  # of a search, whatever its argument says; None: what that says


Factory = Callable[[str | None, AgentSettings], Agent]


def make_agent(
    spec: str, *, count: HarmCount = "first", horizon_s: float = 8.0, most_candidates: int | None = None
) -> Agent:
    """A fresh agent for one vehicle in one batch.

    ``full_brake``, ``coast``, ``constant:a`` (deceleration in m/s2, negative = drive), ``copy_leader``,
    ``gentlest_front``, ``e_v2x_bm`` (= ``e_v2x_bm:coupled``), ``e_v2x_bm:pairwise``, ``planner``,
    ``planner:candidates``, ``planner:20ms`` (a time per decision), and what was registered. ``most_candidates`` is for
    trying an agent out: no search of it takes more.
    Raises ``UnknownName`` with a suggestion for an unknown name, ``InvalidInput`` for a bad argument, count or horizon.
    """
    check_count(count)
    if not isinstance(horizon_s, int | float | np.number) or not 0.0 < horizon_s < float("inf"):
        raise InvalidInput(f"horizon_s {horizon_s!r}: must be a positive number of seconds")
    name, argument = _split(spec)
    if name not in _FACTORIES:
        raise unknown_name("agent", name, _FACTORIES)
    return _FACTORIES[name](argument, AgentSettings(count, horizon_s, most_candidates))


def agent_names() -> tuple[str, ...]:
    """Names that ``make_agent`` knows, in alphabetical order."""
    return tuple(sorted(_FACTORIES))


def register_agent(name: str, factory: Factory) -> None:
    """Make ``name``, ``name:argument`` and ``name@argument`` known to ``make_agent``.

    This is how code above this room, yours included, adds agents without an import upward; the factory gets what
    stands after the colon or the ``@``. Registering the same factory again changes nothing; another one under a taken
    name raises ``AlreadyExists``, a name that is not plain ``InvalidInput``.
    """
    if _split(name) != (name, None):
        raise InvalidInput(f"agent name {name!r}: must be a plain name without argument")
    if _FACTORIES.setdefault(name, factory) is not factory:
        raise AlreadyExists(f"agent {name!r} is registered already")


def _split(spec: str) -> tuple[str, str | None]:
    """Name and argument of ``name``, ``name:argument`` or ``name@argument``; a path may hold any character."""
    head, at, path = spec.partition("@") if isinstance(spec, str) else ("", "", "")
    if not at or ":" in head:
        return parse_agent_spec(spec)
    if not path:
        raise InvalidInput(f"agent {spec!r}: a path is needed after '@'")
    return parse_agent_spec(head)[0], path


def _state_free(name: str) -> Factory:
    def factory(argument: str | None, settings: AgentSettings) -> Agent:
        return StateFree(name if argument is None else f"{name}:{argument}")

    return factory


def _without_argument(name: str, make: Callable[[], Agent]) -> Factory:
    def factory(argument: str | None, settings: AgentSettings) -> Agent:
        if argument is not None:
            raise InvalidInput(f"agent '{name}:{argument}': {name} takes no argument")
        return make()

    return factory


def _e_v2x_bm(argument: str | None, settings: AgentSettings) -> Agent:
    match argument:
        case None | "coupled":
            return EV2XBM("coupled", count=settings.count, horizon_s=settings.horizon_s)
        case "pairwise":
            return EV2XBM("pairwise", count=settings.count, horizon_s=settings.horizon_s)
    raise InvalidInput(f"agent 'e_v2x_bm:{argument}': the argument must be 'coupled' or 'pairwise'")


def _planner(argument: str | None, settings: AgentSettings) -> Agent:
    return Planner(
        argument, count=settings.count, horizon_s=settings.horizon_s, most_candidates=settings.most_candidates
    )


_FACTORIES: dict[str, Factory] = {
    "full_brake": _state_free("full_brake"),
    "coast": _state_free("coast"),
    "constant": _state_free("constant"),
    "copy_leader": _without_argument("copy_leader", CopyLeader),
    "gentlest_front": _without_argument("gentlest_front", GentlestFront),
    "e_v2x_bm": _e_v2x_bm,
    "planner": _planner,
}
