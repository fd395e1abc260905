"""The sensitivity of the random test: how far its headline moves when what the paper leaves open changes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.evaluation import Evaluation, evaluate
from ethbrake_marl.evaluation.inputs import PROGRESS_EVERY
from ethbrake_marl.evaluation.outcome import PAPER_ROWS, RANDOM_TEST
from ethbrake_marl.evaluation.statistics import Estimate, mean, paired_difference, unpaired_difference
from ethbrake_marl.figures.studies import changes_figure
from ethbrake_marl.figures.style import Figure
from ethbrake_marl.learning.recipe import load_recipe
from ethbrake_marl.learning.training import progress_column, progress_rows
from ethbrake_marl.physics import Bools, Floats
from ethbrake_marl.policies.shipped import load_shipped
from ethbrake_marl.scenario import Scenario, load_scenario
from ethbrake_marl.studies.reproduction.item import (
    ABOUT_POLICIES,
    AGREES,
    COUPLED,
    DIFFERS,
    FULL,
    FULL_BRAKE,
    GAPS,
    HARM,
    LIST_SEED,
    NAMES,
    NOT_RUN,
    PAIRWISE,
    PERCENT,
    PPO,
    Alternative,
    Drawn,
    Gap,
    Made,
    Parameter,
    Settings,
    Table,
    Verdict,
    collision_rate,
    compare_number,
    csv_text,
    lineup,
    list_parameter,
    scenario_parameters,
)
from ethbrake_marl.studies.reproduction.trainings import OPEN, PPO_PAPER, TRAINED_HARM, finished, group_named, hybrid

SCENARIO = "paper-random"
_WORLDS = 2_000
_SPECS = (FULL_BRAKE, PAIRWISE, COUPLED, PPO)
_SHOWN = tuple(NAMES[spec] for spec in _SPECS)


@dataclass(frozen=True, slots=True)
class Headline:
    """Harm and collisions of each strategy in each world of a list."""

    gaps_m: Floats  # [n, P] by which lists of the same worlds are known
    harm: Mapping[str, Floats]
    collided: Mapping[str, Bools]

    def change(self, base: Headline, strategy: str) -> Estimate:
        """Harm minus that of ``base``: paired by world where the worlds are the same, else of two lists."""
        own, other = self.harm[strategy], base.harm[strategy]
        if np.array_equal(self.gaps_m, base.gaps_m):
            return paired_difference(own, other)
        return unpaired_difference(mean(own), len(own), mean(other), len(other))


Found = Mapping[tuple[Gap, Alternative], Headline]


def reproduce_gaps(settings: Settings) -> Made:
    """The sensitivity table: every quantity, our default, alternatives, and how far the headline moves."""
    episodes, scenario = settings.worlds(_WORLDS), load_scenario(SCENARIO)
    base = _measure(scenario, Alternative("default"), episodes)
    measured = [gap for gap in GAPS if gap.is_measured]
    found: dict[tuple[Gap, Alternative], Headline] = {}
    for number, gap in enumerate(measured):
        settings.say("open quantities", number, len(measured))
        found |= {(gap, each): _measure(scenario, each, episodes) for each in gap.alternatives}
    settings.say("open quantities", len(measured), len(measured))
    parameters = (
        *scenario_parameters(scenario, gaps_m="text to Table:Random", speeds_mps="text to Table:Random"),
        Parameter("policies", f"{ABOUT_POLICIES}; not trained anew for an alternative", ""),
        list_parameter(episodes),
    )
    trained = _trained(settings)
    tables = (_register(), _headline(base, episodes), _sensitivity(base, found), *([trained] if trained else []))
    figure = Drawn("gaps", "How far the headline moves", _ABOUT_FIGURE, _figure(base, found))
    return Made(
        tuple(_verdicts(base, found, trained=trained is not None)),
        parameters,
        tables,
        (figure,),
        {"gaps": _csv(base, found)},
        _notes(base, found),
    )


_ABOUT_FIGURE = "Change of the mean harm of each strategy on the random test when one open quantity changes."


def _measure(scenario: Scenario, alternative: Alternative, episodes: int) -> Headline:
    """The strategies in one alternative."""
    if "obstacle_margin_m" in alternative.changes:
        own = load_scenario("paper-random-obstacle")
    else:
        own = scenario.replace(**alternative.changes) if alternative.changes else scenario
    agents: dict[str, Agent] = dict(lineup(_SPECS, own))
    if alternative.bound is not None:
        agents[NAMES[PPO]] = hybrid(load_shipped("ppo"), own, alternative.bound)
    seed = LIST_SEED if alternative.seed is None else alternative.seed
    evaluation = evaluate(
        own.sample(episodes, seed),
        agents,
        scenario=own,
        seed=seed,
        chunk=PROGRESS_EVERY,
        aftermath=alternative.harm == "sampled",
    )
    collided = {name: outcome.collided for name, outcome in evaluation.outcomes.items()}
    return Headline(evaluation.worlds.gaps_m, _counted(evaluation, alternative), collided)


def _counted(evaluation: Evaluation, alternative: Alternative) -> dict[str, Floats]:
    """The harm that the alternative counts; a strategy that predicts none has its first-impact harm."""
    found = {}
    for name, outcome in evaluation.outcomes.items():
        predicted = outcome.predicted_harm if name == NAMES[PAIRWISE] else None
        sampled = outcome.sampled_harm
        own = {"total": outcome.total_harm, "sampled": sampled, "predicted": predicted}.get(alternative.harm)
        found[name] = outcome.first_impact_harm if own is None else own
    return found


def _rows(found: Found) -> dict[str, Headline]:
    return {f"{gap.name}: {each.value}": headline for (gap, each), headline in found.items()}


def _register() -> Table:
    rows = tuple((gap.name, gap.paper, gap.ours, _alternatives(gap)) for gap in GAPS)
    head = ("Quantity", "The paper", "Our default", "Alternatives, or why none is measured")
    return Table("Register of what the paper leaves open", head, rows, "Labels are those of the paper's source.")


def _alternatives(gap: Gap) -> str:
    if gap.is_measured:
        return "; ".join(each.value for each in gap.alternatives)
    return f"trained by --full: {gap.trained}..." if gap.trained else f"not measured: {gap.unmeasured}"


def _headline(base: Headline, episodes: int) -> Table:
    rows = tuple(
        (name, PERCENT.estimate(collision_rate(base.collided[name])), HARM.estimate(mean(base.harm[name])))
        for name in _SHOWN
    )
    note = f"{episodes:,} worlds of the random test, seed {LIST_SEED}; first-impact harm, m²/s²; 95 % intervals."
    return Table("Headline at our defaults", ("Strategy", "Collision rate", "Harm"), rows, note)


def _sensitivity(base: Headline, found: Found) -> Table:
    rows = []
    for (gap, each), headline in found.items():
        cells = [HARM.estimate(headline.change(base, name)) for name in _SHOWN]
        rates = [
            PERCENT.number(collision_rate(headline.collided[name]).value) for name in (NAMES[PAIRWISE], NAMES[PPO])
        ]
        rows.append((gap.name, gap.ours, each.value, *cells, *rates))
    head = ("Quantity", "Default", "Alternative", *_SHOWN, "Collisions, E-V2X-BM", "Collisions, PPO")
    note = (
        "Change of the mean harm (m²/s²) with its 95 % interval, paired by world where the worlds are the same; then"
        " the collision rates in the alternative. In the rows of H* inside the hybrid, PPO stands behind Algorithm 1."
    )
    return Table("How far the headline moves", head, tuple(rows), note)


def _trained(settings: Settings) -> Table | None:
    """Harm of the kept policies of the trainings of what is open; None where nothing was trained."""
    if settings.mode != FULL:
        return None
    rows = []
    for name, paths in finished(settings.folder, group_named(OPEN)).items():
        kept = [min(progress_column(progress_rows(path), TRAINED_HARM).values()) for path in paths]
        each = ", ".join(f"{harm:.2f}" for harm in kept)
        rows.append((name, str(len(kept)), f"{float(np.mean(kept)):.2f}", each))
    whole = load_recipe(PPO_PAPER.recipe).total_steps
    note = (
        "First-impact harm (m²/s²) of the kept policy on 1,000 worlds of seed 1007; ppo-paper is the paper's table with"
        f" our weights. Each had {PPO_PAPER.decisions:,} of the recipe's {whole:,} decisions; two seeds say little"
        " about others."
    )
    head = ("Training", "Seeds", "Mean harm", "Each seed")
    return Table("What is open in training", head, tuple(rows), note) if rows else None


_PRINTED = {FULL_BRAKE: "Non-E", PAIRWISE: "E-V2X-BM", PPO: "Hybrid PPO"}
_ORDER = (NAMES[PPO], NAMES[COUPLED], NAMES[FULL_BRAKE])


def _verdicts(base: Headline, found: Found, *, trained: bool) -> list[Verdict]:
    """Whether some alternative brings a strategy to its printed row, and whether the strategies keep their order."""
    rows, verdicts = _rows(found), []
    for spec, agent in _PRINTED.items():
        printed = next(row for row in PAPER_ROWS if (row.table, row.agent) == (RANDOM_TEST, agent))
        own = {row: mean(headline.harm[NAMES[spec]]) for row, headline in rows.items()}
        what = f"{agent}, average harm of Table:Random, one open quantity changed at a time"
        verdicts.append(compare_number(what, printed.average_harm, mean(base.harm[NAMES[spec]]), others=own))
    broken = [row for row, headline in rows.items() if not _in_order(headline, _ORDER)]
    told = f"in {len(rows) - len(broken)} of {len(rows)} alternatives"
    told += f"; not with {'; '.join(broken)}" if broken else ""
    verdicts.append(Verdict(f"the order stays: {' < '.join(_ORDER)}", DIFFERS if broken else AGREES, told))
    if not trained:
        verdicts.append(Verdict("what is open in training", NOT_RUN, "no training; --full trains"))
    return verdicts


def _notes(base: Headline, found: Found) -> tuple[str, ...]:
    """What moves each strategy most."""
    rows, notes = _rows(found), []
    for name in _SHOWN:
        most = max(rows, key=lambda row: abs(rows[row].change(base, name).value))
        change = rows[most].change(base, name)
        harm = HARM.estimate(mean(base.harm[name]))
        notes.append(f"What moves {name} ({harm}) most: {most}, by {HARM.estimate(change)}.")
    return tuple(notes)


def _in_order(headline: Headline, order: tuple[str, ...]) -> bool:
    means = [float(headline.harm[name].mean()) for name in order]
    return means == sorted(means)


def _figure(base: Headline, found: Found) -> Figure:
    changes = {row: {name: headline.change(base, name) for name in _SHOWN} for row, headline in _rows(found).items()}
    return changes_figure(changes, x_label="Change of the mean harm (m²/s²)", caption=_ABOUT_FIGURE)


def _csv(base: Headline, found: Found) -> str:
    rows = []
    for label, headline in {"default": base, **_rows(found)}.items():
        for name in _SHOWN:
            change, harm = headline.change(base, name), mean(headline.harm[name])
            low, high = change.interval or ("", "")
            rate = collision_rate(headline.collided[name])
            rows.append([label, name, len(headline.gaps_m), harm.value, change.value, low, high, rate.value])
    head = ("alternative", "strategy", "worlds", "harm", "change", "change_low", "change_high", "collision_rate")
    return csv_text(head, rows)
