"""The pages about the reproduction: their numbers are those of the code."""

import re
from pathlib import Path

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.agents.pairwise import pairwise
from ethbrake_marl.evaluation.statistics import mean, rate
from ethbrake_marl.extensions.report.style import picture_bytes
from ethbrake_marl.extensions.reproduction.items import ITEMS
from ethbrake_marl.extensions.reproduction.readings import NON_ETHICAL, READINGS, drive
from ethbrake_marl.extensions.reproduction.verdicts import PERCENT
from tests.docs.printed import rows as table_of
from tests.docs.site import DOCS, load

PAGE = (DOCS / "extensions" / "reproduction.md").read_text("utf-8")
RESULTS = (DOCS / "results" / "reproduction.md").read_text("utf-8")

sampling = load("../studies/sampling")


@pytest.mark.parametrize("agent", sampling.AGENTS)
def test_sampling__prints_the_errors_that_the_page_tells(agent: str) -> None:
    study = sampling.convergence(agent, steps_s=(0.2, 0.1, 0.05))
    exact, *_, coarse = sampling.table(study).partition("| 0.05 |")[0].split("| 0.1 | ")
    told = [re.search(r"mean harm (\S+)", exact)[1], coarse.split(" | ")[0]]
    assert [figure for figure in told if figure not in PAGE] == []
    assert picture_bytes(sampling.draw([study]), "study.png").startswith(b"\x89PNG")


def test_map__example_of_the_page_runs_and_prints_its_figures(capsys: pytest.CaptureFixture[str]) -> None:
    (block,) = re.findall("```python\n(.*?)```", PAGE, re.DOTALL)
    exec(block, {})
    harm, collided = map(float, capsys.readouterr().out.split())
    assert (f"{harm:.2f}", f"{100.0 * collided:.1f} %") == ("23.48", "85.4 %")
    assert "23.48 m²/s² with steps of 0.1 s (85.4 %" in " ".join(PAGE.split())


def committed(heading: str, agent: str) -> list[str]:
    """An agent's row in the table below a heading of the results page, without intervals."""
    (row,) = (row for row in table_of("results/reproduction", heading) if row[0] == agent)
    return [cell.split(" [")[0] for cell in row[1:]]


def test_results__are_as_committed() -> None:
    for name, heading, predicted in (("paper-distance", "### Speeds 20, 18, 20 m/s, as stated", "3.07"),
                                     ("paper-random", "### Speeds 18 to 22 m/s, as stated", "9.38")):  # fmt: skip
        assert f"{pairwise(eb.load_scenario(name).sample(5_000, 7), 2).harm.mean():.2f}" == predicted
        assert committed(heading, "E-V2X-BM, realised")[3] == predicted
    for reading, heading in zip(READINGS, ("### As stated", "### Vehicle 2 acts at 0.2 s"), strict=True):
        own = drive(reading.scenario("paper-random"), {NON_ETHICAL: "full_brake"}, 10_000)[NON_ETHICAL]
        told = PERCENT.show(rate(own["collided"])).value, f"{mean(own['first_impact_harm']).value:.2f}"
        assert tuple(committed(heading, NON_ETHICAL)[:2]) == told
    scenario = eb.load_scenario("paper-distance")
    groups = np.digitize(scenario.sample(5_000, 7).gaps_m.sum(axis=1), (12.0, 14.0, 16.0, 18.0))
    harm = drive(scenario, {NON_ETHICAL: "full_brake"}, 5_000)[NON_ETHICAL]["first_impact_harm"]
    told = committed("### Harm by total distance, as stated", NON_ETHICAL)
    assert told == [f"{harm[groups == group].mean():.2f}" for group in range(5)]


def test_pages__show_every_item_and_figures_that_exist() -> None:
    assert [line for line in RESULTS.splitlines() if line.startswith("## ")] == [f"## {item.title}" for item in ITEMS]
    for label in (label for item in ITEMS for label in item.labels):
        assert f"`{label}`" in PAGE
    for name in re.findall(r"\]\(\.\./figures/([^)]+)\)", RESULTS + PAGE):
        assert (DOCS / "figures" / name).is_file()
    shown = {Path(name).name for name in re.findall(r"figures/(reproduction-[^)]+)\)", RESULTS)}
    assert {path.name for path in (DOCS / "figures").glob("reproduction-*")} == shown
