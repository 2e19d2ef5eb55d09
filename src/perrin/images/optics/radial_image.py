"""The image of a sphere in the plane: one radial function, learned from the movie.

Under a camera that sees all of a sphere, the image depends on the distance from its centre alone,
whatever the optics: a disc, a ring, a spot, or the fringes of bright field. The images of
neighbours add. Positions are (y, x), um, with the origin at the centre of pixel (0, 0).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from perrin._arrays import from_plain, frozen, to_plain
from perrin.images.optics.optics import CameraNoise

if TYPE_CHECKING:
    from collections.abc import Mapping

    from perrin._arrays import Floats, Ints


# Coefficients of 1, t, t^2 and t^3 in a piece of a spline, by those of its four cubic B-splines.
_CUBIC = np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]]) / 6.0

# Step of a sphere over the distance of the knots at which a fit ends, and its most steps.
_RADIAL_STEP_CONVERGED, _MAX_STEPS = 1e-3, 25

# Last step that is accepted, in standard errors of a coordinate with all others known.
_SETTLED_STEP = 0.1

# Radius of the pixels of a fit over that of the image.
_SURROUNDINGS = 1.25

# Damping below which a step is a full one, and that at which no step lowers chi-squared.
_SMALL_DAMPING, _MOST_DAMPING = 0.1, 1e8

# Least number of pixels for each fitted parameter.
_PIXELS_PER_PARAMETER = 4

# Least transmission that a logarithm is taken of.
_LEAST_TRANSMISSION = 0.01

# Parameters of the background: a level and its slope along y and x.
_N_LOCAL_BACKGROUND = 3


class TransmissionNoise(NamedTuple):
    """Noise of the logarithm of grey levels: of images whose transmissions multiply.

    A sphere lets a share of the light through, so that behind two spheres the shares multiply: in
    the logarithm ``level * log(grey / level)`` their images add. A grey level g has the variance
    gain g + floor, its logarithm (level / g)^2 of it.

    Attributes
    ----------
    gain : float
        Grey levels per photon.
    floor : float
        Variance of a pixel whose expected value is 0, squared grey levels.
    level : float
        Grey level at which the logarithm is 0 and has the slope 1.

    Examples
    --------
    >>> noise = TransmissionNoise(3.0, 4.0, 100.0)
    >>> logarithm = noise.logarithm(np.array([50.0, 100.0]))
    >>> noise.grey(logarithm), noise.weight(logarithm).round(5)
    (array([ 50., 100.]), array([0.00162, 0.00329]))
    """

    gain: float
    floor: float
    level: float

    def logarithm(self, grey: Floats) -> Floats:
        """Return level log(grey / level); grey levels below a hundredth of the level count as it.

        The logarithm of a noisy grey level is on average below that of its mean by half its
        relative variance, far below the noise unless there are only a few photons.
        """
        least = _LEAST_TRANSMISSION * self.level
        return np.asarray(self.level * np.log(np.maximum(grey, least) / self.level))

    def grey(self, logarithm: Floats) -> Floats:
        """Return the grey levels of logarithms."""
        return np.asarray(self.level * np.exp(logarithm / self.level))

    def weight(self, expected: Floats) -> Floats:
        """Return the inverse variance of pixels with these expected logarithms."""
        grey = self.grey(expected)
        return CameraNoise(self.gain, self.floor).weight(grey) * (grey / self.level) ** 2


@dataclass(frozen=True, eq=False)
class RadialImage:
    """The image of a sphere as a function of the distance from its centre.

    A cubic spline on even knots, smooth at the centre, and zero with two derivatives at its end.

    Attributes
    ----------
    spacing : float
        Distance of the knots, um.
    coefficients : ndarray, shape (k,)
        Coefficients of the B-splines that are centred at 0, 1, ... k - 1 times the spacing, grey
        levels.
    noise : CameraNoise or TransmissionNoise
        Variance of a pixel. With `TransmissionNoise` the image is that of the logarithm of the
        grey levels: the transmissions of spheres multiply.

    Examples
    --------
    >>> image = RadialImage(0.5, np.array([3.0, 2.0, 1.0]), CameraNoise(1.0, 0.0))
    >>> image.reach, image.value(np.array([0.0, 1.0, 2.0])).round(3)
    (2.0, array([2.667, 1.   , 0.   ]))
    """

    spacing: float
    coefficients: Floats
    noise: CameraNoise | TransmissionNoise

    def __post_init__(self) -> None:
        """Make the array read-only."""
        frozen(self.coefficients)

    @property
    def reach(self) -> float:
        """Distance from the centre at which the image ends, um."""
        return (len(self.coefficients) + 1) * self.spacing

    @property
    def surroundings(self) -> float:
        """Distance from the centre of the pixels of a fit, which show the background too, um."""
        return _SURROUNDINGS * self.reach

    def value(self, distance: Floats) -> Floats:
        """Return the image at distances from the centre, um."""
        (a, b, c, d), t = self._pieces(distance)
        return np.asarray(a + t * (b + t * (c + t * d)))

    def value_and_slope(self, distance: Floats) -> tuple[Floats, Floats]:
        """Return the image at distances from the centre, and its derivative, 1/um."""
        (a, b, c, d), t = self._pieces(distance)
        slope = (b + t * (2 * c + 3 * t * d)) / self.spacing
        return np.asarray(a + t * (b + t * (c + t * d))), np.asarray(slope)

    def _pieces(self, distance: Floats) -> tuple[list[Floats], Floats]:
        """Return the coefficients of the spline's piece at each distance, and the place in it."""
        knot, part = _in_knots(distance, self.spacing, len(self.coefficients))
        return [of_order.take(knot, mode="clip") for of_order in self.cubics], part

    @cached_property
    def cubics(self) -> Floats:
        """Coefficients (4, k + 2) of the cubic pieces of the spline, grey levels."""
        mirrored = np.concatenate([self.coefficients[1:2], self.coefficients, np.zeros(4)])
        pieces: Floats = _CUBIC @ np.lib.stride_tricks.sliding_window_view(mirrored, 4).T
        return pieces

    def to_dict(self) -> dict[str, Any]:
        """Return values that JSON holds; `noise` is [gain, floor], or [gain, floor, level]."""
        noise = self.noise[:2] if isinstance(self.noise, CameraNoise) else self.noise
        return {
            "spacing": to_plain(self.spacing),
            "coefficients": to_plain(self.coefficients),
            "noise": [to_plain(value) for value in noise],
        }

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> RadialImage:
        """Return the image that `to_dict` wrote.

        Parameters
        ----------
        entry : mapping
            The dictionary of `to_dict`.

        Returns
        -------
        RadialImage
        """
        values = entry["noise"]
        noise = TransmissionNoise(*values) if len(values) == 3 else CameraNoise(*values)
        return cls(entry["spacing"], from_plain(entry["coefficients"]), noise)

    def seen_in(self, frame: Floats) -> Floats:
        """Return what the images of spheres add to: grey levels, or their logarithms."""
        if isinstance(self.noise, TransmissionNoise):
            return self.noise.logarithm(frame)
        return frame


