"""Training of a mixture of experts with the algorithm ``vine``."""

from __future__ import annotations

import copy

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import update_learning_rate
from torch.nn.functional import mse_loss, softplus

from ethbrake_marl.extensions.learners.averaged_actor import AveragedActor
from ethbrake_marl.extensions.learners.branches import moving_rows, other_count, visit
from ethbrake_marl.extensions.learners.mixture_policy import ExpertsPolicy
from ethbrake_marl.extensions.learners.mixture_stages import Stage, stages_of
from ethbrake_marl.extensions.learners.mixture_worlds import (
    NoBetterTemplate,
    Shown,
    drive_from,
    explore,
    own_worlds,
    show_templates,
)
from ethbrake_marl.extensions.learners.optimizer import adam, descend, follow
from ethbrake_marl.extensions.learners.scout import choose_rows
from ethbrake_marl.extensions.learners.trust_radius import Tried
from ethbrake_marl.extensions.learners.vine_model import VineModel
from ethbrake_marl.extensions.learners.vine_recipe import VineRecipe
from ethbrake_marl.first_edition.engine.state import State
from ethbrake_marl.first_edition.envs.sb3 import EthBrakeVecEnv
from ethbrake_marl.first_edition.physics.state import Floats
from ethbrake_marl.first_edition.policies.network_spec import Float32s


