"""The farm's own checks can fail, and a small farm runs clean against the real server."""

import json
import os
import struct
import subprocess
import sys
from pathlib import Path

import pytest

import farm
import glb
import shapes

HERE = Path(__file__).resolve().parent
BINARY = Path(
    os.environ.get("LOOKALIKE_BIN") or HERE.parent / "target" / "release" / "lookalike"
).resolve()


def edited(content: bytes, old: bytes, new: bytes) -> bytes:
    """`content` with one part of its JSON replaced by another of the same length."""
    assert content.count(old) >= 1 and len(old) == len(new)
    return content.replace(old, new, 1)


@pytest.mark.parametrize("number", range(4))
def test_shapes_are_sound_and_reproducible(number: int) -> None:
    content = shapes.shape(number, seed=5, size=2000)
    assert content == shapes.shape(number, seed=5, size=2000)
    assert content != shapes.shape(number, seed=6, size=2000)
    assert 500 < glb.n_triangles(content) < 5000


@pytest.mark.parametrize(
    "damage",
    [
        lambda c: b"",
        lambda c: b"glTF",
        lambda c: c[:-4],
        lambda c: c + bytes(4),
        lambda c: b"glTF" + struct.pack("<I", 1) + c[8:],
        lambda c: edited(c, b'"POSITION"', b'"POSITIOM"'),
        # Every number in the buffer becomes a NaN or an index far away.
        lambda c: c[: c.index(b"BIN\0") + 4] + b"\xff" * (len(c) - c.index(b"BIN\0") - 4),
    ],
)
def test_damaged_files_are_noticed(damage) -> None:
    with pytest.raises((glb.Unsound, KeyError)):
        glb.n_triangles(damage(shapes.shape(0, seed=5, size=500)))


def test_different_bytes_of_the_same_mesh_are_a_fault() -> None:
    done = [farm.Done(0, f"jobs/{i}", 1.0, [1], digest, 0) for i, digest in enumerate("aab")]
    assert len(farm.differences(done)) == 1
    assert farm.differences(done[:2]) == []


@pytest.mark.parametrize(
    "url", ["http://192.0.2.1:1", "http://example.org", "", "http://0.0.0.0:1"]
)
def test_other_machines_are_left_alone(url: str) -> None:
    with pytest.raises(SystemExit):
        farm.parser().parse_args(["--server", url])


def test_no_server_is_a_fault(tmp_path: Path) -> None:
    done = run("--server=http://127.0.0.1:1", "--jobs=2", "--shapes=1")
    assert done.returncode == 1
    assert "no server answers" in done.stdout


def test_a_small_farm_runs_clean(tmp_path: Path) -> None:
    report = tmp_path / "report.json"
    flags = ["--jobs=8", "--in-flight=4", "--shapes=4", "--size=1500", "--triangles", "300", "60"]
    done = run(f"--binary={BINARY}", *flags, "--kills=2", "--max-secs=240", f"--report={report}")
    assert done.returncode == 0, done.stdout + done.stderr
    assert len(json.loads(report.read_text())["done"]) == 8


def run(*flags: str) -> subprocess.CompletedProcess[str]:
    """The farm as a program."""
    command = [sys.executable, str(HERE / "farm.py"), *flags]
    return subprocess.run(command, capture_output=True, text=True, timeout=300)
