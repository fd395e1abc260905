"""What a scenario says, the shipped ones, and what editors and pages are told.

Refusals: ``test_refusals``. The names of the shipped ones stand in ``cli/printed/scenarios.txt``, their worlds in
``golden``.
"""

import copy
import json
import pickle
import re
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jsonschema import Draft202012Validator
from pydantic import ValidationError

import ethbrake_marl.first_edition as eb
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.yaml import flow_text, parse_yaml, read_yaml
from ethbrake_marl.first_edition.evaluation.identity import scenario_sha256
from ethbrake_marl.first_edition.evaluation.trial import load_runnable
from ethbrake_marl.first_edition.game.harm import HARM_COUNTS, empty_ledger
from ethbrake_marl.first_edition.scenario import catalogue
from ethbrake_marl.first_edition.scenario.catalogue import new_scenario_text, shipped_folder
from ethbrake_marl.first_edition.scenario.channel import PRESETS
from ethbrake_marl.first_edition.scenario.distributions import Uniform
from ethbrake_marl.first_edition.scenario.fields import QUANTITY
from ethbrake_marl.first_edition.scenario.mixtures import changed_content
from ethbrake_marl.first_edition.scenario.roles import ScriptSpec
from ethbrake_marl.first_edition.scenario.schema import scenario_json_schema
from tests.first_edition.contract.interfaces import LEVELS

GIVEN = {
    "name": "given",
    "gaps_m": {"uniform": [5, 10]},
    "speeds_mps": [20, 18, 20],
    "braking_capacity_mps2": [6, 7, 6],
    "driving_capacity_mps2": [6, 7, 6],
    "mass_t": [4.5, 5.5, 5.9],
    "latency_s": [0, 0.5, 0.8],
}


def build(**changes: object) -> eb.Scenario:
    return eb.Scenario(**{**GIVEN, **changes})


# ---------------------------------------------------------------- one scenario


TYPED = {"vehicle_types": {"car": {"weight": 3}, "truck": {"mass_t": {"with_load": [14, 40]}}}}


@pytest.mark.parametrize(
    "changes",
    [
        {"mass_t": {"choice": [4, 5], "weights": [1, 2]}, "roles": {"vehicle_2": "constant:3"}},
        {**TYPED, "types": ["truck", "any", {"car": 2}]},
        *({"v2x": preset} for preset in PRESETS),
        None,
    ],
)
def test_scenario__is_the_same_as_a_copy_as_declared_and_as_json_and_told_by_its_hash(changes: Any) -> None:
    scenario = eb.load_scenario("mixture-delays") if changes is None else build(**changes)
    again = [copy.deepcopy(scenario), pickle.loads(pickle.dumps(scenario)), eb.Scenario(**scenario.declared())]
    again.append(eb.Scenario.model_validate_json(json.dumps(scenario.declared())))
    for each in again:
        assert each == scenario and scenario_sha256(each) == scenario_sha256(scenario)
        assert [member.name for member in each.members] == [member.name for member in scenario.members]
    assert scenario_sha256(scenario.replace(restitution=0.3)) != scenario_sha256(scenario)
    with pytest.raises(ValidationError, match="frozen"):
        scenario.vehicles = 4


# ---------------------------------------------------------------- the shipped scenarios


def not_used(scenario: eb.Scenario) -> set[str]:
    """The keys of the ways to declare gaps, speeds and an obstacle that it does not use; what it does not choose."""
    if scenario.members:
        return set(eb.Scenario.model_fields) - {"name", "title", "description", "source", "mixture"}
    gaps = {key for key in ("gaps_m", "time_gaps_s") if getattr(scenario, key) is None}
    speeds = {key for key in ("speeds_mps", "line_speed_mps") if getattr(scenario, key) is None}
    speeds |= {"speed_deviations_mps"} if scenario.line_speed_mps is None else set()
    obstacle = {key for key in ("obstacle_gap_m", "obstacle_margin_m") if getattr(scenario, key) is None}
    chosen = ("observation", "vehicle_types", "types", "mixture", "table", "friction", "alert_s", *QUANTITY.needed)
    chosen = (*chosen, "brake_rate_mps3", "release_rate_mps3", "harm_weight", "follower")
    return {*gaps, *speeds, *obstacle, *(key for key in chosen if getattr(scenario, key) is None)}


@cache
def editor() -> Draft202012Validator:
    return Draft202012Validator(scenario_json_schema())


