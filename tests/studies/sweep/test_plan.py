"""The file of a sweep: what it comes to, and what is refused before anything is begun."""

from __future__ import annotations

from pathlib import Path

import pytest

from ethbrake_marl.errors import InvalidInput, UnknownName
from ethbrake_marl.learning.training import Training
from ethbrake_marl.studies.sweep import SweepPlan

DOCS = Path(__file__).resolve().parents[3] / "docs"
GRID = {"scenario": "paper-random", "recipe": "ppo"}


def test_grid__is_every_combination_seed_by_seed(write_sweep):
    grid = {
        "scenario": ["cooperation-2-paper", "cooperation-3-pair"],
        "recipe": ["ppo", "sac"],
        "seed": {"first": 4, "count": 2},
    }
    plan = SweepPlan.read(write_sweep(set={"total_steps": 100}, grid={**grid, "set": {"mass_t": [5, 6]}}))
    assert len(plan.rows) == len({row.identity for row in plan.rows}) == 16
    assert [row.asked.seed for row in plan.rows] == [4] * 8 + [5] * 8
    assert plan.rows[1].asked.settings == ("total_steps=100", "mass_t=6")
    assert plan.rows[1].asked.scenario == "cooperation-2-paper"
    assert [*plan.rows[1].settings] == ["total_steps", "mass_t"] and {
        row.first.recipe.total_steps for row in plan.rows
    } == {100}


def test_rows__have_the_hash_that_their_trainings_have(write_sweep):
    listed = [{"scenario": "paper-distance", "recipe": "sac", "seed": 9, "set": {"network.policy": [8, 8]}}]
    plan = SweepPlan.read(write_sweep(grid={**GRID, "seed": [0, 2**32 - 1]}, jobs=listed))
    for row in plan.rows:
        training = plan.training(row)
        assert training.identity == row.identity and training.recipe.seed == row.asked.seed
        assert Training.of(training.recipe, training.scenario).identity == row.identity
    assert plan.training(plan.rows[2]).recipe.network.policy == (8, 8)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ({}, "asks for 0 jobs"),
        ({"grid": {**GRID, "seed": []}}, r"line 4: grid\.seed = \[\]: must not be empty$"),
        ({"grid": {**GRID, "seed": ["one"]}}, r"grid\.seed\[0\] = one: must be a whole number"),
        ({"grid": {**GRID, "seed": {"cont": 2}}}, r"grid\.seed\.cont: unknown key; did you mean count\?$"),
        ({"grid": {**GRID, "scenario": []}}, "grid.scenario = .*: must not be empty"),
        ({"grid": {**GRID, "set": {"gamma": []}}}, "grid.set.gamma = .*: must not be empty"),
        ({"grid": {**GRID, "set": {"gamma": 0.9}}}, "grid.set.gamma = 0.9: must be a list"),
        (
            {"grid": {**GRID, "seed": {"count": 2_000_000}}},
            "grid.seed.count = 2000000: must be less than or equal to 200000",
        ),
        ({"grid": {**GRID, "seed": {"count": 200_000}}, "jobs": [GRID]}, "asks for 200,001 jobs"),
        ({"grid": {**GRID, "recipe": "pppo"}}, "unknown recipe 'pppo'; did you mean 'ppo"),
        ({"grid": {**GRID, "scenario": "paper-randon"}}, "unknown scenario 'paper-randon'"),
        ({"grid": {"recipe": "ppo"}}, "grid.scenario: missing"),
        ({"grid": {"scenario": "paper-random"}}, "grid.recipe: missing"),
        ({"grid": {**GRID, "sede": [1]}}, "grid.sede: unknown key; did you mean seed"),
        ({"jobs": [{**GRID, "sets": {}}]}, "sets: unknown key; did you mean set"),
        ({"gird": GRID}, "gird: unknown key; did you mean grid"),
        ({"grid": {**GRID, "set": {"gama": [0.9]}}}, "unknown setting 'gama'"),
        ({"jobs": [{**GRID, "recipe": "sac", "set": {"n_epochs": 3}}]}, r"jobs\[0\] .*unknown setting 'n_epochs'"),
        ({"set": {"reward.terminl": 1}, "jobs": [GRID]}, r"reward\.terminl: unknown key"),
        ({"set": {"seed": 3}, "jobs": [GRID]}, "seed is no setting here"),
        ({"set": {"gamma=0.9, x": 3}, "jobs": [GRID]}, "a key has no = in it"),
        ({"set": {"": 3}, "jobs": [GRID]}, "must be KEY=VALUE"),
        ({"set": {"scenario.seed": 3}, "jobs": [GRID]}, "unknown setting 'seed'"),
        ({"set": {"gamma": 0.9}, "grid": {**GRID, "set": {"gamma": [0.8]}}}, "stands in the file's own set too"),
        ({"jobs": [GRID, {**GRID, "seed": 0}]}, r"jobs\[1\] \(.*\): is the same training as jobs\[0\]"),
        ({"grid": {**GRID, "seed": [0, 0]}}, "is the same training as grid"),
        ({"jobs": [GRID, {**GRID, "set": {"gamma": 0.995}}]}, "is the same training"),  # the recipe's own value
        (
            {"jobs": [{"scenario": "cooperation-0-sensors", "recipe": "ppo"}]},
            r"jobs\[0\] \(cooperation-0-sensors, ppo, seed 0\)",
        ),
    ],
)
def test_bad_files__are_refused(write_sweep, content, reason):
    with pytest.raises(InvalidInput, match=reason):
        SweepPlan.read(write_sweep(**content))


