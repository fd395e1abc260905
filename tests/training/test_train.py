"""A training: the folder that it leaves, the policies that it keeps, and what stops it."""

from __future__ import annotations

import io
import json
import os
import random
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from stable_baselines3 import A2C
from stable_baselines3.common.vec_env import VecNormalize
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from ethbrake_marl.agent_names import make_agent, open_game, team_of
from ethbrake_marl.agents.team import play_to_end
from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.motion.digest import physics_digest
from ethbrake_marl.policies.bundle import load_drivers, load_policy
from ethbrake_marl.progress import Progress
from ethbrake_marl.training import train as train_module
from ethbrake_marl.training.algorithm import Algorithm
from ethbrake_marl.training.ppo import Ppo
from ethbrake_marl.training.recipe import ALGORITHMS, TrainingRecipe, algorithm_of, register_algorithm
from ethbrake_marl.training.run import RunFolder
from ethbrake_marl.training.train import make_environment, make_model, train
from ethbrake_marl.training.training import Training
from ethbrake_marl.training.updates import TrainingDiverged, make_policies, policy_weights
from tests.refused import refused
from tests.training.tiny import PAIR, TINY, TINY_SAC, TRAININGS, UPDATE, begin, dying_after, go_on, kept, killed


@pytest.mark.parametrize("name", ["shared", "independent"])
def test_policies__know_the_range_of_their_training(name: str, tmp_path: Path) -> None:
    result = begin(name, tmp_path / "run")
    for policies in (result.policies, result.last_policies):
        for vehicle, policy in policies.items():
            low, high = (
                np.array(end) for end in (policy.manifest.training_range.low, policy.manifest.training_range.high)
            )
            names = list(policy.observation.names)
            assert len(low) == len(names) and (low <= high).all() and (low < high).any()
            capacity = names.index("own.braking_capacity")
            both = name == "shared"  # Vehicle 2 brakes at 7 m/s2, Vehicle 3 at 6
            assert low[capacity] == pytest.approx(0.6 if both or vehicle == "vehicle_3" else 0.7)
            assert high[capacity] == pytest.approx(0.7 if both or vehicle == "vehicle_2" else 0.6)
    assert load_drivers(tmp_path / "run" / "policy").values() and all(
        policy.manifest == result.policies[vehicle].manifest
        for vehicle, policy in load_drivers(tmp_path / "run" / "policy").items()
    )


def status_of(run: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((run / "run.json").read_text())
    return content


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any, list[Progress]]:
    """A tiny training: its folder, its result and what it reported."""
    run, reports = tmp_path_factory.mktemp("trained") / "run", list[Progress]()
    return run, train(TINY, "paper-random", run, on_progress=reports.append, settings=["x=1"]), reports


def test_train__reports_and_returns_what_its_folder_says(trained: tuple[Path, Any, list[Progress]]) -> None:
    run, result, reports = trained
    names = ["config.json", "policy", "policy-last", "progress.csv", "run.json", "run.lock", "tensorboard"]
    assert sorted(path.name for path in run.iterdir()) == names
    status, config = status_of(run), json.loads((run / "config.json").read_text())
    for told in ((result.status, result.steps, result.updates), tuple(map(status.get, ("status", "steps", "updates")))):
        assert told == ("finished", 6 * UPDATE, 6)
    assert status["evaluations"] == list(result.evaluations)
    assert [(report.done, report.total) for report in reports] == [(UPDATE * k, 6 * UPDATE) for k in range(7)]
    assert TrainingRecipe.model_fields.keys() - config["recipe"].keys() == {"observation", "scenario"}
    assert config["settings"] == ["x=1"]