@pytest.mark.parametrize("path", [entry.path for entry in eb.list_scenarios()], ids=lambda path: path.stem)
def test_shipped__reads_back_by_name_path_and_folder_and_a_new_file_is_based_on_it(path: Path) -> None:
    scenario, folder = eb.load_scenario(path.stem), path.parent.name
    text = "\n".join(f"{key}: {flow_text(value)}" for key, value in scenario.declared().items())
    short = f"{folder}/{path.stem.removeprefix(f'{folder}-')}"
    assert eb.load_scenario(path) == eb.load_scenario(short) == scenario
    assert eb.Scenario.from_document(parse_yaml(text, limit=1 << 20)) == scenario
    assert scenario.sample(3, 0).worlds.n == 3
    assert scenario.title and scenario.description and scenario.source
    text = new_scenario_text("mine", based_on=path.stem)
    own = {"name", "title", "description", "source"}
    new = eb.load_scenario(parse_yaml(text, limit=1 << 20).content)
    assert new.model_dump(exclude=own) == scenario.model_dump(exclude=own) and new.name == "mine"
    assert all(re.search(rf"^# .*\n(# )?{key}:", text, re.MULTILINE) for key in eb.Scenario.model_fields)
    assert {key for key in eb.Scenario.model_fields if f"\n# {key}:" in text} == not_used(scenario)
    assert not re.search(r"[ \t]$", text, re.MULTILINE)
    for content in (read_yaml(path).content, parse_yaml(text, limit=1 << 20).content):
        assert [error.message for error in editor().iter_errors(content)] == []


