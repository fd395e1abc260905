"""Attacks on shields that do not know everything: no harm above the bound in any world that they certify.

robust   true worlds that are corners of the intervals around the nominal ones
between  true worlds inside the intervals, which no bound covers; only reported
horizon  harm after the horizon, which no bound covers; only reported
"""

from functools import partial
from itertools import product

import numpy as np

import ethbrake_marl as eb
from ethbrake_marl.extensions.certified.robust import RobustShield, opened
from tests.extensions.certified.attack import UNCERTAINTIES, Episodes, robust
from tests.programmes import Cases, Given, Told
from tests.shields.attack import WAYS

DECISIONS = 45  # of an episode, about
AT_ONCE = 500  # worlds attacked together
BATCH = 50_000  # worlds inside a box that are simulated together

OPTIONS = {
    "--decisions": {"type": int, "default": 240_000, "help": "decisions of robust in all, about"},
    "--intervals": {"default": "gaps_m=0.5", "help": "uncertainty of 'between'"},
    "--boxes": {"type": int, "default": 20, "help": "boxes of 'between'"},
    "--draws": {"type": int, "default": 50_000, "help": "worlds from each box"},
    "--seed": {"type": int, "default": 1},
}


def cases(given: Given) -> Cases:
    each = max(1, given.decisions // (DECISIONS * 2 * len(WAYS) * len(UNCERTAINTIES)))
    for intervals in UNCERTAINTIES:
        yield f"robust: {UNCERTAINTIES[intervals]}, {intervals}", partial(attacked, intervals, each, given.seed)
    yield f"between the corners ({given.intervals})", partial(between, given)
    for proposer in ("coast", "full_brake"):
        yield f"horizon: {proposer}", partial(beyond_horizon, proposer)


def attacked(intervals: str, worlds: int, seed: int) -> Told:
    found: list[Episodes] = []
    for k, (count, way) in enumerate(product(("first", "total"), WAYS)):
        for first in range(0, worlds, AT_ONCE):
            n = min(AT_ONCE, worlds - first)
            found.append(robust(intervals, count, way, n, seed + 1000 * k + first))
    above, rises, decisions, replaced = (
        sum(int(np.sum(getattr(each, key))) for each in found) for key in ("above", "rises", "decisions", "replaced")
    )
    harm, bound, trusted = (np.concatenate([getattr(e, key) for e in found]) for key in ("harm", "first", "trusted"))
    return Told(
        above == rises == 0 and trusted.all() and replaced > 0,
        f"{len(harm):,} worlds, {decisions:,} decisions, {replaced:,} replaced, above the bound {above}, bound rose"
        f" {rises}, not trusted {int((~trusted).sum())}; harm {harm.mean():.1f}, bound {bound.mean():.1f}",
    )


def between(given: Given) -> Told:
    """Count the worlds between the corners that do more harm than the bound, if somebody proposes to coast.

    The actions do not depend on which world of the box is the true one. So one shield decides per box, and many worlds
    of the box are played with its actions.
    """
    scenario, game = eb.open_game("paper-random")
    nominal, rng, boxes = scenario.sample(given.boxes, given.seed), np.random.default_rng(given.seed), given.boxes
    shield = RobustShield(uncertainty=given.intervals)
    guarded, decisions = game._replace(shield=shield), 0
    state = guarded.reset(nominal)
    applied = np.full((boxes, state.memories["shield"].plan.shape[1], 1), np.nan)
    while not state.ended.all():
        rows = np.flatnonzero(~state.ended)
        decisions, at = decisions + len(rows), state.steps[rows]
        state, _ = guarded.step(state, np.zeros((boxes, 1)))
        applied[rows, at] = state.memories["shield"].applied[rows]
    plans = np.where(np.isnan(applied), state.memories["shield"].plan, applied)
    memory, above, excess, harm = state.memories["shield"], 0, -np.inf, 0.0
    draws = [min(BATCH, given.draws - first) for first in range(0, given.draws, BATCH)]
    for k, n in product(range(boxes), draws):
        truth = opened(game, shield.uncertainty.draw(nominal.take(np.full(n, k)), rng))
        done = eb.price(game, truth, plans[k : k + 1].repeat(n, axis=0), "first")
        over = done - memory.first[k]
        above, excess, harm = above + int((over > 1e-9).sum()), max(excess, over.max()), harm + done.sum()
    worlds = boxes * given.draws
    return Told(
        None,
        f"{worlds:,} worlds of {boxes} boxes, above: {above:,} ({above / worlds:.2%}), most by {excess:.2g}; bound"
        f" {memory.first.mean():.2f}, harm {harm / worlds:.2f}, replaced {memory.replaced.sum() / decisions:.0%}",
    )


def beyond_horizon(proposer: str) -> Told:
    """Count worlds above the bound if the episode ends at 3 s, once all vehicles have braked from then on to rest."""
    scenario, game = eb.open_game(eb.load_scenario("paper-random").replace(horizon_s=3.0))
    team = eb.shield(eb.make_agent(proposer), scenario=scenario)
    last = eb.drive(game, scenario.sample(2_000, 7), team)
    bound = last.memories["shield"].first
    later = eb.hold(last, -last.car[:, 3], [2], -last.car[:, np.newaxis, 3, [2]], 60.0, "first")[0, :, 0]
    now, then = ((harm > bound + 1e-9).mean() for harm in (last.harm(), later))
    return Told(None, f"worlds above the bound at 3 s: {now:.1%}, when all vehicles are at rest: {then:.1%}")
