"""The vector environment: ends at a limit of steps, descriptions of its worlds."""

import numpy as np
import pytest

from ethbrake_marl.faces.vector import EthBrakeVectorEnv

BRAKE = np.full((3, 1), -1.0)


def ends(env: EthBrakeVectorEnv, steps: int) -> tuple[list[bool], list[bool]]:
    """Brake fully for so many steps; return which worlds the last one terminated and truncated."""
    env.reset(seed=7)
    for _ in range(steps):
        _, _, terminated, truncated, _ = env.step(BRAKE)
    return terminated.tolist(), truncated.tolist()


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_limit_of_steps__truncates_also_an_episode_that_it_ends_with(mode: str) -> None:
    free = EthBrakeVectorEnv(3, autoreset_mode=mode)
    last = next(k for k in range(1, 80) if any(ends(free, k)[0]))
    terminated, truncated = ends(free, last)
    assert any(terminated) and not any(truncated)
    assert ends(EthBrakeVectorEnv(3, autoreset_mode=mode, max_episode_steps=last), last) == (terminated, [True] * 3)


def test_description__has_columns_that_only_some_of_the_worlds_have() -> None:
    env = EthBrakeVectorEnv(4, "mixture-universal")
    env.reset(seed=2)
    worlds = env.describe_worlds()
    assert worlds["world"].tolist() == [0, 1, 2, 3] and worlds["world_seed"].tolist() == [2] * 4
    assert worlds["vehicle_1_type"].tolist() == ["", "", "", "equipped"]
    assert np.isnan(worlds["obstacle_gap_m"]).tolist() == [False, True, False, True]
    assert worlds["scenario"].shape == (4,)


def test_description__of_a_world_of_a_list_has_its_friction() -> None:
    env = EthBrakeVectorEnv(2, "engineering-wet-road")
    env.reset(seed=2, options={"listed_world": {"seed": 7, "number": 3}})
    worlds = env.describe_worlds()
    drawn = env.scenario.draw(2, 7, first=3)
    assert worlds["friction"].tolist() == drawn.friction.tolist() and worlds["world"].tolist() == [-1, -1]
