"""Training schemes: who learns with whom, what is left of it, and that each of them learns."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.envs.sb3 import EthBrakeVecEnv, make_sb3_vec_env
from ethbrake_marl.errors import CorruptBundle, InvalidInput, UnknownName
from ethbrake_marl.learning import runs as train_module
from ethbrake_marl.learning.runs import make_model, resume, train
from ethbrake_marl.learning.training import RunDirectory, Training, TrainingRecipe, load_recipe
from ethbrake_marl.policies import PolicyTeam, load_policy
from tests.learning.tiny import TINY_PPO

PAIR = eb.load_scenario("cooperation-3-pair")
ALONE = eb.load_scenario("cooperation-2-paper")
NAMES = ("vehicle_2", "vehicle_3")
TINY = TINY_PPO.replace(total_steps=8 * 256)


def _weights(folder: Path) -> dict[str, str]:
    found = sorted(folder.rglob("manifest.json"))
    return {str(file.relative_to(folder)): json.loads(file.read_text())["weights_sha256"] for file in found}


def _watched(monkeypatch: pytest.MonkeyPatch, watch: Callable[[int, Any], Any]) -> None:
    """Let every step's answer pass through ``watch(number of the step, answer)``."""

    class Watched(EthBrakeVecEnv):
        count = 0

        def step_wait(self) -> Any:
            self.count += 1
            return watch(self.count, super().step_wait())

    def make(*args: Any, **kwargs: Any) -> EthBrakeVecEnv:
        environment = make_sb3_vec_env(*args, **kwargs)
        environment.__class__ = Watched
        return environment

    monkeypatch.setattr(train_module, "make_sb3_vec_env", make)


@pytest.mark.parametrize("scheme", ["shared", "independent", "centralised"])
def test_train__leaves_a_folder_that_drives_by_itself(scheme: Any, tmp_path: Path) -> None:
    result = train(TINY, PAIR, tmp_path / "run", scheme=scheme)
    assert (result.status, result.steps, result.updates, result.training.scheme) == ("finished", 8 * 256, 8, scheme)
    assert [entry["updates"] for entry in result.evaluations] == [0, 3, 6, 8]
    separate = scheme == "independent"
    given = {name: f"policy/{name}" if separate else "policy" for name in NAMES}
    content = json.loads((tmp_path / "run" / "team.json").read_text())
    assert (content["scheme"], content["vehicles"], content["drivers"]) == (scheme, 3, given)
    assert result.training.drivers == given and RunDirectory(tmp_path / "run").is_team == separate

    moved = tmp_path / "elsewhere"
    shutil.move(tmp_path / "run", moved)
    team = RunDirectory(moved).load_team(PAIR)
    assert sorted(team.drivers) == [1, 2]
    worlds = PAIR.sample(10, 7)
    harm = eb.evaluate(worlds, {"team": team}, scenario=PAIR).outcome("team").first_impact_harm.mean()
    assert harm == pytest.approx(min(entry["first_impact_harm"] for entry in result.evaluations))
    for name in NAMES:
        manifest = load_policy(moved / given[name]).manifest
        assert manifest.learners == ((name,) if separate else NAMES)
        assert bool(manifest.network.value_hidden) == (scheme != "centralised")
    if separate:
        assert len(set(_weights(moved / "policy").values())) == 2


def test_train__without_a_scheme_one_learner_is_single_and_measuring_changes_nothing(tmp_path: Path) -> None:
    result = train(TINY, ALONE, tmp_path / "run", steps=256)
    assert (result.training.scheme, result.training.drivers) == ("single", {"vehicle_2": "policy"})
    train(TINY, ALONE, tmp_path / "unmeasured", steps=256, measure=None)
    assert _weights(tmp_path / "run" / "policy-last") == _weights(tmp_path / "unmeasured" / "policy-last")


