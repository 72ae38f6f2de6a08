"""What Lookalike reaches, measured: writes docs/results.md and its pictures.

    make results                  # everything: about an hour on two cores
    make results QUICK=1          # the short runs alone: some minutes

Every figure comes from `report.json` and from `lookalike compare` (24 views that no run works with,
512 x 512, anti-aliased). Budgets are energy evaluations, so the same build gives the same meshes
everywhere; only seconds depend on the machine. Real models are looked for in --models; those that are
absent are left out, and the page says so.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import platform
import subprocess
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import assets

ROOT = Path(__file__).resolve().parent.parent


@dataclass(frozen=True)
class Experiment:
    """One row of the tables."""

    name: str
    model: str
    triangles: int
    evaluations: int
    #: Flags of `lookalike run`.
    flags: tuple[str, ...] = ()
    #: The paper's energy in percent of the start, where it states one.
    paper: str = ""
    is_long: bool = False
    smooth: bool = False
    #: Where the curve is read off, in evaluations.
    marks: tuple[int, ...] = field(default=())


#: Larger models are left out of quick runs.
QUICK_BYTES = 4_000_000

MEMORYLESS = ("--simplify", "memoryless")
CLUSTER = ("--simplify", "cluster", "--topology", "free")
NORMALS = (*MEMORYLESS, "--shading", "smooth", "--optimize-normals")

EXPERIMENTS = [
    Experiment("bunny, memoryless", "stanford_bunny.glb", 1336, 700_000, MEMORYLESS, "58.8"),
    Experiment("bunny, memoryless", "stanford_bunny.glb", 654, 350_000, MEMORYLESS, "59.7"),
    Experiment("bunny, image-driven", "stanford_bunny.glb", 1333, 700_000, (), "75"),
    Experiment("armadillo, memoryless", "armadillo.glb", 864, 450_000, MEMORYLESS),
    Experiment("armadillo, image-driven", "armadillo.glb", 864, 450_000),
    Experiment("bunny, clustered", "stanford_bunny.glb", 1600, 800_000, CLUSTER, "51.5"),
    Experiment(
        "bunny, clustered", "stanford_bunny.glb", 1600, 8_000_000, CLUSTER, "25.3", is_long=True
    ),
    Experiment(
        "dragon, memoryless, with normals",
        "stanford_dragon.glb",
        8190,
        4_000_000,
        NORMALS,
        "33.5",
        is_long=True,
        smooth=True,
    ),
]


@dataclass
class Row:
    """What an experiment gave."""

    experiment: Experiment
    triangles: int
    vertices: int
    device: str
    evaluations: int
    seconds: float
    per_second: float
    energy_ratio: float
    #: d2 on unseen views, 0 to 255: before, after, and of memoryless at the same triangles.
    before: float
    after: float
    memoryless: float
    curve: list[tuple[int, float, float]]
    picture: str


class Bench:
    """Runs the program in a folder of its own."""

    def __init__(self, binary: Path, models: Path, out: Path, folder: Path, device: str) -> None:
        self.binary, self.models, self.out, self.folder = binary, models, out, folder
        self.device = device

    def call(self, *args: str | Path) -> str:
        """Runs a command; what it printed."""
        done = subprocess.run([self.binary, *args], capture_output=True, text=True)
        if done.returncode != 0:
            raise SystemExit(f"results: {' '.join(map(str, args))}: {done.stderr[-2000:]}")
        return done.stdout

    def d2(self, model: Path, level: Path, smooth: bool, stored: bool = False) -> float:
        """d2 over unseen views, 0 to 255."""
        flags = ["--shading", "smooth"] if smooth else []
        flags += ["--stored-normals"] if stored else []
        told = self.call("compare", model, level, "--json", "--no-distance", *flags)
        return json.loads(told)["d2_255"]

    def run(self, number: int, e: Experiment) -> Row:
        """Runs an experiment and judges it."""
        model, out = self.models / e.model, self.folder / str(number)
        flags = ["--triangles", str(e.triangles), "--device", self.device, *e.flags]
        self.call(
            "run", model, "--out", out, *flags, "--optimize-evaluations", str(e.evaluations)
        )
        report = json.loads((out / "report.json").read_text())
        (level,) = report["levels"]
        stage = report["stages"][-1]
        start, end = out / "before.glb", out / "lod-0.glb"
        file = out / "progressive.lkpm"
        self.call("extract", file, "--level", "lod-0", "--plain", "--out", start)
        plain = out / "memoryless"
        count = str(level["triangles"])
        geometric = ["--triangles", count, "--out", plain, *MEMORYLESS]
        self.call("run", model, *geometric, "--optimize-evaluations", "0")
        picture = f"results-{number}.png"
        sheet_flags = ["--shading", "smooth"] if e.smooth else []
        sheet = self.out.parent / picture
        self.call("compare", model, start, end, "--no-distance", "--sheet", sheet, *sheet_flags)
        return Row(
            experiment=e,
            triangles=level["triangles"],
            vertices=level["vertices"],
            device=report["device"],
            evaluations=level["optimization"]["evaluations"],
            seconds=stage["seconds"],
            per_second=stage["evaluations_per_second"],
            energy_ratio=level["optimization"]["energy_ratio"],
            before=self.d2(model, start, e.smooth),
            after=self.d2(model, end, e.smooth, stored="--optimize-normals" in e.flags),
            memoryless=self.d2(model, plain / "lod-0.glb", e.smooth),
            curve=curve(out / "energy.csv"),
            picture=picture,
        )


def curve(path: Path) -> list[tuple[int, float, float]]:
    """Evaluations, seconds since the stage began, and energy in percent of the start."""
    with path.open() as file:
        rows = [row for row in csv.DictReader(file) if row["stage"] == "optimize"]
    begin = float(rows[0]["seconds"])
    return [
        (int(r["evaluations"]), float(r["seconds"]) - begin, 100 * float(r["energy_ratio"]))
        for r in rows
    ]


def reached(points: list[tuple[int, float, float]], percent: float) -> str:
    """When the curve first was at or below an energy."""
    for evaluations, seconds, ratio in points:
        if ratio <= percent:
            return f"{evaluations:,} evaluations, {seconds:.0f} s"
    return "not reached"


def table(rows: list[Row]) -> str:
    """The page's main table."""
    lines = [
        "| start | triangles | E, % of the start | paper | that reached after | d2 unseen: start "
        "→ end (ratio) | end / memoryless | evaluations | seconds | per second |",
        "|---|---:|---:|---:|---|---:|---:|---:|---:|---:|",
    ]
    for row in rows:
        e = row.experiment
        when = reached(row.curve, float(e.paper)) if e.paper else ""
        lines.append(
            f"| {e.name} | {row.triangles:,} | {100 * row.energy_ratio:.1f} | {e.paper} | {when} "
            f"| {row.before:.2f} → {row.after:.2f} ({row.after / row.before:.3f}) "
            f"| {row.after / row.memoryless:.3f} | {row.evaluations:,} | {row.seconds:.0f} "
            f"| {row.per_second:,.0f} |"
        )
    return "\n".join(lines)


