"""Fixtures of the devices' tests."""

import pytest

from tests.recon.devices.lit_scene import Clock


@pytest.fixture
def clock(monkeypatch):
    """A time of the test's own."""
    return Clock(monkeypatch)
