"""Names with paths in them: a path that exists wins over every sign that would separate something there."""

import shutil

import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.first_edition.agents.spec import parse_spec, split_names, split_specs
from ethbrake_marl.first_edition.policies.shipped import shipped_policies

NAMES = (
    "lr=0.001,seed=1",
    "c+step",
    "c+step,d",
    "x+search",
    "a:b",
    "a@b",
    "a,full_brake",
    "a,ppo@b",
    "my.py:make",
    "a,b+step,c=1@2:3",
    " a, b ",
)


@pytest.fixture(autouse=True)
def _here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def put(name):
    shutil.copytree(shipped_policies()["ppo"], name)


@pytest.mark.parametrize("folder", ["", "runs/", "./", "runs/2+3,4/"])
@pytest.mark.parametrize("name", NAMES)
def test_policy__in_a_folder_of_any_name_is_that_folder_wherever_agents_are_named(name, folder):
    check_folder(folder + name, ("", "+step"))


def check_folder(path, ways):
    put(path)
    for around in ways:
        spec = parse_spec(f"ppo@{path}{around}")
        assert (spec.name, spec.policy, "".join(f"+{each}" for each in spec.around)) == ("ppo", path, around)
        assert split_specs(f"full_brake,ppo@{path}{around},coast") == ["full_brake", f"ppo@{path}{around}", "coast"]
    assert split_specs(f"ppo@{path}+step,ppo@{path}") == [f"ppo@{path}+step", f"ppo@{path}"]
    assert split_names(f"{path},{path}") == [path, path]


def test_folder__that_is_not_there_separates_as_before():
    assert parse_spec("ppo@c+step").around == ("step",) and parse_spec("ppo@c+step").policy == "c"
    assert split_specs("ppo@lr=0.001,seed=1") == ["ppo@lr=0.001", "seed=1"]
    put("c+step")
    put("c")
    assert parse_spec("ppo@c+step").policy == "c+step" and parse_spec("ppo@c/+step").around == ("step",)
    assert parse_spec("ppo@c").policy == "c" and parse_spec("ppo@c+step+step").around == ("step",)


@pytest.mark.parametrize("name", ["constant:b.py", "policy@b.py"])
def test_scenario__cannot_name_a_python_file_however_it_is_called(name, tmp_path):
    (tmp_path / name).write_text("raise SystemExit('was run')", "utf-8")
    with pytest.raises(eb.EthBrakeError, match=r"is a function in a Python file, which a scenario cannot use"):
        eb.load_scenario("paper-random").replace(
            roles={"vehicle_1": f"{name}:make", "vehicle_2": "learner", "vehicle_3": "full_brake"}
        )
