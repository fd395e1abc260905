"""Trying to break the step shield: ``make test-shield`` (``python -m tests.shield.programme``).

Six gates, one line each, exit status 1 if one fails:

bound   random worlds against every adversary of ``tests.shield.lines``, both counts, N = 3 and 5, e from 0 to 0.3
joint   teams of hostile learners at cooperation levels 3 and 4, N = 3 and 5 (``tests.shield.lines``)
interfaces   worlds through every wrapped interface (``tests.shield.interface_attack``)
interference  refused calls, exceptions and interrupts at random lines on every interface, and wrappers in between
search  restarts of a search against the shield, and against twelve leaks of it (``tests.shield.lines``)
believed  worlds that are corners of what was not received (``tests.shield.lines``)
inside  worlds drawn from the inside of intervals, behind robust mode (``tests.shield.inside``)
speed   decisions per second in a batch, and the latency of one decision

No realised harm may be above the bound at the alert (tolerance 1e-9; of teams none, and harm must be the last bound, as
the same double). Bound, joint and interfaces run in chunks; each finished chunk is a file in ``--results``, so what was
stopped goes on, and several processes (``--part 1/2``, ``--part 2/2``) share the work. ``--results`` of other code, or
of another seed, are refused.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from ethbrake_marl.agents.registry import episode_engine
from ethbrake_marl.evaluation.inputs import make_agents
from ethbrake_marl.files.store import write_file
from ethbrake_marl.scenario import load_scenario
from ethbrake_marl.shield import ShieldedDriver
from ethbrake_marl.shield.step_shield import StepShield, certify
from ethbrake_marl.shield.uncertainty import parse_uncertainty
from tests.shield.inside import inside_gate
from tests.shield.interface_attack import INTERFACES
from tests.shield.interference import PLAYS, WRAPPERS, disturbed, wrapped
from tests.shield.lines import (
    ADVERSARIES,
    INSIDE,
    LEAKS,
    LISTS,
    TEAM_ADVERSARIES,
    attack,
    gate,
    line,
    scenario_of,
    search,
)

ROOT = Path(__file__).resolve().parents[2]
TOLERANCE = 1e-9  # m2/s2
CHUNK = 2_000  # worlds
CHUNKS = {3: 36, 5: 12}  # of each cell, for a million worlds: lines of five take five times as long
SLOW_CHUNKS = {"most_harmful": 5}  # of a search in every step
JOINT_CHUNKS = {
    (3, 3): 16,
    (4, 3): 4,
    (3, 5): 4,
    (4, 5): 4,
}  # of each cell, of ``JOINT_CHUNK`` worlds: by what they cost
JOINT_CHUNK = {(3, 3): 500, (4, 3): 500, (3, 5): 400, (4, 5): 300}
JOINT_P50_S = 200e-6
RATE, P50_S, P99_S = 100_000, 100e-6, 300e-6


def bound_chunks(worlds: int) -> Iterator[tuple[str, dict[str, Any]]]:
    """Name and arguments of each chunk of the first gate; no two share a world. 1,000,000 worlds are 500 chunks."""
    first = 0
    cells = [(N, count, name) for N in (3, 5) for count in ("first", "total") for name in ADVERSARIES]
    for N, count, name in cells:
        chunks = max(1, round(SLOW_CHUNKS.get(name, CHUNKS[N]) * worlds / 1_000_000))
        for k in range(chunks):
            given = {"N": N, "harm_count": count, "who": name, "first": first, "worlds": min(CHUNK, worlds)}
            yield f"bound-{N}-{count}-{name}-{k:03d}", given
            first += CHUNK


def attack_chunk(seed: int, *, N: int, harm_count: Any, who: str, first: int, worlds: int) -> dict[str, Any]:
    """One adversary in some worlds."""
    scenario = line(N)
    found = attack(
        scenario, scenario.sample(worlds, seed, first=first).worlds, ADVERSARIES[who], harm_count=harm_count, seed=seed
    )
    return _outcome(found.realised, found.bound, found.decisions) | {"accepted": int(found.accepted.sum())}


def joint_chunks(worlds: int) -> Iterator[tuple[str, dict[str, Any]]]:
    """Likewise for teams; 300,000 worlds are 624 chunks."""
    first = 0
    for level, N in JOINT_CHUNKS:
        for count, hostile, name in product(("first", "total"), ("all", "one"), TEAM_ADVERSARIES):
            chunks = max(1, round(JOINT_CHUNKS[level, N] * worlds / 300_000))
            for k in range(chunks):
                size = min(JOINT_CHUNK[level, N], worlds)
                given = {"level": level, "N": N, "harm_count": count, "hostile": hostile, "who": name}
                yield (
                    f"joint-{N}-{level}-{count}-{hostile}-{name}-{k:03d}",
                    given | {"cap": (None, "baseline")[k % 2], "first": first, "worlds": size},
                )
                first += size


def joint_chunk(
    seed: int, *, level: int, N: int, harm_count: Any, hostile: str, who: str, cap: Any, first: int, worlds: int
) -> dict[str, Any]:
    """One kind of hostile team in some worlds."""
    scenario = scenario_of(level, N)
    found = attack(
        scenario, scenario.sample(worlds, seed, first=first).worlds, TEAM_ADVERSARIES[who], hostile=hostile,
        harm_count=harm_count, cap=cap, seed=first,
    )  # fmt: skip
    told = _outcome(found.realised, found.bound, found.decisions) | {"accepted": int(found.accepted.sum())}
    other = int((found.realised != found.last_bound).sum()) + found.rises + found.over_cap
    return told | {"above": int((found.realised > found.bound).sum()) + other}


def interface_chunks(worlds: int) -> Iterator[tuple[str, dict[str, Any]]]:
    """Likewise for the interfaces."""
    for who in INTERFACES:
        for k, first in enumerate(range(0, worlds, CHUNK)):
            yield f"interface-{who}-{k:03d}", {"who": who, "first": first, "worlds": min(CHUNK, worlds - first)}


def interface_chunk(seed: int, *, who: str, first: int, worlds: int) -> dict[str, Any]:
    """One interface."""
    realised, bound, decisions = INTERFACES[who](worlds, seed * 1_000_000 + first)
    return _outcome(np.array(realised), np.array(bound), decisions)


def _outcome(realised: np.ndarray, bound: np.ndarray, decisions: int) -> dict[str, Any]:
    excess = realised - bound
    return {
        "worlds": len(realised), "decisions": decisions, "above": int((excess > TOLERANCE).sum()),
        "excess": float(excess.max()), "exact": int((realised == bound).sum()),
    }  # fmt: skip


def run_chunks(chunks: list[tuple[str, dict[str, Any]]], run: Any, given: argparse.Namespace, code: str) -> bool:
    """Run what is missing of this part's chunks; print a table of all that is there."""
    part, parts = (int(word) for word in given.part.split("/"))
    given.results.mkdir(parents=True, exist_ok=True)
    in_turn = sorted(
        chunks, key=lambda chunk: (chunk[0].split("-")[1], chunk[0][-3:])
    )  # short lines, then cells in turn
    for k, (name, arguments) in enumerate(in_turn):
        file = given.results / f"{name}.json"
        if k % parts == part - 1 and not file.exists():
            begun = time.process_time()
            outcome = run(given.seed, **arguments)
            kept = {"code": code, "seed": given.seed} | arguments | outcome | {"cpu_s": time.process_time() - begun}
            write_file(file, json.dumps(kept).encode() + b"\n")
    rows = [json.loads((given.results / f"{name}.json").read_text()) for name, _ in chunks if _there(given, name)]
    if any((row["code"], row["seed"]) != (code, given.seed) for row in rows):
        print(f"{given.results}: results of other code or another seed; give another folder")
        return False
    return _tell(rows, len(chunks))


