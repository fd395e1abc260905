"""Learning from exact counterfactuals: one actor, or several networks and a gate between them.

The actor drives without exploration; some of its decisions are tried with a little more and a little less, each played
on to the end of its episode, and the actor is regressed on what was better.
"""

from __future__ import annotations

import copy
import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, NamedTuple, Protocol, Self, get_args

import numpy as np
import torch
from gymnasium.spaces import Box, Space
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import create_mlp
from stable_baselines3.common.type_aliases import MaybeCallback, PyTorchObs, Schedule
from stable_baselines3.common.utils import update_learning_rate
from torch import Tensor, nn
from torch.nn.functional import mse_loss, softplus
from torch.optim import Optimizer

from ethbrake_marl.actions import command_to_action
from ethbrake_marl.defaults import HarmCount
from ethbrake_marl.engine.engine import Engine
from ethbrake_marl.engine.snapshot import (
    Act,
    Moment,
    Offsets,
    branch,
    first_moments,
    join_moments,
    moment_of,
    no_offsets,
    play_on,
    play_to_the_end,
    visit,
)
from ethbrake_marl.envs.sb3 import EthBrakeVecEnv
from ethbrake_marl.errors import EthBrakeError, InvalidInput
from ethbrake_marl.learning.algorithms import ACTIVATIONS
from ethbrake_marl.learning.recipe import ActorShape, CounterfactualRecipe, ModesPlan
from ethbrake_marl.learning.training import Algorithm, Training
from ethbrake_marl.observations import Observations
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds
from ethbrake_marl.physics.advance import command_at, speed_at
from ethbrake_marl.policies.actor import Float32s, tensor_table
from ethbrake_marl.policies.bundle import Policy
from ethbrake_marl.policies.shipped import PolicyKind, load_named_policy
from ethbrake_marl.search import best_templates, profile_problem

_KINDS: dict[str, PolicyKind] = {name: name for name in get_args(PolicyKind)}


class Counterfactual(Algorithm):
    """Gradients of the return by playing on from the same moment in two ways; one actor for all learners."""

    def build(self, training: Training, environment: EthBrakeVecEnv) -> CounterfactualModel:
        """The model, from the policy of ``start`` if the recipe names one."""
        recipe = training.recipe
        assert isinstance(recipe, CounterfactualRecipe)
        branch(environment.engine, moment_of(environment.engine))  # refuses what cannot be branched before it begins
        model: CounterfactualModel
        if recipe.modes is None:
            model = CounterfactualModel(environment, recipe)
            first = model.policy
        else:
            model = ModesModel(environment, recipe, recipe.modes)
            first = model.policy.member(0)
        if recipe.start is not None:
            first.take_over(widened(starting_policy(recipe.start, training), training))
        return model

    def optimizers(self, model: BaseAlgorithm) -> dict[str, Optimizer]:
        """The optimiser of the actor, or that of each network and of the gate."""
        if not isinstance(model, ModesModel):
            return {"policy": model.policy.optimizer}
        policy = model.policy
        members = {f"network_{k + 1}": policy.member(k).optimizer for k in range(model.plan.networks)}
        return {**members, "gate": policy.gate.optimizer}


def starting_policy(start: str, training: Training) -> Policy:
    """The policy that ``ppo@PATH``, ``ppo@shipped`` or ``universal@shipped`` names for a training's scenario."""
    kind, _, path = start.partition("@")
    return load_named_policy(path, _KINDS[kind], training.scenario, training.recipe.reward.harm_count)


def widened(policy: Policy, training: Training) -> dict[str, NDArray[np.float32]]:
    """The actor's tensors of ``policy`` for what the training observes; features that are new to it count for nothing.

    Raises ``InvalidInput`` where the training does not observe all that the policy does, or has another network.
    """
    recipe, wanted = training.recipe, training.recipe.network_spec(training.observation.size)
    found = policy.manifest.network
    if found.networks > 1:
        raise InvalidInput(f"recipe {recipe.name!r}: start: has {found.networks} networks; give a policy of one")
    same = ("policy_hidden", "activation", "output")
    for name in same:
        if getattr(found, name) != getattr(wanted, name):
            raise InvalidInput(
                f"recipe {recipe.name!r}: network: {name} is {getattr(wanted, name)}, but {getattr(found, name)} in the"
                " policy to start from; they must be the same"
            )
    names = [feature.name for feature in training.observation.features]
    known = policy.manifest.observation.features
    missing = [name for name in known if name not in names]
    if missing:
        raise InvalidInput(
            f"recipe {recipe.name!r}: observation: lacks {', '.join(missing[:5])}, which the policy to start from"
            " observes; list what it observes, and more"
        )
    tensors = {name: tensor.copy() for name, tensor in policy.tensors.items() if name.startswith("policy.")}
    first = np.zeros((wanted.policy_hidden[0], len(names)), np.float32)
    first[:, [names.index(name) for name in known]] = tensors["policy.0.weight"]
    return {**tensors, "policy.0.weight": first}


