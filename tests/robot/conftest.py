"""Fixtures of the guidance tests."""

import pytest
from guided_process import write_hand


@pytest.fixture(scope="session")
def hand_film(tmp_path_factory):
    """A recording of a hand that points at one place and then at another."""
    folder = tmp_path_factory.mktemp("hand")
    write_hand(folder, 7.5)
    return folder
