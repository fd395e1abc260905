"""Trainings by these algorithms: recipes, and going on to the same bits."""

import json
from pathlib import Path

import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.first_edition.evaluation.rollout import evaluate
from ethbrake_marl.first_edition.evaluation.summary import summarise
from ethbrake_marl.first_edition.training import session as train_module
from ethbrake_marl.first_edition.training.recipe import TrainingRecipe, load_recipe
from ethbrake_marl.first_edition.training.run_folder import RunDirectory
from tests.extensions.learners.tiny import EXPERTS, TINY_EXPERTS, TINY_ROLLOUTS, TINY_VINE
from tests.first_edition.learning.test_runs import (
    MIXTURE,
    Whole,
    check_one_update,
    check_resumed,
    measure,
    stop,
    trained_once,
)
from tests.first_edition.learning.test_teams import check_meanings, check_shipped
from tests.fixtures.policies import make_policy
from tests.refused import refused

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of those who read event files
SCENARIO = eb.load_scenario("paper-random")


GOAL = 1.10  # harm of the policy, in the least harm known


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_quick__ends_near_the_best_known_for_every_seed(seed: int, tmp_path: Path) -> None:
    result = train_module.train("quick", "paper-random", tmp_path / "run", seed=seed, on_progress=None)
    agents = {"last": eb.LearnedAgent(result.last_policy), "kept": eb.LearnedAgent(result.policy)}
    for row in summarise(evaluate(SCENARIO.sample(10_000, seed=7), agents, scenario=SCENARIO, aftermath=False)):
        assert row.first_impact_harm.value <= GOAL * row["best_known_first_impact_harm"].value


def test_recipe__tells_only_the_keys_that_it_has() -> None:
    told = TINY_VINE.model_dump(mode="json")
    assert {"focus", "experts"} & told.keys() == set()
    assert "initial_action" not in told["network"]
    assert TINY_VINE.replace(focus=0.75).model_dump(mode="json")["focus"] == 0.75


OF_THEIR_KIND = ("cooperation", "experts")  # others differ in numbers
RECIPES = [name for name, file in TrainingRecipe.shipped().items() if file.parent.name == "learners"]


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in OF_THEIR_KIND else pytest.mark.slow) for name in RECIPES]
)
def test_shipped_recipe__trains_for_one_update(name: str, tmp_path: Path) -> None:
    """By the fewest worlds whose decisions can be split into batches and tried."""
    recipe = load_recipe(name)
    most = max(recipe.batch_size, recipe.tried)
    check_one_update(recipe.replace(n_envs=-(-most // recipe.rounds)), tmp_path / "run")


@pytest.mark.parametrize("name", RECIPES)
def test_recipe__that_ships_comes_back_from_its_json_and_its_template_and_passes_the_schema(name: str) -> None:
    check_shipped(name)


@pytest.mark.parametrize("name", RECIPES)
def test_new_recipe__has_every_key_with_a_comment_and_the_same_values(name: str, tmp_path: Path) -> None:
    base, file = load_recipe(name), tmp_path / "mine.yaml"
    text = base.new_text("mine")
    file.write_text(text)
    words = {"name", "title", "description", "source"}
    assert load_recipe(file).model_dump(exclude=words) == base.model_dump(exclude=words)
    lines = text.splitlines()
    for key in type(base).model_fields:
        (number,) = (k for k, line in enumerate(lines) if line.removeprefix("# ").startswith(f"{key}:"))
        assert lines[number - 1].startswith("# "), key


@pytest.mark.parametrize("algorithm", ["vine", "rollout-classification"])
def test_schema__says_what_every_key_of_an_algorithm_means(algorithm: str) -> None:
    check_meanings(algorithm)


CHOOSING_POLICIES = {"policies": ["ppo", "sac"], "drawn": 2, "near": [], "focus": 0.5,
         "relative": True, "tie_break": 0.5, "observation": ["own", "front_1", "rear_1", "contact"]}  # fmt: skip
TRAININGS = {
    "vine": (TINY_VINE.replace(gradient_limit="auto"), SCENARIO),
    "experts": (TINY_EXPERTS, SCENARIO),
    "rollout-classification": (TINY_ROLLOUTS, SCENARIO),
    "policies": (TINY_ROLLOUTS.replace(**CHOOSING_POLICIES), MIXTURE),
    "scout": (TINY_EXPERTS.replace(focus=0.75, experts=EXPERTS | {"tie_break": 0.0}), SCENARIO),
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Whole:
    return trained_once(TRAININGS, tmp_path_factory)


@pytest.mark.parametrize(
    ("name", "at"),
    [
        *((name, ("update", 5)) for name in ("vine", "experts", "policies")),
        *(pytest.param(name, ("update", number), marks=pytest.mark.slow)
          for name, numbers in (("experts", (3, 7)), ("scout", (5,))) for number in numbers),  # in its other stages
    ],
    ids=str,
)  # fmt: skip
def test_resume__after_ctrl_c_everything_is_as_if_nobody_had_stopped_it(
    name: str, at: tuple[str, int], whole: Whole, tmp_path: Path
) -> None:
    check_resumed(TRAININGS[name], tmp_path / "run", at, *whole(name))


def test_resume__refuses_the_run_of_an_earlier_version_by_the_new_name(tmp_path: Path) -> None:
    run = RunDirectory(tmp_path / "run")
    stop(TRAININGS["experts"], run.path, ("update", 5))
    config = json.loads(run.config.read_text())
    config["recipe"]["algorithm"] = "counterfactual"
    run.write_json(run.config, config)
    with refused("algorithm = counterfactual: is now called vine"):
        train_module.resume(run.path, measure=measure)


def test_policy__of_an_earlier_version_has_the_new_name_of_its_algorithm(tmp_path: Path) -> None:
    make_policy(eb.ObservationSpec(), {"name": "paper-random"}, "counterfactual").save(tmp_path / "bundle")
    assert eb.load_policy(tmp_path / "bundle").manifest.algorithm == "vine"
