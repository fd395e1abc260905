"""Recorded episodes on the site's first page, in the player of the reports, and the same in words."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from markupsafe import Markup

from ethbrake_marl.agents.making import make_agent
from ethbrake_marl.evaluation.motion import EpisodeMotion
from ethbrake_marl.extensions.report.page import Part, read_file
from ethbrake_marl.extensions.report.player import Played
from ethbrake_marl.game.harm import HarmCount
from ethbrake_marl.scenario.catalogue import load_scenario

SEED = 7
WORLDS = (0, 1, 3, 5)  # the same lines of vehicles in each test
OWN = "A shipped policy"
AGENTS = {
    "Full braking": "full_brake",
    "E-V2X-BM": "e_v2x_bm",
    "PPO trained for the main test": "ppo",
    OWN: "universal",
    "Best known, with hindsight": "best_harm",
}
TESTS: dict[str, tuple[str, HarmCount]] = {  # scenario, the harm to read
    "Main test": ("paper-random", "first"),
    "Brake-only test": ("paper-random-brake-only", "first"),
    "Obstacle test": ("paper-random-obstacle", "total"),
}
START = """
## Watch it

Choose an emergency of one of the [three tests](game.md#three-tests) and up to three drivers of Vehicle 2.
Then press Play or move the slider. These are recorded episodes, each an example and no average; they
play in this page and load nothing.
"""


def add_demonstration(start: str) -> str:
    """The first page with the demonstration below its picture."""
    before, heading, after = start.partition("\n## Quick start\n")
    if not heading:
        raise ValueError("README has no heading 'Quick start', above which the site has its demonstration")
    return f"{before}\n{START}\n```{{raw}} html\n{demonstration()}\n```\n{heading}{after}"


def demonstration() -> Markup:
    """The player with these episodes, its styles and script, and then each episode in words."""
    played = [one for test in TESTS for one in drive(test)]
    player = Part.player(played, (1,), shown_first=[0, list(AGENTS).index(OWN)], folded=True)
    style = "\n".join(map(read_file, player.styles))
    script = "\n".join(map(read_file, player.scripts))
    words = Markup("\n").join(line for one in played for line in tell(one))
    whole = """<div class="demo">
<style>.demo {{
{}
}}</style>
{}
<details><summary>The same episodes in words</summary>
{}
</details>
<script>(() => {{
{}
}})();</script>
</div>"""
    return Markup(whole).format(Markup(style), player.html, words, Markup(script))


def drive(test: str) -> list[Played]:
    """The worlds of a test, driven by every agent."""
    name, count = TESTS[test]
    scenario = load_scenario(name)
    worlds = scenario.sample(max(WORLDS) + 1, SEED).worlds.take(np.array(WORLDS))
    played = [Played(number, test, "", title=f"{test}, world {number}") for number in WORLDS]
    for agent, spelling in AGENTS.items():
        driver = make_agent(spelling, scenario=scenario, harm_count=count)
        Played.drive(played, worlds, agent, driver, scenario)
    harms = [[one.motions[agent].harm[count == "total"] for agent in ("Full braking", OWN)] for one in played]
    return [
        replace(one, why=f"harm {full:.1f} by full braking, {trained:.1f} by a shipped policy")
        for one, (full, trained) in zip(played, harms, strict=True)
    ]


def tell(played: Played) -> Iterator[Markup]:
    """What happens in a world, a line for each agent."""
    line = Markup("<li><strong>{}.</strong> {}</li>")
    lines = [line.format(agent, in_words(motion)) for agent, motion in played.motions.items()]
    yield Markup("<p><strong>{}</strong></p>").format(played.title)
    yield Markup("<ul>{}</ul>").format(Markup("\n").join(lines))


def in_words(motion: EpisodeMotion) -> str:
    """The first impact of each pair, and the harm."""
    rows = motion.impacts
    told = []
    for k in np.flatnonzero(rows.first):
        pair = int(rows.pair[k])
        whom = "Vehicle 1 strikes the obstacle" if pair < 0 else f"Vehicle {pair + 2} strikes Vehicle {pair + 1}"
        told.append(f"{whom} after {rows.time_s[k]:.2f} s at {rows.closing_speed_mps[k]:.1f} m/s")
    first, total = motion.harm
    harm = f"first-impact harm {first:.1f}, total harm {total:.1f} m²/s²" if told else "No impact, no harm"
    return f"{'; '.join([*told, harm])}."
