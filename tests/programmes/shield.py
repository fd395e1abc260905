"""Attacks on the step shield: the harm of an episode must not be above its bound at the alert.

bound         random worlds against every adversary of ``shield/attacks.py``, both counts, N = 3 and 5, e to 0.3
build-up      as bound, with brakes that build up at 5 to 60 m/s3, and with other vehicles that brake by profiles
joint         teams of hostile learners at cooperation levels 3 and 4, N = 3 and 5; harm must equal the last bound
pieces        as joint, with every selection of message pieces: the shield must refuse or keep its bound
interfaces    worlds in every shielded interface, with one learner and with a team
interference  refused calls, exceptions and interrupts at random lines in every interface, and wrappers in between
search        restarts of a search against the shield, and against twelve planted leaks, each of which must be found
estimated     true worlds that are corners of the unknown ranges, and true worlds inside the ranges
inside        true worlds inside intervals, with robust mode; for corner mode the result is only reported
horizon       harm after the horizon, which no bound covers; only reported
"""

from functools import partial
from itertools import combinations, product
from typing import Any

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.certified.robust_step import RobustShield
from ethbrake_marl.extensions.certified.uncertainty import parse_uncertainty
from ethbrake_marl.first_edition.engine.profiles import profile_problem
from ethbrake_marl.first_edition.physics.messages import LOOK_AHEAD, PIECES
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from ethbrake_marl.first_edition.shields.certify import plan_harm
from ethbrake_marl.first_edition.shields.running import begin_running
from tests.extensions.certified.estimates import ABOVE, LISTS, WAYS, shielded
from tests.first_edition.shield.attacks import (
    ADVERSARIES,
    LEAKS,
    TEAM_ADVERSARIES,
    TEAMS,
    TOLERANCE,
    Attack,
    above_later,
    attack,
    begun,
    line,
    search,
)
from tests.first_edition.shield.plays import INSIDE as WRAPPED, PLAYS, WRAPPERS, Tally, disturbed, played, wrapped
from tests.programmes import Cases, Given, Told

CHUNK = 2_000  # worlds attacked together
BATCH = 50_000  # worlds simulated together with the applied actions
CELLS = {3: 3.0, 5: 1.0}  # number of vehicles -> weight of its worlds; lines of five take five times as long
SLOW = {"worst_case": 0.14}  # adversary -> factor of its weight; it searches at every step
RATES = {"brake_rate_mps3": {"uniform": [5, 40]}, "release_rate_mps3": {"uniform": [5, 60]}}
UNSURE = "brake_rate_mps3=20%"  # uncertainty of every vehicle; the true value is a corner
TEAM_CELLS = {(3, 3): 5.0, (4, 3): 1.25, (3, 5): 1.0, (4, 5): 0.75}  # (level, N) -> weight of its worlds


OPTIONS = {
    "--worlds": {"type": int, "default": 1_000_000, "help": "worlds of 'bound' in all, about"},
    "--build-up-worlds": {"type": int, "default": 1_000_000, "help": "worlds of 'build-up' in all, about"},
    "--joint-worlds": {"type": int, "default": 300_000, "help": "worlds of 'joint' in all, about"},
    "--piece-decisions": {"type": int, "default": 100_000, "help": "decisions of 'pieces' in all, at least"},
    "--interface-worlds": {"type": int, "default": 2_000, "help": "worlds of each interface"},
    "--interfered": {"type": int, "default": 1_000, "help": "episodes with failing calls on each interface"},
    "--corner-worlds": {"type": int, "default": 60_000, "help": "worlds of 'estimated'"},
    "--restarts": {"type": int, "default": 1_000, "help": "restarts of the search"},
    "--intervals": {"default": "gaps_m=0.5", "help": "uncertainty of 'between'"},
    "--boxes": {"type": int, "default": 20, "help": "boxes of 'between'"},
    "--draws": {"type": int, "default": 50_000, "help": "worlds from each box"},
    "--seed": {"type": int, "default": 1},
}


