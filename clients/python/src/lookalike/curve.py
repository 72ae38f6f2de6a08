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
    #: Which level is being optimized, from 0 in the order asked for; None in other stages.
    level: int | None = None
    #: Energy as a share of what it was when this level's optimization began.
    energy_ratio: float | None = None
    #: d2 over views that the job does not work with; now and then.
    d2_unseen: float | None = None
    #: The turn of the view sets it was taken in: the energy may rise from one turn to the next.
    turn: int | None = None


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
        level=s.level if s.HasField("level") else None,
        energy_ratio=s.energy_ratio if s.HasField("energy_ratio") else None,
        d2_unseen=s.d2_unseen if s.HasField("d2_unseen") else None,
        turn=s.turn if s.HasField("turn") else None,
    )


def _line_of(point: Sample) -> str:
    """The line of the picture that a sample belongs to."""
    return point.stage if point.level is None else f"{point.stage}, level {point.level}"


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

    One line a stage, and one a level that is optimized; dots on them are d2 over unseen views. Writes a picture to `path` (the extension gives the format) and returns the
    matplotlib figure. Raises ValueError when no sample has a d2.
    """
    if x not in _AXES:
        raise ValueError(f"`{x}` is no axis: use {', '.join(_AXES)}")
    label, value = _AXES[x]
    lines: dict[str, tuple[list[float], list[float]]] = {}
    unseen: list[tuple[float, float]] = []
    for point in samples:
        if point.d2 is not None:
            xs, ys = lines.setdefault(_line_of(point), ([], []))
            xs.append(value(point))
            ys.append(point.d2)
        if point.d2_unseen is not None:
            unseen.append((value(point), point.d2_unseen))
    if not lines:
        raise ValueError("no sample has a d2: pictures are kept only with method='image'")
    # Not pyplot: it would keep the figure, and choose a window where there may be no screen.
    figure = Figure(figsize=(8, 4.5), layout="constrained")
    axes = figure.subplots()
    for label_of_line, (xs, ys) in lines.items():
        axes.plot(xs, ys, marker=".", markersize=3, linewidth=1, label=label_of_line)
    if unseen:
        axes.plot(*zip(*unseen), "k.", markersize=5, linestyle="none", label="unseen views")
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
