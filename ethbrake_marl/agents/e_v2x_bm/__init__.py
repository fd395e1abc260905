"""E-V2X-BM: the constant deceleration of least harm, in closed form and in the engine's physics."""
