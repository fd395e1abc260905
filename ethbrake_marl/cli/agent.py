"""The commands ``agent list`` and ``agent show``."""

from __future__ import annotations

from typing import Annotated

import typer

from ethbrake_marl.cli.command import JsonOption, Out, example
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.sheet import Column, Sheet

SHOWN_EPISODES = 200

agent_group = typer.Typer(
    help="List the agents, or show a trained one.", epilog=example("agent list", "agent list --json")
)


@agent_group.command("list", epilog=example("agent list"))
def agent_list(as_json: JsonOption = False) -> None:
    """List all agents, what they do and what they know.

    A name that begins with + is appended to the name of an agent, as in full_brake+step.
    """
    with Out(as_json=as_json) as out:
        from ethbrake_marl.agent_names import group, listed_agents, why_not_listed

        entries = listed_agents()
        out.result(
            [{"agent": entry.form, "about": entry.about, "knows": entry.knows} for entry in entries],
            Sheet(
                "", ("Agent", "Method", "Knows"), [(entry.form, entry.about, entry.knows) for entry in entries], gap=2
            ),
            f"ladder stands for {', '.join(group('ladder'))}. See docs/evaluate.md and docs/shield.md.",
        )
        for reason in why_not_listed():
            out.note(f"left out: {reason}")


@agent_group.command("show", epilog=example("agent show ppo --scenario stress-wide"))
def agent_show(
    name: Annotated[str, typer.Argument(metavar="AGENT", help="A trained policy, such as ppo or policy@PATH.")],
    scenario: Annotated[
        str | None, typer.Option(metavar="NAME|PATH", help="Also say how well the policy's training covers a scenario.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Show where a policy was trained.

    The table has the range of what the policy observed there, without the outermost 0.1 % at each end.
    """
    with Out(as_json=as_json) as out:
        from ethbrake_marl.agent_names import make_agent
        from ethbrake_marl.agents.policy_agent import LearnedAgent
        from ethbrake_marl.evaluation.evaluate import evaluate

        agent = make_agent(name, scenario=scenario)
        if not isinstance(agent, LearnedAgent):
            raise InvalidInput(f"agent {name!r}: is no trained policy; name one, such as ppo or policy@runs/mine")
        manifest = agent.policy.manifest
        training_range = manifest.training_range
        if training_range is None:
            raise InvalidInput(f"agent {name!r}: its file does not say what it observed in training; train it again")
        text = f"{name}: {', '.join(manifest.learners)} in {manifest.scenario.get('name')}, by {manifest.algorithm}."
        if scenario is not None:
            share = float(evaluate(scenario, name, episodes=SHOWN_EPISODES)[name]["outside"].mean())
            text += f" In {scenario}, {100 * share:.0f} % of its decisions are outside."
        ends = zip(agent.policy.observation.features, training_range.low, training_range.high, strict=True)
        columns = (
            Column("Feature", "feature", text=True),
            Column("From", "from"),
            Column("To", "to"),
            Column("Unit", "unit", text=True),
        )
        sheet = Sheet("", columns, [(f.name, f.scale * low, f.scale * high, f.unit) for f, low, high in ends], gap=2)
        out.result({"about": text, "range": sheet.json()}, text, sheet)
