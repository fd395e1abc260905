"""``eb.evaluate``: evaluation with scenarios, agents and measures by name."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from ethbrake_marl.agent_names import open_game, require_learner, teams_of
from ethbrake_marl.episode.counts import check_count
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import InvalidInput, check_whole_number
from ethbrake_marl.evaluation.evaluate import Result, evaluate_teams as evaluate_teams
from ethbrake_marl.evaluation.identity import about_scenario
from ethbrake_marl.evaluation.named_measures import measures_called
from ethbrake_marl.worlds.open_game import AnyScenario
from ethbrake_marl.worlds.sampling import DrawnWorlds

EPISODES, SEED = 10_000, 7  # the evaluation list


def evaluate(
    worlds: AnyScenario | DrawnWorlds | State | None = None,
    agents: Any = "full_brake,e_v2x_bm",
    *,
    scenario: AnyScenario | None = None,
    episodes: int | None = None,
    seed: int | None = None,
    harm_count: str = "first",
    measures: Iterable[str] | str = (),
    jobs: int = 1,
    on_done: Callable[[int], None] | None = None,
) -> Result:
    """Let agents drive the same worlds, each agent once in every world.

    ``eb.evaluate("paper-random", "full_brake,ppo+step")`` is the shortest form. Results have the same bits for any
    number of processes.

    Args:
        worlds: a scenario, from whose evaluation list the worlds are taken (a shipped name, the path or content of a
            file, or a ``Scenario``); or worlds at the alert, together with ``scenario``.
        agents: names of agents; or a mapping whose keys name the rows of the result, and whose values are names,
            agents, or mappings from vehicles to agents: ``{"mine": agent, "both": {"vehicle_2": agent, "vehicle_3":
            "coast"}}``.
        scenario: scenario to which ``worlds`` belong, if they are worlds at the alert.
        episodes: number of worlds from the evaluation list; None: 10,000.
        seed: seed of the evaluation list; None: 7.
        harm_count: what optimising agents minimise: ``first``, as in the paper, ``total``, or ``honest``, under which
            pushing hardly pays (``episode.counts``).
        measures: names of further measures (``evaluation.named_measures``).
        jobs: number of processes.
        on_done: function that is called with the number of worlds driven so far.

    Raises ``UnknownName`` for an unknown name, and ``InvalidInput`` for any other mistake.

    >>> import ethbrake_marl as eb
    >>> result = eb.evaluate("paper-random", "full_brake", episodes=3)
    >>> result["full_brake"]["total_harm"].round(2)
    array([33.79, 77.19,  0.  ])

    """
    test_worlds = None
    if isinstance(worlds, DrawnWorlds | State):
        test_worlds = worlds
    elif worlds is not None:
        if scenario is not None:
            raise InvalidInput("evaluate: scenario: is given twice; leave one of the two out")
        scenario = worlds
    if scenario is None:
        if test_worlds is not None:
            raise InvalidInput("evaluate: worlds need their scenario, for instance scenario='paper-random'")
        scenario = "paper-random"
    if test_worlds is not None and (episodes, seed) != (None, None):
        raise InvalidInput("evaluate: episodes and seed choose worlds of a list; leave them out if worlds are given")
    episodes, seed = EPISODES if episodes is None else episodes, SEED if seed is None else seed
    check_count("evaluate: harm_count", harm_count)
    loaded, game = open_game(scenario)
    require_learner(loaded)
    about = about_scenario(loaded, None if test_worlds is not None else seed)
    if test_worlds is None:
        check_whole_number("episodes", episodes, 1)
        test_worlds = loaded.draw(int(episodes), seed)
    teams = teams_of(agents, loaded, harm_count=harm_count)
    about["agent_settings"] = {"harm_count": harm_count}
    return evaluate_teams(test_worlds, teams, game, measures_called(measures or ()), jobs, about=about, on_done=on_done)
