"""Trainings by the paper's own process, and what they say of its sentences: ``recorded.yaml`` of the reproduction.

    .venv/bin/python docs/studies/paper/process.py runs/process --train stopped
    .venv/bin/python docs/studies/paper/process.py runs/process --train stopped random low high dense

The process uses the recipes ``ppo-paper`` and ``sac-paper`` in the paper's fixed-step map (``physics: paper-map``), in
the random test (``random``) and at a low and a high delay. ``dense``: PPO at the low delay without terminal reward.
``stopped``: our recipe ``ppo``, stopped after a fifteenth of its decisions, for the paper's policy "obtained from
training before convergence occurred". A training that was stopped goes on when the command is repeated. At the end the
study prints each result that the trainings in the folder allow, as ``recorded.yaml`` has it. All groups take 13 hours
of one core, nearly all of it for SAC.

What ``recorded.yaml`` has: ``stopped`` of 2026-12-01. The rest is of 2026-11-30, commit d6cf43def, with three of five
seeds of SAC in the random test, and 25,000 decisions of SAC at the two delays, which are too few.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

import ethbrake_marl as eb
from ethbrake_marl.evaluation.statistics import mean
from ethbrake_marl.extensions.reproduction import trajectories
from ethbrake_marl.extensions.reproduction.curves import DELAYS, DISTANCE, PAPER_WORLD, by_distance
from ethbrake_marl.extensions.reproduction.readings import OURS, STATED, Reading
from ethbrake_marl.extensions.reproduction.strategies import E_V2X_BM, HARMS, NON_E, Outcome, strategies
from ethbrake_marl.extensions.reproduction.verdicts import (
    HARM,
    PERCENT,
    VERDICT_TOLERANCE,
    Claim,
    Less,
    Result,
    judge,
    judge_in_each,
    same_claim,
)
from ethbrake_marl.files.plain import read_object
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.training.training import Training

RANDOM, HIGH, LOW, STOPPED, DENSE = "random", "high", "low", "stopped", "dense"
NAMES = {"ppo-paper": "PPO", "sac-paper": "SAC", "ppo": "DRL"}
RETURN, COST = "rollout/ep_rew_mean", "eval/first_impact_harm"  # columns of progress.csv
WORLDS, STOPPED_WORLDS, DISTANCE_WORLDS = 10_000, 5_000, 5_000
STEP_S = 0.1  # of the paper's map
ALIKE, RISEN = 0.1, 0.9  # parts of the rise of a return: what counts as nearly identical, and as converged


class Plan(NamedTuple):
    scenario: str
    recipe: str
    seeds: int
    decisions: int | None = None  # None: those of the recipe
    mapped: bool = True  # in the paper's map
    terminal: float | None = None  # reward at an end without a collision; None: that of the recipe

    def training(self, seed: int) -> Training:
        scenario, recipe = eb.load_scenario(self.scenario), eb.load_recipe(self.recipe)
        if self.mapped:
            scenario = scenario.replace(physics="paper-map")
        reward = {**recipe.reward.model_dump(mode="json"), "harm_count": "first"}
        if self.terminal is not None:
            reward["terminal"] = self.terminal
        return Training.of(recipe, scenario, reward=reward, seed=seed, total_steps=self.decisions or recipe.total_steps)

    def runs(self, folder: Path, group: str) -> list[Path]:
        return [folder / "trainings" / group / f"{self.recipe}-seed{seed}" for seed in range(self.seeds)]


def both(scenario: str, seeds: int) -> tuple[Plan, Plan]:
    return Plan(scenario, "ppo-paper", seeds), Plan(scenario, "sac-paper", seeds, 200_000)


GROUPS = {
    STOPPED: (Plan("paper-random", "ppo", 5, 100_000, mapped=False),),
    RANDOM: both("paper-random", 5),
    LOW: both("paper-delay-low", 3),
    HIGH: both("paper-delay-high", 3),
    DENSE: (Plan("paper-delay-low", "ppo-paper", 2, terminal=0.0),),
}


def is_finished(run: Path) -> bool:
    return (run / "run.json").is_file() and read_object(run / "run.json").get("status") == "finished"


def train(folder: Path, groups: Iterable[str]) -> None:
    for group in groups:
        for plan in GROUPS[group]:
            for seed, run in enumerate(plan.runs(folder, group)):
                if (run / "run.json").is_file() and not is_finished(run):
                    eb.resume(run)
                elif not is_finished(run):
                    training = plan.training(seed)
                    eb.train(training.recipe, training.scenario, run)


def trained(folder: Path, group: str) -> dict[str, list[Path]]:
    """``PPO``, ``SAC``, ``DRL`` -> runs that have finished."""
    runs = {NAMES[plan.recipe]: [*filter(is_finished, plan.runs(folder, group))] for plan in GROUPS[group]}
    return {name: finished for name, finished in runs.items() if finished}


class Course(NamedTuple):
    """Learning curves of one algorithm at one delay, for all seeds: [seeds, k] at k numbers of decisions."""

    decisions: Floats
    returns: Floats
    harm: Floats  # of the last policy in a fixed list of worlds, [seeds] m2/s2

    @staticmethod
    def of(runs: Sequence[Path]) -> Course:
        rows = [[*csv.DictReader((run / "progress.csv").read_text("utf-8").splitlines())] for run in runs]
        returns = [{float(row["steps"]): float(row[RETURN]) for row in of_seed if row.get(RETURN)} for of_seed in rows]
        shared = sorted(set.intersection(*map(set, returns)))
        harm = [float([row[COST] for row in of_seed if row.get(COST)][-1]) for of_seed in rows]
        return Course(np.array(shared), np.array([[each[k] for k in shared] for each in returns]), np.array(harm))

    def part(self, share: float) -> Floats:
        """The last ``share`` of the returns."""
        return self.returns[:, -max(int(self.returns.shape[1] * share), 2) :]

    @property
    def last(self) -> Floats:
        return np.asarray(self.part(0.1).mean(axis=1))

    @property
    def rise(self) -> Floats:
        return np.asarray(self.last - self.returns[:, 0])

    @property
    def unrest(self) -> Floats:
        """Standard deviation of the return over the last quarter, [seeds]."""
        return np.asarray(self.part(0.25).std(axis=1, ddof=1))

    @property
    def spread(self) -> Floats:
        """Mean distance from the mean of all seeds, in the last quarter, [seeds]."""
        late = self.part(0.25)
        return np.asarray(np.abs(late - late.mean(axis=0)).mean(axis=1))

    @property
    def until(self) -> Floats:
        """Number of decisions until the return has made nine tenths of its rise, [seeds]."""
        risen = self.returns >= (self.returns[:, 0] + RISEN * self.rise)[:, np.newaxis]
        return np.asarray(self.decisions[risen.argmax(axis=1)])

    @property
    def improvement(self) -> float:
        """Last third of the training minus middle third, mean over seeds."""
        third = self.returns.shape[1] // 3
        return float((self.returns[:, -third:] - self.returns[:, -2 * third : -third]).mean())

    @property
    def is_converged(self) -> bool:
        return float(self.rise.mean()) > 0.0 and self.improvement <= VERDICT_TOLERANCE * float(self.rise.mean())

    @property
    def length(self) -> str:
        return (
            f"{len(self.returns)} seeds, {self.decisions[-1]:,.0f} decisions, last third {self.improvement:+.2f} of a"
            f" rise of {self.rise.mean():.1f}"
        )


def judge_trained(
    name: str, courses: Mapping[str, Course], parts: Sequence[Less], numbers: str = "", *, ours_decides: bool = False
) -> Claim:
    """Undecided if a training is not converged, if there is one seed, or if lengths or weights, which are our choice,
    decide.
    """
    found, several = judge(parts, numbers), all(len(course.returns) > 1 for course in courses.values())
    rested = all(course.is_converged for course in courses.values())
    reason = "" if rested else "; not converged"
    reason += "" if several else "; one seed"
    lengths = "; ".join(f"{algorithm}: {course.length}" for algorithm, course in courses.items())
    decided = rested and several and not ours_decides
    return same_claim(name, f"{found.text} ({lengths}){reason}", found.verdict if decided else "undecided")


def stopped_claims(runs: Sequence[Path]) -> list[Claim]:
    """Rows of ``Table:hybrid``: means over seeds, with t intervals."""
    of_reading: dict[str, list[dict[str, Outcome]]] = {}
    for run in runs:
        policy = {"DRL": f"policy@{run / 'policy-last'}"}
        for name, outcomes in strategies(STATED, STOPPED_WORLDS, policy).items():
            of_reading.setdefault(name, []).append(outcomes)
    claims = []
    for row, agent in (("Standalone DRL", "DRL"), ("Hybrid", "Hybrid DRL")):
        rates, harms = {}, {}
        for name, seeds in of_reading.items():
            rates[name] = Result(PERCENT.show(over(seeds, agent, "collided")).in_words, "undecided")
            harms[name] = Result(HARM.show(over(seeds, agent, "first")).in_words, "undecided")
        claims += [
            Claim(f"hybrid-table/{row}, collision rate", rates),
            Claim(f"hybrid-table/{row}, average harm", harms),
        ]
    claims.append(judge_in_each("hybrid-table/outperforms in harm", of_reading, partial(better_than_both, key="first")))
    fewer = judge(better_than_both(of_reading[OURS], "collided")).text  # in every reading
    claims.append(same_claim("hybrid-table/outperforms in collisions", fewer, "undecided"))
    return [claim for claim in claims if claim.name != "hybrid-table/Hybrid, collision rate"]  # the command has it


def over(seeds: Sequence[Mapping[str, Outcome]], agent: str, key: str) -> eb.Estimate:
    return mean(np.array([outcomes[agent][key].mean() for outcomes in seeds]))


def better_than_both(seeds: Sequence[Mapping[str, Outcome]], key: str) -> list[Less]:
    """In the worlds of each seed, the hybrid has less of ``key`` than both of its strategies."""
    return [
        Less.of_worlds(f"hybrid minus {rival}, seed {seed}", *(1.0 * each[name][key] for name in ("Hybrid DRL", rival)))
        for seed, each in enumerate(seeds)
        for rival in ("DRL", E_V2X_BM)
    ]


def over_seeds(seeds: Sequence[Mapping[str, Outcome]], smaller: str, larger: str) -> list[Less]:
    """Less harm and fewer collisions, over seeds."""
    scales = {**{key: (words, 1.0) for key, words in HARMS.items()}, "collided": ("% of worlds", 100.0)}
    return [
        Less(
            f"{smaller} minus {larger}, {words}",
            mean(np.array([scale * (each[smaller][key].mean() - each[larger][key].mean()) for each in seeds])),
        )
        for key, (words, scale) in scales.items()
    ]


def driven(reading: Reading, worlds: int, name: str, runs: Sequence[Path]) -> list[dict[str, Outcome]]:
    """For each seed of a policy, strategy -> outcome in the paper's map."""
    mapped = reading._replace(step_s=STEP_S)
    return [strategies(mapped, worlds, {name: f"policy@{run / 'policy'}"})[OURS] for run in runs]


