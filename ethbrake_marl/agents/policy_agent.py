"""Agents that drive with a policy of this package, or of any other library."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.agents.action_scale import REACH, ActionForm, ActionScale, count_in
from ethbrake_marl.agents.foreign import (
    Ask,
    ask_function,
    ask_of,
    check_gamma,
    check_wrappers,
    features_of,
    form_of_actions,
)
from ethbrake_marl.episode.commands import LARGEST_ACTION, commands_of
from ethbrake_marl.episode.counts import COUNTS, HarmCount
from ethbrake_marl.episode.features import GROUPS
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.layer import MESSAGES, Observer, check_seen, observe_through
from ethbrake_marl.episode.observe import Observations, View
from ethbrake_marl.episode.state import NUMBER, State, map_arrays
from ethbrake_marl.errors import AgentFailed, InvalidInput, Unfamiliar
from ethbrake_marl.motion.digest import physics_digest
from ethbrake_marl.motion.layout import Floats, Ints
from ethbrake_marl.policies.manifest import PHYSICS_KEY
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.policies.training_range import TrainingRange
from ethbrake_marl.worlds.catalogue import load_scenario
from ethbrake_marl.worlds.open_game import AnyScenario, views_of
from ethbrake_marl.worlds.scenario import Scenario


class RangeMemory(NamedTuple):
    outside: Ints  # [n] number of decisions so far outside the range of the policy's training


@dataclass(frozen=True, kw_only=True)
class RangeObserver(Observer):
    """Base class of agents that count the decisions outside the range of their training in a ``RangeMemory``."""

    def measures(self, last: State, memory: Any, body: int) -> dict[str, Floats]:
        if not isinstance(memory, RangeMemory):
            return {}
        return {"outside": memory.outside / np.maximum(last.steps, 1)}


@dataclass(frozen=True)
class LearnedAgent(RangeObserver):
    """Drives with the deterministic actions of a policy of this package.

    >>> import ethbrake_marl as eb
    >>> eb.LearnedAgent(eb.load_shipped("ppo"), name="mine").name
    'mine'
    """

    policy: Policy
    name: str = "learned"
    knows: str = MESSAGES

    def __post_init__(self) -> None:
        if not isinstance(self.policy, Policy):
            raise InvalidInput(
                f"agent {self.name!r}: policy = {self.policy!r:.80}: must be a policy with one action, such as that of"
                " load_policy(PATH); for a function or a model of another library use policy_agent"
            )

    def check(self, game: Game, body: int) -> None:
        """Warn (``Unfamiliar``) if the policy was trained with another physics or another time step."""
        manifest, step_s = self.policy.manifest, game.settings.time_step_s
        then, now = manifest.versions.get(PHYSICS_KEY), physics_digest()
        if then not in (None, now):
            warnings.warn(
                f"{self.name}: was trained on other physics ({then!r:.20}) than this installation's ({now!r}), so it"
                " may drive worse than reported; train it again",
                Unfamiliar,
                stacklevel=2,
            )
        if abs(manifest.time_step_s - step_s) > 1e-9:
            warnings.warn(
                f"{self.name}: decided every {manifest.time_step_s:g} s in its training, but decides every {step_s:g} s"
                f" in scenario {game.name!r}",
                Unfamiliar,
                stacklevel=2,
            )

    def begin(self, alert: State, body: int) -> RangeMemory | None:
        return None if self.training_range is None else RangeMemory(np.zeros(alert.n, np.int64))

    def act(self, state: State, memory: RangeMemory | None, body: int) -> tuple[Floats, RangeMemory | None]:
        observations = self.observe(self.policy.observation, state, body)
        actions = self.policy(observations)[:, 0].astype(np.float64)
        if self.training_range is not None and memory is not None:
            outside = self.training_range.is_outside(observations) & ~state.ended
            memory = RangeMemory(memory.outside + outside)
        return commands_of(state, body, actions), memory

    @property
    def training_range(self) -> TrainingRange | None:
        return self.policy.manifest.training_range

    @property
    def trained_for(self) -> HarmCount | str | None:
        """Count of harm that the training minimised, or its name if it is not registered; None: none."""
        reward = self.policy.manifest.reward
        name = reward.get("harm_count") if reward.get("harm") else None
        if not isinstance(name, str):
            return None
        return HarmCount.of(name) if name in COUNTS else name

    def observe(self, view: View, state: State, body: int) -> Observations:
        check_seen(self, state, body)
        return observe_through(self.layers, view, state, body, self.policy.manifest.time_step_s)


@dataclass(frozen=True)
class PolicyAgent(RangeObserver):
    """Drives with a policy of another library; made by ``policy_agent``. It can be pickled if the policy can."""

    policy: Any
    name: str
    ask: Ask
    observation: View
    is_assumed: bool  # neither the policy nor the user has said what it observes
    time_step_s: float  # between two decisions in training; only forecasts need it
    initial_state: Callable[[int], Any] | None
    clip: bool
    actions: ActionForm
    knows: str = MESSAGES

    def check(self, game: Game, body: int) -> None:
        if self.is_assumed and game.views[body] != self.observation:
            raise InvalidInput(
                f"agent {self.name!r}: nothing says which features the policy observes, and vehicle_{body} of scenario"
                f" {game.name!r} does not observe the usual ones; pass observation=[...] to policy_agent, or scenario="
                " for the scenario of its training"
            )

    def begin(self, alert: State, body: int) -> Any:
        return None if self.initial_state is None else self._own(self.initial_state(alert.n), alert.n)

    def act(self, state: State, memory: Any, body: int) -> tuple[Floats, Any]:
        """Commands, [n] m/s2, and the policy's new memory. Raises ``AgentFailed`` for actions of a wrong shape or
        range.
        """
        observations = self.observe(self.observation, state, body)
        if self.initial_state is None:
            actions = self._actions(self.ask(self.policy, observations), state, body)
        else:
            pair = self.policy(observations, self._own(memory, state.n))
            if not isinstance(pair, tuple) or len(pair) != 2:
                right = "with initial_state must return a pair of actions and state"
                raise AgentFailed(self.name, None, f"vehicle_{body}: returned {pair!r:.60}; {right}")
            actions, memory = self._actions(pair[0], state, body), self._own(pair[1], state.n)
        return commands_of(state, body, actions), memory

    def observe(self, view: View, state: State, body: int) -> Observations:
        check_seen(self, state, body)
        return observe_through(self.layers, view, state, body, self.time_step_s)

    def _own(self, memory: Any, n: int) -> Any:
        def copied(part: Any) -> NDArray[Any]:
            array = np.array(to_array(part))
            if array.shape[:1] != (n,) or array.dtype.hasobject:
                right = f"must be an array with one row for each of {n} worlds, or a tuple of such arrays"
                raise AgentFailed(self.name, None, f"its memory has {array.dtype} of the shape {array.shape}; {right}")
            return array

        return map_arrays(copied, memory)

    def _actions(self, answer: Any, state: State, body: int) -> Floats:
        """Actions in [-1, 1], [n], from the answer of the policy."""
        scale = self.actions if isinstance(self.actions, ActionScale) else None
        action_array, n, count = to_array(answer), state.n, count_in(self.actions)
        last, reach = (count or 0) - 1, 1.0 if scale is None else REACH
        kinds, low, high, right = "fiu", -reach, reach, f"a number in [-{reach:g}, {reach:g}]"
        if count is not None:
            kinds, low, high, right = "iu", 0.0, float(last), f"an index from 0 to {last}"
        if action_array.shape not in ((n,), (n, 1)) or action_array.dtype.kind not in kinds:
            what = f"{answer!r:.40}, {action_array.dtype} of shape {action_array.shape}"
            reason = f"returned {what}; must return {right} for each of {n} worlds, in the shape ({n}, 1)"
            raise AgentFailed(self.name, None, f"vehicle_{body}: {reason}")
        values = action_array.reshape(n).astype(np.float64)
        if self.clip:
            values = np.clip(values, low, high)
        good = (values >= low * LARGEST_ACTION) & (values <= high * LARGEST_ACTION)
        if not good.all():
            k = int(np.argmin(good))
            number = int(state.clock[k, NUMBER])
            reason = f"vehicle_{body} at {state.time_s[k]:.2f} s: action {values[k]:g}; must be {right}"
            raise AgentFailed(self.name, k if number < 0 else number, f"{reason}; clip=True clips to the nearest one")
        numbers = np.clip(values, -reach, reach) if count is None else reach * ((2.0 * values - last) / last)
        return numbers if scale is None else scale.actions(numbers)


def to_array(value: Any) -> NDArray[Any]:
    try:
        return np.asarray(value.detach().cpu() if hasattr(value, "detach") else value)
    except ValueError:  # lists of different lengths, or a tuple of arrays
        return np.empty(0, object)


def policy_agent(
    policy: Any,
    *,
    name: str | None = None,
    scenario: AnyScenario | None = None,
    observation: View | Sequence[str] | None = None,
    initial_state: Callable[[int], Any] | None = None,
    clip: bool = False,
    actions: ActionForm = None,
    ignore_wrappers: bool = False,
) -> PolicyAgent:
    """Agent that drives with a policy of any library.

    The policy maps observations, [n, F] float32, to actions, [n, 1] or [n]: numbers in [-1, 1], or indices. A policy
    with a memory is a function ``(observations, state) -> (actions, state)``.

    Args:
        policy: a function, an object with ``predict`` (Stable-Baselines3: deterministic, under its ``VecNormalize``),
            or a torch module (without gradients).
        name: name in tables; None: name of the function or class.
        scenario: scenario in which the policy was trained.
        observation: features on which the policy was trained; None: the features named by its observation space, or
            else those of ``scenario``, or else, with a warning, ``[own, front_1, rear_1]``.
        initial_state: number of episodes n -> first memory: an array with n rows, or a tuple of such arrays.
        clip: clip numbers to their range, or indices to the valid ones; otherwise they are errors.
        actions: number of discrete actions, evenly spaced from -1 to 1, if the policy returns indices; or an
            ``ActionScale``; None: as the model's action space says.
        ignore_wrappers: accept a model whose training environment has wrappers that may change observations or actions.

    Raises ``InvalidInput`` for an unknown kind of policy, if observations or actions would differ from its training,
    and if a model's discount was too large for the shaping of its reward (``episode.shaping``).

    >>> import ethbrake_marl as eb
    >>> agent = eb.policy_agent(lambda observation: -observation[:, :1].clip(0, 1), name="mine")
    >>> agent.observation.names[0]
    'own.speed'

    """
    if name is None:
        name = str(getattr(policy, "__name__", type(policy).__name__))
    who = f"agent {name!r}"
    count_in(actions, f"{who}: actions")
    ask = ask_of(policy, who)
    if initial_state is not None and (ask is not ask_function or not callable(initial_state)):
        raise InvalidInput(
            f"{who}: initial_state = {initial_state!r:.60}: must be a function, number of episodes -> memory, for a"
            " function (observation, state) -> (action, state); write one around another kind of model"
        )
    check_gamma(policy, who)
    if not ignore_wrappers:
        check_wrappers(policy, who)
        actions = form_of_actions(policy, actions, who)
    trained_on, trained_in = features_of(policy), None if scenario is None else load_scenario(scenario)
    view = _view(observation, trained_on, trained_in, who)
    if trained_in is None and any(feature.partition(".")[0] in GROUPS for feature in view.names):
        raise InvalidInput(
            f"{who}: observes forecasts, which need the time between two decisions; pass scenario= for the scenario of"
            " its training"
        )
    is_assumed = observation is None and trained_on is None and trained_in is None
    if is_assumed:
        warnings.warn(
            f"{who}: nothing says which features the policy observes, so it gets the usual {len(view.names)},"
            f" {view.names[0]} to {view.names[-1]}; pass scenario= for the scenario of its training, or"
            " observation=[...]",
            Unfamiliar,
            stacklevel=2,
        )
    time_step_s = math.nan if trained_in is None else trained_in.time_step_s
    return PolicyAgent(policy, name, ask, view, is_assumed, time_step_s, initial_state, clip, actions)


def _view(observation: Any, trained_on: tuple[str, ...] | None, trained_in: Scenario | None, who: str) -> View:
    if observation is not None:
        view = observation if isinstance(observation, View) else View(observation)
        if trained_on not in (None, view.names):
            raise InvalidInput(
                f"{who}: observation lists other features than the policy was trained on, which are"
                f" {list(trained_on or ())!r:.200}; leave out observation="
            )
        return view
    if trained_on is not None:
        return View(trained_on)
    if trained_in is None:
        return View()
    views = views_of(trained_in)
    learner_views = {views[body - 1] for body in trained_in.learners} or set(views)
    if len(learner_views) > 1:
        raise InvalidInput(
            f"{who}: the learners of scenario {trained_in.name!r} observe different features; pass observation=[...]"
        )
    return learner_views.pop()
