"""How badly an agent does in a world, and the search for the worlds in which it does worst."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.agent_names import open_game, teams_of
from ethbrake_marl.agents.team import Team, play_to_end
from ethbrake_marl.episode.counts import HONEST, AnyCount, HarmCount
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.extensions.studies.cube import cube_of
from ethbrake_marl.extensions.studies.falsification import far_apart, search_cube
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.worlds.describe import fixed_columns, quantities_of
from ethbrake_marl.worlds.scenario import Scenario

WEAKNESS_MEASURES = ("harm", "regret", "bound")
HINDSIGHT = "best_harm"  # default rival of regret


class WeaknessResult(NamedTuple):
    score: Floats  # [n] value of the measure, the larger the worse for the agent
    harm: Floats  # [n] harm of the agent
    reference: Floats | None  # [n] harm of the rival, or bound of the agent's shield; None for ``harm``


class WeaknessMeasure(NamedTuple):
    """Measure of how badly an agent does in a world (m2/s2).

    ``harm``: the agent's harm. ``regret``: the agent's harm minus the harm of a rival, by default the best known
    commands. ``bound``: the agent's harm minus the bound that its shield promises at the alert; above 0 the bound is
    broken.
    """

    name: str
    scenario: Scenario
    game: Game
    teams: tuple[Team, ...]  # the agent, then the rival if there is one
    harm_count: HarmCount

    @classmethod
    def of(
        cls, name: str, agent: Any, against: Any, scenario: Scenario, harm_count: AnyCount = HONEST
    ) -> WeaknessMeasure:
        """The weakness measure ``name``, applied to an agent.

        ``against``: the rival, for ``regret`` only; None: the best known commands. Agents are names or objects, as for
        ``eb.evaluate``. Raises ``InvalidInput`` for an unknown measure, for a rival of another measure than ``regret``,
        and if a name means several agents; and the errors of ``teams_of``.
        """
        if name not in WEAKNESS_MEASURES:
            raise unknown_name("measure", name, WEAKNESS_MEASURES)
        if name != "regret" and against is not None:
            raise InvalidInput(f"--against {against}: only --measure regret compares two agents; leave --against out")
        count = HarmCount.of(harm_count)
        loaded, game = open_game(scenario, reward={"harm_count": count})
        chosen = [agent] if name != "regret" else [agent, HINDSIGHT if against is None else against]
        specs = (choice if isinstance(choice, str) else {"agent": choice} for choice in chosen)
        teams = [tuple(teams_of(spec, loaded, harm_count=count).values()) for spec in specs]
        if any(len(group) != 1 for group in teams):
            raise InvalidInput(f"agent {agent!r}, --against {against!r}: a name means several agents; name one agent")
        return cls(name, loaded, game, sum(teams, ()), count)

    def __call__(self, worlds: State) -> WeaknessResult:
        """Value of the measure in every world.

        Raises ``InvalidInput`` for ``bound`` if the agent has no shield that promises a bound.
        """
        last, *rival_states = (play_to_end(self.game, worlds, team) for team in self.teams)
        harm = last.harm(self.harm_count)
        if self.name == "harm":
            return WeaknessResult(harm, harm, None)
        shielded = getattr(last.memories.get("shield"), "first", None)  # price of the shield's plan at the alert
        reference = rival_states[0].harm(self.harm_count) if rival_states else shielded
        if reference is None:
            raise InvalidInput(
                f"agent {self.teams[0].name!r} is not behind a shield that promises a bound at the alert; --measure"
                " bound needs one, for instance ppo+step"
            )
        return WeaknessResult(harm - reference, harm, reference)

    def falsify(
        self, budget: int, seed: int, *, most: int = 20, on_round: Callable[[int], None] | None = None
    ) -> tuple[State, WeaknessResult, Floats]:
        """Worst worlds for the agent among ``budget`` worlds that a search of the scenario tries.

        Returns at most ``most`` worlds at the alert, worst first; the measure in them; and the scores of all tried
        worlds, [budget] m2/s2 (minus infinity: the scenario rejects the world). Except for ``bound``, only worlds with
        a score above 0 are returned, perhaps none. Any two of the worlds differ clearly. ``on_round``: called with the
        number of worlds tried so far.

        Raises the errors of ``cube_of``, and ``InvalidInput`` if the scenario rejects every tried world.
        """
        cube = cube_of(self.scenario)

        def score(points: Floats) -> Floats:
            worlds = cube.worlds(points)
            rows, scores = np.flatnonzero(cube.accepts(worlds)), np.full(len(points), -np.inf)
            if len(rows):
                scores[rows] = self(worlds.take(rows)).score
            return scores

        points, scores = search_cube(score, len(cube.places), budget, seed, on_round or (lambda world_count: None))
        if not np.isfinite(scores).any():
            raise InvalidInput(
                f"scenario {self.scenario.name!r}: in all {budget:,} tried worlds an impact happens before any agent"
                " may act; write 'early_impacts: keep' into the scenario, or give a larger --budget"
            )
        worst = far_apart(points, scores, most)
        worst = worst if self.name == "bound" else worst[scores[worst] > 0.0]
        worlds = cube.worlds(points[worst])
        return worlds, self(worlds), scores


def states_of(worlds: State, scenario: Scenario) -> list[dict[str, float]]:
    """Initial state of each world, column -> value: gaps, speeds, and what else the scenario does not fix."""
    fixed = fixed_columns(scenario)
    columns = {name: values for name, values in quantities_of(worlds).items() if name not in fixed}
    return [
        {name: float(values[k]) for name, values in columns.items() if np.isfinite(values[k])} for k in range(worlds.n)
    ]
