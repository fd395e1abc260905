"""Every interface behind the shield, alone and with a team: played, disturbed, stepped with something between.

``disturbed(interface, episodes, seed)`` plays episodes in which calls are refused, raise, or are interrupted at random
lines; ``wrapped(interface, wrapper, calls, seed)`` steps with a wrapper between the shield and the engine. Harm is read
by a watcher of its own from the engine's ledger, of every episode that ended, and compared with the bound at the alert.
"""

import contextlib
import sys
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple, Self

import gymnasium
import numpy as np

import ethbrake_marl.first_edition as eb
from ethbrake_marl.first_edition.agents.driving import episode_engine
from ethbrake_marl.first_edition.agents.protocol import Team
from ethbrake_marl.first_edition.shields.drivers import ShieldedDriver
from ethbrake_marl.first_edition.shields.guard import MovingAtHorizon
from ethbrake_marl.first_edition.shields.wrappers import HybridShield, ShieldedEnv, ShieldedVectorEnv, shielded_aec
from tests.first_edition.shield.attacks import line

ROWS = 5  # worlds of the batched interfaces
ALONE, PAIR = line(3), eb.load_scenario("cooperation-3-pair")
NO_STATE = {"initial_state": {"gaps_m": [-1, 1], "speeds_mps": [1, 1, 1]}}


class Failure(Exception):
    """Raised by a policy or between the shield and the engine."""


class Recorder:
    """A watcher that counts the steps, and notes harm and bound of every episode that ends."""

    def begun(self, memory: Any, alert: Any, rows: Any) -> Any:
        return memory

    def stepped(self, memory: Any, before: Any, after: Any) -> Any:
        made, ended = memory
        over = after.ended & ~before.ended
        harm, bound = after.ledger.world_harm("first"), after.guarded.shield.memory.first_bound
        return made + 1, [*ended, *zip(harm[over].tolist(), bound[over].tolist(), strict=True)]


class Unreliable:
    """A policy that brakes by turns; where told to it raises, gives too many commands, or none that is a number."""

    name, remembers = "unreliable", False
    how = ""

    def act(self, worlds: Any, vehicle: int) -> np.ndarray:
        if self.how == "fails":
            raise Failure
        if self.how == "misshapen":
            return np.zeros((worlds.n, 2))
        wave = np.sin(17.0 * worlds.time_s + worlds.gaps_m[:, 0])
        told = np.where(wave > 0.0, 0.0, wave * worlds.vehicles.braking_capacity_mps2[:, vehicle])
        return np.full(worlds.n, np.nan) if self.how == "mute" else told


