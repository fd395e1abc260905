"""The answers of the explorer: every agent in one world, what is proven there, and the best that a search finds."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ethbrake_marl.agents.e_v2x_bm import optimise_coupled
from ethbrake_marl.agents.protocol import Agent, Driver, Source, Team
from ethbrake_marl.defaults import HarmCount
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.episodes import EpisodeMotion, follow_episodes
from ethbrake_marl.evaluation.outcome import quantities
from ethbrake_marl.files.yaml import suggestion
from ethbrake_marl.limits.best_harm import driven_profiles, scripted_commands
from ethbrake_marl.limits.limits import Unproven, prove
from ethbrake_marl.pages.frame import shown
from ethbrake_marl.pages.player import played_episode, played_world
from ethbrake_marl.physics import Floats, Ints, Worlds
from ethbrake_marl.physics.kernel import decision_at, first_decision_s, number_of_decisions
from ethbrake_marl.scenario import Scenario, Task
from ethbrake_marl.scenario.fields import OPTIONAL, QUANTITIES, SYMBOLS, QuantityRule
from ethbrake_marl.scenario.sampling import initial_state_worlds
from ethbrake_marl.search import (
    Profiles,
    constant_profiles,
    even_grid,
    profile_problem,
    search_profiles,
)

# The state that the sliders set: its sliders, and the strict reading of what a page sends.
#
# A state is plain data: a quantity of every vehicle or pair is a list, one of the whole world a number.

State = dict[str, Any]
_RULES: dict[str, QuantityRule] = {**QUANTITIES, **OPTIONAL}


# title, least, greatest and step of a slider, and whether it is shown at once
_SLIDERS: dict[str, tuple[str, float, float, float, bool]] = {
    "gaps_m": ("Gap", 0.0, 30.0, 0.1, True),
    "speeds_mps": ("Speed", 0.0, 40.0, 0.1, True),
    "latency_s": ("Delay until it may act", 0.0, 2.0, 0.05, True),
    "braking_capacity_mps2": ("Braking capacity", 0.5, 12.0, 0.1, True),
    "driving_capacity_mps2": ("Driving capacity", 0.0, 12.0, 0.1, False),
    "mass_t": ("Mass", 0.5, 40.0, 0.1, False),
    "restitution": ("Restitution", 0.0, 1.0, 0.01, False),
    "obstacle_gap_m": ("Obstacle ahead of Vehicle 1 at", 1.0, 150.0, 0.5, True),
    "speed_limit_mps": ("Speed limit of driving", 1.0, 60.0, 0.5, False),
}


def slider_groups(scenario: Scenario, state: State) -> list[dict[str, Any]]:
    """The sliders of each quantity of a scenario's worlds, as the page takes them.

    They reach as far as the scenario draws, and as the state is (``low``, ``high``); the numbers beside them reach to
    ``most``. What is not ``usual`` opens when it is asked for.
    """
    found = []
    for field, (title, low, high, step, usual) in _SLIDERS.items():
        if field not in state:
            continue
        rule = _RULES[field]
        values = state[field] if isinstance(state[field], list) else [state[field]]
        bounds = [] if field in OPTIONAL else scenario.bounds(field)
        number = range(1, rule.count(scenario.vehicles) + 1)
        names = {"vehicle": [f"Vehicle {i}" for i in number], "pair": [f"{i} to {i + 1}" for i in number]}
        found.append({
            "field": field,
            "title": title,
            "unit": SYMBOLS.get(rule.unit, rule.unit).replace("2", "²"),
            "low": min(low, *values, *(least for least, _ in bounds)),
            "high": min(max(high, *values, *(most for _, most in bounds)), rule.high),
            "step": step,
            "most": rule.high,
            "names": names.get(rule.per, [""]),
            "usual": usual,
        })  # fmt: skip
    return found


def state_of(world: Worlds) -> State:
    """The state of one world (n = 1)."""
    return quantities(world)


def read_state(given: object, scenario: Scenario) -> Worlds:
    """The world (n = 1) that a page asks for; every quantity must be there.

    Raises ``InvalidInput`` for an unknown or missing key, what is no number, and what ``initial_state_worlds`` refuses.
    """
    if not isinstance(given, Mapping):
        raise InvalidInput("world: must be an object such as {'gaps_m': [7, 7], ...}")
    known = _RULES if scenario.has_obstacle else QUANTITIES
    for key in given:
        if key not in known:
            hint = suggestion(str(key), known) or f"known: {', '.join(known)}"
            raise InvalidInput(f"world: unknown key {key!r:.60}; {hint}")
    if missing := [key for key in known if key not in given]:
        raise InvalidInput(f"world: {missing[0]} is missing; every quantity must be given")
    for key, value in given.items():
        if known[key].per == "world":
            read_number(value, f"world: {key}")
        elif not isinstance(value, list):
            raise InvalidInput(f"world: {key}: must be a list of {known[key].count(scenario.vehicles)} numbers")
        else:
            for i, each in enumerate(value):
                read_number(each, f"world: {key}[{i}]")
    return initial_state_worlds(given, scenario)


def read_number(value: object, what: str) -> float:
    """A finite number of JSON; raises ``InvalidInput`` for anything else, truth values too."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e15:
        raise InvalidInput(f"{what} = {value!r:.60}: must be a number")
    return float(value)


