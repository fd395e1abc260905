"""The model that learns several networks and a gate: each network its own mode, then all of them together."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium.spaces import Box, Space
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import create_mlp
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.common.utils import update_learning_rate
from torch import Tensor, nn
from torch.nn.functional import mse_loss, softplus

from ethbrake_marl.actions import command_to_action
from ethbrake_marl.defaults import HarmCount
from ethbrake_marl.engine.engine import Engine
from ethbrake_marl.engine.snapshot import (
    Act,
    Moment,
    branch,
    first_moments,
    no_offsets,
    play_on,
    play_to_the_end,
    visit,
)
from ethbrake_marl.envs.sb3 import EthBrakeVecEnv
from ethbrake_marl.errors import EthBrakeError
from ethbrake_marl.learning.algorithms.counterfactual_model import (
    AveragedActor,
    CounterfactualModel,
    Tried,
    TryingOut,
    moving_rows,
)
from ethbrake_marl.learning.algorithms.networks import ACTIVATIONS, Adam, Scout, choose_rows
from ethbrake_marl.learning.algorithms.protocol import ModesPlan, Stage, stages_of
from ethbrake_marl.learning.recipe import ActorShape
from ethbrake_marl.observations import Observations
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds
from ethbrake_marl.policies.actor import Float32s
from ethbrake_marl.search import best_templates, profile_problem

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

    def __init__(
        self, environment: EthBrakeVecEnv, shape: ActorShape, how: TryingOut, plan: ModesPlan, **settings: Any
    ) -> None:
        self.plan = plan
        self._stage: Stage | None = None
        self._own: Moment | None = None  # starts of the worlds of the stage's network
        self._rate_share = 1.0
        super().__init__(environment, shape, how, **settings)

    def _setup_model(self) -> None:
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        self.policy = ModesPolicy(
            self.observation_space, self.action_space, self.lr_schedule, self._shape, self.plan, self.how.focus
        )

    def _update(self, told: BaseCallback, total: int) -> None:
        each = self.n_envs * self.how.n_steps
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
        engine, gamma = self.env.engine, self.how.gamma
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
            for batch in torch.split(torch.randperm(len(wanted), generator=generator), self.how.batch_size):
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
        self.num_timesteps += self.n_envs * self.how.n_steps
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
        rows, importance = choose_rows(observed, np.flatnonzero(differ), count, self.how.focus, expect)
        other, then = OTHER_COUNT[engine.reward.harm_count], moments.take(rows)
        costs = np.empty((len(rows), len(members)))
        for number, act in enumerate(members):
            gained, harm = drive_from(engine, then, act, self.how.gamma, other)
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
            inputs, costlier = gate.recall(self.how.batch_size)
            scores = gate.learning(inputs)
            best = scores.gather(1, costlier.argmin(dim=1, keepdim=True))
            loss = (costlier * softplus(scores - best)).sum(dim=1).mean()
            gate.optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            gate.optimizer.step()
            gate.follow(self.how.averaging)
            losses.append(loss.item())
        self.logger.record("gate/loss", float(np.mean(losses)))

    def _train_scout(self, scout: Scout, seen: Float32s, size: Float32s, importance: Float32s) -> None:
        """Teach the gate's scout what the choice was worth, in one pass."""
        arrays = [torch.from_numpy(array) for array in (seen, size, importance)]
        for batch in torch.split(torch.randperm(len(seen)), self.how.batch_size):
            self.policy.gate.optimizer.zero_grad()
            scout.loss(*(array[batch] for array in arrays)).backward()  # type: ignore[no-untyped-call]
            self.policy.gate.optimizer.step()
