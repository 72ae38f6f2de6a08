"""What half of the views from inside are good for: a model of which most is hidden, its inside judged too."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass
from pathlib import Path

from dress import call

MODEL, SHARE = "two_cylinder_engine", "0.1"
#: How levels are made.
WAYS = {
    "memoryless": ["--simplify", "memoryless"],
    "20 views from outside": [],
    "10 of the 20 interior": ["--interior-views", "10"],
}
#: Pictures in which front faces are culled, from all 20 sides.
INTERIOR = ["--image-size", "512", "--interior-views", "20"]


@dataclass
class Level:
    """A level, seen from outside and from inside."""

    way: str
    triangles: int
    #: d2 in percent of full scale: on unseen views from outside, and on 20 interior ones.
    outside: float
    inside: float

    def told(self) -> str:
        """In a line: that of the table."""
        return f"| {self.way} | {self.triangles:,} | {self.outside:.2f} | {self.inside:.2f} |"


def measure(binary: Path, model: Path, folder: Path, device: str) -> list[Level]:
    """The model, simplified in all ways."""
    return [judged(binary, model, folder, device, way) for way in WAYS]


def judged(binary: Path, model: Path, folder: Path, device: str, way: str) -> Level:
    """The model, simplified in one way, and what it looks like."""
    run, seen = folder / f"inside-{len(way)}", folder / f"inside-{len(way)}-seen"
    flags = ["--device", device]
    effort = ["--effort", "fast"]
    call(binary, "run", model, "--ratio", SHARE, "--out", run, *flags, *effort, *WAYS[way])
    level = run / "lod-0.glb"
    # The first sample of an optimization tells the energy of what it was given.
    budget = ["--optimize-evaluations", "1"]
    call(binary, "optimize", model, level, "--out", seen, *flags, *INTERIOR, *budget)
    with (seen / "energy.csv").open() as file:
        first = next(csv.DictReader(file))
    told = call(binary, "compare", model, level, "--json", "--no-distance", "--colours")
    return Level(way, int(first["triangles"]), json.loads(told)["d2_percent"], float(first["d2"]))


def section(levels: list[Level]) -> list[str]:
    """The section of the page."""
    return [
        "",
        "## Half of the views from inside",
        "",
        f"`lookalike run {MODEL}.glb --ratio {SHARE} --effort fast`, of which 72% is hidden: d2 in percent of full scale "
        "on the 24 unseen views, and on 20 views of 512² that cull what faces them and so show the inside.",
        "",
        "| simplified by | triangles | d2 outside | d2 inside |",
        "|---|---:|---:|---:|",
        *(level.told() for level in levels),
    ]
