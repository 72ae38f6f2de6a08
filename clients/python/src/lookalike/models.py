"""Models on their way to and from a server: files, bytes and trimesh objects."""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, cast

import trimesh
from blake3 import blake3

from lookalike import errors
from lookalike.v1 import job_pb2

Geometry = trimesh.Trimesh | trimesh.Scene
Model = Geometry | str | os.PathLike[str] | bytes

#: Bytes of an upload's chunk; the server takes at most 1 MiB.
CHUNK = 256 << 10


@dataclass(frozen=True)
class Source:
    """The bytes of a model file: in memory, or in a file that is read chunk by chunk."""

    #: The extension gives the format.
    file_name: str
    size: int
    #: BLAKE3, 64 lower-case hexadecimal digits.
    hash: str
    content: bytes | Path

    def chunks(self, offset: int = 0) -> Iterator[bytes]:
        """The bytes from `offset` on; may be asked for again."""
        with _open(self.content) as file:
            file.seek(offset)
            while chunk := file.read(CHUNK):
                yield chunk


def source(model: Model, file_name: str | None = None) -> Source:
    """Where the bytes of `model` come from.

    A file is sent as it is. A trimesh object is sent as GLB, which holds single-precision
    positions; normals travel only when trimesh has them at hand (from a file, or because they
    were asked for).
    """
    if isinstance(model, (trimesh.Trimesh, trimesh.Scene)):
        content: bytes | Path = cast(bytes, model.export(file_type="glb"))
        file_name = file_name or "model.glb"
    elif isinstance(model, bytes):
        if file_name is None:
            raise TypeError("bytes have no name: give file_name, whose extension tells the format")
        content = model
    elif isinstance(model, (str, os.PathLike)):
        content = Path(model)
        file_name = file_name or content.name
    else:
        kind = type(model).__name__
        raise TypeError(f"{kind} is no model: give a Trimesh, a Scene, a path, or bytes")
    hasher, size = blake3(), 0
    with _open(content) as file:
        while chunk := file.read(1 << 20):
            hasher.update(chunk)
            size += len(chunk)
    return Source(file_name, size, hasher.hexdigest(), content)


def load_glb(content: bytes, like: type[Geometry] = trimesh.Scene) -> Geometry:
    """A trimesh object from the bytes of a GLB, with every vertex and triangle as it is there."""
    scene = trimesh.load_scene(io.BytesIO(content), file_type="glb", process=False)
    return scene.to_mesh() if like is trimesh.Trimesh else scene


def file_of(artifact: job_pb2.Artifact) -> str:
    """The file name of an artifact: a plain name, whatever the server says."""
    name = artifact.name.rpartition("/")[2]
    if not name or name.startswith(".") or "\\" in name or "\0" in name:
        raise errors.ProtocolFault(f"the server named a file {name!r}: refused")
    return name


def _open(content: bytes | Path) -> BinaryIO:
    return io.BytesIO(content) if isinstance(content, bytes) else content.open("rb")