def page(rows: list[Row], models: list[assets.Model], absent: list[str]) -> str:
    """The whole page."""
    cores = len(os.sched_getaffinity(0))
    device = rows[0].device if rows else "none"
    parts = [
        "# What image-driven optimization reaches",
        "",
        "Written by `make results`. E is the sum of squared luminance differences on the 20 views "
        "of 256² that the run works with; d2 is the root mean square difference on 24 views of "
        "512² that it has not seen (0 to 255). The column *paper* has Lindstrom & Turk's figures "
        "for E (2000, figures 23 to 25 and their text), which took them hours.",
        "",
        f"{cores} cores ({platform.machine()}), evaluator `{device}`. Budgets are evaluations, so "
        "all but the seconds is the same on any machine.",
        "",
        table(rows),
    ]
    if absent:
        parts += ["", f"Left out, because the model is not there: {', '.join(absent)}."]
    for row in rows:
        e = row.experiment
        parts += [
            "",
            f"## {e.name} → {row.triangles:,} triangles, {row.evaluations:,} evaluations",
            "",
            f"![original, start and end, with differences below]({row.picture})",
        ]
    if models:
        parts += assets.section(models)
    return "\n".join(parts) + "\n"


def service_section(path: Path) -> str:
    """What `make loadtest` has written into the page, which is kept."""
    text = path.read_text() if path.exists() else ""
    at = text.find("## The service\n")
    if at < 0:
        return ""
    end = text.find("\n## ", at)
    return "\n" + text[at : end if end >= 0 else len(text)].rstrip() + "\n"


def main() -> None:
    """Reads the command line, runs the experiments, writes the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--binary", type=Path, default=ROOT / "target" / "release" / "lookalike")
    parser.add_argument("--models", type=Path, default=ROOT.parent / "shared" / "models")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "results.md")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--quick", action="store_true", help="leave the long runs out")
    parser.add_argument("--only", type=int, action="append", help="experiments by number, from 0")
    args = parser.parse_args()
    rows, absent = [], []
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(args.binary, args.models, args.out, Path(folder), args.device)
        for number, experiment in enumerate(EXPERIMENTS):
            if args.only and number not in args.only or args.quick and experiment.is_long:
                continue
            if not (args.models / experiment.model).exists():
                absent.append(experiment.name)
                continue
            row = bench.run(number, experiment)
            rows.append(row)
            print(f"{experiment.name}: E {100 * row.energy_ratio:.1f}%", flush=True)
        models = []
        for path in sorted(args.models.glob("*.glb")) if not args.only else []:
            if args.quick and path.stat().st_size > QUICK_BYTES:
                continue
            models.append(assets.measure(args.binary, path, Path(folder), args.device))
            print(assets.table(models[-1:]).splitlines()[-1], flush=True)
    args.out.write_text(page(rows, models, absent) + service_section(args.out))
    print(args.out)


if __name__ == "__main__":
    main()
