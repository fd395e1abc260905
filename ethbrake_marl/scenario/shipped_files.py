"""Where the files are that come with the package: in a checkout, or inside the installed package."""

from __future__ import annotations

from pathlib import Path

from ethbrake_marl.errors import InvalidInput

_PACKAGE = Path(__file__).resolve().parents[1]


def shipped_folder(folder: str, meaning: str) -> Path:
    """The checkout's ``folder``, or the copy inside an installed package.

    Raises ``InvalidInput``, in which ``meaning`` says what is missing, when neither is there: the installation is
    damaged.
    """
    checkout, installed = _PACKAGE.parent / folder, _PACKAGE / "_data" / folder
    if (_PACKAGE.parent / "pyproject.toml").is_file() and checkout.is_dir():
        return checkout
    if not installed.is_dir():
        raise InvalidInput(f"the shipped {meaning} are missing: neither {checkout} nor {installed} exists; reinstall")
    return installed
