"""Several runs beside one another, each with processor cores of its own."""

from __future__ import annotations

import os
import queue
import threading
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Callable

#: Cores of one run, where several runs share the machine.
EACH = 2

_mine = threading.local()


def pin() -> None:
    """In the child of a thread of a pool: keeps to the cores of that thread."""
    if cores := getattr(_mine, "cores", None):
        os.sched_setaffinity(0, cores)


def model() -> str:
    """What the processor calls itself."""
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return os.uname().machine


class Pool:
    """Threads that each wait for one run at a time; with one thread, a run has the whole machine."""

    def __init__(self, n: int) -> None:
        mine = sorted(os.sched_getaffinity(0))
        shares = [set(mine[i * EACH : (i + 1) * EACH]) for i in range(n)]
        if n > 1 and len(shares[-1]) < EACH:
            raise SystemExit(f"results: {n} runs want {n * EACH} cores, here are {len(mine)}")
        free: queue.Queue[set[int] | None] = queue.Queue()
        for share in shares:
            free.put(share if n > 1 else None)

        def begin() -> None:
            _mine.cores = free.get()

        self._threads = ThreadPoolExecutor(n, initializer=begin)

    def __enter__(self) -> Pool:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        self._threads.shutdown(cancel_futures=kind is not None)

    def submit(self, call: Callable, *args: object) -> Future:
        """Calls when a thread is free; what is printed about it is its result."""
        return self._threads.submit(self._told, call, *args)

    @staticmethod
    def _told(call: Callable, *args: object) -> object:
        result = call(*args)
        print(result.told(), flush=True)
        return result
