"""StudyResult: the values of all clusters of a study, their means, trends and comparisons."""

from __future__ import annotations

import hashlib
import json
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from perrin._arrays import to_plain
from perrin._display import Shown
from perrin.study.comparison import Comparison, compare_conditions
from perrin.study.conditions import (
    QUANTITIES,
    RATIO,
    ClusterValue,
    ConditionMean,
    cluster_values,
    condition_means,
)
from perrin.study.ledger import Entry, read_entries
from perrin.study.manifest import Manifest, manifest_dict, manifest_from
from perrin.study.tables import study_table
from perrin.study.trends import Trend, fit_power_law, fit_trend

if TYPE_CHECKING:
    import os

    import pandas as pd

PROVENANCE, PAGE = "provenance.json", "study.html"


@dataclass(frozen=True, eq=False, repr=False)
class StudyResult(Shown):
    """The result of a study: values of all clusters, means, trends and comparisons.

    Attributes
    ----------
    manifest : Manifest
    folder : Path
        Folder of the study.
    entries : dict of Entry
        Result of every movie by its name.
    """

    manifest: Manifest
    folder: Path
    entries: dict[str, Entry] = field(default_factory=dict)

    @classmethod
    def load(cls, folder: str | os.PathLike[str]) -> StudyResult:
        """Read the folder of a study back.

        Parameters
        ----------
        folder : path

        Raises
        ------
        FileNotFoundError
            If it is no folder of a study.
        ManifestError
            If the manifest in it was changed and has faults.
        """
        place = Path(folder)
        if not (place / PROVENANCE).is_file():
            raise FileNotFoundError(f"{place}: no finished study: it holds no {PROVENANCE}")
        stated = json.loads((place / PROVENANCE).read_text(encoding="utf-8"))
        manifest = manifest_from(stated["manifest"])
        entries = read_entries(place)
        return cls(
            manifest, place, {m.name: entries[m.name] for m in manifest.movies if m.name in entries}
        )

    @cached_property
    def values(self) -> list[ClusterValue]:
        """All coefficients of all clusters."""
        return cluster_values(self.manifest, self.entries)

    @cached_property
    def means(self) -> list[ConditionMean]:
        """Means of every kind of bodies and condition."""
        return condition_means(self.manifest, self.values)

    @cached_property
    def trends(self) -> dict[str, Trend]:
        """Laws that are fitted, by kind of bodies and quantity."""
        found = {}
        first = "".join(self.manifest.conditions[:1])
        for body, of_body in self.by_body().items():
            for quantity in QUANTITIES if self.manifest.law is not None else ():
                usable = [
                    m
                    for m in of_body[quantity]
                    if m.mean.movies is not None
                    and isinstance(m.conditions.get(first), int | float)
                ]
                x = [float(m.conditions[first]) for m in usable]
                if len(set(x)) < 3:
                    continue
                # A condition of 0 may have no value under the law.
                with suppress(ValueError):
                    found[f"{body}: {quantity}"] = fit_trend(
                        [m.mean for m in usable],
                        x,
                        law=self.manifest.law or "constant",  # type: ignore[arg-type]
                    )
            pairs = [
                (a, b)
                for a in of_body["D_R"]
                for b in of_body["D_T"]
                if a.conditions == b.conditions
                and all(m.mean.value > 0 and 0 < m.mean.log_stderr < np.inf for m in (a, b))
            ]
            if len(pairs) >= 3:
                found[f"{body}: D_T against D_R"] = fit_power_law(
                    [a.mean for a, _ in pairs], [b.mean for _, b in pairs]
                )
        return found

    @cached_property
    def comparisons(self) -> list[tuple[ConditionMean, ConditionMean, Comparison]]:
        """The first condition of every kind of bodies and quantity, compared with the others."""
        found = []
        for of_body in self.by_body().values():
            for means in of_body.values():
                usable = [m for m in means if m.mean.dof > 0 and 0 < m.mean.log_stderr < np.inf]
                found += [
                    (usable[0], other, compare_conditions(usable[0].mean, other.mean))
                    for other in usable[1:]
                ]
        return found

    def by_body(self) -> dict[str, dict[str, list[ConditionMean]]]:
        """Return the means by kind of bodies, that with most clusters first, and quantity."""
        found: dict[str, dict[str, list[ConditionMean]]] = {}
        for one in self.means:
            empty: dict[str, list[ConditionMean]] = {name: [] for name in QUANTITIES}
            found.setdefault(one.body, empty)[one.quantity].append(one)
        count = {body: sum(v.body == body for v in self.values) for body in found}
        return {body: found[body] for body in sorted(found, key=lambda b: -count[b])}

    def decoupling(self, one: ConditionMean) -> float | None:
        """Return D_T/D_R over that of the predicted body in a dilute fluid, where it is known.

        Parameters
        ----------
        one : ConditionMean
            Mean of D_T/D_R.
        """
        if one.quantity != RATIO or not one.predicted:
            return None
        return one.mean.value / one.predicted

    @property
    def failed(self) -> list[Entry]:
        """Movies without a result."""
        return [one for one in self.entries.values() if one.status == "failed"]

    @property
    def state(self) -> str:
        """SHA-256 of what the results depend on: manifest, inputs and settings of all movies."""
        entries = [
            [e.name, e.status, e.sha256, e.settings, e.reason]
            for e in sorted(self.entries.values(), key=lambda e: e.name)
        ]
        stated = json.dumps([manifest_dict(self.manifest), entries], sort_keys=True)
        return hashlib.sha256(stated.encode("utf-8")).hexdigest()

    @property
    def is_written(self) -> bool:
        """Whether the files of the folder are those of this result."""
        try:
            text = (self.folder / PROVENANCE).read_text(encoding="utf-8")
        except OSError:
            return False
        return bool(json.loads(text)["state"] == self.state) and (self.folder / PAGE).is_file()

    def to_frame(self) -> pd.DataFrame:
        """Return all values as a tidy table, the content of ``results.csv``."""
        return study_table(self.manifest, self.values, self.means)

    def to_dict(self) -> dict[str, Any]:
        """Return means, trends and comparisons for JSON: ``summary.json`` of the study."""
        return {
            "title": self.manifest.title,
            "movies": len(self.manifest.movies),
            "failed": {one.name: one.reason for one in self.failed},
            "means": [{**one.to_dict(), "decoupling": self.decoupling(one)} for one in self.means],
            "trends": {name: one.to_dict() for name, one in self.trends.items()},
            "comparisons": [
                {
                    "body": a.body,
                    "quantity": a.quantity,
                    "first": to_plain(a.conditions),
                    "second": to_plain(b.conditions),
                    **one.to_dict(),
                }
                for a, b, one in self.comparisons
            ],
        }

    def __str__(self) -> str:
        done = len(self.entries) - len(self.failed)
        lines = [f"{self.manifest.title}: {done} of {len(self.manifest.movies)} movies"]
        lines += [f"  {one}" for one in self.means]
        lines += [f"  {one.name} failed: {one.reason}" for one in self.failed[:10]]
        return "\n".join(lines)
