"""The file of a tuning: what it comes to, and what is refused before any trial begins."""

from __future__ import annotations

from pathlib import Path

import pytest

from ethbrake_marl.cli.app import run_command
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.learning.training import TrainingRecipe
from ethbrake_marl.studies.sweep import TuningPlan

DOCS = Path(__file__).resolve().parents[3] / "docs"
RATE = {"low": 1e-4, "high": 1e-2, "log": True}


def searching(**search):
    return {"search": {key.replace("__", "."): value for key, value in search.items()}}


WHOLE = "must be whole numbers, written without a decimal point"
BAD = [
    ({"search": {}}, r"search = .*: must not be empty"),
    ({"search": "-"}, "search: missing; it is needed; docs/tuning.md shows an example"),
    ({"serach": {}}, "serach: unknown key; did you mean search"),
    ({"recipe": "pppo"}, "unknown recipe 'pppo'"),
    ({"scenario": "paper-randon"}, "unknown scenario 'paper-randon'"),
    ({"scenario": "cooperation-0-sensors"}, "no vehicle learns"),
    (searching(gama=RATE), "unknown setting 'gama'"),
    (searching(learning_rate__strat=RATE), "learning_rate.strat: unknown key"),
    (
        searching(gamma={"low": 0.9, "high": 1.5}),
        "search, at gamma=1.5: .*gamma = 1.5: must be less than or equal to 1",
    ),
    (searching(n_epochs={"low": 0, "high": 4}), "search, at n_epochs=0: .*must be greater than or equal to 1"),
    *(
        (searching(n_epochs={"low": low, "high": high}), rf"search.n_epochs = \{{low: {low}, high: {high}\}}: {WHOLE}")
        for low, high in ((1.0, 4.0), (1.5, 4), (1, 4.0))
    ),
    (searching(n_epochs={"low": 4, "high": 4}), r"n_epochs = \{.*\}: low 4 must be less than high 4"),
    (searching(gamma={"low": 0, "high": 1, "log": True}), "low 0 must be greater than 0"),
    (searching(gamma={"low": 0.5, "high": float("nan")}), "gamma.high = .nan: must be a finite number"),
    (searching(gamma={"low": 0.5}), "gamma.high: missing"),
    (searching(gamma={"low": 0.5, "high": 0.9, "steps": 3}), "gamma.steps: unknown key"),
    (searching(gamma=[0.5, 0.9]), "gamma"),
    (searching(gamma={"choices": [0.9]}), "gamma.choices"),
    (searching(gamma={"choices": [0.9, 0.9]}), "0.9 stands there twice"),
    (searching(network__policy={"choices": [[8], [0]]}), r"search, at network.policy=\[0\]: .*must be greater"),
    (searching(seed={"low": 0, "high": 9}), "search.seed: is not searched: a seed is luck"),
    (searching(evaluation__seed={"low": 0, "high": 9}), "search.evaluation.seed: is not searched"),
    (searching(total_steps={"low": 100, "high": 900}), "same number of decisions"),
    (searching(reward__harm_count={"choices": ["first", "total"]}), "says which harm is least"),
    (searching(algorithm={"choices": ["ppo", "sac"]}), "each algorithm has a recipe of its own"),
    (searching(mass_t={"low": 1, "high": 2}), "is the scenario's"),
    (searching(title={"choices": ["a", "b"]}), "unknown setting 'title'"),
    ({**searching(gamma={"low": 0.5, "high": 0.9}), "set": {"gamma": 0.9}}, "gamma stands there too"),
    (
        searching(learning_rate__start=RATE, learning_rate={"choices": [1, 2]}),
        "learning_rate stands there too; leave one of them out",
    ),
    ({"set": {"evaluation.worlds": 3}}, "set.evaluation.worlds: is no setting here"),
    ({"set": {"seed": 3}}, "set.seed: is no setting here"),
    ({"set": {"gama": 3}}, "unknown setting 'gama'"),
    ({"seed": -1}, "seed = -1"),
    ({"measure": {"world": 10}}, "measure.world: unknown key; did you mean worlds"),
    ({"measure": {"times": 0}}, "measure.times = 0"),
    ({"prune": {"keep": 1.0}}, "prune.keep = 1"),
    ({"sampler": {"name": "grid"}}, "sampler.name = grid: must be tpe or random"),
]


@pytest.mark.parametrize(("changes", "reason"), BAD)
def test_bad_files__are_refused(write_tuning, changes, reason):
    with pytest.raises(InvalidInput, match=reason):
        TuningPlan.read(write_tuning(**changes))


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


