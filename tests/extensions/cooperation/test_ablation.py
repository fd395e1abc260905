"""``study ablate``: joint optima, changes from level to level, and a small ablation from the command line."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.episode.counts import ALL_IMPACTS, BUILT_IN_COUNTS, FIRST_IMPACTS
from ethbrake_marl.extensions.cooperation.ablation import Answer, LevelResult, can_imitate, least_known, measure_level
from ethbrake_marl.extensions.cooperation.levels import Level
from ethbrake_marl.extensions.cooperation.results import ablation_figure, comparison, levels_csv
from ethbrake_marl.extensions.search.best_harm import best_harm
from ethbrake_marl.motion.layout import FAR_M, GAP
from tests.fixtures.commands import Command
from tests.fixtures.pictures import draw_nothing

NAMES, COLUMNS = zip(*((count.name, count.column) for count in BUILT_IN_COUNTS), strict=True)


def columns(vehicles: list[list[float]]) -> dict[str, np.ndarray]:
    each = np.array([vehicles], np.float64)
    borne = {f"{name}_{i + 1}": each[:, :, i] for name in COLUMNS for i in range(3)}
    line = dict.fromkeys((*COLUMNS, "goal"), each.sum(axis=2))
    return {**borne, **line, "collided": each.any(axis=2)}


def measured(level: str, vehicles: list[list[float]], algorithm: str | None, braking=None, before=None) -> LevelResult:
    scenario = eb.load_scenario(level)
    best = dict.fromkeys(NAMES, np.ones((1, len(vehicles))))
    worlds = scenario.sample(1, 0)
    return LevelResult(
        Level(level, scenario, before), algorithm, columns(vehicles), columns(braking or vehicles), worlds, best
    )


def test_change__says_who_is_worse_off_and_by_how_much() -> None:
    before = measured("level-0-sensors", [[2, 4, 0], [0, 6, 0], [1, 1, 0], [0, 0, 0]], None)
    after = measured(
        "cooperation-1-front", [[1, 2, 3], [0, 2, 0], [1, 2, 0], [0, 0, 0]], "ppo", None, before.level.name
    )
    (step,) = comparison([before, after], 4)["steps"]
    assert (step["from"], step["to"], step["algorithm"]) == ("level-0-sensors", "cooperation-1-front", "ppo")
    for count in NAMES:
        change = step[count]
        assert change["difference"]["value"] == pytest.approx((0 - 4 + 1 + 0) / 4)
        assert [each["value"] for each in change["vehicles"]] == pytest.approx([-0.25, -1.25, 0.75])
        assert change["worse_off"]["value"] == 0.5  # worlds 0 and 2
        assert change["worse_off_vehicles"] == [0.0, 0.25, 0.25]


def test_level__of_a_table_rests_on_its_rows() -> None:
    for rows in ([[7, 6], [8, 6], [6, 9]], [[7, 6]]):
        table = {"columns": ["gap_1_m", "gap_2_m"], "rows": rows}
        scenario = eb.load_scenario("level-1-messages").replace(gaps_m=None, speeds_mps=20, table=table)
        result = measure_level(Level("mine", scenario), scenario.draw(60, 7), None, ())
        assert result.about["different_rows"] == len(np.unique(result.clusters)) == len(rows)
        (level,) = comparison([result], 30)["levels"]
        for estimate in (level["collision_rate"], level["honest"]["harm"], level["first"]["searched"]["full_brake"]):
            assert (estimate["interval"] is None) == (len(rows) == 1), estimate


def test_level__share_of_the_reduction_and_too_little_training_by_hand() -> None:
    one = measured("cooperation-1-front", [[1, 2, 0], [0, 2, 0]], "ppo", [[0, 6, 0], [0, 5, 0]])
    found = comparison([one], 2)
    share = found["levels"][0]["first"]["searched"]["share_of_possible_reduction"]
    assert share["value"] == pytest.approx((5.5 - 2.5) / (5.5 - 1.0)) and found["undertrained"] == []
    worse = measured("cooperation-1-front", [[0, 6, 0], [0, 5, 0]], "ppo", [[1, 2, 0], [0, 2, 0]])
    (sentence,) = comparison([worse], 2)["undertrained"]
    assert "cooperation-1-front (ppo) with 5.50 (2.50 with full braking)" in sentence


def test_csv__has_a_row_for_each_seed() -> None:
    one = measured("cooperation-1-front", [[1, 2, 3], [0, 2, 0]], "ppo")
    both = one._replace(reached={name: np.concatenate([each, 2 * each]) for name, each in one.reached.items()})
    row, other = csv.DictReader(levels_csv([both], 1).splitlines())
    assert (row["level"], row["seed"], row["first_impact_harm"]) == ("cooperation-1-front", "0", "4.0")
    assert (other["seed"], other["first_impact_harm"], other["searched_total_harm"]) == ("1", "8.0", "12.0")
    assert (row["searched_total_harm"], row["total_harm_3"], row["searched_best_known_total_harm"]) == (
        "6.0", "1.5", "1.0",
    )  # fmt: skip


def answer(level: str, budget: int, n: int = 6, **changes: object) -> Answer:
    scenario = eb.load_scenario(level).replace(**changes)
    loaded, game = eb.open_game(scenario)
    worlds = loaded.sample(n, 7)
    found = best_harm(game, worlds, harm_counts=("first", "total"), budget=budget, threads=1)
    return Answer(loaded, game, worlds, found, {"first": [], "total": []})


def test_optimum__of_a_level_counts_what_fewer_learners_do_and_what_teams_did() -> None:
    two, both = answer("cooperation-2-paper", 2_000), answer("cooperation-3-pair", 1)
    assert can_imitate(both, two).all() and not can_imitate(two, both).any()
    alone, together = (least_known(both, each, FIRST_IMPACTS) for each in ([both], [two, both]))
    assert (together <= alone).all() and (together <= two.searched.harm["first"] + 1e-9).all()
    both.team_harm["first"].append(np.array([0.0, *together[1:]]))
    assert least_known(both, [two, both], FIRST_IMPACTS)[0] == 0.0
    assert least_known(both, [two, both], ALL_IMPACTS)[0] == pytest.approx(least_known(both, [two], ALL_IMPACTS)[0])


def test_optimum__of_a_level_with_an_obstacle_is_simulated_with_it() -> None:
    free, ahead = answer("cooperation-3-pair", 300), answer("cooperation-3-pair", 1, obstacle_gap_m=30.0)
    free.team_harm["first"].append(np.zeros(6))  # without the obstacle, so it must not count
    assert (free.worlds.line[:, GAP, 0] >= FAR_M).all() and can_imitate(ahead, free).all()
    assert not can_imitate(free, ahead).any()
    assert (least_known(ahead, [free], FIRST_IMPACTS) > 1.0).all()


def test_levels__of_other_roles_or_latencies_cannot_be_imitated() -> None:
    pair = answer("cooperation-3-pair", 1)
    for changes in (
        {"roles": {**pair.scenario.roles, "vehicle_1": "coast"}},
        {"latency_s": [0, 0.5, 0.9]},
        {"mass_t": 5.0},
    ):
        assert not can_imitate(pair, answer("cooperation-3-pair", 1, **changes)).any()
    late = answer("cooperation-2-paper", 1, latency_s=[0, 0.55, 0.5])  # decides at 0.55 s
    assert not can_imitate(answer("cooperation-3-pair", 1, latency_s=[0, 0.55, 0.5]), late).any()


def check_level(level: dict[str, Any]) -> None:
    """The search has found what the policies of two seeds have not, and no cost without the harm in it."""
    one, other = level["policy_sha256"]
    assert level["seeds"] == 2 and one != other
    searched = {count: level[count]["searched"] for count in ("first", "total", "honest")}
    assert all(each["best_known"]["value"] <= each["harm"]["value"] for each in searched.values())
    assert searched["honest"]["best_known"]["value"] >= searched["total"]["best_known"]["value"]


def test_ablation__trains_compares_and_goes_on(
    ethbrake: Command, empty_folder: Path, tiny_recipe: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    draw_nothing(monkeypatch)
    small = "--seeds 2 --steps 128 --episodes 12 --search-episodes 2 --set horizon_s=7 --set reward.harm_count=honest"
    line = f"study ablate --levels level-0-sensors,cooperation-2-paper,cooperation-3-pair --recipes {tiny_recipe}"
    assert ethbrake(*line.split(), *small.split(), "--output", "out").status == 0
    out, found = Path("out"), json.loads(Path("out/ablation.json").read_text())
    assert {path.name for path in out.glob("ablation*")} == {"ablation.json", "ablation.csv", "ablation.png"}
    folders = [f"cooperation-{name}-seed{k}" for name in ("2-paper-tiny", "3-pair-tiny-shared") for k in (0, 1)]
    assert sorted(path.name for path in out.glob("trainings/*")) == folders
    config = json.loads((out / "trainings" / folders[0] / "config.json").read_text())
    assert config["settings"] == ["horizon_s=7", "reward.harm_count=honest"] and config["recipe"]["scheme"] is None
    pair = json.loads((out / "trainings" / folders[2] / "config.json").read_text())["recipe"]
    assert (config["recipe"]["total_steps"], pair["total_steps"]) == (128, 256)
    for level in found["levels"][1:]:
        check_level(level)
    assert found["levels"][1]["first"]["full_brake"] == found["levels"][2]["first"]["full_brake"]
    for condition in ("(rewarded for honest cost)", "first 2 worlds", "2 seeds, 128 decisions"):
        assert condition in found["conditions"]
    bars = [bar.get_height() for bar in ablation_figure(found, "").axes[0].patches]
    assert bars == [level["honest"]["harm"]["value"] for level in found["levels"]]  # of all worlds, as in the tables
    again = ethbrake(*line.split(), *small.split(), "--output", "out", "--json")
    assert again.status == 0 and json.loads(again.out)["levels"] == found["levels"]
    other = ethbrake(*line.split(), *small.replace("12", "13").split(), "--output", "out")
    assert other.status == 2 and "contains an ablation with other settings (steps-per-learner 128, now 138" in other.err
