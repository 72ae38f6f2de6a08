"""The connection: calls that survive a restart of the server, streams that go on where they broke.

1. An answer of a server (it carries an ErrorInfo) is final; a broken connection is tried again with
   growing pauses, as long as the server has answered before and is away less than `patience_secs`.
2. Every call may be repeated: uploads are named by their content, jobs by their `request_id`.
3. A watched log has no gaps: each event's number is one more than that of the event before.
"""

from __future__ import annotations

import os
import time
import uuid
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import grpc
import trimesh
from blake3 import blake3

from lookalike import access, errors, models, spec
from lookalike.run import Run
from lookalike.v1 import event_pb2, job_pb2
from lookalike.v1 import lookalike_service_pb2 as api
from lookalike.v1.lookalike_service_pb2_grpc import LookalikeServiceStub

T = TypeVar("T")

FINAL = (job_pb2.JOB_STATE_SUCCEEDED, job_pb2.JOB_STATE_FAILED, job_pb2.JOB_STATE_CANCELLED)

_CHANNEL = (
    # As much as a server may send: a large chunk of records, and room to spare.
    ("grpc.max_receive_message_length", 16 << 20),
    ("grpc.keepalive_time_ms", 20_000),
    ("grpc.keepalive_timeout_ms", 20_000),
    # A server that restarts is back within a second; the default waits up to two minutes.
    ("grpc.initial_reconnect_backoff_ms", 100),
    ("grpc.min_reconnect_backoff_ms", 100),
    ("grpc.max_reconnect_backoff_ms", 2_000),
    # A proxy of the environment is meant for the web, not for a server on this machine.
    ("grpc.enable_http_proxy", 0),
)


