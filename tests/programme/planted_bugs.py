"""Fifty bugs in scenarios, rewards, V2X, engine, ablation, evaluation and learning: each must turn a test red.

``make planted-bugs`` runs this after the bugs of the physics (``python -m tests.programme.planted_bugs [--jobs J]
[--only WORD]``). A bug is a textual patch, applied to a temporary copy of the repository, never to the working tree;
there the few test files of its module run, compiled, until the first failure. The kernels of a copy are compiled once
for all its bugs but those that change a kernel. The tests must be green without any bug, and a patch that does not fit
the code is an error.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import chain
from typing import NamedTuple

from tests.programme.copies import mutated, working_copy
from tests.programme.planting import Patch, first_red, misfits
from tests.programme.suites import ROOT

REWARDS, V2X, ENGINE, TERMS, STEPPING, STARTS, OBJECTIVES = (
    "ethbrake_marl/rewards.py",
    "ethbrake_marl/scenario/v2x.py",
    "ethbrake_marl/engine.py",
    "ethbrake_marl/engine.py",
    "ethbrake_marl/engine.py",
    "ethbrake_marl/engine.py",
    "ethbrake_marl/harm.py",
)  # fmt: skip
SB3 = "ethbrake_marl/envs/sb3.py"
COMPARISON, OPTIMUM, PLAN = (
    "ethbrake_marl/studies/ablation.py",
    "ethbrake_marl/studies/ablation.py",
    "ethbrake_marl/studies/ablation.py",
)
EXACT, SEEDS, TABLE, REGRET, ROLLOUT = (
    "ethbrake_marl/evaluation/statistics.py",
    "ethbrake_marl/evaluation/statistics.py",
    "ethbrake_marl/evaluation/measures.py",
    "ethbrake_marl/evaluation/measures.py",
    "ethbrake_marl/evaluation/rollout.py",
)
SHARDS = "ethbrake_marl/studies/jobs.py"
COURSE, LOOP, EVENTS, KEPT, INDEPENDENT, RECIPE = (
    "ethbrake_marl/learning/runs.py",
    "ethbrake_marl/learning/runs.py",
    "ethbrake_marl/learning/runs.py",
    "ethbrake_marl/learning/training.py",
    "ethbrake_marl/learning/algorithms.py",
    "ethbrake_marl/learning/training.py",
)


SAMPLING = MIXTURE = "ethbrake_marl/scenario/sampling.py"


class Bug(NamedTuple):
    """A bug: where it is, what stands there, what is written instead, and the tests that are tried."""

    file: str
    old: str
    new: str
    tests: tuple[str, ...]


OF_REWARDS = ("tests/test_rewards.py", "tests/test_objectives.py")
OF_SCENARIOS = ("tests/scenario/test_vehicle_types.py", "tests/scenario/test_mixture.py")
OF_V2X = ("tests/scenario/test_v2x.py",)
OF_ENGINE = ("tests/engine/test_engine.py", "tests/test_rewards.py", "tests/envs/test_sb3.py")
OF_ABLATION = ("tests/studies/ablation/test_levels.py", "tests/studies/ablation/test_comparison.py")
OF_OPTIMUM = ("tests/studies/ablation/test_joint_optimum.py",)
OF_STATISTICS = (
    "tests/evaluation/test_exact.py",
    "tests/evaluation/test_statistics.py",
    "tests/evaluation/test_seed_statistics.py",
)
OF_TABLES = ("tests/evaluation/test_table.py", "tests/evaluation/test_regret.py", "tests/evaluation/test_rollout.py")
OF_LEARNING = ("tests/learning/test_progress.py", "tests/learning/test_recipe.py", "tests/learning/test_train.py")
OF_FILES = ("tests/learning/test_training.py", "tests/learning/test_event_files.py")

BUGS: dict[str, Bug] = {
    # ------------------------------------------------------------ rewards
    "shaping potential not renewed after autoreset": Bug(
        ENGINE,
        "        if self.reward.shaping > 0.0:\n            worlds =",
        "        if self.reward.shaping > 0.0 and len(rows) == self.n:\n            worlds =",
        OF_REWARDS,
    ),
    "collision counts first impacts only": Bug(
        REWARDS, "-params.k_energy * step.total_harm", "-params.k_energy * step.first_impact_harm", OF_REWARDS
    ),
    "terminal not paid at the horizon": Bug(
        STEPPING, "1.0 if over and impacts == 0.0 else 0.0", "1.0 if at_rest and impacts == 0.0 else 0.0", OF_REWARDS
    ),
    "terminal paid after a collision of an earlier step": Bug(
        STEPPING, "impacts += state[k, harm + 2 * P + p]", "impacts += table[ROW.COUNT, at + p]", OF_REWARDS
    ),
    "risk without its safety buffer": Bug(
        REWARDS, "step.gaps_m - params.safety_buffer_m", "step.gaps_m - 0.0 * params.safety_buffer_m", OF_REWARDS
    ),
    "risk of a pair told to its front vehicle only": Bug(REWARDS, "    risk[:, 1:] += pair_risk\n", "", OF_REWARDS),
    "jerk per step instead of per second": Bug(
        REWARDS,
        "rate = (step.command_mps2 - step.previous_mps2) / step.time_step_s",
        "rate = step.command_mps2 - step.previous_mps2",
        OF_REWARDS,
    ),
    "discount on the wrong side of the shaping": Bug(
        TERMS,
        "self.params.shaping_discount * running._potential - old",
        "running._potential - self.params.shaping_discount * old",
        OF_REWARDS,
    ),
    "potential of several learners with everybody's first choice": Bug(
        REWARDS, "command[:, vehicle] = np.take", "np.zeros(worlds.n)[:] = np.take", OF_REWARDS
    ),
    "potential in the other count of harm": Bug(
        REWARDS, '[0 if self.harm_count == "first" else 1]', '[1 if self.harm_count == "first" else 0]', OF_REWARDS
    ),
    "weights of social value orientation swapped": Bug(
        OBJECTIVES, "return float(sums[0]), float(sums[1])", "return float(sums[1]), float(sums[0])", OF_REWARDS
    ),
    "an objective's harm so far paid again in every step": Bug(
        TERMS, 'step.further["harm"] = before - self.obj', 'step.further["harm"] = 0.0 * before - self.obj', OF_REWARDS
    ),
    # ------------------------------------------------------------ V2X
    "lost links heard": Bug(V2X, "    delay[u[..., 2] < channel.lost] = np.inf\n", "", OF_V2X),
    "bursts one period short": Bug(
        V2X, "len(rising) - np.searchsorted(", "np.maximum(len(rising) - 1, 0) - np.searchsorted(", OF_V2X
    ),
    "front hears those behind": Bug(V2X, "sender >= receiver,", "sender <= receiver,", OF_V2X),
    "the sight of the vehicle ahead before it brakes": Bug(
        V2X, "latency[:, i - 1] + seen[:, i, i - 1]", "seen[:, i, i - 1]", OF_V2X
    ),
    "own latency forgotten when news come early": Bug(
        V2X, "latency[:, i] = np.maximum(latency[:, i], told)", "latency[:, i] = told", OF_V2X
    ),
    "news before the vehicle may react": Bug(
        V2X,
        "known = np.maximum(latency[:, :, np.newaxis], np.minimum(heard, seen))",
        "known = np.minimum(heard, seen)",
        OF_V2X,
    ),
    "time to act left out of the delay of a message": Bug(
        V2X, "self.radio_s + self.processing_s + self.actuation_s", "self.radio_s + self.processing_s", OF_V2X
    ),
    "all links of a world share one draw": Bug(
        V2X, "u.reshape(n, N, N, PER_LINK)", "np.broadcast_to(u[:, None, None, :PER_LINK], (n, N, N, PER_LINK))", OF_V2X
    ),
    # ------------------------------------------------------------ engine
    "harm before the first decision lost": Bug(
        STARTS,
        "(impacts.first_impact_harm, impacts.total_harm, impacts.count)",
        "(0.0 * impacts.first_impact_harm, 0.0 * impacts.total_harm, impacts.count)",
        ("tests/envs/test_parallel.py",),
    ),
    "one step more where the division rounds up": Bug(
        "ethbrake_marl/physics/kernel.py", " / self.time_step_s - _ROUNDING)", " / self.time_step_s)", OF_ENGINE
    ),
    "rows that have ended are paid again": Bug(TERMS, "        extra[standing] = 0.0\n", "", OF_ENGINE),
    "the last observation taken from the next episode": Bug(
        SB3,
        "            self._close_episodes(ended, step, infos)\n            engine.renew(ended)\n",
        "            engine.renew(ended)\n            self._close_episodes(ended, step, infos)\n",
        OF_ENGINE,
    ),
    "returns go on into the next episode": Bug(
        SB3, "        self._return[rows], self._steps[rows] = 0.0, 0\n", "        self._steps[rows] = 0\n", OF_ENGINE
    ),
    "worlds of the stream given out twice": Bug(
        STARTS, "        self._drawn += size\n", "        self._drawn += size - 1\n", OF_ENGINE
    ),
    # ------------------------------------------------------------ ablation
    "better off called worse off": Bug(COMPARISON, "new > old + TOLERANCE", "old > new + TOLERANCE", OF_ABLATION),
    "difference of two levels the wrong way round": Bug(
        COMPARISON,
        "after.reached.world[harm_count], before.reached.world[harm_count]",
        "before.reached.world[harm_count], after.reached.world[harm_count]",
        OF_ABLATION,
    ),
    "beside the joint optimum stand all worlds": Bug(
        COMPARISON, "reached[:, :searched], braking[:, :searched]", "reached, braking[:, :searched]", OF_ABLATION
    ),
    "the joint optimum of other latencies counts": Bug(
        OPTIMUM, "np.asarray(same & on_grid &", "np.asarray(on_grid &", OF_OPTIMUM
    ),
    "levels may differ in their lines": Bug(PLAN, "(*_LINE, *_WORLD, *_VEHICLE)", "(*_LINE, *_VEHICLE)", OF_ABLATION),
    # ------------------------------------------------------------ evaluation
    "standard deviation of a population": Bug(
        EXACT, "(n * n * (n - 1)) << PRODUCT_BITS", "(n * n * n) << PRODUCT_BITS", OF_STATISTICS
    ),
    "relative decrease as if nothing were paired": Bug(
        EXACT,
        "self.squares * y * y - 2 * x * y * products + x * x * others.squares",
        "(n * self.squares - x * x) * y * y // n",
        OF_STATISTICS,
    ),
    "the upper bits of a summand are lost": Bug(EXACT, "sign * (high >> 32)", "sign * 0", OF_STATISTICS),
    "parts of a list that are finished are driven again": Bug(
        SHARDS, "            if name not in done", "            if True", ("tests/studies/test_shards.py",)
    ),
    "interval over seeds without drawing worlds anew": Bug(
        SEEDS, "drawn = rng.integers(worlds, size=(size, worlds)) +", "drawn = np.arange(worlds) + 0 *", OF_STATISTICS
    ),
    "impacts counted as collisions": Bug(
        REGRET, '"collision_rate", lambda o, _: o.collided,', '"collision_rate", lambda o, _: o.impacts,', OF_TABLES
    ),
    "regret of total harm against the best first-impact harm": Bug(
        REGRET,
        'return self.first_impact_harm if harm_count == "first" else self.total_harm',
        "return self.first_impact_harm",
        OF_TABLES,
    ),
    "a share realised though some world's best is unknown": Bug(
        REGRET, "own.count(KNOWN) != worlds", "own.count(KNOWN) == 0", OF_TABLES
    ),
    "an agent's prediction of the first chunk told for all": Bug(
        TABLE,
        "np.concatenate([getattr(part, name) for part in parts]) for name in given",
        "np.resize(getattr(first, name), sum(len(part.at_rest) for part in parts)) for name in given",
        OF_TABLES,
    ),
    # ------------------------------------------------------------ types and mixtures
    "types drawn from the numbers of the quantities": Bug(
        SAMPLING, "numbers(PER_TYPE * self.vehicles, TYPES)", "numbers(PER_TYPE * self.vehicles, ())", OF_SCENARIOS
    ),
    "each quantity with a load of its own": Bug(
        SAMPLING, "entry.value(typed[1][rows, i])", "entry.value(u[rows, rule.place(i)])", OF_SCENARIOS
    ),
    "worlds of a member numbered anew": Bug(
        MIXTURE, "first + np.flatnonzero(chosen == k)", "first + np.arange(int((chosen == k).sum()))", OF_SCENARIOS
    ),
    "the weights of a mixture ignored": Bug(
        MIXTURE, "[member.weight for member in self.mixture]", "[1.0 for _ in self.mixture]", OF_SCENARIOS
    ),
    # ------------------------------------------------------------ learning
    "the best policy judged by the other count": Bug(
        COURSE,
        "name = RunDirectory.chosen_by(self.evaluations, self.harm_count)",
        'name = RunDirectory.chosen_by(self.evaluations, "first")',
        OF_LEARNING,
    ),
    "no alarm where the harm rises with the return": Bug(
        COURSE, "harms > harmed + RISEN * abs(harmed)", "harms < harmed - RISEN * abs(harmed)", OF_LEARNING
    ),
    "a collapse must be four times the least harm": Bug(
        COURSE, "max(TIMES_LEAST * least[harm],", "max(4.0 * least[harm],", OF_LEARNING
    ),
    "a lost training is not stopped": Bug(
        LOOP, "self.course.lost if self._wishes.stop_when_lost else None", "None", OF_LEARNING
    ),
    "the learning rate falls at once": Bug(
        RECIPE, "done = min(max(1.0 - remaining, 0.0), 1.0)", "done = 1.0", OF_LEARNING
    ),
    "the scenario left out of a training's identity": Bug(
        KEPT, '"scenario": self.scenario.content(without=WORDS)', '"scenario": {}', OF_FILES
    ),
    "event files named by the clock": Bug(EVENTS, "default=0) + 1", "default=0) * 0 + int(time.time())", OF_FILES),
    "a learner learns from the rows of another": Bug(
        INDEPENDENT,
        "getattr(buffer, name)[:, number::count].copy()",
        "getattr(buffer, name)[:, ::count].copy()",
        ("tests/learning/test_teams.py",),
    ),
}


def try_share(names: Sequence[str]) -> int:
    """Plant bugs one after another in one copy of the repository, print which test finds each; how many were found."""
    found = 0
    with working_copy() as folder:
        for name in names:
            bug = BUGS[name]
            with mutated(folder, bug.file, (ROOT / bug.file).read_text("utf-8").replace(bug.old, bug.new)):
                red = first_red(folder, bug.tests, compiled=True)
            found += bool(red)
            print(f"{'found ' if red else 'MISSED'}  {name:60s} {red.removeprefix('tests/')}", flush=True)
    return found


def red_without(tests: Sequence[str]) -> str:
    """The first of these tests that fails without any bug, or an empty string."""
    with working_copy() as folder:
        return first_red(folder, tuple(tests), compiled=True)


def patches(bugs: Mapping[str, Bug]) -> dict[str, tuple[Patch, ...]]:
    """The bugs as ``misfits`` takes them."""
    return {name: (Patch(bug.file, bug.old, bug.new),) for name, bug in bugs.items()}


def main() -> int:
    """Plant every bug and print which test finds it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--only", default="", help="only bugs whose name contains this")
    given = parser.parse_args()
    for wrong in (unfit := misfits(patches(BUGS))):
        print(f"ERROR  {wrong}")
    if unfit:
        return 1
    chosen = [name for name in BUGS if given.only in name]
    if red := red_without(dict.fromkeys(chain.from_iterable(BUGS[name].tests for name in chosen))):
        print(f"ERROR  red without any bug: {red}")
        return 1
    shares = [chosen[k :: given.jobs] for k in range(given.jobs)]
    with ThreadPoolExecutor(given.jobs) as pool:
        found = sum(pool.map(try_share, shares))
    verdict = "PASS" if found == len(chosen) else "FAIL"
    print(f"planted bugs outside the physics: {found}/{len(chosen)} found: {verdict}")
    return 0 if verdict == "PASS" else 1


if __name__ == "__main__":
    sys.exit(main())
