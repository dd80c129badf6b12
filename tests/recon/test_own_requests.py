"""A page of a stranger's in the same browser gets no answer, by whatever name it asks; a page of the server's own does."""

import socket

import pytest

from recon import own_requests
from recon.own_requests import LOOPBACK, is_own

ALL, NAME = "0.0.0.0", "rig.clinic"


@pytest.fixture(autouse=True)
def named(monkeypatch):
    monkeypatch.setattr(socket, "getfqdn", lambda: NAME)
    own_requests.own_names.cache_clear()
    yield
    own_requests.own_names.cache_clear()


@pytest.mark.parametrize(
    ("host", "origin", "listens"),
    [
        ("127.0.0.1:8080", None, LOOPBACK),
        ("localhost:8080", None, LOOPBACK),
        ("localhost", None, LOOPBACK),
        ("LOCALHOST:8080", "http://localhost:8080", LOOPBACK),
        ("[::1]:8080", "http://[::1]:8080", "::1"),
        ("localhost:9000", "http://localhost:9000", LOOPBACK),  # through a tunnel to another port
        ("localhost:8080", "http://localhost:8080", ALL),
        ("rig.clinic:8080", "http://rig.clinic:8080", ALL),
        ("rig.clinic", "https://rig.clinic", ALL),
        ("192.168.0.4:8080", "http://192.168.0.4:8080", ALL),
        ("192.168.0.4:8080", None, "192.168.0.4"),
    ],
)
def test_own_pages_and_other_programs_are_answered(host, origin, listens):
    """By this computer's names and, where it listens to a network, by its name and numbers there."""
    assert is_own([host], [] if origin is None else [origin], listens)


@pytest.mark.parametrize(
    ("hosts", "origins", "listens"),
    [
        (["rebound.example:8080"], [], LOOPBACK),  # a stranger's name that leads here
        (["rebound.example:8080"], [], ALL),
        (["rebound.example:8080"], ["http://rebound.example:8080"], ALL),
        (["rebound.example:8080"], ["http://rebound.example:8080"], "127.0.1.1"),
        (["127.0.0.1.rebound.example"], [], ALL),
        (["cafe:8080"], ["http://cafe:8080"], ALL),  # a word of hexadecimal digits
        (["192.168.0.4:8080"], [], LOOPBACK),
        (["localhost:8080"], ["https://example.org"], LOOPBACK),  # a stranger's page that asks here
        (["localhost:8080"], ["http://localhost:9000"], LOOPBACK),  # that of another program on this computer
        (["localhost:8080"], ["null"], LOOPBACK),  # in a frame without an origin
        (["localhost:8080"], ["http://localhost:8080", "https://example.org"], LOOPBACK),
        (["192.168.0.4:8080"], ["http://rig.clinic:8080"], ALL),
        (["localhost:8080", "localhost:8080"], [], LOOPBACK),
        ([], [], LOOPBACK),
        ([""], [], LOOPBACK),
        (["["], ["http://["], LOOPBACK),
        (["["], [], LOOPBACK),
    ],
)
def test_pages_of_strangers_are_not(hosts, origins, listens):
    assert not is_own(hosts, origins, listens)
