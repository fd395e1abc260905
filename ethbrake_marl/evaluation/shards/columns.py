"""The numbers of an evaluation that are counted and summed: one tally for each agent."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ethbrake_marl.evaluation.exact import exact_products, moments
from ethbrake_marl.evaluation.harm_metrics import COLUMN
from ethbrake_marl.evaluation.outcome import Evaluation, Outcome
from ethbrake_marl.evaluation.regret import Regrets, assess
from ethbrake_marl.evaluation.shards.tally import AgentTally
from ethbrake_marl.evaluation.table import BASELINE, FAR_M
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.objectives import scored
from ethbrake_marl.physics import Floats

HARM_NAMES: dict[HarmCount, str] = {"first": "first_impact_harm", "total": "total_harm"}
REGRET_NAMES: dict[HarmCount, str] = {"first": "regret_first", "total": "regret_total"}


def objective_column(objective: str, harm_count: HarmCount, vehicle: int) -> str:
    """The name of an objective under one count, of a vehicle (from 0)."""
    return f"objective {objective} {harm_count} {vehicle + 1}"


def agent_tallies(evaluation: Evaluation, objectives: Sequence[str], *, limits: bool) -> dict[str, AgentTally]:
    """The tally of every agent; ``limits``: with what needs the best known harm of each world."""
    regrets = assess(evaluation) if limits else None
    reference = evaluation.outcomes.get(BASELINE)
    paired = {} if reference is None else _paired(reference, regrets)
    found = {}
    for agent, outcome in evaluation.outcomes.items():
        counts, columns, against = _counts(outcome), dict(_columns(outcome, objectives)), _paired(outcome, regrets)
        if regrets is not None:
            counts |= _limit_counts(outcome, regrets)
            columns |= _limit_columns(regrets)
        found[agent] = AgentTally(
            counts,
            {name: moments(column) for name, column in (columns | against).items()},
            {name: exact_products(against[name], baseline) for name, baseline in paired.items()},
        )
    return found


def _paired(outcome: Outcome, regrets: Regrets | None) -> dict[str, Floats]:
    """What is compared with the baseline, world by world."""
    found = {name: outcome.world_harm(harm_count) for harm_count, name in HARM_NAMES.items()}
    if regrets is not None:
        found |= {name: regrets.regret(outcome, harm_count) for harm_count, name in REGRET_NAMES.items()}
    return found


def _counts(outcome: Outcome) -> dict[str, int]:
    found = {"collisions": int(outcome.collided.sum()), "horizon_ends": int((~outcome.at_rest).sum())}
    if outcome.shoved_m is not None:
        found["shoved_far"] = int((outcome.shoved_m > FAR_M).sum())
    if outcome.chosen_policy is not None:
        found |= {"policy": int(outcome.chosen_policy.sum()), "hybrid": len(outcome.chosen_policy)}
    return found


def _columns(outcome: Outcome, objectives: Sequence[str]) -> Iterator[tuple[str, Floats]]:
    """Name and values [n] of every number that each world has, but those that are compared."""
    for harm_count, name in HARM_NAMES.items():
        yield from ((f"{name}_{i + 1}", column) for i, column in enumerate(outcome.vehicle_harm(harm_count).T))
        for objective in objectives:
            for values in scored(outcome.ledger, harm_count, [objective]).values():
                yield from ((objective_column(objective, harm_count, i), column) for i, column in enumerate(values.T))
    for name in ("predicted_harm", "shoved_m", "sampled_harm"):
        if getattr(outcome, name) is not None:
            yield name, getattr(outcome, name)
    yield from ((f"{COLUMN}{name}", column) for name, column in outcome.metrics.items())


def _limit_counts(outcome: Outcome, regrets: Regrets) -> dict[str, int]:
    proof, known = regrets.limits.proof, regrets.limits.known
    found = {
        "known": int(known.sum()),
        "below_best_known": int(regrets.below(outcome).sum()),
    }
    if proof.avoidable is not None:
        found["unavoidable"] = int((~proof.avoidable).sum())
        found["avoidable_collisions"] = int((outcome.collided & proof.avoidable).sum())
    if proof.impact is not None:
        found["impact_proven"] = int(proof.impact.sum())
    return found


def _limit_columns(regrets: Regrets) -> dict[str, Floats]:
    first, total, proven = regrets.first_impact_harm, regrets.total_harm, regrets.limits.proof.harm
    found = {"best_known_first": first, "best_known_total": total}
    if proven is not None:
        found |= {"proven_harm": proven, "gap_first": first - proven, "gap_total": total - proven}
    return {name: np.asarray(column) for name, column in found.items()}
