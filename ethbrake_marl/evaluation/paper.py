"""The three tests that stand beside each other: the paper's own, and two that close its ways out.

All three have the same gaps and speeds in world k. ``docs/decisions/0011`` says why the first is the main one, and why
none is shown alone.
"""

from __future__ import annotations

from dataclasses import dataclass

from ethbrake_marl.evaluation.outcome import Evaluation
from ethbrake_marl.scenario import Scenario, load_scenario

MAIN_TEST = "paper-random"
TESTS = {
    MAIN_TEST: "Main test, the paper's rules: Vehicle 2 may drive, nothing stands ahead of Vehicle 1, and pushing it on"
    " costs nothing in either count.",
    "paper-random-brake-only": "Brake-only test: the same worlds, but Vehicle 2 may only brake and coast; it can"
    " neither drive on nor push with its motor.",
    "paper-random-obstacle": "Obstacle test: the same worlds with the obstacle that Vehicle 1 brakes for, 1.7 m beyond"
    " where it stops by itself. Vehicle 1's impact with it is harm.",
}

_TEXTS = {"title", "description", "source"}


def is_as_shipped(scenario: Scenario) -> bool:
    """Whether every value of the scenario is that of the shipped one of its name, whatever its texts say."""
    return scenario.model_dump(exclude=_TEXTS) == load_scenario(scenario.name).model_dump(exclude=_TEXTS)


def other_tests(scenario: Scenario) -> tuple[Scenario, ...]:
    """The two tests that belong beside results on ``scenario``; none where it is not one of the three as shipped."""
    if scenario.name not in TESTS or not is_as_shipped(scenario):
        return ()
    return tuple(load_scenario(name) for name in TESTS if name != scenario.name)


@dataclass(frozen=True, slots=True)
class PaperRow:
    """One row of a table of the paper, as printed; the paper reports a single harm and no intervals."""

    table: str
    agent: str  # the paper's name
    episodes: int
    collisions: int
    collision_rate: float
    average_harm: float  # m2/s2
    harm_decrease: float | None  # relative to Non-E, as printed


RANDOM_TEST = "random test"
HYBRID_TEST = "hybrid test"

PAPER_ROWS = (
    PaperRow(RANDOM_TEST, "Non-E", 10_000, 9391, 0.9391, 33.5878, 0.0),
    PaperRow(RANDOM_TEST, "E-V2X-BM", 10_000, 8520, 0.852, 9.8772, 0.7059),
    PaperRow(RANDOM_TEST, "Hybrid SAC", 10_000, 5896, 0.5896, 5.7001, 0.8302),
    PaperRow(RANDOM_TEST, "Hybrid PPO", 10_000, 5974, 0.5974, 5.6202, 0.8326),
    PaperRow(HYBRID_TEST, "E-V2X-BM", 5_000, 4263, 0.8526, 9.8514, None),
    PaperRow(HYBRID_TEST, "Standalone DRL", 5_000, 3737, 0.7474, 12.229, None),
    PaperRow(HYBRID_TEST, "Hybrid", 5_000, 2995, 0.599, 7.3641, None),
)

PAPER_PARAMETERS = {
    RANDOM_TEST: (
        "10,000 worlds; d = 5–10 m; v = 18–22 m/s; braking and driving capacity (6, 7, 6) m/s²; τ2 = 0.5 s, τ3 = 0.8 s;"
        " m = (4.5, 5.5, 5.9) t; not stated: e, time step, horizon, seed"
    ),
    HYBRID_TEST: (
        "5,000 worlds; d = 5–10 m; capacities, latencies and masses as in the random test; not stated: speeds for this"
        " test, e, time step, horizon, seed"
    ),
}

PAPER_NOTE = (
    "The paper's rows cannot come from the parameters that it states: in 62.3 % of the worlds of its random test no"
    " command of Vehicle 2 whatsoever avoids an impact (in 65.1 % none avoids contact), yet its hybrids collide in"
    " 59 %; and in its 5,000-world test the hybrid avoids 2,005 collisions, although its two parts together avoid at"
    " most 2,000. If Vehicle 2 could act at about 0.2 s instead of the stated 0.5 s, full braking would come close to"
    " the paper's row (the scenario paper-random-early). The paper's E-V2X-BM harm is close to what the pairwise closed"
    " form predicts at the alert, not to what those commands cause; for the 5,000-world table that holds only at the"
    " speeds of the random test, since at those of the paper's figure of distances it predicts 3.07. Nothing here is"
    " tuned to these rows. docs/paper.md goes through the paper's equations, figures and tables one by one."
)

_SHOWN_WITH = ("paper-random", "paper-random-early")  # the second is the variant of which the note speaks


def is_papers_test(evaluation: Evaluation) -> bool:
    """Whether the results may stand beside the paper's rows: a list drawn from one of these shipped scenarios.

    Every value of the scenario counts, not its name; Vehicle 2 is driven, and the worlds are no table of the user's.
    """
    return is_papers_list(evaluation.scenario, evaluation.seed, evaluation.vehicles)


def is_papers_list(scenario: Scenario, seed: int | None, vehicles: tuple[int, ...]) -> bool:
    """``is_papers_test`` for these driven ``vehicles`` (from 0) in the list of this seed; None: the user's table."""
    if scenario.name not in _SHOWN_WITH or seed is None or vehicles != (1,):
        return False
    return is_as_shipped(scenario)
