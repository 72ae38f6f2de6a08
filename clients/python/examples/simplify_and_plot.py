"""Simplifies a mesh on a Lookalike server, follows the work, and leaves the levels and their curve.

    python simplify_and_plot.py                      # a generated, bumpy torus
    python simplify_and_plot.py bunny.ply --triangles 2000 500 --server http://127.0.0.1:7420

Without --server it starts a server of its own (--binary, or `lookalike` on the PATH) and stops it
at the end.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
import trimesh

import lookalike


def bumpy_torus(seed: int = 0) -> trimesh.Trimesh:
    """A torus of 16,384 triangles whose surface undulates, with some noise."""
    mesh = trimesh.creation.torus(1.0, 0.35, major_sections=128, minor_sections=64)
    x, y, z = mesh.vertices.T
    # Out of the tube: away from the circle in its middle.
    angle = np.arctan2(y, x)
    outward = mesh.vertices - np.stack([np.cos(angle), np.sin(angle), 0 * z], axis=1)
    waves = 0.08 * np.sin(9 * angle) * np.cos(14 * z)
    noise = np.random.default_rng(seed).normal(scale=0.003, size=len(z))
    vertices = mesh.vertices + (waves + noise)[:, None] * outward
    return trimesh.Trimesh(vertices, mesh.faces, process=False)


def simplify(client: lookalike.Client, args: argparse.Namespace) -> None:
    """Submits, follows, fetches, draws."""
    model = args.file or bumpy_torus()
    options = {"effort": args.effort, "n_views": args.views, "image_size": args.image_size}
    run = client.simplify(model, triangles=args.triangles, **options)
    for event in run:
        if event.WhichOneof("body") == "state_changed":
            print(f"event {event.seq}: {event.state_changed.text}")
    result = run.result(args.out)
    for triangles, level in zip(args.triangles, result.lods):
        print(f"asked for {triangles:,} triangles, got {level}")
    lookalike.plot_energy(run.samples, args.out / "energy.png")
    for path in [*result.paths, args.out / "energy.png"]:
        print(path)


def main() -> None:
    """Reads the command line; finds or starts the server."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("file", nargs="?", type=Path, help="a mesh: .glb, .gltf, .ply, .obj, .stl")
    parser.add_argument("--triangles", nargs="+", type=int, default=[2000, 500], metavar="N")
    parser.add_argument("--out", type=Path, default=Path("out"), help="where to put the results")
    parser.add_argument("--effort", default="fast", choices=["fast", "balanced", "best"])
    parser.add_argument("--views", type=int, default=20, help="4, 6, 8, 12, 20 or 24")
    parser.add_argument("--image-size", type=int, default=256, metavar="PIXELS")
    parser.add_argument("--server", metavar="URL", help="a server that runs already")
    parser.add_argument("--binary", default="lookalike", help="the server's program")
    parser.add_argument("--device", default="auto", help="auto, cpu, or the name of an adapter")
    args = parser.parse_args()
    if args.server:
        with lookalike.Client(args.server) as client:
            simplify(client, args)
        return
    with tempfile.TemporaryDirectory() as folder:
        with lookalike.Server(Path(folder) / "data", args.binary, device=args.device) as server:
            with lookalike.Client(server.url) as client:
                simplify(client, args)


if __name__ == "__main__":
    main()
