"""Whose harm can Vehicle 2 spare, and who bears more for it? The table and the figure of docs/cooperation.md.

    python docs/studies/whose_harm.py whose-harm.png

For each objective a search looks in every world for the commands of Vehicle 2 with the least honest cost under this
objective. It begins with the best known commands, and a second time with the results of all objectives. Prints the mean
honest cost that each vehicle bears.
"""

from __future__ import annotations

import argparse

from matplotlib.figure import Figure

import ethbrake_marl as eb
from ethbrake_marl.episode.counts import HONEST
from ethbrake_marl.extensions.report.style import finish, in_our_style, new_panels, series_style, write_picture
from ethbrake_marl.extensions.search.best_harm import best_harm
from ethbrake_marl.extensions.search.pricing import problem_of
from ethbrake_marl.extensions.search.tables import best_stored
from ethbrake_marl.motion.layout import Floats

SCENARIO, SEED = "paper-random", 7
FIRST_COUNTS = {  # objective -> whose cost counts; a weight of 1e-4 decides between commands that are otherwise equal
    "weighted:1,1,1": "all three alike",
    "weighted:1,1e-4,1e-4": "Vehicle 1, then the others",
    "weighted:1e-4,1,1e-4": "Vehicle 2, then the others",
    "weighted:1e-4,1e-4,1": "Vehicle 3, then the others",
    "maximin": "the vehicle that bears most",
}
ANGLES = {f"social:{angle}": f"{angle}°" for angle in (45, 70, 75, 80, 85)}  # 45° counts all alike
BRAKING = "nobody: full braking"


def borne_costs(worlds: int, budget: int) -> dict[str, Floats]:
    """Mean honest cost that each vehicle bears, [3] m2/s2, by objective, and with full braking."""
    scenario, game = eb.open_game(SCENARIO)
    alert = scenario.sample(worlds, SEED)
    problem = problem_of(game, alert)
    results = {"best known": best_stored(problem, HONEST)[1]}
    for _ in range(2):
        results = {
            objective: best_harm(
                game, alert, objective=objective, budget=budget, first_profiles=[*results.values()]
            ).profiles["honest"]
            for objective in (*FIRST_COUNTS, *ANGLES)
        }
    results[BRAKING] = problem.constant(problem.bounds[:, None, :, 0])
    return {objective: problem.follow(profiles).borne_harm().mean(axis=0) for objective, profiles in results.items()}


@in_our_style
def draw(costs: dict[str, Floats], worlds: int) -> Figure:
    """Figure: the cost of Vehicle 2 and that of the others, a point for each objective."""
    figure, (axes,) = new_panels((6.0, 4.2))
    points = {objective: (borne[1], borne[0] + borne[2]) for objective, borne in costs.items()}
    axes.plot(*zip(*(points[objective] for objective in ANGLES), strict=True), label="social:φ", **series_style(0))
    for objective, label in ANGLES.items():
        axes.annotate(label, points[objective], (4, 4), textcoords="offset points")
    for k, (objective, label) in enumerate((FIRST_COUNTS | {BRAKING: BRAKING}).items(), 1):
        axes.plot(*points[objective], label=label, **(series_style(k) | {"linestyle": "none"}))
    axes.set(xlabel="Vehicle 2 bears (m²/s²)", ylabel="Vehicles 1 and 3 bear (m²/s²)")
    axes.legend(fontsize=8.5)
    return finish(figure, f"Mean honest cost in {worlds:,} worlds of {SCENARIO}, seed {SEED}, by what counts.")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("picture", help="file for the figure")
    parser.add_argument("--worlds", type=int, default=300)
    parser.add_argument("--budget", type=int, default=3000, help="profiles for each world and objective, in each round")
    given = parser.parse_args()
    means = borne_costs(given.worlds, given.budget)
    for objective, borne in means.items():
        cells = " | ".join(f"{cost:.2f}" for cost in (*borne, borne.sum()))
        print(f"| {(FIRST_COUNTS | ANGLES).get(objective, objective)} | {cells} |")
    write_picture(given.picture, draw(means, given.worlds), force=True)