class Adam(torch.optim.Adam):
    """torch's, to the bit, without what imports torch's compiler (1 to 3 CPU-s), which has nothing to do here."""


for _name in ("step", "add_param_group", "zero_grad", "state_dict", "load_state_dict"):
    setattr(Adam, _name, torch.no_grad()(inspect.unwrap(getattr(torch.optim.Adam, _name))))


LOG_NOISE = -3.0  # of the bundle: the actor itself never explores


class AveragedActor(BasePolicy):
    """An actor that learns (``learning``), and the running average of its weights, which drives.

    The average stands under the names of Stable-Baselines3's PPO, as a bundle wants it.
    """

    def __init__(
        self, observation_space: Space[Any], action_space: Any, rate: Schedule, shape: ActorShape, focus: float = 0.0
    ) -> None:
        super().__init__(observation_space, action_space)
        assert isinstance(observation_space, Box)
        inputs, activation = observation_space.shape[0], ACTIVATIONS[shape.activation]
        hidden = create_mlp(inputs, -1, list(shape.policy), activation)
        self.mlp_extractor = nn.ModuleDict({"policy_net": nn.Sequential(*hidden)})
        self.action_net = nn.Linear(shape.policy[-1], 1)
        for layer in self._layers(self.mlp_extractor["policy_net"]):
            nn.init.orthogonal_(layer.weight, math.sqrt(2.0))
            nn.init.zeros_(layer.bias)
        nn.init.orthogonal_(self.action_net.weight, 0.01)
        nn.init.constant_(self.action_net.bias, shape.initial_action or 0.0)
        self.log_std = nn.Parameter(torch.full((1,), LOG_NOISE), requires_grad=False)
        last = nn.Linear(shape.policy[-1], 1)
        self.learning = nn.Sequential(*create_mlp(inputs, -1, list(shape.policy), activation), last)
        self._spec = shape.spec(inputs)
        average = [*self._layers(self.mlp_extractor["policy_net"]), self.action_net]
        pairs = list(zip(average, self._layers(self.learning), strict=True))
        self._pairs = [
            (getattr(mean, name), getattr(learns, name)) for mean, learns in pairs for name in ("weight", "bias")
        ]
        self._average(0.0, towards_learning=False)
        self.scout = Scout(inputs) if focus > 0.0 else None
        learned = [*self.learning.parameters(), *(self.scout.parameters() if self.scout is not None else ())]
        self.optimizer = Adam(learned, lr=rate(1.0), eps=1e-5)

    def take_over(self, tensors: Mapping[str, Float32s]) -> None:
        """Begin with these tensors of a bundle."""
        state = self.state_dict()
        for row in tensor_table(self._spec):
            state[row.sb3_name].copy_(torch.from_numpy(tensors[row.name]))
        self._average(0.0, towards_learning=False)

    def follow(self, keep: float) -> None:
        """Move the average towards the weights that learn, keeping this share of what it was."""
        self._average(keep, towards_learning=True)

    def means(self, observation: Float32s) -> Float32s:
        """What the actor that learns says to observations [rows, F], [rows]; beyond -1 and 1 it means -1 and 1."""
        with torch.no_grad():
            found: Float32s = self.learning(torch.from_numpy(observation))[:, 0].numpy()
        return found

    def act(self, observation: Float32s) -> Float32s:
        """Its actions [rows] in [-1, 1]."""
        return np.clip(self.means(observation), -1.0, 1.0)

    def expect(self, observation: Float32s) -> Floats:
        """The size of the gradient that its scout expects, [rows]."""
        assert self.scout is not None
        return self.scout.expect(observation)

    def forward(self, observation: Tensor) -> Tensor:
        """Actions [rows, 1] of the average."""
        means: Tensor = self.action_net(self.mlp_extractor["policy_net"](observation))
        return means.clamp(-1.0, 1.0)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> Tensor:
        assert isinstance(observation, Tensor)
        return self.forward(observation)

    def _average(self, keep: float, *, towards_learning: bool) -> None:
        with torch.no_grad():
            for mean, learns in self._pairs:
                if towards_learning:
                    mean.lerp_(learns, 1.0 - keep)
                else:
                    learns.copy_(mean)

    @staticmethod
    def _layers(network: nn.Module) -> list[nn.Linear]:
        return [layer for layer in network.modules() if isinstance(layer, nn.Linear)]


class Tried(NamedTuple):
    """Decisions that were tried in two ways, and what that brought."""

    seen: Float32s  # [B, F]
    mean: Float32s  # [B] what the actor said; beyond -1 and 1 it means -1 and 1
    gradient: Float32s  # [B] of the return by the action
    importance: Float32s  # [B] what each counts


