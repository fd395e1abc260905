"""The statistics of some worlds of a list: counts and exact sums, which merge in any order to the same bits."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.exact import VALUE_BITS, Moments
from ethbrake_marl.evaluation.outcome import LeftOut

HASHES = 1 << 256  # sums of hashes are kept modulo this
_MOST = 1 << 64
_ALWAYS = ("first_impact_harm", "total_harm")  # numbers that every agent has in every world
Range = tuple[float, float]


@dataclass(frozen=True, slots=True)
class AgentTally:
    """What one agent did in some worlds. What it does not have in all worlds of a list is told of none."""

    counts: Mapping[str, int] = field(default_factory=dict)  # worlds in which something was so
    moments: Mapping[str, Moments] = field(default_factory=dict)  # of a number that each world has
    products: Mapping[str, int] = field(default_factory=dict)  # of a number with the baseline's of the same name

    def __add__(self, other: AgentTally) -> AgentTally:
        return AgentTally(
            {name: self.counts.get(name, 0) + other.counts.get(name, 0) for name in {**self.counts, **other.counts}},
            {
                name: self.moments.get(name, Moments()) + other.moments.get(name, Moments())
                for name in {**self.moments, **other.moments}
            },
            {
                name: self.products.get(name, 0) + other.products.get(name, 0)
                for name in {**self.products, **other.products}
            },
        )

    def to_json(self) -> dict[str, Any]:
        """Plain data; whole numbers of any size are hexadecimal texts."""
        return {
            "counts": dict(self.counts),
            "moments": {name: [m.count, hex(m.total), hex(m.squares)] for name, m in self.moments.items()},
            "products": {name: hex(value) for name, value in self.products.items()},
        }

    @classmethod
    def from_json(cls, told: Mapping[str, Any]) -> AgentTally:
        """What ``to_json`` gave; raises ``KeyError``, ``TypeError`` or ``ValueError`` for anything else."""
        return cls(
            {name: _whole(value) for name, value in told["counts"].items()},
            {name: _moments(*parts) for name, parts in told["moments"].items()},
            {name: int(value, 16) for name, value in told["products"].items()},
        )


@dataclass(frozen=True, slots=True)
class Tally:
    """The statistics of some worlds, added in any order.

    ``worlds_hash`` is the sum, modulo 2^256, of the SHA-256 of the leaves: 1,000 neighbouring worlds of the list each.
    """

    worlds: int = 0  # that count, driven by all agents
    hidden: int = 0  # in which the channel hides something from a driven vehicle
    worlds_hash: int = 0
    ranges: Mapping[str, tuple[Range, ...]] = field(default_factory=dict)  # least and largest of every quantity
    left_out: tuple[LeftOut, ...] = ()
    agents: Mapping[str, AgentTally] = field(default_factory=dict)

    def __add__(self, other: Tally) -> Tally:
        return Tally(
            self.worlds + other.worlds,
            self.hidden + other.hidden,
            (self.worlds_hash + other.worlds_hash) % HASHES,
            {name: _joined(self.ranges, other.ranges, name) for name in {**self.ranges, **other.ranges}},
            tuple(sorted((*self.left_out, *other.left_out))),
            {
                name: self.agents.get(name, AgentTally()) + other.agents.get(name, AgentTally())
                for name in {**self.agents, **other.agents}
            },
        )

    def to_json(self) -> dict[str, Any]:
        """Plain data, as in the file of a finished shard."""
        return {
            "worlds": self.worlds,
            "hidden": self.hidden,
            "worlds_hash": hex(self.worlds_hash),
            "ranges": {name: [list(each) for each in entries] for name, entries in self.ranges.items()},
            "left_out": [list(left) for left in self.left_out],
            "agents": {name: agent.to_json() for name, agent in self.agents.items()},
        }

    @classmethod
    def from_json(cls, told: Any) -> Tally:
        """What ``to_json`` gave; raises ``InvalidInput`` for anything else."""
        try:
            tally = cls(
                _whole(told["worlds"]),
                _whole(told["hidden"]),
                int(told["worlds_hash"], 16) % HASHES,
                {name: tuple((float(a), float(b)) for a, b in entries) for name, entries in told["ranges"].items()},
                tuple(_left_out(*left) for left in told["left_out"]),
                {name: AgentTally.from_json(agent) for name, agent in told["agents"].items()},
            )
            for agent in tally.agents.values() if tally.worlds else ():
                if any(agent.moments[name].count != tally.worlds for name in _ALWAYS):
                    raise ValueError("an agent that did not drive every world")
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise InvalidInput(f"is no tally of a shard: {error!r}") from None
        return tally


def _whole(value: Any) -> int:
    if type(value) is not int or not 0 <= value < _MOST:
        raise ValueError(f"{value!r} is no whole number from 0 on")
    return value


def _moments(count: Any, total: str, squares: str) -> Moments:
    """Moments that some values can have, none of them beyond 2^1000."""
    found = Moments(_whole(count), int(total, 16), int(squares, 16))
    n = found.count
    if abs(found.total) > n << (VALUE_BITS + 1000) or n * found.squares < found.total**2 or (n == 0 < found.squares):
        raise ValueError("moments that no values have")
    return found


def _left_out(world: Any, seed: Any, agent: Any, reason: Any) -> LeftOut:
    if not (isinstance(agent, str) and isinstance(reason, str)):
        raise ValueError(f"{agent!r}, {reason!r}: must be texts")
    return LeftOut(_whole(world), _whole(seed), agent, reason)


def _joined(
    one: Mapping[str, tuple[Range, ...]], other: Mapping[str, tuple[Range, ...]], name: str
) -> tuple[Range, ...]:
    """The ranges that hold both."""
    first, second = one.get(name), other.get(name)
    if first is None or second is None:
        return second if first is None else first  # type: ignore[return-value]  # one of them is there
    return tuple((min(a[0], b[0]), max(a[1], b[1])) for a, b in zip(first, second, strict=True))