def process_claims(runs: Mapping[str, Sequence[Path]]) -> list[Claim]:
    """The contributions, and Figs. 4 and 5, with policies of the paper's process."""
    claims = []
    for name, of_seeds in runs.items():
        course = {name: Course.of(of_seeds)}
        seeds, hybrid = driven(STATED, WORLDS, name, of_seeds), f"Hybrid {name}"
        for result, parts in ((name, over_seeds(seeds, name, E_V2X_BM)), (hybrid, over_seeds(seeds, hybrid, name))):
            claims.append(judge_trained(f"random-table/{result} by the process", course, parts, ours_decides=True))
        distance = STATED._replace(base=DISTANCE)
        seeds = driven(distance, DISTANCE_WORLDS, name, of_seeds)
        parts = [
            part
            for group, (_, rows) in by_distance(distance, DISTANCE_WORLDS, {}).items()
            for part in less_harm(seeds, name, [E_V2X_BM], group, rows)
        ]
        claims.append(judge_trained(f"harm-distance/{name} by the process", course, parts, ours_decides=True))
        parts = [
            part
            for delay in DELAYS
            for reading in (STATED._replace(base=f"paper-delay-{delay}", others=PAPER_WORLD),)
            for part in less_harm(driven(reading, 1, name, of_seeds), name, [NON_E, E_V2X_BM], delay, slice(None))
        ]
        claims.append(judge_trained(f"harm-delays/{name} by the process", course, parts, ours_decides=True))
    return claims


