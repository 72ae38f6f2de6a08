"""What other programs say of the files that Lookalike writes: the Khronos validator, three.js and Blender.

    make viewers

Every model at a tenth and at 3%: `lod-0.glb`, `lod-1.glb` and `lods.glb`, some of them packed too. Nothing may be an
error, and the others must find as many triangles as the report says, and the materials and textures that the file
names. Writes a section of docs/results.md and fails where something is amiss.
"""

from __future__ import annotations

import argparse
import json
import struct
import subprocess
import sys
import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
HEADING = "## What other programs say of the files"
FILES = ("lod-0.glb", "lod-1.glb", "lods.glb")
MODELS = (
    *("barramundi_fish.glb", "corset.glb", "dutch_ship.glb", "flight_helmet.glb", "frog_vertex_colours.glb"),
    *("house_scene.glb", "spot_cow.glb", "stanford_bunny.ply", "two_cylinder_engine.glb"),
)
#: Runs with these flags too.
PACKED = {name: ("--quantize", "--compress") for name in ("barramundi_fish.glb", "corset.glb", "flight_helmet.glb")}
FLAGS = "--ratio .1,.03 --effort fast --optimize-evaluations 2000"
#: What Blender 5.0 says to meshopt compression.
REFUSED = "EXT_meshopt_compression is not available"


@dataclass
class Row:
    """What was said of the files of one run."""

    name: str
    triangles: str
    parts: str
    validator: str
    three: str
    blender: str
    is_fine: bool

    def told(self) -> str:
        """In a line: that of the table."""
        cells = (self.name, self.triangles, self.parts, self.validator, self.three, self.blender)
        return f"| {' | '.join(cells)} |"


def lines(*command: str | Path) -> list:
    """What a reader prints about each file."""
    done = subprocess.run(command, capture_output=True, text=True, cwd=HERE)
    if done.returncode != 0:
        raise SystemExit(f"viewers: {' '.join(map(str, command))}: {done.stderr[-2000:]}")
    return [json.loads(line) for line in done.stdout.splitlines() if line.startswith(("{", "["))]


def document(path: Path) -> dict:
    """The JSON chunk of a GLB file."""
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + length])


def named(value: object, key: str = "") -> set[int]:
    """The textures that a part of a material names."""
    if not isinstance(value, dict):
        return set()
    own = {value["index"]} if key.endswith("Texture") else set()
    return own.union(*(named(below, name) for name, below in value.items()))


def used(json_: dict, roots: list[int]) -> dict[str, int]:
    """Materials, textures and images of what is below nodes."""
    nodes, meshes, left = json_["nodes"], set(), list(roots)
    while left:
        node = nodes[left.pop()]
        left += node.get("children", [])
        meshes |= {node["mesh"]} if "mesh" in node else set()
    primitives = [p for mesh in meshes for p in json_["meshes"][mesh]["primitives"]]
    materials = {p["material"] for p in primitives if "material" in p}
    textures = set().union(*(named(json_["materials"][m]) for m in materials))
    images = {json_["textures"][t].get("source") for t in textures}
    return {"materials": len(materials), "textures": len(textures), "images": len(images)}


def expected(path: Path, triangles: list[int]) -> tuple[list[dict], dict]:
    """What three.js must find in each level of a file, and Blender in all of them together."""
    json_ = document(path)
    finest = json_["scenes"][0]["nodes"]
    levels = [finest, *([n] for root in finest for n in lods(json_["nodes"][root]))]
    each = [used(json_, roots) | {"triangles": n} for roots, n in zip(levels, triangles, strict=True)]
    together = used(json_, [node for level in levels for node in level]) | {"triangles": sum(triangles)}
    keys = ("triangles", "materials", "textures")
    return [{k: level[k] for k in keys} for level in each], {k: together[k] for k in (*keys[:2], "images")}


def lods(node: dict) -> list[int]:
    """The coarser levels of a node."""
    return node.get("extensions", {}).get("MSFT_lod", {}).get("ids", [])


