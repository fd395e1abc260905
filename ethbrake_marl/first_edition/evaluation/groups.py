"""Results tables by group of worlds: one table for each scenario of a mixture, or for each vehicle type."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.first_edition.evaluation.evaluation import Evaluation
from ethbrake_marl.first_edition.evaluation.measure_sets import BASELINE
from ethbrake_marl.first_edition.evaluation.summary import SummaryTable, summarise

NO_TYPE = "no type"  # group of worlds in which the vehicle has no type


def summarise_by(evaluation: Evaluation, by: str, *, baseline: str = BASELINE) -> dict[str, SummaryTable]:
    """Return one results table (``summarise``) for each group of worlds, by the group's name, in alphabetical order.

    Args:
        evaluation: outcomes of the agents in worlds of a mixture of scenarios, of a scenario with vehicle types, or of
            a table with recordings.
        by: ``"scenario"`` (one group for each scenario of the mixture), the type of a vehicle, such as
            ``"vehicle_2_type"``, or ``"recording"``.
        baseline: name of the agent with which the other agents are compared.

    Raises ``InvalidInput`` if the worlds have no groups, and ``UnknownName`` if ``by`` is unknown.

    >>> import ethbrake_marl.first_edition as eb
    >>> delays = eb.load_scenario("mixture-delays")
    >>> agents = {"full_brake": eb.make_agent("full_brake")}
    >>> tables = eb.summarise_by(eb.evaluate(delays.sample(30, seed=7), agents, scenario=delays), "scenario")
    >>> {name: rows[0].episodes for name, rows in tables.items()}
    {'paper-delay-high': 11, 'paper-delay-low': 8, 'paper-delay-middle': 11}

    """
    if not evaluation.kinds:
        raise InvalidInput(
            f"by = {by!r}: these worlds have no groups; worlds of a mixture can be grouped by 'scenario', worlds of a"
            " scenario with vehicle_types by 'vehicle_1_type' and so on, worlds of a table with recordings by"
            " 'recording'"
        )
    if by not in evaluation.kinds:
        raise unknown_name("group", by, evaluation.kinds)
    column = evaluation.kinds[by]
    return {
        name or NO_TYPE: summarise(evaluation.take(column == name), baseline=baseline)
        for name in np.unique(column).tolist()
    }