def _history(recipe: TrainingRecipe, folder: Path) -> list[dict[str, str]]:
    """Hashes of the learners' weights before the first update and after each one."""
    seen: list[dict[str, str]] = []

    def note(team: PolicyTeam) -> dict[str, float]:
        seen.append({name: policy.manifest.weights_sha256 for name, policy in team.drivers.items()})
        return {}

    often = recipe.replace(evaluation={"every_updates": 1, "worlds": 1, "seed": 7})
    train(often, PAIR, folder, measure=lambda training: note)
    return seen


def test_independent__all_learn_at_once_or_in_turns(tmp_path: Path) -> None:
    def changed(history: list[dict[str, str]]) -> list[list[str]]:
        return [[n for n in NAMES if a[n] != b[n]] for a, b in pairwise(history)]

    together = _history(TINY.replace(scheme="independent", total_steps=2 * 256), tmp_path / "together")
    assert changed(together[:3]) == [[*NAMES], [*NAMES]]
    turns = _history(TINY.replace(scheme="independent", turns=2), tmp_path / "turns")
    first, second = ["vehicle_2"], ["vehicle_3"]
    assert changed(turns[:9]) == [first, first, second, second, first, first, second, second]


def test_independent__nobody_learns_from_anothers_reward(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recipe = TINY.replace(scheme="independent", total_steps=256)
    plain = _history(recipe, tmp_path / "plain")[1]

    def spoil(step: int, answer: Any) -> Any:
        answer[1][1::2] *= 3.0  # rows of vehicle_3
        return answer

    _watched(monkeypatch, spoil)
    spoiled = _history(recipe, tmp_path / "spoiled")[1]
    assert plain["vehicle_2"] == spoiled["vehicle_2"]
    assert plain["vehicle_3"] != spoiled["vehicle_3"]


def test_independent__a_row_that_is_cut_off_gets_the_value_of_its_own_learner() -> None:
    recipe = TINY.replace(scheme="independent")
    environment = make_sb3_vec_env(PAIR, 8, appended="number", reward=recipe.reward)
    policy: Any = make_model(recipe.make_algorithm(), Training.of(recipe, PAIR), environment).policy
    seen = environment.reset()
    assert seen.shape == (16, environment.engine.observation.size + 1)
    assert seen[:, -1].tolist() == [0.0, 1.0] * 8
    tensor = policy.obs_to_tensor(seen)[0]
    values = policy.predict_values(tensor)[:, 0]
    for number, member in enumerate(policy.policies):
        own = member.predict_values(tensor[number::2, :-1])[:, 0]
        np.testing.assert_allclose(values[number::2].detach().numpy(), own.detach().numpy(), atol=1e-6)
    alone = policy.predict_values(policy.obs_to_tensor(seen[1])[0])
    assert alone.item() == pytest.approx(values[1].item(), abs=1e-6)


def test_centralised__the_critic_sees_the_line_and_the_actor_does_not() -> None:
    recipe = TINY.replace(scheme="centralised")
    environment = make_sb3_vec_env(PAIR, 8, appended="state", reward=recipe.reward)
    policy: Any = make_model(recipe.make_algorithm(), Training.of(recipe, PAIR), environment).policy
    own = environment.engine.observation.size
    seen = policy.obs_to_tensor(environment.reset())[0]
    elsewhere = seen.clone()
    elsewhere[:, own:] += 0.1
    actions = [policy.get_distribution(each).distribution.mean for each in (seen, elsewhere)]
    assert (actions[0] == actions[1]).all()
    assert (policy.predict_values(seen) != policy.predict_values(elsewhere)).all()


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize(
    "scheme",
    [
        pytest.param("shared", marks=pytest.mark.slow),  # these three have less to keep than turns
        pytest.param("independent", marks=pytest.mark.slow),
        "turns",
        pytest.param("centralised", marks=pytest.mark.slow),
    ],
)
def test_resume__after_a_failure_or_ctrl_c_it_ends_as_if_nothing_had_happened(
    scheme: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    turns = {"scheme": "independent", "turns": 2}
    recipe = TINY.replace(**(turns if scheme == "turns" else {"scheme": scheme}))
    whole = train(recipe, PAIR, tmp_path / "whole")

    def fail(step: int, answer: Any) -> Any:
        if step == 5 * 16 + 3:
            raise RuntimeError("power cut")
        return answer

    def ctrl_c(step: int, answer: Any) -> Any:
        if step == 20:
            os.kill(os.getpid(), signal.SIGINT)
        return answer

    with monkeypatch.context() as patch:
        _watched(patch, fail)
        with pytest.raises(RuntimeError, match="power cut"):
            train(recipe, PAIR, tmp_path / "run")
    with monkeypatch.context() as patch:
        _watched(patch, ctrl_c)
        assert resume(tmp_path / "run").status == "interrupted"
    (tmp_path / "run" / "team.json").write_text("{}")
    result = resume(tmp_path / "run")
    assert (result.status, result.updates) == ("finished", 8)
    assert result.evaluations == whole.evaluations
    assert (tmp_path / "run" / "team.json").read_bytes() == (tmp_path / "whole" / "team.json").read_bytes()
    for folder in ("policy", "policy-last"):
        assert _weights(tmp_path / "run" / folder) == _weights(tmp_path / "whole" / folder)


KILLED = """
import os, signal, sys
from pathlib import Path
from tests.learning.test_teams import TINY, PAIR
from ethbrake_marl.learning.runs import train
def tell(progress):
    if progress.updates == 5:
        os.kill(os.getpid(), signal.SIGKILL)
train(TINY, PAIR, Path(sys.argv[1]), scheme="independent", on_progress=tell)
"""


@pytest.mark.long
def test_resume__after_kill_9_independent_learners_have_the_same_weights(tmp_path: Path) -> None:
    root = Path(__file__).resolve().parents[2]
    killed = subprocess.run([sys.executable, "-c", KILLED, tmp_path / "run"], cwd=root, check=False)
    assert killed.returncode == -signal.SIGKILL
    train(TINY, PAIR, tmp_path / "whole", scheme="independent")
    resume(tmp_path / "run")
    for folder in ("policy", "policy-last"):
        assert _weights(tmp_path / "run" / folder) == _weights(tmp_path / "whole" / folder)


def test_independent__stops_at_numbers_that_are_not_finite(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def spoil(step: int, answer: Any) -> Any:
        if step == 20:
            answer[1][1] = np.nan
        return answer

    _watched(monkeypatch, spoil)
    with pytest.raises(ArithmeticError, match=r"rewards\[row 1\] = nan at step"):
        train(TINY, PAIR, tmp_path / "run", scheme="independent")
    assert load_policy(tmp_path / "run" / "policy-last" / "vehicle_3").manifest.steps == 256


def test_scheme__that_does_not_fit_is_refused_before_anything_is_made(tmp_path: Path) -> None:
    nobody = PAIR.with_learners([])
    cases: list[tuple[Any, Any, Any, str]] = [
        (TINY, PAIR, "single", "'cooperation-3-pair' has 2 learners; use shared, independent or centralised"),
        (TINY, ALONE, "independent", "'cooperation-2-paper' has one learner; use single"),
        (TINY, nobody, "shared", "no vehicle learns"),
        (load_recipe("sac"), PAIR, "independent", "recipe 'sac' is for SAC; it needs one for PPO"),
        (load_recipe("sac"), PAIR, "centralised", "recipe 'sac' is for SAC; it needs one for PPO"),
    ]
    for recipe, scenario, scheme, message in cases:
        with pytest.raises(InvalidInput, match=message):
            train(recipe, scenario, tmp_path / "run", scheme=scheme)
    with pytest.raises(InvalidInput, match=r"turns = 3: is for scheme: independent only"):
        train(TINY, PAIR, tmp_path / "run", scheme="shared", turns=3)
    with pytest.raises(InvalidInput, match=r"turns = 5: 2 learners need 10 updates, .* are 8"):
        train(TINY, PAIR, tmp_path / "run", scheme="independent", turns=5)
    with pytest.raises(InvalidInput, match="scheme = centralized: must be single, shared, independent or centralised"):
        TINY.replace(scheme="centralized")
    assert list(tmp_path.iterdir()) == []


def test_scheme__of_a_recipe_and_who_drives_what() -> None:
    assert Training.of(TINY, ALONE).scheme == "single" and Training.of(TINY, PAIR).scheme == "shared"
    assert Training.of(TINY, PAIR, scheme="centralised").scheme == "centralised"
    assert Training.of(TINY, PAIR).who_drives() == "scheme shared: policy drives vehicle_2, vehicle_3"
    told = "scheme independent: policy/vehicle_2 drives vehicle_2; policy/vehicle_3 drives vehicle_3"
    assert Training.of(TINY, PAIR, scheme="independent").who_drives() == told


def test_train__takes_names_as_the_interfaces_do(tmp_path: Path) -> None:
    recipe = tmp_path / "tiny.yaml"
    recipe.write_text(json.dumps(TINY.model_dump(mode="json", exclude_unset=True)))
    train(recipe, "cooperation-3-pair", tmp_path / "named", steps=1)
    train(TINY, PAIR, tmp_path / "loaded", steps=1)
    assert _weights(tmp_path / "named" / "policy-last") == _weights(tmp_path / "loaded" / "policy-last")
    assert sorted(RunDirectory(tmp_path / "named").load_team("cooperation-3-pair").drivers) == [1, 2]
    with pytest.raises(UnknownName, match="unknown recipe 'cooperatin'; did you mean 'cooperation'"):
        train("cooperatin", PAIR, tmp_path / "no")
    with pytest.raises(UnknownName, match="unknown scenario"):
        train(TINY, "cooperation-3-pairs", tmp_path / "no")


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("team") / "run"
    train(TINY, PAIR, folder, scheme="independent", steps=256)
    return folder


def test_load_team__drives_the_learners_that_the_scenario_has(trained: Path) -> None:
    assert sorted(RunDirectory(trained).load_team(PAIR.with_learners(["vehicle_3"])).drivers) == [2]
    four = PAIR.replace(
        vehicles=4, braking_capacity_mps2=6, driving_capacity_mps2=6, mass_t=5, latency_s=0.5, roles={
            "vehicle_1": "full_brake", "vehicle_2": "learner", "vehicle_3": "learner", "vehicle_4": "full_brake"}
    )  # fmt: skip
    with pytest.raises(InvalidInput, match=r"a line of 3 vehicles, scenario 'cooperation-3-pair' has 4"):
        RunDirectory(trained).load_team(four)
    with pytest.raises(InvalidInput, match=r"drives vehicle_2, vehicle_3; scenario .* has nobody to drive"):
        RunDirectory(trained).load_team(PAIR.with_learners([]))
    with pytest.raises(InvalidInput, match=r"has a policy of its own; name one, for instance .*vehicle_2"):
        load_policy(trained)
    with pytest.raises(InvalidInput, match="holds no team"):
        RunDirectory(trained / "policy").load_team(PAIR)
    with pytest.raises(InvalidInput, match=r"has finished; .* --scenario cooperation-3-pair --agents team@.*/run$"):
        resume(trained)


def _replace(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))


def _without(file: Path, vehicle: str) -> None:
    content = json.loads(file.read_text())
    del content["drivers"][vehicle]
    file.write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda t: t.write_text("{"), r"team.json: is not JSON \(.*\); right is, for instance, {\"scheme\""),
        (lambda t: t.write_text("[]"), "team.json: must be a mapping"),
        (lambda t: t.write_text("{}"), r"scheme: missing; right is, for instance, {\"scheme\""),
        (lambda t: _replace(t, "policy/vehicle_3", "../policy"), 'vehicle_3 = "../policy": must be policy/vehicle_3'),
        (lambda t: _replace(t, "policy/vehicle_3", "policy/vehicle_2"), "must be policy/vehicle_3 under scheme ind"),
        (lambda t: _replace(t, "independent", "shared"), "vehicle_2 = policy/vehicle_2: must be policy under scheme"),
        (lambda t: _without(t, "vehicle_2"), "must be two vehicles or more under scheme independent"),
        (lambda t: _replace(t, '"vehicles": 3', '"vehicles": 2'), "= vehicle_3: must be one of vehicle_1 to vehicle_2"),
        (lambda t: _replace(t, "independent", "together"), "scheme = together: must be single, shared, independent"),
        (lambda t: (t.parent / "policy" / "vehicle_3" / "weights.safetensors").unlink(), "s: is missing"),
        (lambda t: (t.parent / "policy" / "vehicle_3" / "manifest.json").write_text("{}"), "manifest.json: "),
    ],
)  # fmt: skip
def test_load_team__a_damaged_folder_is_refused(
    damage: Callable[[Path], object], message: str, trained: Path, tmp_path: Path
) -> None:
    shutil.copytree(trained, tmp_path / "run")
    damage(tmp_path / "run" / "team.json")
    with pytest.raises(CorruptBundle, match=message):
        RunDirectory(tmp_path / "run").load_team(PAIR)