class Client:
    """A Lookalike server.

    `url` is where it listens; `patience_secs` is how long a server that answered once may be away
    before calls give up. May be used by several threads. Connects when first used.

    A server that asks who calls wants a `token` (default: LOOKALIKE_TOKEN of the environment). For
    https:// addresses, `ca` is the file of the authority of its certificate (default: those that
    gRPC trusts), `cert` and `key` are the files of a certificate of one's own; all in PEM.
    """

    def __init__(
        self,
        url: str = "http://127.0.0.1:7420",
        *,
        patience_secs: float = 60.0,
        token: str | None = None,
        ca: str | os.PathLike[str] | None = None,
        cert: str | os.PathLike[str] | None = None,
        key: str | os.PathLike[str] | None = None,
    ) -> None:
        self.url = url
        self.patience_secs = patience_secs
        self._has_answered = False
        self._channel = access.channel(url, _CHANNEL, ca=ca, cert=cert, key=key)
        token = token or os.environ.get("LOOKALIKE_TOKEN")
        self._stub = LookalikeServiceStub(access.saying_who(self._channel, token))

    def simplify(
        self,
        model: models.Model,
        triangles: int | Iterable[int] = (),
        *,
        file_name: str | None = None,
        request_id: str | None = None,
        labels: Mapping[str, str] | None = None,
        progress: bool = True,
        **options: Any,
    ) -> Run:
        """Uploads `model`, creates a job for levels of `triangles` each, and follows it.

        The model is a trimesh object, a path, or bytes with their `file_name`. `request_id` names
        this request: the same again finds the job it made; `labels` are what to call the job by (see
        `jobs`). Levels may be given by `ratios` (shares
        of the model's triangles), `max_d2`, `screen_size` (pixels) or `max_bytes` as well or instead,
        one value a level. Other keywords are the fields of SimplifySpec and RenderSpec, such as
        method="image", effort="fast", lock="border", n_views=20, seed=0, and those of Optimization
        behind `optimize_`, such as optimize_max_evaluations=0.
        """
        # Before the upload, so that a misspelt option costs nothing.
        work = spec.simplify_spec(triangles, **options)
        source = models.source(model, file_name)
        mesh = self.upload(source)
        job = self.create(mesh, source.file_name, work, request_id=request_id, labels=labels)
        like = trimesh.Trimesh if isinstance(model, trimesh.Trimesh) else trimesh.Scene
        return Run(self, job.name, progress=progress, like=like)

    def optimize(
        self,
        original: models.Model,
        simplified: models.Model,
        *,
        file_name: str | None = None,
        simplified_file_name: str | None = None,
        request_id: str | None = None,
        labels: Mapping[str, str] | None = None,
        progress: bool = True,
        **options: Any,
    ) -> Run:
        """Makes `simplified`, which any tool made of `original`, look more like it.

        Keywords are the fields of OptimizeSpec, of its optimization (`optimize_max_evaluations=...`,
        `optimize_until=0.5`) and of RenderSpec; everything else is as in `simplify`.
        """
        spec.optimize_spec("", "", **options)  # as above: before the uploads
        source = models.source(original, file_name)
        crude = models.source(simplified, simplified_file_name)
        mesh = self.upload(source)
        work = spec.optimize_spec(self.upload(crude), crude.file_name, **options)
        job = self.create(mesh, source.file_name, work, request_id=request_id, labels=labels)
        like = trimesh.Trimesh if isinstance(simplified, trimesh.Trimesh) else trimesh.Scene
        return Run(self, job.name, progress=progress, like=like)

    def evaluate(
        self,
        original: models.Model,
        simplified: models.Model,
        *,
        file_name: str | None = None,
        simplified_file_name: str | None = None,
        request_id: str | None = None,
        labels: Mapping[str, str] | None = None,
        progress: bool = True,
        **options: Any,
    ) -> Run:
        """Tells how much `simplified` looks like `original`: `run.result().comparison`.

        d2 of pictures in 24 views that no job works with, and the distance between the surfaces, as
        by `lookalike compare`. Keywords are the fields of EvaluateSpec, such as shading="smooth",
        colours=True, distance=False; everything else is as in `simplify`.
        """
        spec.evaluate_spec("", "", **options)  # as above: before the uploads
        source = models.source(original, file_name)
        crude = models.source(simplified, simplified_file_name)
        mesh = self.upload(source)
        work = spec.evaluate_spec(self.upload(crude), crude.file_name, **options)
        job = self.create(mesh, source.file_name, work, request_id=request_id, labels=labels)
        return Run(self, job.name, progress=progress)

    def upload(self, model: models.Model | models.Source, file_name: str | None = None) -> str:
        """Stores a model file; its name, `meshes/{hash}`. What is there is not sent again."""
        source = model if isinstance(model, models.Source) else models.source(model, file_name)

        # What is small is sent as a whole.
        upload_id = uuid.uuid4().hex if source.size > models.CHUNK else ""

        def parts(offset: int) -> Iterator[api.UploadMeshRequest]:
            header = api.UploadMeshHeader(
                size=source.size, blake3=source.hash, upload_id=upload_id, offset=offset
            )
            yield api.UploadMeshRequest(header=header)
            for chunk in source.chunks(offset):
                yield api.UploadMeshRequest(chunk=chunk)

        def send() -> api.UploadMeshResponse:
            offset = 0
            if upload_id:
                # Where it broke off, or all that is there.
                query = api.QueryUploadRequest(mesh=f"meshes/{source.hash}", upload_id=upload_id)
                answer = self._call(lambda: self._stub.QueryUpload(query))
                offset = min(answer.held, source.size)
            try:
                return self._stub.UploadMesh(parts(offset))
            except grpc.RpcError as error:
                # Another server answers, which holds less of it: all of it is right for any.
                if offset == 0 or error.code() != grpc.StatusCode.OUT_OF_RANGE:
                    raise
                return self._stub.UploadMesh(parts(0))

        return self._call(send).mesh

    def create(
        self,
        mesh: str,
        file_name: str,
        work: spec.Work,
        *,
        request_id: str | None = None,
        labels: Mapping[str, str] | None = None,
    ) -> job_pb2.Job:
        """Queues a job for an uploaded mesh; `labels` are what to call it by, to find it again."""
        request = api.CreateJobRequest(
            request_id=request_id or str(uuid.uuid4()),
            mesh=mesh,
            file_name=file_name,
            spec=spec.job_spec(work),
            labels=labels or {},
        )
        return self._call(lambda: self._stub.CreateJob(request)).job

    def run(self, job: str, *, progress: bool = True) -> Run:
        """Follows a job that exists, from the beginning of its log."""
        return Run(self, self.job(job).name, progress=progress)

    def job(self, job: str) -> job_pb2.Job:
        """A job, by `jobs/{id}` or the bare id."""
        request = api.GetJobRequest(name=_job_name(job))
        return self._call(lambda: self._stub.GetJob(request)).job

    def jobs(
        self, *states: str, labels: Mapping[str, str] | None = None
    ) -> Iterator[job_pb2.Job]:
        """All jobs in one of `states` ("queued", "running", ...; none means all) that have all of
        `labels`, newest first."""
        kind = job_pb2.JobState.DESCRIPTOR
        numbers: Any = [spec.enum_value(kind, state) for state in states]
        wanted = [f"{key}={value}" for key, value in (labels or {}).items()]
        request = api.ListJobsRequest(states=numbers, labels=wanted)
        while True:
            page = self._call(lambda: self._stub.ListJobs(request))
            yield from page.jobs
            if not page.next_page_token:
                return
            request.page_token = page.next_page_token

    def watch(self, job: str, after_seq: int = 0) -> Generator[event_pb2.JobEvent, None, None]:
        """The events of a job after `after_seq`, until its state is final."""
        name = _job_name(job)
        patience = _Patience(self)
        while True:
            stream = self._stub.WatchJob(api.WatchJobRequest(name=name, after_seq=after_seq))
            try:
                for answer in stream:
                    if answer.event.seq != after_seq + 1:
                        raise errors.ProtocolFault(
                            f"{name}: event {answer.event.seq} follows event {after_seq}: "
                            "run server and client of the same version"
                        )
                    after_seq += 1
                    patience.reset()
                    yield answer.event
                return
            except grpc.RpcError as error:
                patience.after(error)
            finally:
                stream.cancel()

    def cancel(self, job: str, *, wait: bool = True) -> job_pb2.Job:
        """Cancels a job; by default returns when that, or another end, is confirmed."""
        request = api.CancelJobRequest(name=_job_name(job))
        answer = self._call(lambda: self._stub.CancelJob(request)).job
        while wait and answer.state not in FINAL:
            time.sleep(0.1)
            answer = self.job(job)
        return answer

    def retry(self, job: str) -> job_pb2.Job:
        """Queues a job anew that failed or was cancelled; one that waits or runs is left alone."""
        request = api.RetryJobRequest(name=_job_name(job))
        return self._call(lambda: self._stub.RetryJob(request)).job

    def delete(self, job: str, *, missing_ok: bool = False) -> None:
        """Deletes a job that has ended, with its log and files."""
        request = api.DeleteJobRequest(name=_job_name(job), allow_missing=missing_ok)
        self._call(lambda: self._stub.DeleteJob(request))

    def artifacts(self, job: str) -> list[job_pb2.Artifact]:
        """The files of a job that has ended, by name; empty before."""
        request = api.ListArtifactsRequest(parent=_job_name(job))
        files: list[job_pb2.Artifact] = []
        while True:
            page = self._call(lambda: self._stub.ListArtifacts(request))
            files.extend(page.artifacts)
            if not page.next_page_token:
                return files
            request.page_token = page.next_page_token

    def read(self, artifact: job_pb2.Artifact) -> bytes:
        """The bytes of a file."""
        return b"".join(self.stream(artifact))

    def stream(self, artifact: job_pb2.Artifact) -> Iterator[bytes]:
        """The bytes of a file as they arrive; raises Damaged at the end when they are others."""
        patience = _Patience(self)
        hasher, n_read = blake3(), 0
        while True:
            request = api.ReadArtifactRequest(name=artifact.name, offset=n_read)
            stream = self._stub.ReadArtifact(request)
            try:
                for answer in stream:
                    patience.reset()
                    hasher.update(answer.data)
                    n_read += len(answer.data)
                    yield answer.data
                break
            except grpc.RpcError as error:
                patience.after(error)
            finally:
                stream.cancel()
        if hasher.hexdigest() != artifact.blake3:
            raise errors.Damaged(f"{artifact.name} arrived damaged: fetch it again")

    def fetch(self, job: str, folder: str | os.PathLike[str]) -> list[Path]:
        """Writes every file of a job that has ended into `folder`; their paths."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        paths = []
        for artifact in self.artifacts(job):
            path = folder / models.file_of(artifact)
            # Under its name only when it is whole.
            part = path.with_name(f".{path.name}.part")
            with part.open("wb") as file:
                file.writelines(self.stream(artifact))
            part.replace(path)
            paths.append(path)
        return paths

    def close(self) -> None:
        """Closes the connection."""
        self._channel.close()

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _call(self, call: Callable[[], T]) -> T:
        """Calls until the server answers."""
        patience = _Patience(self)
        while True:
            try:
                answer = call()
            except grpc.RpcError as error:
                patience.after(error)
            else:
                patience.reset()
                return answer


class _Patience:
    """How long a server may be away during one call."""

    FIRST_PAUSE_SECS = 0.05
    LONGEST_PAUSE_SECS = 2.0

    def __init__(self, client: Client) -> None:
        self._client = client
        self._silent_since: float | None = None
        self._pause_secs = self.FIRST_PAUSE_SECS

    def reset(self) -> None:
        """The server answered."""
        self._client._has_answered = True
        self._silent_since = None
        self._pause_secs = self.FIRST_PAUSE_SECS

    def after(self, error: grpc.RpcError) -> None:
        """Waits after a failed call, unless another one is pointless: then raises."""
        answer = errors.Answer.read(error)
        self._client._has_answered |= bool(answer.reason)
        if not answer.is_transient:
            raise errors.Refused(answer) from error
        now = time.monotonic()
        self._silent_since = self._silent_since or now
        # A server that never answered is more likely not there than about to come back.
        patience_secs = self._client.patience_secs if self._client._has_answered else 0.0
        if now - self._silent_since >= patience_secs:
            raise errors.unreachable(self._client.url, answer.text) from error
        time.sleep(self._pause_secs)
        self._pause_secs = min(2 * self._pause_secs, self.LONGEST_PAUSE_SECS)


def _job_name(job: str) -> str:
    return job if job.startswith("jobs/") else f"jobs/{job}"