def cases(given: Given) -> Cases:
    seed = given.seed
    yield f"between the corners ({given.intervals})", partial(between, given)
    for name in PLAYS:
        yield f"interference: {name}", partial(disturbance, name, given.interfered, seed)
    for wrapper in WRAPPERS:
        yield f"interference: inside, {wrapper}", partial(in_between, wrapper, given.interfered, seed)
    for count in ("first", "total"):
        yield f"search: the shield as it is, {count}", partial(searched, given.restarts, seed, harm_count=count)
    for name, leak in LEAKS.items():
        yield f"search: {name}", partial(searched, given.restarts, seed, leak=leak)
    for name, way in product(LISTS, WAYS):
        each = max(1, given.corner_worlds // (len(LISTS) * len(WAYS)))
        yield f"estimated: {name}, {way}", partial(estimated, LISTS[name], way, each, seed)
    for which in TEAMS:
        yield f"pieces: level {which[0]}, N = {which[1]}", partial(pieces, which, given.piece_decisions, seed)
    for name in PLAYS:
        yield f"interfaces: {name}", partial(interface, name, given.interface_worlds, seed)
    yield from attacks(given)
    for proposer in ("coast", "full_brake", "e_v2x_bm"):
        yield f"horizon: {proposer}", partial(beyond_horizon, proposer)


def attacks(given: Given) -> Cases:
    """Yield every adversary of one learner and of teams, each with its number of worlds. No two cases share a world."""
    one, rates, teams, draws = [], [], [], np.random.default_rng(given.seed)
    for N, count, name in product(CELLS, ("first", "total"), ADVERSARIES):
        case, share = {"harm_count": count, "adversary": ADVERSARIES[name]}, CELLS[N] * SLOW.get(name, 1.0)
        one.append((f"bound: N = {N}, {count}, {name}", share, line(N), case))
        rates.append((f"build-up: N = {N}, {count}, {name}", share, line(N).replace(**RATES), case))
        if name != "worst_case":  # this adversary searches in one world
            unsure = {**case, "uncertain": (RobustShield, parse_uncertainty(UNSURE))}
            rates.append(
                (f"build-up: {UNSURE}, N = {N}, {count}, {name}", 0.25 * share, line(N).replace(**RATES), unsure)
            )
        begins, a, b, c = np.round(draws.uniform([0.05, 0, 0, 3], [1, 6, 6, 6]), 3).tolist()
        pieces, scenario = [[0, a], [begins, b], [1.5, c]], line(N).replace(**(RATES if draws.random() < 0.5 else {}))
        roles = {**scenario.roles, "vehicle_1": {"profile": pieces}, f"vehicle_{N}": {"profile": pieces[::2]}}
        rates.append((f"build-up: in pieces, N = {N}, {count}, {name}", share, scenario.replace(roles=roles), case))
    every_team = product(TEAM_CELLS, ("first", "total"), ("all", "one"), TEAM_ADVERSARIES)
    for k, (which, count, hostile, name) in enumerate(every_team):
        cap = (None, "baseline")[k % 2]
        case = {"harm_count": count, "hostile": hostile, "adversary": TEAM_ADVERSARIES[name], "cap": cap}
        told = f"joint: level {which[0]}, N = {which[1]}, {count}, {hostile} hostile, {name}, cap {cap}"
        scenario = load_scenario(TEAMS[which])
        if which[0] == 3 and k % 3 == 0:  # on level 3 Vehicle 1 is no learner
            told = told.replace("joint:", "joint: in pieces,")
            scenario = scenario.replace(roles={**scenario.roles, "vehicle_1": {"profile": [[0, 2], [0.4, 6], [1, 1]]}})
        teams.append((told, TEAM_CELLS[which], scenario, case))
    first = 0
    for all_worlds, cells in ((given.worlds, one), (given.build_up_worlds, rates), (given.joint_worlds, teams)):
        whole = sum(share for _, share, *_ in cells)
        for told, share, scenario, case in cells:
            worlds = max(1, round(all_worlds * share / whole))
            yield told, partial(attacked, scenario, worlds, first, given.seed, case)
            first += worlds


def attacked(scenario: Any, worlds: int, first: int, seed: int, case: dict[str, Any]) -> Told:
    """Run one adversary in some worlds.

    With one learner, rounding may exceed the bound by a tolerance. With a team, harm must equal the last bound.
    """
    found: list[Attack] = []
    for begin in range(first, first + worlds, CHUNK):
        sample = scenario.sample(min(CHUNK, first + worlds - begin), seed, first=begin).worlds
        found.append(attack(scenario, sample, seed=seed + begin, **case))
    excess = np.concatenate([each.realised - each.bound for each in found])
    inexact = sum(int((each.realised != each.last_bound).sum()) for each in found)
    wrong = int((excess > TOLERANCE).sum())
    if len(scenario.learners) > 1:
        wrong += int((excess > 0.0).sum()) + inexact + sum(each.rises + each.over_cap for each in found)
    accepted, decisions = (
        sum(int(np.sum(getattr(each, name))) for each in found) for name in ("accepted", "decisions")
    )
    return Told(
        wrong == 0,
        f"{worlds:,} worlds, {decisions:,} decisions, {accepted:,} deviations accepted, above: {wrong}, largest excess"
        f" {excess.max():.1e}",
    )


def pieces(which: tuple[int, int], decisions: int, seed: int) -> Told:
    """Attack a team for every selection of message pieces. The shield must refuse or keep its bound."""
    team = load_scenario(TEAMS[which])
    channel = team.v2x.model_dump(exclude_none=True)
    every = [list(some) for size in range(len(PIECES) + 1) for some in combinations(PIECES, size)]
    every += [{name: [p for p in PIECES if p != one]} for name in team.vehicle_names for one in PIECES]
    refused, wrong, taken, done, excess = 0, 0, [], 0, -np.inf
    for tells in every:
        scenario = team.replace(v2x={**channel, "tells": tells})
        try:
            begun(scenario, scenario.sample(2, seed).worlds)
        except InvalidInput as error:
            refused += 1
            wrong += "(key v2x.tells)" not in str(error)
        else:
            taken.append(scenario)
        (told,) = tells.values() if isinstance(tells, dict) else [tells]
        wrong += (scenario in taken[-1:]) != (set(LOOK_AHEAD) <= set(told))
    cells, k = list(product(taken, TEAM_ADVERSARIES.values(), ("first", "total"), ("all", "one"))), 0
    while done < decisions / len(TEAMS) or k < len(cells):
        scenario, adversary, count, hostile = cells[k % len(cells)]
        sample = scenario.sample(20, seed, first=20 * k).worlds
        found = attack(scenario, sample, adversary, harm_count=count, hostile=hostile, seed=seed + k)
        over = found.realised - found.bound
        wrong += int((over > 0.0).sum()) + int((found.realised != found.last_bound).sum()) + found.rises
        done, excess, k = done + found.decisions, max(excess, float(over.max())), k + 1
    return Told(
        wrong == 0,
        f"{len(every)} contents, {refused} refused, {len(taken)} attacked: {done:,} decisions, above: {wrong}, largest"
        f" excess {excess:.1e}",
    )


def interface(name: str, worlds: int, seed: int) -> Told:
    found = played(name, worlds, seed)
    return Told(found.above == found.broken == 0, f"{found.episodes:,} episodes, {found.above} above the bound")


def disturbance(name: str, episodes: int, seed: int) -> Told:
    """Check that failing calls never lead to harm above the bound, and leave shield and engine in the same state."""
    found = disturbed(name, episodes, seed)
    good = (found.above, found.broken) == (0, 0) and found.refused > 0 and found.interrupted > 0
    return Told(
        good,
        f"{found.episodes:,} episodes, {found.refused:,} refused, {found.interrupted:,} interrupted, above the bound:"
        f" {found.above}, changed by what failed: {found.broken}",
    )


def in_between(wrapper: str, calls: int, seed: int) -> Told:
    """Check all interfaces with a wrapper between shield and environment."""
    tallies = [wrapped(name, wrapper, calls, seed) for name in WRAPPED]
    total = Tally(*(sum(column) for column in zip(*tallies, strict=True)))
    good = total.above == total.broken == 0 and all(each.episodes > 0 for each in tallies)
    return Told(
        good,
        f"{total.episodes:,} episodes, {total.refused:,} steps refused, above the bound: {total.above}, changed by what"
        f" failed: {total.broken}",
    )


def searched(restarts: int, seed: int, leak: Any = None, harm_count: str = "first") -> Told:
    """Search against the shield, where nothing must be found, or against a planted leak, which must be found."""
    found = search(restarts, seed, leak, until_found=leak is not None, harm_count=harm_count)
    if leak is None:
        told = f"{found.restarts:,} restarts, {found.above} above the bound, largest excess {found.excess:.1e}"
        return Told(found.above == 0, f"{told}; {found.loose:.0%} above with the same proposals without the shield")
    first = "NOT FOUND" if found.first is None else f"found in restart {found.first}"
    return Told(found.first is not None, f"{first}, largest excess {found.excess:.2g} m2/s2")


def estimated(scenario: Any, way: str, worlds: int, seed: int) -> Told:
    """Check the bound if the true world is a corner of the unknown ranges, for all proposals."""
    harm, bound, replaced = shielded(way, scenario, worlds, seed)
    above, kept = int((harm > bound + ABOVE).sum()), np.isfinite(bound)
    excess = float(np.maximum(harm - bound, 0.0)[kept].max(initial=0.0))
    return Told(
        above == 0 and replaced > 0,
        f"{worlds:,} worlds, {replaced:,} replaced, above the bound: {above}, largest excess {excess:.2g}, without one:"
        f" {int((~kept).sum())}; harm {harm.mean():.1f}, bound {bound[kept].mean():.1f}",
    )


def between(given: Given) -> Told:
    """Count the worlds between the corners that do more harm than the bound, with the agent ``coast``. None is wrong:
    the bound does not cover these worlds.

    The actions of robust mode do not depend on which world of the box is the true one. So one shield decides per box,
    and many worlds of the box are simulated with its actions.
    """
    scenario, uncertainty, boxes = load_scenario("paper-random"), parse_uncertainty(given.intervals), given.boxes
    told, rng = scenario.sample(boxes, given.seed).worlds, np.random.default_rng(given.seed)
    shield = RobustShield(scenario, 1, uncertainty=uncertainty)
    shield.begin(told, np.arange(boxes))
    decisions = 0
    while not shield.memory.running.finished.all():
        decisions += int((~shield.memory.running.finished).sum())
        shield.decide(np.zeros(boxes))
    above, excess, harm = 0, -np.inf, 0.0
    draws = [min(BATCH, given.draws - first) for first in range(0, given.draws, BATCH)]
    for k, n in product(range(boxes), draws):
        truth = uncertainty.draw(told.take(np.full(n, k)), rng)
        plan = np.repeat(shield.memory.backup.plan[k : k + 1], n, axis=0)
        realised = plan_harm(begin_running(profile_problem(truth, [1], horizon_s=scenario.horizon_s)), plan)
        over = realised - shield.memory.first_bound[k]
        above, excess, harm = above + int((over > TOLERANCE).sum()), max(excess, over.max()), harm + realised.sum()
    worlds, bound = boxes * given.draws, float(shield.memory.first_bound.mean())
    return Told(
        None,
        f"{worlds:,} worlds of {boxes} boxes, above: {above:,} ({above / worlds:.2%}), most by {excess:.2g}; bound"
        f" {bound:.2f}, harm {harm / worlds:.2f}, replaced {shield.interventions.sum() / decisions:.0%}",
    )


def beyond_horizon(proposer: str) -> Told:
    now, later = above_later(proposer, 2_000)
    return Told(None, f"worlds above the bound at 3 s: {now:.1%}, when all vehicles are at rest: {later:.1%}")
