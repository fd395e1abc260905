"""The agents that drive a vehicle: one protocol, scripts, baselines and the registry. See docs/baselines.md."""

from typing import TYPE_CHECKING

from ethbrake_marl.doors import front_door

if TYPE_CHECKING:
    from ethbrake_marl.agents.believed import (
        SUFFIX as SUFFIX,
        Believing as Believing,
        Foretold as Foretold,
        Odometer as Odometer,
        Ranges as Ranges,
        Told as Told,
        believed_worlds as believed_worlds,
        ranges_of as ranges_of,
        split_believed as split_believed,
        told_to as told_to,
    )
    from ethbrake_marl.agents.e_v2x_bm import (
        EV2XBM as EV2XBM,
        optimise_coupled as optimise_coupled,
        optimise_pairwise as optimise_pairwise,
        pairwise_breakpoints as pairwise_breakpoints,
        pairwise_harm as pairwise_harm,
    )
    from ethbrake_marl.agents.planner import (
        MOST_CANDIDATES as MOST_CANDIDATES,
        PROFILE_BUDGET as PROFILE_BUDGET,
        BestHarm as BestHarm,
    )
    from ethbrake_marl.agents.policy import (
        LearnedAgent as LearnedAgent,
        LearnedPolicy as LearnedPolicy,
        PolicyAgent as PolicyAgent,
        policy_agent as policy_agent,
    )
    from ethbrake_marl.agents.protocol import (
        Agent as Agent,
        AgentAround as AgentAround,
        Driver as Driver,
        Knowledge as Knowledge,
        Shielding as Shielding,
        Source as Source,
        Team as Team,
        check_agent as check_agent,
        combine as combine,
        fixed_commands as fixed_commands,
        knowledge_of as knowledge_of,
        knowledge_text as knowledge_text,
        sees_through as sees_through,
        team_of as team_of,
    )
    from ethbrake_marl.agents.refined import Refined as Refined
    from ethbrake_marl.agents.registry import (
        AgentSettings as AgentSettings,
        agent_entries as agent_entries,
        agent_names as agent_names,
        make_agent as make_agent,
        make_single_agent as make_single_agent,
        parse_spec as parse_spec,
        register_agent as register_agent,
    )
    from ethbrake_marl.agents.rollout import (
        Episodes as Episodes,
        drive as drive,
        episode_engine as episode_engine,
        play as play,
        record_commands as record_commands,
        script_agents as script_agents,
        write_down as write_down,
    )
else:
    __getattr__ = front_door(__name__, __file__)
