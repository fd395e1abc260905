"""Contents of this extension: group -> name -> module of this folder and object."""

CONTENTS = {
    "features": {
        "age": "features:AGE",
        "intent": "features:INTENT_FEATURE",
        "place_known": "features:KNOWN.place",
        "speed_known": "features:KNOWN.speed",
        "acceleration_known": "features:KNOWN.acceleration",
        "braking_capacity_known": "features:KNOWN.braking_capacity",
        "latency_known": "features:KNOWN.latency",
        "mass_known": "features:KNOWN.mass",
        "intent_known": "features:KNOWN.intent",
        "plan_known": "features:KNOWN.plan",
        "plan_command_1": "features:PLAN_FEATURES.command_1",
        "plan_command_2": "features:PLAN_FEATURES.command_2",
        "plan_command_3": "features:PLAN_FEATURES.command_3",
        "plan_change_1": "features:PLAN_FEATURES.change_1",
        "plan_change_2": "features:PLAN_FEATURES.change_2",
    },
    "v2x_keys": {
        "persistence": "declared:DEFAULT_MESSAGES",
        "tells": "declared:DEFAULT_MESSAGES",
        "reports": "reports:REPORTS",
    },
}
