"""What sweeps, tunings, levels of cooperation and falsifications refuse."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

import ethbrake_marl as eb
from ethbrake_marl.errors import UnknownName
from ethbrake_marl.extensions.cooperation.levels import Level, common_worlds, with_scheme
from ethbrake_marl.extensions.studies.falsification import search
from ethbrake_marl.extensions.studies.sweep import SweepPlan
from ethbrake_marl.extensions.studies.tuning import TuningPlan
from ethbrake_marl.extensions.studies.weakness import Measure
from ethbrake_marl.scenario.catalogue import load_scenario
from ethbrake_marl.scenario.ranges import ranges
from tests.refused import refused

WRITTEN = """title: One mistake
scenario: paper-random
recipe: ppo
set:
  gamma: 0.9
  vf_coef: 0.5
search:
  learning_rate.start: {low: 0.001, high: 0.1}
  n_epochs: {low: 1, high: 4}
measure:
  worlds: 10
"""
RATE = {"low": 1e-4, "high": 1e-2, "log": True}


def plan(text: str = "", **changes: object) -> TuningPlan:
    """The tuning of the learning rate that a file says, with changes, or of this text."""
    content = {"scenario": "paper-random", "recipe": "ppo", "search": {"learning_rate.start": RATE}, **changes}
    Path("t.yaml").write_text(text or yaml.safe_dump(content))
    return TuningPlan.read(Path("t.yaml"))


TUNINGS: dict[str, Callable[[], object]] = {
    "t.yaml, line 3: search = {}: must not be empty": lambda: plan(search={}),
    "t.yaml: search: missing; this key is required; docs/extensions/studies.md shows an example": lambda: plan(
        "scenario: paper-random\nrecipe: ppo\n"
    ),
    "t.yaml, line 4: search: a trial with learning_rate.strat=0.0001 is not possible: recipe 'ppo'": lambda: plan(
        search={"learning_rate.strat": RATE}
    ),
    "must be whole numbers, written without a decimal": lambda: plan(search={"n_epochs": {"low": 1.0, "high": 4.0}}),
    "t.yaml, line 4: search.n_epochs = {high: 4, low: 4}: low (4) must be less than high (4)": lambda: plan(
        search={"n_epochs": {"low": 4, "high": 4}}
    ),
    "low (0) must be above 0, because log is true": lambda: plan(search={"gamma": {"low": 0, "high": 1, "log": True}}),
    "t.yaml, line 5: search.gamma.high = .nan: must be a finite number": lambda: plan(
        search={"gamma": {"low": 0.5, "high": float("nan")}}
    ),
    "t.yaml, line 4: search.gamma.high: missing; this key is required; docs/extensions/studies.md": lambda: plan(
        search={"gamma": {"low": 0.5}}
    ),
    "t.yaml, line 7: search.gamma.steps: unknown key": lambda: plan(
        search={"gamma": {"low": 0.5, "high": 0.9, "steps": 3}}
    ),
    "t.yaml, line 4: search.gamma = [0.5, 0.9]: must be a mapping": lambda: plan(search={"gamma": [0.5, 0.9]}),
    "t.yaml, line 5: search.gamma.choices = [0.9]: must have at least 2 entries": lambda: plan(
        search={"gamma": {"choices": [0.9]}}
    ),
    "t.yaml, line 4: search.gamma = {choices: [0.9, 0.9]}: the value 0.9 is listed twice": lambda: plan(
        search={"gamma": {"choices": [0.9, 0.9]}}
    ),
    "t.yaml, line 4: search: a trial with network.policy=[0] is not possible: recipe 'ppo': network": lambda: plan(
        search={"network.policy": {"choices": [[8], [0]]}}
    ),
    "t.yaml, line 4: search.seed: this key cannot be searched: a good seed is luck; give one seed for all": lambda: (
        plan(search={"seed": {"low": 0, "high": 9}})
    ),
    "t.yaml, line 4: search.evaluation.seed: this key cannot be searched: all trials are evaluated on": lambda: plan(
        search={"evaluation.seed": {"low": 0, "high": 9}}
    ),
    "t.yaml, line 4: search.total_steps: this key cannot be searched: all trials have the same number": lambda: plan(
        search={"total_steps": {"low": 100, "high": 900}}
    ),
    "t.yaml, line 4: search.reward.harm_count: this key cannot be searched: it defines the harm that": lambda: plan(
        search={"reward.harm_count": {"choices": ["first", "total"]}}
    ),
    "t.yaml, line 4: search.algorithm: this key cannot be searched: a recipe has the keys of one": lambda: plan(
        search={"algorithm": {"choices": ["ppo", "sac"]}}
    ),
    "t.yaml, line 4: search.mass_t: this is a key of the scenario, but only keys of the recipe": lambda: plan(
        search={"mass_t": {"low": 1, "high": 2}}
    ),
    "t.yaml, line 4: search.gamma: the file also sets gamma; delete one of the two keys": lambda: plan(
        search={"gamma": {"low": 0.5, "high": 0.9}}, set={"gamma": 0.9}
    ),
    "t.yaml, line 8: search.learning_rate.start: the file also sets learning_rate; delete one of": lambda: plan(
        search={"learning_rate.start": RATE, "learning_rate": {"choices": [1, 2]}}
    ),
    "search: a trial with offset.largest=0.1080873589761303, offset.smallest=0.16819777065410824": lambda: plan(
        recipe="quick",
        search={"offset.smallest": {"low": 0.01, "high": 0.2}, "offset.largest": {"low": 0.1, "high": 0.5}},
    ),
    "t.yaml, line 9: set.evaluation.worlds: this key is not allowed under set": lambda: plan(
        set={"evaluation.worlds": 3}
    ),
    "t.yaml, line 8: seed = -1: must be greater than or equal to 0": lambda: plan(seed=-1),
    "t.yaml, line 2: measure.world: unknown key; did you mean worlds?": lambda: plan(measure={"world": 10}),
    "t.yaml, line 2: prune.after_trials = -1: must be greater than or equal": lambda: plan(prune={"after_trials": -1}),
    "t.yaml, line 3: sampler.name = grid: must be tpe or random": lambda: plan(sampler={"name": "grid"}),
    "t.yaml, line 2: scenario 'cooperation-0-sensors' has no learner; give at least one vehicle the role": lambda: plan(
        WRITTEN.replace("paper-random", "cooperation-0-sensors", 1)
    ),
    "t.yaml, line 6: recipe 'ppo': vf_coef = -0.5: must be greater than or equal to 0": lambda: plan(
        WRITTEN.replace("vf_coef: 0.5", "vf_coef: -0.5", 1)
    ),
    "t.yaml, line 6: set.seed: this key is not allowed under set; to choose the seed and": lambda: plan(
        WRITTEN.replace("vf_coef: 0.5", "seed: 3", 1)
    ),
}


@pytest.mark.usefixtures("empty_folder")
@pytest.mark.parametrize("message", TUNINGS)
def test_tuning__is_refused_with_its_line(message: str) -> None:
    with refused(message):
        TUNINGS[message]()


NAMES: dict[str, Callable[[], object]] = {
    "t.yaml, line 4: unknown setting 'title'; did you mean 'table'?": lambda: plan(
        search={"title": {"choices": ["a", "b"]}}
    ),
    "t.yaml, line 2: unknown scenario 'paper-randon'; did you mean 'paper-random'?": lambda: plan(
        WRITTEN.replace("paper-random", "paper-randon", 1)
    ),
    "t.yaml, line 3: unknown recipe 'pppo'; did you mean 'ppo'?": lambda: plan(WRITTEN.replace("ppo", "pppo", 1)),
}


@pytest.mark.usefixtures("empty_folder")
@pytest.mark.parametrize("message", NAMES)
def test_name_in_a_tuning__is_unknown(message: str) -> None:
    with refused(message, UnknownName):
        NAMES[message]()


GRID = {"scenario": "paper-random", "recipe": "ppo"}
SWEPT = """title: One mistake
set:
  vf_coef: 0.4