def less_harm(seeds: Sequence[Mapping[str, Outcome]], name: str, rivals: Sequence[str], where: str, rows) -> list[Less]:
    parts = []
    for rival in rivals:
        own, other = (np.array([each[who]["first"][rows].mean() for each in seeds]) for who in (name, rival))
        parts.append(Less(f"{name} minus {rival}, {where}", mean(own - other), not own.any() and not other.any()))
    return parts


def curve_claims(low: Mapping[str, Course], high: Mapping[str, Course]) -> list[Claim]:
    """Figs. 2 and 3. That a deviation is below a tenth of the rise can hardly fail, so it decides nothing."""
    ppo, sac = low["PPO"], low["SAC"]
    pairs = {name: {f"{name}, {HIGH}": high[name], f"{name}, {LOW}": low[name]} for name in low}
    everything = pairs["PPO"] | pairs["SAC"]
    apart = np.abs(high["PPO"].last.mean() - high["SAC"].last) - ALIKE * high["PPO"].rise.mean()
    stable = [Less.of_lists("PPO minus SAC, deviation", high["PPO"].unrest, high["SAC"].unrest)]
    stable += [Less.of_lists("PPO minus SAC, harm", high["PPO"].harm, high["SAC"].harm)]
    faster = [Less.of_lists("SAC minus PPO, decisions until nine tenths of the rise", sac.until, ppo.until)]
    suits = [*faster, Less.of_lists("SAC minus PPO, harm", sac.harm, ppo.harm)]
    alike, safer = [Less("difference minus a tenth of PPO's rise", mean(apart))], []
    steadier = [Less.of_lists("PPO minus SAC, deviation in the last quarter", ppo.unrest, sac.unrest)]
    higher = [Less.of_lists(name, high[name].last, low[name].last) for name in low]
    safer += [Less.of_lists(f"{name}, harm", low[name].harm, high[name].harm) for name in low]
    varied = [Less.of_lists(name, high[name].spread, low[name].spread) for name in low]
    rest = {
        name: [Less(f"{at}: deviation minus a tenth of the rise", mean(each.unrest - ALIKE * each.rise)) for at, each
               in pair.items()] for name, pair in pairs.items()
    }  # fmt: skip
    results = [
        ("PPO converges", pairs["PPO"], rest["PPO"], True), ("SAC converges", pairs["SAC"], rest["SAC"], True),
        ("steady", high, [rest[name][0] for name in rest], True), ("alike", high, alike, True),
        ("PPO suits", high, stable, False), ("faster", low, faster, True), ("higher", everything, higher, False),
        ("safer", everything, safer, False), ("steadier", low, steadier, False), ("varied", everything, varied, False),
        ("SAC suits", low, suits, True),
    ]  # fmt: skip
    return [
        judge_trained(f"learning-curves/{name}", courses, parts, ours_decides=ours)
        for name, courses, parts, ours in results
    ]


