"""The scripts of docs/studies, and pages that tell what the code does or what was measured: paper, cooperation, ..."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.agents.pairwise import pairwise
from ethbrake_marl.extensions.report.style import picture_bytes
from ethbrake_marl.names import make_teams
from tests.docs.printed import rows as table_of
from tests.docs.site import DOCS, load

price, equal_time = (load(f"../studies/{name}") for name in ("price", "equal_time"))
BASE = eb.load_scenario("cooperation-2-paper")


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


def test_equal_time__compares_with_the_first_team() -> None:
    scenario, game = eb.open_game("paper-random")
    teams = make_teams("e_v2x_bm,full_brake", scenario)
    rows = equal_time.rows_of(equal_time.drive(scenario.sample(30, 7), teams, game, 1), teams)
    assert {row[0]: row[5] == "" for row in rows} == {"`e_v2x_bm`": True, "`full_brake`": False}
    assert all(float(row[2]) > 0.0 for row in rows)


def volume_below(reference: np.ndarray, points: np.ndarray) -> float:
    """The volume that points [n, 3] dominate below a reference point, cell by cell of the grid of their coordinates."""
    edges = [np.unique(np.clip([*points[:, k], reference[k]], None, reference[k])) for k in range(3)]
    corners = np.stack(np.meshgrid(*(edge[:-1] for edge in edges), indexing="ij"), axis=-1)
    dominated = (points[:, None, None, None] <= corners).all(axis=-1).any(axis=0)
    return float(np.einsum("ijk,i,j,k", dominated, *map(np.diff, edges)))


def test_morl_front__its_numbers_agree_with_each_other_and_with_full_braking() -> None:
    found = json.loads((DOCS / "studies" / "morl_front.json").read_bytes())
    weights = np.array(found["weights"])
    assert weights.shape == (21, 3) and np.allclose(weights.sum(axis=1), 1.0)
    braking = eb.evaluate(found["scenario"], "full_brake", episodes=found["worlds"], seed=found["seed"])["full_brake"]
    columns = {"first": "first_impact_harm", "total": "total_harm"}
    for training in found["trainings"]:
        for count, column in columns.items():
            measured = training[count]
            full = np.array([braking[f"{column}_{vehicle}"].mean() for vehicle in (1, 2, 3)])
            points = np.array(measured["harm"])
            assert points.shape == (21, 3) and points.max() < found["roof"]
            assert measured["full_braking"] == full.round(4).tolist()
            assert measured["hypervolume"] == pytest.approx(volume_below(full.round(4), points))
            assert measured["hypervolume_below_roof"] == pytest.approx(volume_below(np.full(3, found["roof"]), points))


# ---------------------------------------------------------------- pages


COOPERATION = (DOCS / "cooperation.md").read_text("utf-8")


def committed(heading: str, agent: str) -> list[str]:
    """An agent's row in the table below a heading of the page of the reproduction, without intervals."""
    (row,) = (row for row in table_of("results/reproduction", heading) if row[0] == agent)
    return [cell.split(" [")[0] for cell in row[1:]]


def test_paper__its_5000_worlds_cannot_come_from_the_speeds_of_the_figure_of_distances() -> None:
    for name, heading, cells in (
        ("paper-distance", "### Speeds 20, 18, 20 m/s, as stated", ("67.7 %", "12.88", "3.07")),
        ("paper-random", "### Speeds 18 to 22 m/s, as stated", ("65.5 %", "19.13", "9.38")),
    ):
        predicted = pairwise(eb.load_scenario(name).sample(5_000, 7), 2).harm.mean()
        row = committed(heading, "E-V2X-BM, realised")
        assert [row[column] for column in (0, 1, 3)] == list(cells) and f"{predicted:.2f}" == cells[2]


@pytest.mark.parametrize(("spec", "name"), [("full_brake", "Non-ethical (full braking)"), ("ppo", "PPO")])
def test_paper__harms_at_three_delays_are_as_committed(spec: str, name: str) -> None:
    row = committed("### Gaps of 7 m, speeds of 20, 18 and 20 m/s", name)
    state = {"gap_1_m": [7], "gap_2_m": [7], "speed_1_mps": [20], "speed_2_mps": [18], "speed_3_mps": [20]}
    for told, delay in zip(row, ("low", "middle", "high"), strict=True):
        scenario = eb.load_scenario(f"paper-delay-{delay}")
        result = eb.evaluate(eb.worlds_from_table(scenario, state), spec, scenario=scenario)
        assert told == f"{result[spec]['first_impact_harm'].mean():.2f}"


def test_cooperation__its_examples_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    blocks = re.findall("```python\n(.*?)```", COOPERATION, re.DOTALL)
    for block in blocks:
        exec(block.replace("1000", "20"), names)
    assert blocks
