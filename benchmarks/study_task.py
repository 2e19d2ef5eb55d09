"""A stand-in for the measurement of a movie, in a module that the workers of Dask can import."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

import perrin
from perrin.study import Entry, write_entry
from perrin.study.ledger import settings_of, stamp_of

if TYPE_CHECKING:
    from perrin.study.running import Task

CLUSTERS = 10  # of a movie


@dataclass(frozen=True)
class StandIn:
    """A task that takes a time (s) and writes what a measurement writes."""

    seconds: float

    def __call__(self, task: Task) -> Entry:
        """Write the entry and the run folder of a movie whose values are drawn."""
        start = time.monotonic()
        rng = np.random.default_rng(int(task.movie.options["dt"]))
        template = perrin.Cluster.touching(4, 1.0).positions.tolist()
        clusters = []
        for number in range(CLUSTERS):
            values = {}
            for name, unit in (("D_R", "rad^2/s"), ("D_T", "um^2/s")):
                D = float(np.exp(rng.normal(0, 0.2)))
                values[name] = {
                    "symbol": name, "value": D, "stderr": 0.1 * D, "unit": unit, "resolved": True,
                    "ci68": [0.9 * D, 1.11 * D], "ci95": [0.82 * D, 1.22 * D],
                    "verdict": "diffusion", "predicted": None,
                }  # fmt: skip
            clusters.append(
                {"cluster": number, "label": None, "kind": 0, "rigid": True, "frames": 300,
                 "warnings": ["a warning of some length, as they are"], **values}
            )  # fmt: skip
        folder = Path(task.folder) / "runs" / task.movie.name
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "run.json").write_text("{}")
        kind = {"size": 4, "point_group": "T_d", "count": CLUSTERS, "template": template}
        entry = Entry(
            task.movie.name, "done", sha256="0" * 64, clusters=tuple(clusters), kinds=(kind,),
            settings=settings_of(task.movie, reports=task.reports), stamp=stamp_of(task.movie.path),
        )  # fmt: skip
        write_entry(Path(task.folder), entry)
        time.sleep(max(0.0, self.seconds - (time.monotonic() - start)))
        return entry
