"""The package against the real server and its worker: meshes in, levels and a live log out."""

import csv
import json
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import trimesh

import lookalike
from conftest import BINARY, DEVICE, ROOT, new_server
from lookalike.v1 import job_pb2

#: Small pictures: these tests are about the way there and back.
QUICK = {
    "effort": "fast",
    "n_views": 4,
    "image_size": 64,
    "optimize_max_evaluations": 5000,
    "progress": False,
}
#: The same for jobs without an effort.
LOOKS = {"n_views": 4, "image_size": 64, "progress": False}
#: Minutes of work, for jobs that are to be caught at it.
LONG = {"effort": "best", "n_views": 20, "image_size": 512, "start_factor": 1000, "progress": False}


def ball(seed: int, subdivisions: int = 4) -> trimesh.Trimesh:
    """A closed ball with dents: 5,120 triangles (each further subdivision: 4 times that)."""
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    waves = np.random.default_rng(seed).normal(size=(4, 3)) * 3
    radius = 1 + 0.05 * np.sin(mesh.vertices @ waves.T).sum(axis=1)
    return trimesh.Trimesh(mesh.vertices * radius[:, None], mesh.faces, process=False)


def test_levels_records_and_curve_come_back(client: lookalike.Client, tmp_path: Path) -> None:
    targets = [600, 150]
    # Pictures with pixels enough for the second level to be worth optimizing.
    looks = {"n_views": 6, "image_size": 128}
    run = client.simplify(ball(1), triangles=targets, seed=3, **(QUICK | looks))
    events = list(run)
    result = run.result(tmp_path)

    # The log: gap-free, from creation to success, and the same when it is replayed.
    assert [event.seq for event in events] == list(range(1, len(events) + 1))
    states = [e.state_changed.state for e in events if e.WhichOneof("body") == "state_changed"]
    assert states[0] == job_pb2.JOB_STATE_QUEUED
    assert states[-1] == job_pb2.JOB_STATE_SUCCEEDED
    assert list(client.watch(run.job)) == events
    assert list(client.watch(run.job, after_seq=len(events) - 2)) == events[-2:]

    # The levels: as many triangles as were asked for, closed as the ball was.
    assert len(result.lods) == len(targets)
    for level, target in zip(result.lods, targets):
        assert isinstance(level, trimesh.Trimesh)
        # A collapse inside a closed surface takes two triangles.
        assert target - 2 < len(level.faces) <= target
        assert np.abs(np.linalg.norm(level.vertices, axis=1) - 1).max() < 0.5
        level.merge_vertices(merge_norm=True, merge_tex=True)
        assert level.is_watertight

    # The curve: live and in the file, the same points.
    assert run.samples and all(s.triangles >= targets[-1] - 1 for s in run.samples)
    drawn = [s for s in run.samples if s.d2 is not None]
    assert drawn and drawn[-1].stage == "optimize"
    # Optimization: level by level, never worse, with a look at unseen views before and after.
    for level in range(2):
        curve = [s for s in run.samples if s.level == level]
        for one, next_one in zip(curve, curve[1:]):
            assert next_one.energy <= one.energy or next_one.turn > one.turn
        assert curve[0].d2_unseen is not None and curve[-1].d2_unseen is not None
        assert curve[-1].d2_unseen <= curve[0].d2_unseen
    assert curve[-1].d2_unseen < curve[0].d2_unseen
    kinds = {event.WhichOneof("body") for event in events}
    assert {"record_chunk", "move_statistics", "energy_sample"} <= kinds
    with (tmp_path / "energy.csv").open() as file:
        rows = list(csv.DictReader(file))
    columns = ["seq", "stage", "evaluations", "seconds", "triangles", "energy", "d2"]
    assert list(rows[0]) == [*columns, "level", "energy_ratio", "d2_unseen", "turn"]
    assert [int(row["triangles"]) for row in rows] == [s.triangles for s in run.samples]

    names = {path.name for path in result.paths}
    assert {"lod-0.glb", "lod-1.glb", "progressive.lkpm", "energy.csv", "report.json"} <= names
    assert [lod["triangles"] for lod in result.report["levels"]] == [
        len(level.faces) for level in result.lods
    ]


