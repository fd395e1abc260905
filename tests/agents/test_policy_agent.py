"""Policies of other libraries drive as agents: alone, refined and behind every shield."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.agents import registry
from ethbrake_marl.agents.registry import drive
from ethbrake_marl.errors import AgentFailed, InvalidInput
from ethbrake_marl.evaluation.inputs import policy_sha256
from ethbrake_marl.shield.guard import ShieldedDriver
from tests.fixtures.asked import Asked

SCENARIO = eb.load_scenario("paper-random")
WORLDS = SCENARIO.sample(12, 7).worlds
AROUND = ("+refined", "+episode", "+episode:pairwise", "+step", "+refined+step")


@pytest.fixture(autouse=True)
def forget_what_is_registered(monkeypatch):
    monkeypatch.setattr(registry, "_ENTRIES", dict(registry._ENTRIES))


def harms(agent, worlds=WORLDS):
    return drive(worlds, agent, SCENARIO, 1).ledger.world_harm("first")


@pytest.fixture(autouse=True)
def own_names(monkeypatch):
    monkeypatch.setattr(registry, "_ENTRIES", dict(registry._ENTRIES))


def shielded(agent, around):
    """The agent with this around it, through a name of its own."""
    eb.register_agent(f"theirs_{id(agent)}", lambda argument, settings: agent)
    return eb.make_agent(f"theirs_{id(agent)}{around}", scenario=SCENARIO)


def brake(observation):
    return np.full((len(observation), 1), -0.5, np.float32)


@pytest.fixture(scope="module")
def model():
    stable = pytest.importorskip("stable_baselines3")
    model = stable.PPO(
        "MlpPolicy", eb.make_sb3_vec_env("paper-random", 4), n_steps=8, batch_size=16, n_epochs=1, seed=1
    )
    return model.learn(64)


def test_function__drives_as_it_says_and_is_named_after_itself():
    agent = eb.policy_agent(brake)
    assert agent.name == "brake" and isinstance(agent, eb.Agent)
    assert (
        Asked(agent).begin(WORLDS, 1).act(WORLDS, 1).tolist()
        == (-0.5 * WORLDS.vehicles.braking_capacity_mps2[:, 1]).tolist()
    )


def test_trained_model__drives_as_in_its_own_librarys_rollout(model):
    agent = eb.policy_agent(model, name="sb3", scenario=SCENARIO)
    for seed in (3, 4, 9):
        env = eb.EthBrakeEnv()
        observation, _ = env.reset(seed=seed)
        over, reward = False, 0.0
        while not over:
            action, _ = model.predict(observation, deterministic=True)
            observation, more, terminated, truncated, _ = env.step(action)
            reward, over = reward + more, terminated or truncated
        worlds = SCENARIO.sample(1, seed, channel="training").worlds
        assert harms(agent, worlds)[0] == pytest.approx(-reward, rel=1e-5, abs=1e-5)


def test_trained_model__is_driven_by_evaluate(model):
    agent = eb.policy_agent(model, name="sb3")
    found = eb.evaluate(SCENARIO.sample(12, 7), {"sb3": agent}, scenario=SCENARIO, chunk=5)
    # Torch rounds products by the size of the batch, so a chunk changes the last digits.
    assert found.outcome("sb3").first_impact_harm == pytest.approx(harms(agent), rel=1e-5)


@pytest.mark.parametrize("around", AROUND)
def test_trained_model__behind_every_shield_keeps_the_bound(model, around):
    agent = shielded(eb.policy_agent(model, name="sb3"), around)
    found = eb.evaluate(WORLDS, {"mine": agent}, scenario=SCENARIO).outcome("mine")
    if around != "+episode:pairwise":
        assert (found.first_impact_harm <= found.predicted_harm + 1e-5).all()


def test_policy_of_another_library__is_known_by_its_weights():
    torch = pytest.importorskip("torch")
    module = torch.nn.Linear(27, 1)
    agent = eb.policy_agent(module)
    before = policy_sha256(agent)
    assert before == policy_sha256(ShieldedDriver(agent, SCENARIO)) == policy_sha256(eb.policy_agent(module))
    with torch.no_grad():
        module.bias += 0.1
    assert policy_sha256(agent) not in (before, None)
    assert policy_sha256(eb.policy_agent(lambda seen: seen[:, :1])) is None


def test_agent_that_fails__is_called_as_its_user_calls_it():
    def wrong(seen):
        return np.zeros((len(seen), 2))

    with pytest.raises(InvalidInput, match=r"agent 'mine', world 0, step 1 \(.* s\): gave float64 of shape \(4, 2\)"):
        eb.evaluate(SCENARIO.sample(4, 1), {"mine": eb.policy_agent(wrong)}, scenario=SCENARIO)


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (lambda seen: (np.zeros((len(seen), 1)), None), "gave a tuple of 2 .* needs initial_state"),
        (lambda seen: np.ma.masked_array(np.zeros((len(seen), 1)), mask=True), "in which stands nan"),
    ],
)
def test_answer_that_is_no_action__is_told(answer, message):
    with pytest.raises(InvalidInput, match=message):
        eb.evaluate(SCENARIO.sample(4, 1), {"mine": eb.policy_agent(answer)}, scenario=SCENARIO)


def test_agent_that_fails_once__is_told_with_its_step():
    calls = []

    def tired(seen):
        calls.append(len(seen))
        if len(calls) == 5:
            raise ZeroDivisionError("once")
        return np.zeros((len(seen), 1))

    with pytest.raises(
        InvalidInput, match=r"agent 'tired', steps? \d+.*: observations of shape .*ZeroDivisionError: once"
    ):
        eb.evaluate(SCENARIO.sample(4, 1), {"tired": eb.policy_agent(tired)}, scenario=SCENARIO)


def test_torch_module__drives_without_gradients_and_is_shared():
    torch = pytest.importorskip("torch")
    module = torch.nn.Sequential(torch.nn.Linear(27, 1), torch.nn.Tanh())
    agent = eb.policy_agent(module, name="torch")

    def by_hand(observation):
        return module(torch.from_numpy(observation)).detach().numpy()

    assert harms(agent).tolist() == harms(eb.policy_agent(by_hand)).tolist()


def test_onnx__path_and_session_drive_as_the_policy_does(tmp_path: Path):
    runtime = pytest.importorskip("onnxruntime")
    pytest.importorskip("onnx")
    policy = eb.load_shipped("ppo")
    path = tmp_path / "shipped.onnx"
    path.write_bytes(policy.to_onnx())
    expected = harms(eb.LearnedAgent(policy))
    session = runtime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    for given in (path, session):
        assert harms(eb.policy_agent(given)) == pytest.approx(expected, rel=1e-5, abs=1e-5)
    assert eb.policy_agent(path).name == "shipped"
    assert harms(eb.policy_agent(policy)).tolist() == expected.tolist()


def ramp(observation, state):
    """Brakes harder with every step: what it does depends on its memory alone."""
    return -np.minimum(state["steps"], 10.0) / 10.0, {"steps": state["steps"] + 1.0}


def no_memory(n):
    return {"steps": np.zeros((n, 1), np.float32)}


def test_memory__belongs_to_each_episode_and_goes_with_its_world():
    agent = Asked(eb.policy_agent(ramp, initial_state=no_memory))
    capacity = WORLDS.vehicles.braking_capacity_mps2[:, 1]
    agent.begin(WORLDS, 1, np.arange(12))
    for _ in range(3):
        agent.act(WORLDS, 1)
    agent.begin(WORLDS.take([4]), 1, np.array([4]))  # one episode is renewed
    part = agent.take(np.array([3, 4]))
    share = np.where(np.arange(12) == 4, 0.0, 0.3)
    assert agent.act(WORLDS, 1) == pytest.approx(-share * capacity)
    assert part.act(WORLDS.take([3, 4]), 1) == pytest.approx([-0.3 * capacity[3], 0.0])  # left as it was


@pytest.mark.parametrize("around", AROUND)
def test_memory__behind_every_shield_keeps_the_bound(around):
    agent = shielded(eb.policy_agent(ramp, initial_state=no_memory), around)
    found = eb.evaluate(WORLDS, {"mine": agent}, scenario=SCENARIO).outcome("mine")
    harm = found.first_impact_harm
    if around != "+episode:pairwise":
        assert (harm <= found.predicted_harm + 1e-9).all()
    if around == "+step":  # rolled out with a memory of its own, so it drives unhindered where it is good
        alone = harms(eb.policy_agent(ramp, initial_state=no_memory))
        assert (harm[found.chosen_policy] == alone[found.chosen_policy]).all() and found.chosen_policy.any()


class Recurrent:
    """A model with the interface of sb3-contrib's recurrent ones, which brakes harder with every step."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        if state is None:
            state = (np.zeros((1, len(observation), 1), np.float32),)
        steps = np.where(np.asarray(episode_start)[None, :, None], 0.0, state[0]) if episode_start is not None else 0.0
        steps = steps + np.zeros((1, len(observation), 1), np.float32)
        return -np.minimum(steps[0], 10.0) / 10.0, (steps + 1.0,)