def test_train__leaves_the_policy_that_is_the_best_on_the_list(trained: tuple[Path, Any, list[Progress]]) -> None:
    run, result, _ = trained
    policy, last = load_policy(run), load_policy(run / "policy-last")
    assert policy.manifest == result.policy.manifest and last.manifest == result.last_policy.manifest
    assert (policy.manifest.steps, last.manifest.steps) == (result.metrics["steps"], 6 * UPDATE)
    assert policy.manifest.versions["physics"] == physics_digest()
    assert policy.manifest.learners == ("vehicle_2",) and policy.manifest.seeds == {"training": 0, "evaluation": 7}
    scenario, game = open_game("paper-random")
    assert result.agent == f"policy@{run}"
    ended = play_to_end(game, scenario.sample(10, 7), team_of(make_agent(result.agent), scenario))
    least = min(each["first_impact_harm"] for each in result.evaluations)
    assert (
        ended.harm("first").mean() == pytest.approx(least, rel=1e-12) and least == result.metrics["first_impact_harm"]
    )


def test_train__measures_before_the_first_update_and_as_often_as_asked(
    trained: tuple[Path, Any, list[Progress]],
) -> None:
    run, result, _ = trained
    harm = [each["first_impact_harm"] for each in result.evaluations]
    assert [each["updates"] for each in result.evaluations] == [0, 3, 6]
    rows = kept(run)["rows"]
    assert [int(row["steps"]) for row in rows] == [UPDATE * k for k in range(7)]
    assert [float(row["eval/first_impact_harm"]) for row in rows[::3]] == harm
    events = EventAccumulator(str(run / "tensorboard"))
    events.Reload()
    told = [(event.step, event.value) for event in events.Scalars("eval/first_impact_harm")]
    assert told == [(3 * UPDATE * k, pytest.approx(value, rel=1e-6)) for k, value in enumerate(harm)]


def test_train__is_the_same_twice_and_leaves_the_global_generators(tmp_path: Path) -> None:
    def states() -> Any:
        numpy_state = np.random.get_state()[1].tolist()  # noqa: NPY002
        return random.getstate(), numpy_state, torch.get_rng_state().tolist(), torch.get_num_threads()

    torch.set_num_threads(2)
    before = states()
    begin("ppo", tmp_path / "one")
    assert states() == before
    np.random.rand(3)  # noqa: NPY002
    begin("ppo", tmp_path / "two")
    assert kept(tmp_path / "one") == kept(tmp_path / "two")
    other = begin("ppo", tmp_path / "other", seed=1, measure=None).last_policy.manifest
    assert load_policy(tmp_path / "one/policy-last").manifest.weights_sha256 != other.weights_sha256


REMAINDERS: dict[str, tuple[str, dict[str, Any], list[int], list[int]]] = {  # training, change, measured, rows
    "a part of an update": ("ppo", {"total_steps": 3 * UPDATE + 1}, [0, 3, 4], [*range(5)]),
    "two learners": ("independent", {"total_steps": 2 * 5 * UPDATE}, [0, 3, 5], [*range(6)]),
    "between two rows": ("sac", {"total_steps": 9 * 8 + 1}, [0, 10], [0, 10]),
}


@pytest.mark.parametrize("case", REMAINDERS)
def test_train__an_end_between_two_measurements_or_rows_is_measured_and_stored(case: str, tmp_path: Path) -> None:
    name, change, measured, rows = REMAINDERS[case]
    recipe, scenario = TRAININGS[name]
    run, other = tmp_path / "run", tmp_path / "not measured"
    result = train(recipe.replace(**change), scenario, run, on_progress=None)
    assert result.updates == measured[-1] == status_of(run)["updates"]
    assert [each["updates"] for each in result.evaluations] == measured
    update = result.steps // result.updates
    assert [int(row["steps"]) for row in kept(run)["rows"]] == [update * each for each in rows]
    train(recipe.replace(**change), scenario, other, measure=None, on_progress=None)
    last, same = (load_drivers(folder / "policy-last") for folder in (run, other))
    for vehicle, policy in result.last_policies.items():
        assert policy.manifest.steps == last[vehicle].manifest.steps == same[vehicle].manifest.steps == result.steps
        assert policy.manifest.weights_sha256 == same[vehicle].manifest.weights_sha256


