"""The page of the explorer: sliders, what every agent makes of them, the player, a profile to draw, files to keep."""

from __future__ import annotations

from typing import Any, NamedTuple

from ethbrake_marl.pages.explorer.answer import Explored
from ethbrake_marl.pages.explorer.state import State, slider_groups
from ethbrake_marl.pages.frame import Part, Section, page, page_policy, render, shown
from ethbrake_marl.pages.parts import data
from ethbrake_marl.pages.player import live_player
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.shield import HybridAgent, StepShieldAgent

_STYLES = ("explorer/explorer.css",)
_SCRIPTS = ("explorer/profile.js", "explorer/cards.js", "explorer/explorer.js")


class Page(NamedTuple):
    """A page, and the content security policy that stands in it too."""

    html: str
    policy: str


def explorer_page(explored: Explored, state: State, *, world: int, seed: int) -> Page:
    """The page of a scenario and its agents.

    Args:
        explored: what is explored.
        state: with which the page begins.
        world: number of that state in the list.
        seed: of the list.

    """
    scenario = explored.scenario
    vehicle = f"Vehicle {explored.vehicle + 1}"
    content = _content(explored, state, world)
    shielded = any(isinstance(agent, HybridAgent | StepShieldAgent) for agent in explored.lineup.values())
    sections = [
        Section("The emergency", [_part("sliders", seed=seed)]),
        Section("What came of it", [_part("outcome", harm_count=explored.harm_count)]),
        Section("Drive it yourself", [_part("profile", vehicle=vehicle)]),
        Section("Watch it", [live_player(scenario.vehicles, shielded=shielded)]),
        Section("Keep it", [_part("keep"), Part(data("explorer_data", content), _STYLES, _SCRIPTS)]),
    ]
    title = f"Explorer: {scenario.name}"
    lead = f"Move a slider: {len(explored.lineup)} agents drive {vehicle} in the world that you set, at once."
    return Page(page(title, sections, lead=lead, served=True), page_policy(sections, served=True))


def _part(name: str, **values: object) -> Part:
    return Part(render("explorer/explorer.html.j2", part=name, **values))


def _content(explored: Explored, state: State, world: int) -> dict[str, Any]:
    groups = [group._asdict() for group in slider_groups(explored.scenario, state)]
    agents = list(explored.lineup)
    return {
        "groups": groups,
        "state": state,
        "world": world,
        "agents": [shown(agent) for agent in agents],
        "named": agents,  # as the server knows them
        "rival": _rival(explored),
        "worst": agents.index("full_brake") if "full_brake" in agents else 0,
        "driven": [explored.vehicle],
        "vehicles": explored.scenario.vehicles,
        "harm_count": explored.harm_count,
    }


def _rival(explored: Explored) -> int:
    """Whom to beat: the first agent that learned, else the last one."""
    for k, agent in enumerate(explored.lineup.values()):
        if isinstance(getattr(agent, "policy", None), Policy):
            return k
    return len(explored.lineup) - 1
