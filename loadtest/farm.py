"""An asset farm in miniature: many jobs at once on one server, and every result checked.

    python loadtest/farm.py --binary target/release/lookalike --jobs 40 --in-flight 8 --kills 4

Each of `--shapes` generated meshes is submitted several times. Every job must succeed, with a log
that has no gap, levels that are sound GLBs of at most the triangles asked for and load in trimesh,
and the same bytes as every other job of the same mesh. `--kills` kills the server or a worker with
-9 at random moments. Ends with 0 only when nothing was wrong; never takes much longer than
`--max-secs`.
"""

import argparse
import contextlib
import ipaddress
import json
import os
import random
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import trimesh
from blake3 import blake3

import glb
import lookalike
import shapes
from lookalike.models import load_glb
from lookalike.spec import simplify_spec


@dataclass
class Done:
    """One job that came back."""

    shape: int
    job: str
    #: From the upload to the end of the log.
    latency_secs: float
    triangles: list[int]
    #: BLAKE3 of the levels and the records, which must not depend on anything but the mesh.
    digest: str
    restarts: int


@dataclass
class Report:
    """What the farm found."""

    jobs: int
    in_flight: int
    seconds: float = 0.0
    faults: list[str] = field(default_factory=list)
    done: list[Done] = field(default_factory=list)

    def summary(self) -> dict[str, object]:
        """The figures."""
        figures: dict[str, object] = {
            "jobs": self.jobs,
            "in_flight": self.in_flight,
            "checked": len(self.done),
            "shapes": len({done.shape for done in self.done}),
            "restarts": sum(done.restarts for done in self.done),
            "seconds": round(self.seconds, 3),
            "jobs_per_second": round(len(self.done) / self.seconds, 3),
        }
        latencies = [done.latency_secs for done in self.done]
        for percent in (50, 90, 99, 100) if latencies else ():
            latency = float(np.percentile(latencies, percent))
            figures[f"latency_p{percent}_secs"] = round(latency, 3)
        return figures | {"faults": self.faults}


def one(client: lookalike.Client, args: argparse.Namespace, number: int) -> Done:
    """Submits a job, follows it, checks its result. Raises what is wrong."""
    shape = number % args.shapes
    content = shapes.shape(shape, args.seed, args.size)
    start = time.monotonic()
    request_id = f"farm-{args.seed}-{args.started}-{number}"
    options = {"method": args.method, "effort": args.effort, "seed": args.seed}
    work = simplify_spec(args.triangles, n_views=args.views, image_size=args.image_size, **options)
    mesh = client.upload(content, f"shape-{shape}.glb")
    job = client.create(mesh, f"shape-{shape}.glb", work, request_id=request_id).name
    again = client.create(mesh, f"shape-{shape}.glb", work, request_id=request_id).name
    if again != job:
        raise AssertionError(f"the same request made {job} and {again}")
    # The client itself raises at a gap in the log.
    kinds = [event.WhichOneof("body") for event in client.watch(job)]
    latency_secs = time.monotonic() - start
    end = client.job(job)
    if end.failure.reason:
        raise lookalike.JobFailed(job, end.failure.reason, end.failure.text)
    triangles, digest = check_files(client, job, args.triangles)
    return Done(shape, job, latency_secs, triangles, digest, kinds.count("attempt_restarted"))


def check_files(client: lookalike.Client, job: str, targets: list[int]) -> tuple[list[int], str]:
    """Triangles of the levels of a job, and a digest of all that must be reproducible."""
    artifacts = {artifact.name.rpartition("/")[2]: artifact for artifact in client.artifacts(job)}
    hasher, found = blake3(), []
    for i, target in enumerate(targets):
        name = f"lod-{i}.glb"
        content = client.read(artifacts[name])
        n_triangles = glb.n_triangles(content)
        n_loaded = len(load_glb(content, like=trimesh.Trimesh).faces)
        if not 0 < n_triangles <= target or n_loaded != n_triangles:
            text = f"{n_triangles} triangles ({n_loaded} in trimesh), not {target}"
            raise AssertionError(f"{name}: {text}")
        found.append(n_triangles)
        hasher.update(content)
    hasher.update(client.read(artifacts["progressive.lkpm"]))
    return found, hasher.hexdigest()


def farm(client: lookalike.Client, args: argparse.Namespace) -> Report:
    """Runs all jobs, `in_flight` at a time, until all are done or the time is up."""
    report = Report(args.jobs, args.in_flight)
    start = time.monotonic()
    pool = ThreadPoolExecutor(args.in_flight)
    futures = {pool.submit(one, client, args, number): number for number in range(args.jobs)}
    try:
        for future in as_completed(futures, timeout=args.max_secs):
            take(report, future, futures[future])
    except TimeoutError:
        late = [number for future, number in futures.items() if not future.done()]
        report.faults.append(f"{len(late)} jobs were not done after {args.max_secs} s")
        # Calls at work end with an error; those that wait never begin.
        client.close()
    pool.shutdown(cancel_futures=True)
    report.seconds = time.monotonic() - start
    report.faults += differences(report.done)
    return report