def _in_knots(distance: Floats, spacing: float, k: int) -> tuple[Ints, Floats]:
    """Return the piece of each distance, k + 1 beyond the last one, and the place within it."""
    scaled = np.minimum(distance / spacing, k + 1.0)
    knot = scaled.astype(np.int64)
    return knot, scaled - knot


def spline_design(distance: Floats, *, spacing: float, k: int) -> Floats:
    """Return the values of every B-spline of a radial image.

    Parameters
    ----------
    distance : ndarray, shape (n, m)
        Distances of m pixels from n centres, um.
    spacing : float
        Distance of the knots, um.
    k : int
        Number of B-splines.

    Returns
    -------
    ndarray, shape (n, k, m)

    Examples
    --------
    >>> distance = np.array([[0.0, 0.7, 1.9, 2.5]])
    >>> image = RadialImage(0.5, np.array([3.0, 2.0, 1.0]), CameraNoise(1.0, 0.0))
    >>> design = spline_design(distance, spacing=0.5, k=3)
    >>> np.allclose(image.coefficients @ design[0], image.value(distance[0]))
    True
    """
    n, m = distance.shape
    knot, t = _in_knots(distance, spacing, k)
    weights = np.einsum("pw,pnm->wnm", _CUBIC, np.stack([np.ones_like(t), t, t**2, t**3]))
    out = np.zeros((k + 6, n * m))
    pixel = np.arange(n * m)
    # The row 0 is the B-spline at -1 knots, which is that at 1 knot mirrored.
    for w in range(4):
        out[knot.ravel() + w, pixel] = weights[w].ravel()
    if k > 1:
        out[2] += out[0]
    return np.moveaxis(out[1 : k + 1].reshape(k, n, m), 1, 0)


