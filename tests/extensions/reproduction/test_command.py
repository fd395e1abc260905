"""``ethbrake reproduce``: what it prints, writes, keeps and refuses."""

import re
from pathlib import Path

import pytest

from ethbrake_marl.errors import AlreadyExists
from ethbrake_marl.extensions.reproduction import items, verdicts
from ethbrake_marl.extensions.reproduction.made import Item, Made, ReproductionSettings
from ethbrake_marl.extensions.reproduction.verdicts import same_claim
from ethbrake_marl.files.sheet import Column, Estimate, Sheet
from tests.fixtures.commands import Command, Refuse, rows_of, told_json
from tests.refused import refused


def test_list__has_the_items_in_the_order_of_the_paper(ethbrake: Command) -> None:
    rows = told_json(ethbrake("reproduce", "elsewhere", "learning-curves", "random-table", "--list", "--json"))
    assert [row["Item"] for row in rows] == ["random-table", "learning-curves", "elsewhere"]
    assert [row["Label in the paper"] for row in rows] == [
        "Table:Random", "fig:ppo_sac_high_latency, fig:ppo_sac_low_latency", "",
    ]  # fmt: skip


def test_cost__is_told_and_nothing_is_written(ethbrake: Command, empty_folder: Path) -> None:
    some = ethbrake("reproduce", "trajectories", "accelerations", "--cost").err
    assert "to do: 2 items, at most about 4 s of one core" in some
    whole = int(re.search(r"about (\d+) s", ethbrake("reproduce", "--cost").err)[1])
    assert 60 < whole <= 120
    assert not list(empty_folder.iterdir())


def test_reproduce__writes_page_figures_and_tables(ethbrake: Command, empty_folder: Path) -> None:
    done = ethbrake("reproduce", "accelerations", "--episodes", "3", "--output", "out", "--json")
    (result,) = told_json(done)
    assert result["name"] == "accelerations" and len(result["tables"]["Commands of Vehicle 2"]) == 4
    assert [each["ours"] for each in result["claims"]] == ["differs", "undecided", "agrees", "undecided"]
    assert all(each["Why"].startswith("one world, exact impacts; decided only if") for each in result["claims"])
    page = Path("out/README.md").read_text("utf-8")
    assert "Made by `ethbrake reproduce accelerations --episodes 3` on 20" in page
    assert f"version {result['version']}, physics {result['physics_digest']})" in page
    assert "](accelerations/accelerations.svg)" in page and "| undecided | 2 | 2 | 2 |" in page
    folder = Path("out/accelerations")
    for name in ("accelerations.svg", "accelerations.pdf", "commands-of-vehicle-2.csv"):
        assert (folder / name).stat().st_size > 200
    assert [row["The paper"] for row in rows_of(Path("out/claims.csv"))] == [
        each["The paper"] for each in result["claims"]
    ]
    assert done.err.endswith("page: out/README.md\n")


def test_terminal__has_lines_counts_and_the_page(ethbrake: Command, empty_folder: Path) -> None:
    done = ethbrake("reproduce", "elsewhere", "--output", "out")
    lines = done.out.splitlines()
    assert len(lines) == 1 + 3 + 1 + 2 + 1 + 4
    assert lines[2] == f"{'Sec. II':<14} {SHORT:<60} agrees    agrees    agrees"
    assert lines[5].rstrip() == "Verdicts on 3 results" and lines[8].split() == ["agrees", "2", "2", "2"]
    assert done.err.endswith("page: out/README.md\n") and Path("out/README.md").exists()


SHORT = "Vehicle 2 needs a small amount of information: braking capa…"

SENTENCE = {"where": "Fig. 9", "paper": "H* is less", "result": "less/less", "why": {"agrees": "so it is"}}


@pytest.fixture
def planted_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    texts = {"lead": "A lead.", "sentences": [SENTENCE]}
    for module in (items, verdicts):
        monkeypatch.setattr(module, "paper_texts", lambda: texts)


def planted(ours: str) -> Item:
    sheet = Sheet("A table, 1 m/s", ("Who", Column("Harm")), [("PPO | H*", Estimate(1.5, (1.25, 1.75)))], "Of 24.")
    made = Made([same_claim("less", ours, "agrees")], [sheet], notes=["A note."])
    return Item("less", ("Fig:x",), "A title", "What it is.", lambda settings: made, 1.0)


@pytest.mark.usefixtures("planted_sentence")
def test_page__by_hand_and_results_are_replaced_by_force_alone(tmp_path: Path) -> None:
    settings = ReproductionSettings(tmp_path / "out", episodes=24)
    items.reproduce(settings, [planted("b")], "a machine")
    text = (tmp_path / "out/README.md").read_text("utf-8")
    _, rest = text.split("## The paper, sentence by sentence\n\n")
    assert rest == (
        "A lead.\n\n| Where | The paper | ours | R1 | R2 | Numbers, ours | Numbers, R1 | Numbers, R2 | Why |\n"
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |\n"
        "| Fig. 9 | H\\* is less | agrees | agrees | agrees | b |  |  | so it is |\n\n"
        "## A title\n\nWhat it is. In the paper's source: `Fig:x`. Command: `ethbrake reproduce less`.\n\nA note.\n\n"
        "### A table, 1 m/s\n\n| Who | Harm |\n| --- | ---: |\n| PPO \\| H\\* | 1.50 [1.25, 1.75] |\n\nOf 24.\n"
    )
    table = tmp_path / "out/less/a-table-1-m-s.csv"
    assert table.read_text() == "Who,Harm,Harm_low,Harm_high\nPPO | H*,1.5,1.25,1.75\n"
    with refused("README.md: already exists", AlreadyExists):
        items.reproduce(settings, [planted("c")], "m")
    items.reproduce(settings, [planted("d")], "m", force=True)
    assert "| d |  |  | so it is |" in (settings.folder / items.RESULTS_FILE).read_text()


@pytest.mark.parametrize(
    ("line", "message"),
    [("trajectorys", "unknown item 'trajectorys'; did you mean 'trajectories'?"), ("--episodes 1", "--episodes")],
)
def test_refusals(refuse: Refuse, line: str, message: str) -> None:
    refuse(f"reproduce {line}", message)
