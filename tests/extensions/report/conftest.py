"""What most tests of the report look at."""

from dataclasses import replace

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.agent_names import teams_of
from ethbrake_marl.episode.counts import FIRST_IMPACTS, IMPACT_COUNTS
from ethbrake_marl.evaluation.comparison import Comparison
from ethbrake_marl.evaluation.measures import Measure
from ethbrake_marl.evaluation.summary import summarise
from ethbrake_marl.extensions.report.best_known import CONTACT_AVOIDABLE, IMPACT_UNAVOIDABLE

AGENTS = ("full_brake", "constant:4.5", "ppo", "ppo+episode")


def compared_by(scenario: str | eb.Scenario, agents: object, episodes: int = 60, count: str = "first") -> Comparison:
    loaded = eb.load_scenario(scenario)
    teams = teams_of(agents, loaded, harm_count=count)
    return Comparison.of(loaded, teams, episodes=episodes, seed=7, harm_count=count)


def with_best_known(compared: Comparison) -> Comparison:
    """Result with invented best known harm: half of these agents' least harm; avoidable where that is 0."""
    result = compared.result
    least = {
        count: 0.5 * np.min([own[count.column] for own in result.columns.values()], axis=0) for count in IMPACT_COUNTS
    }
    more = {f"best_known_{count.name}": value for count, value in least.items()}
    more[CONTACT_AVOIDABLE] = least[FIRST_IMPACTS] == 0.0
    more[IMPACT_UNAVOIDABLE] = least[FIRST_IMPACTS] > 0.0
    columns = {agent: {**own, **more} for agent, own in result.columns.items()}
    searched = replace(
        result,
        columns=columns,
        measures=(*result.measures, Measure("best_known"), Measure(CONTACT_AVOIDABLE), Measure(IMPACT_UNAVOIDABLE)),
    )
    return compared._replace(result=searched, table=summarise(searched))


@pytest.fixture(scope="session")
def compared() -> Comparison:
    return compared_by("paper-random", AGENTS, 120)


@pytest.fixture(scope="session")
def searched(compared: Comparison) -> Comparison:
    return with_best_known(compared)
