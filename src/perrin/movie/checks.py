"""Warnings and notes about a movie and its clusters.

Every check returns `Findings`, or a `Verdict` for one cluster. A warning that depends on a noisy
number is a statistical test: the number must exceed its bound by more than its error allows, at a
level of 1 % (`_TEST_LEVEL`) for a true value on the bound itself.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from perrin._text import listed
from perrin.geometry.shapes import pair_distances
from perrin.motion.scanning import scan_share
from perrin.run.kinds import part_of
from perrin.tracks.groups import TOUCHING_REACH

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    import pandas as pd

    from perrin._arrays import Floats, Ints
    from perrin.images.optics.optics import Optics
    from perrin.motion.error_ratio import ErrorRatio
    from perrin.motion.rigid_motion import RigidMotion
    from perrin.run.results import BodyKind, ClusterResult


_LISTED_ITEMS = 10  # largest number of frames or clusters that a message lists
_TEST_LEVEL = 0.01  # one-sided level of the tests
_NORMAL_QUANTILE = 2.326  # quantile of the normal distribution at that level
_PAIR_BIAS, _NOTED_PAIR_BIAS = 0.03, 0.003  # relative error of the mean pair distance
_IMAGE_MISFIT = 0.025  # mean squared residual over the noise less 1, of volumes
_FEWEST_DIRECTIONS = 1  # degrees of freedom of the dependence of distances on direction
_BLEACHED = 0.1  # relative loss of brightness over the movie
_DEPTH_CHANGE = 0.1  # relative change of brightness over the depth of the spheres
_MISSING_SHARE = 0.1  # missing share of the spheres of the clusters
_NOTED_ERROR_RATIO, _LARGE_ERROR_RATIO = 1.15, 2.0  # errors of positions over the stated ones
_LARGE_FLICKER = 0.1  # relative standard deviation of the light
_FAILED_SHARE = 0.01  # share of fits that did not converge
_UNSAFE_STEP, _REFUSED_STEP = 0.25, 0.5  # rms step over the contact distance
_RING_ERRORS = 5.0  # standard errors of the contrasts of a 2-D image
_RING_CONTRAST, _OPPOSITE_CONTRAST = 1.2, 0.3  # contrast at the rim over that in the middle
_MIDDLE, _RIM = 0.15, (0.25, 0.5)  # radii of middle and rim of a sphere over its diameter
_BACKGROUND_DISTANCE, _LEAST_BACKGROUND = 1.5, 0.02  # in diameters; least share of the pixels
_OVERLAP, _OVERLAP_SHARE = 0.85, 0.1  # distance over the contact; share of the places
_FEWEST_PLACES = 8  # from which the contrasts are known
_FAST_RATIO, _SLOW_ROTATION = 2.0, 0.5  # MSAD at the first lag over Phi^2; rms rotation, rad


class Findings(NamedTuple):
    """Warnings and notes of one or more checks.

    Attributes
    ----------
    warnings : tuple of str
        Reasons to doubt a result.
    notes : tuple of str
        Information about a result.
    """

    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def __add__(self, other: object) -> Findings:
        """Return the findings of both, in their order."""
        if not isinstance(other, Findings):
            return NotImplemented
        return Findings(self.warnings + other.warnings, self.notes + other.notes)


_NOTHING = Findings()


class Verdict(NamedTuple):
    """Warning or note of a check about one cluster, and its size among those of other clusters."""

    text: str
    size: float


def combined_verdicts(verdicts: Mapping[str, Verdict | None]) -> dict[str, str]:
    """Combine the verdicts of one check on several clusters into one text.

    Parameters
    ----------
    verdicts : mapping
        Verdict on each cluster by its name; None if the check found nothing.

    Returns
    -------
    dict of str to str
        The text by the name of the cluster, or by "" if it is about several; such a text quotes the
        largest case.

    Examples
    --------
    >>> combined_verdicts({"0": Verdict("too fast", 1.0), "1": None})
    {'0': 'too fast'}
    >>> combined_verdicts({"0": Verdict("0.3 um", 0.3), "1": Verdict("0.4 um", 0.4), "2": None})
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


def frame_runs_text(frames: Ints | list[int]) -> str:
    """Return frame numbers for a sentence, successive ones as a range; at most ten numbers.

    Parameters
    ----------
    frames : sequence of int

    Returns
    -------
    str

    Examples
    --------
    >>> frame_runs_text([3, 4, 5, 9]), frame_runs_text([7])
    ('frames 3 to 5, 9', 'frame 7')
    """
    every = np.unique(np.asarray(frames, dtype=np.int64))
    runs = np.split(every, np.flatnonzero(np.diff(every) > 1) + 1)
    numbers = np.cumsum([min(len(run), 2) for run in runs])
    shown = int((numbers <= _LISTED_ITEMS).sum())
    words = [f"{r[0]}" if len(r) == 1 else f"{r[0]} to {r[-1]}" for r in runs[:shown]]
    more = f" and {sum(map(len, runs[shown:]))} more" if len(runs) > shown else ""
    return f"frame{'s' if len(every) > 1 else ''} {', '.join(words)}{more}"


def unreadable_frames(frames: pd.DataFrame) -> Findings:
    """Warn of frames that could not be read.

    Parameters
    ----------
    frames : pandas.DataFrame
        As in `Imaging`.

    Examples
    --------
    >>> import pandas as pd
    >>> frames = pd.DataFrame({"frame": [0, 1, 2], "fault": ["", "page is cut short", ""]})
    >>> unreadable_frames(frames).warnings[0]
    '1 of 3 frames cannot be read and are left out: frame 1 (page is cut short)'
    """
    lost = frames[frames["fault"] != ""]
    if not len(lost):
        return _NOTHING
    text = (
        f"{len(lost)} of {len(frames)} frames cannot be read and are left out: "
        f"{frame_runs_text(lost['frame'].to_numpy())} ({lost['fault'].iloc[0]})"
    )
    return Findings((text,))