def test_a_mesh_that_something_else_simplified_is_optimized(client: lookalike.Client) -> None:
    original = ball(9)
    crude = trimesh.creation.icosphere(subdivisions=2)
    run = client.optimize(original, crude, optimize_until=0.9, **LOOKS)
    result = run.result()
    (level,) = result.lods
    assert isinstance(level, trimesh.Trimesh) and len(level.faces) <= len(crude.faces)
    (report,) = result.report["levels"]
    assert report["optimization"]["energy_ratio"] <= 0.9
    assert report["optimization"]["stopped_by"] == "energy"
    with pytest.raises(TypeError, match="effort"):
        client.optimize(original, crude, effort="fast")


def test_two_meshes_are_compared(client: lookalike.Client, tmp_path: Path) -> None:
    original, crude = ball(9), ball(9, subdivisions=3)
    files = [tmp_path / name for name in ("original.glb", "crude.glb")]
    for path, mesh in zip(files, (original, crude)):
        path.write_bytes(mesh.export(file_type="glb"))
    said = subprocess.run([BINARY, "compare", *files, "--json"], capture_output=True, check=True)
    result = client.evaluate(original, crude, progress=False).result(tmp_path / "out")
    assert result.comparison == json.loads(said.stdout) and result.lods == []
    assert result.report["comparison"] == result.comparison
    assert (tmp_path / "out" / "contact-0.png").read_bytes().startswith(b"\x89PNG")
    alike = client.evaluate(crude, crude, distance=False, progress=False).result()
    assert alike.comparison["d2_percent"] == 0 and alike.comparison["metro"] is None


def test_a_scene_comes_back_as_a_scene(client: lookalike.Client) -> None:
    parts = [ball(2, subdivisions=3), ball(3, subdivisions=3).apply_translation([3, 0, 0])]
    scene = trimesh.Scene(parts)
    run = client.simplify(scene, triangles=300, quantize=True, **QUICK)
    (level,) = run.result().lods
    assert isinstance(level, trimesh.Scene)
    # Under the same names.
    assert set(level.graph.nodes_geometry) == set(scene.graph.nodes_geometry)
    assert 0 < sum(len(part.faces) for part in level.geometry.values()) <= 300
    # Both balls are still there, where they were.
    np.testing.assert_allclose(level.bounds, scene.bounds, atol=0.3)


def test_files_and_bytes_are_models_too(client: lookalike.Client, tmp_path: Path) -> None:
    path = tmp_path / "ball.ply"
    path.write_bytes(ball(4, subdivisions=3).export(file_type="ply"))
    mesh = client.upload(path)
    assert client.upload(path.read_bytes(), "other.ply") == mesh
    runs = [
        client.simplify(path, triangles=200, **QUICK),
        client.simplify(path.read_bytes(), triangles=200, file_name="ball.ply", **QUICK),
    ]
    lods = [run.result().lods[0].to_mesh() for run in runs]
    np.testing.assert_array_equal(lods[0].vertices, lods[1].vertices)
    np.testing.assert_array_equal(lods[0].faces, lods[1].faces)


def test_the_same_request_makes_one_job(client: lookalike.Client) -> None:
    mesh = ball(5, subdivisions=3)

    def submit(_: int) -> str:
        run = client.simplify(
            mesh, triangles=100, request_id="same", labels={"batch": "7"}, **QUICK
        )
        run.close()
        return run.job

    with ThreadPoolExecutor(8) as pool:
        names = set(pool.map(submit, range(24)))
    assert len(names) == 1
    job = names.pop()
    assert [listed.name for listed in client.jobs()].count(job) == 1
    assert [listed.name for listed in client.jobs(labels={"batch": "7"})] == [job]
    assert list(client.jobs("failed", labels={"batch": "7"})) == []
    assert len(client.run(job, progress=False).result().lods) == 1
    with pytest.raises(lookalike.Refused) as refused:
        client.simplify(mesh, triangles=101, request_id="same", **QUICK)
    assert refused.value.reason == "REQUEST_ID_REUSED"