@pytest.mark.parametrize("default", [torch.float64, "meta", "inside"], ids=str)
@pytest.mark.parametrize("recipe", ["ppo", pytest.param("sac", marks=pytest.mark.slow)])
def test_train__has_the_same_bits_whatever_torchs_defaults_are(
    default, recipe, tiny_recipe, tiny_sac, tmp_path
) -> None:
    def weights(name: str) -> bytes:
        file = {"ppo": tiny_recipe, "sac": tiny_sac}[recipe]
        train_module.train(file, "paper-random", tmp_path / name, measure=None, on_progress=None)
        return (tmp_path / name / "policy" / "weights.safetensors").read_bytes()

    expected = weights("as usual")
    inside = torch.device("meta") if default == "inside" else nullcontext()
    try:
        if default == "meta":
            torch.set_default_device(default)
        elif default != "inside":
            torch.set_default_dtype(default)
        before = torch.get_default_dtype(), torch.get_default_device()
        with inside:
            assert weights("otherwise") == expected
        assert (torch.get_default_dtype(), torch.get_default_device()) == before
    finally:
        torch.set_default_dtype(torch.float32)
        torch.set_default_device(None)


@pytest.mark.parametrize(("count", "best"), [("first", 3), ("total", 6)])
def test_train__keeps_the_best_by_the_count_of_the_reward(count: str, best: int, tmp_path: Path) -> None:
    planned = iter([(9.0, 9.0), (1.0, 8.0), (2.0, 3.0), (3.0, 4.0)])

    def measure(training: Any) -> Any:
        return lambda policies: dict(zip(("first_impact_harm", "total_harm"), next(planned), strict=True))

    recipe = TINY.replace(reward={"harm": 0.05, "harm_count": count}, total_steps=9 * UPDATE)
    result = train(recipe, "paper-random", tmp_path / "run", measure=measure, on_progress=None)
    assert result.policy.manifest.steps == best * UPDATE
    assert (result.last_policy.manifest.steps, result.metrics["updates"]) == (9 * UPDATE, best)


def test_train__objectives_decide_where_they_are_not_the_harm_of_the_line(tmp_path: Path) -> None:
    recipe = TINY.replace(reward={"harm": 0.05, "harm_count": "first", "objective": "own"}, total_steps=UPDATE)
    result = train(recipe, PAIR, tmp_path / "run", on_progress=None)
    scenario, game = open_game(PAIR)
    last = play_to_end(game, scenario.sample(10, 7), team_of(make_agent(result.agent, scenario=PAIR), scenario))
    assert result.metrics is not None
    own = [result.metrics[f"objective_{name}"] for name in result.policies]
    assert own == pytest.approx(last.borne_harm("first")[:, 1:].mean(axis=0))
    assert result.metrics["objective"] == pytest.approx(sum(own) / 2)
    assert result.metrics["objective"] == min(each["objective"] for each in result.evaluations)


def closed() -> Any:
    """Stream that is closed."""
    stream = io.StringIO()
    stream.close()
    return stream


def full(text: str) -> int:
    """Write to a full disk."""
    raise OSError(28, "No space left on device")


STREAMS: dict[str, Callable[[], Any]] = {
    "none": lambda: None,
    "closed": closed,
    "full": lambda: SimpleNamespace(write=full, flush=lambda: None, isatty=lambda: True),
}


