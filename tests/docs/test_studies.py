"""The scripts of docs/studies, and pages that tell what the code does or what was measured: paper, cooperation, ..."""

import json
import re
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.extensions.report.style import picture_bytes
from ethbrake_marl.first_edition.evaluation.lineup import make_lineup
from ethbrake_marl.first_edition.game.harm import HARM_COUNTS
from ethbrake_marl.first_edition.game.objectives import scored
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from tests.docs.printed import rows as table_of
from tests.docs.site import DOCS, load

price, equal_time, message_contents, team_curves, equilibria = (
    load(f"../studies/{name}") for name in ("price", "equal_time", "message_contents", "team_curves", "equilibria")
)


PAPER = load_scenario("paper-random")


BASE = load_scenario("cooperation-2-paper")


PNG = b"\x89PNG"


def test_price__is_nothing_where_everything_is_known():
    found = price.drive(BASE, 12, {"paper": {"preset": "paper"}})["paper"]
    for count in price.COUNTS:
        assert price.price(found, "e_v2x_bm:estimated", count).value == pytest.approx(0.0, abs=1e-4)
    assert price.above(found, "e_v2x_bm:estimated") is None
    assert price.above(found, f"{price.POLICY}+step:estimated").value == 0.0


drawings = load("../drawings")


@pytest.mark.parametrize("name", drawings.DRAWINGS)
def test_drawing__is_the_one_that_is_shown(name: str) -> None:
    assert f"](../figures/model-{name}.svg)" in (DOCS / "internals" / "model.md").read_text("utf-8").replace("\n", " ")
    made = picture_bytes(drawings.DRAWINGS[name](), "made.svg")
    assert made == (DOCS / "figures" / f"model-{name}.svg").read_bytes()


def test_equilibria__have_a_row_for_each_objective() -> None:
    level = equilibria.search("cooperation-2-paper", 2)
    found = [row[:2] for row in equilibria.price_rows(level)]
    assert found == [["`cooperation-2-paper`", objective] for objective in equilibria.OBJECTIVES]


def test_team_curves__show_the_middle_three_of_five_seeds_and_what_they_compare_with() -> None:
    level, lasts = team_curves.LEVELS[0], (9.0, 1.0, 2.0, 6.0, 4.0)  # without the best and the worst: mean 4
    curves = [
        {
            "algorithm": "ippo",
            "level": level,
            "seed": seed,
            "points": [[0, 0.0, 30.0, 40.0], [8192, 2.0, last, 2 * last]],
        }
        for seed, last in enumerate(lasts)
    ]
    harms = {"full_brake": [24.0, 25.0], "e_v2x_bm": [15.0, 16.0], "joint optimum": [0.5, 0.75]}
    found = {"seconds": 2.0, "worlds": 100, "seed": 1, "speeds": [], "references": {level: harms}, "curves": curves}
    assert json.loads(team_curves.text_of(found)) == found
    rows = team_curves.table(found)
    assert [row[1] for row in rows] == ["full braking", "E-V2X-BM", "IPPO (`train/ippo.py`)", "joint optimum (search)"]
    assert rows[2][2:4] == ["8,192", "2 s"]
    assert [cell.split(" [")[0] for cell in rows[2][4:]] == ["4.00", "8.00"]
    assert rows[3][4:] == ["0.50", "0.75"]
    assert picture_bytes(team_curves.draw(found), "curves.png").startswith(PNG)


def test_team_curves__the_table_in_the_docs_is_made_from_the_numbers_beside_the_script() -> None:
    found = json.loads(team_curves.NUMBERS.read_bytes())
    assert table_of("results/cooperation", "## Five algorithms at 45 processor seconds each") == [
        team_curves.HEAD, *team_curves.table(found),
    ]  # fmt: skip
    assert team_curves.NUMBERS.read_text("utf-8") == team_curves.text_of(found)
    assert len(found["curves"]) == len(team_curves.LEVELS) * len(team_curves.ALGORITHMS) * 5


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", [each for each in team_curves.ALGORITHMS if each != "benchmarl"])
def test_team_curves__measure_before_the_first_and_after_the_last_update(algorithm) -> None:
    first, last = team_curves.learn(algorithm, "cooperation-3-pair", 1, 0, worlds=2)
    assert first[:2] == [0, 0.0]
    assert last[0] > 0
    assert last[1] > 0.0
    assert first[2:] != last[2:]


def test_team_curves__a_failed_job_is_counted_and_the_others_go_on(capsys) -> None:
    good, bad = Future(), Future()
    good.set_result("good.json")
    bad.set_exception(ValueError("no such level"))
    assert team_curves.finish_jobs({good: "good.json", bad: "bad.json"}) == 1
    printed = capsys.readouterr()
    assert "good.json\n" in printed.out
    assert "bad.json FAILED" in printed.out
    assert "no such level" in printed.err


def volume_below(reference: np.ndarray, points: np.ndarray) -> float:
    """The volume that points [n, 3] dominate below a reference point, cell by cell of the grid of their coordinates."""
    edges = [np.unique(np.clip([*points[:, k], reference[k]], None, reference[k])) for k in range(3)]
    corners = np.stack(np.meshgrid(*(edge[:-1] for edge in edges), indexing="ij"), axis=-1)
    dominated = (points[:, None, None, None] <= corners).all(axis=-1).any(axis=0)
    return float(np.einsum("ijk,i,j,k", dominated, *map(np.diff, edges)))


def test_morl_front__its_numbers_agree_with_each_other_and_with_full_braking() -> None:
    found = json.loads((DOCS / "studies" / "morl_front.json").read_bytes())
    weights, scenario = np.array(found["weights"]), load_scenario(found["scenario"])
    assert weights.shape == (21, 3) and np.allclose(weights.sum(axis=1), 1.0)
    worlds = scenario.sample(found["worlds"], found["seed"])
    braking = eb.evaluate(worlds, make_lineup(["full_brake"], scenario), scenario=scenario).outcome("full_brake")
    for training in found["trainings"]:
        for count in HARM_COUNTS:
            measured = training[count]
            points, full = np.array(measured["harm"]), braking.vehicle_harm(count).mean(axis=0)
            assert points.shape == (21, 3) and points.max() < found["roof"]
            assert measured["full_braking"] == full.round(4).tolist()
            assert measured["hypervolume"] == pytest.approx(volume_below(full.round(4), points))
            assert measured["hypervolume_below_roof"] == pytest.approx(volume_below(np.full(3, found["roof"]), points))


# ---------------------------------------------------------------- pages


def text_of(*names: str) -> list[str]:
    return [(DOCS / f"{name}.md").read_text("utf-8") for name in names]


(COOPERATION,), (TRAIN,) = text_of("cooperation"), text_of("train")


# docs/cooperation.md, and the methods for several learners in docs/train.md


def test_cooperation__its_examples_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    blocks = re.findall("```python\n(.*?)```", COOPERATION, re.DOTALL)
    for block in blocks:
        exec(block.replace("1000", "20"), names)
    assert blocks and names["columns"]["social:45"].shape == (20, 3)
    assert names["columns"].keys() == scored(names["result"].outcome("full_brake").ledger, "first").keys()
    quick = '("cooperation-ppo").replace(total_steps=1, n_envs=8)'
    (block,) = (each for each in re.findall("```python\n(.*?)```", TRAIN, re.DOTALL) if "team@runs/team" in each)
    names = {"eb": eb}
    exec(block.replace('("cooperation-ppo")', quick).replace("1000", "20"), names)
    assert names["team_harm"].shape == (20,) and (tmp_path / "runs" / "team" / "team.json").is_file()