def take(report: Report, future: Future[Done], number: int) -> None:
    """Notes how a job ended."""
    error = future.exception()
    if error is None:
        report.done.append(future.result())
    else:
        report.faults.append(f"job {number}: {type(error).__name__}: {error}")
    n_ended = len(report.done) + len(report.faults)
    print(f"\r{n_ended} of {report.jobs}, {len(report.faults)} faults", end="", file=sys.stderr)


def differences(done: list[Done]) -> list[str]:
    """Jobs of the same mesh whose results differ."""
    first: dict[int, Done] = {}
    texts = []
    for job in sorted(done, key=lambda job: job.job):
        other = first.setdefault(job.shape, job)
        if job.digest != other.digest:
            texts.append(f"{other.job} and {job.job}: the same mesh, other bytes")
    return texts


@contextlib.contextmanager
def own_server(args: argparse.Namespace) -> Iterator[str]:
    """A server of the farm's own, which may be killed."""
    # Short leases, so that a killed worker's job soon starts over, as often as it takes.
    flags = ["--lease-secs=4", "--heartbeat-secs=1", "--drain-secs=2"]
    flags += [f"--max-attempts={args.kills + 3}"]
    with tempfile.TemporaryDirectory() as folder:
        server = lookalike.Server(
            Path(folder) / "data",
            args.binary,
            workers=args.workers,
            device=args.device,
            flags=flags,
        )
        over = threading.Event()
        with server:
            killer = threading.Thread(target=kill_by_turns, args=(server, args, over))
            killer.start()
            try:
                yield server.url
            finally:
                over.set()
                killer.join()


def kill_by_turns(
    server: lookalike.Server, args: argparse.Namespace, over: threading.Event
) -> None:
    """Kills the server and one of its workers by turns, at random moments, until it is `over`."""
    rng = random.Random(args.seed)
    for n_killed in range(args.kills):
        if over.wait(rng.uniform(0.2, 2.0)):
            print(f"\nonly {n_killed} of {args.kills} kills: all jobs were done", file=sys.stderr)
            return
        if n_killed % 2 == 0:
            server.kill()
            server.start()
        elif workers := server.workers():
            # It may have ended by itself just now.
            with contextlib.suppress(ProcessLookupError):
                os.kill(rng.choice(workers), signal.SIGKILL)


def loopback(url: str) -> str:
    """A URL on this machine: the farm is no weapon."""
    host = urlsplit(url).hostname or ""
    with contextlib.suppress(ValueError):
        if host == "localhost" or ipaddress.ip_address(host).is_loopback:
            return url
    raise argparse.ArgumentTypeError(f"{url} is not on this machine: use http://127.0.0.1:PORT")


def bounded(low: int, high: int) -> Callable[[str], int]:
    """A reader of whole numbers between two bounds."""

    def read(text: str) -> int:
        number = int(text)
        if not low <= number <= high:
            raise argparse.ArgumentTypeError(f"{number}: use {low} to {high}")
        return number

    return read


def parser() -> argparse.ArgumentParser:
    """The command line."""
    flags = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    where = flags.add_mutually_exclusive_group(required=True)
    where.add_argument("--server", type=loopback, metavar="URL", help="a server on this machine")
    where.add_argument("--binary", metavar="PATH", help="start a server of this program")
    flags.add_argument("--workers", type=bounded(1, 64), default=1, help="of one's own server")
    flags.add_argument("--device", default="cpu", help="of one's own server")
    flags.add_argument("--kills", type=bounded(0, 1000), default=0, help="of one's own server")
    flags.add_argument("--jobs", type=bounded(1, 10_000), default=24, metavar="N")
    flags.add_argument("--in-flight", type=bounded(1, 200), default=8, metavar="N")
    flags.add_argument("--shapes", type=bounded(1, 10_000), default=8, help="different meshes")
    flags.add_argument("--size", type=bounded(200, 1_000_000), default=4000, help="triangles")
    flags.add_argument("--triangles", type=bounded(1, 1_000_000), nargs="+", default=[400, 100])
    flags.add_argument("--method", choices=["image", "memoryless"], default="image")
    flags.add_argument("--effort", choices=["fast", "balanced", "best"], default="fast")
    flags.add_argument("--views", type=int, default=4)
    flags.add_argument("--image-size", type=int, default=64)
    flags.add_argument("--seed", type=int, default=0)
    flags.add_argument("--max-secs", type=bounded(1, 86_400), default=600)
    flags.add_argument("--report", type=Path, help="where to write everything as JSON")
    return flags


def main() -> int:
    """Runs the farm; 0 when nothing was wrong."""
    args = parser().parse_args()
    if args.kills and not args.binary:
        parser().error("--kills needs a server of one's own: use --binary")
    # Names the requests of this run, so that a long-lived server does not answer from the last one.
    args.started = time.time_ns()
    where = own_server(args) if args.binary else contextlib.nullcontext(args.server)
    with where as url, lookalike.Client(url) as client:
        report = farm(client, args)
    print(f"\n{json.dumps(report.summary(), indent=2)}")
    if args.report:
        args.report.write_text(json.dumps(asdict(report), indent=2))
    return 1 if report.faults or len(report.done) != args.jobs else 0


if __name__ == "__main__":
    sys.exit(main())
