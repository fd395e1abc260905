"""The limits of a recipe's values: what lies on a limit is accepted, the next number beyond it is refused."""

from __future__ import annotations

import math
from typing import Any

import pytest

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.training.recipe import PpoRecipe, SacRecipe, TrainingRecipe
from tests.training.tiny import TINY, TINY_SAC

LEAST = math.nextafter(0.0, 1.0)  # above 0
MOST = 1.7976931348623157e308


def over(value: float) -> float:
    return math.nextafter(value, math.inf)


UNIT = ([0.0, 1.0], [-LEAST, over(1.0)])
SHARE = ([LEAST, 1.0], [0.0, over(1.0)])
ABOVE = ([LEAST, MOST], [0.0, -LEAST, math.inf])
ANY = ([0.0, MOST], [-LEAST, math.inf, math.nan])
COUNT = ([1], [0, -1])

# place of a value -> accepted values, refused values
OF_ALL: dict[str, tuple[list[Any], list[Any]]] = {
    "total_steps": COUNT,
    "checkpoint_every_updates": COUNT,
    "seed": ([0, 2**32 - 1], [-1, 2**32]),
    "gamma": UNIT,
    "learning_rate.start": SHARE,
    "learning_rate.end": SHARE,
    "evaluation.every_updates": COUNT,
    "evaluation.worlds": ([1, 1_000_000], [0, 1_000_001]),
    "evaluation.seed": ([0], [-1]),
    "network.policy": ([[1], [4096], [1] * 8], [[], [0], [4097], [1] * 9]),
    "network.value": ([[1], [4096], [1] * 8], [[], [0], [4097], [1] * 9]),
    **{f"reward.{name}": ANY for name in ("collision", "risk", "jerk", "terminal", "push", "drove", "still_moving")},
    **{f"reward.{name}": ANY for name in ("shaping", "safety_buffer_m", "target_gap_m")},
    **{f"reward.{name}": ABOVE for name in ("ttc_scale_s", "distance_slope_per_m")},
    "reward.harm": ([LEAST, MOST], [-LEAST, math.inf]),
    "reward.k_energy": ([0.0, MOST, [0.0, 1.0]], [-LEAST, math.inf, [], [1.0, -LEAST]]),
    "reward.shaping_discount": SHARE,
}
OF_PPO: dict[str, tuple[list[Any], list[Any]]] = {
    "n_envs": ([1, 2**20], [0, 2**20 + 1]),  # with 16 steps: 2^24 decisions
    "n_steps": ([2, 2**21], [1, 2**21 + 1]),  # of 8 worlds
    "batch_size": ([2, 128], [1, 3, 129]),  # 128 decisions
    "n_epochs": ([1, 1000], [0, 1001]),
    "gae_lambda": UNIT,
    "clip_range": SHARE,
    "ent_coef": ANY,
    "vf_coef": ANY,
    "max_grad_norm": ABOVE,
    "target_kl": ABOVE,
    "network.initial_log_std": ([-10.0, 2.0], [math.nextafter(-10.0, -11.0), over(2.0)]),
}
OF_SAC: dict[str, tuple[list[Any], list[Any]]] = {
    "n_envs": ([1, 300], [0, 301]),  # of 300 decisions in memory
    "batch_size": ([2], [1]),
    "steps_per_update": ([1, 10_000], [0, 10_001]),
    "gradient_steps": ([1, 100_000], [0, 100_001]),
    "buffer_size": ([8, 10_000_000], [7, 10_000_001]),  # of 8 worlds
    "learning_starts": ([0], [-1]),
    "tau": SHARE,
    "ent_coef": ([0.0, MOST, "auto"], [-LEAST, math.inf, math.nan, "automatic", True]),
    "initial_ent_coef": ABOVE,
    "target_entropy": ([-MOST, MOST], [math.inf, -math.inf]),
    "target_update_interval": COUNT,
    "log_every_updates": COUNT,
}
UNSHAPED = TINY.replace(batch_size=2, reward={"harm": 0.05})  # a discount of shaping would limit gamma
CASES = [
    *((UNSHAPED, place, each) for place, each in (OF_ALL | OF_PPO).items()),
    *((TINY_SAC, place, each) for place, each in (OF_ALL | OF_SAC).items() if place in OF_SAC or "network" in place),
]


def accepts(recipe: TrainingRecipe, place: str, value: Any) -> bool:
    key, _, inside = place.partition(".")
    whole = {**recipe.model_dump(mode="json")[key], inside: value} if inside else value
    try:
        recipe.replace(**{key: whole})
    except InvalidInput:
        return False
    return True


@pytest.mark.parametrize(("recipe", "place", "values"), CASES, ids=lambda each: each if isinstance(each, str) else "")
def test_value__at_its_limit_is_accepted_and_beyond_it_is_refused(
    recipe: TrainingRecipe, place: str, values: tuple[list[Any], list[Any]]
) -> None:
    for each, right in zip(values, (True, False), strict=True):
        assert [accepts(recipe, place, value) for value in each] == [right] * len(each), each


WORDS = {"name", "title", "description", "source", "algorithm", "scheme", "observation", "horizon_is_end", "scenario"}


@pytest.mark.parametrize(("recipe", "own"), [(PpoRecipe, OF_PPO), (SacRecipe, OF_SAC)])
def test_limits__are_those_of_all_numbers(recipe: type[TrainingRecipe], own: dict[str, Any]) -> None:
    assert {place.partition(".")[0] for place in OF_ALL | own} == recipe.model_fields.keys() - WORDS
