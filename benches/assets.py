"""Every model at a quarter, a tenth, 3% and 1% of its triangles: the second table of docs/results.md."""

from __future__ import annotations

import json
import os
import subprocess
from dataclasses import dataclass
from pathlib import Path

import cores

SHARES = (0.25, 0.10, 0.03, 0.01)
#: What ends a level that has as few triangles as was asked.
REACHED = ("triangles", "ratio")


@dataclass
class Level:
    """One level of detail."""

    asked: int
    triangles: int
    stopped_by: str
    #: d2 on unseen views, percent of full scale: ours, likewise before it was optimized (if it was), and of memoryless
    #: at as many triangles.
    d2: float
    simplified: float | None
    memoryless: float

    def told(self) -> str:
        """In a cell of the table."""
        shares = [d2 / self.memoryless for d2 in (self.simplified, self.d2) if d2 is not None]
        end = "" if self.stopped_by in REACHED else f" {self.stopped_by}"
        told = ", ".join(f"{share:.2f}" for share in shares)
        return f"{self.triangles:,}: {self.d2:.2f} ({told}){end}"


@dataclass
class Model:
    """What a chain of levels took and gave."""

    name: str
    triangles: int
    #: Of processor, all threads together.
    seconds: float
    #: Peak of resident memory.
    mebibytes: float
    levels: list[Level]

    def told(self) -> str:
        """In a line: that of the table."""
        return table([self]).splitlines()[-1]


def timed(command: list[str | Path]) -> tuple[float, float]:
    """Runs a command: processor seconds, and peak of resident memory in MiB."""
    process = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, preexec_fn=cores.pin
    )
    assert process.stderr is not None
    told = process.stderr.read()
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode != 0:
        raise SystemExit(f"results: {' '.join(map(str, command))}: {told[-2000:].decode()}")
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024


def levels_of(out: Path) -> dict:
    """The report of a run."""
    return json.loads((out / "report.json").read_text())


def unseen_d2(binary: Path, model: Path, level: Path, report: dict) -> float:
    """d2 on unseen views, percent of full scale; in colours, as runs draw it, unless it has but one."""
    layers = " ".join(report["input"]["layers"])
    is_white = report["input"]["materials"] <= 1 and "colour" not in layers and "texture" not in layers
    flags = [] if is_white else ["--colours"]
    told = subprocess.run(
        [binary, "compare", model, level, "--json", "--no-distance", *flags],
        capture_output=True,
        check=True,
        preexec_fn=cores.pin,
    )
    return json.loads(told.stdout)["d2_percent"]


def measure(binary: Path, model: Path, folder: Path, device: str) -> Model:
    """A chain at effort fast, and memoryless levels of the same sizes beside it."""
    ours, plain = folder / f"{model.stem}-ours", folder / f"{model.stem}-plain"
    ratios = ",".join(map(str, SHARES))
    flags = ["--effort", "fast", "--device", device]
    seconds, mebibytes = timed(
        [binary, "run", model, "--ratio", ratios, "--out", ours, *flags]
    )
    report = levels_of(ours)
    counts = [level["triangles"] for level in report["levels"]]
    timed(
        [binary, "run", model, "--triangles", ",".join(map(str, counts)), "--out", plain]
        + ["--simplify", "memoryless", "--device", device]
    )
    levels = []
    for i, (share, level) in enumerate(zip(SHARES, report["levels"])):
        # Levels finer than pictures show are not optimized, and nobody has looked at them yet.
        optimized = level.get("optimization")
        simplified, unseen = (
            optimized["d2_unseen_percent"]
            if optimized
            else (None, unseen_d2(binary, model, ours / f"lod-{i}.glb", report))
        )
        levels.append(
            Level(
                asked=round(share * report["input"]["triangles"]),
                triangles=level["triangles"],
                stopped_by=level["stopped_by"],
                d2=unseen,
                simplified=simplified,
                memoryless=unseen_d2(binary, model, plain / f"lod-{i}.glb", report),
            )
        )
    return Model(model.stem, report["input"]["triangles"], seconds, mebibytes, levels)


def table(models: list[Model]) -> str:
    """The table of all models."""
    heads = " | ".join(f"{100 * share:g}%" for share in SHARES)
    lines = [
        f"| model | triangles | {heads} | processor seconds | peak MiB |",
        "|---|---:|" + "---:|" * len(SHARES) + "---:|---:|",
    ]
    for m in models:
        cells = " | ".join(level.told() for level in m.levels)
        lines.append(
            f"| {m.name} | {m.triangles:,} | {cells} | {m.seconds:.0f} | {m.mebibytes:,.0f} |"
        )
    return "\n".join(lines)


def section(models: list[Model]) -> list[str]:
    """The section of the page."""
    return [
        "",
        "## Every model, four levels in one run",
        "",
        "`lookalike run MODEL --ratio .25,.1,.03,.01 --effort fast`, with the optimization that comes "
        "with it. Each level: triangles, d2 on unseen views in percent of full scale, in brackets what "
        "that is of memoryless simplification to as many triangles, before optimization and after it "
        "(one share where there was none), and what ended it where that was not "
        "the number of triangles. Processor seconds (all threads together) and memory are those of the "
        "whole process: reading, all four levels, files and pictures.",
        "",
        table(models),
    ]
