"""Contacts of spheres that last longer than diffusion allows."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from perrin.tracks.bonds import shared_rows
from perrin.tracks.groups import near_pairs

if TYPE_CHECKING:
    from perrin._arrays import Floats, Ints

# A pair that is in contact in fewer frames is not followed.
_FEWEST_NEAR = 3

# False contacts that are expected in a movie of free spheres whose steps are as assumed.
_FALSE_CONTACTS = 1e-4

# Near each other, spheres may move up to five times less relative to each other than alone
# (lubrication, crowding): the steps of a free pair have one of these sizes.
_HINDERED = (0.2, 0.5, 1.0)

# The distance of a pair in contact is measured with up to eight times the stated error; without a
# stated error, with an error from a thousandth to a sixteenth of the reach.
_ERROR_FACTORS = (1.0, 2.0, 4.0, 8.0)
_ERROR_SHARES = tuple(2.0**k for k in range(-10, -3))

# A step has at least this share of the variance that is left when that of the errors is subtracted.
_LEAST_STEP_SHARE = 0.01

# A likelihood ratio that is e^3 lower says nothing: one gross error costs more than that.
_INSIGNIFICANT = 3.0

# Where no contact is found, stated errors are taken to be this many times larger.
_FAR_ABOVE = 4.0

# Distances off by over five standard errors are measured wrongly, in this share of the frames.
_GROSS_ERRORS, _GROSS_SHARE = 5.0, 0.02


class Contacts(NamedTuple):
    """Contacts of two tracks that last, one entry per contact.

    A pair that is in contact, apart, and in contact again has several.

    Attributes
    ----------
    one, other : ndarray of int
        The two tracks.
    first, last : ndarray of int
        First and last frame of the contact.
    score : ndarray
        Logarithm of the likelihood of a constant distance over that of diffusion.
    """

    one: Ints
    other: Ints
    first: Ints
    last: Ints
    score: Floats


def lasting_contacts(
    frame: Ints,
    track: Ints,
    x: Floats,
    *,
    reach: float,
    variance: Floats,
    error: float | None = None,
    scan: float = 0.0,
) -> Contacts:
    """Find the contacts of spheres that last longer than diffusion allows.

    Parameters
    ----------
    frame, track : ndarray of int, shape (N,)
        Frame and track of each detection; a track has one detection per frame at most.
    x : ndarray, shape (N, d)
        Coordinates of each detection, um; no NaN.
    reach : float
        Spheres nearer than this are in contact, um.
    variance : ndarray
        Variance of one coordinate of the step over one frame of each track, um^2, by its number.
    error : float, optional
        Stated standard error of one coordinate, um.
    scan : float
        Share of the time between frames that passes between the recordings of two touching spheres:
        the body moves meanwhile, and their distance has the variance of that part of a step.

    Returns
    -------
    Contacts

    Notes
    -----
    A likelihood-ratio test in time (Page's sequential test). A pair in contact has a constant
    distance, measured with up to eight times the stated error, and grossly wrong in 2 % of the
    frames (of either kind of pair). The distance of a free pair takes steps with the variance of
    the two spheres, or up to twenty-five times less where near spheres hinder each other. For free
    pairs the expected likelihood ratio is 1 in every frame, so that it exceeds the threshold
    N/0.0001 anywhere among N distances in 0.01 % of all movies (Ville's inequality). The contact
    ends where the ratio has fallen by as much as it had to rise. A pair that stays within reach in
    all of its frames, over half of the movie, is in contact unless diffusion is more likely, if
    most contacts of the movie are of this kind: in a few frames, or where spheres move less than
    the error of their places, nothing else is known.

    Examples
    --------
    >>> steps = 0.3 * np.random.default_rng(1).normal(size=(40, 1))
    >>> one = np.concatenate([steps.cumsum(axis=0), steps.cumsum(axis=0) + 1.0])
    >>> frame, track = np.tile(np.arange(40), 2), np.repeat([0, 1], 40)
    >>> found = lasting_contacts(frame, track, one, reach=1.3, variance=np.full(2, 0.09))
    >>> found.first.tolist(), found.last.tolist()
    ([0], [39])
    """
    order = np.lexsort((frame, track))
    time, code, x = frame[order].astype(np.int64), track[order], x[order]
    first, second = near_pairs(time, code, x, reach=reach, fewest=_FEWEST_NEAR)[0].T
    nothing = np.empty(0, dtype=np.int64)
    if not first.size:
        return Contacts(nothing, nothing, nothing, nothing, np.empty(0))
    time = time - time.min()
    pair, one, two = shared_rows(time, code, first, second)
    distance = np.linalg.norm(x[one] - x[two], axis=1)
    if error:
        moved = scan * float(np.median(variance))
        errors = np.sqrt(2 * (error * np.array(_ERROR_FACTORS)) ** 2 + moved)
        variance = np.maximum(variance - 2 * error**2, _LEAST_STEP_SHARE * variance)
    else:
        errors = reach * np.array(_ERROR_SHARES)
    steps = variance[first] + variance[second]
    threshold = float(np.log((distance <= reach).sum() / _FALSE_CONTACTS))
    found = _sequential_test(
        pair, time[one], distance, errors, steps=steps, reach=reach, threshold=threshold
    )
    if error and not found.one.size:
        # With errors far above the stated ones nothing can be decided, only assumed.
        errors = errors * _FAR_ABOVE
        found = _sequential_test(
            pair, time[one], distance, errors, steps=steps, reach=reach, threshold=np.inf
        )
    begin = frame.min()
    return Contacts(
        first[found.one],
        second[found.one],
        begin + found.first,
        begin + found.last,
        found.score,
    )


def _sequential_test(
    pair: Ints,
    time: Ints,
    distance: Floats,
    errors: Floats,
    *,
    steps: Floats,
    reach: float,
    threshold: float,
) -> Contacts:
    """Return the stretches of constant distance, with the number of the pair for both tracks.

    Rows are sorted by pair and time. Every hypothesis is a Kalman filter of one number.
    """
    count = int(pair[-1]) + 1
    length = np.bincount(pair, minlength=count)
    begin = np.cumsum(length) - length
    noise = errors[:, None, None] ** 2
    # Along the second axis: a constant distance, and the steps of free pairs.
    step = np.array([0.0, *_HINDERED])[None, :, None] ** 2 * steps
    shape = (len(errors), step.shape[1], count)
    mean, spread, level = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    start, last, before = (np.zeros(count, dtype=np.int64) for _ in range(3))
    best, score = np.zeros(count), np.zeros(count)
    out: list[tuple[Ints, Ints, Ints, Floats]] = []

    def restart(chosen: Ints, values: Floats, now: Ints) -> None:
        mean[..., chosen], spread[..., chosen], level[..., chosen] = values, noise, 0.0
        start[chosen] = last[chosen] = now
        best[chosen] = score[chosen] = 0.0

    restart(np.arange(count), distance[begin], time[begin])
    before[:] = time[begin]
    for k in range(1, int(length.max())):
        on = np.flatnonzero(length > k)
        now, value = time[begin[on] + k], distance[begin[on] + k]
        predicted = spread[..., on] + step[..., on] * (now - before[on])
        total = predicted + noise
        off = value - mean[..., on]
        log = -0.5 * (np.log(2 * np.pi * total) + off**2 / total)
        gain = predicted / total
        # A distance that is grossly wrong does not move the mean of a constant one.
        gross = np.abs(off[:, 0]) > _GROSS_ERRORS * np.sqrt(total[:, 0])
        log = np.logaddexp(np.log1p(-_GROSS_SHARE) + log, np.log(_GROSS_SHARE / reach))
        gain[:, 0] = np.where(gross, 0.0, gain[:, 0])
        mean[..., on] += gain * off
        spread[..., on] = predicted * (1 - gain)
        level[..., on] += log
        before[on] = now
        constant, free = level[:, :1, on], level[:, 1:, on]
        score[on] = (
            np.logaddexp.reduce(constant, axis=(0, 1))
            - np.logaddexp.reduce(free, axis=(0, 1))
            + np.log(len(_HINDERED))
        )
        best[on] = np.maximum(best[on], score[on])
        holds = on[score[on] >= best[on] - _INSIGNIFICANT]
        last[holds] = time[begin[holds] + k]
        over = (score[on] < -_INSIGNIFICANT) | (best[on] - score[on] > threshold)
        ended = on[over & (best[on] > threshold)]
        out.append((ended, start[ended], last[ended], best[ended]))
        restart(on[over], value[over], now[over])
    near = np.bincount(pair[distance <= reach], minlength=count)
    decided = best > threshold
    spans = (start == time[begin]) & (near == length) & (2 * length > np.ptp(time) + 1)
    open_still = spans & (score >= -_INSIGNIFICANT)
    usual = 2 * near[decided | open_still].sum() > near.sum()
    kept = np.flatnonzero(decided | (open_still & usual))
    out.append((kept, start[kept], last[kept], best[kept]))
    index, first, final, value = (np.concatenate(column) for column in zip(*out, strict=True))
    return Contacts(index, index, first, final, value)
