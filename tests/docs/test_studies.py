"""The scripts of docs/studies, and pages that tell what the code does or what was measured: paper, cooperation, ..."""

import dataclasses
import json
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.extensions.report.style import picture_bytes
from ethbrake_marl.extensions.search.tables import TABLE_FOLDER, BestHarmTable
from ethbrake_marl.motion.digest import physics_digest
from tests.docs.printed import rows
from tests.docs.site import DOCS, load
from tests.fixtures.commands import rows_of

drawings = load("../drawings")


@pytest.mark.usefixtures("pinned_matplotlib")
@pytest.mark.parametrize("name", drawings.DRAWINGS)
def test_drawing__is_the_one_that_is_shown(name: str) -> None:
    assert f"](figures/model-{name}.svg)" in (DOCS / "physics.md").read_text("utf-8").replace("\n", " ")
    made = picture_bytes(drawings.DRAWINGS[name](), "made.svg")
    assert made == (DOCS / "figures" / f"model-{name}.svg").read_bytes()


best_harm = load("../studies/best_harm")


def test_restamp__renews_a_table_only_if_all_its_harms_keep_their_bits(tmp_path, capsys) -> None:
    file, old = tmp_path / "cooperation-2-five.npz", {"physics": "0123456789abcdef"}
    shipped = BestHarmTable.load(TABLE_FOLDER / file.name)
    harm = {count: each.copy() for count, each in shipped.harm.items()}
    harm["total"][7] = np.nextafter(harm["total"][7], 99.0)
    for changed in (
        {"header": {**shipped.header, **old}},
        {"header": {**shipped.header, **old}, "harm": harm},
        {"header": {**shipped.header, **old, "list_seed": 8}},
    ):
        dataclasses.replace(shipped, **changed).save(file)
        before = file.read_bytes()
        renewed = best_harm.restamp(tmp_path)
        assert renewed == ("harm" not in changed and changed["header"]["list_seed"] == 7)
        assert renewed or file.read_bytes() == before
        assert not renewed or BestHarmTable.load(file).content() == shipped.content()
    same, other_harm, other_worlds = capsys.readouterr().out.splitlines()
    assert same == f"cooperation-2-five: same bits, physics {physics_digest()}"
    assert other_harm.endswith("NOT renewed: other harms in worlds: 1 of 400 (total); search the list again")
    assert other_worlds.endswith("NOT renewed: its worlds are not those of its list")


def test_ablation__page_and_file_say_the_same() -> None:
    costs = defaultdict(list)
    for row in rows_of(DOCS / "results" / "ablation.csv"):
        costs[f"`{row['level']}`"].append(
            [float(row[key]) for key in ("first_impact_harm", "total_harm", "honest_cost")]
        )
    shown = {
        row[0]: [cell.partition(" [")[0] for cell in row[2:5]]
        for row in rows("cooperation", "## Harm on each level")[1:]
    }
    assert shown == {level: [f"{mean:.2f}" for mean in np.mean(each, axis=0)] for level, each in costs.items()}


competence = load("../studies/competence")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("competence.py rule", "competence.py: error: rule needs a policy, such as runs/three-tests"),
        ("competence.py warning {file}", "competence.py: error: "),
    ],
)
def test_studies__end_with_a_message(words: str, message: str, tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch()
    study, *arguments = words.format(file=file).split()
    command = [sys.executable, str(DOCS / "studies" / study), *arguments]
    ended = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert ended.returncode == 2 and message in ended.stderr and "Traceback" not in ended.stderr


def test_competence__has_a_best_known_cost_of_every_line() -> None:
    best = json.loads(competence.BEST.read_text("utf-8"))
    assert best.keys() == competence.every_line().keys()
    assert len(best) > 80 and all(cost >= 0.0 for cost in best.values())


def test_page__has_the_numbers_of_plan_in_every_line() -> None:
    table = competence.read_table()
    assert rows("findings", "## `plan` in every line")[1:] == competence.page_rows(table)
    numbers = [tuple(row[agent] for agent in (*competence.RIVALS, competence.AGENT)) for row in table]
    assert len(set(numbers)) == len(table) > 60


def test_row__has_what_an_evaluation_says() -> None:
    row = competence.row_of(eb.load_scenario("paper-random"), 9.0)
    result = eb.evaluate(
        "paper-random", "full_brake,plan", episodes=competence.WORLDS, seed=competence.SEED, measures="pushed_mps"
    )
    brake, plan = result["full_brake"]["honest_cost"], result["plan"]["honest_cost"]
    assert (row["full_brake"], row["plan"]) == (brake.mean(), plan.mean())
    assert (row["learners"], row["hidden"], row["best_known"]) == ("2", 0.0, 9.0)
    assert row["over_1"] == (plan - brake > 1.0).mean() and row["plan_push_mps"] == result["plan"]["pushed_mps"].mean()
    assert row["worst5"] == np.sort(plan)[-15:].mean() < row["full_brake_worst5"] == np.sort(brake)[-15:].mean()
    assert competence.row_of(eb.load_scenario("paper-random"), 99.0)["best_known"] == plan.mean()


def test_page_rows__by_hand() -> None:
    def row(name: str, cost: float, best: float, **more: object) -> dict[str, str]:
        numbers = {"learners": "2", "hidden": 0, "full_brake": 20, "e_v2x_bm": 10, "plan:1": 11, "plan": cost}
        return {"line": name, **{key: str(cell) for key, cell in (numbers | {"best_known": best, **more}).items()}}

    table = [
        row("a", 8.0, 8.0, over_1=0.0), row("b", 12.0, 6.0, over_1=0.01), row("c", 10.2, 9.0, over_1=0.002),
        row("d", 20.0, 19.9, over_1=0.0, e_v2x_bm=30), row("e", 0.04, 0.01, over_1=0.0),
        row("f", 5.0, 4.0, over_1=0.0, learners="2 3"), row("g", 10.5, 10.0, over_1=0.5, hidden=1.0),
    ]  # fmt: skip
    assert competence.page_rows(table) == [
        ["one learner", "5", "1: `b`", "1.13", "2.00 (`b`)", "1.0 % (`b`)"],
        ["several learners", "1", "0", "1.25", "1.25 (`f`)", "0.0 % (`f`)"],
        ["the channel hides values", "1", "0", "1.05", "1.05 (`g`)", "50.0 % (`g`)"],
    ]
