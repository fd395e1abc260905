"""INTERIM."""

from __future__ import annotations

from functools import cache

from ethbrake_marl.extensions.proofs.lower_bound import lower_bound
from ethbrake_marl.first_edition.scenario.schema import Scenario as Old


@cache
def _bound(content: str, n: int):
    import json

    old = Old(**json.loads(content))
    return lower_bound(old.sample(n, 7).worlds, 1, horizon_s=old.horizon_s, time_step_s=old.time_step_s).harm


def least_harm(scenario, result):
    import json

    return _bound(json.dumps(scenario.declared(), default=float), result.n)
