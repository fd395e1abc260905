"""Contents of this extension: group -> name -> module of this folder and object."""

CONTENTS = {
    "agents": {"best_harm": "agents:BEST_HARM", "ladder.search": "agents:SEARCH_LADDER"},
    "measures": {"limits": "limits:LIMITS"},
}