def test_recurrent_model__keeps_its_state_world_by_world():
    agent, same = Asked(eb.policy_agent(Recurrent())), Asked(eb.policy_agent(ramp, initial_state=no_memory))
    for each in (agent, same):
        each.begin(WORLDS, 1, np.arange(12))
    for step in range(5):
        assert agent.act(WORLDS, 1).tolist() == same.act(WORLDS, 1).tolist()
        if step == 2:
            for each in (agent, same):
                each.begin(WORLDS.take([4, 7]), 1, np.array([4, 7]))
    rows = np.array([7, 3])
    assert agent.take(rows).act(WORLDS.take(rows), 1).tolist() == same.take(rows).act(WORLDS.take(rows), 1).tolist()
    assert harms(agent.agent).tolist() == harms(same.agent).tolist()


def test_recurrent_model__whose_state_has_no_axis_of_worlds_is_refused():
    class Shared(Recurrent):
        def predict(self, observation, **asked):
            return super().predict(observation)[0], np.zeros((1, 8))

    with pytest.raises(InvalidInput, match=r"'Shared': predict on 27 features: .* shape \(1, 8\) for two worlds"):
        eb.policy_agent(Shared())


def test_model_trained_under_vec_normalize__drives_by_what_was_counted():
    stable = pytest.importorskip("stable_baselines3")
    normalised = stable.common.vec_env.VecNormalize(eb.make_sb3_vec_env("paper-random", 4), clip_obs=2.0)
    model = stable.PPO("MlpPolicy", normalised, n_steps=64, batch_size=256, n_epochs=1, seed=1).learn(256)

    def with_statistics(seen):
        return model.predict(normalised.normalize_obs(seen), deterministic=True)[0]

    agent = eb.policy_agent(model)
    assert harms(agent).tolist() == harms(eb.policy_agent(with_statistics)).tolist()
    before, mean = policy_sha256(agent), normalised.obs_rms.mean.copy()
    normalised.obs_rms.mean = mean + 1.0
    assert policy_sha256(agent) not in (before, None)
    normalised.obs_rms.mean = mean
    assert policy_sha256(agent) == before  # asking has counted nothing
    assert harms(eb.policy_agent(model.policy)).tolist() != harms(agent).tolist()  # the statistics do matter


