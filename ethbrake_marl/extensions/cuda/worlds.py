"""``Worlds``: many episodes on a GPU, as torch tensors that stay on the device."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ethbrake_marl.agent_names import open_game
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.state import LAST, State
from ethbrake_marl.episode.step import FIRST_HARM, OUT_ROWS, TERMINATED, TOTAL_HARM, TRUNCATED, failure
from ethbrake_marl.errors import InvalidInput, check_whole_number
from ethbrake_marl.extensions.cuda.device import Kernel, device_named, enough_memory
from ethbrake_marl.extensions.cuda.kernels import (
    BEGIN,
    LOOK,
    NO_ACTION,
    PHYSICS_FAILED,
    RENEW,
    STEP_MODE,
    KernelSettings,
    Results,
    StoredEpisodes,
    ViewArrays,
    memory_of,
)
from ethbrake_marl.worlds.open_game import AnyScenario

POOL = 100_000  # worlds that are drawn by default
WHOSE = {"harm": "harm of single vehicles"}  # otherwise the compiled step computes it


class Stepped(NamedTuple):
    """Results of a step in n worlds: tensors that the next step overwrites."""

    observations: Tensor  # [n, L, F] float32 of the learners, front to rear; of the new episode where one has begun
    reward: Tensor  # [n] float64 of every learner
    terminated: Tensor  # [n] bool, whether all vehicles have come to rest
    truncated: Tensor  # [n] bool, whether the horizon came first
    first_impact_harm: Tensor  # [n] float64 of the line in this step (m2/s2)
    total_harm: Tensor  # [n] float64 of all impacts of the line in this step (m2/s2)


class Worlds:
    """n episodes on one device, with the same bits as ``Game.step``.

    An episode that ends is replaced, in the same step, by an episode in the next world of a pool, which is drawn in
    advance. An example is in docs/libraries.md.
    """

    def __init__(
        self,
        scenario: AnyScenario,
        n: int,
        pool: int | State = POOL,
        device: str = "cuda",
        *,
        seed: int = 0,
        learners: Any = None,
        reward: Any = "honest",
        observation: Any = None,
    ) -> None:
        """Draw the pool of worlds, copy it to the device, and begin all episodes.

        Args:
            scenario: as for ``open_game``.
            n: number of episodes.
            pool: number of training worlds that are drawn, or worlds at the alert (``Scenario.sample``).
            device: ``cuda``, ``cuda:1``, or ``cpu``, where the same code runs slowly.
            seed: seed of the training worlds.
            learners: vehicles that learn, as for ``open_game``.
            reward: as for ``open_game``, but only with terms that the compiled step computes.
            observation: features of the groups own, front_K, rear_K, role and obstacle.

        Raises ``InvalidInput`` for what no kernel computes: scripts that look at the state, messages, replaced physics,
        a shield, features and reward terms that are Python functions, learners that observe different features; for a
        device that cannot run kernels; and for more worlds than the device has memory for. Raises ``MissingExtra`` if
        the kernels must be compiled and numba-cuda is missing.

        """
        check_whole_number("n", n, 1)
        self.n, self.device = n, device_named(device)
        self.scenario, self.game = open_game(scenario, learners, reward, observation)
        check_runs(self.game)
        if isinstance(pool, State):
            worlds, vehicles = pool, self.scenario.vehicles
            if not (pool.n and pool.vehicles == vehicles):
                raise InvalidInput(
                    f"pool: has {pool.n} worlds of {pool.vehicles} vehicles; must have one or more of {vehicles}"
                    f" vehicles, as in scenario {self.scenario.name!r}"
                )
        else:
            check_whole_number("pool", pool, 1)
            check_whole_number("seed", seed, 0)
            worlds = self.game.draw(pool, seed, 0)
        first = self.game.reset(worlds)
        self.longest = int(first.clock[:, LAST].max())  # decisions of the longest episode
        self.view = self.game.views[int(self.game.settings.learners[0])]
        self.settings, self.view_arrays, self.kernel = kernel_of(self.game, first.vehicles + 1, self.device)
        L, F = len(self.game.settings.learners), len(self.view.names)
        with enough_memory(f"n = {n} worlds, and a pool of {first.n}, on device {str(self.device)!r}"):
            self.pool = self.stored(first)
            self.now = StoredEpisodes(*(self._zeros(*array.shape[:-1], n) for array in self.pool))
            self.following = self._zeros(n, kind=torch.int64)
            self.results = Results(
                self._zeros(OUT_ROWS, n),
                self._zeros(n),
                self._zeros(n, L, F, kind=torch.float32),
                self._zeros(n, kind=torch.int64),
            )
            self._no_actions = self._zeros(n, L, kind=torch.float32)
        self.reset()

    def _zeros(self, *shape: int, kind: torch.dtype = torch.float64) -> Tensor:
        return torch.zeros(*shape, dtype=kind, device=self.device)

    def stored(self, state: State) -> StoredEpisodes:
        """Arrays of a state as tensors on the device, with the index of the world last."""
        arrays = (state.line, state.car, state.clock, state.know, state.wanted)
        return StoredEpisodes(*(torch.from_numpy(np.moveaxis(array, 0, -1).copy()).to(self.device) for array in arrays))

    @property
    def observations(self) -> Tensor:
        """Present observations of the learners, [n, L, F] float32; the next step overwrites them."""
        observations: Tensor = self.results.observations
        return observations

    def reset(self) -> Tensor:
        """Begin all episodes, in the first n worlds of the pool; return the observations, [n, L, F] float32."""
        torch.arange(self.n, out=self.following)
        self.following.remainder_(self.pool.wanted.shape[1])
        self.results.status.zero_()
        self._launch(self._no_actions, BEGIN)
        return self.observations

    def step(self, actions: Tensor, *, renew: bool = True) -> Stepped:
        """Take one step in all episodes.

        ``actions`` [n, L] float32 are clipped to [-1, 1]. With ``renew=False``, an episode that has ended stays as it
        is, and its reward and harm are 0. Raises ``InvalidInput`` for a tensor of another shape, type or device. Other
        errors, such as an action that is NaN, are stored for ``check``, so that no step waits for the device.
        """
        shape, right = self._no_actions.shape, (torch.float32, torch.strided)
        if not (isinstance(actions, Tensor) and actions.shape == shape and (actions.dtype, actions.layout) == right):
            what = f"{actions.dtype} of shape {tuple(actions.shape)}" if isinstance(actions, Tensor) else repr(actions)
            raise InvalidInput(f"actions = {what:.80}: must be a dense torch tensor, float32, of shape {tuple(shape)}")
        if actions.device != self.device:
            raise InvalidInput(f"actions: are on the device {actions.device}, the worlds on {self.device}")
        self._launch(actions.detach().resolve_neg().contiguous(), RENEW if renew else STEP_MODE)
        out, reward, observations, _ = self.results
        ends = out[TERMINATED] == 1.0, out[TRUNCATED] == 1.0
        return Stepped(observations, reward, *ends, out[FIRST_HARM], out[TOTAL_HARM])

    def put(self, stored: StoredEpisodes, rows: Tensor) -> Tensor:
        """Replace the running episodes by the episodes ``rows`` [n] of ``stored``; return the observations, [n, L, F].

        Raises ``InvalidInput`` for another number of rows, and for worlds with another number of vehicles.
        """
        if not (rows.shape == (self.n,) and rows.dtype == torch.int64):
            what = f"{rows.dtype} of shape {tuple(rows.shape)}"
            raise InvalidInput(f"rows = {what}: must be int64 of shape ({self.n},), one for each episode")
        if stored.know.shape[:-1] != self.now.know.shape[:-1]:
            bodies = len(stored.know), len(self.now.know)
            raise InvalidInput(f"stored: has {bodies[0]} bodies in each world; must have {bodies[1]}")
        for target, source in zip(self.now, stored, strict=True):
            target.copy_(source.index_select(-1, rows))
        self._launch(self._no_actions, LOOK)
        return self.observations

    def arguments(self, actions: Tensor, mode: int) -> tuple[Any, ...]:
        return self.now, self.pool, self.following, actions, self.results, self.settings, self.view_arrays, mode

    def _launch(self, actions: Tensor, mode: int) -> None:
        self.kernel.launch(self.device, self.n, *self.arguments(actions, mode))

    def state(self) -> State:
        """The running episodes as the core's ``State``, on the processor."""
        line, car, clock, know, wanted = (np.moveaxis(array.cpu().numpy(), -1, 0).copy() for array in self.now)
        return State(line, car, clock, know, wanted, {})

    def check(self) -> None:
        """Raise an error for the first world in which a step has failed since the last ``reset``.

        The error is ``InvalidInput`` for an action that is NaN, and ``PhysicsError`` if a check of the physics failed.
        """
        if not bool(self.results.status.any()):
            return
        status = self.results.status.cpu().numpy()
        row = int(status.nonzero()[0][0])
        if status[row] == NO_ACTION:
            raise InvalidInput(f"actions: an action of row {row} is no number; nothing has moved in this world")
        assert status[row] == PHYSICS_FAILED
        state = self.state()
        raise failure(state, row, state.time_s[row], self.game.settings.horizon_s)


