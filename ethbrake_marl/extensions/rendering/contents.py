"""Contents of this extension: group -> name -> module of this folder and object."""

CONTENTS = {
    "renderers": {"rgb_array": "viewer:Viewer", "ansi": "viewer:Words", "human": "viewer:Window"},
    "commands": {"watch": "commands:WATCH"},
}