def test_model_of_actions_that_mean_something_else__is_refused():
    stable, gymnasium = pytest.importorskip("stable_baselines3"), pytest.importorskip("gymnasium")
    model = stable.PPO("MlpPolicy", gymnasium.wrappers.RescaleAction(eb.EthBrakeEnv(), np.float32(0), np.float32(1)))
    with pytest.raises(InvalidInput, match=r"gives actions in Box\(0.0, 1.0, .*here they mean \[-1, 1\]"):
        eb.policy_agent(model)


def test_model_that_has_its_environment__observes_what_it_was_trained_on(model):
    stable, wrappers = pytest.importorskip("stable_baselines3"), pytest.importorskip("gymnasium").wrappers
    other = eb.ObservationSpec(front=2, rear=0)  # as many features as the usual ones
    assert other.size == eb.ObservationSpec().size
    settings = {"env_kwargs": {"observation": other}}
    for rows in (
        eb.make_sb3_vec_env("paper-random", 2, observation=other),
        stable.common.env_util.make_vec_env("EthBrake-v0", **settings),
    ):
        theirs = stable.PPO("MlpPolicy", rows, n_steps=8, batch_size=8)
        assert eb.policy_agent(theirs).observation.front == 2
        for settings in ({"scenario": SCENARIO}, {"observation": eb.ObservationSpec()}):
            with pytest.raises(InvalidInput, match=r"trained on other features than ObservationSpec\(front=1, rear=1"):
                eb.policy_agent(theirs, **settings)
    rows = stable.common.env_util.make_vec_env("EthBrake-v0", wrapper_class=wrappers.NormalizeObservation)
    with pytest.raises(InvalidInput, match="trained under NormalizeObservation, which this agent knows nothing of"):
        eb.policy_agent(stable.PPO("MlpPolicy", rows, n_steps=8, batch_size=8))