class Actor(Protocol):
    """What is tried out; its actions are its means, cut at -1 and 1."""

    def means(self, observation: Float32s) -> Float32s:
        """Of observations [rows, F], [rows]."""

    def act(self, observation: Float32s) -> Float32s:
        """Actions [rows] in [-1, 1]."""

    def expect(self, observation: Float32s) -> Floats:
        """The size of the gradient that its scouts expect, [rows]."""


class CounterfactualModel(BaseAlgorithm):
    """Visits decisions by its deterministic actor, tries some of them in two ways, and learns from the difference."""

    policy: AveragedActor

    def __init__(self, environment: EthBrakeVecEnv, recipe: CounterfactualRecipe) -> None:
        super().__init__(
            AveragedActor,
            environment,
            stats_window_size=max(100, environment.num_envs),
            device="cpu",
            support_multi_env=True,
            learning_rate=recipe.learning_rate.at,
            seed=recipe.seed,
        )
        self.recipe = recipe
        self._setup_model()

    def _setup_model(self) -> None:
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        self.policy = AveragedActor(
            self.observation_space, self.action_space, self.lr_schedule, self.recipe.network, self.recipe.focus
        )

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str = "counterfactual",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """Train for so many decisions of learners."""
        total, told = self._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)
        told.on_training_start(locals(), globals())
        while self.num_timesteps < total:
            told.on_rollout_start()
            self._update(told, total)
        told.on_training_end()
        return self

    def _update(self, told: BaseCallback, total: int) -> None:
        """One round of collecting and learning."""
        actor = self.policy
        seen, moments = self._visit(told, actor.act)
        told.on_rollout_end()
        self._update_current_progress_remaining(self.num_timesteps, total)
        self._train(actor, self._try_out(seen, moments, actor))

    def _visit(self, told: BaseCallback, act: Act) -> tuple[Float32s, Moment]:
        """Drive on for ``n_steps``; what was seen [n_steps, rows, F], and the worlds' moments, step by step."""
        assert isinstance(self.env, EthBrakeVecEnv)
        seen, moments = [], []
        for _ in range(self.recipe.n_steps):
            observations: Any = self._last_obs
            seen.append(observations)
            moments.append(moment_of(self.env.engine))
            new_obs, rewards, dones, infos = self.env.step(act(observations)[:, np.newaxis])
            self.num_timesteps += self.env.num_envs
            self._update_info_buffer([infos[row] for row in np.flatnonzero(dones)], dones[dones])  # others tell nothing
            self._last_obs, self._last_episode_starts = new_obs, dones  # type: ignore[assignment]
            told.update_locals(locals())
            told.on_step()
        return np.stack(seen), join_moments(moments)

    def _try_out(self, seen: Float32s, moments: Moment, actor: Actor) -> Tried:
        """Try some of the visited decisions with more and with less, each to the end of its episode."""
        assert isinstance(self.env, EthBrakeVecEnv)
        recipe, learners = self.recipe, len(self.env.engine.learners)
        moving = np.flatnonzero(moving_rows(moments, self.env.engine.scenario.vehicles).repeat(learners))
        observed = seen.reshape(-1, seen.shape[2])
        rows, importance = choose_rows(observed, moving, recipe.counterfactuals, recipe.focus, actor.expect)
        sizes = _log_uniform(recipe.offset.smallest, recipe.offset.largest, len(rows))
        holds = np.array(recipe.holds, np.int64)[torch.randint(len(recipe.holds), (len(rows),)).numpy()]
        both = np.concatenate([sizes, -sizes])
        worlds: Ints = np.tile(rows // learners, 2)
        engine = branch(self.env.engine, moments.take(worlds))
        offsets = Offsets(np.tile(rows % learners, 2), both, np.tile(holds, 2))
        gained, moved = play_to_the_end(engine, actor.act, offsets, recipe.gamma)
        gradient = np.clip(_difference(gained) / _difference(moved), -recipe.gradient_limit, recipe.gradient_limit)
        good = np.isfinite(gradient)
        then = observed[rows[good]]
        return Tried(then, actor.means(then), gradient[good].astype(np.float32), importance[good])

    def _train(self, actor: AveragedActor, tried: Tried) -> None:
        """Regress the actor on actions that are better, within the trust radius; log what that was."""
        recipe = self.recipe
        self._update_learning_rate(actor.optimizer)
        target, weight = trusted_targets(tried, recipe.trust_radius, recipe.anchor)
        arrays = (tried.seen, target, weight * tried.importance, np.abs(tried.gradient), tried.importance)
        seen, wanted, weights, sizes, importance = (torch.from_numpy(array) for array in arrays)
        losses = []
        for _ in range(recipe.n_epochs):
            for batch in torch.split(torch.randperm(len(wanted)), recipe.batch_size):
                means = actor.learning(seen[batch])[:, 0]
                loss = (weights[batch] * (means - wanted[batch]) ** 2).mean()
                actor.optimizer.zero_grad()
                loss.backward()
                if actor.scout is not None:
                    actor.scout.loss(seen[batch], sizes[batch], importance[batch]).backward()  # type: ignore[no-untyped-call]
                actor.optimizer.step()
                actor.follow(recipe.averaging)
                losses.append(loss.item())
        self._n_updates += recipe.n_epochs
        self.logger.record("train/loss", float(np.mean(losses)) if losses else 0.0)
        self.logger.record("train/gradient", float(np.abs(tried.gradient).mean()) if len(wanted) else 0.0)
        self.logger.record("train/counterfactuals", len(wanted))


def moving_rows(moments: Moment, vehicles: int) -> Bools:
    """In which rows some vehicle moves; where everything stands there is nothing to learn."""
    moving: Bools = (moments.state[:, speed_at(vehicles) : command_at(vehicles)] != 0.0).any(axis=1)
    return moving


def trusted_targets(tried: Tried, radius: float, anchor: float) -> tuple[Float32s, Float32s]:
    """Where the means [B] should go, and how much that weighs [B]: ``m + g / w`` with ``w = |g| / radius + anchor``.

    Half the weighted squared distance from there is, up to a constant, ``-g (mu - m) + w (mu - m)^2 / 2``: the exact
    slope, and a curvature with which nothing moves farther than the radius, however large its gradient. A mean at or
    beyond a bound is not asked to go farther out, where its action would not change.
    """
    outward = ((tried.mean >= 1.0) & (tried.gradient > 0.0)) | ((tried.mean <= -1.0) & (tried.gradient < 0.0))
    gradient = tried.gradient.copy()
    gradient[outward] = 0.0
    weight = (np.abs(gradient) / radius + anchor).astype(np.float32)
    target: Float32s = tried.mean + gradient / weight
    return target, weight


def _difference(values: Floats) -> Floats:
    """The first half minus the second."""
    half = len(values) // 2
    return values[:half] - values[half:]


def _log_uniform(smallest: float, largest: float, count: int) -> NDArray[np.float64]:
    share = torch.rand(count, dtype=torch.float64).numpy()
    drawn: NDArray[np.float64] = smallest * (largest / smallest) ** share
    return drawn


# A scout: it learns at which decisions a difference is to be expected, so that most are tried where there is one.
#
# Where nothing depends on what is done, a counterfactual says 0 and costs as much as any other. Decisions are drawn
# with
# unequal chances, and each counts the less, the likelier it was drawn: what is learned is the same on average.

WIDTH = 64  # of its hidden layer
HIGHEST = 20.0  # logarithm of what it expects at most


class Drawn(NamedTuple):
    """Rows that were drawn, and what each counts."""

    rows: Ints  # [B], the same one several times where a difference is expected
    importance: Float32s  # [B] 1 / (chance of the row x number of rows); their mean is 1 on average


class Scout(nn.Module):
    """A small network for the size of the difference that is to be expected of an observation."""

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(inputs, WIDTH), nn.ReLU(), nn.Linear(WIDTH, 1))
        last = self.layers[-1]
        assert isinstance(last, nn.Linear)
        nn.init.zeros_(last.weight)  # until it learns, it expects the same everywhere
        nn.init.zeros_(last.bias)

    def forward(self, observation: Tensor) -> Tensor:
        """The logarithm of what is to be expected [rows] of observations [rows, F]."""
        found: Tensor = self.layers(observation)[:, 0].clamp(max=HIGHEST)
        return found

    def expect(self, observation: Float32s) -> Floats:
        """What is to be expected [rows], above 0."""
        with torch.no_grad():
            found: Floats = np.exp(self(torch.from_numpy(observation)).numpy().astype(np.float64))
        return found

    def loss(self, observation: Tensor, size: Tensor, importance: Tensor) -> Tensor:
        """Least where it expects the mean size; of sizes [rows] >= 0, whose largest do not rule it as in a square."""
        logarithm = self(observation)
        found: Tensor = (importance * (logarithm.exp() - size * logarithm)).mean()
        return found


