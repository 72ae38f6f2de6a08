"""Generated meshes for the farm: the same number and seed give the same bytes."""

from collections.abc import Callable

import numpy as np
import trimesh


def ball(rng: np.random.Generator, size: int) -> trimesh.Trimesh:
    """A closed ball with dents."""
    rows = max(6, int(np.sqrt(size / 4)))
    mesh = trimesh.creation.uv_sphere(count=[rows, rows])
    waves = rng.normal(size=(4, 3)) * 3
    return moved(
        mesh, mesh.vertices * (1 + 0.05 * np.sin(mesh.vertices @ waves.T).sum(axis=1))[:, None]
    )


def torus(rng: np.random.Generator, size: int) -> trimesh.Trimesh:
    """A torus with noise on it."""
    rows = max(8, int(np.sqrt(size / 4)))
    mesh = trimesh.creation.torus(1.0, rng.uniform(0.2, 0.5), rows * 2, rows)
    return moved(mesh, mesh.vertices + rng.normal(scale=0.004, size=mesh.vertices.shape))


def sheet(rng: np.random.Generator, size: int) -> trimesh.Trimesh:
    """A hilly square with an open border."""
    n = max(4, int(np.sqrt(size / 2)))
    x, y = np.meshgrid(np.linspace(-1, 1, n + 1), np.linspace(-1, 1, n + 1), indexing="ij")
    z = sum(0.1 * np.sin(a * x + b * y) for a, b in rng.normal(size=(4, 2)) * 5)
    corner = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    halves = [[0, n + 1, n + 2], [0, n + 2, 1]]
    faces = (corner[:, None, None] + np.array(halves)).reshape(-1, 3)
    return trimesh.Trimesh(np.stack([x, y, z], axis=-1).reshape(-1, 3), faces, process=False)


def pair(rng: np.random.Generator, size: int) -> trimesh.Trimesh:
    """Two parts that touch nowhere."""
    other = torus(rng, size // 2).apply_translation([3, 0, 0])
    return trimesh.util.concatenate([ball(rng, size // 2), other])


KINDS: list[Callable[[np.random.Generator, int], trimesh.Trimesh]] = [ball, torus, sheet, pair]


def shape(number: int, seed: int, size: int) -> bytes:
    """The GLB of the farm's mesh `number`: half to twice `size` triangles."""
    rng = np.random.default_rng([seed, number])
    kind = KINDS[number % len(KINDS)]
    return kind(rng, int(size * 2 ** rng.uniform(-1, 1))).export(file_type="glb")


def moved(mesh: trimesh.Trimesh, vertices: np.ndarray) -> trimesh.Trimesh:
    """`mesh` with other positions, and nothing cached that would change the bytes."""
    return trimesh.Trimesh(vertices, mesh.faces, process=False)