def _there(given: argparse.Namespace, name: str) -> bool:
    return (given.results / f"{name}.json").exists()


def _tell(rows: list[dict[str, Any]], wanted: int) -> bool:
    groups: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for row in rows:
        keys = ("N", "level", "harm_count", "hostile", "who")
        groups[" ".join(str(row[key]) for key in keys if key in row)].append(row)
    for name, members in groups.items():
        total = {key: sum(m[key] for m in members) for key in ("worlds", "decisions", "above", "cpu_s")}
        print(
            f"  {name:22s} {total['worlds']:9,} worlds {total['decisions']:11,} decisions"
            f"{_accepted(members)}  above: {total['above']}  largest excess {max(m['excess'] for m in members):.1e}"
            f"  {total['cpu_s']:6.0f} s"
        )
    worlds, decisions, above = (sum(row[key] for row in rows) for key in ("worlds", "decisions", "above"))
    left = f"; {wanted - len(rows)} of {wanted} chunks are missing" if len(rows) < wanted else ""
    print(f"  {worlds:,} worlds, {decisions:,} decisions, {above} above the bound{left}", flush=True)
    return above == 0 and not left


def _accepted(rows: list[dict[str, Any]]) -> str:
    """How many deviations from the plan were let through, where that was counted."""
    return f" {sum(row['accepted'] for row in rows):11,} deviations accepted" if "accepted" in rows[0] else ""


