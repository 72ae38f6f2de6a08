"""The package against a scripted server in this process: what a sound server never does."""

import json
import random
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import grpc
import pytest
from blake3 import blake3
from google.protobuf import any_pb2
from google.rpc import code_pb2, error_details_pb2, status_pb2
from grpc_status import rpc_status

import lookalike
from lookalike.curve import Sample
from lookalike.models import CHUNK
from lookalike.spec import evaluate_spec, job_spec, optimize_spec, simplify_spec
from lookalike.v1 import event_pb2, job_pb2, spec_pb2
from lookalike.v1 import lookalike_service_pb2 as api
from lookalike.v1.lookalike_service_pb2_grpc import (
    LookalikeServiceServicer,
    add_LookalikeServiceServicer_to_server,
)

JOB = "jobs/1"


def events() -> list[event_pb2.JobEvent]:
    """A log in which the first attempt is lost after two samples."""
    succeeded = event_pb2.StateChanged(state=job_pb2.JOB_STATE_SUCCEEDED, reason="COMPLETED")
    bodies = [
        {"state_changed": event_pb2.StateChanged(state=job_pb2.JOB_STATE_QUEUED)},
        {"energy_sample": event_pb2.EnergySample(stage="image", evaluations=1, triangles=9, d2=1)},
        {"energy_sample": event_pb2.EnergySample(stage="image", evaluations=2, triangles=8, d2=2)},
        {"attempt_restarted": event_pb2.AttemptRestarted(rewind_to_seq=1, lost_attempt=1)},
        {"note": event_pb2.Note(code="READ", text="read again")},
        {"energy_sample": event_pb2.EnergySample(stage="image", evaluations=1, triangles=9, d2=3)},
        {"progress": event_pb2.Progress(stage="image", fraction=0.9, eta_secs=2)},
        {"state_changed": succeeded},
    ]
    return [event_pb2.JobEvent(seq=i + 1, **body) for i, body in enumerate(bodies)]


class Scripted(LookalikeServiceServicer):
    """Answers from what a test puts into it."""

    def __init__(self) -> None:
        self.log = events()
        #: Streams break after so many messages; one number a stream, then none breaks.
        self.breaks: list[int] = []
        self.asked_after: list[int] = []
        self.asked_offset: list[int] = []
        self.content = bytes(range(256)) * 40
        self.received: list[bytes] = []
        #: An upload breaks once when so many bytes are there.
        self.breaks_at: int | None = None
        #: What is held of broken uploads, by name, and where uploads began.
        self.held: dict[str, bytes] = {}
        self.offsets: list[int] = []
        #: QueryUpload says that so much more is held.
        self.boast = 0
        self.goodbye: status_pb2.Status | None = None
        #: Of the job.
        self.spec = job_spec(simplify_spec(1))
        #: The names of its files, which all have the same content.
        self.files = ["energy.csv"]
        self.lock = threading.Lock()
        #: What calls said of who makes them.
        self.callers: list[str | None] = []

    def _until_it_breaks(self, messages: list, context: grpc.ServicerContext) -> Iterator:
        with self.lock:
            n_sent = self.breaks.pop(0) if self.breaks else len(messages) + 1
        yield from messages[:n_sent]
        if n_sent <= len(messages):
            if self.goodbye is not None:
                context.abort_with_status(rpc_status.to_status(self.goodbye))
            context.abort(grpc.StatusCode.UNAVAILABLE, "connection reset")

    def GetJob(self, request, context):
        self.callers.append(dict(context.invocation_metadata()).get("authorization"))
        if request.name != JOB:
            context.abort_with_status(rpc_status.to_status(answer(code_pb2.NOT_FOUND, "NOT_FOUND")))
        job = job_pb2.Job(name=JOB, state=job_pb2.JOB_STATE_SUCCEEDED)
        job.spec.CopyFrom(self.spec)
        return api.GetJobResponse(job=job)

    def WatchJob(self, request, context):
        self.callers.append(dict(context.invocation_metadata()).get("authorization"))
        self.asked_after.append(request.after_seq)
        rest = [api.WatchJobResponse(event=e) for e in self.log if e.seq > request.after_seq]
        yield from self._until_it_breaks(rest, context)

    def ListArtifacts(self, request, context):
        return api.ListArtifactsResponse(artifacts=[self.artifact(file) for file in self.files])

    def artifact(self, file: str) -> job_pb2.Artifact:
        digest = blake3(self.content).hexdigest()
        return job_pb2.Artifact(name=f"{JOB}/artifacts/{file}", blake3=digest)

    def ReadArtifact(self, request, context):
        self.asked_offset.append(request.offset)
        rest = self.content[request.offset :]
        parts = [rest[i : i + 1000] for i in range(0, len(rest), 1000)]
        answers = [api.ReadArtifactResponse(data=part) for part in parts]
        yield from self._until_it_breaks(answers, context)

    def UploadMesh(self, request_iterator, context):
        self.callers.append(dict(context.invocation_metadata()).get("authorization"))
        header = next(request_iterator).header
        self.offsets.append(header.offset)
        if header.offset > len(self.held.get(header.upload_id, b"")):
            context.abort(grpc.StatusCode.OUT_OF_RANGE, "so many bytes are not held")
        content = self.held.pop(header.upload_id, b"")[: header.offset]
        self.received = []
        for request in request_iterator:
            self.received.append(request.chunk)
            content += request.chunk
            if len(content) == self.breaks_at:
                self.breaks_at = None
                self.held[header.upload_id] = content
                context.abort(grpc.StatusCode.UNAVAILABLE, "the connection broke")
        assert (header.size, header.blake3) == (len(content), blake3(content).hexdigest())
        return api.UploadMeshResponse(mesh=f"meshes/{header.blake3}", size=len(content))

    def QueryUpload(self, request, context):
        held = len(self.held.get(request.upload_id, b"")) + self.boast
        return api.QueryUploadResponse(held=held)

    def CreateJob(self, request, context):
        faults = error_details_pb2.BadRequest()
        faults.field_violations.add(field="spec.simplify.seed", description="use another")
        faults.field_violations.add(field="file_name", description="give it an extension")
        status = answer(code_pb2.INVALID_ARGUMENT, "INVALID", faults)
        context.abort_with_status(rpc_status.to_status(status))