def draw_rows(expected: Floats, count: int, focus: float) -> Drawn:
    """Draw ``count`` of the rows: the share ``focus`` in proportion to ``expected`` [n] > 0, the others evenly."""
    n = len(expected)
    chance = (1.0 - focus) / n + focus * (expected / expected.sum())
    rows = torch.multinomial(torch.from_numpy(chance), count, replacement=True).numpy()
    return Drawn(rows, (1.0 / (n * chance[rows])).astype(np.float32))


def choose_rows(
    observed: Float32s, rows: Ints, count: int, focus: float, expect: Callable[[Float32s], Floats]
) -> Drawn:
    """Draw ``count`` of ``rows``: evenly and each once, or mostly where ``expect`` says that there is a difference."""
    if focus == 0.0 or len(rows) == 0:
        some = rows[torch.randperm(len(rows))[:count].numpy()]
        return Drawn(some, np.ones(len(some), np.float32))
    drawn = draw_rows(expect(observed[rows]), count, focus)
    return Drawn(rows[drawn.rows], drawn.importance)


# Several networks: which updates of a training do what.

ROUNDING = 1e-6  # of sums of shares, in updates


class Stage(NamedTuple):
    """What a stretch of updates is for."""

    does: Literal["alone", "further", "gate", "together"]
    network: int  # that of ``further``
    first: int  # update, from 0
    end: int  # the first update after it


