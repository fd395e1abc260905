"""What every test of a refusal asserts: the class, and the part of the message that says what, where and what is right.

A table of refusals maps the message to the call, so that no two examples show the same message.
"""

import re

import pytest

from ethbrake_marl.errors import EthBrakeError, InvalidInput


def refused(message: str, error: type[EthBrakeError] = InvalidInput) -> pytest.RaisesExc[EthBrakeError]:
    """The block must raise ``error`` with ``message`` in its text."""
    return pytest.raises(error, match=re.escape(message))