class Patch(NamedTuple):
    """The pixels of one fit: those near any of its spheres.

    Attributes
    ----------
    place : ndarray, shape (2, m)
        Positions (y, x), um.
    data : ndarray, shape (m,)
        Grey levels, less the images of spheres that are not fitted.
    background : ndarray, shape (3, m)
        The background's basis: a level and its slope along y and x.
    pixel : ndarray of int, shape (2, m)
        Numbers (y, x) of the pixels in the frame.
    """

    place: Floats
    data: Floats
    background: Floats
    pixel: Ints

    def offsets(self, centers: Floats) -> tuple[Floats, Floats]:
        """Return positions (n, 2, m) relative to the centres (n, 2), and distances (n, m)."""
        offset = self.place - centers[:, :, None]
        return offset, np.sqrt((offset**2).sum(axis=1))

    def has_enough_pixels(self, count: int) -> bool:
        """Return whether there are enough pixels to fit `count` spheres."""
        return len(self.data) >= _PIXELS_PER_PARAMETER * (3 * count + _N_LOCAL_BACKGROUND)


def cut_patch(frame: Floats, centers: Floats, *, reach: float, pixel: tuple[float, float]) -> Patch:
    """Cut out the pixels within `reach` of any of the centres.

    Parameters
    ----------
    frame : ndarray, shape (ny, nx)
    centers : ndarray, shape (n, 2)
        Positions (y, x), um.
    reach : float
        Distance from the centre, um.
    pixel : tuple of float
        Pixel size (y, x), um.

    Returns
    -------
    Patch

    Examples
    --------
    >>> patch = cut_patch(np.eye(9), np.array([[0.8, 0.8]]), reach=0.25, pixel=(0.2, 0.2))
    >>> patch.data.tolist()
    [0.0, 0.0, 1.0, 0.0, 0.0]
    """
    step = np.array(pixel)
    low = np.clip(np.floor((centers.min(0) - reach) / step), 0, None).astype(int)
    high = np.minimum(np.ceil((centers.max(0) + reach) / step) + 1, frame.shape).astype(int)
    y, x = (h * np.arange(a, max(a, b)) for h, a, b in zip(step, low, high, strict=True))
    inside = np.zeros((len(y), len(x)), dtype=np.bool_)
    for center in centers:
        inside |= ((y - center[0]) ** 2)[:, None] + (x - center[1]) ** 2 < reach**2
    number = np.stack(np.nonzero(inside)) + low[:, None]
    place = number * step[:, None]
    middle = place.mean(axis=1, keepdims=True) if place.size else np.zeros((2, 1))
    background = np.concatenate([np.ones((1, place.shape[1])), (place - middle) / reach])
    data = frame[number[0], number[1]].astype(np.float64)
    return Patch(place, data, background, number)


class PatchFit(NamedTuple):
    """A fit of the spheres of a patch.

    Attributes
    ----------
    centers : ndarray, shape (n, 2)
        Positions (y, x), um.
    linear : ndarray, shape (n + 3,)
        Brightness of each sphere relative to the image, and background.
    expected : ndarray, shape (m,)
        Expected grey levels.
    information : ndarray, shape (3 n + 3, 3 n + 3)
        Fisher information of positions, brightness and background.
    jacobian : ndarray, shape (3 n + 3, m)
        Derivatives of the expected grey levels.
    weight : ndarray, shape (m,)
        Inverse variances of the pixels.
    chi2 : float
        Chi-squared per degree of freedom.
    converged : bool
        Whether the last step was far below the distance of the knots.
    """

    centers: Floats
    linear: Floats
    expected: Floats
    information: Floats
    jacobian: Floats
    weight: Floats
    chi2: float
    converged: bool

    @property
    def brightness(self) -> Floats:
        """Brightness (n,) of each sphere relative to the image."""
        return self.linear[: len(self.centers)]

    @property
    def covariance(self) -> Floats:
        """Covariance (3 n + 3, 3 n + 3) of positions, brightness and background."""
        return np.asarray(np.linalg.pinv(self.information, hermitian=True), dtype=np.float64)


class _PatchState(NamedTuple):
    """Parameters of a fit, and what follows from them."""

    centers: Floats
    linear: Floats
    expected: Floats
    weight: Floats
    jacobian: Floats

    def chi2(self, patch: Patch, expected: Floats) -> float:
        """Return chi-squared of an expected intensity, with the weights of this state."""
        return float(self.weight @ (patch.data - expected) ** 2)


