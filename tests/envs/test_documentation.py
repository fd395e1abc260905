from __future__ import annotations

import re
from pathlib import Path

import pytest

from ethbrake_marl.envs.interfaces import EthBrakeEnv
from ethbrake_marl.observations import Feature
from tests.envs.lines import REST
from tests.reference.docs_tables import environment_tables, feature_table

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "environment.md").read_text("utf-8")


def test_feature_table__has_one_line_for_each_feature() -> None:
    table = feature_table([Feature("own.speed", "m/s", 20.0, -2.0, 4.0, "own speed")])
    assert table.splitlines() == [
        "| # | feature | unit | scale | low | high | meaning |",
        "| --- | --- | --- | --- | --- | --- | --- |",
        "| 0 | `own.speed` | m/s | 20 | -2 | 4 | own speed |",
    ]


@pytest.mark.parametrize("marker", environment_tables())
def test_page__shows_the_table_that_the_code_makes(marker: str) -> None:
    match = re.search(f"<!-- {marker} -->\n(.*?)\n<!-- end -->", PAGE, re.DOTALL)
    assert match is not None
    assert match[1] == environment_tables()[marker]


def test_page__names_every_info() -> None:
    env = EthBrakeEnv(REST)
    env.reset(seed=0)
    info = env.step(env.action_space.low)[4]
    table = PAGE.split("## Infos")[1].split("There is no clock")[0]
    named = {
        name
        for line in table.splitlines()
        if line.startswith("| `")
        for name in re.findall("`(.*?)`", line.split("|")[1])
    }
    assert named == set(info)


def test_page__its_example_runs() -> None:
    code = re.search("```python\n(.*?)```", PAGE, re.DOTALL)
    assert code is not None
    names: dict[str, object] = {}
    exec(code[1].replace("4096", "4").replace("512", "4"), names)
    assert {"env", "many", "vec"} <= set(names)