def repeated_frames(frames: pd.DataFrame) -> Findings:
    """Warn of frames that are exact copies of an earlier one.

    Noise never repeats, so that such a frame is no measurement.

    Parameters
    ----------
    frames : pandas.DataFrame
        As in `Imaging`.

    Examples
    --------
    >>> import pandas as pd
    >>> frames = pd.DataFrame({"frame": [0, 1, 2], "copy_of": [-1, 0, -1]})
    >>> repeated_frames(frames).warnings[0][:47]
    '1 of 3 frames repeat an earlier frame exactly, '
    """
    copies = frames[frames["copy_of"] >= 0]
    if not len(copies):
        return _NOTHING
    first = copies.iloc[0]
    text = (
        f"{len(copies)} of {len(frames)} frames repeat an earlier frame exactly, voxel by voxel "
        f"(first: frame {first['frame']}, as frame {first['copy_of']}): they are no measurements "
        f"and are treated as missing: {frame_runs_text(copies['frame'].to_numpy())}"
    )
    return Findings((text,))


def empty_frames(frames: pd.DataFrame, *, minmass: float) -> Findings:
    """Warn of frames without any spot above the mass cut.

    Parameters
    ----------
    frames : pandas.DataFrame
        As in `Imaging`.
    minmass : float
        Mass cut.

    Examples
    --------
    >>> import pandas as pd
    >>> frames = pd.DataFrame({"frame": [0, 1], "fault": ["", ""], "spheres": [4, 0]})
    >>> empty_frames(frames, minmass=50.0).warnings[0][:64]
    'no particles passed the mass cut (50) in 1 of 2 frames: frame 1;'
    """
    read = frames[frames["fault"] == ""]
    none = read[read["spheres"] == 0]
    if not len(none):
        return _NOTHING
    text = (
        f"no particles passed the mass cut ({minmass:.3g}) in {len(none)} of {len(read)} frames: "
        f"{frame_runs_text(none['frame'].to_numpy())}; inspect the mass histogram, set minmass or "
        "leave them out"
    )
    return Findings((text,))


def saturated_frames(frames: pd.DataFrame) -> Findings:
    """Warn of frames with voxels clipped at the highest value (see `saturated_share`).

    Parameters
    ----------
    frames : pandas.DataFrame
        As in `Imaging`.

    Examples
    --------
    >>> import pandas as pd
    >>> saturated_frames(pd.DataFrame({"saturated": [0.0, 0.0]}))
    Findings(warnings=(), notes=())
    """
    share = frames["saturated"].to_numpy(dtype=np.float64)
    over = share > 0
    if not over.any():
        return _NOTHING
    text = (
        f"saturated voxels: up to {100 * np.nanmax(share):.2g} % of a frame pile up at its highest "
        f"value, in {over.sum()} of {len(frames)} frames (chance of one such frame without "
        "saturation under 1e-6); they and the voxels beside them are left out of the fits of a "
        "volume, so that positions are less exact; reduce gain or laser power"
    )
    return Findings((text,))


class Change(NamedTuple):
    """A relative change of brightness.

    Attributes
    ----------
    value : float
        Relative change: -0.3 for a fall by 30 %.
    stderr : float
        Standard error of the change.
    freedom : int
        Degrees of freedom of the standard error.
    """

    value: float
    stderr: float
    freedom: int

    def exceeds(self, bound: float) -> bool:
        """Return whether the change is significantly larger than `bound`, up or down (t test)."""
        from scipy.stats import t

        margin = float(t.isf(_TEST_LEVEL / 2, self.freedom)) * self.stderr
        return abs(self.value) - margin > bound

    def percent(self) -> str:
        """Return the change with its error in percent: "-30 +- 3 %"."""
        return f"{100 * self.value:+.0f} +- {100 * self.stderr:.1g} %"