@pytest.mark.parametrize(("layer", "setting"), [("Dropout", 0.5), ("BatchNorm1d", 4)])
def test_torch_module__that_draws_or_mixes_worlds_must_be_in_evaluation_mode(layer, setting):
    torch = pytest.importorskip("torch")
    module = torch.nn.Sequential(
        torch.nn.Linear(27, 4), getattr(torch.nn, layer)(setting), torch.nn.Linear(4, 1), torch.nn.Tanh()
    )
    with pytest.raises(InvalidInput, match=rf"{layer} is in training mode, .* call eval\(\) of the module first"):
        eb.policy_agent(module)
    agent = eb.policy_agent(module.eval())
    assert harms(agent).tolist() == harms(agent).tolist()


@pytest.mark.parametrize("appended", ["number", "state"])
def test_model_trained_on_rows_with_something_appended__drives_as_there(appended):
    stable = pytest.importorskip("stable_baselines3")
    scenario = eb.load_scenario("cooperation-3-pair")
    rows = eb.make_sb3_vec_env(scenario, 4, seed=3, appended=appended)
    model = stable.PPO("MlpPolicy", rows, n_steps=8, batch_size=16, n_epochs=1, seed=1)
    with pytest.raises(InvalidInput, match=r"scenario, observation, or appended \(number or state"):
        eb.policy_agent(model.policy, scenario=scenario)
    with pytest.raises(InvalidInput, match="needs the scenario that it was trained in"):
        eb.policy_agent(model.policy, appended=appended)
    told = {"scenario": scenario, "appended": appended}  # a model that has its environment needs none of it
    agents = {1: eb.policy_agent(model.policy, **told), 2: eb.policy_agent(model)}
    assert agents[1].knows == (eb.agents.registry.Source.STATE if appended == "state" else "messages")
    team = drive(scenario.sample(4, 3, channel="training").worlds, eb.Team(agents, "theirs"), scenario)
    rows.seed(3)  # the model has set its own
    seen, over, harm = rows.reset(), np.zeros(4, bool), np.full(4, np.nan)
    while not over.all():
        seen, _, done, infos = rows.step(model.predict(seen, deterministic=True)[0])
        for k in np.flatnonzero(done[::2] & ~over):
            over[k], harm[k] = True, infos[2 * k]["world_first_impact_harm"]
    assert team.ledger.world_harm("first") == pytest.approx(harm, rel=1e-4, abs=1e-4)


def failing(observation):
    if (observation[:, 0] == observation_of_world(7)).any():
        raise RuntimeError("not this one")
    return brake(observation)


def observation_of_world(row):
    from ethbrake_marl.observations import observe

    return observe(WORLDS, 1, eb.ObservationSpec())[row, 0]


@pytest.mark.parametrize("chunk", [5, 12])
def test_exception__names_agent_world_of_the_list_and_step(chunk):
    agent = eb.policy_agent(failing, name="mine")
    told = r"agent 'mine', world 7, step 1 \(0\.\d\d s\): observations of shape \(\d+, 27\): RuntimeError: not this one"
    with pytest.raises(AgentFailed, match=told + r" \(test_policy_agent.py, line \d+\)"):
        eb.evaluate(SCENARIO.sample(12, 7), {"mine": agent}, scenario=SCENARIO, chunk=chunk)


