"""Passports: one short string that names an episode, so that it can be played again and compared to the bit.

``EB1:SCENARIO:HASH:SEED.WORLD:COUNT:VERSIONS:WORLD-HASH:EPISODE-HASH:POLICY-HASH:AGENT:CHECK``, of letters, digits
and ``:.,-_@+/=%``, which no shell touches. Hashes are the beginnings of those in results files; the last part tells a
typo from a difference.
"""

from __future__ import annotations

import hashlib
import platform
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.metadata import version
from pathlib import Path
from urllib.parse import quote, unquote

import numpy as np

from ethbrake_marl.agents.protocol import Driver, team_of
from ethbrake_marl.agents.registry import parse_spec
from ethbrake_marl.defaults import HarmCount
from ethbrake_marl.errors import InvalidInput, UnknownName, count_of, plain_text
from ethbrake_marl.evaluation.episodes import EpisodeMotion, follow_episodes
from ethbrake_marl.evaluation.inputs import (
    choose_worlds,
    content_sha256,
    load_runnable,
    make_lineup,
    policy_sha256,
    scenario_sha256,
    worlds_sha256,
)
from ethbrake_marl.files.yaml import Override
from ethbrake_marl.physics import Worlds
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.shield.uncertainty import Uncertainty

MOST_CHARACTERS = 160
LEFT_OUT = "..."  # in the place of what would make a passport too long
_MARK, _KIND = "EB", "1"
_NAME = 30  # characters of a scenario's name
_NONE = "-"
_SCENARIO, _WORLD, _EPISODE, _POLICY, _CHECK = 10, 6, 10, 8, 6  # hexadecimal digits of each hash
_PACKAGES = ("ethbrake-marl", "numba", "numpy")  # and Python, second
_SHAPE = re.compile(
    r"EB1:(?P<scenario>[\w.-]+):(?P<scenario_sha>[0-9a-f]{10}):(?P<seed>\d{1,20}|-)\.(?P<number>\d{1,18})"
    r":(?P<count>[ft])(?P<vehicles>[\d.]+|-):(?P<versions>[\w.,+-]+):(?P<world_sha>[0-9a-f]{6})"
    r":(?P<episode_sha>[0-9a-f]{10}):(?P<policy_sha>[0-9a-f]{8}|-):(?P<agent>[\w%:.,@+/=-]+)"
)


@dataclass(frozen=True, slots=True)
class Passport:
    """What names an episode."""

    scenario: str  # its name
    scenario_sha: str
    seed: int | None  # of the list; None: the world came from a file
    number: int  # of the world in its list
    harm_count: HarmCount  # that agents minimised
    vehicles: tuple[int, ...]  # driven, from 0
    versions: tuple[str, ...]  # of the package, Python, numba and numpy
    world_sha: str
    episode_sha: str  # of the ledger and of what the episode left
    policy_sha: str | None
    agent: str  # as it is written; LEFT_OUT stands for what did not fit

    def __str__(self) -> str:
        name = self.scenario if len(self.scenario) <= _NAME else self.scenario[:_NAME] + LEFT_OUT
        for agent in _shorter(self.agent):
            text = replace(self, agent=agent)._written(name)
            if len(text) <= MOST_CHARACTERS:
                return text
        return replace(self, agent=LEFT_OUT)._written(name[:20] + LEFT_OUT)

    def _written(self, scenario: str) -> str:
        parts = (
            _MARK + _KIND,
            scenario,
            self.scenario_sha,
            f"{_NONE if self.seed is None else self.seed}.{self.number}",
            self.harm_count[0] + (".".join(str(i + 1) for i in self.vehicles) or _NONE),
            ",".join(self.versions),
            self.world_sha,
            self.episode_sha,
            self.policy_sha or _NONE,
            quote(self.agent, safe="@+:,./=-_", errors="replace").replace("~", "%7E"),
        )
        text = ":".join(parts)
        return f"{text}:{_check(text)}"

    def differences(self, other: Passport) -> list[str]:
        """What another passport of the same world and agent says differently, in words; nothing if it is the same."""
        found = []
        if self.scenario_sha != other.scenario_sha:
            found.append(
                f"the scenario: its values have the hash {other.scenario_sha}, in the passport {self.scenario_sha}; it"
                " was edited since, or other settings (--set) were given"
            )
        found += [
            f"{name}: {now} here, {then} in the passport"
            for name, then, now in zip(
                ("ethbrake-marl", "Python", "numba", "numpy"), self.versions, other.versions, strict=True
            )
            if then != now
        ]
        if self.world_sha != other.world_sha:
            found.append(f"the world at the alert: {other.world_sha} here, {self.world_sha} in the passport")
        if self.policy_sha != other.policy_sha:
            found.append(f"the policy: {other.policy_sha or 'none'} here, {self.policy_sha or 'none'} in the passport")
        if self.episode_sha != other.episode_sha:
            found.append(f"the episode: {other.episode_sha} here, {self.episode_sha} in the passport")
        return found

    def is_same_episode(self, other: Passport) -> bool:
        """Whether world and episode are the same to the bit."""
        return (self.world_sha, self.episode_sha) == (other.world_sha, other.episode_sha)


