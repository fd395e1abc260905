"""The parts that this extension adds: group -> name -> module of this folder and object."""

PARTS = {
    "agents": {"best_harm": "agents:BEST_HARM", "ladder.search": "agents:SEARCH_LADDER"},
    "shields": {"search": "agents:SEARCH"},
    "measures": {"limits": "limits:LIMITS"},
}
