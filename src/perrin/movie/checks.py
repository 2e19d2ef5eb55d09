"""What speaks against a measurement made from images, and what informs about it.

Every check returns `Findings`, or a `Verdict` where it is of one cluster. A warning that rests on a
noisy number is a test: it appears where the number exceeds its bound by more than its error allows,
at a level of 1 % (`_LEVEL`) for a true value on the bound itself; movies without the fault lie far
inside.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from perrin._text import listed
from perrin.tracks.clusters import REACH

if TYPE_CHECKING:
    from collections.abc import Mapping

    import pandas as pd

    from perrin._arrays import Floats, Ints
    from perrin.diffusion.estimate import DiffusionEstimate
    from perrin.motion.rigid_motion import RigidMotion


_LISTED = 10  # numbers of frames or clusters in one message


_LEVEL = 0.01  # of the tests, one-sided


_NORMAL = 2.326  # standard errors at that level


_PAIR = 0.03  # relative error of the mean pair distance


_FADED = 0.1  # loss of brightness over the movie


_DEPTH = 0.1  # change of brightness over the depth of the stack


_MISSING = 0.1  # share of the spheres of the clusters


_FAILED = 0.01  # share of the fits


_QUARTER, _HALF = 0.25, 0.5  # of the contact distance: steps that endanger identities


_FAST, _SLOW = 2.0, 0.5  # MSAD at one lag over Phi^2; rms rotation per frame, rad


class Findings(NamedTuple):
    """What is to be reported of a run.

    Attributes
    ----------
    warnings : tuple of str
        What casts doubt on a result.
    notes : tuple of str
        What informs.
    """

    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def __add__(self, other: object) -> Findings:
        """Return both together, in their order."""
        if not isinstance(other, Findings):
            return NotImplemented
        return Findings(self.warnings + other.warnings, self.notes + other.notes)


_NOTHING = Findings()


class Verdict(NamedTuple):
    """What a check says of one cluster, and how grave it is beside that of others."""

    text: str
    size: float


def of_clusters(verdicts: Mapping[str, Verdict | None]) -> dict[str, str]:
    """Return one text where a check speaks of several clusters; each by the cluster it stands for.

    The key is "" for the text about several, whose gravest case is quoted.

    Examples
    --------
    >>> of_clusters({"0": Verdict("too fast", 1.0), "1": None})
    {'0': 'too fast'}
    >>> of_clusters({"0": Verdict("0.3 um", 0.3), "1": Verdict("0.4 um", 0.4), "2": None})
    {'': '2 of 3 clusters (0, 1), the worst is cluster 1: 0.4 um'}
    """
    met = {name: verdict for name, verdict in verdicts.items() if verdict is not None}
    if len(met) < 2:
        return {name: verdict.text for name, verdict in met.items()}
    worst = max(met, key=lambda name: met[name].size)
    return {
        "": f"{len(met)} of {len(verdicts)} clusters ({listed(met)}), the worst is cluster "
        f"{worst}: {met[worst].text}"
    }


def at(frames: Ints | list[int]) -> str:
    """Name frames in words, runs of neighbours as one, by ten numbers at most.

    Examples
    --------
    >>> at([3, 4, 5, 9]), at([7])
    ('frames 3 to 5, 9', 'frame 7')
    """
    every = np.unique(np.asarray(frames, dtype=np.int64))
    runs = np.split(every, np.flatnonzero(np.diff(every) > 1) + 1)
    numbers = np.cumsum([min(len(run), 2) for run in runs])
    shown = int((numbers <= _LISTED).sum())
    words = [f"{r[0]}" if len(r) == 1 else f"{r[0]} to {r[-1]}" for r in runs[:shown]]
    more = f" and {sum(map(len, runs[shown:]))} more" if len(runs) > shown else ""
    return f"frame{'s' if len(every) > 1 else ''} {', '.join(words)}{more}"


def unreadable(frames: pd.DataFrame) -> Findings:
    """Name the frames that could not be read, and why."""
    lost = frames[frames["fault"] != ""]
    if not len(lost):
        return _NOTHING
    text = (
        f"{len(lost)} of {len(frames)} frames cannot be read and are left out: "
        f"{at(lost['frame'].to_numpy())} ({lost['fault'].iloc[0]})"
    )
    return Findings((text,))


def repeated(frames: pd.DataFrame) -> Findings:
    """Name the frames that are copies of an earlier one.

    Noise never repeats: such a frame is no measurement of its time.
    """
    copies = frames[frames["copy_of"] >= 0]
    if not len(copies):
        return _NOTHING
    first = copies.iloc[0]
    text = (
        f"{len(copies)} of {len(frames)} frames repeat an earlier frame exactly, voxel by voxel "
        f"(first: frame {first['frame']}, as frame {first['copy_of']}): they are no measurements "
        f"and are treated as missing: {at(copies['frame'].to_numpy())}"
    )
    return Findings((text,))


def empty(frames: pd.DataFrame, *, minmass: float) -> Findings:
    """Name the frames in which nothing passed the mass cut."""
    read = frames[frames["fault"] == ""]
    none = read[read["spheres"] == 0]
    if not len(none):
        return _NOTHING
    text = (
        f"no particles passed the mass cut ({minmass:.3g}) in {len(none)} of {len(read)} frames: "
        f"{at(none['frame'].to_numpy())}; look at the mass histogram, set minmass or leave them out"
    )
    return Findings((text,))


def saturated(frames: pd.DataFrame) -> Findings:
    """Say which share of the voxels was clipped (`optics.saturated_share`)."""
    share = frames["saturated"].to_numpy(dtype=np.float64)
    over = share > 0
    if not over.any():
        return _NOTHING
    text = (
        f"saturated voxels: up to {100 * np.nanmax(share):.2g} % of a frame pile up at its highest "
        f"value, in {over.sum()} of {len(frames)} frames (chance of one such frame without "
        "saturation under 1e-6); their light is lost and places may be off: less gain or laser "
        "power"
    )
    return Findings((text,))


class Change(NamedTuple):
    """A relative change of brightness, its standard error, and the error's degrees of freedom."""

    value: float
    stderr: float
    freedom: int

    def exceeds(self, bound: float) -> bool:
        """Return whether the change is certainly larger than `bound`, up or down."""
        from scipy.stats import t

        doubt = float(t.isf(_LEVEL / 2, self.freedom)) * self.stderr
        return abs(self.value) - doubt > bound

    def percent(self) -> str:
        """Write the change with its error, in percent."""
        return f"{100 * self.value:+.0f} +- {100 * self.stderr:.1g} %"


