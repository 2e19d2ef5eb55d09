"""What speaks against a measurement made from images: each check returns what has to be told."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from perrin.grouping import REACH

if TYPE_CHECKING:
    from collections.abc import Mapping

    import pandas as pd

    from perrin._arrays import Floats, Ints
    from perrin.motion import RigidMotion

_LISTED = 10  # frames named one by one
_PAIR = 0.03  # relative error of the mean pair distance that is told
_SATURATED, _SATURATED_LEAST = 1e-5, 10  # share and number of voxels at the end of the range
_FADED = 0.1  # loss of brightness over the movie that is told
_DEPTH, _DEPTH_ERRORS = 0.1, 5.0  # change of brightness over the depth of the stack
_QUARTER, _HALF = 0.25, 0.5  # of the contact distance: steps that endanger identities
_FAST, _SLOW = 2.0, 0.5  # MSAD at one lag over Phi^2; rms rotation per frame, rad


def at(frames: Ints | list[int]) -> str:
    """Name frames in words, runs of neighbours as one.

    Examples
    --------
    >>> at([3, 4, 5, 9]), at([7])
    ('frames 3 to 5, 9', 'frame 7')
    """
    listed = np.unique(np.asarray(frames, dtype=np.int64))
    runs = np.split(listed, np.flatnonzero(np.diff(listed) > 1) + 1)
    words = [f"{r[0]}" if len(r) == 1 else f"{r[0]} to {r[-1]}" for r in runs[:_LISTED]]
    more = f" and {sum(map(len, runs[_LISTED:]))} more" if len(runs) > _LISTED else ""
    return f"frame{'s' if len(listed) > 1 else ''} {', '.join(words)}{more}"


def unreadable(frames: pd.DataFrame) -> list[str]:
    """Name the frames that could not be read, and why."""
    lost = frames[frames["fault"] != ""]
    if not len(lost):
        return []
    return [
        f"{len(lost)} of {len(frames)} frames cannot be read and are left out: "
        f"{at(lost['frame'].to_numpy())} ({lost['fault'].iloc[0]})"
    ]


def empty(frames: pd.DataFrame, *, minmass: float) -> list[str]:
    """Name the frames in which nothing passed the mass cut."""
    read = frames[frames["fault"] == ""]
    none = read[read["spheres"] == 0]
    if not len(none):
        return []
    return [
        f"no particles passed the mass cut ({minmass:.3g}) in {len(none)} of {len(read)} frames: "
        f"{at(none['frame'].to_numpy())}; look at the mass histogram, set minmass or leave them out"
    ]


def saturated(frames: pd.DataFrame, *, voxels: int) -> list[str]:
    """Say which share of the voxels stands at the end of the range."""
    share = frames["saturated"].to_numpy(dtype=np.float64)
    over = (share > _SATURATED) & (share * voxels >= _SATURATED_LEAST)
    if not over.any():
        return []
    return [
        f"saturated voxels: up to {100 * share.max():.2g} % of a frame stand at its highest value, "
        f"in {over.sum()} of {len(frames)} frames; their light is lost and places may be off: "
        "less gain or laser power"
    ]


def faded(features: pd.DataFrame) -> list[str]:
    """Say by how much brightness fell from the first tenth of the frames to the last."""
    by_frame = features.groupby("frame")["mass"].median()
    tenth = max(1, len(by_frame) // 10)
    if len(by_frame) < 4:
        return []
    fall = 1 - float(by_frame.iloc[-tenth:].median() / by_frame.iloc[:tenth].median())
    if not fall > _FADED:
        return []
    return [
        f"brightness fell by {100 * fall:.0f} % over the movie (bleaching): late frames are less "
        "exact"
    ]


def dimmed_with_depth(features: pd.DataFrame) -> list[str]:
    """Say by how much brightness changes from the lowest sphere to the highest."""
    # What was found in the light left over by a crowd has no mass.
    features = features[features["mass"].notna()]
    if "z" not in features or len(features) < 10:
        return []
    relative = features["mass"] / features.groupby("frame")["mass"].transform("median")
    z, y = features["z"].to_numpy(dtype=np.float64), np.log(relative.to_numpy(dtype=np.float64))
    off = z - z.mean()
    power = float(off @ off)
    if not power > 0:
        return []
    slope = float(off @ y) / power
    left = y - y.mean() - slope * off
    error = float(np.sqrt(left @ left / power / len(z)))
    # One sphere keeps its brightness over the frames: only so many spheres are independent.
    frames = max(1, features["frame"].nunique())
    change, doubt = slope * float(np.ptp(z)), error * float(np.ptp(z)) * np.sqrt(frames)
    if not (abs(change) > _DEPTH and abs(change) > _DEPTH_ERRORS * doubt):
        return []
    return [
        f"amplitude changes with depth, by about {100 * np.expm1(change):+.0f} % over "
        f"{np.ptp(z):.3g} um: z is biased, nearly the same in all frames of a cluster"
    ]


def unrefined(features: pd.DataFrame) -> list[str]:
    """Count the fits that failed, by reason."""
    if "reason" not in features:
        return []
    failed = features.loc[features["reason"] != "", "reason"].value_counts()
    if not len(failed):
        return []
    kinds = "; ".join(f"{count} x {why}" for why, count in failed.items())
    return [
        f"{failed.sum()} of {len(features)} places are as found, not refined ({kinds}); the "
        "column reason of features.parquet says which; those of tried fits are not used"
    ]


def pair_distance(
    features: pd.DataFrame, *, contact: float, refine: str | None, axes: list[str]
) -> list[str]:
    """Compare the mean distance of touching spheres of the clusters to the contact distance."""
    mean = mean_pair_distance(features, contact=contact, axes=axes)
    off = mean / contact - 1
    if not abs(off) > _PAIR:
        return []
    why = (
        "centroid bias of touching balls; run refinement (refine='model')"
        if refine is None
        else "the contact distance, the voxel size or the diameter may be wrong"
    )
    return [f"mean pair distance {mean:.3g} um, expected {contact:.3g} ({100 * off:+.0f} %): {why}"]


def mean_pair_distance(features: pd.DataFrame, *, contact: float, axes: list[str]) -> float:
    """Return the mean distance of touching spheres of the same cluster, um; NaN without any."""
    distances = []
    tracked = features[features["cluster"] >= 0]
    for _, rows in tracked.groupby(["frame", "cluster"]):
        x = rows[axes].to_numpy(dtype=np.float64)
        apart = np.linalg.norm(x[:, None] - x, axis=-1)[np.triu_indices(len(x), 1)]
        distances.append(apart[apart < REACH * contact])
    every = np.concatenate([np.empty(0), *distances])
    return float(every.mean()) if every.size else np.nan


def counts(features: pd.DataFrame, *, size: int, contact: float, frames: Ints) -> list[str]:
    """Say in which frames a cluster has not as many spheres as it should, or is not there.

    `features` is that of `Bodies`, `frames` all that could be read.
    """
    told = []
    for cluster, rows in features[features["cluster"] >= 0].groupby("cluster"):
        present = rows.groupby("frame").size()
        first, last = int(present.index.min()), int(present.index.max())
        absent = int(((frames >= first) & (frames <= last)).sum()) - len(present)
        few = present[present < size].value_counts().sort_index()
        crowd = rows.groupby("frame")["together"].max().loc[lambda n: n > size]
        said = [f"{n} found in {_frames(k)}" for n, k in few.items()]
        said += [f"none placed in {_frames(absent)}"] if absent else []
        said += [
            f"{n} found in {_frames(k)} (two clusters within {REACH * contact:.2g} um)"
            for n, k in crowd.value_counts().sort_index().items()
        ]
        said += [f"first seen in frame {first}"] if first > frames.min() else []
        said += [f"lost after frame {last}"] if last < frames.max() else []
        if said:
            told.append(f"cluster {cluster}: {size} expected, {', '.join(said)}")
    return told


def _frames(count: int) -> str:
    return f"{count} frame{'' if count == 1 else 's'}"


def at_border(features: pd.DataFrame, *, margin: float, dropped: Mapping[int, Ints]) -> list[str]:
    """Say which clusters come near the border, and which of their frames were dropped.

    `features` is that of `Bodies`.
    """
    told = []
    tracked = features[features["cluster"] >= 0]
    near = tracked[tracked["border"] < margin].groupby("cluster")["frame"]
    touched = {int(cluster): frames.unique() for cluster, frames in near}
    for cluster in sorted({*touched, *dropped}):
        gone = dropped.get(cluster, np.empty(0, dtype=np.int64))
        frames = np.union1d(touched.get(cluster, np.empty(0, dtype=np.int64)), gone)
        text = (
            f"cluster {cluster}: centre within d/2 + 2 sigma ({margin:.2g} um) of the border in "
            f"{at(frames)}"
        )
        text += (
            f"; frames dropped, as spheres are out of view: {at(gone).partition(' ')[2]}"
            if len(gone)
            else ""
        )
        told.append(text)
    return told


def scan_blur(
    motion: RigidMotion, *, D_T: float, plane_time: float | None, height: float, diameter: float
) -> list[str]:
    """Say how far a cluster moves while its planes are scanned; `height` of a plane, um."""
    if plane_time is None or motion.template.shape[1] != 3 or not D_T > 0:
        return []
    planes = (2 * motion.R + diameter) / height
    scan = planes * plane_time
    blur, sigma = float(np.sqrt(2 * D_T * scan)), float(motion.sigma)
    if not blur > sigma:
        return []
    return [
        f"cluster scanned in {scan:.2g} s ({planes:.0f} planes of {plane_time:.2g} s): motion blur "
        f"about {1e3 * blur:.0f} nm > sigma {1e3 * sigma:.0f} nm; positions are of different "
        "moments; scan faster or take fewer planes"
    ]


def step_length(motion: RigidMotion, *, contact: float) -> float:
    """Return the rms displacement of a particle between neighbouring frames over the contact."""
    square = _squares(motion)
    return float(np.sqrt(square)) / contact if np.isfinite(square) else 0.0


def long_steps(motion: RigidMotion, *, contact: float) -> list[str]:
    """Warn of steps over a quarter of the contact distance, which endanger identities."""
    over = step_length(motion, contact=contact)
    if over <= _QUARTER:
        return []
    safe = motion.dt * (_QUARTER / over) ** 2
    return [
        f"rms step {over * contact:.3g} um is over a quarter of the contact distance "
        f"{contact:.3g} um: identities are unsafe at dt = {motion.dt:.3g} s; they are safe below "
        f"dt = {safe:.2g} s"
    ]


def refused(motion: RigidMotion, *, contact: float) -> str:
    """Return why a cluster is refused for steps over half the contact distance; "" if it is not."""
    over = step_length(motion, contact=contact)
    if over <= _HALF:
        return ""
    fast = motion.dt * (_QUARTER / over) ** 2
    return (
        f"rms step {over * contact:.3g} um is over half of the contact distance {contact:.3g} um: "
        f"who is who cannot be told; take frames every {fast:.2g} s"
    )


def _squares(motion: RigidMotion) -> float:
    """Return the mean square displacement of the particles over one frame, um^2."""
    start, stop = _neighbours(motion)
    x = motion.positions()
    square = ((x[stop] - x[start]) ** 2).sum(axis=-1)
    return float(square.mean()) if square.size else np.nan


def _neighbours(motion: RigidMotion) -> tuple[Ints, Ints]:
    """Return the rows of the steps that join neighbouring frames."""
    start, stop = motion.steps()
    near = motion.time[stop] - motion.time[start] < 1.5 * motion.dt
    return start[near], stop[near]


def sampling(motion: RigidMotion, *, phi2: float) -> list[str]:
    """Say where frames are too far apart or too close for the rotation."""
    angles = _step_angles(motion)
    if not angles.size:
        return []
    rms = float(np.sqrt(np.mean(angles**2)))
    told = []
    if motion.template.shape[1] == 3 and rms > _SLOW:
        told.append(
            f"rms rotation per frame {rms:.2g} rad: sampling too slow, D_R biased low; take "
            "frames more often"
        )
    # Of a step's three angles two turn a direction: MSAD = 2/3 of the mean square rotation.
    first = rms**2 * (2 / 3 if motion.template.shape[1] == 3 else 1)
    if phi2 > 0 and first < _FAST * phi2:
        told.append(
            f"MSAD at first lag {first:.2g} rad^2 < 2 x Phi^2 ({phi2:.2g}): sampling too fast, "
            "steps are mostly noise; fewer frames over a longer time tell more"
        )
    return told


def _step_angles(motion: RigidMotion) -> Floats:
    """Return the rotation angles between neighbouring frames, rad."""
    _, stop = _neighbours(motion)
    return np.asarray(np.linalg.norm(motion.step_vectors()[stop - 1], axis=-1))
