"""The real server, for the tests that need one."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

import lookalike

ROOT = Path(__file__).resolve().parents[3]
BINARY = Path(
    os.environ.get("LOOKALIKE_BIN") or ROOT / "target" / "release" / "lookalike"
).resolve()
DEVICE = os.environ.get("LOOKALIKE_DEVICE") or "cpu"


def new_server(folder: Path) -> lookalike.Server:
    """A server that is not started yet; its data and log are in `folder`."""
    # Leases of seconds, not of half a minute: a killed server is part of the tests.
    flags = ["--lease-secs=4", "--heartbeat-secs=1"]
    return lookalike.Server(folder / "data", BINARY, device=DEVICE, flags=flags)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[lookalike.Server]:
    """A server with one worker, for all tests of a module."""
    with new_server(tmp_path_factory.mktemp("server")) as server:
        yield server


@pytest.fixture
def client(server: lookalike.Server) -> Iterator[lookalike.Client]:
    """A client of the server."""
    with lookalike.Client(server.url) as client:
        yield client
