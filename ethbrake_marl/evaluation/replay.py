"""An episode that a passport names, played again: what must be given for it, and what differs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ethbrake_marl.agents.spelling import parse_spec
from ethbrake_marl.agents.team import Driver, team_of
from ethbrake_marl.errors import InvalidInput, UnknownName, count_of
from ethbrake_marl.evaluation.identity import policy_sha256
from ethbrake_marl.evaluation.inputs import choose_worlds, load_runnable, make_lineup
from ethbrake_marl.evaluation.motion import EpisodeMotion, follow_episodes
from ethbrake_marl.evaluation.passport import LEFT_OUT, Passport, issue_passport
from ethbrake_marl.files.overrides import Override
from ethbrake_marl.physics import Worlds
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.shield.uncertainty import Uncertainty


@dataclass(frozen=True, slots=True)
class Given:
    """What a passport does not hold."""

    scenario: str | None = None  # a name or path; None: the shipped one of the passport's name
    settings: tuple[Override, ...] = ()  # of the scenario
    agent: str | None = None  # as it is written; None: as in the passport
    initial_states: Path | None = None  # the file that the world came from
    uncertainty: Uncertainty | None = None  # that ``+robust`` was certified against


@dataclass(frozen=True, slots=True)
class Replay:
    """An episode that was played again."""

    passport: Passport  # as the episode went now
    scenario: Scenario
    worlds: Worlds  # n = 1, at the alert
    agent: Driver
    motion: EpisodeMotion
    differences: tuple[str, ...]  # in words; none: everything is the same
    same: bool  # the world and the episode are, to the bit

    @property
    def title(self) -> str:
        """What it is, for a page or a film."""
        return f"{self.passport.agent}: world {self.passport.number} of {self.scenario.name}"


def replay(passport: Passport, given: Given) -> Replay:
    """Play the episode of a passport again, and compare it to the bit.

    Raises ``InvalidInput`` that says what is missing: the scenario's file, the agent or its policy, the worlds.
    """
    scenario = _scenario(passport, given)
    spelling = _spelling(passport, given.agent)
    world = _world(passport, scenario, given.initial_states)
    try:
        lineup = make_lineup([spelling], scenario, harm_count=passport.harm_count, uncertainty=given.uncertainty)
    except InvalidInput as error:
        hint = "" if given.agent else "; a policy or agent that lies elsewhere here is given by --agent"
        raise InvalidInput(f"passport: agent {spelling!r}: {error}{hint}") from None
    (agent,) = lineup.values()
    (motion,) = follow_episodes(world, agent, scenario)
    drivers = team_of(agent, scenario.learners).drivers
    policies = {i: sha for i, driver in drivers.items() if (sha := policy_sha256(driver)) is not None}
    now = issue_passport(
        motion, scenario, spelling, seed=passport.seed, number=passport.number, harm_count=passport.harm_count,
        policies=policies,
    )  # fmt: skip
    found = tuple(passport.differences(now))
    return Replay(now, scenario, world, agent, motion, found, passport.is_same_episode(now))


def _scenario(passport: Passport, given: Given) -> Scenario:
    try:
        scenario = load_runnable(given.scenario or passport.scenario, given.settings)
    except UnknownName:
        if given.scenario is not None:
            raise
        raise InvalidInput(
            f"passport: scenario {passport.scenario!r} does not ship; give its file: --scenario FILE.yaml"
        ) from None
    if scenario.learners == passport.vehicles:
        return scenario
    if not all(0 <= i < scenario.vehicles for i in passport.vehicles):
        most = max(passport.vehicles) + 1
        raise InvalidInput(
            f"passport: drives Vehicle {most}, but {scenario.name!r} has {count_of(scenario.vehicles, 'vehicle')}"
        )
    return scenario.with_learners(passport.vehicles)


def _spelling(passport: Passport, agent: str | None) -> str:
    """The agent, from the passport alone where that may say it: no passport names code to run."""
    if agent is not None:
        return agent
    if LEFT_OUT in passport.agent:
        raise InvalidInput(
            f"passport: the agent, {passport.agent}, did not fit into it; give it whole: --agent AGENT, for instance"
            " ppo@runs/my-run"
        )
    if parse_spec(passport.agent).file is not None:
        raise InvalidInput(
            f"passport: the agent, {passport.agent!r}, is code in a file, which is run only where you name it: --agent"
            f" {passport.agent}"
        )
    return passport.agent


def _world(passport: Passport, scenario: Scenario, initial_states: Path | None) -> Worlds:
    if passport.seed is not None:
        if initial_states is not None:
            raise InvalidInput("passport: its world is of a list that is drawn; leave --initial-states out")
        return scenario.sample(1, passport.seed, first=passport.number).worlds
    if initial_states is None:
        raise InvalidInput("passport: its world came from a file; give it: --initial-states FILE.csv")
    worlds = choose_worlds(scenario, initial_states=initial_states)[0].worlds
    if not passport.number < worlds.n:
        raise InvalidInput(
            f"{initial_states}: has {count_of(worlds.n, 'world')}; the passport is of number {passport.number}, from 0"
        )
    return worlds.take(np.array([passport.number]))