def bleaching(features: pd.DataFrame) -> Change | None:
    """Return how the spheres' brightness changed from the first tenth of the frames to the last.

    The change is that of a sphere seen in both, mean over the tracked spheres in logarithms; their
    scatter gives the error. None for fewer than four frames or two such spheres.

    Examples
    --------
    >>> import pandas as pd
    >>> mass = [100, 200, 90, 181, 80, 161, 70, 140]
    >>> table = {"frame": [0, 0, 1, 1, 2, 2, 3, 3], "particle": 4 * [0, 1], "mass": mass}
    >>> bleaching(pd.DataFrame(table | {"cluster": 0})).percent()
    '-30 +- 0 %'
    """
    seen = features[(features["cluster"] >= 0) & (features["mass"] > 0)]
    numbers = np.unique(seen["frame"])
    if len(numbers) < 4:
        return None
    tenth = max(1, len(numbers) // 10)
    light = np.log(seen["mass"].to_numpy(dtype=np.float64))
    of = seen.assign(light=light).set_index("frame").sort_index()
    ends = [
        of.loc[part[0] : part[-1]].groupby(["cluster", "particle"])["light"].mean()
        for part in (numbers[:tenth], numbers[-tenth:])
    ]
    change = (ends[1] - ends[0]).dropna().to_numpy()
    if len(change) < 2:
        return None
    ratio = float(np.exp(change.mean()))
    error = ratio * float(change.std(ddof=1)) / np.sqrt(len(change))
    return Change(ratio - 1, error, len(change) - 1)


def faded(features: pd.DataFrame) -> Findings:
    """Say by how much brightness fell from the first tenth of the frames to the last."""
    change = bleaching(features)
    if change is None or change.value > 0 or not change.exceeds(_FADED):
        return _NOTHING
    text = (
        f"brightness fell by {-100 * change.value:.0f} +- {100 * change.stderr:.1g} % from the "
        "first tenth of the movie to the last (bleaching): late frames are less exact"
    )
    return Findings((text,))


def depth_change(features: pd.DataFrame) -> tuple[Change, float] | None:
    """Return the change of brightness from the lowest sphere to the highest, and their distance.

    One sphere keeps its brightness over the frames, so that only the spheres of one frame are
    independent; None where they are fewer than three or do not differ in height.
    """
    # What was found in the light left over by a crowd has no mass.
    features = features[features["mass"].notna()]
    count = len(features) // max(1, features["frame"].nunique())
    if "z" not in features or count < 3:
        return None
    relative = features["mass"] / features.groupby("frame")["mass"].transform("median")
    z, y = features["z"].to_numpy(dtype=np.float64), np.log(relative.to_numpy(dtype=np.float64))
    off = z - z.mean()
    power, span = float(off @ off), float(np.ptp(z))
    if not power > 0:
        return None
    slope = float(off @ y) / power
    left = y - y.mean() - slope * off
    freedom = count - 2
    error = float(np.sqrt(left @ left / power / freedom))
    ratio = float(np.exp(slope * span))
    return Change(ratio - 1, ratio * error * span, freedom), span


def dimmed_with_depth(features: pd.DataFrame) -> Findings:
    """Say by how much brightness changes from the lowest sphere to the highest."""
    found = depth_change(features)
    if found is None or not found[0].exceeds(_DEPTH):
        return _NOTHING
    change, span = found
    text = (
        f"amplitude changes with depth, by {change.percent()} over {span:.3g} um: z is biased, "
        "nearly the same in all frames of a cluster"
    )
    return Findings((text,))


def unrefined(features: pd.DataFrame) -> Findings:
    """Count the fits that failed, by reason; a warning where they are over 1 %."""
    if "reason" not in features:
        return _NOTHING
    failed = features.loc[features["reason"] != "", "reason"].value_counts()
    if not len(failed):
        return _NOTHING
    kinds = "; ".join(f"{count} x {why}" for why, count in failed.items())
    text = (
        f"{failed.sum()} of {len(features)} places are as found, not refined ({kinds}); the "
        "column reason of features.parquet says which; those of tried fits are not used"
    )
    return _by_share(text, failed.sum() / len(features))


def unsettled(count: int, of: int) -> Findings:
    """Count the poses whose fit to the image failed; a warning where they are over 1 %."""
    if not count:
        return _NOTHING
    text = f"{count} of {of} poses did not settle in the image and are those of the free centres"
    return _by_share(text, count / of)


def _by_share(text: str, share: float) -> Findings:
    return Findings((text,)) if share > _FAILED else Findings(notes=(text,))


def pair_distance(
    features: pd.DataFrame, *, contact: float, refine: str | None, axes: list[str]
) -> Findings:
    """Compare the mean distance of touching spheres of the clusters to the contact distance."""
    mean, error = mean_pair_distance(features, contact=contact, axes=axes)
    off = mean / contact - 1
    if not abs(off) > _PAIR + _NORMAL * error / contact:
        return _NOTHING
    why = (
        "centroid bias of touching balls; run refinement (refine='model')"
        if refine is None
        else "the contact distance, the voxel size or the diameter may be wrong"
    )
    text = (
        f"mean pair distance {mean:.4g} +- {error:.1g} um, expected {contact:.4g} "
        f"({100 * off:+.1f} +- {100 * error / contact:.1g} %): {why}"
    )
    return Findings((text,))


def mean_pair_distance(
    features: pd.DataFrame, *, contact: float, axes: list[str]
) -> tuple[float, float]:
    """Return the mean distance of touching spheres of the same cluster, um, and its error.

    The error of a place may last over all frames, and a sphere touches several others: the scatter
    of the pairs' mean distances gives the error, with half as many independent ones as there are
    spheres; where there is one pair, the scatter of the frames. Both are NaN without any.
    """
    distances, pairs = [np.empty(0)], [np.empty(0, dtype=np.int64)]
    tracked = features[features["cluster"] >= 0].sort_values(["frame", "cluster", "particle"])
    most = int(tracked["particle"].max()) + 1 if len(tracked) else 1
    for (_, cluster), rows in tracked.groupby(["frame", "cluster"]):
        x, particle = rows[axes].to_numpy(dtype=np.float64), rows["particle"].to_numpy()
        first, second = np.triu_indices(len(x), 1)
        apart = np.linalg.norm(x[first] - x[second], axis=-1)
        near = apart < REACH * contact
        distances.append(apart[near])
        pairs.append(((int(cluster) * most + particle[first]) * most + particle[second])[near])
    every, pair = np.concatenate(distances), np.concatenate(pairs)
    if not every.size:
        return np.nan, np.nan
    _, which, count = np.unique(pair, return_inverse=True, return_counts=True)
    mean = float(every.mean())
    if len(count) == 1:
        return mean, float(every.std() / np.sqrt(every.size))
    spheres = len(tracked[["cluster", "particle"]].drop_duplicates())
    scatter = float(np.std(np.bincount(which, every) / count, ddof=1))
    return mean, scatter / np.sqrt(spheres / 2)


def counts(features: pd.DataFrame, *, size: int, contact: float, frames: Ints) -> Findings:
    """Say in which frames clusters have not as many spheres as they should, or are not there.

    `features` is that of `Bodies`, `frames` all that could be read. It is a warning where over 10 %
    of the spheres of the clusters are missing between their first and their last frame.
    """
    texts: dict[int, str] = {}
    missing = expected = 0
    tracked = features[features["cluster"] >= 0]
    for cluster, rows in tracked.groupby("cluster"):
        present = rows.groupby("frame").size()
        first, last = int(present.index.min()), int(present.index.max())
        due = int(((frames >= first) & (frames <= last)).sum())
        few = present[present < size]
        missing += size * (due - len(present)) + int((size - few).sum())
        expected += size * due
        said = _unusual(rows, few, size=size, absent=due - len(present), contact=contact)
        said += [f"first seen in frame {first}"] if first > frames.min() else []
        said += [f"lost after frame {last}"] if last < frames.max() else []
        if said:
            texts[int(cluster)] = ", ".join(said)
    if not texts:
        return _NOTHING
    shown = "; ".join(f"cluster {c}: {text}" for c, text in list(texts.items())[:_LISTED])
    more = f"; and {len(texts) - _LISTED} more" if len(texts) > _LISTED else ""
    text = (
        f"{100 * missing / expected:.2g} % of the spheres are missing, {size} expected in each of "
        f"{tracked['cluster'].nunique()} clusters; {shown}{more}"
    )
    return Findings((text,)) if missing > _MISSING * expected else Findings(notes=(text,))


def _unusual(
    rows: pd.DataFrame, few: pd.Series[int], *, size: int, absent: int, contact: float
) -> list[str]:
    """Say in how many frames one cluster has fewer spheres, none, or more than it should."""
    crowd = rows.groupby("frame")["together"].max().loc[lambda n: n > size]
    said = [f"{n} found in {_frames(k)}" for n, k in few.value_counts().sort_index().items()]
    said += [f"none placed in {_frames(absent)}"] if absent else []
    said += [
        f"{n} found in {_frames(k)} (two clusters within {REACH * contact:.2g} um)"
        for n, k in crowd.value_counts().sort_index().items()
    ]
    return said


def _frames(count: int) -> str:
    return f"{count} frame{'' if count == 1 else 's'}"


def at_border(features: pd.DataFrame, *, margin: float, dropped: Mapping[int, Ints]) -> Findings:
    """Note which clusters come near the border, and which of their frames were dropped.

    `features` is that of `Bodies`.
    """
    tracked = features[features["cluster"] >= 0]
    near = tracked[tracked["border"] < margin].groupby("cluster")["frame"]
    touched = {int(cluster): frames.unique() for cluster, frames in near}
    verdicts: dict[str, Verdict | None] = {
        str(c): None for c in sorted({*tracked["cluster"].unique().tolist(), *dropped})
    }
    for cluster in sorted({*touched, *dropped}):
        gone = dropped.get(cluster, np.empty(0, dtype=np.int64))
        frames = np.union1d(touched.get(cluster, np.empty(0, dtype=np.int64)), gone)
        text = f"in {at(frames)}"
        if len(gone):
            text += f"; dropped, as spheres are out of view: {at(gone)}"
        verdicts[str(cluster)] = Verdict(text, float(len(frames)))
    return Findings(
        notes=tuple(
            f"centre within d/2 + 2 sigma ({margin:.2g} um) of the border, "
            f"{f'cluster {name} ' if name else ''}{text}"
            for name, text in of_clusters(verdicts).items()
        )
    )


def scan_blur(
    motion: RigidMotion,
    *,
    D_T: DiffusionEstimate,
    plane_time: float | None,
    height: float,
    diameter: float,
) -> Verdict | None:
    """Say how far a cluster moves while its planes are scanned; `height` of a plane, um."""
    if plane_time is None or motion.template.shape[1] != 3 or not D_T.value > 0:
        return None
    planes = (2 * motion.R + diameter) / height
    scan = planes * plane_time
    blur, sigma = float(np.sqrt(2 * D_T.value * scan)), float(motion.sigma)
    # The errors of a square root and of a standard deviation are half the relative one.
    blur_error = blur * D_T.stderr / (2 * D_T.value)
    n, freedom = len(motion.template), max(1, motion.fitted.size - 1)
    sigma_error = sigma / np.sqrt(2 * max(1, 3 * n - 6) * freedom)
    if not blur - sigma > _NORMAL * np.hypot(blur_error, sigma_error):
        return None
    text = (
        f"cluster scanned in {scan:.2g} s ({planes:.0f} planes of {plane_time:.2g} s): motion blur "
        f"about {1e3 * blur:.0f} +- {1e3 * blur_error:.1g} nm > sigma {1e3 * sigma:.0f} +- "
        f"{1e3 * sigma_error:.1g} nm; positions are of different moments; scan faster or take "
        "fewer planes"
    )
    return Verdict(text, blur / sigma if sigma > 0 else np.inf)


def step_length(motion: RigidMotion, *, contact: float) -> float:
    """Return the rms displacement of a particle between neighbouring frames over the contact."""
    square, _ = _squares(motion)
    return float(np.sqrt(square)) / contact if np.isfinite(square) else 0.0


def long_steps(motion: RigidMotion, *, contact: float) -> Verdict | None:
    """Warn of steps over a quarter of the contact distance, which endanger identities."""
    over, count = step_length(motion, contact=contact), _squares(motion)[1]
    if not _certainly_over(over, _QUARTER, freedom=count * motion.template.shape[1]):
        return None
    safe = motion.dt * (_QUARTER / over) ** 2
    error = over * contact / np.sqrt(2 * count * motion.template.shape[1])
    text = (
        f"rms step {over * contact:.3g} +- {error:.1g} um is over a quarter of the contact "
        f"distance {contact:.3g} um: identities are unsafe at dt = {motion.dt:.3g} s; they are "
        f"safe below dt = {safe:.2g} s"
    )
    return Verdict(text, over)


def _certainly_over(rms: float, bound: float, *, freedom: int) -> bool:
    """Return whether Gaussian steps of this rms, with so many squares, are longer than `bound`."""
    from scipy.special import chdtri

    return freedom > 0 and bool(freedom * (rms / bound) ** 2 > chdtri(freedom, _LEVEL))


def refused(motion: RigidMotion, *, contact: float) -> str:
    """Return why a cluster is refused for steps over half the contact distance; "" if it is not."""
    over = step_length(motion, contact=contact)
    if over <= _HALF:
        return ""
    fast = motion.dt * (_QUARTER / over) ** 2
    return (
        f"rms step {over * contact:.3g} um is over half of the contact distance {contact:.3g} um: "
        f"which label belongs to which particle cannot be known; take frames every {fast:.2g} s"
    )


def _squares(motion: RigidMotion) -> tuple[float, int]:
    """Return the mean square displacement of the particles over one frame, um^2, and the steps."""
    start, stop = _neighbours(motion)
    x = motion.positions()
    square = ((x[stop] - x[start]) ** 2).sum(axis=-1)
    return (float(square.mean()) if square.size else np.nan), len(start)


def _neighbours(motion: RigidMotion) -> tuple[Ints, Ints]:
    """Return the rows of the steps that join neighbouring frames."""
    start, stop = motion.steps()
    near = motion.time[stop] - motion.time[start] < 1.5 * motion.dt
    return start[near], stop[near]


def slow_sampling(motion: RigidMotion) -> Verdict | None:
    """Say where frames are too far apart for the rotation."""
    angles = _step_angles(motion)
    if motion.template.shape[1] != 3 or not angles.size:
        return None
    rms = float(np.sqrt(np.mean(angles**2)))
    if not _certainly_over(rms, _SLOW, freedom=3 * angles.size):
        return None
    error = rms / np.sqrt(6 * angles.size)
    text = (
        f"rms rotation per frame {rms:.2g} +- {error:.1g} rad is over {_SLOW}: sampling too slow, "
        "D_R biased low; take frames more often"
    )
    return Verdict(text, rms)


def fast_sampling(motion: RigidMotion, *, phi2: float) -> Verdict | None:
    """Note where frames are so close that their steps are mostly noise."""
    angles = _step_angles(motion)
    if not (angles.size and phi2 > 0):
        return None
    # Of a step's three angles two turn a direction: MSAD = 2/3 of the mean square rotation.
    solid = motion.template.shape[1] == 3
    first = float(np.mean(angles**2)) * (2 / 3 if solid else 1)
    # Neighbouring steps of noise share a pose: 1.5 times the variance of independent ones.
    error = first * np.sqrt(1.5 * 2 / ((3 if solid else 1) * angles.size))
    if not first + _NORMAL * error < _FAST * phi2:
        return None
    text = (
        f"MSAD at first lag {first:.2g} +- {error:.1g} rad^2 < 2 x Phi^2 ({phi2:.2g}): sampling "
        "too fast, steps are mostly noise; fewer frames over a longer time tell more"
    )
    return Verdict(text, phi2 / first if first > 0 else np.inf)


def _step_angles(motion: RigidMotion) -> Floats:
    """Return the rotation angles between neighbouring frames, rad."""
    _, stop = _neighbours(motion)
    return np.asarray(np.linalg.norm(motion.step_vectors()[stop - 1], axis=-1))
