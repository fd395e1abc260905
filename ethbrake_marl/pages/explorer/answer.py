"""The answers of the explorer: every agent in one world, what is proven there, and the best that a search finds."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ethbrake_marl.agents.e_v2x_bm.coupled import optimise_coupled
from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.agents.team import Driver, Team
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.motion import EpisodeMotion, follow_episodes
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.limits.best_harm import scripted_commands
from ethbrake_marl.limits.driven_profiles import driven_profiles
from ethbrake_marl.limits.limits import Unproven, prove
from ethbrake_marl.pages.explorer.hand import HandDriven, decision_grid
from ethbrake_marl.pages.frame import shown
from ethbrake_marl.pages.player import played_episode, played_world
from ethbrake_marl.physics import Floats, Worlds
from ethbrake_marl.scenario import Scenario, Task
from ethbrake_marl.search.problem import ProfileProblem, profile_problem
from ethbrake_marl.search.profiles import Profiles, constant_profiles, even_grid, search_profiles

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
            "grid": decision_grid(world, self.scenario, self.vehicle)._asdict(),
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
        steps = decision_grid(world, self.scenario, self.vehicle).steps
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
        given = self._starts(world, problem)
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

    def _starts(self, world: Worlds, problem: ProfileProblem) -> Profiles:
        grid = even_grid(problem, CONSTANTS)
        constant = self.best_constant(world)["deceleration_mps2"]
        return constant_profiles(problem, np.concatenate([np.full((1, 1, 1), -constant), grid], axis=1))


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
