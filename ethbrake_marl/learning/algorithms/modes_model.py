"""The model that learns several networks and a gate: each network its own mode, then all of them together."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box, Space
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.common.utils import update_learning_rate
from torch import Tensor, nn
from torch.nn.functional import mse_loss, softplus

from ethbrake_marl.engine.branches import Act, Moment, branch, visit
from ethbrake_marl.envs.sb3 import EthBrakeVecEnv
from ethbrake_marl.errors import EthBrakeError
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.learning.algorithms.averaged_gate import AveragedGate
from ethbrake_marl.learning.algorithms.counterfactual_model import (
    AveragedActor,
    CounterfactualModel,
    Tried,
    TryingOut,
    moving_rows,
)
from ethbrake_marl.learning.algorithms.mode_worlds import Shown, drive_from, explore, own_worlds, show_templates
from ethbrake_marl.learning.algorithms.modes import ModesPlan, Stage, stages_of
from ethbrake_marl.learning.algorithms.networks import Adam
from ethbrake_marl.learning.algorithms.scout import Scout, choose_rows
from ethbrake_marl.learning.recipe import ActorShape
from ethbrake_marl.physics import Floats
from ethbrake_marl.policies.actor import Float32s

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