def stages_of(plan: ModesPlan, updates: int) -> tuple[Stage, ...]:
    """The stages of a training with so many updates, in order; some may be empty."""
    shares, more = plan.shares, plan.networks - 1
    parts: list[tuple[Literal["alone", "further", "gate", "together"], int, float]] = [("alone", 0, shares.alone)]
    parts += [("further", k + 1, shares.further / more) for k in range(more)]
    parts += [("gate", 0, shares.gate), ("together", 0, shares.together)]
    found, done, first = [], 0.0, 0
    for does, network, share in parts:
        done += share
        end = min(math.ceil(done * updates - ROUNDING), updates)
        found.append(Stage(does, network, first, end))
        first = end
    return tuple(found)


# The gate between several networks: what it has learned, the average that decides, and what it remembers.


class AveragedGate(nn.Module):
    """A gate that learns (``learning``), and the running average of its weights (``average``), which decides.

    It remembers the last decisions at which networks were compared: what was seen, and how much more than the best one
    each of them costs.
    """

    seen: Tensor  # [M, F]
    more: Tensor  # [M, K]
    compared: Tensor  # [1] so far; the newest take the places of the oldest

    def __init__(self, inputs: int, plan: ModesPlan, shape: ActorShape, rate: Schedule, focus: float = 0.0) -> None:
        super().__init__()
        networks = plan.networks
        layers = create_mlp(inputs, networks, list(plan.gate), ACTIVATIONS[shape.activation])
        nn.init.zeros_(layers[-1].weight)  # type: ignore[arg-type]  # until it learns, the first network acts
        nn.init.zeros_(layers[-1].bias)  # type: ignore[arg-type]
        self.average = nn.Sequential(*layers)
        self.learning = copy.deepcopy(self.average)
        self.scout = Scout(inputs) if focus > 0.0 else None
        learned = [*self.learning.parameters(), *(self.scout.parameters() if self.scout is not None else ())]
        self.optimizer = Adam(learned, lr=rate(1.0), eps=1e-5)
        self.register_buffer("seen", torch.zeros(plan.gate_memory, inputs))
        self.register_buffer("more", torch.zeros(plan.gate_memory, networks))
        self.register_buffer("compared", torch.zeros(1, dtype=torch.int64))

    def remember(self, seen: Float32s, more: Float32s) -> None:
        """Keep compared decisions."""
        M, before = len(self.seen), int(self.compared)
        places = torch.arange(before, before + len(seen)) % M
        self.seen[places], self.more[places] = torch.from_numpy(seen), torch.from_numpy(more)
        self.compared += len(seen)

    def recall(self, count: int) -> tuple[Tensor, Tensor]:
        """Some of the kept ones, [count, F] and [count, K]."""
        some = torch.randint(min(int(self.compared), len(self.seen)), (count,))
        return self.seen[some], self.more[some]

    def choose(self, observation: Float32s) -> NDArray[np.int64]:
        """Which network acts on each of the observations [rows, F], [rows]."""
        with torch.no_grad():
            chosen: NDArray[np.int64] = self.average(torch.from_numpy(observation)).argmax(dim=1).numpy()
        return chosen

    def expect(self, observation: Float32s) -> Floats:
        """How much its scout expects to depend on the choice, [rows]."""
        assert self.scout is not None
        return self.scout.expect(observation)

    def follow(self, keep: float) -> None:
        """Move the average towards the weights that learn, keeping this share of what it was."""
        with torch.no_grad():
            for mean, learns in zip(self.average.parameters(), self.learning.parameters(), strict=True):
                mean.lerp_(learns, 1.0 - keep)


# The worlds of another mode: where random templates of a whole episode do better than every network so far.

NO_DIFFERENCE = 1e-2  # of returns: two networks that differ by less do the same


class Explored(NamedTuple):
    """Worlds of the training, and the best that networks do in them."""

    alert: Worlds
    start: Moment  # at the first decision
    gained: Floats  # [n] the highest return
    harm: Floats  # [n] the least harm (m2/s2)


class Shown(NamedTuple):
    """What templates did at each decision, to be imitated."""

    seen: Float32s  # [m, F]
    action: Float32s  # [m]