def answer(code: int, reason: str, *details) -> status_pb2.Status:
    """A status as a Lookalike server sends it."""
    status = status_pb2.Status(code=code, message=f"{reason} in words")
    for detail in [error_details_pb2.ErrorInfo(reason=reason, domain="lookalike"), *details]:
        packed = any_pb2.Any()
        packed.Pack(detail)
        status.details.append(packed)
    return status


@pytest.fixture
def scripted() -> Iterator[tuple[Scripted, lookalike.Client]]:
    service, server = Scripted(), grpc.server(ThreadPoolExecutor(4))
    add_LookalikeServiceServicer_to_server(service, server)
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    with lookalike.Client(f"http://127.0.0.1:{port}") as client:
        yield service, client
    server.stop(None).wait()


def test_a_broken_stream_goes_on_after_the_last_event(scripted) -> None:
    service, client = scripted
    service.breaks = [2, 0, 3]
    client.job(JOB)  # a server that has answered is waited for
    assert list(client.watch(JOB)) == events()
    assert service.asked_after == [0, 2, 2, 5]


@pytest.mark.parametrize("reason", ["SHUTTING_DOWN", "AWAY"])
def test_a_server_that_shuts_down_or_has_no_database_is_waited_for(scripted, reason) -> None:
    service, client = scripted
    service.breaks, service.goodbye = [4], answer(code_pb2.UNAVAILABLE, reason)
    assert [event.seq for event in client.watch(JOB)] == list(range(1, 9))


def test_an_answer_is_final(scripted) -> None:
    service, client = scripted
    service.breaks, service.goodbye = [4], answer(code_pb2.UNAVAILABLE, "QUEUE_FULL")
    with pytest.raises(lookalike.Refused, match="QUEUE_FULL in words"):
        list(client.watch(JOB))
    assert service.asked_after == [0]
    with pytest.raises(lookalike.Refused) as refused:
        client.job("2")
    assert (refused.value.reason, refused.value.code) == ("NOT_FOUND", grpc.StatusCode.NOT_FOUND)


@pytest.mark.parametrize("damage", [lambda log: log.pop(3), lambda log: log.insert(3, log[2])])
def test_a_gap_or_a_repetition_in_the_log_is_a_fault(scripted, damage) -> None:
    service, client = scripted
    damage(service.log)
    with pytest.raises(lookalike.ProtocolFault, match=r"event \d follows event 3"):
        list(client.watch(JOB))


def test_a_server_that_never_answered_is_not_waited_for() -> None:
    with lookalike.Client("http://127.0.0.1:1") as client:
        with pytest.raises(lookalike.Unreachable, match="lookalike serve"):
            client.job(JOB)


def test_patience_ends(scripted) -> None:
    service, client = scripted
    client.patience_secs = 0.3
    service.breaks = [0] * 100
    client.job(JOB)
    with pytest.raises(lookalike.Unreachable):
        list(client.watch(JOB))
    assert 2 <= len(service.asked_after) < 20


def test_samples_of_a_lost_attempt_are_dropped(scripted) -> None:
    _, client = scripted
    run = client.run(JOB, progress=False)
    n_samples = [len(run.samples) for _ in run]
    assert n_samples == [0, 1, 2, 0, 0, 1, 1, 1]
    assert run.samples == [Sample(6, "image", 1, 0.0, 9, None, 3.0)]