@pytest.mark.parametrize(
    ("old", "new", "line", "reason"),
    [
        ("paper-random", "paper-randon", 2, "unknown scenario 'paper-randon'; did you mean 'paper-random"),
        ("paper-random", "cooperation-0-sensors", 2, "no vehicle learns"),
        ("ppo", "pppo", 3, "unknown recipe 'pppo'"),
        ("gamma", "gama", 5, "unknown setting 'gama'"),
        ("vf_coef: 0.5", "vf_coef: -0.5", 6, "vf_coef = -0.5: must be greater"),
        ("vf_coef: 0.5", "seed: 3", 6, "set.seed: is no setting here"),
        ("learning_rate.start", "learning_rate", 8, "search, at learning_rate=0.001"),
        ("learning_rate.start", "gamma", 8, "search.gamma: gamma stands there too"),
        ("n_epochs", "n_epoch", 9, "unknown setting 'n_epoch'; did you mean 'n_epochs'"),
        ("low: 1,", "low: 1.0,", 9, WHOLE),
        ("low: 1,", "low: 0,", 9, "search, at n_epochs=0: .*must be greater than or equal to 1"),
        ("n_epochs: {low: 1, high: 4}", "seed: {low: 1, high: 4}", 9, "search.seed: is not searched"),
        ("worlds: 10", "worlds: 10.0", 11, "measure.worlds = 10.0: must be a whole number"),
    ],
)
def test_bad_files__are_refused_with_file_and_line(tmp_path, old, new, line, reason):
    path = tmp_path / "mine.yaml"
    path.write_text(WRITTEN.replace(old, new, 1))
    with pytest.raises(InvalidInput, match=f"^{path}, line {line}: (?!.*, line ).*{reason}"):
        TuningPlan.read(path)


def test_bad_files__without_their_mistake_are_planned(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(WRITTEN)
    TuningPlan.read(path)


@pytest.mark.parametrize("changes", [{"recipe": "pppo"}, searching(gama=RATE), {"prune": 1}])
def test_bad_files__begin_no_trial_and_make_nothing(write_tuning, tmp_path, changes):
    file = write_tuning(**changes)
    assert run_command(["study", "tune", str(file), "--output", str(tmp_path / "new")]) == 2
    assert [*tmp_path.iterdir()] == [file]


def test_space__parts_of_which_no_recipe_allows_are_refused(write_tuning):
    search = {"offset.smallest": {"low": 0.01, "high": 0.2}, "offset.largest": {"low": 0.1, "high": 0.5}}
    with pytest.raises(InvalidInput, match=r"search, at offset.*, offset.*: must be at least smallest"):
        TuningPlan.read(write_tuning(recipe="quick", search=search))


def test_every_trial__is_measured_as_often_whatever_an_update_holds(write_tuning):
    file = write_tuning(recipe="ppo", search={"n_envs": {"choices": [16, 128, 256]}}, measure={"times": 7, "seed": 3})
    plan = TuningPlan.read(file)
    for n_envs in (16, 128, 256):
        recipe = plan.training({"n_envs": n_envs}).recipe
        updates, every = plan.updates(recipe), recipe.evaluation.every_updates
        assert (recipe.evaluation.seed, recipe.seed, recipe.n_envs) == (3, 0, n_envs)
        steps = [7 * update // updates for update in {*range(0, updates, every), updates}]
        assert len(set(steps)) == len(steps) and 6 <= len(steps) <= 8 and max(steps) == 7


def test_own_values__are_the_recipes_where_the_space_has_them(write_tuning):
    search = {"network.policy": {"choices": [[9], [8]]}, "vf_coef": {"low": 0, "high": 1.0}}
    file = write_tuning(search=search)
    assert TuningPlan.read(file).own_values() == {"network.policy": [8], "vf_coef": 0.5}
    file = write_tuning(search={"gamma": {"low": 0, "high": 1}})  # whole numbers alone, and the recipe has 0.995
    assert TuningPlan.read(file).own_values() is None
    file = write_tuning(search={"max_grad_norm": {"low": 0.6, "high": 0.9}})
    assert TuningPlan.read(file).own_values() is None


def test_identity__is_that_of_all_that_changes_a_trial(write_tuning):
    def identity(**changes):
        return str(TuningPlan.read(write_tuning(**changes)).question)

    same = identity()
    assert identity(title="words") == same
    others = [{"seed": 1}, {"set": {"mass_t": 9}}, {"measure": {"seed": 12}}, {"prune": None}, {"sampler": {"seed": 1}}]
    assert len({same, *(identity(**changes) for changes in others)}) == len(others) + 1


@pytest.mark.parametrize("name", ["tuning-quick", "tuning-ppo"])
def test_shipped_spaces__are_in_order_and_hold_their_recipe(name):
    plan = TuningPlan.read(DOCS / f"{name}.yaml")
    assert plan.own_values() is not None and plan.file.recipe in TrainingRecipe.shipped()
    assert (DOCS / f"{name}.yaml").read_text("utf-8") in (DOCS / "tuning.md").read_text(
        "utf-8"
    ) or name != "tuning-quick"
