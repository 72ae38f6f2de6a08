"""The energy curve: samples as they arrive, and their picture."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from matplotlib.figure import Figure

from lookalike.v1 import event_pb2


@dataclass(frozen=True)
class Sample:
    """A point of the energy curve; the columns of `energy.csv`."""

    #: Number of its event in the job's log.
    seq: int
    #: `memoryless`, `image` or `optimize`.
    stage: str
    #: Energy evaluations of the stage so far.
    evaluations: int
    #: Seconds since the attempt began.
    seconds: float
    triangles: int
    #: Sum of squared luminance differences (0 to 255 units); None where no pictures are kept.
    energy: int | None
    #: The papers' d2, percent of full scale.
    d2: float | None


def sample(event: event_pb2.JobEvent) -> Sample:
    """The sample that an event of kind `energy_sample` carries."""
    s = event.energy_sample
    return Sample(
        seq=event.seq,
        stage=s.stage,
        evaluations=s.evaluations,
        seconds=s.seconds,
        triangles=s.triangles,
        energy=s.energy if s.HasField("energy") else None,
        d2=s.d2 if s.HasField("d2") else None,
    )


#: What plot_energy can draw to the right, and how an axis is named.
_AXES: dict[str, tuple[str, Callable[[Sample], float]]] = {
    "evaluations": ("energy evaluations of the stage", lambda s: s.evaluations),
    "seconds": ("seconds", lambda s: s.seconds),
    "triangles": ("triangles", lambda s: s.triangles),
}


def plot_energy(
    samples: Iterable[Sample], path: str | os.PathLike[str] | None = None, x: str = "evaluations"
) -> Figure:
    """Draws d2 (percent of full scale) over `x`: evaluations, seconds or triangles.

    One line a stage. Writes a picture to `path` (the extension gives the format) and returns the
    matplotlib figure. Raises ValueError when no sample has a d2.
    """
    if x not in _AXES:
        raise ValueError(f"`{x}` is no axis: use {', '.join(_AXES)}")
    label, value = _AXES[x]
    stages: dict[str, tuple[list[float], list[float]]] = {}
    for point in samples:
        if point.d2 is not None:
            xs, ys = stages.setdefault(point.stage, ([], []))
            xs.append(value(point))
            ys.append(point.d2)
    if not stages:
        raise ValueError("no sample has a d2: pictures are kept only with method='image'")
    # Not pyplot: it would keep the figure, and choose a window where there may be no screen.
    figure = Figure(figsize=(8, 4.5), layout="constrained")
    axes = figure.subplots()
    for stage, (xs, ys) in stages.items():
        axes.plot(xs, ys, marker=".", markersize=3, linewidth=1, label=stage)
    axes.set_xlabel(label)
    axes.set_ylabel("d2, % of full scale")
    if x == "triangles":
        # From fine to coarse, as the work goes.
        axes.set_xscale("log")
        axes.invert_xaxis()
    axes.grid(alpha=0.3)
    axes.legend()
    if path is not None:
        figure.savefig(path, dpi=150)
    return figure