def explore(engine: Engine, plan: ModesPlan, acts: Sequence[Act], gamma: float) -> Explored:
    """The first worlds of the training, each driven by every network from its start to its end."""
    alert, start = first_moments(engine, plan.worlds)
    gained, harm = np.full(plan.worlds, -np.inf), np.full(plan.worlds, np.inf)
    for act in acts:
        its_gain, its_harm = drive_from(engine, start, act, gamma)
        gained, harm = np.fmax(gained, its_gain), np.fmin(harm, its_harm)
    return Explored(alert, start, gained, harm)


def drive_from(
    engine: Engine, start: Moment, act: Act, gamma: float, count: HarmCount | None = None
) -> tuple[Floats, Floats]:
    """Return of the first learner [n], NaN for a row that could not be advanced, and harm of the world [n] (m2/s2).

    The harm is of the reward's count unless another one is given.
    """
    rows = branch(engine, start)
    gained, _ = play_to_the_end(rows, act, no_offsets(rows.n), gamma)
    return gained, rows.ledger.world_harm(engine.reward.harm_count if count is None else count)


def show_templates(engine: Engine, plan: ModesPlan, found: Explored, gamma: float, seed: int) -> Shown:
    """What the best template does in each world in which it gains more, by ``plan.gain``, than every network."""
    (vehicle,) = engine.learners
    problem = profile_problem(
        found.alert,
        [vehicle],
        harm_count=engine.reward.harm_count,
        horizon_s=engine.scenario.horizon_s,
        time_step_s=engine.scenario.time_step_s,
        others_mps2=found.start.wanted,
    )
    commands, steps = best_templates(problem, found.harm, number=plan.templates, seed=seed)
    rows = np.flatnonzero(steps > 0)
    actions = _actions_of(commands[rows], found.alert.take(rows), vehicle)
    seen_then: list[Observations] = []
    where: list[Ints] = []

    def decide(seen: Observations, some: Ints, number: int) -> Floats:
        seen_then.append(seen[:, 0])
        where.append(some)
        wanted: Floats = actions[some, number][:, np.newaxis]
        return wanted

    gained = play_on(branch(engine, found.start.take(rows)), decide, gamma)[:, 0]
    better: Bools = gained > found.gained[rows] + plan.gain
    if not where:
        return Shown(np.zeros((0, engine.observation.size), np.float32), np.zeros(0, np.float32))
    wanted = np.concatenate([actions[some, number] for number, some in enumerate(where)]).astype(np.float32)
    kept = better[np.concatenate(where)]
    return Shown(np.concatenate(seen_then)[kept], wanted[kept])


def own_worlds(engine: Engine, plan: ModesPlan, found: Explored, act: Act, gamma: float) -> Moment:
    """The starts of the worlds in which ``act`` is at most ``plan.margin`` worse than the networks before it.

    Those where it makes no difference are left out, and those where the networks before do no harm: they teach nothing.
    """
    gained, _ = drive_from(engine, found.start, act, gamma)
    more = gained - found.gained
    rows = np.flatnonzero((more > -plan.margin) & (np.abs(more) > NO_DIFFERENCE) & (found.harm > 0.0))
    return found.start.take(rows)


def _actions_of(commands_mps2: Floats, worlds: Worlds, vehicle: int) -> Floats:
    """Actions [n, T] for commands [n, T]."""
    each = [command_to_action(commands_mps2[:, t], worlds.vehicles, vehicle) for t in range(commands_mps2.shape[1])]
    return np.stack(each, axis=1)


OTHER_COUNT: dict[HarmCount, HarmCount] = {"first": "total", "total": "first"}
SAME_COST = 1e-9
SAME_ACTION = 1e-2


class NoOtherMode(EthBrakeError, ValueError):
    """No template does better than the networks so far: there is no other mode to be learned."""


