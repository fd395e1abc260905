"""The scripts of docs/studies, and pages that tell what the code does or what was measured: paper, cooperation, ..."""

import csv
import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.extensions.report.style import picture_bytes
from ethbrake_marl.extensions.search.tables import TABLE_FOLDER, BestHarmTable
from ethbrake_marl.motion.digest import physics_digest
from ethbrake_marl.policies.bundle import load_shipped
from ethbrake_marl.training.training import Training
from tests.docs.printed import rows
from tests.docs.site import DOCS, load

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


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("lines.py {file}", "lines.py: error: "),
        ("competence.py rule", "competence.py: error: rule needs a policy, such as runs/lines/start"),
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
    competence = load("../studies/competence")
    best = json.loads(competence.BEST.read_text("utf-8"))
    assert best.keys() == {*competence.shipped(), *dict(competence.places())}
    assert len(best) > 80 and all(cost >= 0.0 for cost in best.values())


NO_NUMBERS = ("line", "learners")  # columns of lines.csv


def test_page_of_universal__has_the_numbers_of_the_lines() -> None:
    competence = load("../studies/competence")
    table = list(csv.DictReader(competence.TABLE.read_text("utf-8").splitlines()))
    costs = {row["line"]: {key: float(cell) for key, cell in row.items() if key not in NO_NUMBERS} for row in table}
    groups: dict[str, list[str]] = {"one learner": [], "several learners": [], "the channel hides values": []}
    for row in table:
        known = "several learners" if " " in row["learners"] else "one learner"
        groups["the channel hides values" if float(row["hidden"]) else known].append(row["line"])
    recomputed = []
    for group, names in groups.items():
        for agent in competence.LEARNED:
            better = {name: min(costs[name][rule] for rule in competence.rules_of(costs[name])) for name in names}
            worse = sum(competence.is_worse(costs[name][agent], better[name]) for name in names)
            searched = [name for name in names if costs[name]["best_known"] >= competence.NO_COST]
            ratios = {name: costs[name][agent] / costs[name]["best_known"] for name in searched}
            worst = max(ratios, key=lambda name: ratios[name])
            titles = [group, str(len(names))] if agent == competence.POLICY else ["", ""]
            numbers = [str(worse), f"{np.median([*ratios.values()]):.2f}", f"{ratios[worst]:.2f} (`{worst}`)"]
            recomputed.append([*titles, f"`{agent}`", *numbers])
    assert rows("reference/policies", "## `universal` in every line")[1:] == recomputed
    agents_numbers = {tuple(row[key] for key in row if key != "best_known") for row in costs.values()}
    page = " ".join((DOCS / "reference" / "policies.md").read_text("utf-8").split())
    assert f"{len(costs)} rows, of which {len(agents_numbers)} differ" in page
    assert f"In each of [{len(agents_numbers)} lines](" in (DOCS.parent / "README.md").read_text("utf-8")
    rivals = {name: min(row[rule] for rule in competence.rules_of(row)) for name, row in costs.items()}
    assert all(row[competence.POLICY] <= 1.01 * rivals[name] for name, row in costs.items())


def test_universal__was_trained_by_its_recipe_on_its_lines() -> None:
    policy, recipe = load_shipped("universal"), eb.load_recipe("universal")
    manifest = policy.manifest
    assert manifest.scenario == lines.mixture().content()
    assert policy.observation.names == eb.View(recipe.observation).names
    assert (manifest.algorithm, manifest.network.policy_hidden) == (recipe.algorithm, recipe.network.policy)
    assert recipe.total_steps <= manifest.steps < recipe.total_steps + 20_000