@pytest.mark.parametrize("broken", STREAMS)
def test_progress__needs_no_stream(broken: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", STREAMS[broken]())
    listener = Progress.listener("show")
    assert (listener is None) == (broken == "none")
    if listener is not None:
        listener(Progress("training", 1, 2))


def test_train__shows_its_progress(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result = begin("ppo", tmp_path / "run", steps=2 * UPDATE, on_progress="show")
    harm = f"honest cost {result.evaluations[0]['honest_cost']:.2f}"
    assert capsys.readouterr().err == f"training: 0 of 256, {harm}\n"  # the next line would come after ten seconds


def test_train__in_two_threads_is_refused_and_the_first_one_is_as_alone(tmp_path: Path) -> None:
    errors: list[BaseException] = []

    def second() -> None:
        try:
            begin("ppo", tmp_path / "second")
        except InvalidInput as error:
            errors.append(error)

    def meanwhile(progress: Progress) -> None:
        if progress.updates == 2:
            thread = threading.Thread(target=second)
            thread.start()
            thread.join()

    begin("ppo", tmp_path / "first", on_progress=meanwhile)
    begin("ppo", tmp_path / "alone")
    assert "another thread of this process is training" in str(errors[0]) and not (tmp_path / "second").exists()
    assert kept(tmp_path / "first") == kept(tmp_path / "alone")


class Disturbed(train_module.EthBrakeVecEnv):
    """Calls ``at[k]`` with the answer of step k."""

    at: dict[int, Callable[[Any], Any]]
    count = 0

    def step_wait(self) -> Any:
        self.count += 1
        answer = super().step_wait()
        self.at.get(self.count, lambda _: None)(answer)
        return answer


def disturb(monkeypatch: pytest.MonkeyPatch, at: dict[int, Callable[[Any], Any]]) -> None:
    monkeypatch.setattr(train_module, "EthBrakeVecEnv", type("Mine", (Disturbed,), {"at": at}))


def test_train__a_second_ctrl_c_stops_at_once(tmp_path: Path) -> None:
    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        disturb(patch, dict.fromkeys((40, 41), lambda _: os.kill(os.getpid(), signal.SIGINT)))
        begin("ppo", tmp_path / "run")
    status = status_of(tmp_path / "run")
    assert (status["status"], status["updates"]) == ("interrupted", 2)
    go_on(tmp_path / "run")
    begin("ppo", tmp_path / "whole")
    assert kept(tmp_path / "run") == kept(tmp_path / "whole")


def test_train__a_signal_stops_it_after_the_update_and_leaves_no_handler(tmp_path: Path) -> None:
    before = [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)]
    with pytest.MonkeyPatch.context() as patch:
        disturb(patch, {40: lambda _: os.kill(os.getpid(), signal.SIGTERM)})
        assert begin("ppo", tmp_path / "run").status == "interrupted"
    assert [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)] == before
    go_on(tmp_path / "run")
    begin("ppo", tmp_path / "whole")
    assert kept(tmp_path / "run") == kept(tmp_path / "whole")


SPOILED: dict[str, Callable[[Any], Any]] = {
    "rewards": lambda answer: answer[1].__setitem__(3, np.nan),
    "huge": lambda answer: answer[1].fill(1e38),
}


