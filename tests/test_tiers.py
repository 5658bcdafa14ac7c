"""What holds for the tiers of tests themselves."""

import os

import pytest


@pytest.mark.slow
def test_long_tests_run_what_users_run():
    """Trainings and whole plates take minutes in programs that were compiled for quick tests."""
    assert "backend_optimization_level" not in os.environ.get("XLA_FLAGS", "")