def test_cancelling_a_running_and_a_waiting_job(client: lookalike.Client) -> None:
    mesh = ball(6, subdivisions=5)
    running = client.simplify(mesh, triangles=10, **LONG)
    waiting = client.simplify(mesh, triangles=12, **LONG)
    for event in running:
        if event.WhichOneof("body") == "energy_sample":
            break
    for run in (waiting, running):
        assert run.cancel().state == job_pb2.JOB_STATE_CANCELLED
        *_, last = run
        assert last.state_changed.state == job_pb2.JOB_STATE_CANCELLED
        with pytest.raises(lookalike.JobCancelled, match=run.job):
            run.result()
    assert {running.job, waiting.job} <= {job.name for job in client.jobs("cancelled")}
    client.delete(waiting.job)
    with pytest.raises(lookalike.Refused, match="does not exist"):
        client.job(waiting.job)


def test_a_cancelled_job_is_done_when_it_is_retried(client: lookalike.Client) -> None:
    busy = client.simplify(ball(6, subdivisions=5), triangles=10, **LONG)
    waiting = client.simplify(ball(9, subdivisions=2), triangles=12, **QUICK)
    assert waiting.cancel().state == job_pb2.JOB_STATE_CANCELLED
    assert client.retry(waiting.job).state in (
        job_pb2.JOB_STATE_QUEUED,
        job_pb2.JOB_STATE_RUNNING,
    )
    busy.cancel()
    assert len(client.run(waiting.job, progress=False).result().lods) == 1
    with pytest.raises(lookalike.Refused, match="submit it again"):
        client.retry(waiting.job)


def test_faults_are_told_by_name(client: lookalike.Client) -> None:
    with pytest.raises(lookalike.Refused) as refused:
        client.simplify(ball(7, subdivisions=1), triangles=[50, 0], n_views=5, progress=False)
    assert set(refused.value.faults) == {
        "spec.simplify.triangles[1]",
        "spec.simplify.render.n_views",
    }
    run = client.simplify(b"", triangles=10, file_name="nothing.glb", progress=False)
    with pytest.raises(lookalike.JobFailed) as failed:
        run.result()
    assert failed.value.reason and "nothing.glb" in failed.value.text


def test_a_killed_server_costs_neither_events_nor_the_job(tmp_path: Path) -> None:
    mesh, targets = ball(8), [400]
    with new_server(tmp_path) as server, lookalike.Client(server.url) as client:
        calm = client.simplify(mesh, targets, seed=1, **QUICK)
        calm_events = len(list(calm))
        run = client.simplify(mesh, targets, seed=1, **QUICK)
        seqs = []
        for event in run:
            seqs.append(event.seq)
            if event.seq == calm_events // 3:
                server.kill()
                server.start()
        assert seqs == list(range(1, len(seqs) + 1))
        wanted, found = calm.result().lods[0], run.result().lods[0]
        np.testing.assert_array_equal(found.vertices, wanted.vertices)
        np.testing.assert_array_equal(found.faces, wanted.faces)


def test_the_example_leaves_levels_and_a_plot(tmp_path: Path) -> None:
    example = ROOT / "clients" / "python" / "examples" / "simplify_and_plot.py"
    command = [sys.executable, example, "--binary", BINARY, "--device", DEVICE, "--out", tmp_path]
    command += ["--views", "4", "--image-size", "64", "--triangles", "1000", "250"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    for i, target in enumerate([1000, 250]):
        level = trimesh.load_mesh(tmp_path / f"lod-{i}.glb", process=False)
        assert 0 < len(level.faces) <= target
    assert (tmp_path / "energy.png").read_bytes().startswith(b"\x89PNG")