class ExpertsModel(VineModel):
    """Model that trains a mixture of experts.

    The training run has four stages. The first stage trains the first expert in all worlds. The second stage trains the
    other experts, each in worlds that are selected for it. The third stage trains the gating network, and the last
    stage trains all networks together.

    Args:
        environment: environment in which the model is trained.
        recipe: recipe with the key ``experts``.

    """

    policy: ExpertsPolicy  # type: ignore[assignment]

    def __init__(self, environment: EthBrakeVecEnv, recipe: VineRecipe) -> None:
        assert recipe.experts is not None
        self.plan = recipe.experts
        self._stage: Stage | None = None
        self._own: State | None = None  # starting states of the worlds selected for the stage's expert
        self._rate_share = 1.0
        super().__init__(environment, recipe)

    def _update(self, callback: BaseCallback, total: int) -> None:
        each = self.n_envs * self.recipe.n_steps
        number, policy = self.num_timesteps // each, self.policy
        stage = next(s for s in stages_of(self.plan, -(-total // each)) if s.first <= number < s.end)
        if stage != self._stage:
            self._enter(stage, number)
        member = policy.actors[stage.network]
        if stage.trains == "other":  # whole episodes in some of the worlds selected for this expert
            assert self._own is not None
            some = torch.randint(len(self._own.motion), (self.n_envs,)).numpy()
            visited, moments = visit(self.engine.branch(self._own.take(some)), member.act)
            seen = visited.reshape(1, -1, visited.shape[2])
            self.num_timesteps += each
        else:
            seen, moments = self._visit(callback, member.act if stage.trains == "first" else policy.act)
        callback.on_rollout_end()
        self._update_current_progress_remaining(number - stage.first, stage.end - stage.first)
        self._rate_share = self.plan.joint_rate if stage.trains == "joint" else 1.0
        if stage.trains in ("first", "other"):
            self._train(member, self._try_out(seen, moments, member))
            return
        if stage.trains == "joint":  # each expert learns from the decisions at which it is chosen
            tried = self._try_out(seen, moments, policy)
            chosen = policy.gate.choose(tried.seen)
            for k, actor in enumerate(policy.actors):
                rows = np.flatnonzero(chosen == k)
                if len(rows) > 1:
                    self._train(actor, Tried(*(array[rows] for array in tried)))
        self._train_gate(*self._compare(seen, moments))

    def _update_learning_rate(self, optimizers: list[torch.optim.Optimizer] | torch.optim.Optimizer) -> None:
        assert isinstance(optimizers, torch.optim.Optimizer)
        rate = self._rate_share * self.lr_schedule(self._current_progress_remaining)
        self.logger.record("train/learning_rate", rate)
        update_learning_rate(optimizers, rate)

    def _enter(self, stage: Stage, number: int) -> None:
        """Prepare a stage of the training run, which begins or is resumed at the update ``number``.

        If the stage trains a second or later expert, this expert first imitates templates that have a higher return
        than the earlier experts. Then the worlds for its training are selected.

        The preparation depends only on the earlier experts, so a resumed training run repeats it exactly.

        Raises ``NoBetterTemplate`` if no template has a higher return than the earlier experts, or if no world can be
        selected.
        """
        self._stage, self._own = stage, None
        if stage.trains != "other":
            return
        engine, gamma = self.engine, self.recipe.gamma
        earlier = [actor.act for actor in self.policy.actors[: stage.network]]
        explored = explore(engine, self.plan, earlier, gamma)
        seed = int(self.seed or 0)
        shown = show_templates(engine, self.plan, explored, gamma, seed)
        pupil = copy.deepcopy(self.policy.actors[0])
        self._imitate(pupil, shown, seed + stage.network)
        self._own = own_worlds(engine, self.plan, explored, pupil.act, gamma)
        if len(shown.action) == 0 or len(self._own.motion) == 0:
            raise NoBetterTemplate(
                f"experts: expert {stage.network + 1} has nothing to learn: in none of {self.plan.worlds:,} worlds"
                f" does one of {self.plan.templates} random braking profiles (templates) improve the return of the"
                f" earlier experts by more than {self.plan.gain:g}; set fewer networks, or remove the key experts"
            )
        if number == stage.first:
            self.policy.actors[stage.network].load_state_dict(pupil.state_dict())

    def _imitate(self, pupil: AveragedActor, shown: Shown, seed: int) -> None:
        """Train the expert ``pupil`` to imitate the actions in ``shown``, in a random order that ``seed`` fixes."""
        pupil.optimizer = adam(self.lr_schedule(1.0), pupil.learning)
        seen, wanted = torch.from_numpy(shown.seen), torch.from_numpy(shown.action)
        generator = torch.Generator().manual_seed(seed)
        for _ in range(self.plan.imitation_epochs):
            for batch in torch.split(torch.randperm(len(wanted), generator=generator), self.recipe.batch_size):
                means, target = pupil.learning(seen[batch])[:, 0], wanted[batch]
                reached = (target.abs() >= 1.0) & (means * target >= 1.0)  # an output beyond a bound is clipped to it
                loss = mse_loss(means, torch.where(reached, means.detach(), target))
                descend(pupil.optimizer, loss)
        follow(pupil.average, pupil.learning, 0.0)

    def _compare(self, seen: Float32s, moments: State) -> tuple[Float32s, Floats, Float32s]:
        """Let each of K experts drive from B visited decisions to the end of the episode, to compare their costs.

        The cost of an expert is minus its return, plus ``tie_break`` times its harm. This harm is in the harm count
        that the reward does not use. The B decisions are drawn from the visited decisions (observations ``seen``
        [steps, rows, F]) at which the experts choose different actions; ``moments`` are the states of the worlds at the
        visited decisions.

        Returns the observations at the B decisions, [B, F], the cost of each expert, [B, K], and the weight of each
        decision in the loss (importance), [B].
        """
        engine, members = self.engine, [actor.act for actor in self.policy.actors]
        observed = seen.reshape(-1, seen.shape[2])
        actions = np.stack([act(observed) for act in members])
        differ = (np.ptp(actions, axis=0) > 1e-2) & moving_rows(moments)
        count, scout = self.plan.gating_states, self.policy.gate.scout
        expect = None if scout is None else scout.expect
        rows, importance = choose_rows(observed, np.flatnonzero(differ), count, self.recipe.focus, expect)
        other = other_count(engine.reward.harm_count)
        then = moments.take(rows)
        costs = np.empty((len(rows), len(members)))
        for number, act in enumerate(members):
            gained, harm = drive_from(engine, then, act, self.recipe.gamma, other)
            costs[:, number] = self.plan.tie_break * harm - gained
        good = np.isfinite(costs).all(axis=1)
        return observed[rows[good]], costs[good], importance[good]

    def _train_gate(self, seen: Float32s, costs: Floats, importance: Float32s | None = None) -> None:
        """Train the gating network to choose the cheapest expert.

        The weight of a wrong choice in the loss is proportional to its extra cost: the cost of the chosen expert minus
        the cost of the cheapest expert. ``seen`` is [B, F], ``costs`` [B, K], and ``importance`` [B] weighs the
        decisions in the loss (None: all weights are 1).
        """
        importance = np.ones(len(seen), np.float32) if importance is None else importance
        gate = self.policy.gate
        self._update_learning_rate(gate.optimizer)
        more = (costs - costs.min(axis=1, keepdims=True)).astype(np.float32)
        rows = np.flatnonzero(more.max(axis=1) > 1e-9)
        gate.remember(seen[rows], more[rows] * importance[rows, np.newaxis])
        if gate.scout is not None:
            arrays = [torch.from_numpy(array) for array in (seen, more.max(axis=1), importance)]
            for batch in torch.split(torch.randperm(len(seen)), self.recipe.batch_size):
                descend(gate.optimizer, gate.scout.loss(*(array[batch] for array in arrays)))
        if len(rows):
            regret = np.take_along_axis(more[rows], gate.choose(seen[rows])[:, np.newaxis], axis=1)
            self.logger.record("gating/regret", float((regret[:, 0] * importance[rows]).mean()))
        if int(gate.compared) == 0:
            return
        losses = []
        for _ in range(self.plan.gating_steps):
            inputs, costlier = gate.recall(self.recipe.batch_size)
            scores = gate.learning(inputs)
            best = scores.gather(1, costlier.argmin(dim=1, keepdim=True))
            loss = (costlier * softplus(scores - best)).sum(dim=1).mean()
            descend(gate.optimizer, loss)
            follow(gate.average.parameters(), gate.learning, self.recipe.averaging)
            losses.append(loss.item())
        self.logger.record("gating/loss", float(np.mean(losses)))