# A profile that somebody draws: commands of one vehicle on the grid of decisions, and the agent that drives it.

MOST_COMMANDS = 2_000


def decision_grid(world: Worlds, scenario: Scenario, vehicle: int) -> dict[str, Any]:
    """Where the commands of a profile of a vehicle fall in one world (n = 1), and which are possible."""
    first = first_decision_s(world, [vehicle])
    steps = number_of_decisions(first, scenario.time_step_s, scenario.horizon_s)
    v = world.vehicles
    return {
        "first_s": float(first[0]),
        "step_s": scenario.time_step_s,
        "steps": int(steps[0]),
        "low_mps2": -float(v.braking_capacity_mps2[0, vehicle]),
        "high_mps2": float(v.driving_capacity_mps2[0, vehicle]),
    }


def read_profile(given: object) -> Floats:
    """Commands (m/s2) that a page sends, one per decision; raises ``InvalidInput``."""
    if not isinstance(given, list) or not 1 <= len(given) <= MOST_COMMANDS:
        raise InvalidInput(f"profile: must be a list of 1 to {MOST_COMMANDS} commands in m/s2")
    return np.array([read_number(value, f"profile[{k}]") for k, value in enumerate(given)])


class HandDriven:
    """Drives a profile in every world; the last command goes on, and one beyond a capacity asks for the capacity."""

    knows = Source.UNSTATED

    def __init__(self, commands_mps2: Floats, time_step_s: float, name: str = "by hand") -> None:
        self.name = name
        self.commands_mps2 = commands_mps2
        self._time_step_s = time_step_s
        self._start_s: Floats = np.empty(0)

    def begin(self, worlds: Worlds, vehicle: int, rows: Ints) -> None:
        """Note when the decisions of these episodes fall."""
        self._start_s = first_decision_s(worlds, [vehicle])

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """The command of the decision at hand, [n] m/s2."""
        step = decision_at(worlds.time_s, self._start_s[: worlds.n], self._time_step_s)
        command = self.commands_mps2[np.clip(step, 0, len(self.commands_mps2) - 1)]
        v = worlds.vehicles
        bounded: Floats = np.clip(command, -v.braking_capacity_mps2[:, vehicle], v.driving_capacity_mps2[:, vehicle])
        return bounded


SLICE = 4_000  # candidates between two looks at the clock
CONSTANTS = 29  # from which a search starts, beside E-V2X-BM's
MOST_AGENTS = 8
_REASONS = {
    "early": "a pair meets before the driven vehicle may act",
    "front": "even full braking meets the vehicle in front",
    "rear": "whatever spares the vehicle in front is met by the one behind",
}