class ModesPolicy(BasePolicy):
    """Several actors and a gate; under the names that ``policies.manifest.tensor_table`` has for them."""

    def __init__(
        self,
        observation_space: Space[Any],
        action_space: Any,
        rate: Schedule,
        shape: ActorShape,
        plan: ModesPlan,
        focus: float = 0.0,
    ) -> None:
        super().__init__(observation_space, action_space)
        assert isinstance(observation_space, Box)
        actors = [AveragedActor(observation_space, action_space, rate, shape, focus) for _ in range(plan.networks)]
        self.members = nn.ModuleList(actors)
        self.gate = AveragedGate(observation_space.shape[0], plan, shape, rate, focus)

    def member(self, number: int) -> AveragedActor:
        """One of its actors."""
        found = self.members[number]
        assert isinstance(found, AveragedActor)
        return found

    def means(self, observation: Float32s) -> Float32s:
        """What the actors that learn say where the gate chooses them, [rows]; beyond -1 and 1 it means -1 and 1."""
        chosen, means = self.gate.choose(observation), np.empty(len(observation), np.float32)
        for number in range(len(self.members)):
            rows = np.flatnonzero(chosen == number)
            means[rows] = self.member(number).means(observation[rows])
        return means

    def act(self, observation: Float32s) -> Float32s:
        """Its actions [rows] in [-1, 1]."""
        return np.clip(self.means(observation), -1.0, 1.0)

    def expect(self, observation: Float32s) -> Floats:
        """The size of the gradient that the scouts of the actors expect where the gate chooses them, [rows]."""
        chosen, found = self.gate.choose(observation), np.empty(len(observation))
        for number in range(len(self.members)):
            rows = np.flatnonzero(chosen == number)
            found[rows] = self.member(number).expect(observation[rows])
        return found

    def forward(self, observation: Tensor) -> Tensor:
        """Actions [rows, 1] of the averages."""
        chosen = self.gate.average(observation).argmax(dim=1, keepdim=True)
        every = torch.cat([self.member(number)(observation) for number in range(len(self.members))], dim=1)
        return every.gather(1, chosen)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> Tensor:
        assert isinstance(observation, Tensor)
        return self.forward(observation)


