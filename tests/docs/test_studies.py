"""The scripts of docs/studies, and pages that tell what the code does or what was measured: paper, cooperation, ..."""

import dataclasses
import json
from concurrent.futures import Future

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.extensions.report.style import picture_bytes
from ethbrake_marl.extensions.search.tables import TABLE_FOLDER, BestHarmTable
from ethbrake_marl.motion.digest import physics_digest
from ethbrake_marl.policies.bundle import load_shipped
from ethbrake_marl.training.training import Training
from tests.docs.printed import rows as table_of
from tests.docs.site import DOCS, load

team_curves = load("../studies/team_curves")
PNG = b"\x89PNG"


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
    assert [row[1] for row in rows] == [
        "full braking",
        "E-V2X-BM (coupled)",
        "IPPO (`train/ippo.py`)",
        "joint optimum (search)",
    ]
    assert rows[2][2:4] == ["8,192", "2 s"]
    assert [cell.split(" [")[0] for cell in rows[2][4:]] == ["4.00", "8.00"]
    assert rows[3][4:] == ["0.50", "0.75"]
    assert picture_bytes(team_curves.draw(found), "curves.png").startswith(PNG)


def test_team_curves__the_table_in_the_docs_is_made_from_the_numbers_beside_the_script() -> None:
    found = json.loads(team_curves.NUMBERS.read_bytes())
    rows = team_curves.table(found)
    levels, drivers = (list(dict.fromkeys(row[k] for row in rows)) for k in (0, 1))
    harms = {(level, driver): first for level, driver, _, _, first, _ in rows}
    assert (
        table_of("results/learning", "## Five algorithms at 45 processor seconds each")
        == [
            ["who drives the learners", *levels],  # without baselines, which have other numbers on the evaluation list
            *([driver, *(harms[level, driver] for level in levels)] for driver in drivers[2:]),
        ]
    )
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


lines = load("../studies/lines")


def test_lines__are_trained_on_by_their_recipe() -> None:
    training = Training.of("universal", lines.mixture())
    assert {line.scenario.vehicles for line in training.lines} == {2, 3, 4, 5, 6, 8}
    assert {body for line in training.lines for body in line.scenario.learners} == {*range(1, 9)}
    assert sum(line.recipe.n_envs for line in training.lines) == pytest.approx(training.recipe.n_envs, rel=0.02)
    for line in training.lines:
        assert line.scenario.sample(5, 7).vehicles == line.scenario.vehicles


def test_competence__has_a_best_known_cost_of_every_line() -> None:
    competence = load("../studies/competence")
    best = json.loads(competence.BEST.read_text("utf-8"))
    assert best.keys() == {*competence.shipped(), *dict(competence.places())}
    assert len(best) > 80 and all(cost >= 0.0 for cost in best.values())


def test_universal__was_trained_by_its_recipe_on_its_lines() -> None:
    policy, recipe = load_shipped("universal"), eb.load_recipe("universal")
    manifest = policy.manifest
    assert manifest.scenario == lines.mixture().content()
    assert policy.observation.names == eb.View(recipe.observation).names
    assert (manifest.algorithm, manifest.network.policy_hidden) == (recipe.algorithm, recipe.network.policy)
    assert recipe.total_steps <= manifest.steps < recipe.total_steps + 20_000