def reward_claims(sparse: Course, dense: Course) -> list[Claim]:
    """PPO at the low delay with the terminal reward, which is sparse, and without."""
    courses = {"with": sparse, "without": dense}
    unrest = [course.unrest / course.rise for course in courses.values()]
    shares = " with it, ".join(f"{100.0 * share.mean():.1f} %" for share in unrest)
    harms = " with it, ".join(f"{course.harm.mean():.2f}" for course in courses.values())
    calmer = [Less.of_lists("", unrest[1], 0.5 * unrest[0])]  # without it, less than half of the deviation
    safer = [Less.of_lists("", sparse.harm, dense.harm)]
    text = f"deviation in the last quarter {shares} of the rise without"
    return [
        judge_trained("learning-curves/sparse", courses, calmer, text),
        judge_trained("learning-curves/terminal", courses, safer, f"harm {harms} without"),
    ]


def shapes(runs: Mapping[str, Sequence[Path]]) -> dict[str, list[bool]]:
    """Figs. 6 and 7: claim -> for each seed of which both policies are trained, whether it holds."""
    seeds: dict[str, list[bool]] = {}
    for both_runs in zip(runs["PPO"], runs["SAC"], strict=False):
        policies = dict(zip(("PPO", "SAC"), (f"policy@{run / 'policy'}" for run in both_runs), strict=True))
        records = trajectories.record_all(tuple(policies.items()))
        for name, (_, holds) in (trajectories.positions(records) | trajectories.commands(records)).items():
            seeds.setdefault(name, []).append(bool(holds))
    return seeds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--train", nargs="+", choices=GROUPS, default=[], help="groups to train first")
    arguments = parser.parse_args()
    train(arguments.folder, arguments.train)
    runs = {group: trained(arguments.folder, group) for group in GROUPS}
    claims = stopped_claims(runs[STOPPED]["DRL"]) if runs[STOPPED] else []
    claims += process_claims(runs[RANDOM])
    low, high, dense = ({name: Course.of(each) for name, each in runs[group].items()} for group in (LOW, HIGH, DENSE))
    claims += curve_claims(low, high) if {*low} == {*high} == {"PPO", "SAC"} else []
    claims += reward_claims(low["PPO"], dense["PPO"]) if low.keys() & dense.keys() else []
    for claim in claims:
        print(f"  {claim.name}:")
        for reading, result in claim.results.items():
            print(f'    {reading}: {{verdict: {result.verdict}, text: "{result.text}"}}')
    if {*runs[RANDOM]} == {"PPO", "SAC"}:
        print("seeds:")
        for name, holds in shapes(runs[RANDOM]).items():
            print(f"  {name}: {str(holds).lower()}")


if __name__ == "__main__":
    main()
