"""Clusters of all runs gathered by kind of body and condition, and their means."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from perrin._arrays import to_plain
from perrin._display import Shown
from perrin.study.influence import Influence, leave_one_out
from perrin.study.mixture import RunKind, study_kinds
from perrin.study.profiles import Coefficient, ratio_of
from perrin.study.random_effects import PopulationMean, population_mean

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from perrin.study.ledger import Entry
    from perrin.study.manifest import Manifest, StudyMovie

RATIO = "D_T/D_R"
QUANTITIES = ("D_R", "D_T", RATIO)
QUANTITY_UNITS = {"D_R": "rad^2/s", "D_T": "um^2/s", RATIO: "um^2"}


@dataclass(frozen=True)
class ClusterValue:
    """One coefficient of one cluster of a study.

    Attributes
    ----------
    movie : StudyMovie
    cluster : int
    label : str or None
    body : str
        Kind of body in the study.
    quantity : {"D_R", "D_T", "D_T/D_R"}
        D_R is D_perp for rods.
    coefficient : Coefficient
    verdict : str
        Kind of the motion; of both motions where the quantity is their ratio.
    apart_because : str
        Why it is not averaged; empty where it is.
    predicted : float or None
        Prediction for spheres of the stated diameter.
    frames, warnings : int
        Number of frames with a pose, and of warnings of the cluster.
    """

    movie: StudyMovie
    cluster: int
    label: str | None
    body: str
    quantity: str
    coefficient: Coefficient
    verdict: str
    apart_because: str
    predicted: float | None
    frames: int
    warnings: int

    @property
    def name(self) -> str:
        """Movie and cluster."""
        return cluster_name(self.movie.name, self.label, self.cluster)


@dataclass(frozen=True, eq=False, repr=False)
class ConditionMean(Shown):
    """The mean of a coefficient of one kind of bodies under one condition.

    Attributes
    ----------
    body : str
        Kind of body.
    conditions : dict
        Values of the conditions.
    quantity : str
        "D_R", "D_T" or "D_T/D_R".
    mean : PopulationMean
    apart : dict of int
        Number of clusters that are not averaged, by reason.
    predicted : float or None
        Median of the predictions.
    outlying : tuple of tuple
        Name and `Influence` of the clusters and movies that lie outside the scatter of the others.
    """

    body: str
    conditions: dict[str, float | str]
    quantity: str
    mean: PopulationMean
    apart: dict[str, int]
    predicted: float | None
    outlying: tuple[tuple[str, Influence], ...] = ()

    @property
    def label(self) -> str:
        """The conditions in words."""
        return condition_text(self.conditions)

    def __str__(self) -> str:
        return f"{self.body}, {self.label}: {self.quantity} = {self.mean.text}"

    def to_dict(self) -> dict[str, Any]:
        """Return the mean for JSON."""
        return {
            "body": self.body,
            "conditions": to_plain(self.conditions),
            "quantity": self.quantity,
            "mean": self.mean.to_dict(),
            "apart": dict(self.apart),
            "predicted": self.predicted,
            "outlying": [{"name": name, **one.to_dict()} for name, one in self.outlying],
        }


def cluster_name(movie: str, label: str | None, number: int) -> str:
    """Return how a cluster of a study is called in texts.

    Parameters
    ----------
    movie : str
        Name of the movie.
    label : str or None
        The user's label of the cluster.
    number : int

    Examples
    --------
    >>> cluster_name("monday", None, 3)
    'monday, cluster 3'
    """
    return f"{movie}, cluster {label or number}"


def condition_text(conditions: Mapping[str, float | str]) -> str:
    """Return the values of conditions in words.

    Parameters
    ----------
    conditions : mapping

    Examples
    --------
    >>> condition_text({"phi": 0.45, "salt": "none"}), condition_text({})
    ('phi = 0.45, salt = none', 'all samples')
    """
    parts = [
        f"{k} = {v:.6g}" if isinstance(v, float) else f"{k} = {v}" for k, v in conditions.items()
    ]
    return ", ".join(parts) or "all samples"


def cluster_values(manifest: Manifest, entries: Mapping[str, Entry]) -> list[ClusterValue]:
    """Return all coefficients of all clusters, with the reason where one is not averaged.

    Parameters
    ----------
    manifest : Manifest
    entries : mapping of Entry
        Results by the names of movies.

    Returns
    -------
    list of ClusterValue
    """
    measured = [(m, entries[m.name]) for m in manifest.movies if m.name in entries]
    kinds = [
        (
            m.name,
            k,
            RunKind(one["size"], one["point_group"], np.array(one["template"]), one["count"]),
        )
        for m, entry in measured
        for k, one in enumerate(entry.kinds)
    ]
    names = study_kinds([kind for _, _, kind in kinds]) if kinds else []
    body = {(movie, k): name for (movie, k, _), name in zip(kinds, names, strict=True)}
    values = []
    for movie, entry in measured:
        for one in entry.clusters:
            pair = {name: Coefficient.from_dict(one[name]) for name in ("D_R", "D_T")}
            verdicts = {name: str(one[name]["verdict"]) for name in pair}
            predicted = {name: one[name]["predicted"] for name in pair}
            both = None not in predicted.values()
            verdicts[RATIO] = verdicts["D_R"]
            if verdicts["D_T"] not in manifest.average or verdicts["D_R"] == "not judged":
                verdicts[RATIO] = verdicts["D_T"]
            excluded = movie.excluded_because(one["cluster"], one["label"])
            coefficients = {**pair, RATIO: ratio_of(pair["D_T"], pair["D_R"])}
            values += [
                ClusterValue(
                    movie=movie,
                    cluster=one["cluster"],
                    label=one["label"],
                    body=body.get((movie.name, one["kind"]), "unknown"),
                    quantity=name,
                    coefficient=coefficients[name],
                    verdict=verdicts[name],
                    apart_because=excluded
                    or ("not rigid" if one["rigid"] is False else "")
                    or ("" if verdicts[name] in manifest.average else f"motion: {verdicts[name]}")
                    or (coefficients[name].absent_because or ""),
                    predicted=predicted["D_T"] / predicted["D_R"]
                    if name == RATIO and both
                    else predicted.get(name),
                    frames=one["frames"],
                    warnings=len(one["warnings"]),
                )
                for name in QUANTITIES
            ]
    return values


def condition_means(manifest: Manifest, values: Sequence[ClusterValue]) -> list[ConditionMean]:
    """Return the means of every kind of bodies under every condition.

    Parameters
    ----------
    manifest : Manifest
    values : sequence of ClusterValue

    Returns
    -------
    list of ConditionMean
        Sorted by kind, quantity and condition; none where no cluster is averaged.
    """
    groups: dict[tuple[str, str, tuple[float | str, ...]], list[ClusterValue]] = {}
    for one in values:
        at = tuple(one.movie.conditions[name] for name in manifest.conditions)
        groups.setdefault((one.body, one.quantity, at), []).append(one)

    def place(key: tuple[str, str, tuple[float | str, ...]]) -> tuple[Any, ...]:
        order = [(isinstance(v, str), 0.0 if isinstance(v, str) else v, str(v)) for v in key[2]]
        return key[0], QUANTITIES.index(key[1]), order

    found = []
    for body, quantity, at in sorted(groups, key=place):
        members = groups[body, quantity, at]
        used = [one for one in members if not one.apart_because]
        if not used:
            continue
        coefficients = [one.coefficient for one in used]
        units = [one.movie.unit for one in used]
        mean = population_mean(coefficients, movies=units, unit=QUANTITY_UNITS[quantity])
        known = [one.predicted for one in members if one.predicted is not None]
        movies = list(dict.fromkeys(units))
        outlying = [
            (used[one.index].name if kind == "cluster" else movies[one.index], one)
            for kind in ("cluster", "movie")
            for one in leave_one_out(coefficients, movies=units, kind=kind, mean=mean)
            if one.outlying
        ]
        found.append(
            ConditionMean(
                body=body,
                conditions=dict(zip(manifest.conditions, at, strict=True)),
                quantity=quantity,
                mean=mean,
                apart=dict(Counter(o.apart_because for o in members if o.apart_because)),
                predicted=float(np.median(known)) if known else None,
                outlying=tuple(outlying),
            )
        )
    return found
