"""What Lookalike reaches, measured: writes docs/results.md and its pictures.

    make results                  # everything: about an hour on two cores
    make results QUICK=1          # the short runs alone: some minutes
    make results JOBS=8           # so many runs beside one another, two cores each

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
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

import assets
import cores
import dress
import inside

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
    #: The paper's energy in percent of the start: the run ends there.
    paper: str = ""
    is_long: bool = False
    smooth: bool = False

    def budget(self) -> list[str]:
        """What ends optimization."""
        until = ["--optimize-until", str(float(self.paper) / 100)] if self.paper else []
        return ["--optimize-evaluations", str(self.evaluations), *until]


#: Larger models are left out of quick runs.
QUICK_BYTES = 4_000_000

MEMORYLESS = ("--simplify", "memoryless")
CLUSTER = ("--simplify", "cluster", "--topology", "free")
#: As the paper has them, however many triangles.
SMALL = ("--image-size", "256")
SMOOTH = ("--shading", "smooth")
FAST = ("--effort", "fast")
NORMALS = (*MEMORYLESS, "--shading", "smooth", "--optimize-normals")

EXPERIMENTS = [
    Experiment("bunny, memoryless", "stanford_bunny.glb", 1336, 700_000, MEMORYLESS),
    Experiment("bunny, memoryless", "stanford_bunny.glb", 654, 350_000, MEMORYLESS),
    Experiment("bunny, image-driven", "stanford_bunny.glb", 1333, 700_000),
    Experiment("armadillo, memoryless", "armadillo.glb", 864, 450_000, MEMORYLESS),
    Experiment("armadillo, image-driven", "armadillo.glb", 864, 450_000),
    Experiment("bunny, clustered", "stanford_bunny.glb", 1600, 800_000, CLUSTER),
    Experiment(
        "dragon, memoryless, with normals",
        "stanford_dragon.glb",
        8190,
        4_000_000,
        NORMALS,
        is_long=True,
        smooth=True,
    ),
    # Until the energy is what the paper has: then the run-time pictures are all that counts.
    Experiment("bunny, memoryless", "stanford_bunny.glb", 1336, 2_000_000, MEMORYLESS, "58.8"),
    Experiment("bunny, memoryless", "stanford_bunny.glb", 654, 1_500_000, MEMORYLESS, "59.7"),
    Experiment("bunny, image-driven", "stanford_bunny.glb", 1333, 1_000_000, (), "75"),
    Experiment(
        "bunny, clustered", "stanford_bunny.glb", 1600, 800_000, (*CLUSTER, *SMALL), "51.5"
    ),
    Experiment(
        "dragon, memoryless, with normals",
        "stanford_dragon.glb",
        8190,
        4_000_000,
        (*NORMALS, *SMALL),
        "33.5",
        smooth=True,
    ),
    Experiment(
        "bunny, clustered",
        "stanford_bunny.glb",
        1600,
        8_000_000,
        (*CLUSTER, *SMALL),
        "25.3",
        is_long=True,
    ),
    # As viewers show a model without normals of its own whose triangles share vertices.
    Experiment(
        "bunny, image-driven, Gouraud", "stanford_bunny.glb", 1333, 700_000, SMOOTH, smooth=True
    ),
    Experiment("armadillo, image-driven, Gouraud", "armadillo.glb", 864, 450_000, SMOOTH, smooth=True),
    # From a start that is worse than that of effort balanced, so that more is left to find.
    Experiment("bunny, image-driven fast", "stanford_bunny.glb", 1333, 700_000, FAST),
    Experiment("armadillo, image-driven fast", "armadillo.glb", 864, 450_000, FAST),
    Experiment(
        "bunny, image-driven fast", "stanford_bunny.glb", 1333, 8_000_000, FAST, "75", is_long=True
    ),
    Experiment(
        "armadillo, image-driven fast", "armadillo.glb", 864, 8_000_000, FAST, "75", is_long=True
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
    #: Of runs that go on to the end of their budget.
    picture: str | None

    def told(self) -> str:
        """In a line."""
        return f"{self.experiment.name}: E {100 * self.energy_ratio:.1f}%"


class Bench:
    """Runs the program in a folder of its own."""

    def __init__(self, binary: Path, models: Path, out: Path, folder: Path, device: str) -> None:
        self.binary, self.models, self.out, self.folder = binary, models, out, folder
        self.device = device

    def call(self, *args: str | Path) -> str:
        """Runs a command; what it printed."""
        done = subprocess.run(
            [self.binary, *args], capture_output=True, text=True, preexec_fn=cores.pin
        )
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
        self.call("run", model, "--out", out, *flags, *e.budget())
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
        picture = None if e.paper else f"results-{number}.png"
        if picture:
            smooth = ["--shading", "smooth"] if e.smooth else []
            smooth += ["--stored-normals"] if "--optimize-normals" in e.flags else []
            sheet = self.out.parent / picture
            self.call("compare", model, start, end, "--no-distance", "--sheet", sheet, *smooth)
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


def machine(jobs: int) -> str:
    """The cores that a run had."""
    if jobs > 1:
        return f"{cores.EACH} cores for each run, {jobs} runs beside one another"
    return f"{len(os.sched_getaffinity(0))} cores"


def page(
    rows: list[Row],
    models: list[assets.Model],
    dressed: list[dress.Dressed],
    seen: list[inside.Level],
    absent: list[str],
    jobs: int,
) -> str:
    """The whole page."""
    device = rows[0].device if rows else "none"
    parts = [
        "# What image-driven optimization reaches",
        "",
        "Written by `make results`. E is the sum of squared luminance differences on the 20 views "
        "that the run works with (of 256², of 512² where there are more than 1,500 triangles and no "
        "figure of the paper to compare with); d2 is the root mean square difference on 24 views of "
        "512² that it has not seen (0 to 255). Runs with an entry under *paper* were asked to stop at that "
        "energy (`--optimize-until`), which is Lindstrom & Turk's (2000, figures 23 to 25 and their "
        "text) and took them hours; they look at the run-time views alone, where the others look at "
        "more, for the sake of views that nobody has looked at.",
        "",
        f"{machine(jobs)} ({cores.model()}), evaluator `{device}`. Budgets are evaluations, so "
        "all but the seconds is the same on any machine.",
        "",
        table(rows),
    ]
    if absent:
        parts += ["", f"Left out, because the model is not there: {', '.join(absent)}."]
    for row in (row for row in rows if row.picture):
        parts += [
            "",
            f"## {row.experiment.name} → {row.triangles:,} triangles, {row.evaluations:,} evaluations",
            "",
            f"![original, start and end, with differences below]({row.picture})",
        ]
    if models:
        parts += assets.section(models)
    if dressed:
        parts += dress.section(dressed)
    if seen:
        parts += inside.section(seen)
    return "\n".join(parts) + "\n"


#: What `make loadtest` and `make viewers` write.
OTHERS = ("## The service", "## What other programs say of the files")


def other_sections(path: Path) -> str:
    """What others have written into the page, which is kept."""
    text = path.read_text() if path.exists() else ""
    _, *sections = f"\n{text}".split("\n## ")
    kept = (f"## {section}" for section in sections)
    return "".join(f"\n{s.rstrip()}\n" for s in kept if s.splitlines()[0] in OTHERS)


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
    parser.add_argument("--jobs", type=int, default=1, help="runs beside one another")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(args.binary, args.models, args.out, Path(folder), args.device)
        chosen = [
            (number, e)
            for number, e in enumerate(EXPERIMENTS)
            if (not args.only or number in args.only) and not (args.quick and e.is_long)
        ]
        there = [(n, e) for n, e in chosen if (args.models / e.model).exists()]
        absent = [e.name for _, e in chosen if not (args.models / e.model).exists()]
        paths = [
            path
            for path in sorted(args.models.glob("*.glb"), key=lambda path: -path.stat().st_size)
            if not args.only and not (args.quick and path.stat().st_size > QUICK_BYTES)
        ]
        with cores.Pool(args.jobs) as pool:
            # The longest first.
            running = {n: pool.submit(bench.run, n, e) for n, e in reversed(there)}
            measuring = [
                pool.submit(assets.measure, args.binary, path, Path(folder), args.device)
                for path in paths
            ]
            looking = [
                pool.submit(inside.measure, args.binary, path, Path(folder), args.device)
                for path in paths
                if path.stem == inside.MODEL
            ]
            turning = [
                pool.submit(dress.measure, args.binary, path, Path(folder), args.device)
                for path in paths
                if path.stem in dress.MODELS
            ]
            rows = [running[n].result() for n, _ in there]
            models = sorted((m.result() for m in measuring), key=lambda m: m.name)
            dressed = sorted((t.result() for t in turning), key=lambda d: d.name)
            seen = [level for levels in looking for level in levels.result()]
    args.out.write_text(page(rows, models, dressed, seen, absent, args.jobs) + other_sections(args.out))
    print(args.out)


if __name__ == "__main__":
    main()