grid:
  scenario: paper-random
  recipe:
  - ppo
  - ppo-paper
  set:
    gamma: [0.9]
    n_epochs: [2, 3]
jobs:
- scenario: cooperation-3-pair
  recipe: cooperation-ppo
  set: {scheme: shared}
"""


def sweep(content: Any) -> SweepPlan:
    """The sweep that a file with this content says."""
    Path("s.yaml").write_text(content if isinstance(content, str) else yaml.safe_dump(content))
    return SweepPlan.read(Path("s.yaml"))


SWEEPS: dict[str, Callable[[], object]] = {
    "s.yaml: the file requests 0 jobs; a sweep has from 1 to 10,000 jobs": lambda: sweep({}),
    "s.yaml, line 4: grid.seed = []: must not be empty": lambda: sweep({"grid": {**GRID, "seed": []}}),
    "must be a whole number, written without a decimal point": lambda: sweep({"grid": {**GRID, "seed": ["one"]}}),
    "s.yaml, line 5: grid.seed.cont: unknown key; did you mean count?": lambda: sweep(
        {"grid": {**GRID, "seed": {"cont": 2}}}
    ),
    "s.yaml, line 5: grid.set.gamma = 0.9: must be a list": lambda: sweep({"grid": {**GRID, "set": {"gamma": 0.9}}}),
    "s.yaml, line 5: grid.seed.count = 20000: must be less than or equal to 10000": lambda: sweep(
        {"grid": {**GRID, "seed": {"count": 20_000}}}
    ),
    "s.yaml: the file requests 10,001 jobs; a sweep has from 1 to 10,000 jobs": lambda: sweep(
        {"grid": {**GRID, "seed": {"count": 10_000}}, "jobs": [GRID]}
    ),
    "s.yaml, line 1: grid.scenario: missing; this key is required; docs/extensions/studies.md": lambda: sweep(
        {"grid": {"recipe": "ppo"}}
    ),
    "s.yaml, line 4: grid.sede: unknown key; did you mean seed?": lambda: sweep({"grid": {**GRID, "sede": [1]}}),
    "s.yaml, line 4: jobs[0].sets: unknown key; did you mean set?": lambda: sweep({"jobs": [{**GRID, "sets": {}}]}),
    "recipe 'ppo': reward.terminl: unknown key; did you mean terminal?": lambda: sweep(
        {"set": {"reward.terminl": 1}, "jobs": [GRID]}
    ),
    "the seed must not stand under set; write the key seed next to the key recipe": lambda: sweep(
        {"set": {"seed": 3}, "jobs": [GRID]}
    ),
    's.yaml, line 4: set = {"gamma=0.9, x": 3}: "gamma=0.9, x": a key must not contain': lambda: sweep(
        {"set": {"gamma=0.9, x": 3}, "jobs": [GRID]}
    ),
    "s.yaml, line 5: jobs[0] (paper-random, ppo, seed 0, =3): --set '=3': must be KEY=VALUE": lambda: sweep(
        {"set": {"": 3}, "jobs": [GRID]}
    ),
    "jobs[1] (paper-random, ppo, seed 0): this job trains the same policy as jobs[0] (paper-random": lambda: sweep(
        {"jobs": [GRID, {**GRID, "seed": 0}]}
    ),
    "grid (paper-random, ppo, seed 0): this job trains the same policy as grid (paper-random, ppo, seed 0)": lambda: (
        sweep({"grid": {**GRID, "seed": [0, 0]}})
    ),
    "jobs[1] (paper-random, ppo, seed 0, gamma=0.995): this job trains the same policy as jobs[0]": lambda: sweep(
        {"jobs": [GRID, {**GRID, "set": {"gamma": 0.995}}]}
    ),
    "scenario 'cooperation-0-sensors' has no learner; give at least one vehicle the role learner": lambda: sweep(
        {"jobs": [{"scenario": "cooperation-0-sensors", "recipe": "ppo"}]}
    ),
    "--set network.policy.9: '9' must be an index from 0 to 1": lambda: sweep(
        {"jobs": [GRID, {**GRID, "set": {"network.policy.9": 4}}]}
    ),
    "--set gamma.x: 'x' cannot be set inside 0.995, which is neither a mapping nor a": lambda: sweep(
        {"jobs": [GRID, {**GRID, "set": {"gamma.x": 4}}]}
    ),
    "s.yaml, line 1, column 45: key 'recipe' occurs twice; the first is on line 1": lambda: sweep(
        "grid: {scenario: paper-random, recipe: ppo, recipe: sac}\n"
    ),
    "s.yaml: must be a mapping with a grid or a list of jobs": lambda: sweep("- one\n"),
    "s.yaml, line 10: grid.set.vf_coef: the file sets vf_coef twice: here, and for all jobs": lambda: sweep(
        SWEPT.replace("gamma", "vf_coef", 1)
    ),
}


@pytest.mark.usefixtures("empty_folder")
@pytest.mark.parametrize("message", SWEEPS)
def test_sweep__is_refused_with_its_line_and_job(message: str) -> None:
    with refused(message):
        SWEEPS[message]()


SWEPT_NAMES: dict[str, Callable[[], object]] = {
    "s.yaml, line 5: jobs[0] (paper-random, sac, seed 0, n_epochs=3): unknown setting 'n_epochs'": lambda: sweep(
        {"jobs": [{**GRID, "recipe": "sac", "set": {"n_epochs": 3}}]}
    ),
    "s.yaml, line 5: grid (paper-randon, ppo, seed 0, vf_coef=0.4, gamma=0.9, n_epochs=2)": lambda: sweep(
        SWEPT.replace("paper-random", "paper-randon", 1)
    ),
    "s.yaml, line 8: grid (paper-random, ppo-papr, seed 0, vf_coef=0.4, gamma=0.9, n_epochs=2)": lambda: sweep(
        SWEPT.replace("ppo-paper", "ppo-papr", 1)
    ),
}


@pytest.mark.usefixtures("empty_folder")
@pytest.mark.parametrize("message", SWEPT_NAMES)
def test_name_in_a_sweep__is_unknown(message: str) -> None:
    with refused(message, UnknownName):
        SWEPT_NAMES[message]()


PAPER = load_scenario("paper-random")
LEVEL_2 = load_scenario("cooperation-2-paper")


def compare(**changes: object) -> None:
    """Level 2 of cooperation beside one that differs from it in the vehicle that learns, and in this."""
    mine = LEVEL_2.replace(name="mine", roles={"vehicle_3": "learner"}, **changes)
    common_worlds([Level(LEVEL_2), Level(mine)], 5, 7)


LEVELS: dict[str, Callable[[], object]] = {
    "level 'mine': mass_t is 4.5, 5.5, 6, but 4.5, 5.5": lambda: compare(mass_t=[4.5, 5.5, 6]),
    "level 'mine': restitution is 0.2, but 0.1 at level 'cooperation-2-paper'": lambda: compare(restitution=0.2),
    "level 'mine': latency_s is 0, 0.5, 0.9, but 0, 0.5, 0.8": lambda: compare(latency_s=[0, 0.5, 0.9]),
    "level 'mine': its observation differs from the observation of level": lambda: compare(observation=["own"]),
    "recipe 'cooperation-ppo': turns = 5: is allowed with scheme: independent only": lambda: with_scheme(
        eb.load_recipe("cooperation-ppo").replace(scheme="independent", turns=5), "shared"
    ),
}


@pytest.mark.parametrize("message", LEVELS)
def test_levels__are_compared_on_the_same_lines(message: str) -> None:
    with refused(message):
        LEVELS[message]()


def test_levels__may_differ_in_roles_objective_obstacle_and_channel_alone() -> None:
    roles = {"vehicle_1": "learner", "vehicle_3": "coast"}
    free = LEVEL_2.replace(name="mine", roles=roles, objective="own", obstacle_gap_m=42, v2x="blocked")
    late = LEVEL_2.replace(name="late", v2x="blocked")
    assert len(common_worlds([Level(LEVEL_2), Level(free), Level(late)], 5, 7)) == 3
    with refused("level 'late': latency_s is 0, 0.5, 0.9, but 0, 0.5, 0.8 at level 'mine'"):
        common_worlds([Level(LEVEL_2), Level(free), Level(late.replace(latency_s=[0, 0.5, 0.9]))], 5, 7)


FALSIFICATIONS: dict[str, Callable[[], object]] = {
    "scenario 'mixture-delays': is a mixture; use one of its scenarios: paper-delay-low": lambda: ranges(
        load_scenario("mixture-delays")
    ),
    "scenario 'cooperation-2-blocked': its v2x channel has delays and losses, which a table of worlds": lambda: ranges(
        load_scenario("cooperation-2-blocked")
    ),
    "scenario 'paper-scenario-1': no quantity is random, so all its worlds are the same": lambda: ranges(
        load_scenario("paper-scenario-1")
    ),
    "--against coast: --measure harm uses no second agent; leave --against out": lambda: Measure.of(
        "harm", "full_brake", "coast", PAPER, "first"
    ),
    "--measure difference compares two agents; give the second agent with --against AGENT": lambda: Measure.of(
        "difference", "full_brake", None, PAPER, "first"
    ),
    "agent 'full_brake' is listed twice; list each agent once": lambda: Measure.of(
        "regret", "full_brake", "full_brake", PAPER, "first"
    ),
    "agent 'full_brake' has no shield, but --measure bound compares the harm with the": lambda: Measure.of(
        "bound", "full_brake", None, PAPER, "first"
    ).falsify(10, 0),
    "search: budget = 0: must be a whole number, at least 1": lambda: search(lambda points: points[:, 0], 2, 0, 0),
    "search: seed = -1: must be a whole number, at least 0": lambda: search(lambda points: points[:, 0], 2, 10, -1),
}


@pytest.mark.parametrize("message", FALSIFICATIONS)
def test_falsification__is_refused(message: str) -> None:
    with refused(message):
        FALSIFICATIONS[message]()