class Play:
    """One interface, shielded: ``make`` begins it, ``step`` proposes afresh, ``bad`` are calls that must raise."""

    def __init__(self, seed: int, *, team: bool = False) -> None:
        self.rng, self.team, self.scenario = np.random.default_rng(seed), team, PAIR if team else ALONE
        self.members = {i: Unreliable() for i in self.scenario.learners}
        self.raises: str | None = None  # where the wrapper in between raises
        self.how: Callable[..., Any] = self._failing
        self.bad: list[Callable[[], Any]] = []
        self.done: list[tuple[float, float]] = []  # of engines before this one
        self.make()

    def put(self, env: Any, shield: Any = None, **begin: int) -> None:
        """Play this environment from now on, which is or has such a shield: watch its engine, begin an episode."""
        self.env, at = env, env if shield is None else shield
        self.engine, self.shield = lambda: at.attached.engine, lambda: at.attached.shield
        self.watch()
        env.reset(**begin)

    def between(self, env: Any) -> Any:
        """The environment, each of whose steps goes through ``how``."""
        step = env.step
        env.step = lambda actions: self.how(step, actions)
        return env

    def watch(self, memory: Any = (0, [])) -> None:
        self.recorder = Recorder()
        self.engine().watch(self.recorder, memory)

    def begin(self) -> int:
        return int(self.rng.integers(10**6))

    def made(self) -> Any:
        """Steps that the engine made."""
        return self.engine().memory(self.recorder)[0]

    def ended(self) -> list[tuple[float, float]]:
        """Harm and bound of the episodes that have ended."""
        return [*self.done, *self.engine().memory(self.recorder)[1]]

    def _failing(self, step: Callable[[Any], Any], actions: Any) -> Any:
        if self.raises == "before":
            raise Failure
        told = step(actions)
        if self.raises == "after":
            raise Failure
        return told

    def drawn(self, *shape: int) -> np.ndarray:
        return np.where(self.rng.random(shape) < 0.5, np.sign(self.rng.uniform(-1, 1, shape)), self.rng.uniform(-1, 1))

    def known(self) -> list[Any]:
        """What must not change when nothing happens: bound, plan, trust, place in the episodes."""
        shield = self.shield()
        held = [
            shield.bound,
            shield.memory.backup.plan,
            shield.memory.distrusted,
            shield.memory.running.steps,
            shield.memory.running.states,
        ]
        return [array.tolist() for array in held]

    def astray(self) -> int:
        """1 where the shield is not where the engine is, or trusts it no longer."""
        shield, engine = self.shield(), self.engine()
        return int(
            not (shield.memory.running.steps == engine.steps)[~engine.ended].all() or shield.memory.distrusted.any()
        )

    def member_is(self, how: str, asked: Callable[[], Any]) -> Callable[[], None]:
        """A call in which one member fails so, while the others are well."""

        def call() -> None:
            one = self.members[int(self.rng.choice(self.scenario.learners))]
            one.how = how
            try:
                asked()
                raise AssertionError("nobody asked it")
            except (ValueError, IndexError) as error:
                raise Failure from error
            finally:
                one.how = ""

        return call

    @contextlib.contextmanager
    def sometimes_mute(self) -> Iterator[None]:
        """Now and then a member says nothing that is a number: that is no failure, but replaced."""
        for member in self.members.values():
            member.how = "mute" if self.rng.random() < 0.15 else ""
        try:
            yield
        finally:
            for member in self.members.values():
                member.how = ""


class Parallel(Play):
    """PettingZoo parallel; the members of a team, or the one policy, propose where nobody does."""

    def make(self) -> None:
        policies: Any = {f"vehicle_{i + 1}": member for i, member in self.members.items()}
        policy = policies if self.team else policies["vehicle_2"]
        inner = self.between(eb.parallel_env(self.scenario))
        last = list(policies)[-1]
        self.bad = [
            lambda: self.env.step({"vehicle_2": np.zeros(1), "vehicle_9": np.zeros(1)}),
            lambda: self.env.step({"vehicle_2": np.zeros(1)} | {last: np.array([np.nan])}),
            lambda: self.env.step({last: np.zeros(3)}),
            lambda: self.env.step([0.0] * len(policies)),
            lambda: self.env.reset(options=NO_STATE),
            self.member_is("fails", lambda: self.env.step({})),
            self.member_is("misshapen", lambda: self.env.step({})),
        ]
        self.put(HybridShield(inner, policy, mode="step", cap="baseline" if self.team else None), seed=self.begin())

    def step(self) -> None:
        if self.engine().ended[0]:
            self.env.reset()
        names = (f"vehicle_{i + 1}" for i in self.members)
        with self.sometimes_mute():
            self.env.step({name: self.drawn(1) for name in names if self.rng.random() < 0.65})


class Aec(Play):
    """PettingZoo AEC."""

    def make(self) -> None:
        env = inner = shielded_aec(self.between(eb.parallel_env(self.scenario, agents="learners")), mode="step")
        while not isinstance(inner, HybridShield):
            inner = inner.env
        self.put(env, inner, seed=self.begin())

    def step(self) -> None:
        if self.engine().ended[0]:
            self.env.reset()
        before = self.made()
        while self.made() == before:
            self.env.step(self.drawn(1).astype(np.float32))


class Single(Play):
    """Gymnasium."""

    def make(self) -> None:
        plain = gymnasium.make("EthBrake-v1", scenario=self.scenario).unwrapped
        self.bad = [
            lambda: self.env.step(np.array([np.nan])),
            lambda: self.env.step(np.zeros(2)),
            lambda: self.env.step(np.array([1j])),
            lambda: self.env.reset(seed=-1),
            lambda: self.env.reset(options=NO_STATE),
        ]
        self.put(ShieldedEnv(self.between(plain)), seed=self.begin())

    def step(self) -> None:
        if self.engine().ended[0]:
            self.env.reset()
        self.env.step(self.drawn(1))