def check_runs(game: Game) -> None:
    """Raise ``InvalidInput`` if a game contains something that GPU kernels do not compute."""
    what = f"scenario {game.name!r} in kernels for a GPU"
    for body, script in game.scripts.items():
        name = getattr(script, "name", type(script).__name__)
        raise InvalidInput(
            f"{what}: vehicle_{body} is driven by {name!r}, which looks at the state; scripts that hold one command run"
            " there, such as full_brake and coast (--set roles.NAME=full_brake)"
        )
    if game.layers or game.physics is not None:
        part_names = [type(part).__name__ for part in (*game.layers, game.physics) if part is not None]
        raise InvalidInput(
            f"{what}: has {', '.join(part_names)}; messages with content and another physics run on a processor only"
        )
    if game.shield is not None:
        raise InvalidInput(f"{what}: has a shield, which runs on a processor only; train without it, then shield")
    if not len(game.settings.learners):
        raise InvalidInput(f"{what}: has no learner; make a vehicle one: learners=['vehicle_2']")
    if not game.rewarding.is_compiled:
        parts = [WHOSE.get(name, name) for name, *_ in game.rewarding.terms]
        parts += ["shaping"] * (game.rewarding.shaping is not None)
        raise InvalidInput(
            f"{what}: the reward has {', '.join(parts) or 'components'}; the terms harm (of the whole line, in any"
            " count) and terminal run there"
        )
    views = {game.views[i] for i in game.settings.learners.tolist()}
    if len(views) > 1:
        raise InvalidInput(f"{what}: its learners observe different features; give all of them the same observation")
    (view,) = views
    beside = [name for name, place in zip(view.names, view.plan.places, strict=False) if place < 0]
    if beside:
        raise InvalidInput(
            f"{what}: the observation has {', '.join(beside[:5])}, which functions of Python compute; the groups own,"
            " front_K, rear_K, role and obstacle run there"
        )


def kernel_of(game: Game, bodies: int, device: torch.device) -> tuple[KernelSettings, ViewArrays, Kernel]:
    """Settings and features of a game as constant arguments of the kernel ``play_world``, and this kernel.

    ``bodies``: number of bodies (the vehicles and the obstacle).
    """
    on = partial(torch.tensor, device=device)
    settings, plan = game.settings, game.views[int(game.settings.learners[0])].plan
    kernel_settings = KernelSettings(
        on(settings.learners),
        float(settings.time_step_s),
        float(settings.harm),
        float(settings.terminal),
        on(settings.harm_count.weights),
    )
    view_arrays = ViewArrays(on(plan.offsets), plan.role, plan.obstacle, on(plan.places), on(plan.scaling))
    size = bodies, len(settings.learners), plan.scaling.shape[1], len(plan.offsets)
    return kernel_settings, view_arrays, Kernel(size, memory_of(*size))