WRITTEN = """title: One mistake
set:
  vf_coef: 0.4
grid:
  scenario: paper-random
  recipe:
  - ppo
  - ppo-total
  set:
    gamma: [0.9]
    n_epochs: [2, 3]
jobs:
- scenario: cooperation-3-pair
  recipe: cooperation-ppo
  set: {scheme: shared}
"""


@pytest.mark.parametrize(
    ("old", "new", "line", "reason"),
    [
        ("vf_coef: 0.4", "vf_coef: -1", 3, r"grid \(.*\): .*vf_coef = -1: must be greater"),
        ("paper-random", "paper-randon", 5, r"grid \(.*\): unknown scenario 'paper-randon'"),
        ("paper-random", "cooperation-0-sensors", 4, r"grid \(.*\): .*no vehicle learns"),
        ("ppo-total", "ppo-totl", 8, r"grid \(.*\): unknown recipe 'ppo-totl'"),
        ("gamma", "gama", 10, "unknown setting 'gama'"),
        ("gamma", "vf_coef", 10, "grid.set.vf_coef: stands in the file's own set too"),
        ("[2, 3]", "[2, 0]", 11, "n_epochs = 0: must be greater"),
        ("cooperation-3-pair", "cooperation-9-pair", 13, r"jobs\[0\] \(.*\): unknown scenario 'cooperation-9-pair'"),
        ("scheme: shared", "scheme: sharde", 15, "scheme = sharde: must be"),
        ("scheme: shared", "vf_coef: 1", 15, r"jobs\[0\].set.vf_coef: stands in"),
        ("[2, 3]", "[2, 2]", 4, r"grid \(.*\): is the same training as grid"),
    ],
)
def test_bad_files__are_refused_with_file_and_line(tmp_path, old, new, line, reason):
    path = tmp_path / "mine.yaml"
    path.write_text(WRITTEN)
    SweepPlan.read(path)
    path.write_text(WRITTEN.replace(old, new, 1))
    with pytest.raises(InvalidInput, match=f"^{path}, line {line}: (?!.*, line ).*{reason}"):
        SweepPlan.read(path)


def test_example__of_the_page_is_in_order():
    plan = SweepPlan.read(DOCS / "sweep-example.yaml")
    assert len(plan.rows) == 42 and {row.first.recipe.total_steps for row in plan.rows} == {200_000}
    assert (DOCS / "sweep-example.yaml").read_text("utf-8") in (DOCS / "scaling.md").read_text("utf-8")


def test_bad_files__are_refused_as_what_they_are(write_sweep, tmp_path):
    with pytest.raises(UnknownName):
        SweepPlan.read(write_sweep(jobs=[{**GRID, "recipe": "none"}]))
    twice = tmp_path / "twice.yaml"
    twice.write_text("grid: {scenario: paper-random, recipe: ppo, recipe: sac}\n")
    with pytest.raises(InvalidInput, match=r"line 1, column .*: key 'recipe' is given twice"):
        SweepPlan.read(twice)
    twice.write_text("- one\n")
    with pytest.raises(InvalidInput, match="must be a mapping with a grid or a list of jobs"):
        SweepPlan.read(twice)