def issue_passport(
    motion: EpisodeMotion,
    scenario: Scenario,
    agent: str,
    *,
    seed: int | None,
    number: int,
    harm_count: HarmCount = "first",
    policies: Mapping[int, str] | None = None,
) -> Passport:
    """The passport of an episode that was driven.

    Args:
        motion: the episode.
        scenario: as it was driven, with its learners.
        agent: as it is written.
        seed: of the list of worlds; None: they came from a file.
        number: of the world in its list.
        harm_count: that agents minimise.
        policies: SHA-256 of the policy that drives a vehicle, by vehicle, where one does.

    """
    shas = list((policies or {}).values())
    joined = shas[0] if len(shas) == 1 else hashlib.sha256("".join(shas).encode()).hexdigest()
    return Passport(
        scenario=scenario.name,
        scenario_sha=scenario_sha256(scenario)[:_SCENARIO],
        seed=seed,
        number=number,
        harm_count=harm_count,
        vehicles=scenario.learners,
        versions=_versions(),
        world_sha=worlds_sha256(motion.world, np.array([number], np.int64))[:_WORLD],
        episode_sha=content_sha256(motion.ledger, motion.final, motion.impacts)[:_EPISODE],
        policy_sha=joined[:_POLICY] if shas else None,
        agent=agent,
    )


def parse_passport(text: str) -> Passport:
    """The passport that a text is; raises ``InvalidInput`` that tells a typo from another kind of text."""
    given = text.strip()
    shown = plain_text(given[:40])
    if not given.startswith(_MARK) or ":" not in given:
        raise InvalidInput(
            f"{shown!r}: is no passport; one begins with {_MARK}{_KIND}: and stands under each episode of a report"
        )
    if not given.startswith(f"{_MARK}{_KIND}:"):
        raise InvalidInput(
            f"{shown!r}: a passport of another kind; this version reads those that begin with {_MARK}{_KIND}:"
        )
    body, _, check = given.rpartition(":")
    found = _SHAPE.fullmatch(body)
    if check != _check(body) or found is None or len(given) > 2 * MOST_CHARACTERS:
        raise InvalidInput(
            f"{shown!r}...: a typo, or a part is missing: the check at the end does not fit; copy it whole"
        )
    part = found.groupdict()
    versions = tuple(part["versions"].split(","))
    if len(versions) != len(_PACKAGES) + 1:
        raise InvalidInput(f"{shown!r}...: names {count_of(len(versions), 'version')}; {len(_PACKAGES) + 1} are needed")
    return Passport(
        scenario=part["scenario"],
        scenario_sha=part["scenario_sha"],
        seed=None if part["seed"] == _NONE else int(part["seed"]),
        number=int(part["number"]),
        harm_count="first" if part["count"] == "f" else "total",
        vehicles=_vehicles(part["vehicles"], shown),
        versions=versions,
        world_sha=part["world_sha"],
        episode_sha=part["episode_sha"],
        policy_sha=None if part["policy_sha"] == _NONE else part["policy_sha"],
        agent=unquote(part["agent"], errors="strict"),
    )


def _vehicles(text: str, shown: str) -> tuple[int, ...]:
    if text == _NONE:
        return ()
    if not re.fullmatch(r"[1-9]\d?(\.[1-9]\d?)*", text):
        raise InvalidInput(f"{shown!r}...: vehicles {text!r}: must be numbers from 1, with dots between them")
    return tuple(int(each) - 1 for each in text.split("."))


def _shorter(agent: str) -> Sequence[str]:
    """How an agent may be written where there is little room: as it is, without its path, not at all."""
    before, at, _ = agent.partition("@")
    around = "" if not at else "".join(f"+{each}" for each in _around(agent))
    return (agent, *([f"{before}@{LEFT_OUT}{around}"] if at else []), LEFT_OUT)


def _around(agent: str) -> tuple[str, ...]:
    try:
        return parse_spec(agent).around
    except InvalidInput:  # the name of an agent that was made in Python
        return ()


@cache
def _versions() -> tuple[str, ...]:
    own, *others = (version(name) for name in _PACKAGES)
    return (own, platform.python_version(), *others)


def _check(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:_CHECK]


# An episode that a passport names, played again: what must be given for it, and what differs.


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
