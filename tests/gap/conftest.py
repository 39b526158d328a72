"""Every report that a test of the diagnosis makes keeps the rules of reports."""

import pytest


@pytest.fixture(scope="session", autouse=True)
def _keeping_rules(ruled_reports):
    pass
