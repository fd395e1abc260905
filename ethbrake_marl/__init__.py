"""Research environment for ethical emergency braking: exact physics, multi-agent, with a shield whose bound holds."""

from __future__ import annotations

__version__ = "0.1.0"
