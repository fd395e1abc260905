"""Every shipped policy of one learner in every scenario of one learner: the table `every-test` of docs/results.

    PYTHONPATH=. .venv/bin/python -W ignore docs/studies/every_test.py --cache FILE.npz RUN ...

The worlds are those of a list that no training, table or choice of a setting saw. FILE.npz keeps, scenario by
scenario, what was searched and driven; it is looked up by worlds and weights, so a policy that is new drives alone.
Each RUN is another seed of ``universal``, with a column of its own.
"""

from __future__ import annotations

import argparse
import datetime
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation import evaluate, worlds_sha256
from ethbrake_marl.evaluation.inputs import make_lineup
from ethbrake_marl.harm import HARM_COUNTS
from ethbrake_marl.limits.limits import best_harm
from ethbrake_marl.physics import Floats
from ethbrake_marl.policies import Policy, load_policy, load_shipped, shipped_policies
from ethbrake_marl.scenario import Sample, Scenario, list_scenarios, load_scenario
from ethbrake_marl.studies.machine import this_machine
from tests.docs.site import load

WORLDS, SEED, BUDGET = 600, 20_261_126, 10_000
WORSE = 1.0  # m2/s2: so much more harm than full braking in the same world
ID, NONE = "every-test", "–"
NOTE = (
    f"{WORLDS} worlds of each scenario, seed {SEED}. Best known: the least, in each world, of a search with"
    f" {BUDGET:,} candidates and of all policies here. In a cell: times the best known harm; share of what could be"
    f" saved against full braking that is saved; share of worlds with over {WORSE:g} m²/s² more harm than full braking."
    f" Bold: trained there. {NONE}: it cannot drive there, or there is next to no harm to save. Where parameters are"
    " wide, a few worlds rule the mean."
)


def scenarios() -> Iterator[Scenario]:
    """Every shipped one of one learner."""
    every = (load_scenario(entry.name) for entry in list_scenarios())
    return (scenario for scenario in every if len(scenario.learners) == 1)


def policies() -> dict[str, Policy]:
    """Every shipped one of one learner, as an agent."""
    every = {f"policy@shipped/{name}": load_shipped(name) for name in shipped_policies()}
    return {spec: policy for spec, policy in every.items() if len(policy.manifest.learners) == 1}


class Cache:
    """Harms [2, n] for both counts by worlds and what did them; a file keeps them."""

    def __init__(self, path: Path) -> None:
        self.path, self.kept = path, dict(np.load(path)) if path.exists() else {}
        self.known = len(self.kept)

    def get(self, key: str, find: Callable[[], Floats]) -> Floats:
        """What is kept, or else what is found."""
        if key not in self.kept:
            self.kept[key] = find()
        return self.kept[key]

    def save(self) -> None:
        """Write the file, if there is news."""
        if len(self.kept) > self.known:
            np.savez(self.path, **self.kept)
            self.known = len(self.kept)


def searched(scenario: Scenario, sample: Sample) -> Floats:
    """The least harm that the search finds."""
    best = best_harm(scenario, sample.worlds, budget=BUDGET, threads=1).best
    return np.stack([best[count].harm for count in HARM_COUNTS])


def driven(scenario: Scenario, sample: Sample, spec: str) -> Floats:
    """The harm of an agent; NaN where it cannot drive there."""
    try:
        outcome = evaluate(sample, make_lineup([spec], scenario), scenario=scenario, aftermath=False).outcome(spec)
    except InvalidInput:
        return np.full((len(HARM_COUNTS), WORLDS), np.nan)
    return np.stack([outcome.ledger.world_harm(count) for count in HARM_COUNTS])


def cell(harm: Floats, full: Floats, best: Floats) -> str:
    """What a policy's harm [n] comes to."""
    least, saveable = best.mean(), (full - best).mean()
    ratio = f"{harm.mean() / least:.3f}" if least > 1e-3 else NONE
    share = f"{100.0 * (full - harm).mean() / saveable:.1f} %" if saveable > 1e-3 else NONE
    return f"{ratio}; {share}; {100.0 * (harm > full + WORSE).mean():.1f} %"


def rows(cache: Cache, found: dict[str, Policy]) -> Iterator[list[str]]:
    """A line for each scenario and count, with a cell for each agent that is found."""
    for scenario in scenarios():
        sample = scenario.sample(WORLDS, SEED)
        worlds = worlds_sha256(sample.worlds, sample.index)
        searches = cache.get(worlds, partial(searched, scenario, sample))
        fully = cache.get(f"{worlds}.full_brake", partial(driven, scenario, sample, "full_brake"))
        harm = {}
        for spec, policy in found.items():
            drive = partial(driven, scenario, sample, spec)
            harm[spec] = cache.get(f"{worlds}.{policy.manifest.weights_sha256}", drive)
        cache.save()
        least = np.fmin.reduce([searches, fully, *harm.values()])
        for k, count in enumerate(HARM_COUNTS):
            full, best, told = fully[k], least[k], []
            for spec, policy in found.items():
                text = NONE if np.isnan(harm[spec]).any() else cell(harm[spec][k], full, best)
                told.append(f"**{text}**" if policy.manifest.scenario["name"] == scenario.name else text)
            yield [f"`{scenario.name}`", count, f"{full.mean():.3f}", f"{best.mean():.3f}", *told]


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--cache", type=Path, required=True)
    parser.add_argument("runs", nargs="*", type=Path)
    asked = parser.parse_args()
    results, seeds = load("results"), {f"policy@{run}": load_policy(run) for run in asked.runs}
    names = [spec.partition("/")[2] for spec in policies()]
    names += [f"universal, seed {policy.manifest.seeds['training']}" for policy in seeds.values()]
    table = results.Table(
        id=ID,
        title="Every policy in every scenario",
        columns=["scenario", "count", "full braking", "best known", *(f"`{name}`" for name in names)],
        rows=list(rows(Cache(asked.cache), policies() | seeds)),
        commands=["python -W ignore docs/studies/every_test.py --cache FILE.npz RUN RUN"],
        machine=str(this_machine()),
        date=datetime.date.today().isoformat(),
        compared="a training",
        note=NOTE,
    )
    tables = [each for each in results.read_tables("learning") if each.id != ID]
    (results.RESULTS / "learning.json").write_text(results.text_of([*tables, table]), "utf-8")
