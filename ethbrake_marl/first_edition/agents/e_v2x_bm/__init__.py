"""E-V2X-BM: the constant deceleration of least harm, in closed form or by simulation with the engine's physics."""