def test_the_bar_survives_every_kind_of_event(scripted, capsys) -> None:
    _, client = scripted
    assert len(list(client.run(JOB))) == len(events())
    shown = capsys.readouterr().err
    assert "read again" in shown
    last = shown.rsplit("\r", 1)[-1]
    assert "100%" in last and "left" not in last


def test_a_result_without_its_files_is_a_fault(scripted) -> None:
    _, client = scripted
    with pytest.raises(lookalike.ProtocolFault, match="without lod-0.glb"):
        client.run(JOB, progress=False).result()


def test_the_result_of_an_evaluation_is_a_comparison(scripted, tmp_path: Path) -> None:
    service, client = scripted
    service.spec = job_spec(evaluate_spec("meshes/0", "crude.ply"))
    with pytest.raises(lookalike.ProtocolFault, match="without comparison.json"):
        client.run(JOB, progress=False).result()
    service.files = ["comparison.json", "contact-0.png", "report.json"]
    service.content = json.dumps({"d2_percent": 1.25}).encode()
    for folder, names in [(None, []), (tmp_path, service.files)]:
        result = client.run(JOB, progress=False).result(folder)
        assert (result.lods, result.comparison) == ([], {"d2_percent": 1.25})
        assert [path.name for path in result.paths] == names


def test_a_broken_download_goes_on_where_it_broke(scripted, tmp_path: Path) -> None:
    service, client = scripted
    service.breaks = [3, 4]
    (path,) = client.fetch(JOB, tmp_path / "new" / "folder")
    assert path.read_bytes() == service.content
    assert service.asked_offset == [0, 3000, 7000]


def test_a_damaged_download_is_not_kept(scripted, tmp_path: Path) -> None:
    service, client = scripted
    artifact = service.artifact("energy.csv")
    service.content = service.content[:-1] + b"x"
    with pytest.raises(lookalike.Damaged, match="energy.csv"):
        client.read(artifact)
    service.artifact = lambda file: artifact
    with pytest.raises(lookalike.Damaged):
        client.fetch(JOB, tmp_path)
    assert not (tmp_path / "energy.csv").exists()


@pytest.mark.parametrize("name", ["..", ".hidden", "", "a\\b", "a\0b"])
def test_file_names_stay_in_their_folder(scripted, tmp_path: Path, name: str) -> None:
    service, client = scripted
    artifact = service.artifact(name)
    service.artifact = lambda file: artifact
    with pytest.raises(lookalike.ProtocolFault, match="refused"):
        client.fetch(JOB, tmp_path)


@pytest.mark.parametrize("size", [0, 1, CHUNK, CHUNK + 1, 3 * CHUNK])
def test_uploads_are_cut_into_chunks(scripted, tmp_path: Path, size: int) -> None:
    service, client = scripted
    content = bytes(size)
    path = tmp_path / "model.ply"
    path.write_bytes(content)
    name = f"meshes/{blake3(content).hexdigest()}"
    assert client.upload(path) == client.upload(content, "model.ply") == name
    assert b"".join(service.received) == content
    assert all(0 < len(chunk) <= CHUNK for chunk in service.received)


def test_an_upload_goes_on_where_it_broke_off(scripted) -> None:
    service, client = scripted
    content = random.Random(7).randbytes(5 * CHUNK)
    service.breaks_at = 3 * CHUNK
    assert client.upload(content, "model.ply") == f"meshes/{blake3(content).hexdigest()}"
    assert service.offsets == [0, 3 * CHUNK]
    assert b"".join(service.received) == content[3 * CHUNK :]
    # The one that was asked held more than the one that answers.
    service.boast = CHUNK
    client.upload(content, "model.ply")
    assert service.offsets[2:] == [CHUNK, 0]


def test_every_fault_of_a_request_is_told(scripted) -> None:
    _, client = scripted
    with pytest.raises(lookalike.Refused) as refused:
        client.create("meshes/0", "model", spec_pb2.SimplifySpec())
    faults = {"spec.simplify.seed": "use another", "file_name": "give it an extension"}
    assert (refused.value.faults, refused.value.reason) == (faults, "INVALID")
    assert str(refused.value).splitlines() == [f"{field}: {text}" for field, text in faults.items()]