def search_gate(restarts: int, seed: int) -> bool:
    """The search against the shield, and against each leak."""
    good = True
    for count in ("first", "total"):
        whole = search(restarts, seed, harm_count=count)
        good = good and whole.above == 0
        print(
            f"  the shield as it is, {count}: {whole.restarts:,} restarts, {whole.above} above the bound, largest"
            f" excess {whole.excess:.1e}; the same proposals without it: {whole.loose:.0%} above",
            flush=True,
        )
    for name, leak in LEAKS.items():
        found = search(restarts, seed, leak, until_found=True)
        good = good and found.first is not None
        told = "NOT FOUND" if found.first is None else f"found in restart {found.first}"
        print(f"  {name:52s} {told}, largest excess {found.excess:.2g} m2/s2", flush=True)
    return good


def interference_gate(episodes: int, seed: int) -> bool:
    """Whatever fails, whatever stands in between: no episode above its bound, and the shield where the engine is."""
    good = True
    for name in PLAYS:
        found = disturbed(name, episodes, seed)
        good = good and (found.above, found.broken) == (0, 0) and found.refused > 0 and found.interrupted > 0
        print(
            f"  {name:20s} {found.episodes:7,} episodes {found.refused:8,} refused {found.interrupted:7,} interrupted"
            f"  above the bound: {found.above}, changed by what failed: {found.broken}",
            flush=True,
        )
    for wrapper in WRAPPERS:
        tallies = [wrapped(name, wrapper, episodes, seed) for name in PLAYS if "evaluation" not in name]
        total = [sum(column) for column in zip(*tallies, strict=True)]
        good = good and total[1] == total[4] == 0 and all(tally.episodes > 0 for tally in tallies)
        print(
            f"  inside: {wrapper:15s} {total[0]:4,} episodes {total[2]:8,} steps refused"
            f"  above the bound: {total[1]}, changed by what failed: {total[4]}",
            flush=True,
        )
    return good


def speed(decisions: int) -> bool:
    """Batched decisions per second and the latency of one, N = 3."""
    scenario = load_scenario("paper-random")
    rate, _ = batch_rate(None, 4096)
    rng, took = np.random.default_rng(0), []
    while len(took) < decisions:
        shield = StepShield(scenario, 1)
        shield.begin(scenario.sample(1, 3, first=len(took)).worlds, np.arange(1))
        while not shield.running.finished.all():
            proposed = rng.uniform(-1.0, 1.0, 1)
            begun = time.perf_counter()
            decision = certify(shield.running, proposed, shield.backup, shield.bound)
            took.append(time.perf_counter() - begun)
            shield.running, shield.backup = decision.after, decision.backup
    p50, p99 = np.quantile(took, [0.5, 0.99])
    print(f"  {rate:,.0f} decisions/s batched; one decision p50 {p50 * 1e6:.0f} us, p99 {p99 * 1e6:.0f} us")
    for intervals in ("gaps_m=0.5", "braking_capacity_mps2=10%,gaps_m=0.5"):
        robust, members = batch_rate(intervals, 1000)
        print(f"  robust mode, {members} members ({intervals}): {robust:,.0f} decisions/s batched")
    for later in (False, True):
        mid, slow = np.quantile(_agent_times(decisions, later), [0.5, 0.99]) * 1e6
        told = f"ppo@shipped behind it, {'with' if later else 'without'} later rollouts, inference included"
        print(f"  {told}: p50 {mid:.0f} us, p99 {slow:.0f} us of processor time")
    return bool(rate >= RATE and p50 <= P50_S and p99 <= P99_S)