def one_bad(rows: int, row: int) -> np.ndarray:
    """Actions of which one is no number."""
    return np.where(np.arange(rows)[:, np.newaxis] == row, np.nan, 0.0)


class Vector(Play):
    """Gymnasium vector."""

    mode = "SameStep"

    def make(self) -> None:
        inner = self.between(eb.EthBrakeVectorEnv(ROWS, self.scenario, autoreset_mode=self.mode))
        self.bad = [
            lambda: self.env.step(one_bad(ROWS, int(np.argmin(self.engine().ended)))),  # others are ignored
            lambda: self.env.step(np.zeros((ROWS + 1, 1))),
            lambda: self.env.step(np.full((ROWS, 1), 1.0 + 1j)),
            lambda: self.env.reset(seed=-1),
        ]
        self.put(ShieldedVectorEnv(inner), seed=self.begin())

    def step(self) -> None:
        self.env.step(self.drawn(ROWS, 1).astype(np.float32))


class NextStepVector(Vector):
    """Gymnasium vector, the other autoreset mode."""

    mode = "NextStep"


class Sb3(Play):
    """Stable-Baselines3; of a team one row of each member and world."""

    def make(self) -> None:
        inner = eb.make_sb3_vec_env(self.scenario, ROWS, seed=self.begin())
        plain = inner.step_wait

        def step(actions: Any) -> Any:
            inner._actions = actions
            return plain()

        inner.step_wait = lambda: self.how(step, inner._actions)
        rows = inner.num_envs
        self.bad = [
            lambda: self.env.step(one_bad(rows, int(self.rng.integers(rows)))),
            lambda: self.env.step(np.zeros((rows, 2))),
            self._options,
        ]
        self.put(eb.ShieldedVecEnv(inner))

    def _options(self) -> None:
        self.env.set_options(NO_STATE)
        self.env.reset()

    def step(self) -> None:
        rows = self.env.num_envs
        if self.rng.random() < 0.2:  # one too many
            self.env.step_async(self.drawn(rows, 1))
        self.env.step(self.drawn(rows, 1).astype(np.float32))


class Evaluation(Play):
    """The shielded driver of an evaluation, or its team; nothing can stand in between."""

    def make(self) -> None:
        worlds, learners = self.scenario.sample(ROWS, self.begin()).worlds, self.scenario.learners
        if self.team:
            driver = ShieldedDriver(Team(self.members, "unreliable"), self.scenario, cap="baseline").on(learners)
            engine = episode_engine(worlds, driver, self.scenario)
        else:
            engine = episode_engine(worlds, ShieldedDriver(self.members[1], self.scenario), self.scenario, 1)
        made, self.done = (self.made(), self.ended()) if self.bad else (0, [])
        self.engine, self.shield = lambda: engine, lambda: engine.guarded.shield
        self.bad = [self.member_is(how, lambda: engine.step({})) for how in ("fails", "misshapen")]
        self.watch((made, []))
        engine.step({})

    def step(self) -> None:
        if self.engine().ended.all():
            self.make()
        with self.sometimes_mute():
            self.how(self.engine().step, {})


PLAYS: dict[str, Callable[[int], Play]] = {
    "parallel": Parallel, "aec": Aec, "single": Single, "vector": Vector, "vector, next step": NextStepVector,
    "sb3": Sb3, "evaluation": Evaluation, "team, parallel": partial(Parallel, team=True),
    "team, aec": partial(Aec, team=True), "team, sb3": partial(Sb3, team=True),
    "team, evaluation": partial(Evaluation, team=True),
}  # fmt: skip


def reported(info: dict[str, Any]) -> dict[str, Any]:
    """What an info says of the shield, by name without ``shield_``; of a vector environment each a column."""
    return {name.removeprefix("shield_"): told for name, told in info.items() if name.startswith("shield_")}


# ---------------------------------------------------------------- played, disturbed, wrapped


class Tally(NamedTuple):
    """What happened."""

    episodes: int
    above: int  # episodes that ended above the bound told at their alert
    refused: int  # calls that raised
    interrupted: int
    broken: int  # times that bound, plan, trust or place in the episode were not as they should be after that

    @classmethod
    def of(cls, play: Play, refused: int = 0, interrupted: int = 0, broken: int = 0) -> Self:
        ended = play.ended()
        return cls(len(ended), sum(harm > bound + 1e-9 for harm, bound in ended), refused, interrupted, broken)