def codes(told: list[dict], source: Counter) -> str:
    """Errors, warnings and, if there are any, what they are."""
    counts = [sum((Counter(t[severity]) for t in told), Counter()) for severity in ("error", "warning")]
    names = [f"{c}{' (the source too)' if c in source else ''}" for count in counts for c in sorted(count)]
    return "; ".join([" / ".join(str(count.total()) for count in counts), *names])


def compared(found: list, wanted: list) -> str:
    """Whether a reader found what it had to."""
    problems = sorted({f["problem"] for f in found if isinstance(f, dict) and "problem" in f})
    if problems:
        return f"not read: {REFUSED}" if all(REFUSED in p for p in problems) else "; ".join(problems)
    return "same" if found == wanted else f"{found} instead of {wanted}"


def measure(args: argparse.Namespace, model: Path, flags: list[str], out: Path) -> Row:
    """Runs one model, unless that was done, and has its files looked at."""
    if not (out / "report.json").exists():
        lines(args.binary, "run", model, "--out", out, *FLAGS.split(), "--device", args.device, *flags)
    triangles = [level["triangles"] for level in json.loads((out / "report.json").read_text())["levels"]]
    files = [out / name for name in FILES]
    wanted = [expected(f, n) for f, n in zip(files, (triangles[:1], triangles[1:], triangles), strict=True)]
    told = lines("node", "validate.mjs", *files)
    source = lines("node", "validate.mjs", model)[0]["warning"] if model.suffix == ".glb" else {}
    three = compared(lines("node", "three.mjs", *files), [each for each, _ in wanted])
    blender = compared(lines(args.python, "blender.py", *files), [together for _, together in wanted])
    refused = "--compress" in flags and blender.endswith(REFUSED)
    is_fine = not any(t["error"] for t in told) and three == "same" and (blender == "same" or refused)
    first = wanted[0][0][0] | wanted[0][1]
    parts = f"{first['materials']}, {first['textures']}, {first['images']}"
    name = " ".join([f"{model.stem}", *flags])
    count = " + ".join(f"{n:,}" for n in triangles)
    return Row(name, count, parts, codes(told, Counter(source)), three, blender, is_fine)


def section(rows: list[Row]) -> str:
    """The section of the page."""
    pinned = json.loads((HERE / "package.json").read_text())["dependencies"]
    (blender,) = (HERE / "requirements.txt").read_text().split()
    return "\n".join([
        HEADING,
        "",
        f"Written by `make viewers`: `lookalike run MODEL {FLAGS}`, and of each run {', '.join(FILES)}, which holds both "
        f"levels. Khronos validator {pinned['gltf-validator']}: errors and warnings of the three files together. "
        f"three.js {pinned['three']} and Blender ({blender}) read each file; *same*: they find as many triangles as "
        "`report.json` says, and the materials, textures and images that the file names (of lod-0 in the third column). "
        "Images and materials are the source's own, and so are the warnings about them.",
        "",
        "| model | triangles | materials, textures, images | validator: errors / warnings | three.js | Blender |",
        "|---|---:|---:|---|---|---|",
        *(row.told() for row in rows),
        "",
    ])


def put(page: Path, text: str) -> None:
    """Puts the section where it was, or at the end."""
    before, _, after = page.read_text().partition(f"{HEADING}\n")
    after = after.partition("\n## ")[1:]
    page.write_text(f"{before.rstrip()}\n\n{text}{''.join(after)}")


def main() -> int:
    """Reads the command line, looks at every model, writes the section."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--binary", type=Path, default=ROOT / "target" / "release" / "lookalike")
    parser.add_argument("--models", type=Path, default=ROOT.parent / "shared" / "models")
    parser.add_argument("--page", type=Path, default=ROOT / "docs" / "results.md")
    parser.add_argument("--python", default=sys.executable, help="has the package bpy")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--out", type=Path, help="keeps what the runs write; what is there is not made again")
    args = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = args.out or Path(temporary)
        for path in (args.models / name for name in MODELS if (args.models / name).exists()):
            for flags in ([], *([flag] for flag in PACKED.get(path.name, ()))):
                rows.append(measure(args, path, flags, folder / "".join([path.stem, *flags])))
                print(rows[-1].told(), flush=True)
    put(args.page, section(rows))
    return 0 if all(row.is_fine for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