def batch_rate(intervals: str | None, n: int) -> tuple[float, int]:
    """Decisions per second of a batch under random proposals, and the members of each world."""
    scenario = load_scenario("paper-random")
    shield = StepShield(scenario, 1, uncertainty=None if intervals is None else parse_uncertainty(intervals))
    shield.begin(scenario.sample(n, 3).worlds, np.arange(n))
    rng = np.random.default_rng(0)
    shield.decide(rng.uniform(-1.0, 1.0, n))
    done, begun = 0, time.process_time()
    while not shield.running.finished.all():
        done += int((~shield.running.finished).sum())
        shield.decide(rng.uniform(-1.0, 1.0, n))
    return done / (time.process_time() - begun), shield.running.members


def _agent_times(decisions: int, later: bool) -> list[float]:
    """Processor time (s) per decision of a learned policy behind the shield, one world at a time."""
    scenario = load_scenario("paper-random")
    (policy,) = make_agents(["ppo@shipped"], scenario).values()
    took: list[float] = []
    world = 0
    while len(took) < decisions:
        driver = ShieldedDriver(policy, scenario, later_rollouts=later)
        engine = episode_engine(scenario.sample(1, 3, first=world).worlds, driver, scenario, 1)
        while not engine.ended.all():
            nothing, begun = np.full((1, 1), np.nan), time.process_time()
            engine.guard.decide(engine, engine.guarded, nothing)  # changes nothing
            took.append(time.process_time() - begun)
            engine.step({})
        world += 1
    return took


def code_digest() -> str:
    """What the outcomes depend on: the shield, the physics, and these tests."""
    digest = hashlib.sha256()
    for folder in ("ethbrake_marl/shield", "ethbrake_marl/physics", "tests/shield"):
        for file in sorted((ROOT / folder).glob("*.py")):
            if file.name not in ("programme.py", "planted_bugs.py") and not file.name.startswith("test_"):
                digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


def main() -> int:
    """All gates."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--worlds", type=int, default=1_000_000, help="of the gate 'bound', all cells together")
    parser.add_argument("--joint-worlds", type=int, default=300_000, help="of the gate 'joint', all cells together")
    parser.add_argument("--interface-worlds", type=int, default=10_000, help="through each interface")
    parser.add_argument("--interfered", type=int, default=1_000, help="episodes with failing calls on each interface")
    parser.add_argument("--corner-worlds", type=int, default=60_000, help="of the gate 'believed'")
    parser.add_argument("--range-worlds", type=int, default=1_200, help="of that gate, from between the corners")
    parser.add_argument("--restarts", type=int, default=1_000, help="of the search")
    parser.add_argument("--intervals", default="gaps_m=0.5", help="of the gate 'inside'")
    parser.add_argument("--boxes", type=int, default=20, help="of that gate")
    parser.add_argument("--draws", type=int, default=50_000, help="worlds out of each box")
    parser.add_argument("--decisions", type=int, default=5_000, help="timed one by one")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--only",
        default="speed,inside,interference,search,believed,interfaces,joint,bound",
        help="gates, with commas between them",
    )
    parser.add_argument("--results", type=Path, default=ROOT / "runs" / "test-shield", help="folder of finished chunks")
    parser.add_argument("--part", default="1/1", help="this process's share of the chunks, for instance 1/2")
    given = parser.parse_args()
    code = code_digest()
    gates = {
        "speed": lambda: speed(given.decisions),
        "inside": lambda: inside_gate(given.intervals, given.boxes, given.draws, given.seed),
        "search": lambda: search_gate(given.restarts, given.seed),
        "interference": lambda: interference_gate(given.interfered, given.seed),
        "joint": lambda: run_chunks(list(joint_chunks(given.joint_worlds)), joint_chunk, given, code),
        "believed": lambda: (
            gate(LISTS, "corners", given.corner_worlds, given.seed)
            & gate(INSIDE, "interior", given.range_worlds, given.seed)
        ),
        "interfaces": lambda: run_chunks(list(interface_chunks(given.interface_worlds)), interface_chunk, given, code),
        "bound": lambda: run_chunks(list(bound_chunks(given.worlds)), attack_chunk, given, code),
    }
    verdicts = {}
    for name in given.only.split(","):
        print(name, flush=True)
        verdicts[name] = gates[name]()
    for name, good in verdicts.items():
        print(f"{name}: {'PASS' if good else 'FAIL'}")
    return 0 if all(verdicts.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
