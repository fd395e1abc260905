"""A *reading*: one interpretation of the paper's text, with a value for each quantity that the text leaves open."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

from ethbrake_marl.evaluation.evaluate import SEED
from ethbrake_marl.worlds.catalogue import load_scenario
from ethbrake_marl.worlds.scenario import Scenario

RANDOM = "paper-random"

Star = Literal["low end", "middle", "high end"]
ReportedHarm = Literal["realised", "predicted", "predicted harm, realised collisions"]

FIELD_TEXTS = {  # field of a reading -> its default in words, and another value
    "base": ("the random test", "{}"),
    "acts_s": ("Vehicle 2 acts at its latency", "Vehicle 2 acts at {} s"),
    "rear_s": ("Vehicle 3 brakes at its latency", "Vehicle 3 brakes at {} s"),
    "step_s": ("exact impacts", "the paper's map at {} s"),
    "restitution": ("e of the scenario", "e = {}"),
    "others": ("other keys of the scenario", "{}"),
    "seed": ("the usual seed", "seed {}"),
    "counted": ("first-impact harm counts", "{} harm counts"),
    "after_impact": ("Non-E brakes on after an impact", "Non-E {} after an impact"),
    "plans_as_stated": ("E-V2X-BM plans for what is driven", "E-V2X-BM plans for the stated latencies"),
    "star": ("a* in the middle", "a* at the {}"),
    "baseline": ("E-V2X-BM: realised", "E-V2X-BM: {}"),
    "hybrid": ("hybrid: realised", "hybrid: {}"),
}


def field_text(field: str, value: Any) -> str:
    default, template = FIELD_TEXTS[field]
    if value == Reading._field_defaults[field]:
        return default
    return template.format(", ".join(f"{key} = {setting}" for key, setting in value) if field == "others" else value)


class Reading(NamedTuple):
    """Defaults are ours."""

    base: str = RANDOM  # name of the scenario, of three vehicles
    acts_s: float | None = None  # when Vehicle 2 acts (s since the alert); None: the latency of the scenario
    rear_s: float | None = None  # when Vehicle 3 brakes (s since the alert); None: the latency of the scenario
    step_s: float | None = None  # time step (s) of the paper's map, with impacts at samples; None: exact impacts
    restitution: float | None = None  # None: the scenario's
    others: tuple[tuple[str, Any], ...] = ()  # other keys of the scenario, and their values
    seed: int = SEED  # of the list of worlds
    counted: Literal["first", "total"] = "first"  # harm of each pair's first impact, or of every impact
    after_impact: Literal["brakes on", "coasts", "ends"] = "brakes on"  # what vehicles, or the episode, do under Non-E
    plans_as_stated: bool = False  # E-V2X-BM plans for the scenario's latencies, not for ``acts_s`` and ``rear_s``
    star: Star = "middle"  # which of the decelerations with the least harm
    baseline: ReportedHarm = "realised"  # what to report of E-V2X-BM: simulation or prediction
    # what to report of the hybrid (Algorithm 1, with the pairwise H*): simulation, or the prediction min(H_RL, H*)
    hybrid: ReportedHarm | Literal["realised, by the coupled H*", "policy alone"] = "realised"

    @property
    def name(self) -> str:
        changed = (field for field, value in self._asdict().items() if value != self._field_defaults[field])
        return "; ".join(field_text(field, getattr(self, field)) for field in changed) or "as stated"

    def only(self, *fields: str) -> Reading:
        """All other fields have their defaults."""
        return Reading(**{field: getattr(self, field) for field in fields})

    def scenario(self, name: str) -> Scenario:
        scenario = load_scenario(name)
        keys = dict(self.others)
        latency_s = [*scenario.model_dump()["latency_s"]]
        if self.acts_s is not None:
            latency_s[1] = self.acts_s
        if self.rear_s is not None:
            latency_s[2] = self.rear_s
        keys["latency_s"] = latency_s
        if self.step_s is not None:
            keys |= {"physics": "paper-map", "time_step_s": self.step_s}
        if self.restitution is not None:
            keys["restitution"] = self.restitution
        return scenario.replace(**keys)


STATED = Reading()
# Of 122,472 readings the nearest to all numbers of ``Table:Random`` together, by a search in version 1.0.0.
NEAREST = STATED._replace(
    acts_s=0.2,
    step_s=0.2,
    plans_as_stated=True,
    star="low end",
    baseline="predicted harm, realised collisions",
    hybrid="policy alone",
)