@pytest.mark.parametrize("around", AROUND)
def test_exception__names_the_same_world_behind_every_shield(around):
    agent = shielded(eb.policy_agent(failing, name="mine"), around)
    with pytest.raises(AgentFailed, match=r"agent 'mine', world 7, step \d+ "):
        eb.evaluate(SCENARIO.sample(12, 7), {"mine": agent}, scenario=SCENARIO, chunk=5)


@pytest.mark.parametrize(
    ("answer", "told"),
    [
        (lambda seen: brake(seen)[:, 0], r"world 0, step 1 \(0\.00 s\): gave float32 of shape \(12,\) for"),
        (lambda seen: brake(seen)[:5], r"world 5, .*gave float32 of shape \(5, 1\)"),
        (lambda seen: np.where(np.arange(12) == 3, np.nan, -1.0)[:, None], r"world 3, .*in which stands nan; must be"),
        (lambda seen: 1.5 * np.eye(12)[:, 2:3], r"world 2, .*stands 1.5; must be in \[-1, 1\]; with clip=True"),
        (lambda seen: "brake", r"world 0, .*gave <U5 of shape \(\)"),
    ],
)
def test_answer__that_is_no_action_names_agent_world_and_shape(answer, told):
    agent = Asked(eb.policy_agent(answer, name="mine")).begin(WORLDS, 1)
    with pytest.raises(InvalidInput, match="agent 'mine', " + told):
        agent.act(WORLDS, 1)


def test_clip__means_the_nearest_and_one_float32_step_beyond_is_always_1():
    for beyond, clip in ((1.5, True), (float(np.nextafter(np.float32(1), np.float32(2))), False)):
        agent = eb.policy_agent(lambda seen, beyond=beyond: np.full((len(seen), 1), -beyond), clip=clip)
        assert (
            Asked(agent).begin(WORLDS, 1).act(WORLDS, 1).tolist()
            == (-WORLDS.vehicles.braking_capacity_mps2[:, 1]).tolist()
        )


def test_bad_policies__are_refused_at_once(tmp_path: Path, model):
    with pytest.raises(InvalidInput, match=r"a int is no policy; must be a function of observations"):
        eb.policy_agent(3)
    with pytest.raises(InvalidInput, match="there is no such file"):
        eb.policy_agent(tmp_path / "none.onnx")
    with pytest.raises(InvalidInput, match=r"takes observations of shape \(27,\), here are \d+ features"):
        eb.policy_agent(model, observation=eb.ObservationSpec(front=2))
    with pytest.raises(InvalidInput, match="initial_state is for a function"):
        eb.policy_agent(model, initial_state=no_memory)
    agent = eb.policy_agent(ramp, initial_state=lambda n: {"steps": np.zeros(3)})
    with pytest.raises(AgentFailed, match=r"initial_state\(12\): state: ndarray of shape \(3,\); its first"):
        agent.begin(WORLDS, 1, {})


class OwnAgent:
    """An agent of one's own, which is no ``policy_agent``."""

    def __init__(self, answer):
        self.name, self.answer = "own", answer

    def act(self, worlds, vehicle):
        return self.answer(worlds)


@pytest.mark.parametrize("around", ["", *AROUND])
@pytest.mark.parametrize(
    ("answer", "told"),
    [
        (lambda worlds: 1 / 0, r"agent 'own' of vehicle_2: act on \d+ worlds at 0.\d\d s: ZeroDivisionError"),
        (
            lambda worlds: np.zeros((worlds.n, 1)),
            r"agent 'own', world 0, vehicle_2 at 0.\d\d s: gave float64 of shape \(\d+, 1\); one number per world is",
        ),
        (lambda worlds: 1.0, r"agent 'own', world 0, vehicle_2 at 0.\d\d s: gave float64 of shape \(\)"),
        (lambda worlds: None, r"agent 'own', world 0, vehicle_2 at 0.\d\d s: gave object of shape \(\)"),
        (lambda worlds: ["x"] * worlds.n, r"agent 'own', world 0, vehicle_2 at 0.\d\d s: gave <U1 of shape"),
    ],
)
def test_own_agent__that_raises_or_gives_another_shape_is_named(around, answer, told):
    agent = shielded(OwnAgent(answer), around)
    with pytest.raises(InvalidInput, match=told):
        eb.evaluate(SCENARIO.sample(12, 7), {"own": agent}, scenario=SCENARIO)


