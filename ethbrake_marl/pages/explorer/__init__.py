"""The explorer: a local page whose sliders set one world, and the server that lets every agent drive in it."""
