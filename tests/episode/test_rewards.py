"""Rewards by hand, and settings that a reward takes or refuses."""

from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.episode.reward import RewardParams
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.worlds.game import game_of


@pytest.mark.parametrize("objective", ["weighted:1,4,1", "social:45", "injury:lr4s", ["own", "total", "maximin"]])
def test_objective__is_taken_by_name_or_for_each_vehicle(objective: str | list[str]) -> None:
    game_of("paper-random", reward={"harm": 1.0, "objective": objective})
    RewardParams(harm=1.0, objective=objective if isinstance(objective, str) else tuple(objective))


def test_objective__needs_as_many_weights_as_there_are_vehicles() -> None:
    with pytest.raises(InvalidInput, match="has 2 weights; must have 3"):
        game_of("paper-random", reward={"harm": 1.0, "objective": "weighted:1,4"})
    with pytest.raises(InvalidInput, match="objective 'weighted:0,0'"):
        game_of("paper-random", reward={"harm": 1.0, "objective": "weighted:0,0"})


def test_objectives__share_the_harm_of_an_impact_as_written() -> None:
    # the pairs of masses 4.5, 5.5 and 5.9 t have harm h1, h2: the front one of a pair bears the share of the rear mass
    kinds = ["total", "own", "social:90", "maximin", "mass-weighted", "weighted:1,4,1"]
    games = [game_of("paper-random", reward={"harm": 1.0, "objective": kind})[1] for kind in kinds]
    state = games[0].start(40, 7, 0)
    masses = np.array([4.5, 5.5, 5.9])
    seen = 0
    while not state.ended.all():
        after, _ = games[0].step(state, np.full((40, 1), -0.3))
        h1, h2 = (after.line[:, 4, 1:3] - state.line[:, 4, 1:3]).T
        borne = np.stack([5.5 / 10.0 * h1, 4.5 / 10.0 * h1 + 5.9 / 11.4 * h2, 5.5 / 11.4 * h2], axis=1)
        ever = np.stack([after.borne_harm(), state.borne_harm()])
        expected = {
            "total": borne.sum(axis=1),
            "own": borne[:, 1],
            "social:90": borne[:, 0] + borne[:, 2],
            "maximin": np.subtract(*ever.max(axis=2)),
            "mass-weighted": 3.0 * borne @ masses / masses.sum(),
            "weighted:1,4,1": 3.0 * borne @ np.array([1.0, 4.0, 1.0]) / 6.0,
        }
        for game, kind in zip(games, kinds, strict=True):
            found = game.step(state, np.full((40, 1), -0.3))[1].reward[:, 1]
            np.testing.assert_allclose(found, -expected[kind], rtol=1e-9, atol=1e-9, err_msg=kind)
        seen += int((h1 + h2 > 0.0).sum())
        state = after
    assert seen > 20
