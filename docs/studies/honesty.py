"""What honesty costs: best known braking against the price of a push (docs/findings.md).

    .venv/bin/python docs/studies/honesty.py docs/figures/honesty.png

A push of s m/s costs PRICE times s (m2/s2); at a price of 0 everything is allowed. At any other price driving costs
10 m2/s2 for each m/s, harm that a contact passes on counts, and a vehicle that still moves at v at the horizon costs
v^2, as in the honest cost, where a push costs 10. At the prices 0 and 10 the best known braking is that of the shipped
tables; at a price between them a search starts from both. About eight CPU-minutes.
"""

from __future__ import annotations

import argparse
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

import ethbrake_marl as eb
from ethbrake_marl.episode.counts import EXACT_IMPACTS, HONEST, HarmCount
from ethbrake_marl.extensions.report.style import finish, in_our_style, new_panels, series_style, write_picture
from ethbrake_marl.extensions.search.best_harm import e_v2x_bm_profiles
from ethbrake_marl.extensions.search.pricing import Problem, problem_of
from ethbrake_marl.extensions.search.search import search_profiles
from ethbrake_marl.extensions.search.tables import best_stored
from ethbrake_marl.motion.layout import DROVE, PUSHED

TESTS = {"paper-random": "Main test", "paper-random-obstacle": "Obstacle test"}
PRICES = (0.0, 1.0, 3.0, 10.0)
SHIPPED = {0.0: "total", 10.0: "honest"}  # price -> count of the shipped tables
WORLDS, SEED, BUDGET = 10_000, 7, 4_000
DROVE_MPS = 0.05  # driving that gives more than this counts


class Cost(NamedTuple):
    """Means over the worlds of one test."""

    agent: str
    price: float
    first: float  # m2/s2
    total: float  # m2/s2
    honest: float  # m2/s2
    push_mps: float
    drove: float  # share of the worlds
    moving: float  # share of the worlds

    @classmethod
    def of(cls, agent: str, price: float, last: eb.State) -> Cost:
        """Means of episodes with these last states."""
        drove = last.line[:, DROVE].sum(axis=1) > DROVE_MPS
        harms = (float(last.harm(count).mean()) for count in ("first", "total", "honest"))
        push = float(last.line[:, PUSHED].sum(axis=1).mean())
        return cls(agent, price, *harms, push, float(drove.mean()), float(last.moving.mean()))


def with_price(problem: Problem, price: float) -> Problem:
    """Problem that minimises total harm and the costs of a price."""
    passed, _, *others = HONEST.weights[2:] if price else np.zeros(4)
    weights = np.array([0.0, 1.0, passed, price, *others])
    words = f"cost at a price of {price:g}"
    return problem.with_count(HarmCount("priced", weights, "priced_cost", words, (EXACT_IMPACTS,)))


def costs_of(test: str) -> list[Cost]:
    """Full braking, and for each price E-V2X-BM and the best known braking."""
    scenario, game = eb.open_game(test)
    alert = scenario.sample(WORLDS, SEED)
    asked = problem_of(game, alert, harm_count="total")
    shipped = {price: best_stored(asked, HarmCount.of(count))[1] for price, count in SHIPPED.items()}
    found = [Cost.of("full_brake", 0.0, asked.follow(asked.constant(asked.bounds[:, np.newaxis, :, 0])))]
    for price in PRICES:
        problem = with_price(asked, price)
        braking = e_v2x_bm_profiles(problem, alert)
        found.append(Cost.of("e_v2x_bm", price, problem.follow(braking)))
        best = shipped.get(price)
        if best is None:
            best, _ = search_profiles(problem, [*shipped.values(), braking], budget=BUDGET, threads=2)
        found.append(Cost.of("best known", price, problem.follow(best)))
    return found


@in_our_style
def draw(found: dict[str, list[Cost]]) -> Figure:
    """Figure: total harm against the push, with a panel for each test."""
    figure, panels = new_panels((8.0, 3.6), columns=len(found))
    for axes, (test, costs) in zip(panels, found.items(), strict=True):
        for k, agent in enumerate(("full_brake", "e_v2x_bm", "best known")):
            own = [cost for cost in costs if cost.agent == agent]
            axes.plot([cost.push_mps for cost in own], [cost.total for cost in own], label=agent, **series_style(k))
            for cost in own if agent == "best known" else ():
                axes.annotate(f"{cost.price:g}", (cost.push_mps, cost.total), (2, 5), textcoords="offset points")
        axes.set_xscale("symlog", linthresh=0.1)
        axes.set(title=TESTS[test], xlabel="push (m/s)", ylim=(0.0, None), xlim=(-0.01, 40.0))
    panels[0].set_ylabel("total harm (m²/s²)")
    panels[-1].legend(fontsize=8.5)
    return finish(figure, f"{WORLDS:,} worlds of seed {SEED}. Numbers: price of a push of 1 m/s, in m²/s².")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("picture", help="file for the figure")
    given = parser.parse_args()
    every = {test: costs_of(test) for test in TESTS}
    print(
        "| who drives Vehicle 2 | price | first-impact harm | total harm | honest cost | push (m/s) | drives | moves |"
    )
    print("|---|---:|---:|---:|---:|---:|---:|---:|")
    for test, costs in every.items():
        print(f"| **{TESTS[test]}** | | | | | | | |")
        for agent, price, first, total, honest, push, drove, moving in costs:
            shown = "" if agent == "full_brake" else f"{price:g}"
            numbers = (
                f"{first:.2f} | {total:.2f} | {honest:.2f} | {push:.2f} | {100 * drove:.1f} % | {100 * moving:.1f} %"
            )
            print(f"| {agent} | {shown} | {numbers} |")
    write_picture(given.picture, draw(every), force=True)
