"""The price of not knowing: agents that see through a channel beside the same ones on what was received."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from ethbrake_marl.agents.believing import SUFFIX, split_believed
from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.agents.spelling import parse_spec
from ethbrake_marl.defaults import PRICE_CHANNELS
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.identity import result_identity
from ethbrake_marl.evaluation.outcome import Evaluation, LeftOut
from ethbrake_marl.evaluation.rollout import evaluate
from ethbrake_marl.evaluation.statistics import Estimate, estimates_to_json, mean, paired_difference, rate
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.scenario.v2x import CHANNELS as PRESETS

if TYPE_CHECKING:
    from ethbrake_marl.figures.style import Figure

POLICY = "ppo@shipped/ppo"
AGENTS = (
    "full_brake",
    POLICY,
    f"e_v2x_bm:{SUFFIX}",
    f"planner:128:{SUFFIX}",
    f"{POLICY}+step:{SUFFIX}",
    f"{POLICY}+robust:{SUFFIX}",
)
ABOVE = 1e-6  # m2/s2 above the bound that count

OnAgent = Callable[[str, int], None]  # channel and agent, worlds done so far


@dataclass(frozen=True, slots=True)
class PriceRow:
    """One agent over one channel; harms are means per world (m2/s2).

    Beside an agent that decides on what was received stand the ``limit``, which reads the line as it is, and the price:
    its own harm minus the limit's, paired by world.
    """

    channel: str  # the preset, with ``, periodic`` behind it where messages are
    agent: str
    first: Estimate
    total: Estimate
    limit: str | None = None  # the omniscient agent; None: this one says nothing of ``believed``
    limit_first: Estimate | None = None
    limit_total: Estimate | None = None
    price_first: Estimate | None = None
    price_total: Estimate | None = None
    above: Estimate | None = None  # share of worlds above what its shield expected first; None: it has none

    def to_json(self) -> dict[str, Any]:
        """Plain data for JSON; an interval is ``[low, high]`` or null, and what does not exist is null."""
        found = {name: getattr(self, name) for name in ESTIMATES}
        return {"channel": self.channel, "agent": self.agent, "limit": self.limit, **estimates_to_json(found)}


ESTIMATES = ("first", "total", "limit_first", "limit_total", "price_first", "price_total", "above")


@dataclass(frozen=True, slots=True)
class Price:
    """All agents over all channels, with the worlds that could not be advanced over one of them."""

    rows: tuple[PriceRow, ...]  # channel by channel, the agents in their order
    identities: dict[str, dict[str, Any]]  # by channel, for results files
    left_out: tuple[LeftOut, ...] = ()

    def to_json(self) -> list[dict[str, Any]]:
        """A row for each agent and channel, with what it is about."""
        return [self.identities[row.channel] | row.to_json() for row in self.rows]


def channels_of(presets: Sequence[str] = PRICE_CHANNELS) -> dict[str, dict[str, str]]:
    """The channels by name: each preset, and where it sends messages one by one also periodic.

    Raises ``InvalidInput`` for no preset, and for a name that is none.
    """
    found: dict[str, dict[str, str]] = {}
    for preset in presets:
        if preset not in PRESETS:
            raise InvalidInput(f"channel {preset!r}: must be a preset of v2x: {', '.join(PRESETS)}")
        found[preset] = {"preset": preset}
        if PRESETS[preset].timing == "messages" and PRESETS[preset].hears != "none":
            found[f"{preset}, periodic"] = {"preset": preset, "persistence": "periodic"}
    if not found:
        raise InvalidInput("price of not knowing: at least one channel is needed")
    return found


def limit_of(agent: str) -> str | None:
    """The agent that does the same and reads the line as it is; None where this one says nothing of ``believed``.

    A robust shield has none that knows: beside it stands the step shield.

    >>> from ethbrake_marl.studies.price import limit_of
    >>> limit_of("planner:128:believed"), limit_of("coast+robust:believed"), limit_of("coast")
    ('planner:128', 'coast+step', None)

    """
    written = parse_spec(agent)
    around = [split_believed(each) for each in written.around]
    argument, believes = split_believed(written.argument)
    if not believes and not any(said for _, said in around):
        return None
    core = (
        written.core
        if not believes
        else written.core.replace(f":{written.argument}", f":{argument}" if argument else "")
    )
    names = ("step" if said and str(name).startswith("robust") else str(name) for name, said in around)
    return "".join([core, *(f"+{name}" for name in names)])


def price_of_not_knowing(
    scenario: Scenario,
    *,
    channels: Sequence[str] = PRICE_CHANNELS,
    agents: Sequence[str] = AGENTS,
    n: int = 100,
    seed: int = 7,
    harm_count: HarmCount = "first",
    on_progress: OnAgent | None = None,
) -> Price:
    """Drive the first ``n`` worlds of a list over every channel, by every agent and by its limit.

    Args:
        scenario: whose list; its own channel is replaced.
        channels: presets of ``v2x``; those that send messages one by one are also taken with periodic ones.
        agents: as ``ethbrake evaluate`` writes them. Those that say ``believed`` are compared with their limits.
        n: number of worlds.
        seed: of the list.
        harm_count: harm that agents minimise; both are measured.
        on_progress: is called with channel and agent, and that agent's worlds done so far.

    Raises ``InvalidInput`` for an unknown channel, where no agent is compared, and for one that cannot drive.

    """
    if not any(limit_of(agent) for agent in agents):
        raise InvalidInput(
            f"price of not knowing: none of the agents is compared; give one that says {SUFFIX!r}: e_v2x_bm:{SUFFIX}"
        )
    rows: list[PriceRow] = []
    about: dict[str, dict[str, Any]] = {}
    left_out: list[LeftOut] = []
    everybody = dict.fromkeys(spec for agent in agents for spec in (agent, limit_of(agent)) if spec is not None)
    lines = {name: scenario.replace(v2x=v2x) for name, v2x in channels_of(channels).items()}
    lineups = {  # all of them before the first is driven: what cannot be is refused at once
        name: {spec: make_agent(spec, scenario=over, harm_count=harm_count) for spec in everybody}
        for name, over in lines.items()
    }
    for name, over in lines.items():
        sample = over.sample(n, seed)

        def tell(spec: str, done: int, name: str = name) -> None:
            if on_progress is not None:
                on_progress(f"{name}: {spec}", done)

        found = evaluate(sample, lineups[name], scenario=over, seed=seed, on_progress=tell, aftermath=False)
        rows += [_row(name, agent, found, harm_count) for agent in agents]
        missing = {left.world for left in found.left_out}
        gone = [row for row, world in enumerate(sample.index.tolist()) if world in missing]
        about[name] = result_identity("price", over, sample, gone)
        left_out += found.left_out
    return Price(tuple(rows), about, tuple(left_out))


def _row(channel: str, agent: str, found: Evaluation, harm_count: HarmCount) -> PriceRow:
    own, limit = found.outcome(agent), limit_of(agent)
    row = PriceRow(channel, agent, mean(own.first_impact_harm), mean(own.total_harm))
    if limit is None:
        return row
    other, above = found.outcome(limit), None
    if own.predicted_harm is not None and parse_spec(agent).shield is not None:
        above = rate(int((own.world_harm(harm_count) > own.predicted_harm + ABOVE).sum()), len(own.total_harm))
    return replace(
        row,
        limit=limit,
        limit_first=mean(other.first_impact_harm),
        limit_total=mean(other.total_harm),
        price_first=paired_difference(own.first_impact_harm, other.first_impact_harm),
        price_total=paired_difference(own.total_harm, other.total_harm),
        above=above,
    )


def price_tables(rows: Sequence[PriceRow]) -> str:
    """A Markdown table for every agent that is compared, and one for all that are not: a line per channel."""
    agents = list(dict.fromkeys(row.agent for row in rows))
    alone = [agent for agent in agents if limit_of(agent) is None]
    tables = [_table_alone([[row for row in rows if row.agent == agent] for agent in alone])] if alone else []
    compared = ([row for row in rows if row.agent == agent] for agent in agents if agent not in alone)
    return "\n\n".join([*tables, *map(_table_compared, compared)])


def _table_alone(by_agent: Sequence[Sequence[PriceRow]]) -> str:
    head = ["channel", *(f"`{rows[0].agent}`, {count}" for rows in by_agent for count in ("first", "total"))]
    lines = [
        [rows[0].channel, *(each.in_words() for row in rows for each in (row.first, row.total))]
        for rows in zip(*by_agent, strict=True)
    ]
    return _markdown(head, lines)


def _table_compared(rows: Sequence[PriceRow]) -> str:
    limit, agent = f"`{rows[0].limit}`", f"`{rows[0].agent}`"
    head = ["channel", *(f"{word}, {count}" for count in ("first", "total") for word in (limit, agent, "price"))]
    lines = []
    for row in rows:
        estimates = (row.limit_first, row.first, row.price_first, row.limit_total, row.total, row.price_total)
        words = [each.in_words() if k % 3 == 2 else f"{each.value:.2f}" for k, each in enumerate(estimates) if each]
        lines.append([row.channel, *words, *([row.above.in_words(scale=100, unit=" %")] if row.above else [])])
    return _markdown([*head, *(["above its bound"] if rows[0].above else [])], lines)


def _markdown(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    rule = "| --- |" + " ---: |" * (len(head) - 1)
    return "\n".join(["| " + " | ".join(head) + " |", rule, *("| " + " | ".join(cells) + " |" for cells in lines)])


def price_figure(rows: Sequence[PriceRow], *, caption: str = "") -> Figure:
    """The price of every agent that is compared, per channel and harm count."""
    # Here: matplotlib takes a second to load, and tables need none.
    from ethbrake_marl.figures.bars import draw_bars

    compared = [row for row in rows if row.limit is not None]
    panels = []
    for count in ("first", "total"):
        series: dict[str, list[Estimate]] = {}
        for row in compared:
            price = row.price_first if count == "first" else row.price_total
            assert price is not None
            series.setdefault(row.agent, []).append(price)
        panels.append(
            (
                f"price, {count}-impact harm (m²/s²)" if count == "first" else "price, total harm (m²/s²)",
                list(series.items()),
            )
        )
    return draw_bars(list(dict.fromkeys(row.channel for row in compared)), panels, caption=caption)
