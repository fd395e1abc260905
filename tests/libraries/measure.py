"""Runs one library's file inside the library's own environment: ``python -m tests.libraries.measure NAME FILE``.

For each way: train, measure first-impact harm on a fixed list of worlds beside full braking, and where the way brings
the library's own rollout, compare it with ours world by world. Writes rows to FILE as JSON.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import traceback
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

import ethbrake_marl as eb
from tests.libraries.library import Library, Way, load

SCENARIO, EPISODES, SEED = "paper-random", 500, 7
OWN_EPISODES, CLOSE = 50, 1e-5  # of the library's own rollout; m2/s2


def measure(library: Library, way: Way) -> dict[str, Any]:
    """One row: what was run, how long it took, what it came to."""
    row: dict[str, Any] = {"library": library.title, "version": version(library.package), "way": way.title}
    begun = cpu_seconds()
    try:
        print(f"== {library.title}, {way.title}: {way.ran}", flush=True)
        if way.command:
            path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
            subprocess.run(["bash", "-ec", way.code], check=True, env={**os.environ, "PATH": path})
        made = way.function()
        row |= {"ran": way.ran, "seconds": round(cpu_seconds() - begun, 1)}
        row |= judge(way, made)
    except Exception as error:
        traceback.print_exc()
        said = (str(error).strip().splitlines() or [""])[0]
        row |= {"ran": way.ran, "seconds": round(cpu_seconds() - begun, 1)}
        row["verdict"] = f"FAILED: {type(error).__name__}: {said}"
    return row


def cpu_seconds() -> float:
    """Of this process and of all that it started and that has ended."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)


def judge(way: Way, made: Any) -> dict[str, Any]:
    """Harm beside full braking, distance to the library's own rollout, and the verdict."""
    policy, own = made if isinstance(made, tuple) else (made, None)
    if policy is None:
        return {"verdict": "runs"}
    agent = policy if hasattr(policy, "begin") or isinstance(policy, eb.Team) else eb.policy_agent(policy, clip=True)
    row = measure_harm(agent)
    if own is not None:
        row["difference"] = compare_rollouts(agent, own)
        if not row["difference"] <= CLOSE:
            return row | {"verdict": f"FAILED: {row['difference']:.2g} m2/s2 from the library's own rollout"}
    if way.learns and not row["harm"] < row["full_braking"]:
        return row | {"verdict": "FAILED: does not beat full braking"}
    return row | {"verdict": "beats full braking" if way.learns else "runs"}


def measure_harm(agent: Any) -> dict[str, Any]:
    """Mean first-impact harm and share of worlds with a collision, beside full braking's."""
    scenario = eb.load_scenario(SCENARIO)
    agents = {"full_brake": eb.make_agent("full_brake"), "theirs": agent}
    result = eb.evaluate(scenario.sample(EPISODES, SEED), agents, scenario=scenario)
    theirs, braking = result.outcome("theirs"), result.outcome("full_brake")
    return {
        "harm": round(float(theirs.first_impact_harm.mean()), 2),
        "full_braking": round(float(braking.first_impact_harm.mean()), 2),
        "total_harm": round(float(theirs.total_harm.mean()), 2),
        "collisions": round(float(theirs.collided.mean()), 4),
    }


def compare_rollouts(agent: Any, own: Callable[[int], Any]) -> float:
    """Largest difference of first-impact harm, m2/s2, of any world of the stream that both drive in."""
    scenario = eb.load_scenario(SCENARIO)
    sample = scenario.sample(OWN_EPISODES, SEED, channel="training")  # the worlds of ``env.reset(seed=SEED)``
    ours = eb.evaluate(sample, {"theirs": agent}, scenario=scenario).outcome("theirs").first_impact_harm
    theirs = np.asarray(own(OWN_EPISODES), np.float64)
    assert theirs.shape == ours.shape, (theirs.shape, ours.shape)
    return float(np.abs(theirs - ours).max())


def main() -> None:
    """Measure every way of the library; what is measured is in the file at once."""
    name, file = sys.argv[1], Path(sys.argv[2])
    library = load(name)
    measure_harm(eb.make_agent("coast"))  # compiles the physics: no way's time
    rows: list[dict[str, Any]] = []
    for way in library.ways:
        rows.append(measure(library, way))
        file.write_text(json.dumps(rows), "utf-8")
        print(f"   {rows[-1]['verdict']}", flush=True)


if __name__ == "__main__":
    main()
