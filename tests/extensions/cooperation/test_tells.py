"""Levels of cooperation that differ in what a message contains."""

import json
from pathlib import Path

import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.cooperation.levels import common_worlds, plan_ablation, read_levels
from ethbrake_marl.first_edition.physics.messages import USUAL_PIECES
from tests.fixtures.commands import run_command

SEEN = ["own", "front_1", "rear_1", "front_1.intent", "rear_1.intent"]


@pytest.fixture
def levels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    monkeypatch.chdir(tmp_path)
    base = eb.load_scenario("cooperation-3-pair")
    contents = {"all": None, "no-mass": [*USUAL_PIECES[:-1]], "intent": [*USUAL_PIECES, "intent"]}
    for name, tells in contents.items():
        v2x = base.v2x.model_dump(exclude_none=True) | ({} if tells is None else {"tells": tells})
        Path(f"{name}.yaml").write_text(json.dumps(base.replace(name=name, v2x=v2x, observation=SEEN).declared()))
    return [f"{name}.yaml" for name in contents]


def test_levels__that_differ_in_tells_are_compared_with_the_first_on_the_same_lines(levels: list[str]) -> None:
    read = read_levels(levels)
    assert [level.clear for level in read] == [None, "all", "all"]
    one, two, _ = common_worlds(read, 10, 7)
    assert one.worlds.gaps_m.tolist() == two.worlds.gaps_m.tolist()


def test_ablate__trains_and_compares_levels_that_differ_in_tells(levels: list[str]) -> None:
    few = "--seeds 1 --steps 512 --episodes 20 --search-episodes 3"
    assert run_command(f"study ablate --levels {','.join(levels)} {few} --output out".split()) == 0
    found = json.loads(Path("out/ablation.json").read_text("utf-8"))
    assert [(each["from"], each["to"]) for each in found["channels"]] == [("all", "no-mass"), ("all", "intent")]


def test_ablate__behind_a_shield_refuses_a_level_whose_messages_lack_a_piece_before_it_trains(
    levels: list[str],
) -> None:
    where = r"level 'no-mass' behind the shield: messages of vehicle_1 do not contain its mass"
    with pytest.raises(InvalidInput, match=where):
        plan_ablation(",".join(levels), "ppo", None, quick=True, shield="step", folder=Path("out"))
    assert not Path("out").exists()
