"""One job, followed: its events with a progress bar, its energy curve, its result."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import trimesh
from tqdm.auto import tqdm

from lookalike import curve, errors, models
from lookalike.v1 import event_pb2, job_pb2

if TYPE_CHECKING:
    from lookalike.client import Client


@dataclass(frozen=True)
class Result:
    """What a job that succeeded leaves."""

    job: job_pb2.Job
    #: The levels of detail, in the order asked for; none of an evaluation.
    lods: list[models.Geometry]
    #: `report.json`.
    report: dict[str, Any]
    #: Where the files were written; empty when no folder was given.
    paths: list[Path]
    #: `comparison.json` of an evaluation; None of other jobs.
    comparison: dict[str, Any] | None = None


class Run:
    """An iterator of a job's events; see `Client.simplify` and `Client.run`.

    Leaving it early, or losing it, never cancels the job: use `cancel`.
    """

    def __init__(
        self,
        client: Client,
        job: str,
        *,
        progress: bool = True,
        like: type[models.Geometry] = trimesh.Scene,
    ) -> None:
        #: The job's name, `jobs/{id}`.
        self.job = job
        #: The energy curve so far. Samples of a lost attempt are taken out again.
        self.samples: list[curve.Sample] = []
        self._client = client
        self._like = like
        self._events = client.watch(job)
        self._bar = _Bar(job, progress)

    def __iter__(self) -> Iterator[event_pb2.JobEvent]:
        return self

    def __next__(self) -> event_pb2.JobEvent:
        try:
            event = next(self._events)
        except BaseException:
            # The end of the log, a fault, or Ctrl-C: no bar is left half drawn.
            self._bar.close()
            raise
        kind = event.WhichOneof("body")
        if kind == "energy_sample":
            self.samples.append(curve.sample(event))
        elif kind == "attempt_restarted":
            last = event.attempt_restarted.rewind_to_seq
            self.samples = [sample for sample in self.samples if sample.seq <= last]
        self._bar.show(event)
        return event

    def result(self, folder: str | os.PathLike[str] | None = None) -> Result:
        """Waits for the end and fetches the result; with a `folder`, all files are written there.

        Levels are Trimesh objects when one was given, Scene objects otherwise. Raises JobFailed or
        JobCancelled when there is no result.
        """
        for _ in self:
            pass
        job = self._client.job(self.job)
        if job.state == job_pb2.JOB_STATE_CANCELLED:
            raise errors.JobCancelled(job.name)
        if job.state != job_pb2.JOB_STATE_SUCCEEDED:
            raise errors.JobFailed(job.name, job.failure.reason, job.failure.text)
        paths = [] if folder is None else self._client.fetch(job.name, folder)
        if job.spec.WhichOneof("kind") == "evaluate":
            files = self._files(["comparison.json", "report.json"], paths)
            report, comparison = (json.loads(files[f"{n}.json"]) for n in ("report", "comparison"))
            return Result(job, [], report, paths, comparison)
        # A mesh that was simplified already is one level.
        asked = job.spec.simplify
        budgets = (
            asked.triangles,
            asked.ratios,
            asked.level_max_d2,
            asked.screen_size,
            asked.max_bytes,
        )
        n_levels = max(map(len, budgets)) or 1
        levels = [f"lod-{i}.glb" for i in range(n_levels)]
        files = self._files([*levels, "report.json"], paths)
        lods = [models.load_glb(files[level], self._like) for level in levels]
        return Result(job, lods, json.loads(files["report.json"]), paths)

    def cancel(self) -> job_pb2.Job:
        """Cancels the job and waits until that is confirmed; its events can be read on."""
        return self._client.cancel(self.job)

    def close(self) -> None:
        """Stops following. The job goes on."""
        self._bar.close()
        self._events.close()

    def _files(self, names: list[str], paths: list[Path]) -> dict[str, bytes]:
        """The contents of some files of the job, from `paths` where they are there already."""
        here = {path.name: path for path in paths}
        there = {} if here else {models.file_of(a): a for a in self._client.artifacts(self.job)}
        missing = [name for name in names if name not in here and name not in there]
        if missing:
            raise errors.ProtocolFault(
                f"{self.job} succeeded without {missing[0]}: "
                "run server and client of the same version"
            )
        return {
            name: here[name].read_bytes() if name in here else self._client.read(there[name])
            for name in names
        }


class _Bar:
    """A progress bar in percent of the whole job, with what the last sample said."""

    FORMAT = "{desc} {percentage:3.0f}%|{bar}| {elapsed}{postfix}"

    def __init__(self, job: str, progress: bool) -> None:
        # The end of the job's name tells jobs of the same minute apart.
        self._bar = tqdm(total=1.0, desc=job[-8:], bar_format=self.FORMAT, disable=not progress)
        self._facts: dict[str, str] = {}

    def show(self, event: event_pb2.JobEvent) -> None:
        """Takes in one event."""
        kind = event.WhichOneof("body")
        if kind == "progress":
            progress = event.progress
            self._facts["stage"] = progress.stage
            self._facts.pop("left", None)
            if progress.HasField("eta_secs"):
                self._facts["left"] = f"{progress.eta_secs:.0f} s"
            self._bar.n = progress.fraction
        elif kind == "energy_sample":
            sample = event.energy_sample
            self._facts["triangles"] = f"{sample.triangles:,}"
            if sample.HasField("d2"):
                self._facts["d2"] = f"{sample.d2:.3f}%"
        elif kind == "state_changed":
            state = event.state_changed.state
            name = job_pb2.JobState.Name(state)
            self._facts["state"] = name.removeprefix("JOB_STATE_").lower()
            if state == job_pb2.JOB_STATE_SUCCEEDED:
                # The last progress was told before the files were written.
                self._facts.pop("left", None)
                self._bar.n = self._bar.total
        elif kind == "attempt_restarted":
            self._facts.clear()
            self._bar.n = 0.0
        elif kind == "note":
            self._line(event.note.text)
        self._bar.set_postfix(self._facts, refresh=False)
        self._bar.update(0)

    def close(self) -> None:
        """Leaves the bar as it is on the screen."""
        self._bar.close()

    def _line(self, text: str) -> None:
        """A line above the bar."""
        if not self._bar.disable:
            tqdm.write(text, file=sys.stderr)
