"""What every test of a refusal says: the class, and the part of the message that tells what, where and what is right.

A table of refusals has the message as its key, so that no two examples show the same one, and what is done as its
value.
"""

import re

import pytest

from ethbrake_marl.errors import EthBrakeError, InvalidInput


def refused(message: str, error: type[EthBrakeError] = InvalidInput) -> pytest.RaisesExc[EthBrakeError]:
    """The block must raise ``error`` with ``message`` in its text."""
    return pytest.raises(error, match=re.escape(message))