def test_keywords_become_fields() -> None:
    spec = simplify_spec([8, 2], effort="best", n_views=6, custom_views=[(0, 0, -2)], seed=None)
    render = spec_pb2.RenderSpec(n_views=6, custom_views=[spec_pb2.Direction(z=-2)])
    wanted = spec_pb2.SimplifySpec(triangles=[8, 2], effort=spec_pb2.EFFORT_BEST, render=render)
    assert spec == wanted
    assert simplify_spec(7) == spec_pb2.SimplifySpec(triangles=[7])
    assert simplify_spec(ratios=(0.5, 0.1)) == spec_pb2.SimplifySpec(ratios=[0.5, 0.1])
    assert simplify_spec(ratios=0.5) == spec_pb2.SimplifySpec(ratios=[0.5])
    spec = simplify_spec(
        max_d2=3, screen_size=[300, 60], max_bytes=[0, 9000], lock="border,hard-edge"
    )
    locks = [spec_pb2.LOCK_BORDER, spec_pb2.LOCK_HARD_EDGE]
    wanted = spec_pb2.SimplifySpec(
        level_max_d2=[3], screen_size=[300, 60], max_bytes=[0, 9000], lock=locks
    )
    assert spec == wanted
    assert simplify_spec(lock=["seam"], max_d2=[3, 2]) == spec_pb2.SimplifySpec(
        lock=[spec_pb2.LOCK_SEAM], level_max_d2=[3, 2]
    )


def test_work_knows_its_kind() -> None:
    works = {
        "simplify": simplify_spec(7),
        "optimize": optimize_spec("meshes/0", "a.ply", optimize_until=0.5),
        "evaluate": evaluate_spec("meshes/0", "a.ply", shading="smooth", distance=False),
    }
    for kind, work in works.items():
        spec = job_spec(work)
        assert spec.WhichOneof("kind") == kind and getattr(spec, kind) == work
    wanted = spec_pb2.EvaluateSpec(
        simplified_mesh="meshes/0",
        simplified_file_name="a.ply",
        shading=spec_pb2.SHADING_SMOOTH,
        distance=False,
    )
    assert works["evaluate"] == wanted
    with pytest.raises(TypeError, match="`effort` is no option: use colours, distance"):
        evaluate_spec("", "", effort="fast")


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"n_view": 4}, "did you mean `n_views`"),
        ({"render": 4}, "is no option"),
        ({"effort": "bst"}, "use fast, balanced, best"),
        ({"lock": "all"}, "use border, seam, hard_edge"),
        ({"n_views": -1}, "n_views: "),
        ({"seed": "a"}, "seed: "),
        ({"custom_views": [(1, 2)]}, "custom_views: "),
    ],
)
def test_wrong_keywords_say_what_is_right(options: dict, text: str) -> None:
    with pytest.raises((TypeError, ValueError), match=text):
        simplify_spec([1], **options)


def test_every_kind_of_call_says_who_makes_it(scripted, monkeypatch) -> None:
    service, anonymous = scripted
    anonymous.job(JOB)
    monkeypatch.setenv("LOOKALIKE_TOKEN", "from-the-environment")
    for token, wanted in [("given", "Bearer given"), (None, "Bearer from-the-environment")]:
        with lookalike.Client(anonymous.url, token=token) as client:
            client.job(JOB)
            client.upload(b"solid", file_name="a.stl")
            assert list(client.watch(JOB)) == events()
        assert service.callers[-3:] == [wanted] * 3
    assert service.callers[0] is None


def test_a_certificate_needs_its_key(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="both cert and key"):
        lookalike.Client("https://127.0.0.1:1", cert=tmp_path / "cert.pem")


@pytest.mark.parametrize("url", ["", "127.0.0.1:7420", "ftp://x", "http://", "http://x/y"])
def test_wrong_addresses_say_what_is_right(url: str) -> None:
    with pytest.raises(ValueError, match="use a URL such as"):
        lookalike.Client(url)


def test_the_curve_is_drawn_for_every_axis(tmp_path: Path) -> None:
    curve = [Sample(i, "image", 10 * i, i / 2, 100 - i, i, i / 10) for i in range(1, 9)]
    silent = Sample(9, "memoryless", 0, 0.0, 200, None, None)
    for x in ("evaluations", "seconds", "triangles"):
        path = tmp_path / f"{x}.png"
        figure = lookalike.plot_energy([silent, *curve], path, x=x)
        assert path.read_bytes().startswith(b"\x89PNG")
        (line,) = figure.axes[0].lines
        assert list(line.get_ydata()) == [s.d2 for s in curve]
        assert list(line.get_xdata()) == [getattr(s, x) for s in curve]
    with pytest.raises(ValueError, match="method='image'"):
        lookalike.plot_energy([silent])
    with pytest.raises(ValueError, match="use evaluations, seconds, triangles"):
        lookalike.plot_energy(curve, x="time")


def test_a_server_that_cannot_start_says_why(tmp_path: Path) -> None:
    with pytest.raises(lookalike.ServerNotStarted, match="cargo build"):
        lookalike.Server(tmp_path / "data", tmp_path / "nothing").start()
    fails = tmp_path / "fails"
    fails.write_text("#!/bin/sh\necho no room left >&2\nexit 1\n")
    fails.chmod(0o755)
    with pytest.raises(lookalike.ServerNotStarted, match="no room left"):
        lookalike.Server(tmp_path / "data", fails).start()