def bleaching(features: pd.DataFrame) -> Change | None:
    """Return the change of the spheres' brightness from the first tenth of the frames to the last.

    It is the mean over the tracked spheres that are seen in both, in logarithms, and the error is
    that of this mean.

    Parameters
    ----------
    features : pandas.DataFrame
        As in `Imaging`.

    Returns
    -------
    Change or None
        None for fewer than four frames or two such spheres.

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
    log_mass = np.log(seen["mass"].to_numpy(dtype=np.float64))
    by_frame = seen.assign(log_mass=log_mass).set_index("frame").sort_index()
    ends = [
        by_frame.loc[part[0] : part[-1]].groupby(["cluster", "particle"])["log_mass"].mean()
        for part in (numbers[:tenth], numbers[-tenth:])
    ]
    change = (ends[1] - ends[0]).dropna().to_numpy()
    if len(change) < 2:
        return None
    ratio = float(np.exp(change.mean()))
    error = ratio * float(change.std(ddof=1)) / np.sqrt(len(change))
    return Change(ratio - 1, error, len(change) - 1)


def bleaching_text(change: Change) -> str:
    """Return the words for a change of brightness over the movie.

    Examples
    --------
    >>> bleaching_text(Change(-0.3, 0.03, 7))
    'brightness fell by 30 +- 3 % from the first tenth of the movie to the last'
    >>> bleaching_text(Change(0.1, 0.02, 7))
    'brightness rose by 10 +- 2 % from the first tenth of the movie to the last'
    """
    verb = "fell" if change.value <= 0 else "rose"
    return (
        f"brightness {verb} by {abs(100 * change.value):.0f} +- {100 * change.stderr:.1g} % from "
        "the first tenth of the movie to the last"
    )


def bleached(features: pd.DataFrame) -> Findings:
    """Warn if the brightness fell significantly from the start of the movie to its end.

    Parameters
    ----------
    features : pandas.DataFrame
        As in `Imaging`.
    """
    change = bleaching(features)
    if change is None or change.value > 0 or not change.exceeds(_BLEACHED):
        return _NOTHING
    return Findings((f"{bleaching_text(change)} (bleaching): late frames are less exact",))


def depth_change(features: pd.DataFrame) -> tuple[Change, float] | None:
    """Return the change of brightness from the lowest sphere to the highest, and their distance.

    A sphere keeps its brightness over the frames, so that only the spheres of one frame are
    independent.

    Parameters
    ----------
    features : pandas.DataFrame
        As in `Imaging`.

    Returns
    -------
    change : Change
    span : float
        Height of the highest sphere above the lowest, um.

    None is returned for fewer than three spheres in a frame, or if all have the same height.
    """
    # Spheres found in the residual image of a crowd have no mass.
    features = features[features["mass"].notna()]
    count = len(features) // max(1, features["frame"].nunique())
    if "z" not in features or count < 3:
        return None
    relative = features["mass"] / features.groupby("frame")["mass"].transform("median")
    z, y = features["z"].to_numpy(dtype=np.float64), np.log(relative.to_numpy(dtype=np.float64))
    height = z - z.mean()
    square_sum, span = float(height @ height), float(np.ptp(z))
    if not square_sum > 0:
        return None
    slope = float(height @ y) / square_sum
    residual = y - y.mean() - slope * height
    freedom = count - 2
    error = float(np.sqrt(residual @ residual / square_sum / freedom))
    ratio = float(np.exp(slope * span))
    return Change(ratio - 1, ratio * error * span, freedom), span


def depth_dimming(features: pd.DataFrame) -> Findings:
    """Warn if the brightness changes significantly from the lowest sphere to the highest.

    Parameters
    ----------
    features : pandas.DataFrame
        As in `Imaging`.
    """
    found = depth_change(features)
    if found is None or not found[0].exceeds(_DEPTH_CHANGE):
        return _NOTHING
    change, span = found
    text = (
        f"amplitude changes with depth, by {change.percent()} over {span:.3g} um: z is biased, "
        "nearly the same in all frames of a cluster"
    )
    return Findings((text,))


def unrefined_spheres(features: pd.DataFrame) -> Findings:
    """Count the fits of spheres that failed, by reason; a warning above 1 %, else a note.

    Parameters
    ----------
    features : pandas.DataFrame
        As in `Imaging`.
    """
    if "reason" not in features:
        return _NOTHING
    failed = features.loc[features["reason"] != "", "reason"].value_counts()
    if not len(failed):
        return _NOTHING
    kinds = "; ".join(f"{count} x {why}" for why, count in failed.items())
    text = (
        f"{failed.sum()} of {len(features)} places are as found, not refined ({kinds}); the "
        "column reason of features.parquet lists them; those of tried fits are not used"
    )
    return _fit_failures(text, failed.sum() / len(features))


def error_ratio_shown(ratio: ErrorRatio, *, axes: list[str]) -> Findings:
    """State by how much rigid bodies show larger errors than the fits of their images state.

    A warning where the errors of an axis are over twice the stated ones, a note above 1.15 or where
    they change with time or depth.

    Parameters
    ----------
    ratio : ErrorRatio
    axes : list of str
        Columns of the coordinates.
    """
    if ratio.is_one:
        return _NOTHING
    factor = np.sqrt(ratio.value)
    error = ratio.stderr / (2 * factor)
    listed_axes = ", ".join(
        f"{axis} {f:.2f} +- {e:.2g}" for axis, f, e in zip(axes, factor, error, strict=True)
    )
    trend = [
        f"{100 * (np.exp(rate / 2) - 1):+.2g} % a {unit}"
        for rate, unit in ((ratio.by_time, "second"), (ratio.by_depth, "um of height"))
        if rate
    ]
    changing = f", changing by {' and '.join(trend)}" if trend else ""
    text = (
        f"errors of the positions over those of the fits of their images, from the residuals of "
        f"rigid bodies: {listed_axes}{changing}; the stated errors of spheres and poses contain "
        "this"
    )
    if factor.max() > _LARGE_ERROR_RATIO:
        return Findings(
            (
                text + "; smoothing, compression or flicker of the movie, or an image of the "
                "spheres that the model does not describe",
            )
        )
    if trend or factor.max() > _NOTED_ERROR_RATIO:
        return Findings(notes=(text,))
    return _NOTHING


def noise_in_common(optics: Optics | None) -> Findings:
    """State what the noise of voxels has in common, which the fits allow for.

    Flicker of over 10 % and correlations of neighbours are warnings, other flicker and gains of
    pixels are notes.

    Parameters
    ----------
    optics : Optics or None
    """
    if optics is None:
        return _NOTHING
    noise, found = optics.noise, _NOTHING
    kinds = [
        f"by {100 * size:.2g} % from {kind} to {kind}"
        for kind, size in (("plane", noise.plane), ("line", noise.line))
        if size
    ]
    if kinds:
        text = (
            f"flicker: the light differs {' and '.join(kinds)} (rms), as a source or a scanner "
            "that is not steady; the fits allow for it, and the stated errors contain what is left"
        )
        large = max(noise.plane, noise.line) > _LARGE_FLICKER
        found += Findings((text,)) if large else Findings(notes=(text,))
    if noise.pixel:
        text = (
            f"gains of pixels differ by {100 * noise.pixel:.2g} % (rms); the fits allow for it, "
            "and the stated errors contain what is left"
        )
        found += Findings(notes=(text,))
    if noise.neighbours:
        text = (
            f"correlated noise: that of neighbouring voxels of a plane has a correlation of "
            f"{max(noise.neighbours[0][1], noise.neighbours[1][0]):.2f}, as in an image that was "
            "compressed with loss or smoothed; the stated errors contain it: save the images as "
            "they are recorded"
        )
        found += Findings((text,))
    return found


def asymmetric_point_spread(optics: Optics | None) -> Findings:
    """Note that the point spread is no even body of revolution, which the fits allow for.

    Parameters
    ----------
    optics : Optics or None

    Examples
    --------
    >>> asymmetric_point_spread(None)
    Findings(warnings=(), notes=())
    """
    if optics is None or optics.asymmetry is None:
        return _NOTHING
    text = (
        f"asymmetric point spread: {listed(optics.asymmetry.kinds)}, as of optics that are not "
        "aligned, or of a sample with another refractive index than the immersion; the fits allow "
        "for it to first order"
    )
    return Findings(notes=(text,))


def confocal_point_spread(optics: Optics | None) -> Findings:
    """Note that the point spread is computed from an aperture and a pinhole.

    Parameters
    ----------
    optics : Optics or None

    Examples
    --------
    >>> confocal_point_spread(None)
    Findings(warnings=(), notes=())
    """
    if optics is None or optics.pupil is None:
        return _NOTHING
    pupil = optics.pupil
    text = (
        f"confocal point spread: that of an aperture with a pinhole of {pupil.pinhole:.2g} um "
        f"(radius in the sample; {pupil.airy_units:.2g} Airy units), which fits images that were "
        "left out better than Gaussians"
    )
    return Findings(notes=(text,))


def changing_point_spread(optics: Optics | None) -> Findings:
    """Note that the point spread changes with the height of a sphere, which the fits allow for.

    Parameters
    ----------
    optics : Optics or None

    Examples
    --------
    >>> changing_point_spread(None)
    Findings(warnings=(), notes=())
    """
    if optics is None or optics.depth is None:
        return _NOTHING
    depth = optics.depth
    first, last = (depth.psf(optics.psf, height) for height in (depth.low, depth.high))
    text = (
        f"point spread by depth: its standard deviations are {first[0]:.3g} um along z and "
        f"{first[1]:.3g} um in the plane at a height of {depth.low:.3g} um, and {last[0]:.3g} and "
        f"{last[1]:.3g} um at {depth.high:.3g} um, as in a sample with another refractive index "
        "than the immersion; the fits allow for it"
    )
    return Findings(notes=(text,))


def image_misfit(features: pd.DataFrame, optics: Optics | None) -> Findings:
    """Note that the residuals of the fits to images exceed the noise, at a level of 1 %.

    Above 2.5 %: of a point spread that the model describes, chi-squared is within 1 % of 1. Images
    whose noise is correlated are not judged.

    Parameters
    ----------
    features : pandas.DataFrame
        As in `Imaging`.
    optics : Optics or None

    Examples
    --------
    >>> import pandas as pd
    >>> from perrin.images import CameraNoise, Optics
    >>> fits = pd.DataFrame({"refined": True, "chi2": [1.05, 1.04, 1.05]})
    >>> image_misfit(fits, Optics(2.0, (0.4, 0.15), CameraNoise(3.0, 4.0))).notes[0][:47]
    'image misfit: the residuals of the fits are 4.7'
    """
    if optics is None or optics.noise.neighbours or "refined" not in features:
        return _NOTHING
    chi2 = features.loc[features["refined"].to_numpy(dtype=np.bool_), "chi2"].dropna().to_numpy()
    if len(chi2) < 2:
        return _NOTHING
    more, error = float(chi2.mean()) - 1, float(chi2.std(ddof=1) / np.sqrt(len(chi2)))
    if not more > _IMAGE_MISFIT + _NORMAL_QUANTILE * error:
        return _NOTHING
    text = (
        f"image misfit: the residuals of the fits are {100 * more:.2g} % above the noise, by their "
        "squares: a point spread that is not modelled (haze, an aberration), spheres of another "
        "shape, or spheres that move while they are recorded; touching spheres may be off "
        "by more than is stated, by as much in all frames, which D does not contain"
    )
    return Findings(notes=(text,))


def unsettled_poses(count: int, of: int) -> Findings:
    """Count the fits of poses that failed; a warning above 1 %, else a note.

    Parameters
    ----------
    count, of : int
        Number of failed fits, and of all fits.
    """
    if not count:
        return _NOTHING
    text = (
        f"{count} of {of} fits of poses did not converge; these poses are those of the free centres"
    )
    return _fit_failures(text, count / of)


def _fit_failures(text: str, share: float) -> Findings:
    return Findings((text,)) if share > _FAILED_SHARE else Findings(notes=(text,))


def pair_distance_bias(
    features: pd.DataFrame, *, contact: float, refine: str | None, axes: list[str]
) -> Findings:
    """Warn if the mean distance of touching spheres differs from the contact distance.

    Above 0.3 % it is a note: an error that is constant in the body changes its shape, not D.

    Parameters
    ----------
    features : pandas.DataFrame
        As in `Imaging`.
    contact : float
        Centre distance of touching spheres, um.
    refine : {"model", "trackpy", None}
        Refinement of the positions.
    axes : list of str
        Columns of the coordinates.
    """
    mean, error = mean_pair_distance(features, contact=contact, axes=axes)
    off = mean / contact - 1
    if not abs(off) > _NOTED_PAIR_BIAS + _NORMAL_QUANTILE * error / contact:
        return _NOTHING
    if not abs(off) > _PAIR_BIAS + _NORMAL_QUANTILE * error / contact:
        text = (
            f"distances of touching spheres read {100 * abs(off):.2g} +- "
            f"{100 * error / contact:.1g} % {'short' if off < 0 else 'long'} of the contact "
            f"distance {contact:.4g} um: a point spread that the model does not describe, unequal "
            "spheres, or the contact itself; the stated errors of the shape contain it, and D is "
            "not affected"
        )
        return Findings(notes=(text,))
    why = (
        "centroid bias of touching spheres; run refinement (refine='model')"
        if refine is None
        else "the contact distance, the voxel size or the diameter may be wrong"
    )
    text = (
        f"mean pair distance {mean:.4g} +- {error:.1g} um, expected {contact:.4g} "
        f"({100 * off:+.1f} +- {100 * error / contact:.1g} %): {why}"
    )
    return Findings((text,))


def ring_images(
    images: Sequence[Floats],
    places: Sequence[Floats],
    *,
    pixel: tuple[float, float],
    diameter: float,
    dark: bool,
) -> Findings:
    """Warn if the places found in a 2-D movie are no discs: rings, or gaps between dark spheres.

    The contrast of a disc with the background is strongest in its middle, and has the same sign at
    its rim. The background is the median of the pixels that are over 1.5 diameters from all places.

    Parameters
    ----------
    images : sequence of ndarray, shape (ny, nx)
        Some frames.
    places : sequence of ndarray, shape (n, 2)
        Places (x, y) found in each of them, um.
    pixel : tuple of float
        Size of a pixel (y, x), um.
    diameter : float
        Sphere diameter, um.
    dark : bool
        Whether spheres are searched for as darker than their surroundings.

    Examples
    --------
    >>> y, x = np.mgrid[:60, :60] * 0.2
    >>> away = np.hypot(x - 6.0, y - 6.0)
    >>> ring = 100.0 - 50.0 * np.exp(-(((away - 1.0) / 0.2) ** 2))
    >>> found = ring_images(
    ...     [ring] * 9, [np.array([[6.0, 6.0]])] * 9, pixel=(0.2, 0.2), diameter=2.0, dark=True
    ... )
    >>> found.warnings[0][:40]
    'ring images: the contrast of the places '
    """
    from scipy.spatial import cKDTree

    middles, rims = [], []
    for image, found in zip(images, places, strict=True):
        if not len(found):
            continue
        y, x = (h * np.arange(n) for h, n in zip(pixel, image.shape, strict=True))
        y, x = np.meshgrid(y, x, indexing="ij")
        grid = np.stack([x.ravel(), y.ravel()], axis=1)
        grey = image.ravel().astype(np.float64) * (-1.0 if dark else 1.0)
        away, _ = cKDTree(found).query(grid)
        far = away > _BACKGROUND_DISTANCE * diameter
        if far.mean() < _LEAST_BACKGROUND:
            continue
        tree, level = cKDTree(grid), float(np.median(grey[far]))
        for place in found:
            near = np.array(tree.query_ball_point(place, _RIM[1] * diameter))
            radius = np.linalg.norm(grid[near] - place, axis=1) / diameter
            middle, rim = grey[near[radius < _MIDDLE]], grey[near[radius > _RIM[0]]]
            if middle.size and rim.size:
                middles.append(middle.mean() - level)
                rims.append(rim.mean() - level)
    if len(middles) < _FEWEST_PLACES:
        return _NOTHING
    middle, rim = np.array(middles), np.array(rims)
    excess = rim - _RING_CONTRAST * np.maximum(middle, 0.0)
    opposite = -rim - _OPPOSITE_CONTRAST * np.abs(middle)
    for value, text in (
        (
            excess,
            "ring images: the contrast of the places found is stronger at the rim than in the "
            "middle ({rim:.3g} and {middle:.3g} grey levels): the spheres are rings, as in bright "
            "field; between touching rims there are false places, and centroids are biased: focus "
            "so that spheres are discs, or pass the clusters to leave out (exclude)",
        ),
        (
            opposite,
            "contrast: around the places found the image is {other} than the background (middle "
            "{middle:+.3g}, rim {rim:+.3g} grey levels): they may be gaps between spheres that are "
            "{other} than the background, as in bright field: pass dark={dark}, and look at the "
            "places found",
        ),
    ):
        if value.mean() > _RING_ERRORS * value.std() / np.sqrt(len(value)):
            sign = -1.0 if dark else 1.0
            words = {"other": "brighter" if dark else "darker", "dark": not dark}
            numbers = {"rim": sign * rim.mean(), "middle": sign * middle.mean()}
            return Findings((text.format(**words, **numbers),))
    return _NOTHING


def overlapping_places(places: Sequence[Floats], *, contact: float) -> Findings:
    """Warn if many places of a 2-D movie are nearer to each other than spheres can be.

    Parameters
    ----------
    places : sequence of ndarray, shape (n, 2)
        Places found in some frames, um.
    contact : float
        Centre distance of touching spheres, um.

    Examples
    --------
    >>> rims = np.array([[0.0, 0.0], [1.5, 0.0], [9.0, 0.0], [10.5, 0.0]])
    >>> overlapping_places([rims, rims], contact=2.0).warnings[0][:43]
    'overlap: 8 of 8 places (100 %) are nearer t'
    """
    from scipy.spatial import cKDTree
    from scipy.special import bdtrc

    near = total = 0
    for found in places:
        if len(found) > 1:
            distance = cKDTree(found).query(found, k=2)[0][:, 1]
            near += int((distance < _OVERLAP * contact).sum())
        total += len(found)
    if not near or bdtrc(near - 1, total, _OVERLAP_SHARE) > _TEST_LEVEL:
        return _NOTHING
    text = (
        f"overlap: {near} of {total} places ({100 * near / total:.0f} %) are nearer than "
        f"{_OVERLAP:g} contact distances to another, where spheres in a plane cannot be: some are "
        "no spheres but parts of them or gaps between them (rings, as in bright field), spheres "
        "lie above each other, or contact is too large"
    )
    return Findings((text,))


def mean_pair_distance(
    features: pd.DataFrame, *, contact: float, axes: list[str]
) -> tuple[float, float]:
    """Return the mean distance of touching spheres of the same cluster, and its standard error.

    The error of a position may be the same in all frames, and a sphere touches several others.
    Therefore the error is the scatter of the pairs' mean distances, with half as many independent
    ones as there are spheres; for a single pair it is the scatter over the frames.

    Parameters
    ----------
    features : pandas.DataFrame
        As in `Imaging`.
    contact : float
        Centre distance of touching spheres, um.
    axes : list of str
        Columns of the coordinates.

    Returns
    -------
    mean, stderr : float
        um; NaN if no spheres touch.
    """
    pairs = _touching_pairs(features, contact=contact, axes=axes)
    if not pairs.distance.size:
        return np.nan, np.nan
    mean, count = float(pairs.distance.mean()), np.bincount(pairs.pair)
    if len(count) == 1:
        return mean, float(pairs.distance.std() / np.sqrt(pairs.distance.size))
    scatter = float(np.std(np.bincount(pairs.pair, pairs.distance) / count, ddof=1))
    return mean, scatter / np.sqrt(pairs.spheres / 2)


class _TouchingPairs(NamedTuple):
    """Distances of touching spheres of the same cluster, in all frames.

    `upright` is the squared cosine between the pair and the optical axis, `pair` the number of the
    pair, `spheres` the number of spheres of all clusters.
    """

    distance: Floats
    upright: Floats
    pair: Ints
    spheres: int


def _touching_pairs(features: pd.DataFrame, *, contact: float, axes: list[str]) -> _TouchingPairs:
    """Return the distances of touching spheres; the parameters are those of the mean distance."""
    distances, upright, pairs = [np.empty(0)], [np.empty(0)], [np.empty(0, dtype=np.int64)]
    tracked = features[features["cluster"] >= 0].sort_values(["frame", "cluster", "particle"])
    most = int(tracked["particle"].max()) + 1 if len(tracked) else 1
    x, particle = tracked[axes].to_numpy(dtype=np.float64), tracked["particle"].to_numpy()
    frame, cluster = tracked["frame"].to_numpy(), tracked["cluster"].to_numpy()
    # The rows of one cluster in one frame are neighbours.
    ends = np.flatnonzero((np.diff(frame) != 0) | (np.diff(cluster) != 0)) + 1
    for rows in np.split(np.arange(len(tracked)), ends):
        first, second = rows[np.array(np.triu_indices(len(rows), 1))]
        distance = pair_distances(x[rows])
        near = distance < TOUCHING_REACH * contact
        distances.append(distance[near])
        height = x[second, -1] - x[first, -1] if "z" in axes else np.zeros(len(first))
        upright.append(np.square(height[near] / np.maximum(distance[near], 1e-300)))
        number = (cluster[first].astype(np.int64) * most + particle[first]) * most
        pairs.append((number + particle[second])[near])
    _, which = np.unique(np.concatenate(pairs), return_inverse=True)
    spheres = len(tracked[["cluster", "particle"]].drop_duplicates())
    return _TouchingPairs(np.concatenate(distances), np.concatenate(upright), which, spheres)


def distances_by_direction(features: pd.DataFrame, *, contact: float, axes: list[str]) -> Findings:
    """Note that touching spheres above each other have another distance than those side by side.

    The slope of the distance against the squared cosine of the angle to the optical axis is found
    by least squares; its error is that of the scatter of the pairs, with half as many independent
    ones as there are spheres. Noted above 0.3 %.

    Parameters
    ----------
    features, contact, axes
        As in `mean_pair_distance`.

    Examples
    --------
    >>> import pandas as pd
    >>> table = pd.DataFrame({"frame": [0, 0], "cluster": 0, "particle": [0, 1], "x": [0.0, 2.0]})
    >>> distances_by_direction(table.assign(y=0.0, z=0.0), contact=2.0, axes=["x", "y", "z"])
    Findings(warnings=(), notes=())
    """
    from scipy.special import stdtrit

    if "z" not in axes:
        return _NOTHING
    pairs = _touching_pairs(features, contact=contact, axes=axes)
    freedom = pairs.spheres / 2 - 2
    if freedom < _FEWEST_DIRECTIONS or not pairs.distance.size:
        return _NOTHING
    relative = pairs.distance / contact
    lever = pairs.upright - pairs.upright.mean()
    if not (square := float(lever @ lever)) > 0:
        return _NOTHING
    slope = float(lever @ relative) / square
    left = lever * (relative - relative.mean() - slope * lever)
    of_pairs = np.bincount(pairs.pair, left)
    more = len(of_pairs) / (pairs.spheres / 2) * (freedom + 2) / freedom
    error = float(np.sqrt(np.sum(of_pairs**2) * more)) / square
    if not abs(slope) > _NOTED_PAIR_BIAS + stdtrit(freedom, 1 - _TEST_LEVEL) * error:
        return _NOTHING
    text = (
        f"distances along z: touching spheres above each other read {100 * abs(slope):.2g} +- "
        f"{100 * error:.1g} % {'nearer' if slope < 0 else 'farther'} than those side by side, as "
        "with another z step than stated, or a sample of another refractive index than the "
        "immersion; heights of bodies are off by as much, and D hardly"
    )
    return Findings(notes=(text,))


def distance_error(features: pd.DataFrame, *, contact: float, axes: list[str]) -> float | None:
    """Return the relative error of distances that is the same in all frames, from touching spheres.

    Rigid residuals do not show it. It is the deviation of the mean distance of touching spheres
    from the contact distance, or the error of this mean where that is larger.

    Parameters
    ----------
    features, contact, axes
        As in `mean_pair_distance`.

    Returns
    -------
    float or None
        None where no spheres of a cluster touch.

    Examples
    --------
    >>> import pandas as pd
    >>> pair = {"frame": [0, 0, 1, 1], "cluster": 0, "particle": [0, 1, 0, 1]}
    >>> table = pd.DataFrame(pair | {"x": [0, 1.98, 0, 1.98], "y": 0.0})
    >>> round(distance_error(table, contact=2.0, axes=["x", "y"]), 6)
    0.01
    """
    mean, stderr = mean_pair_distance(features, contact=contact, axes=axes)
    if not np.isfinite(mean):
        return None
    return max(abs(mean - contact), float(np.nan_to_num(stderr))) / contact


def missing_spheres(
    features: pd.DataFrame, *, sizes: Mapping[int, int], contact: float, frames: Ints
) -> Findings:
    """Report the frames in which clusters have missing or additional spheres, or are missing.

    It is a warning if over 10 % of the spheres of the clusters are missing between their first and
    their last frame, else a note.

    Parameters
    ----------
    features : pandas.DataFrame
        As in `Bodies`.
    sizes : mapping
        Number of spheres of each cluster.
    contact : float
        Centre distance of touching spheres, um.
    frames : ndarray of int
        All frames that could be read.
    """
    texts: dict[int, str] = {}
    missing = expected = 0
    tracked = features[features["cluster"] >= 0]
    for cluster, rows in tracked.groupby("cluster"):
        present = rows.groupby("frame").size()
        first, last = int(present.index.min()), int(present.index.max())
        due, size = int(((frames >= first) & (frames <= last)).sum()), sizes[int(cluster)]
        absent = due - len(present)
        few = present[present < size]
        near = rows.groupby("frame")["together"].max()
        crowd = near[near > size]
        missing += size * absent + int((size - few).sum())
        expected += size * due
        parts = [
            f"{n} found in {_frame_count(k)}" for n, k in few.value_counts().sort_index().items()
        ]
        if absent:
            parts.append(f"none placed in {_frame_count(absent)}")
        parts += [
            f"{n} found in {_frame_count(k)} "
            f"(two clusters within {TOUCHING_REACH * contact:.2g} um)"
            for n, k in crowd.value_counts().sort_index().items()
        ]
        if first > frames.min():
            parts.append(f"first seen in frame {first}")
        if last < frames.max():
            parts.append(f"lost after frame {last}")
        if parts:
            texts[int(cluster)] = ", ".join(parts)
    if not texts:
        return _NOTHING
    shown = "; ".join(f"cluster {c}: {text}" for c, text in list(texts.items())[:_LISTED_ITEMS])
    more = f"; and {len(texts) - _LISTED_ITEMS} more" if len(texts) > _LISTED_ITEMS else ""
    text = (
        f"{100 * missing / expected:.2g} % of the spheres are missing, "
        f"{listed(sorted(set(sizes.values())))} expected in each of "
        f"{tracked['cluster'].nunique()} clusters; {shown}{more}"
    )
    return Findings((text,)) if missing > _MISSING_SHARE * expected else Findings(notes=(text,))


def _frame_count(count: int) -> str:
    return f"{count} frame{'' if count == 1 else 's'}"


def clusters_near_border(
    features: pd.DataFrame, *, margin: float, sizes: Mapping[int, int]
) -> Findings:
    """Note the clusters near the border, and the frames in which spheres of them are missing.

    Parameters
    ----------
    features : pandas.DataFrame
        As in `Bodies`.
    margin : float
        Largest distance to the border of a centre whose sphere may be cut, um.
    sizes : mapping
        Number of spheres of each cluster.
    """
    tracked = features[features["cluster"] >= 0]
    near = tracked[tracked["border"] < margin].groupby("cluster")["frame"]
    touched = {int(cluster): np.unique(frames) for cluster, frames in near}
    verdicts: dict[str, Verdict | None] = {
        str(c): None for c in sorted(tracked["cluster"].unique().tolist())
    }
    for cluster, frames in touched.items():
        shown = tracked[tracked["cluster"] == cluster].groupby("frame")["x"].size()[frames]
        partial = frames[shown.to_numpy() < sizes[cluster]]
        text = f"in {frame_runs_text(frames)}"
        if len(partial):
            text += f"; in part, with spheres out of view, in {frame_runs_text(partial)}"
        verdicts[str(cluster)] = Verdict(text, float(len(frames)))
    return Findings(
        notes=tuple(
            f"centre within d/2 + 2 sigma ({margin:.2g} um) of the border, "
            f"{f'cluster {name} ' if name else ''}{text}"
            for name, text in combined_verdicts(verdicts).items()
        )
    )


def partial_bodies(results: Sequence[ClusterResult], kinds: Sequence[BodyKind]) -> Findings:
    """Note the kinds of clusters that have the shape of a part of a larger kind.

    Parameters
    ----------
    results : sequence of ClusterResult
    kinds : sequence of BodyKind
        Kinds of the results.
    """
    templates = {r.cluster: r.motion.template for r in results}
    known = [kind for kind in kinds if kind.clusters[0] in templates]
    texts = []
    for kind in known:
        shape = templates[kind.clusters[0]]
        larger = [one for one in known if part_of(shape, templates[one.clusters[0]])]
        if larger:
            many = "s" if len(kind.clusters) > 1 else ""
            texts.append(
                f"cluster{many} {listed(kind.clusters)} ({kind.name}) in those of "
                f"{' or '.join(one.name for one in larger)}"
            )
    if not texts:
        return _NOTHING
    return Findings(
        notes=(
            f"clusters with the shape of a part of larger ones: {'; '.join(texts)}; a sphere of "
            "them may be undyed, dim or out of view, or they are smaller clusters: they are "
            "measured with the spheres that are seen, and not pooled with the others",
        )
    )


def scanned_poses(motion: RigidMotion) -> Verdict | None:
    """Note that poses are those of spheres with their own times, and what the scan leaves in them.

    Parameters
    ----------
    motion : RigidMotion
    """
    if motion.turn_noise is None:
        return None
    turn = motion.covariance[motion.fitted]
    error = float(np.sqrt(np.trace(turn, axis1=1, axis2=2).mean() / turn.shape[1]))
    text = (
        f"every sphere has the time of its own planes; orientation error {1e3 * error:.2g} mrad, "
        f"{scan_share(motion):.0%} of its variance from the motion during the scan; the pose is "
        "that of the spheres, not of the image"
    )
    return Verdict(text, error)


def step_length(motion: RigidMotion, *, contact: float) -> float:
    """Return the rms displacement of a particle between neighbouring frames over the contact.

    Parameters
    ----------
    motion : RigidMotion
    contact : float
        Centre distance of touching spheres, um.

    Returns
    -------
    float
        0 if no two neighbouring frames have a pose.
    """
    square, _ = _mean_square_step(motion)
    return float(np.sqrt(square)) / contact if np.isfinite(square) else 0.0


def long_steps(motion: RigidMotion, *, contact: float) -> Verdict | None:
    """Warn of an rms step over a quarter of the contact distance, which makes identities unsafe.

    Parameters
    ----------
    motion : RigidMotion
    contact : float
        Centre distance of touching spheres, um.
    """
    over, count = step_length(motion, contact=contact), _mean_square_step(motion)[1]
    if not exceeds_rms(over, _UNSAFE_STEP, freedom=count * motion.template.shape[1]):
        return None
    safe = motion.dt * (_UNSAFE_STEP / over) ** 2
    error = over * contact / np.sqrt(2 * count * motion.template.shape[1])
    text = (
        f"rms step {over * contact:.3g} +- {error:.1g} um is over a quarter of the contact "
        f"distance {contact:.3g} um: identities are unsafe at dt = {motion.dt:.3g} s; they are "
        f"safe below dt = {safe:.2g} s"
    )
    return Verdict(text, over)


def exceeds_rms(rms: float, bound: float, *, freedom: int) -> bool:
    """Return whether Gaussian steps have an rms above a bound (chi-square test, level 1 %).

    Parameters
    ----------
    rms : float
        Measured root mean square.
    bound : float
        Bound of the true value.
    freedom : int
        Number of independent squares.

    Examples
    --------
    >>> exceeds_rms(1.1, 1.0, freedom=10), exceeds_rms(1.1, 1.0, freedom=1000)
    (False, True)
    """
    from scipy.special import chdtri

    return freedom > 0 and bool(freedom * (rms / bound) ** 2 > chdtri(freedom, _TEST_LEVEL))


def refusal(motion: RigidMotion, *, contact: float) -> str:
    """Return the reason to refuse a cluster with steps over half the contact distance, or "".

    Parameters
    ----------
    motion : RigidMotion
    contact : float
        Centre distance of touching spheres, um.
    """
    over = step_length(motion, contact=contact)
    if over <= _REFUSED_STEP:
        return ""
    fast = motion.dt * (_UNSAFE_STEP / over) ** 2
    return (
        f"rms step {over * contact:.3g} um is over half of the contact distance {contact:.3g} um: "
        f"which label belongs to which particle cannot be known; take frames every {fast:.2g} s"
    )


def _mean_square_step(motion: RigidMotion) -> tuple[float, int]:
    """Return the mean square displacement of the particles over one frame, um^2, and the steps."""
    start, stop = _frame_steps(motion)
    x = motion.positions()
    square = ((x[stop] - x[start]) ** 2).sum(axis=-1)
    return (float(square.mean()) if square.size else np.nan), len(start)


def _frame_steps(motion: RigidMotion) -> tuple[Ints, Ints]:
    """Return the rows of the poses before and after each step of one frame."""
    start, stop = motion.steps()
    near = motion.time[stop] - motion.time[start] < 1.5 * motion.dt
    return start[near], stop[near]


def slow_sampling(motion: RigidMotion) -> Verdict | None:
    """Warn if the rotation between neighbouring frames is too large.

    Parameters
    ----------
    motion : RigidMotion
    """
    angles = _step_angles(motion)
    if motion.template.shape[1] != 3 or not angles.size:
        return None
    rms = float(np.sqrt(np.mean(angles**2)))
    if not exceeds_rms(rms, _SLOW_ROTATION, freedom=3 * angles.size):
        return None
    error = rms / np.sqrt(6 * angles.size)
    text = (
        f"rms rotation per frame {rms:.2g} +- {error:.1g} rad is over {_SLOW_ROTATION}: "
        "sampling too slow, D_R biased low; take frames more often"
    )
    return Verdict(text, rms)


def fast_sampling(motion: RigidMotion, *, phi2: float) -> Verdict | None:
    """Note if the steps between neighbouring frames are mostly noise.

    Parameters
    ----------
    motion : RigidMotion
    phi2 : float
        Noise of the MSAD, rad^2.
    """
    angles = _step_angles(motion)
    if not (angles.size and phi2 > 0):
        return None
    # Of a step's three angles two turn a direction: MSAD = 2/3 of the mean square rotation.
    solid = motion.template.shape[1] == 3
    first = float(np.mean(angles**2)) * (2 / 3 if solid else 1)
    # Neighbouring steps of noise share a pose: 1.5 times the variance of independent ones.
    error = first * np.sqrt(1.5 * 2 / ((3 if solid else 1) * angles.size))
    if not first + _NORMAL_QUANTILE * error < _FAST_RATIO * phi2:
        return None
    text = (
        f"MSAD at first lag {first:.2g} +- {error:.1g} rad^2 < 2 x Phi^2 ({phi2:.2g}): sampling "
        "too fast, steps are mostly noise; take fewer frames over a longer time"
    )
    return Verdict(text, phi2 / first if first > 0 else np.inf)


def check_clusters(
    results: Sequence[ClusterResult], *, contact: float
) -> tuple[tuple[ClusterResult, ...], Findings]:
    """Run the checks of steps, sampling and scan on every cluster.

    Parameters
    ----------
    results : sequence of ClusterResult
    contact : float
        Centre distance of touching spheres, um.

    Returns
    -------
    results : tuple of ClusterResult
        With the warnings about one cluster.
    findings : Findings
        Warnings about several clusters, and all notes.
    """
    own, found = {r.name: r.warnings for r in results}, Findings()
    alarms: tuple[Callable[[ClusterResult], Verdict | None], ...] = (
        lambda r: long_steps(r.motion, contact=contact),
        lambda r: slow_sampling(r.motion),
    )
    for check in alarms:
        for name, text in combined_verdicts({r.name: check(r) for r in results}).items():
            if name:
                own[name] = (*own[name], text)
            else:
                found += Findings((text,))
    fast = {r.name: fast_sampling(r.motion, phi2=r.noise.phi2) for r in results}
    for name, text in combined_verdicts(fast).items():
        found += Findings(notes=(f"cluster {name}: {text}" if name else text,))
    scanned = {r.name: scanned_poses(r.motion) for r in results}
    for name, text in combined_verdicts(scanned).items():
        found += Findings(notes=(f"cluster {name}: {text}" if name else text,))
    return tuple(replace(r, warnings=own[r.name]) for r in results), found


def _step_angles(motion: RigidMotion) -> Floats:
    """Return the rotation angles between neighbouring frames, rad."""
    _, stop = _frame_steps(motion)
    return np.asarray(np.linalg.norm(motion.step_vectors()[stop - 1], axis=-1))