@contextlib.contextmanager
def interrupt_at(number: int) -> Iterator[None]:
    """Ctrl-C at that line of Python, counted from here; not within the compiler, which would be left half done."""
    left = number

    def trace(frame: Any, event: str, argument: Any) -> Any:
        nonlocal left
        if "numba" in frame.f_code.co_filename:
            return None
        if event == "line":
            left -= 1
            if left == 0:
                raise KeyboardInterrupt
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        yield
    finally:
        sys.settrace(before)


@contextlib.contextmanager
def calm() -> Iterator[None]:
    """Without the warning that something moves at the horizon."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MovingAtHorizon)
        yield


@calm()
def played(name: str, episodes: int, seed: int) -> Tally:
    """Play so many episodes through an interface, in which nothing fails."""
    play, broken = PLAYS[name](seed), 0
    while len(play.ended()) < episodes:
        play.step()
        broken += play.astray()
    return Tally.of(play, broken=broken)


@calm()
def disturbed(name: str, episodes: int, seed: int) -> Tally:
    """The same; before every second step something fails or is interrupted."""
    play = PLAYS[name](seed)
    for _ in range(3):
        play.step()  # compiles what is not compiled yet: whose lines would be counted
    refused = interrupted = broken = 0
    while len(play.ended()) < episodes:
        if play.engine().ended.all():
            play.step()  # begins the next episode
        kind, before, made = int(play.rng.integers(5)), play.known(), play.made()
        if kind == 0 and play.bad:
            with contextlib.suppress(eb.EthBrakeError, Failure):
                play.bad[int(play.rng.integers(len(play.bad)))]()
                broken += 1  # it did not raise
            refused += 1
        elif kind == 1:
            play.raises = str(play.rng.choice(["before", "after"]))
            with contextlib.suppress(Failure):
                play.step()
            play.raises, refused = None, refused + 1
        elif kind == 2:
            try:
                # at one of the first so many lines of a call, if it has so many
                with interrupt_at(int(play.rng.integers(1, play.rng.choice((50, 200, 800))))):
                    play.step()
            except KeyboardInterrupt:
                interrupted += 1
        else:
            play.step()
        if play.made() == made and kind != 2:
            broken += play.known() != before
        broken += play.astray()
    return Tally.of(play, refused, interrupted, broken)


def _scaled(actions: Any, factor: float) -> Any:
    if isinstance(actions, dict):
        return {name: _scaled(action, factor) for name, action in actions.items()}
    return np.asarray(actions) * factor


def skip(frames: int, step: Callable[[Any], Any], actions: Any) -> Any:
    """A frame skip."""
    for _ in range(frames):
        told = step(actions)
    return told


def twice(step: Callable[[Any], Any], actions: Any) -> Any:
    step(_scaled(actions, 0.0))
    return step(actions)


class Swallowing:
    """Every third step is not made; the last answer is given again."""

    def __init__(self) -> None:
        self.calls, self.told = 0, None

    def __call__(self, step: Callable[[Any], Any], actions: Any) -> Any:
        self.calls += 1
        if self.calls % 3:
            self.told = step(actions)
        return self.told


WRAPPERS: dict[str, Callable[[], Callable[..., Any]]] = {
    "frame skip 2": lambda: partial(skip, 2),
    "frame skip 80": lambda: partial(skip, 80),
    "changes actions": lambda: lambda step, actions: step(_scaled(actions, 0.5)),
    "steps twice": lambda: twice,
    "swallows steps": Swallowing,
}
INSIDE = [name for name in PLAYS if "evaluation" not in name]  # the engine itself asks that one: nothing is in between


@calm()
def wrapped(name: str, wrapper: str, calls: int, seed: int) -> Tally:
    """So many steps with a wrapper inside, whose actions reach the engine; what is raised is caught."""
    play = PLAYS[name](seed)
    play.how = WRAPPERS[wrapper]()
    refused = broken = 0
    for _ in range(calls):
        with contextlib.suppress(eb.EthBrakeError):  # at the end also the plain "no episode is running"
            play.step()
            refused -= 1
        refused += 1
        broken += play.astray()
    return Tally.of(play, refused, 0, broken)
