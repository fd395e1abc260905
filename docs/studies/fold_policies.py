"""Let every shipped policy of one learner drive the worlds of the shipped tables: docs/best-harm.md.

    PYTHONPATH=. .venv/bin/python -W ignore docs/studies/fold_policies.py [SCENARIO ...] [+refined+episode]

Where one does less harm than a table knows, its episode is kept; the table's header says in how many worlds. What
begins with ``+`` drives as well, behind every policy.
"""

from __future__ import annotations

import sys
import time

from ethbrake_marl.agents import make_agent
from ethbrake_marl.defaults import HARM_COUNTS
from ethbrake_marl.limits.limits import LOWERED, TABLES, BestHarmTable
from ethbrake_marl.policies import load_shipped, shipped_policies
from ethbrake_marl.scenario import load_scenario


def folded(name: str, shields: list[str]) -> BestHarmTable:
    """The table of a scenario, with what the policies do."""
    table, scenario = BestHarmTable.load(TABLES / f"{name}.npz"), load_scenario(name)
    worlds = scenario.sample(table.header["episodes"], table.header["list_seed"]).worlds
    names = [each for each in shipped_policies() if len(load_shipped(each).manifest.learners) == 1]
    for spec in [f"policy@shipped/{each}{shield}" for shield in ("", *shields) for each in names]:
        counts = HARM_COUNTS if "+" in spec else HARM_COUNTS[:1]  # a policy alone minimises nothing
        agents = {count: make_agent(spec, scenario=scenario, harm_count=count) for count in counts}
        table = table.folded(scenario, worlds, spec, agents)
        print(f"{name}, {spec}: lower in", table.header[LOWERED][spec], flush=True)
    return table


if __name__ == "__main__":
    shields = [word for word in sys.argv[1:] if word.startswith("+")]
    asked = [word for word in sys.argv[1:] if word not in shields]
    for name in asked or sorted(path.stem for path in TABLES.glob("*.npz")):
        begun = time.process_time()
        folded(name, shields).save(TABLES / f"{name}.npz")
        print(f"{name}: {time.process_time() - begun:.0f} s of a processor", flush=True)
