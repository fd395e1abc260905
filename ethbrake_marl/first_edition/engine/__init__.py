"""The engine, which runs many episodes of one scenario side by side, and draws the worlds of new episodes."""