class ModesModel(CounterfactualModel):
    """Learns a network alone, further ones in the worlds of their own modes, the gate, and then all together."""

    policy: ModesPolicy  # type: ignore[assignment]

    def __init__(self, environment: EthBrakeVecEnv, recipe: CounterfactualRecipe, plan: ModesPlan) -> None:
        self.plan = plan
        self._stage: Stage | None = None
        self._own: Moment | None = None  # starts of the worlds of the stage's network
        self._rate_share = 1.0
        super().__init__(environment, recipe)

    def _setup_model(self) -> None:
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        self.policy = ModesPolicy(
            self.observation_space,
            self.action_space,
            self.lr_schedule,
            self.recipe.network,
            self.plan,
            self.recipe.focus,
        )

    def _update(self, told: BaseCallback, total: int) -> None:
        each = self.n_envs * self.recipe.n_steps
        number, policy = self.num_timesteps // each, self.policy
        stage = next(s for s in stages_of(self.plan, -(-total // each)) if s.first <= number < s.end)
        if stage != self._stage:
            self._enter(stage, number)
        member = policy.member(stage.network)
        if stage.does == "further":
            seen, moments = self._visit_own(member.act)
        else:
            seen, moments = self._visit(told, member.act if stage.does == "alone" else policy.act)
        told.on_rollout_end()
        self._update_current_progress_remaining(number - stage.first, stage.end - stage.first)
        self._rate_share = self.plan.together_rate if stage.does == "together" else 1.0
        if stage.does in ("alone", "further"):
            self._train(member, self._try_out(seen, moments, member))
            return
        if stage.does == "together":
            self._train_chosen(self._try_out(seen, moments, policy))
        self._train_gate(*self._compare(seen, moments))

    def _update_learning_rate(self, optimizers: list[torch.optim.Optimizer] | torch.optim.Optimizer) -> None:
        assert isinstance(optimizers, torch.optim.Optimizer)
        rate = self._rate_share * self.lr_schedule(self._current_progress_remaining)
        self.logger.record("train/learning_rate", rate)
        update_learning_rate(optimizers, rate)

    def _enter(self, stage: Stage, number: int) -> None:
        """Prepare a stage. After a resume this finds the same again: it depends on finished networks alone."""
        self._stage, self._own = stage, None
        if stage.does != "further":
            return
        assert isinstance(self.env, EthBrakeVecEnv)
        engine, gamma = self.env.engine, self.recipe.gamma
        before = [self.policy.member(k).act for k in range(stage.network)]
        found = explore(engine, self.plan, before, gamma)
        seed = int(self.seed or 0)
        shown = show_templates(engine, self.plan, found, gamma, seed)
        pupil = copy.deepcopy(self.policy.member(0))
        self._imitate(pupil, shown, seed + stage.network)
        self._own = own_worlds(engine, self.plan, found, pupil.act, gamma)
        if len(shown.action) == 0 or len(self._own.state) == 0:
            raise NoOtherMode(
                f"modes: network {stage.network + 1}: in none of {self.plan.worlds:,} worlds did one of"
                f" {self.plan.templates} templates do better by {self.plan.gain:g}; leave out modes, or have"
                " fewer networks"
            )
        if number == stage.first:
            self.policy.member(stage.network).load_state_dict(pupil.state_dict())

    def _imitate(self, pupil: AveragedActor, shown: Shown, seed: int) -> None:
        """Teach a network what templates do."""
        pupil.optimizer = Adam(pupil.learning.parameters(), lr=self.lr_schedule(1.0), eps=1e-5)
        seen, wanted = torch.from_numpy(shown.seen), torch.from_numpy(shown.action)
        generator = torch.Generator().manual_seed(seed)
        for _ in range(self.plan.imitation_epochs):
            for batch in torch.split(torch.randperm(len(wanted), generator=generator), self.recipe.batch_size):
                means, target = pupil.learning(seen[batch])[:, 0], wanted[batch]
                reached = (target.abs() >= 1.0) & (means * target >= 1.0)  # beyond a bound it means the bound
                loss = mse_loss(means, torch.where(reached, means.detach(), target))
                pupil.optimizer.zero_grad()
                loss.backward()  # type: ignore[no-untyped-call]
                pupil.optimizer.step()
        pupil.follow(0.0)

    def _visit_own(self, act: Act) -> tuple[Float32s, Moment]:
        """Drive whole episodes in some of the stage's own worlds; what was seen [1, rows, F], and the moments."""
        assert isinstance(self.env, EthBrakeVecEnv) and self._own is not None
        some = torch.randint(len(self._own.state), (self.n_envs,)).numpy()
        seen, moments = visit(branch(self.env.engine, self._own.take(some)), act)
        self.num_timesteps += self.n_envs * self.recipe.n_steps
        return seen.reshape(1, -1, seen.shape[2]), moments

    def _train_chosen(self, tried: Tried) -> None:
        """Train each network on what was tried where the gate chooses it."""
        chosen = self.policy.gate.choose(tried.seen)
        for number in range(self.plan.networks):
            rows = np.flatnonzero(chosen == number)
            if len(rows) > 1:
                self._train(self.policy.member(number), Tried(*(array[rows] for array in tried)))

    def _compare(self, seen: Float32s, moments: Moment) -> tuple[Float32s, Floats, Float32s]:
        """At some decisions: what is seen [B, F], what going on with each network costs [B, K], what each counts [B].

        Where all networks would do the same now nothing depends on the choice: the gate is asked again at the next one.
        """
        assert isinstance(self.env, EthBrakeVecEnv)
        engine, members = self.env.engine, [self.policy.member(k).act for k in range(self.plan.networks)]
        observed = seen.reshape(-1, seen.shape[2])
        actions = np.stack([act(observed) for act in members])
        differ = (np.ptp(actions, axis=0) > SAME_ACTION) & moving_rows(moments, engine.scenario.vehicles)
        count, expect = self.plan.gate_states, self.policy.gate.expect
        rows, importance = choose_rows(observed, np.flatnonzero(differ), count, self.recipe.focus, expect)
        other, then = OTHER_COUNT[engine.reward.harm_count], moments.take(rows)
        costs = np.empty((len(rows), len(members)))
        for number, act in enumerate(members):
            gained, harm = drive_from(engine, then, act, self.recipe.gamma, other)
            costs[:, number] = self.plan.tie_break * harm - gained
        good = np.isfinite(costs).all(axis=1)
        return observed[rows[good]], costs[good], importance[good]

    def _train_gate(self, seen: Float32s, costs: Floats, importance: Float32s | None = None) -> None:
        """Teach the gate which network costs least, each decision as much as the others would cost more."""
        importance = np.ones(len(seen), np.float32) if importance is None else importance
        gate = self.policy.gate
        self._update_learning_rate(gate.optimizer)
        more = (costs - costs.min(axis=1, keepdims=True)).astype(np.float32)
        rows = np.flatnonzero(more.max(axis=1) > SAME_COST)
        gate.remember(seen[rows], more[rows] * importance[rows, np.newaxis])
        if gate.scout is not None:
            self._train_scout(gate.scout, seen, more.max(axis=1), importance)
        if len(rows):
            regret = np.take_along_axis(more[rows], gate.choose(seen[rows])[:, np.newaxis], axis=1)
            self.logger.record("gate/regret", float((regret[:, 0] * importance[rows]).mean()))
        if int(gate.compared) == 0:
            return
        losses = []
        for _ in range(self.plan.gate_steps):
            inputs, costlier = gate.recall(self.recipe.batch_size)
            scores = gate.learning(inputs)
            best = scores.gather(1, costlier.argmin(dim=1, keepdim=True))
            loss = (costlier * softplus(scores - best)).sum(dim=1).mean()
            gate.optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            gate.optimizer.step()
            gate.follow(self.recipe.averaging)
            losses.append(loss.item())
        self.logger.record("gate/loss", float(np.mean(losses)))

    def _train_scout(self, scout: Scout, seen: Float32s, size: Float32s, importance: Float32s) -> None:
        """Teach the gate's scout what the choice was worth, in one pass."""
        arrays = [torch.from_numpy(array) for array in (seen, size, importance)]
        for batch in torch.split(torch.randperm(len(seen)), self.recipe.batch_size):
            self.policy.gate.optimizer.zero_grad()
            scout.loss(*(array[batch] for array in arrays)).backward()  # type: ignore[no-untyped-call]
            self.policy.gate.optimizer.step()
