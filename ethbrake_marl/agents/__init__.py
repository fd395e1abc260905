"""The agents that drive a vehicle: one protocol, scripts, baselines and the registry. See docs/baselines.md."""

from typing import TYPE_CHECKING

from ethbrake_marl.doors import front_door

if TYPE_CHECKING:
    from ethbrake_marl.agents.believed import (
        Believing as Believing,
        Odometer as Odometer,
        Ranges as Ranges,
        Told as Told,
    )
    from ethbrake_marl.agents.e_v2x_bm import (
        EV2XBM as EV2XBM,
        optimise_coupled as optimise_coupled,
        optimise_pairwise as optimise_pairwise,
        pairwise_harm as pairwise_harm,
    )
    from ethbrake_marl.agents.planner import BestHarm as BestHarm, Searched as Searched
    from ethbrake_marl.agents.policy import (
        LearnedAgent as LearnedAgent,
        LearnedPolicy as LearnedPolicy,
        PolicyAgent as PolicyAgent,
        policy_agent as policy_agent,
    )
    from ethbrake_marl.agents.registry import (
        Agent as Agent,
        AgentAround as AgentAround,
        AgentSettings as AgentSettings,
        Driver as Driver,
        Episodes as Episodes,
        Knowledge as Knowledge,
        Source as Source,
        Team as Team,
        agent_entries as agent_entries,
        agent_names as agent_names,
        agents_refused as agents_refused,
        check_agent as check_agent,
        drive as drive,
        episode_engine as episode_engine,
        find_entry as find_entry,
        fixed_commands as fixed_commands,
        make_agent as make_agent,
        make_role as make_role,
        parse_spec as parse_spec,
        record_commands as record_commands,
        register_agent as register_agent,
        register_shield as register_shield,
        script_agents as script_agents,
        shield_forms as shield_forms,
        split_names as split_names,
        split_specs as split_specs,
        write_down as write_down,
    )
else:
    __getattr__ = front_door(__name__, __file__)
