"""The parts that this extension adds: group -> name -> module of this folder and object."""

PARTS = {
    "renderers": {"rgb_array": "viewer:Viewer", "ansi": "viewer:Words", "human": "viewer:Window"},
    "commands": {"watch": "commands:WATCH"},
}