def test_resume__of_another_library_is_refused(trained: Path, tmp_path: Path) -> None:
    shutil.copytree(trained, tmp_path / "run")
    config = tmp_path / "run" / "config.json"
    config.write_text(json.dumps({**json.loads(config.read_text()), "library": "benchmarl"}))
    with pytest.raises(InvalidInput, match="was trained by benchmarl, which leaves nothing to go on from"):
        resume(tmp_path / "run")


def test_load_team__needs_no_torch(trained: Path) -> None:
    program = (
        "import sys, ethbrake_marl as eb; from ethbrake_marl.learning.training import RunDirectory;"
        f"from pathlib import Path; run = RunDirectory(Path({str(trained)!r}));"
        "run.load_team(eb.load_scenario('cooperation-3-pair')); sys.exit('torch' in sys.modules)"
    )
    root = Path(__file__).resolve().parents[2]
    assert subprocess.run([sys.executable, "-c", program], cwd=root, check=False).returncode == 0


@pytest.mark.long
def test_cooperation__two_learners_avoid_what_can_be_avoided(tmp_path: Path) -> None:
    """Contact cannot be avoided in 65 % of these worlds; PPO's pairs collided in every one (docs/cooperation.md)."""
    train("cooperation", PAIR, tmp_path / "run", steps=800_000)
    result = eb.evaluate(PAIR.sample(1000, 7), {"team": RunDirectory(tmp_path / "run").load_team(PAIR)}, scenario=PAIR)
    assert result.outcome("team").collided.mean() < 0.70
    assert result.outcome("team").first_impact_harm.mean() < 7.2


LEARNS = load_recipe("cooperation-ppo").replace(
    total_steps=200_000,
    n_envs=32,
    network={"policy": [64, 64], "value": [64, 64], "initial_log_std": -0.7},
    evaluation={"every_updates": 1000, "worlds": 1000, "seed": 1007},
)


@pytest.mark.long
@pytest.mark.parametrize("scheme", ["shared", "independent", "centralised"])
def test_scheme__learns_to_beat_full_braking(scheme: Any, tmp_path: Path) -> None:
    train(LEARNS, PAIR, tmp_path / "run", scheme=scheme)
    agents = {"full_brake": eb.make_agent("full_brake"), "team": RunDirectory(tmp_path / "run").load_team(PAIR)}
    result = eb.evaluate(PAIR.sample(1000, 7), agents, scenario=PAIR)
    harm = {name: result.outcome(name).first_impact_harm.mean() for name in agents}
    assert harm["team"] < 0.9 * harm["full_brake"]
