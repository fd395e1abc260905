"""``reset(options={"listed_world": ...})``: a world of the list on which agents are evaluated, in every interface."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.errors import InvalidInput
from tests.contract.interfaces import PAPER

LISTED = PAPER.sample(3, 7, first=40).worlds


def wanted(seed: Any = 7, number: Any = 40) -> dict[str, Any]:
    return {"listed_world": {"seed": seed, "number": number}}


def test_reset__starts_in_the_listed_world_and_goes_on_in_the_stream() -> None:
    env, stream = eb.EthBrakeEnv(PAPER), eb.EthBrakeEnv(PAPER)
    _, info = env.reset(seed=5, options=wanted())
    assert np.array_equal(env.engine.worlds.vehicles.latency_s, LISTED.vehicles.latency_s[:1])
    assert (info["world_seed"], info["world"]) == (5, -1)
    record = eb.evaluate(LISTED.take([0]), {"coast": eb.make_agent("coast")}, scenario=PAPER).outcome("coast")
    while True:
        _, _, terminated, truncated, info = env.step([0.0])
        if terminated or truncated:
            break
    assert info["world_total_harm"] == record.total_harm[0]
    assert np.array_equal(env.reset()[0], stream.reset(seed=5)[0])


def test_reset__of_a_batch_starts_in_the_worlds_that_follow() -> None:
    batch = eb.EthBrakeVectorEnv(3, PAPER)
    parallel = eb.parallel_env(scenario=PAPER)
    seen, _ = batch.reset(seed=1, options=wanted())
    for k in range(3):
        alone, _ = parallel.reset(options=wanted(number=np.int64(40 + k)))
        assert np.array_equal(alone["vehicle_2"], seen[k])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"listed_world": 3},
            r"listed_world = 3: must name a world of a list, for instance \{'seed': 7, 'number': 3\}",
        ),
        ({"listed_world": {"seed": 7}}, "must name a world of a list"),
        (wanted(number=-1), "listed_world: number = -1: must be a whole number"),
        (wanted(seed=0.5), "listed_world: seed = 0.5: must be a whole number"),
        (wanted() | {"initial_state": {"gaps_m": 7}}, "both given"),
    ],
)
def test_reset__a_world_that_is_none_is_refused(options: dict[str, Any], message: str) -> None:
    env = eb.EthBrakeEnv(PAPER)
    with pytest.raises(InvalidInput, match=message):
        env.reset(options=options)


def test_options__of_rows_do_not_know_it() -> None:
    env = eb.make_sb3_vec_env(PAPER, 2)
    env.set_options([wanted()] * 2)
    with pytest.warns(UserWarning, match="unknown option listed_world, ignored; known: initial_state"):
        env.reset()
