"""Contents of this extension: group -> name -> module of this folder and object."""

CONTENTS = {
    "agents": {"plan": "planner:AGENT"},
    "feature_groups": {"contact": "contacts:GROUP", "plan": "plan:GROUP", "forecast": "plan:FORECAST_GROUP"},
}