def test_path__a_name_that_nobody_has_is_that_of_a_file_without_its_ending(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("my/folder").mkdir(parents=True)
    for file in ("mine.yaml", "my/folder/mine.yaml", "my/folder/bad.yaml", "paper-random.yaml"):
        declared = {**eb.load_scenario("paper-random").declared(), "name": Path(file).stem, "title": file}
        bad = {"roles": {"vehicle_3": "brak"}} if "bad" in file else {}
        Path(file).write_text(json.dumps({**declared, "early_impacts": "keep", **bad}))
    Path("my/folder/mixed.yaml").write_text("name: mixed\nmixture: [{scenario: mine}, {scenario: paper-random}]\n")
    for name in ("mine", "./mine", "my/folder/mine", Path("my/folder/mine")):
        assert eb.load_scenario(name).title == f"{Path(name)}.yaml"
    assert eb.load_scenario("paper-random").title != "paper-random.yaml"  # the shipped one, whatever lies here
    with pytest.raises(InvalidInput, match=r"^my/folder/bad.yaml, line 1: roles.vehicle_3 = brak: unknown agent"):
        load_runnable("my/folder/bad")
    Path("mine.yaml").unlink()
    own, shipped = eb.load_scenario("my/folder/mixed").members  # looked for beside the mixture
    assert (own.early_impacts, shipped.early_impacts) == ("keep", "reject")


@pytest.mark.parametrize("name", ["cooperation-3-pair", "cooperation-3-five"])
def test_level_4__has_the_lines_of_level_3_and_full_braking_never_meets_its_obstacle(name: str) -> None:
    level_3, level_4 = LEVELS[name], LEVELS[name.replace("3-pair", "4-all").replace("3-five", "4-five")]
    assert level_4.learners == tuple(range(level_4.vehicles)) and level_4.obstacle_gap_m == 42.0
    worlds = {"3": level_3.sample(2_000, 7).worlds, "4": level_4.sample(2_000, 7).worlds}
    ledgers = {}
    for key, at_alert in worlds.items():
        _, impacts = eb.advance(at_alert, -at_alert.vehicles.braking_capacity_mps2, until_s=8.0)
        ledgers[key] = empty_ledger(at_alert).add(impacts)
    assert not ledgers["4"].obstacle_count.any() and ledgers["3"].collided.sum() > 1_000
    for harm_count in HARM_COUNTS:
        assert ledgers["4"].vehicle_harm(harm_count).tobytes() == ledgers["3"].vehicle_harm(harm_count).tobytes()
    v, a = worlds["4"].speeds_mps[:, 0], worlds["4"].vehicles.braking_capacity_mps2[:, 0]
    assert (v * v / (2.0 * a) < worlds["4"].obstacle_gap_m).all()


# ---------------------------------------------------------------- folders, editors, pages


@pytest.mark.parametrize("kind", ["scenarios", "recipes"])
def test_folder__of_an_installed_package_is_inside_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    monkeypatch.setattr(catalogue, "_PACKAGE", tmp_path / "ethbrake_marl")
    name, find = {"scenarios": ("scenarios", shipped_folder), "recipes": ("train", eb.TrainingRecipe.shipped)}[kind]
    with pytest.raises(InvalidInput, match=rf"the shipped {kind} are missing: .*reinstall"):
        find()
    installed = tmp_path / "ethbrake_marl" / "_data" / name
    installed.mkdir(parents=True)
    (installed / "mine.yaml").touch()
    (tmp_path / name).mkdir()  # somebody else's folder: no pyproject.toml beside it
    assert find() == (installed if kind == "scenarios" else {"mine": installed / "mine.yaml"})
    (tmp_path / "pyproject.toml").touch()
    assert find() == (tmp_path / name if kind == "scenarios" else {})


def written(key: str, x: float, inside: float) -> list[dict[str, Any]]:
    """Scenarios with the number ``x`` in every place of a quantity, also of a type; ``inside`` is in its range."""
    low, high = sorted((x, inside))
    drawn = [
        x,
        {"uniform": [low, high]},
        {"loguniform": [low, high]},
        {"normal": {"mean": inside, "sd": high - low, "low": low, "high": high}},
        {"choice": [inside, x], "weights": [1, 5000]},
    ]
    rule = QUANTITY.declared.get(key)
    entries = drawn if rule is None or rule.per == "world" else [*drawn, *([each] * rule.count(3) for each in drawn)]
    beside = {"line_speed_mps": 9} if key == "speed_deviations_mps" else {}
    alone = [changed_content(GIVEN, {**beside, key: entry}) for entry in entries if rule is not None]
    of_a_type = [*drawn, {"with_load": [x, inside]}] if key in QUANTITY.of_a_type else drawn * (key == "load")
    return [*alone, *({**GIVEN, "vehicle_types": {"car": {key: entry}}} for entry in of_a_type)]


def in_range(content: dict[str, Any]) -> bool:
    """Whether the reader finds every number in its range, whatever it says of keys that limit each other."""
    try:
        eb.Scenario(**content)
    except InvalidInput as error:
        return re.search(r"must be (finite and )?in |low must be above 0", str(error)) is None
    return True


@pytest.mark.parametrize("key", [*QUANTITY.declared, "load"])
def test_json_schema__a_number_is_in_range_exactly_where_the_reader_says_so(key: str) -> None:
    editor = Draft202012Validator(scenario_json_schema())
    rule = QUANTITY.declared.get(key, QUANTITY.declared["restitution"])  # of both the range is [0, 1]
    least, most = (np.nextafter(0.0, 1.0) if rule.positive else rule.low), rule.high
    inside = (least + 3 * most) / 4
    for x, good in ((least, True), (np.nextafter(least, -1e9), False), (most, True), (np.nextafter(most, 1e9), False)):
        for content in written(key, float(x), inside):
            told = in_range(content), editor.is_valid(content)
            above_0 = "loguniform" in str(content) and x <= 0.0
            assert told == (good and not above_0,) * 2, content


def test_scenario__one_entry_stands_for_all() -> None:
    scenario = build(mass_t=5, gaps_m=[7, {"uniform": [5, 10]}])
    assert scenario.quantities("mass_t") == (5.0, 5.0, 5.0)
    assert scenario.quantities("restitution") == (0.1,)
    assert scenario.quantities("gaps_m") == (7.0, Uniform(uniform=(5.0, 10.0)))


def test_replacement__changes_one_field_and_checks_again() -> None:
    scenario = build().replace(latency_s=[0, 0.2, 0.8])
    assert scenario.latency_s == (0.0, 0.2, 0.8)
    assert scenario.mass_t == (4.5, 5.5, 5.9)
    numpys = build(speeds_mps=np.array([20, 18, 20]), restitution=np.float64(0.3))
    assert numpys.speeds_mps == (20.0, 18.0, 20.0)
    assert numpys.restitution == 0.3
    same = {key: 5 for key in ("speeds_mps", "braking_capacity_mps2", "driving_capacity_mps2", "mass_t")}
    scenario = eb.Scenario(name="any", gaps_m=7, latency_s=0.1, **same)
    assert scenario.replace(vehicles=5).sample(1, 0).worlds.N == 5
    assert scenario.replace(vehicles=5).learners == (1,)
    assert dict(scenario.replace(vehicles=2).roles) == {"vehicle_1": "full_brake", "vehicle_2": "learner"}


def test_learners__whoever_is_left_out_or_no_longer_learns_brakes_fully() -> None:
    for scenario in (build(roles={"vehicle_3": "learner"}), build().with_learners(["vehicle_3"])):
        assert scenario.learners == (2,)
        assert scenario.scripts == {0: "full_brake", 1: "full_brake"}
        assert dict(scenario.roles) == {"vehicle_1": "full_brake", "vehicle_2": "full_brake", "vehicle_3": "learner"}
    assert build().with_learners([]).learners == ()
    assert type(build().model_dump()["roles"]) is dict


@pytest.mark.parametrize(
    ("spec", "expected"),
    [
        ("full_brake", (("full_brake", None), True, [-6.0, -7.0])),
        ("coast", (("coast", None), True, [0.0, 0.0])),
        ("constant:3.5", (("constant", "3.5"), True, [-3.5, -3.5])),
        ("constant:6", (("constant", "6"), True, [-6.0, -6.0])),
        ("constant:-2", (("constant", "-2"), True, [2.0, 2.0])),
        ("e_v2x_bm:pairwise", (("e_v2x_bm", "pairwise"), False, None)),
        ("learned:runs/my-run", (("learned", "runs/my-run"), False, None)),
        ("policy@best.v1-a:b:c", (("policy@best.v1-a", "b:c"), False, None)),
    ],
)
def test_script__is_parted_at_the_first_colon_and_has_a_command_if_free_of_the_state(spec, expected) -> None:
    script = ScriptSpec.parse(spec)
    command = script.command([6.0, 7.0], [2.0, 3.0])
    assert (tuple(script), script.is_state_free(), command if command is None else command.tolist()) == expected


@pytest.mark.parametrize(
    ("name", "gaps_m", "speeds_mps", "latency_s"),
    [
        ("random", {"uniform": [5, 10]}, {"uniform": [18, 22]}, [0, 0.5, 0.8]),
        ("random-early", {"uniform": [5, 10]}, {"uniform": [18, 22]}, [0, 0.2, 0.8]),
        ("distance", {"uniform": [5, 10]}, [20, 18, 20], [0, 0.5, 0.8]),
        ("scenario-1", [10, 8], [20, 18, 20], [0, 0.5, 0.8]),
        ("scenario-2", [5, 9], [22, 18, 20], [0, 0.5, 0.8]),
        ("delay-low", {"uniform": [5, 10]}, {"uniform": [18, 22]}, [0, 0.1, 0.3]),
        ("delay-middle", {"uniform": [5, 10]}, {"uniform": [18, 22]}, [0, 0.3, 0.6]),
        ("delay-high", {"uniform": [5, 10]}, {"uniform": [18, 22]}, [0, 0.8, 1.2]),
    ],
)
def test_scenarios_of_the_paper__by_hand(name, gaps_m, speeds_mps, latency_s) -> None:
    scenario = eb.load_scenario(f"paper-{name}")
    declared = scenario.declared()
    assert (declared["gaps_m"], declared["speeds_mps"], declared["latency_s"]) == (gaps_m, speeds_mps, latency_s)
    assert declared["braking_capacity_mps2"] == declared["driving_capacity_mps2"] == [6, 7, 6]
    assert declared["mass_t"] == [4.5, 5.5, 5.9]
    assert (scenario.vehicles, scenario.restitution, scenario.early_impacts) == (3, 0.1, "reject")
    assert (scenario.time_step_s, scenario.horizon_s, scenario.speed_limit_mps) == (0.1, 8.0, 40.0)
    assert (scenario.learners, scenario.scripts) == ((1,), {0: "full_brake", 2: "full_brake"})


PAPER = eb.load_scenario("paper-random")


def test_hash_of_a_scenario__tells_its_values_not_its_words() -> None:
    own = scenario_sha256(PAPER)
    assert scenario_sha256(PAPER.replace(name="mine", title="t", description="d", source="s")) == own
    others = [PAPER.replace(restitution=0.2), PAPER.replace(horizon_s=9.0), PAPER.with_learners(["vehicle_3"])]
    assert len({own, *map(scenario_sha256, others)}) == 4
    types = {"car": {}, "truck": {"speed_limit_mps": 40.0}}
    for each in (PAPER, PAPER.replace(speed_limit_mps=30.0, vehicle_types=types, types=["car", "car", "truck"])):
        assert scenario_sha256(eb.Scenario.of_dump(each.model_dump(mode="json"))) == scenario_sha256(each)


@pytest.mark.parametrize(
    "objective",
    ["own", "maximin", "mass-weighted", "social:30", "weighted:1,4,2", "injury:gidas", ("own", "total", "own")],
)
def test_objective__comes_back_from_what_is_declared(objective) -> None:
    scenario = PAPER.replace(objective=objective)
    assert scenario.objective == objective
    assert eb.Scenario(**scenario.declared()) == scenario
