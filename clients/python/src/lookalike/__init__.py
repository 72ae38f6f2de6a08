"""Levels of detail that look alike: a thin client of the Lookalike service.

    import lookalike, trimesh

    client = lookalike.Client("http://127.0.0.1:7420")
    run = client.simplify(trimesh.load("bunny.ply"), triangles=[8000, 2000, 500])
    for event in run:                  # lookalike.v1.event_pb2.JobEvent, with a progress bar
        ...
    result = run.result()              # waits, fetches: result.lods, result.report
    lookalike.plot_energy(run.samples, "energy.png")

`client.py` makes calls that survive a restart of the server; `run.py` follows one job; `models.py`
turns meshes into bytes and back; `spec.py` turns keywords into a specification; `curve.py` keeps
and draws the energy; `errors.py` is everything that can go wrong; `server.py` runs a server of
one's own. The messages themselves are generated into `lookalike.v1`.
"""

from lookalike.client import Client
from lookalike.curve import Sample, plot_energy
from lookalike.errors import (
    Damaged,
    JobCancelled,
    JobFailed,
    LookalikeError,
    ProtocolFault,
    Refused,
    ServerNotStarted,
    Unreachable,
)
from lookalike.run import Result, Run
from lookalike.server import Server

__all__ = [
    "Client",
    "Damaged",
    "JobCancelled",
    "JobFailed",
    "LookalikeError",
    "ProtocolFault",
    "Refused",
    "Result",
    "Run",
    "Sample",
    "Server",
    "ServerNotStarted",
    "Unreachable",
    "plot_energy",
]
