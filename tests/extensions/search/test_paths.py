"""A policy in a folder of any name, searched around."""

import pytest

from tests.first_edition.agents.test_paths import NAMES, check_folder


@pytest.mark.usefixtures("empty_folder")
@pytest.mark.parametrize("name", NAMES)
def test_policy__in_a_folder_of_any_name_is_that_folder_with_a_search_around_it(name):
    for folder in ("", "runs/", "runs/2+3,4/"):
        check_folder(folder + name, ("+search", "+search+step"))