@pytest.mark.filterwarnings("ignore:overflow encountered:RuntimeWarning", "ignore:invalid value:RuntimeWarning")
@pytest.mark.parametrize(("name", "kind"), [("ppo", "rewards"), ("sac", "huge")])
def test_train__numbers_that_are_not_finite_stop_it(
    name: str, kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disturb(monkeypatch, dict.fromkeys(range(36, 100), SPOILED[kind]))
    with pytest.raises(TrainingDiverged, match=r"not finite at step \d+; try a smaller learning_rate"):
        begin(name, tmp_path / "run")
    status = status_of(tmp_path / "run")
    assert status["status"] == "failed" and status["reason"].startswith("TrainingDiverged: training: ")
    policy = load_policy(tmp_path / "run/policy-last")
    assert all(np.isfinite(each).all() for each in policy.tensors.values())


def test_train__no_exploration_stops_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    build = Ppo.build

    def broken(self: Ppo, training: Any, environment: Any) -> Any:
        model = build(self, training, environment)
        model.policy.log_std.data.fill_(-200.0)
        return model

    monkeypatch.setattr(Ppo, "build", broken)
    with pytest.raises(TrainingDiverged, match="noise of exploration is not finite at step 0"):
        begin("ppo", tmp_path / "run")


class A2cRecipe(TrainingRecipe):
    """Recipe of an algorithm of a user."""

    algorithm: str = "a2c"
    n_steps: int = 8
    gae_lambda: float = 1.0
    network: Any = None

    def network_spec(self, observation_size: int) -> Any:
        """PPO's: A2C has the same networks."""
        return TINY.network_spec(observation_size)


class A2c(Algorithm):
    """An algorithm of a user: only what must be written."""

    def build(self, training: Any, environment: Any) -> A2C:
        """Model."""
        recipe = training.recipe
        return A2C(
            "MlpPolicy",
            VecNormalize(environment) if recipe.name == "normalising" else environment,
            learning_rate=recipe.learning_rate.at,
            n_steps=recipe.n_steps,
            gamma=recipe.gamma,
            policy_kwargs={"net_arch": {"pi": [8], "vf": [8, 4]}, "activation_fn": torch.nn.ReLU},
            seed=recipe.seed,
            device="cpu",
        )


@pytest.fixture
def a2c() -> Iterator[dict[str, Any]]:
    """The content of a recipe of A2C, which is registered."""
    register_algorithm("a2c", A2cRecipe, A2c)
    content = TINY.model_dump(mode="json", include={*TrainingRecipe.model_fields})
    yield {**content, "algorithm": "a2c", "total_steps": 9 * 64}
    del ALGORITHMS.loaded["a2c"]


class Gambling(A2c):
    """Moves a weight, after every update, by random numbers of all generators that a user may have used."""

    def build(self, training: Any, environment: Any) -> A2C:
        """Model."""
        model = super().build(training, environment)
        learn = model.train

        def gamble() -> None:
            learn()
            with torch.no_grad():
                model.policy.action_net.bias += random.random() + np.random.rand() + torch.rand(1)  # noqa: NPY002

        model.train = gamble  # type: ignore[method-assign]
        return model


def test_algorithm__of_a_user_that_draws_from_any_generator_resumes_to_the_bit(
    a2c: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(ALGORITHMS.loaded, "a2c", (A2cRecipe, Gambling))
    whole = train(a2c, "paper-random", tmp_path / "whole", measure=None, on_progress=None)
    killed(train, a2c, "paper-random", tmp_path / "run", measure=None, on_progress=dying_after(5))
    random.seed(1)
    go_on(tmp_path / "run", measure=None)
    assert kept(tmp_path / "run") == kept(tmp_path / "whole")
    assert load_policy(tmp_path / "run/policy-last").manifest.algorithm == "a2c" and whole.updates == 9


def test_algorithm__that_normalises_by_itself_is_refused(a2c: dict[str, Any], tmp_path: Path) -> None:
    with refused("algorithm 'a2c': its model uses VecNormalize"):
        train({**a2c, "name": "normalising"}, "paper-random", tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("name", TRAININGS)
def test_policy__acts_as_the_model_does_without_exploration(name: str) -> None:
    training = Training.of(*TRAININGS[name])
    environment = make_environment(training)
    model = make_model(training, environment)
    policies = make_policies(training, 5, policy_weights(training, model))
    seen = environment.reset()
    expected, _ = model.predict(seen, deterministic=True)
    for place, learner in enumerate(training.learners):
        rows = slice(place, None, len(training.learners))
        own = np.ascontiguousarray(seen[rows, : len(training.row.names)])
        np.testing.assert_allclose(policies[learner](own), expected[rows], atol=1e-5)
        assert policies[learner].manifest.steps == 5


SETTINGS: dict[str, tuple[TrainingRecipe, set[str]]] = {  # recipe -> keys that Stable-Baselines3 calls the same
    "ppo": (
        TINY.replace(
            gamma=0.97, gae_lambda=0.9, clip_range=0.15, ent_coef=0.01, vf_coef=0.6, max_grad_norm=0.4, target_kl=0.2
        ),
        {"n_steps", "batch_size", "n_epochs", "gae_lambda", "ent_coef", "vf_coef", "max_grad_norm", "target_kl"},
    ),
    "sac": (
        TINY_SAC.replace(gamma=0.97, tau=0.03, gradient_steps=3, target_update_interval=2, ent_coef=0.2),
        {"batch_size", "buffer_size", "learning_starts", "tau", "gradient_steps", "ent_coef", "target_update_interval"},
    ),
}


@pytest.mark.parametrize("name", SETTINGS)
def test_model__has_the_settings_of_the_recipe(name: str) -> None:
    recipe, keys = SETTINGS[name]
    recipe = recipe.replace(seed=5, horizon_is_end=False)
    training = Training.of(recipe, "paper-random")
    environment: Any = make_environment(training)
    model = algorithm_of(recipe).build(training, environment)
    for key in (*keys, "gamma", "seed", "n_envs"):
        assert getattr(model, key) == getattr(recipe, key), key
    assert model.lr_schedule(0.3) == recipe.learning_rate.at(0.3)
    assert name == "sac" or model.clip_range(1.0) == 0.15
    assert not environment.horizon_is_end and environment.game.rewarding.params == recipe.reward


def test_training__has_an_identity_of_all_but_words() -> None:
    identity = Training.of(TINY, "paper-random").identity
    words = {"title": "Other", "description": "Other", "source": "Other"}
    assert Training.of(TINY.replace(**words), "paper-random").identity == identity
    others = [Training.of(TINY, "paper-random", seed=1), Training.of(TINY, "paper-random-obstacle")]
    assert identity not in [each.identity for each in others]


REFUSED: dict[str, Any] = {
    "scenario 'cooperation-3-pair' has no learner": (TINY, {}, []),
    "scheme single: scenario 'cooperation-3-pair' has 2 learners": (TINY, {"scheme": "single"}, None),
    "the algorithm sac of recipe 'sac' does not support": (TINY_SAC, {"scheme": "centralised"}, None),
}


@pytest.mark.parametrize("message", REFUSED)
def test_train__is_refused(message: str, tmp_path: Path) -> None:
    recipe, settings, learners = REFUSED[message]
    scenario = open_game(PAIR)[0]
    scenario = scenario if learners is None else scenario.with_learners(learners)
    with refused(message):
        train(recipe, scenario, tmp_path / "run", **settings)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("name", ["a,b", "a+b"])
def test_train__into_a_folder_that_no_agent_could_name_is_refused(name: str, tmp_path: Path) -> None:
    with refused(f"{tmp_path / name}: a path in the name of an agent must have no comma and no plus; rename it"):
        train(TINY, "paper-random", tmp_path / name)
    assert not (tmp_path / name).exists()


@pytest.fixture
def begun(tmp_path: Path) -> Path:
    """A run that was killed before its first update."""
    RunFolder(tmp_path / "run").create(Training.of(TINY, "paper-random").config())
    return tmp_path / "run"


def test_train__replaces_a_run_only_if_it_is_asked_to_and_nobody_trains_there(begun: Path) -> None:
    with refused(f"{begun}: this run already exists; choose another folder (--output), resume", AlreadyExists):
        begin("ppo", begun)
    with RunFolder(begun).held(), refused("another process is training in this folder"):
        begin("ppo", begun, force=True)
    (begun / "checkpoints").mkdir()
    assert begin("ppo", begun, force=True, measure=None).status == "finished"
    assert not (begun / "checkpoints").exists()
    (begun.parent / "thesis").mkdir()
    (begun.parent / "thesis/chapter-1").touch()
    (begun.parent / "link").symlink_to(begun)
    for name in ("thesis", "link"):
        with refused(f"{name}: ", AlreadyExists):
            begin("ppo", begun.parent / name, force=True)
    assert (begun.parent / "thesis/chapter-1").exists()


def changed(run: Path, file: str, **content: Any) -> None:
    """Change entries of a JSON file."""
    before = json.loads((run / file).read_text())
    (run / file).write_text(json.dumps({**before, **content}))


HOSTILE: dict[str, Any] = {
    ": is not the folder of a run; name the folder": lambda run: [path.unlink() for path in run.glob("*.json")],
    "run.json: is damaged: ": lambda run: (run / "run.json").write_text("{"),
    "config.json: the file does not exist": lambda run: (run / "config.json").unlink(),
    "config.json: does not describe a training": lambda run: changed(run, "config.json", scenario=3),
    "config.json: scenario 'paper-random': horizon_s": lambda run: changed(
        run, "config.json", scenario={"name": "paper-random", "horizon_s": -1}
    ),
    "policy: must be a plain folder": lambda run: (run / "policy").write_text(""),
}


@pytest.mark.parametrize("message", HOSTILE)
def test_resume__a_hostile_folder_is_refused(message: str, begun: Path) -> None:
    HOSTILE[message](begun)
    with refused(message):
        go_on(begun)
