"""Settings KEY=VALUE of recipes and scenarios, and the YAML that they are written in."""

import ethbrake_marl.first_edition as eb
from ethbrake_marl.files.overrides import Override
from ethbrake_marl.files.yaml import flow_text, parse_yaml
from ethbrake_marl.first_edition.evaluation.trial import load_runnable
from ethbrake_marl.first_edition.training.settings import read_settings

PPO = eb.load_recipe("ppo")


def load(*texts):
    return load_runnable("paper-random", read_settings(texts).scenario)


def test_settings__are_typed_by_the_rules_of_yaml() -> None:
    assert Override.put(
        {}, Override.parse(["a=1", "b=0.5", "c=true", "d=x", "e={uniform: [1, 2]}", "f.g.h=null", "i='1'"])
    ) == {"a": 1, "b": 0.5, "c": True, "d": "x", "e": {"uniform": [1, 2]}, "f": {"g": {"h": None}}, "i": "1"}
    content = {"a": {"b": [1, 2], "c": 3}, "d": 4}
    assert Override.put(content, Override.parse(["a.b.1=5", "a.e=6"])) == {"a": {"b": [1, 5], "c": 3, "e": 6}}
    assert content == {"a": {"b": [1, 2], "c": 3}, "d": 4}


def test_settings__belong_to_the_recipe_or_to_the_scenario() -> None:
    given = read_settings(["gamma=0.9", "scenario.mass_t=40", "recipe.seed=3"], [PPO])
    assert [[each.key for each in part] for part in (given.recipe, given.scenario)] == [["gamma", "seed"], ["mass_t"]]


def test_settings_of_a_recipe__are_checked_and_a_pair_is_kept_together() -> None:
    changed = read_settings(["learning_rate.start=0.002", "network.policy=[8]"], [PPO]).change(PPO)
    assert (changed.learning_rate.start, changed.learning_rate.end) == (0.002, PPO.learning_rate.end)
    assert (changed.network.policy, changed.network.value) == ((8,), PPO.network.value)
    assert {name for name in type(PPO).model_fields if getattr(PPO, name) != getattr(changed, name)} == {
        "learning_rate",
        "network",
    }


def test_settings_of_a_scenario__change_what_they_name() -> None:
    assert load("restitution=0.3").bounds("restitution") == ((0.3, 0.3),)
    assert load("roles.vehicle_3=coast").scripts[2] == "coast"
    assert load("roles.vehicle_3=coast").learners == (1,)
    assert load("gaps_m.uniform.1=12").bounds("gaps_m")[0][1] == 12.0
    assert load("v2x.preset=blocked").v2x.preset == "blocked"


def test_document__nests_and_knows_its_lines() -> None:
    document = parse_yaml("a:\n  - 1\n  - {b: [2, three]}\nc: |\n  long\n  text\n", "file.yaml")
    assert document.content == {"a": [1, {"b": [2, "three"]}], "c": "long\ntext\n"}
    assert [document.line_of(place) for place in (("a", 1, "b", 0), ("c",), ("a", 7))] == [3, 4, 1]
    assert parse_yaml(b"\xef\xbb\xbfa: 1").content == {"a": 1}


def test_flow_text__is_written_as_one_would_write_it() -> None:
    assert (
        flow_text({"uniform": [5.0, 7.5], "weights": [True, None], "role": "constant:3.5", "text": "a b"})
        == '{uniform: [5, 7.5], weights: [true, null], role: constant:3.5, text: "a b"}'
    )
    assert flow_text([1.0] * 50, 20) == "[1, 1, 1, 1, 1, 1..."
