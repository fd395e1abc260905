"""The table of all keys of ``v2x``: on its page, and in ``scenario show``."""

import numpy as np
import pytest

from ethbrake_marl.cli.app import run_command
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.yaml import parse_yaml
from ethbrake_marl.worlds.catalogue import load_scenario
from ethbrake_marl.worlds.channel import PER_LINK, PRESETS, V2X
from ethbrake_marl.worlds.channel_table import key_table, page_table, values_of
from ethbrake_marl.worlds.scenario_file import whole_text
from tests.docs.site import DOCS

BUILT_IN = [name for name, settings in PRESETS.items() if "preset" not in settings]


def test_page__has_the_table_of_the_code() -> None:
    assert page_table() in (DOCS / "cooperation.md").read_text("utf-8")


def test_table__has_every_key_and_every_preset() -> None:
    head, *rows = key_table()
    assert head == ["key", *BUILT_IN, "meaning"]
    table = {row[0]: dict(zip(head, row, strict=True)) for row in rows}
    assert table.keys() >= {*V2X.key_fields()} and all(row["meaning"] for row in table.values())
    assert [table["silent_links"][name] for name in BUILT_IN] == ["0", "0", "0", "0.05", "0.2", "–"]
    assert [table["loss_begins"][name] for name in BUILT_IN] == ["–", "0.01", "0.05", "0.1", "0.2", "–"]


@pytest.mark.parametrize("preset", BUILT_IN)
def test_values__make_the_same_channel(preset: str) -> None:
    channel, again = V2X.model_validate(preset), V2X.model_validate(values_of(V2X.model_validate(preset)))
    u, nobody = np.random.default_rng(3).random((500, 9 * PER_LINK)), np.zeros((1, 3, 3), bool)
    own = np.tile([0.0, 0.2, 0.5], (500, 1))
    for here, there in zip(channel.news(own, u, nobody), again.news(own, u, nobody), strict=True):
        assert here.tobytes() == there.tobytes()
    assert values_of(again) == values_of(channel)


@pytest.mark.parametrize("name", ["cooperation-2-blocked", "messages-noisy", "benchmark-blocked"])
def test_scenario_show__prints_all_keys_of_v2x(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["scenario", "show", name]) == 0
    printed = capsys.readouterr().out
    content = parse_yaml(printed).content
    assert content["v2x"] == values_of(load_scenario(name).v2x) and content["v2x"]["loss_begins"] > 0.0
    rows = dict(line.removeprefix("# ").split(maxsplit=1) for line in printed.splitlines() if line.startswith("# "))
    assert rows.keys() >= {*V2X.key_fields()}
    assert load_scenario(content).sample(20, 7).know.tobytes() == load_scenario(name).sample(20, 7).know.tobytes()
    assert "All keys" not in whole_text("paper-random")


@pytest.mark.parametrize(
    "v2x", [{"preset": "nominal", "lost": 0.3}, {"preset": "paper", "lost": 0.0}, {"lost": 0.3, "hears": "front"}]
)
def test_old_key__is_refused_with_what_to_write(v2x: dict[str, object]) -> None:
    right = r"^.*v2x\.lost: unknown key; write silent_links .*; for 30 % of all messages write loss_begins: 0\.3,.*$"
    with pytest.raises(InvalidInput, match=right) as caught:
        load_scenario("paper-random").replace(v2x=v2x)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("begins", "ends", "share"), [(0.3, 0.7, 0.3), (0.1, 0.9, 0.1), (0.2, 0.2, 0.5)])
def test_share_of_messages__is_lost(begins: float, ends: float, share: float) -> None:
    channel = V2X.model_validate({"preset": "nominal", "loss_begins": begins, "loss_ends": ends})
    u = np.random.default_rng(0).random((100_000, PER_LINK))
    u[:, 0] = 0.5
    late = np.rint((channel.first_message_s(u) - 0.37) / 0.1)  # number of messages that are lost before the first
    assert (late >= 1.0).mean() == pytest.approx(share, abs=0.006)
    assert (late >= 2.0).mean() == pytest.approx(share * (1.0 - ends), abs=0.006)