@dataclass(frozen=True)
class Explored:
    """A scenario with one driven vehicle, and who drives it.

    Raises ``InvalidInput`` for a scenario without exactly one learner, a team, or more than ``MOST_AGENTS`` agents.
    """

    scenario: Scenario
    lineup: Mapping[str, Driver]
    harm_count: HarmCount = "first"  # that agents and the search minimise

    def __post_init__(self) -> None:
        """Look whether all of it can be explored."""
        if len(self.scenario.learners) != 1:
            raise InvalidInput(f"explore: {len(self.scenario.learners)} vehicles are driven; it takes exactly one")
        if not 1 <= len(self.lineup) <= MOST_AGENTS:
            raise InvalidInput(f"explore: {len(self.lineup)} agents; at least 1 and at most {MOST_AGENTS}")
        for name, agent in self.lineup.items():
            if isinstance(agent, Team):
                raise InvalidInput(f"agent {name!r}: is a team, one agent is needed here: ppo@RUN/policy/vehicle_2")

    @property
    def vehicle(self) -> int:
        """The driven vehicle, from 0."""
        return self.scenario.learners[0]

    @cached_property
    def task(self) -> Task:
        """What agents are asked."""
        return Task(self.scenario, (self.vehicle,))

    def answer(self, world: Worlds, profile: Floats) -> dict[str, Any]:
        """Every agent and the profile ``by hand`` in one world (n = 1), and what is known of it, as plain data."""
        drivers: dict[str, Agent] = {**self.lineup, "by hand": self.by_hand(profile)}  # type: ignore[dict-item]  # no teams
        motions = {name: self.follow(world, driver) for name, driver in drivers.items()}
        return {
            "world": played_world(world, [played_episode(motion, (self.vehicle,)) for motion in motions.values()]),
            "outcomes": [outcome(name, motion) for name, motion in motions.items()],
            "verdict": self.verdict(world),
            "constant": self.best_constant(world),
            "grid": decision_grid(world, self.scenario, self.vehicle),
        }

    def by_hand(self, profile: Floats) -> HandDriven:
        """The agent that drives a profile."""
        return HandDriven(profile, self.scenario.time_step_s)

    def follow(self, world: Worlds, agent: Driver) -> EpisodeMotion:
        """The episode of one agent in one world."""
        return follow_episodes(world, agent, self.scenario)[0]

    def verdict(self, world: Worlds) -> dict[str, Any]:
        """Whether contact can be avoided, and the harm that no command undercuts (m2/s2), where that is proven."""
        proof = prove(world, self.task)
        if isinstance(proof, Unproven):
            return {"avoidable": None, "why": shown(proof.because), "proven_harm": None}
        harm = float(proof.harm[0])
        if proof.avoidable is None or proof.reason is None:
            return {"avoidable": None, "why": "not decided for these vehicles", "proven_harm": harm}
        avoidable, reason = bool(proof.avoidable[0]), str(proof.reason[0])
        return {"avoidable": avoidable, "why": _REASONS.get(reason, ""), "proven_harm": harm}

    def best_constant(self, world: Worlds) -> dict[str, Any]:
        """H*: the least harm of one constant deceleration, in the engine's physics; why not, where it is not known."""
        try:
            others = scripted_commands(world, self.task)
        except InvalidInput as error:
            return {"why": shown(error)}
        best = optimise_coupled(
            world, self.vehicle, harm_count=self.harm_count, horizon_s=self.scenario.horizon_s, others_mps2=others
        )
        return {
            "deceleration_mps2": float(best.deceleration_mps2[0]),
            "first": float(best.first_impact_harm[0]),
            "total": float(best.total_harm[0]),
        }

    def commands_of(self, world: Worlds, agent: str) -> list[float]:
        """What an agent of the line-up commands in each decision (m/s2), to begin a profile from."""
        steps = decision_grid(world, self.scenario, self.vehicle)["steps"]
        driver = self.lineup[agent]
        assert not isinstance(driver, Team)  # refused at the beginning
        return _step_by_step(driven_profiles(driver, world, self.task, np.array([steps])))

    def search(self, world: Worlds, profile: Floats, seconds: float, stop: Callable[[], bool]) -> dict[str, Any]:
        """The best profile that a search of so many seconds finds; ``stop`` ends it early.

        It starts from constants, H*'s among them, and from the profile by hand if that is better. The harm is that of
        the profile driven again by the engine.
        """
        begin = time.monotonic()
        problem = profile_problem(
            world,
            [self.vehicle],
            harm_count=self.harm_count,
            horizon_s=self.scenario.horizon_s,
            time_step_s=self.scenario.time_step_s,
            others_mps2=scripted_commands(world, self.task),
        )
        constant = np.full((1, 1, 1), -self.best_constant(world)["deceleration_mps2"])
        given = constant_profiles(problem, np.concatenate([constant, even_grid(problem, CONSTANTS)], axis=1))
        used = 0
        while True:
            given = search_profiles(problem, given, budget=SLICE, seed=used // SLICE).profiles
            used += SLICE
            if time.monotonic() - begin >= seconds or stop():
                break
        commands = _step_by_step(given)
        motions = [self.follow(world, self.by_hand(np.array(each))) for each in (commands, profile.tolist())]
        which = int(np.argmin([motion.ledger.world_harm(self.harm_count)[0] for motion in motions]))
        best = outcome("best known", motions[which])
        return best | {
            "commands": commands if which == 0 else profile.tolist(),
            "candidates": used,
            "by_hand": which == 1,
            "episode": played_episode(motions[which], (self.vehicle,)),
        }


def outcome(name: str, motion: EpisodeMotion) -> dict[str, Any]:
    """What an episode came to: impacts, harm under both counts (m2/s2), and whether the line came to rest."""
    first, total = motion.harm
    return {
        "agent": shown(name),
        "impacts": int(motion.ledger.impacts[0]),
        "first": first,
        "total": total,
        "at_rest": motion.at_rest,
    }


def _step_by_step(profiles: Profiles) -> list[float]:
    """The commands of the one profile, decision by decision (m/s2)."""
    steps = int(profiles.ends[0, -1])
    return [float(profiles.at(np.array([k]))[0, 0]) for k in range(steps)]
