"""Evaluations of the second edition against those of the first: columns, statistics, records."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.agents.drive import Team
from ethbrake_marl.agents.scripts import Held
from ethbrake_marl.evaluation import statistics as new
from ethbrake_marl.evaluation.evaluate import evaluate
from ethbrake_marl.evaluation.identity import about_scenario
from ethbrake_marl.evaluation.named_measures import measures_called
from ethbrake_marl.evaluation.record import record_episode
from ethbrake_marl.evaluation.summary import summarise
from ethbrake_marl.first_edition.evaluation import statistics as old
from ethbrake_marl.first_edition.evaluation.own_measures import LOADED, REPORTED, load_measures
from ethbrake_marl.worlds.game import game_of

SCENARIOS = ["paper-random", "paper-random-obstacle", "paper-random-buildup", "mixture-delays", "cooperation-2-five"]
AGENTS = {name: Held(name) for name in ("full_brake", "coast", "constant:2.5")}


@pytest.fixture
def injuries() -> Iterator[None]:
    """The first edition's evaluations report measures of injury."""
    reported, loaded = dict(REPORTED), dict(LOADED)
    load_measures(["injury"])
    yield
    for kept, before in ((REPORTED, reported), (LOADED, loaded)):
        kept.clear()
        kept.update(before)  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", SCENARIOS)
@pytest.mark.usefixtures("injuries")
def test_columns__are_those_of_the_first_edition(name: str) -> None:
    earlier = eb.load_scenario(name)
    expected = eb.evaluate(earlier.sample(300, seed=7), ",".join(AGENTS), scenario=earlier)
    scenario, game = game_of(name)
    (body,) = game.rules.learners.tolist()
    teams = {key: Team(key, {body: agent}) for key, agent in AGENTS.items()}
    measures = ["sampled_harm", "vehicle_1_shoved_m", "injury"]
    found = evaluate(scenario.draw(300, 7), teams, game, measures_called(measures), about=about_scenario(scenario, 7))
    exact = "buildup" not in name
    for key in AGENTS:
        columns = expected.outcome(key).columns()
        for column, values in columns.items():
            mine = found[key].get(column.removeprefix("metric_"))
            if column.startswith(("final", "obstacle", "chosen", "metric")) or values is None:
                continue
            assert mine is not None, column
            if values.dtype.kind == "U" or (exact and column not in ("sampled_harm", "vehicle_1_shoved_m")):
                assert mine.tolist() == values.tolist(), column
            else:
                np.testing.assert_allclose(
                    mine.astype(float), values.astype(float), rtol=1e-9, atol=1e-9, err_msg=column
                )
        for curve in ("lr4s", "reference", "gidas"):
            np.testing.assert_allclose(
                found[key][f"injury_{curve}"], columns[f"metric_injury_{curve}"], rtol=1e-9, atol=1e-9
            )
    for row, other in zip(summarise(found), eb.summarise(expected), strict=True):
        for estimate in (
            "collision_rate",
            "total_harm",
            "harm_decrease_first",
            "total_harm_difference",
            "sampled_harm",
        ):
            if other[estimate] is not None:
                assert row[estimate].value == pytest.approx(other[estimate].value, rel=1e-9, abs=1e-12)  # type: ignore[union-attr]
        assert (row.knows, row.horizon_ends) == (other.knows.text, other.horizon_ends)


@pytest.mark.parametrize("seed", range(5))
def test_statistics__are_those_of_the_first_edition(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 3000))
    x, y = rng.gamma(1.0, 24.0, n) * (rng.random(n) < 0.6), rng.gamma(1.0, 24.0, n)
    pairs = [
        (new.mean(x), old.mean(x)), (new.difference(x, y), old.paired_difference(x, y)),
        (new.decrease(x, y), old.relative_decrease(x, y)), (new.rate(x > 0.0), old.share_of(x > 0.0)),
        (new.unpaired(new.mean(y), new.mean(y + 1.0)), old.unpaired_difference(old.mean(y), n, old.mean(y + 1.0), n)),
    ]  # fmt: skip
    for found, expected in pairs:
        assert found is not None and expected is not None and expected.interval is not None
        assert found.value == pytest.approx(expected.value, rel=1e-12)
        assert found.interval == pytest.approx(expected.interval, rel=1e-12)


def test_equal_recordings__have_the_errors_of_the_first_edition() -> None:
    x, names = np.random.default_rng(1).exponential(3.0, 120), np.repeat(np.arange(12).astype(str), 10)
    found, expected = new.mean(x, names), old.Moments.of(x, names)
    assert found.error == pytest.approx(expected.standard_error, rel=1e-12) and found.freedom == pytest.approx(11.0)


@pytest.mark.parametrize("name", ["paper-random", "paper-random-obstacle", "paper-random-buildup"])
def test_record__is_that_of_the_first_edition(name: str) -> None:
    earlier, (scenario, game) = eb.load_scenario(name), game_of(name)
    for k in range(3):
        expected = eb.record_episode(
            earlier.sample(k + 1, seed=7).worlds.take([k]), eb.make_agent("constant:4"), scenario=earlier
        )
        found = record_episode(scenario.sample(1, 7, first=k), Team("x", {2: Held("constant:4")}), game)
        for field in ("time_s", "gaps_m", "speeds_mps", "positions_m", "command_mps2"):
            np.testing.assert_allclose(getattr(found, field), getattr(expected, field), rtol=1e-9, atol=1e-9)
        impacts, rows = found.impacts, expected.impacts
        assert impacts.number.sum() == len(rows.time_s)  # several within 0.02 s are one row
        first = [
            int(np.argmin(abs(rows.time_s - time) + (rows.pair + 1 != p)))
            for time, p in zip(impacts.time_s, impacts.pair, strict=True)
        ]
        np.testing.assert_allclose(impacts.time_s, rows.time_s[first], rtol=1e-9)
        np.testing.assert_allclose(impacts.closing_speed_mps, rows.closing_speed_mps[first], rtol=1e-6)
        assert found.at_rest == expected.at_rest