def test_own_agent__with_too_few_commands_names_the_first_world_without_one() -> None:
    agent = OwnAgent(lambda worlds: np.zeros(min(7, worlds.n)))
    told = r"agent 'own', world 7, vehicle_2 at 0.\d\d s: gave float64 of shape \(7,\); .*, shape \(12,\)"
    with pytest.raises(InvalidInput, match=told):
        eb.evaluate(SCENARIO.sample(12, 7), {"own": agent}, scenario=SCENARIO)


def test_own_agent__with_a_command_that_is_no_number_names_agent_and_world() -> None:
    agent = OwnAgent(lambda worlds: np.where(np.arange(worlds.n) == 4, np.nan, 0.0))
    told = r"agent 'own', world 4, vehicle_2 at 0.\d\d s: command nan m/s2; must be in \[-7, 7\]"
    with pytest.raises(InvalidInput, match=told):
        eb.evaluate(SCENARIO.sample(12, 7), {"own": agent}, scenario=SCENARIO)


class Nameless:
    def begin(self, worlds):
        pass

    def act(self, worlds, vehicle):
        return np.zeros(worlds.n)


@pytest.mark.parametrize("around", ["", *AROUND])
def test_own_agent__without_a_name_or_with_other_parameters_is_told_what_is_wrong(around):
    with pytest.raises(InvalidInput, match="evaluate: agent 'own': 'Nameless' is no agent: it has no name; make_"):
        eb.evaluate(SCENARIO.sample(3, 7), {"own": Nameless()}, scenario=SCENARIO)
    agent = Nameless()
    agent.name = "own"
    told = r"'own' of vehicle_2: has begin, and act without a memory; one that remembers has begin\(alert, vehicle, scr"
    with pytest.raises(InvalidInput, match=told):
        eb.evaluate(SCENARIO.sample(3, 7), {"own": shielded(agent, around)}, scenario=SCENARIO)


FILE = """
import numpy as np
import ethbrake_marl as eb

def make_agent():
    return eb.policy_agent(lambda seen: np.full((len(seen), 1), -0.5), name="half")

def harder(argument, settings):
    return eb.policy_agent(lambda seen: np.full((len(seen), 1), -float(argument)), scenario=settings.scenario)

def wrong():
    return 3

def raising():
    raise KeyError("weights")
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "My+File.py"
    path.write_text(FILE)
    return path


@pytest.mark.parametrize("around", ["", *AROUND])
def test_file__makes_an_agent_alone_and_behind_every_shield(file, around):
    agent = eb.make_agent(f"{file}:harder:0.5{around}", scenario=SCENARIO)
    same = shielded(eb.policy_agent(brake), around)
    assert harms(agent).tolist() == harms(same).tolist()
    assert harms(eb.make_agent(f"{file}:make_agent")).tolist() == harms(eb.policy_agent(brake)).tolist()


@pytest.mark.parametrize(
    ("spec", "told"),
    [
        ("{file}", "one from a file is FILE.py:FUNCTION"),
        ("{file}:", "one from a file is FILE.py:FUNCTION"),
        ("{file}:make_agent+stpe", "did you mean 'step'"),
        ("{file}:make_agent:3", "make_agent has no parameters, so it takes no argument"),
        ("{file}:wrong", "'int' is no agent"),
        ("{file}:raising", r"KeyError: 'weights' \(My\+File.py, line 15\)"),
        ("{file}:nobody", "has no function nobody"),
        ("nowhere/none.py:make_agent", "there is no such file"),
    ],
)
def test_file__what_is_wrong_is_one_clear_error(file, spec, told):
    with pytest.raises(InvalidInput, match=told):
        eb.make_agent(spec.format(file=file), scenario=SCENARIO)


def test_file__no_scenario_can_name_one(file):
    (file.parent / "half.py").write_text(FILE + "raise SystemExit('this ran')")
    for script in (f"{file}:make_agent", "half.py:make_agent"):
        with pytest.raises(InvalidInput, match=r"agent '.*py:make_agent'"):
            SCENARIO.replace(roles={"vehicle_1": script})