def _patch_state(
    patch: Patch, image: RadialImage, centers: Floats, known: Floats, linear: Floats | None
) -> _PatchState:
    """Return the state of positions; `linear` None is fitted by least squares."""
    n, m = len(centers), len(patch.data)
    offset, distance = patch.offsets(centers)
    value, slope = image.value_and_slope(distance)
    rows = np.concatenate([value, patch.background])
    if linear is None:
        weight = image.noise.weight(np.full(m, (patch.data + known).mean()))
        linear = np.zeros(len(rows))
        for _ in range(2):
            weighted = rows * weight
            solved = np.linalg.lstsq(weighted @ rows.T, weighted @ patch.data, rcond=None)[0]
            linear = np.asarray(solved, dtype=np.float64)
            weight = image.noise.weight(np.asarray(linear @ rows + known))
    expected = linear @ rows
    gradient = -(linear[:n, None] * slope / np.maximum(distance, 1e-12))[:, None] * offset
    return _PatchState(
        centers,
        linear,
        expected,
        image.noise.weight(expected + known),
        np.concatenate([gradient.reshape(2 * n, m), rows]),
    )


def fit_patch(
    patch: Patch, image: RadialImage, start: Floats, *, known: Floats | float = 0.0
) -> PatchFit:
    """Find positions, brightness and background of greatest likelihood.

    Parameters
    ----------
    patch : Patch
        The pixels of the fit.
    image : RadialImage
        The image of a sphere.
    start : ndarray, shape (n, 2)
        Positions (y, x) at the start, um.
    known : ndarray, shape (m,), or float
        Images of other spheres, which the grey levels of the patch no longer contain: they count
        for the noise only.

    Returns
    -------
    PatchFit

    Notes
    -----
    Fisher scoring with Levenberg-Marquardt damping, as in `fit_window`. A steep rim between pixels
    makes it slow: a last step of under a tenth of a standard error is accepted.

    Examples
    --------
    >>> image = RadialImage(0.3, np.array([100.0, 80.0, 30.0]), CameraNoise(1.0, 0.0))
    >>> y, x = np.meshgrid(0.2 * np.arange(20), 0.2 * np.arange(20), indexing="ij")
    >>> frame = 5 + image.value(np.hypot(y - 2.03, x - 1.87))
    >>> patch = cut_patch(frame, np.array([[2.0, 2.0]]), reach=1.6, pixel=(0.2, 0.2))
    >>> fit = fit_patch(patch, image, np.array([[2.1, 1.8]]))
    >>> fit.centers.round(4), fit.brightness.round(4)
    (array([[2.03, 1.87]]), array([1.]))
    """
    others = np.broadcast_to(np.asarray(known, dtype=np.float64), patch.data.shape)
    n = len(start)
    state = _patch_state(patch, image, start, others, None)
    damping, converged, settled = 1e-3, False, False
    for _ in range(_MAX_STEPS):
        weighted = state.jacobian * state.weight
        information = weighted @ state.jacobian.T
        score = weighted @ (patch.data - state.expected)
        scale = np.diag(information)
        if not scale.min() > 0:  # a sphere without intensity in the patch has no position
            break
        step = np.linalg.solve(information + np.diag((damping + 1e-12) * scale), score)
        trial = _patch_state(
            patch,
            image,
            state.centers + step[: 2 * n].reshape(n, 2),
            others,
            state.linear + step[2 * n :],
        )
        if state.chi2(patch, trial.expected) > state.chi2(patch, state.expected) * (1 + 1e-12):
            damping *= 10.0
            if damping > _MOST_DAMPING:
                break
            continue
        change = np.abs(step[: 2 * n]).max()
        full = damping < _SMALL_DAMPING
        settled = full and bool((np.abs(step) * np.sqrt(scale) < _SETTLED_STEP)[: 2 * n].all())
        state, damping = trial, damping / 10.0
        if change < _RADIAL_STEP_CONVERGED * image.spacing and full:
            converged = True
            break
    freedom = max(len(patch.data) - len(state.jacobian), 1)
    return PatchFit(
        state.centers,
        state.linear,
        state.expected,
        np.asarray((state.jacobian * state.weight) @ state.jacobian.T),
        state.jacobian,
        state.weight,
        state.chi2(patch, state.expected) / freedom,
        converged or settled,
    )
