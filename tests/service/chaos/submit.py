"""A whole job by the Python client: submit.py URL FILE REQUEST_ID OUT.

Ends with 3 when nobody answers at the first call, as the command line does: whoever started it may try again.
"""

import sys
from pathlib import Path

import lookalike
from lookalike.spec import simplify_spec


def main(url: str, file: str, request_id: str, out: str) -> None:
    """What JOB of tests/service/support.rs asks for."""
    looks = {"n_views": 12, "image_size": 128, "effort": "fast", "seed": 7}
    balance = {"surface_weight": 0.3, "optimize_max_evaluations": 3000}
    work = simplify_spec([500, 200], **looks, **balance)
    with lookalike.Client(url, patience_secs=120) as client:
        mesh = client.upload(Path(file))
        job = client.create(mesh, Path(file).name, work, request_id=request_id).name
        events = list(client.watch(job))
        assert [event.seq for event in events] == list(range(1, len(events) + 1))
        client.fetch(job, out)


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except lookalike.Unreachable as error:
        print(error, file=sys.stderr)
        sys.exit(3)
