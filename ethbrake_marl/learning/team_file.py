"""``team.json`` in a run's folder: which bundle drives which vehicle. Reading a team needs no torch."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from ethbrake_marl.agents.policy import LearnedAgent
from ethbrake_marl.agents.protocol import Driver, Team
from ethbrake_marl.agents.registry import AgentSettings
from ethbrake_marl.errors import CorruptBundle, InvalidInput
from ethbrake_marl.files.store import parse_strict_json, read_plain
from ethbrake_marl.files.yaml import Document, Wording, YamlPath, explain
from ethbrake_marl.learning.recipe import Scheme, driver, drivers
from ethbrake_marl.policies.bundle import Policy, load_policy
from ethbrake_marl.policies.shipped import SHIPPED, PolicyKind, load_named_policy
from ethbrake_marl.scenario import Scenario, load_scenario
from ethbrake_marl.scenario.schema import refuse

TEAM = "team.json"
_LIMIT_BYTES = 1 << 20
_RIGHT = (
    'right is, for instance, {"scheme": "shared", "vehicles": 3, "drivers": {"vehicle_2": "policy", "vehicle_3":'
    ' "policy"}}'
)


class _TeamFile(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    format: Literal["ethbrake-team"] = "ethbrake-team"
    format_version: Literal[1] = 1
    scheme: Scheme
    vehicles: Annotated[int, Field(ge=2, le=64)]
    drivers: Annotated[dict[str, str], Field(min_length=1)]

    @model_validator(mode="after")
    def _drivers_of_the_line_and_scheme(self) -> _TeamFile:
        line = [f"vehicle_{i + 1}" for i in range(self.vehicles)]
        for name, bundle in self.drivers.items():
            if name not in line:
                refuse(("drivers",), name, f"must be one of {line[0]} to {line[-1]}")
            if bundle != driver(self.scheme, name):
                refuse(("drivers", name), bundle, f"must be {driver(self.scheme, name)} under scheme {self.scheme}")
        alone = len(self.drivers) == 1
        if (self.scheme == "single" and not alone) or (self.scheme == "independent" and alone):
            right = "two vehicles or more" if alone else "one vehicle"
            refuse(("drivers",), self.drivers, f"must be {right} under scheme {self.scheme}")
        return self


class _TeamWording(Wording):
    """The ``Wording`` of messages about ``team.json``."""

    def known(self, path: YamlPath) -> list[str]:
        """The keys of the file."""
        return list(_TeamFile.model_fields)

    def needed(self, path: YamlPath) -> str:
        """A whole file."""
        return _RIGHT


def team_content(scheme: Scheme, scenario: Scenario) -> dict[str, Any]:
    """What ``team.json`` says of a training."""
    file = _TeamFile(scheme=scheme, vehicles=scenario.vehicles, drivers=drivers(scheme, scenario))
    return file.model_dump(mode="json")


def is_team(path: str | os.PathLike[str]) -> bool:
    """Whether ``path`` is a run whose learners have a policy each, so that no policy alone drives all of them."""
    file = Path(path) / TEAM
    return os.path.lexists(file) and len(set(_read(file).drivers.values())) > 1


def load_team(path: str | os.PathLike[str], scenario: str | Path | Scenario, name: str = "team") -> Team:
    """The learners of ``scenario`` driven as they were trained together in the run at ``path``.

    A learner that the scenario gives a script is left out. Raises ``InvalidInput`` where there is no team, for one of
    another line length, or for a learner that it does not drive; ``CorruptBundle`` (file, what is wrong) for a damaged
    one.
    """
    scenario = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
    file = Path(path) / TEAM
    if not os.path.lexists(file):
        raise InvalidInput(f"{path}: holds no team ({TEAM}); give the folder of a run, or a bundle as ppo@{path}")
    team = _read(file)
    if team.vehicles != scenario.vehicles:
        shared = len(set(team.drivers.values())) == 1
        raise InvalidInput(
            f"{path}: is a team for a line of {team.vehicles} vehicles, scenario {scenario.name!r} has"
            f" {scenario.vehicles}; "
            + (
                f"its one policy can drive other lines: policy@{path}"
                if shared
                else "only a shared policy can drive others"
            )
        )
    wanted = {scenario.vehicle_names[i]: i for i in scenario.learners}
    missing = [each for each in wanted if each not in team.drivers]
    if missing or not wanted:
        who = ", ".join(missing) or "nobody"
        raise InvalidInput(f"{path}: drives {', '.join(team.drivers)}; scenario {scenario.name!r} has {who} to drive")
    return Team({i: LearnedAgent(load_driver(path, each), name) for each, i in wanted.items()}, name)


def load_driver(path: str | os.PathLike[str], vehicle: str) -> Policy:
    """The policy that drives ``vehicle`` in the run at ``path``; raises as ``load_team``."""
    given: Mapping[str, str] = _read(Path(path) / TEAM).drivers
    if vehicle not in given:
        raise InvalidInput(f"{path}: drives {', '.join(given)}, not {vehicle}")
    return load_policy(Path(path) / given[vehicle])


def _read(file: Path) -> _TeamFile:
    data = read_plain(file, _LIMIT_BYTES)
    try:
        content = parse_strict_json(data)
        return _TeamFile.model_validate(content)
    except ValidationError as error:
        raise CorruptBundle(str(explain(error, Document(str(file), content, {}), _TeamWording()))) from None
    except ValueError as error:
        raise CorruptBundle(f"{file}: is not JSON ({error}); {_RIGHT}") from None


# Trained policies as agents: ``ppo@PATH``, ``policy@PATH``, whatever trained it, ``universal@shipped``, ``team@RUN``.
#
# Needs no torch.

_KINDS: dict[str, PolicyKind] = {name: name for name in get_args(PolicyKind)} | {"team": "policy"}


def make_policy_agent(argument: None, settings: AgentSettings) -> Driver:
    """The policy of a run or a bundle, or the team of a run in which each learner has its own.

    ``PATH`` may be ``shipped``, the policy that comes with the package for this scenario and harm count, or
    ``shipped/NAME``; ``universal@shipped`` is for all scenarios, ``team@shipped`` is ``policy@shipped``. Raises
    ``InvalidInput`` for a policy of another algorithm, and what loading it raises.
    """
    spec, path = settings.spec, settings.policy
    name = spec.partition("@")[0]
    if path is None:
        raise InvalidInput(
            f"agent {spec!r}: a policy is needed: {name}@PATH, where PATH is a run or a policy bundle, for instance"
            f" {name}@runs/my-run, or {name}@{SHIPPED}"
        )
    ships = path.partition("/")[0] == SHIPPED  # one policy for all learners
    if not ships and (name == "team" or (name != "universal" and is_team(path))):
        scenario = settings.needed_scenario()
        team = load_team(path, scenario, spec)
        _check_algorithm(name, path, load_driver(path, scenario.vehicle_names[min(team.drivers)]))
        return team
    if name == "universal" and path != SHIPPED:
        raise InvalidInput(f"agent {spec!r}: must be universal@{SHIPPED}; for another policy: ppo@PATH or sac@PATH")
    policy = load_named_policy(path, _KINDS[name], settings.scenario, settings.harm_count)
    _check_algorithm(name, path, policy)
    return LearnedAgent(policy, name=spec)


def _check_algorithm(name: str, path: str, policy: Policy) -> None:
    """``ppo@PATH``, ``sac@PATH`` and ``counterfactual@PATH`` are for policies of that algorithm."""
    trained_by = policy.manifest.algorithm
    if name in ("ppo", "sac", "counterfactual") and name != trained_by:
        raise InvalidInput(
            f"agent '{name}@{path}': that policy was trained by {trained_by.upper()}: {trained_by}@{path}"
        )
