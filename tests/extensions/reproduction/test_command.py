"""``ethbrake reproduce``: what it prints, writes, keeps and refuses."""

from pathlib import Path

import pytest

from ethbrake_marl.errors import AlreadyExists
from ethbrake_marl.extensions.reproduction import items, verdicts
from ethbrake_marl.extensions.reproduction.made import Item, Made, ReproductionSettings
from ethbrake_marl.extensions.reproduction.verdicts import Claim
from ethbrake_marl.files.sheet import Column, Estimate, Sheet
from tests.fixtures.commands import Command, Refuse, rows_of, told_json
from tests.refused import refused


def test_list__has_the_items_in_the_order_of_the_paper(ethbrake: Command) -> None:
    rows = told_json(ethbrake("reproduce", "gaps", "learning-low", "random-table", "changes", "--list", "--json"))
    assert [row["Item"] for row in rows] == ["changes", "random-table", "learning-low", "gaps"]
    assert [row["Label in the paper"] for row in rows] == ["", "Table:Random", "fig:ppo_sac_low_latency", ""]


def test_cost__counts_the_trainings_that_are_missing(ethbrake: Command, empty_folder: Path) -> None:
    quick = ethbrake("reproduce", "hybrid-table", "learning-low", "--cost").err
    assert "to do: 2 items, at most about 6 s of one core; trainings before them about 0.1 min" in quick
    full = ethbrake("reproduce", "hybrid-table", "learning-low", "gaps", "--full", "--cost").err
    # trainings: 2 x 3 x (280 + 300) s, 2 x 280 s without a terminal reward, and 6 s
    assert "3 items, at most about 18 s of one core; trainings before them about 67.4 min" in full
    assert "about 58.0 min" in ethbrake("reproduce", "learning-high", "--full", "--cost").err
    assert "about 348.3 min" in ethbrake("reproduce", "trajectories", "--full", "--cost").err
    assert "trainings" not in ethbrake("reproduce", "gaps", "trajectories", "--cost").err
    assert not list(empty_folder.iterdir())
    run = Path("runs/reproduction/trainings/random/ppo-paper-seed0")
    run.mkdir(parents=True)
    (run / "run.json").write_text('{"status": "finished"}')
    assert "at most about 24 s" in ethbrake("reproduce", "gaps", "trajectories", "--cost").err  # 12 + 2 + 10


def test_reproduce__writes_page_figures_and_tables(ethbrake: Command, empty_folder: Path) -> None:
    done = ethbrake("reproduce", "accelerations", "--episodes", "3", "--output", "out", "--json")
    (result,) = told_json(done)
    assert result["name"] == "accelerations" and len(result["tables"]["Commands of Vehicle 2"]) == 8
    assert [each["Verdict"] for each in result["claims"]] == ["undecided"] * 4
    assert all(each["Why"].startswith("one world, exact impacts; decided only if") for each in result["claims"])
    page = Path("out/README.md").read_text("utf-8")
    assert "Made by `ethbrake reproduce accelerations --episodes 3` on 20" in page
    assert f"version {result['version']}, physics {result['physics_digest']})" in page
    assert "](accelerations/accelerations.svg)" in page and "not run need --full" in page
    folder = Path("out/accelerations")
    for name in ("accelerations.svg", "accelerations.pdf", "commands-of-vehicle-2.csv"):
        assert (folder / name).stat().st_size > 200
    assert [row["The paper"] for row in rows_of(Path("out/claims.csv"))] == [
        each["The paper"] for each in result["claims"]
    ]
    assert done.err.endswith("page: out/README.md\n")


SENTENCE = {"where": "Fig. 9", "paper": "H* is less", "result": "gaps/less", "why": {"agrees": "so it is"}}


@pytest.fixture
def planted_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    texts = {"lead": "A lead.", "sentences": [SENTENCE]}
    for module in (items, verdicts):
        monkeypatch.setattr(module, "paper_texts", lambda: texts)


def planted(ours: str) -> Item:
    sheet = Sheet("A table, 1 m/s", ("Who", Column("Harm")), [("PPO | H*", Estimate(1.5, (1.25, 1.75)))], "Of 24.")
    made = Made([Claim("less", ours, "", "agrees")], [sheet], notes=["A note."])
    return Item("gaps", ("Fig:x",), "A title", "What it is.", lambda settings: made, 1.0)


@pytest.mark.usefixtures("planted_sentence")
def test_page__by_hand_and_results_are_replaced_by_force_alone(tmp_path: Path) -> None:
    settings = ReproductionSettings(tmp_path / "out", episodes=24)
    items.reproduce(settings, [planted("b")], "a machine")
    text = (tmp_path / "out/README.md").read_text("utf-8")
    _, rest = text.split("## The paper, sentence by sentence\n\n")
    assert rest == (
        "A lead.\n\n| Where | The paper | Ours, as stated | Ours, nearest reading | Verdict | Why |\n"
        "| --- | --- | --- | --- | --- | --- |\n| Fig. 9 | H\\* is less | b |  | agrees | so it is |\n\n"
        "## A title\n\nWhat it is. In the paper's source: `Fig:x`. Command: `ethbrake reproduce gaps`.\n\nA note.\n\n"
        "### A table, 1 m/s\n\n| Who | Harm |\n| --- | ---: |\n| PPO \\| H\\* | 1.50 [1.25, 1.75] |\n\nOf 24.\n"
    )
    table = tmp_path / "out/gaps/a-table-1-m-s.csv"
    assert table.read_text() == "Who,Harm,Harm_low,Harm_high\nPPO | H*,1.5,1.25,1.75\n"
    with refused("README.md: already exists", AlreadyExists):
        items.reproduce(settings, [planted("c")], "m")
    items.reproduce(settings, [planted("d")], "m", force=True)
    assert "| d |  | agrees | so it is |" in (settings.folder / items.RESULTS_FILE).read_text()


def test_interrupted__training_makes_no_item(tmp_path: Path, monkeypatch, ethbrake: Command) -> None:
    monkeypatch.setattr(items, "train_groups", lambda *given: False)
    done = ethbrake("reproduce", "gaps", "--output", str(tmp_path / "again"))
    assert done.status == 130 and "interrupted; finished trainings remain; repeat the command" in done.err
    assert not (tmp_path / "again" / items.RESULTS_FILE).exists()


@pytest.mark.parametrize(
    ("line", "message"), [("gasp", "unknown item 'gasp'; did you mean 'gaps'?"), ("--episodes 1", "--episodes")]
)
def test_refusals(refuse: Refuse, line: str, message: str) -> None:
    refuse(f"reproduce {line}", message)
