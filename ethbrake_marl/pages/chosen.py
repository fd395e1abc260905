"""The worlds that a report shows: the worst, the typical, and some drawn at random; and every agent in each."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ethbrake_marl.agents.team import Driver, team_of
from ethbrake_marl.evaluation.identity import policy_sha256
from ethbrake_marl.evaluation.motion import follow_episodes
from ethbrake_marl.evaluation.outcome import Evaluation
from ethbrake_marl.evaluation.passport import issue_passport
from ethbrake_marl.evaluation.regret import assess
from ethbrake_marl.evaluation.table import BASELINE
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.pages.player import Played
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds
from ethbrake_marl.scenario import Scenario

MOST_WORLDS = 50
WORST = 10
_EACH = 5  # of the other kinds
_RANDOM_SEED = 0


class Chosen(NamedTuple):
    """A world of an evaluation, and why it is shown."""

    row: int
    kind: str
    why: str


def choose_shown(evaluation: Evaluation, focus: str, *, most: int = MOST_WORLDS) -> list[Chosen]:
    """Up to ``most`` worlds to look at, each once: where ``focus`` did worst, best against full braking, as usual."""
    outcome = evaluation.outcome(focus)
    found: dict[int, Chosen] = {}
    total, first = outcome.total_harm, outcome.first_impact_harm

    def add(kind: str, rows: Sequence[int] | Ints, most_of_kind: int) -> None:
        fresh = [int(row) for row in rows if int(row) not in found][: min(most_of_kind, most - len(found))]
        for row in fresh:
            found[row] = Chosen(row, kind, f"{focus}: harm {first[row]:.2f} first-impact, {total[row]:.2f} total")

    add(f"Where {focus} did worst", worst_rows(evaluation, focus), WORST)
    regrets = assess(evaluation)
    avoidable = None if regrets is None else regrets.limits.proof.avoidable
    if avoidable is not None:
        add(
            f"Avoidable, and {focus} collided",
            _largest(total, outcome.collided & avoidable),
            _EACH,
        )
    if BASELINE in evaluation.outcomes and focus != BASELINE:
        saved = evaluation.outcome(BASELINE).total_harm - total
        add(f"Where {focus} saved most against {BASELINE}", _largest(saved, saved > 0.0), _EACH)
        add(f"Where {focus} did more harm than {BASELINE}", _largest(-saved, saved < 0.0), _EACH)
    order = np.argsort(total, kind="stable")
    add(f"Typical of {focus}", [order[int(q * (len(order) - 1))] for q in (0.5, 0.6, 0.7, 0.8, 0.9)], _EACH)
    add("Drawn at random", np.random.default_rng(_RANDOM_SEED).permutation(len(total))[: 2 * most], most)
    return list(found.values())


def worst_rows(evaluation: Evaluation, focus: str) -> Ints:
    """The ten worlds of the largest regret in total harm, or of the largest total harm where no best is known."""
    outcome, regrets = evaluation.outcome(focus), assess(evaluation)
    value = outcome.total_harm if regrets is None else regrets.regret(outcome, "total")
    return _largest(value, value > 0.0)[:WORST]


def _largest(value: Floats, among: Bools) -> Ints:
    order = np.argsort(-value, kind="stable")
    return order[among[order]]


def play_chosen(
    evaluation: Evaluation,
    chosen: Sequence[Chosen],
    agents: Mapping[str, Driver],
    *,
    spellings: Mapping[str, str] | None = None,
    harm_count: HarmCount = "first",
    on_agent: Callable[[str], None] | None = None,
) -> list[Played]:
    """Let every agent drive these worlds once more, and keep the motion and a passport of each episode.

    Args:
        evaluation: whose worlds they are.
        chosen: at least one.
        agents: that were evaluated, by name; they are left as they are.
        spellings: how an agent is written on a command line, where that is not its name.
        harm_count: that agents minimised.
        on_agent: is told each agent that is done.

    """
    rows = np.array([each.row for each in chosen], np.int64)
    worlds, numbers = evaluation.worlds.take(rows), evaluation.index[rows]
    scenario = evaluation.scenario
    if evaluation.vehicles != scenario.learners:
        scenario = scenario.with_learners(evaluation.vehicles)
    played = [Played(int(n), each.kind, each.why, {}, {}) for n, each in zip(numbers, chosen, strict=True)]
    for name, agent in agents.items():
        spelling = (spellings or {}).get(name, name)
        drive_played(played, worlds, name, agent, scenario, spelling, seed=evaluation.seed, harm_count=harm_count)
        if on_agent is not None:
            on_agent(name)
    return played


def drive_played(
    played: Sequence[Played],
    worlds: Worlds,
    name: str,
    agent: Driver,
    scenario: Scenario,
    spelling: str,
    *,
    seed: int | None,
    harm_count: HarmCount = "first",
) -> None:
    """Let one agent drive the worlds of ``played`` and keep each motion and passport there, by the agent's name.

    Args:
        played: one for each world.
        worlds: at the alert, in the same order.
        name: of the agent on the page.
        agent: is left as it is.
        scenario: of the worlds, with the vehicles that are driven as its learners.
        spelling: how the agent is written on a command line.
        seed: of the list of worlds; None: they came from a file.
        harm_count: that the agent minimised.

    """
    drivers = team_of(agent, scenario.learners).drivers
    policies = {i: sha for i, driver in drivers.items() if (sha := policy_sha256(driver)) is not None}
    for one, motion in zip(played, follow_episodes(worlds, agent, scenario), strict=True):
        passport = issue_passport(
            motion, scenario, spelling, seed=seed, number=one.number, harm_count=harm_count, policies=policies
        )
        one.motions[name] = motion
        one.passports[name] = str(passport)
