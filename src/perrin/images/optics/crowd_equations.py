"""The intensity of many spheres whose images overlap, and the normal equations of their positions.

Axes of arrays and centres are (z, y, x), um, with the origin at the centre of voxel (0, 0, 0). The
parameters are ordered as position (z, y, x) and brightness of every sphere, one sphere after the
other, and then the parameters of the background.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from perrin.images.optics.window_fit import box_around, within

if TYPE_CHECKING:
    from collections.abc import Iterator

    from perrin._arrays import Bools, Floats
    from perrin.images.optics.ball_image import SphereImage, SphereSpot
    from perrin.images.optics.optics import CameraNoise


# Parameters of a sphere: its position and its brightness.
_PER_SPHERE = 4

# Slopes and curvatures of the background within the plane.
_N_TILTS = 5


@dataclass(frozen=True, eq=False)
class CrowdWindow:
    """The voxels around a crowd, and the model of their intensity.

    The background has a level of its own in every plane, because planes are scanned one after
    another and a dense sample often ends at a dark floor, and a smooth slope and curvature within
    the plane.

    Attributes
    ----------
    data : ndarray, shape (nz, ny, nx)
        Grey levels.
    mask : ndarray of bool, shape (nz, ny, nx)
        The voxels that the fit uses.
    origin : ndarray, shape (3,)
        Position of the first voxel in the frame, um.
    image : SphereImage
        The image of a sphere.
    noise : CameraNoise
        The variance of a voxel.
    tilt : ndarray, shape (5, ny, nx)
        Basis of the background within the plane: y, x, y^2, x^2 and x y.
    """

    data: Floats
    mask: Bools
    origin: Floats
    image: SphereImage
    noise: CameraNoise
    tilt: Floats

    @property
    def n_background(self) -> int:
        """Number of parameters of the background."""
        return len(self.data) + _N_TILTS

    def background(self, parameters: Floats) -> Floats:
        """Return the intensity of the background (nz, ny, nx)."""
        n = len(self.data)
        return np.asarray(parameters[:n, None, None] + np.tensordot(parameters[n:], self.tilt, 1))

    def holds(self, centers: Floats) -> Bools:
        """Return which positions lie between the first voxel and the last."""
        last = self.origin + (np.array(self.data.shape) - 1) * np.array(self.image.voxel)
        return np.asarray(np.all((centers >= self.origin) & (centers <= last), axis=1))

    def spots(self, image: SphereImage, centers: Floats) -> list[SphereSpot]:
        """Return the unit images of spheres in this window."""
        shape, origin = self.data.shape, self.origin
        return [image.spot(c - origin, shape, height=float(c[0])) for c in centers]


def cut_crowd_window(
    frame: Floats, image: SphereImage, noise: CameraNoise, centers: Floats, others: Floats
) -> CrowdWindow:
    """Cut out the box around the spheres of a crowd, one sphere wider than their images.

    Spheres missing from `centers` are searched for in the whole box.

    Parameters
    ----------
    frame : ndarray, shape (nz, ny, nx)
        Voxels of NaN are left out.
    image : SphereImage
    noise : CameraNoise
    centers, others : ndarray, shape (n, 3), (m, 3)
        Positions of the crowd, and of other spheres, whose voxels are not used, um.

    Returns
    -------
    CrowdWindow
    """
    extent, step = image.extent, np.array(image.voxel)
    box = box_around(centers, extent + image.diameter, image.voxel, frame.shape)
    grid = [h * np.arange(s.start, s.stop) for s, h in zip(box, step, strict=True)]
    ends = np.array([[g[0], g[-1]] for g in grid]).T
    near = np.all(np.abs(others - np.clip(others, *ends)) < extent, axis=1)
    y, x = (np.linspace(-1.0, 1.0, len(g)) for g in grid[1:])
    plane = (len(y), len(x))
    basis = (y[:, None], x, y[:, None] ** 2, x**2, y[:, None] * x)
    known = np.isfinite(frame[box])
    return CrowdWindow(
        np.where(known, frame[box], 0.0),
        known & ~within(grid, others[near], extent),
        np.array([g[0] for g in grid]),
        image,
        noise,
        np.stack([np.broadcast_to(term, plane) for term in basis]),
    )


class CrowdIntensity(NamedTuple):
    """Spheres with their brightness and a background, and the expected grey levels.

    Attributes
    ----------
    centers : ndarray, shape (n, 3)
        Positions, um.
    brightness : ndarray, shape (n,)
        Intensity inside each sphere, grey levels.
    background : ndarray, shape (nz + 5,)
        Parameters of the background.
    spots : list of SphereSpot
        Unit images of the spheres.
    expected : ndarray, shape (nz, ny, nx)
        Expected grey levels.
    weight : ndarray, shape (nz, ny, nx)
        Inverse variances; 0 for voxels that the fit does not use.
    """

    centers: Floats
    brightness: Floats
    background: Floats
    spots: list[SphereSpot]
    expected: Floats
    weight: Floats

    def chi2(self, window: CrowdWindow, expected: Floats) -> float:
        """Return chi-squared of expected grey levels, with the weights of this state."""
        return float(np.sum(self.weight * (window.data - expected) ** 2))

    @property
    def n_voxels(self) -> int:
        """Number of voxels that the fit uses."""
        return int(np.count_nonzero(self.weight))

    def moved(self, window: CrowdWindow, step: Floats) -> CrowdIntensity:
        """Return the intensity after a step of all parameters."""
        n = len(self.centers)
        own = step[: _PER_SPHERE * n].reshape(n, _PER_SPHERE)
        return crowd_intensity(
            window,
            self.centers + own[:, :3],
            self.brightness + own[:, 3],
            self.background + step[_PER_SPHERE * n :],
        )


def crowd_intensity(
    window: CrowdWindow, centers: Floats, brightness: Floats, background: Floats
) -> CrowdIntensity:
    """Return the intensity of spheres on a background.

    Parameters
    ----------
    window : CrowdWindow
    centers, brightness, background
        As in `CrowdIntensity`.

    Returns
    -------
    CrowdIntensity
    """
    spots = window.spots(window.image, centers)
    expected = window.background(background) + sum_of_spheres(window, spots, brightness)
    weight = np.where(window.mask, window.noise.weight(expected), 0.0)
    return CrowdIntensity(centers, brightness, background, spots, expected, weight)


def sum_of_spheres(window: CrowdWindow, spots: list[SphereSpot], brightness: Floats) -> Floats:
    """Return the intensity (nz, ny, nx) of all spheres together, without the background."""
    intensity = np.zeros(window.data.shape)
    for spot, bright in zip(spots, brightness, strict=True):
        intensity[spot.box] += bright * spot.value
    return intensity


def slopes_of_spheres(
    window: CrowdWindow, slopes: Floats, centers: Floats, brightness: Floats
) -> Floats:
    """Return derivatives (k, nz, ny, nx) of the intensity by parameters of the sphere's image.

    Parameters
    ----------
    window : CrowdWindow
    slopes : ndarray, shape (k, ...)
        The tables of `SphereImage.slopes`.
    centers, brightness : ndarray, shape (n, 3), (n,)
        The spheres.

    Returns
    -------
    ndarray, shape (k, nz, ny, nx)
    """
    intensity = np.zeros((len(slopes), *window.data.shape))
    for center, bright in zip(centers - window.origin, brightness, strict=True):
        box, value = window.image.slope_spot(slopes, center, window.data.shape)
        intensity[(slice(None), *box)] += bright * value
    return intensity


def fit_brightness(window: CrowdWindow, centers: Floats) -> CrowdIntensity:
    """Fit brightness and background by least squares, with the spheres at given positions.

    Parameters
    ----------
    window : CrowdWindow
    centers : ndarray, shape (n, 3)
        Positions, um.

    Returns
    -------
    CrowdIntensity
    """
    n = len(centers)
    planes = zip(window.data, window.mask, strict=True)
    level = [float(d[m].mean()) if m.any() else 0.0 for d, m in planes]
    state = crowd_intensity(window, centers, np.zeros(n), np.append(level, np.zeros(_N_TILTS)))
    for _ in range(2):
        information, score = normal_equations(window, state)
        free = np.append(
            np.arange(3, _PER_SPHERE * n, _PER_SPHERE), np.arange(_PER_SPHERE * n, len(score))
        )
        # The brightness of a sphere outside the window is undetermined; lstsq leaves it at 0.
        step = np.zeros_like(score)
        part = information[free][:, free].toarray()
        step[free] = np.linalg.lstsq(part, score[free], rcond=None)[0]
        state = state.moved(window, step)
    return state


def normal_equations(window: CrowdWindow, state: CrowdIntensity) -> tuple[Any, Floats]:
    """Return the Fisher information, sparse (p, p), and the score (p,).

    Spheres whose boxes do not overlap have no common term.
    """
    from scipy.sparse import coo_array

    blocks = list(_information_blocks(window, state))
    blocks += [(column, row, block.T) for row, column, block in blocks if row != column]
    index = [np.indices(block.shape).reshape(2, -1) for *_, block in blocks]
    row, column = (
        np.concatenate([at[k] + block[k] for at, block in zip(index, blocks, strict=True)])
        for k in (0, 1)
    )
    value = np.concatenate([block.ravel() for *_, block in blocks])
    p = _PER_SPHERE * len(state.spots) + window.n_background
    information = coo_array((value, (row, column)), shape=(p, p)).tocsr()
    return information, project(window, state, state.weight * (window.data - state.expected))


def brightness_parameters(state: CrowdIntensity) -> slice:
    """Return which of the parameters are the brightness of the spheres."""
    return slice(_PER_SPHERE - 1, _PER_SPHERE * len(state.spots), _PER_SPHERE)


def project(window: CrowdWindow, state: CrowdIntensity, field: Floats) -> Floats:
    """Return the scalar products (p,) of a field with the intensity's derivatives."""
    own = [
        s.reshape(_PER_SPHERE, -1) @ field[spot.box].ravel()
        for s, spot in zip(_sphere_derivatives(state), state.spots, strict=True)
    ]
    return np.concatenate([*own, field.sum((1, 2)), np.einsum("tyx,zyx->t", window.tilt, field)])


def _sphere_derivatives(state: CrowdIntensity) -> list[Floats]:
    """Return the derivatives (4, *box) of every sphere's intensity by position and brightness."""
    pairs = zip(state.spots, state.brightness, strict=True)
    return [np.concatenate([b * spot.gradient, spot.value[None]]) for spot, b in pairs]


def _information_blocks(
    window: CrowdWindow, state: CrowdIntensity
) -> Iterator[tuple[int, int, Floats]]:
    """Yield the blocks of the information on and right of the diagonal: row, column, block."""
    derivatives, last = _sphere_derivatives(state), _PER_SPHERE * len(state.spots)
    n, tilt = len(window.data), window.tilt
    for i, a in enumerate(state.spots):
        weighted = derivatives[i] * state.weight[a.box]
        with_background = np.zeros((_PER_SPHERE, window.n_background))
        with_background[:, a.box[0]] = weighted.sum((2, 3))
        tilt_here = tilt[(slice(None), *a.box[1:])].reshape(_N_TILTS, -1)
        with_background[:, n:] = weighted.sum(1).reshape(_PER_SPHERE, -1) @ tilt_here.T
        yield _PER_SPHERE * i, last, with_background
        for j in range(i, len(state.spots)):
            b = state.spots[j]
            overlap = [
                slice(max(p.start, q.start), min(p.stop, q.stop))
                for p, q in zip(a.box, b.box, strict=True)
            ]
            if all(common.start < common.stop for common in overlap):
                # The overlap as a part of each of the two boxes.
                in_a, in_b = (
                    tuple(
                        slice(common.start - side.start, common.stop - side.start)
                        for common, side in zip(overlap, box, strict=True)
                    )
                    for box in (a.box, b.box)
                )
                own = weighted[(slice(None), *in_a)].reshape(_PER_SPHERE, -1)
                theirs = derivatives[j][(slice(None), *in_b)].reshape(_PER_SPHERE, -1)
                yield _PER_SPHERE * i, _PER_SPHERE * j, own @ theirs.T
    flat, weight = tilt.reshape(_N_TILTS, -1), state.weight
    background = np.zeros((window.n_background, window.n_background))
    background[:n, :n] = np.diag(weight.sum((1, 2)))
    background[:n, n:] = weight.reshape(n, -1) @ flat.T
    background[n:, :n] = background[:n, n:].T
    background[n:, n:] = (flat * weight.sum(0).ravel()) @ flat.T
    yield last, last, background


def profile_information(
    window: CrowdWindow, state: CrowdIntensity, derivatives: Floats
) -> tuple[Floats, Floats]:
    """Return information (k, k) and score (k,) of k more parameters, all others eliminated.

    Parameters
    ----------
    window : CrowdWindow
    state : CrowdIntensity
    derivatives : ndarray, shape (k, nz, ny, nx)
        Derivatives of the intensity by the k parameters.

    Returns
    -------
    information : ndarray, shape (k, k)
    score : ndarray, shape (k,)

    Notes
    -----
    The Schur complement of the information; parameters without information count as known.
    """
    from scipy.sparse import diags_array
    from scipy.sparse.linalg import splu

    information, score = normal_equations(window, state)
    scale = information.diagonal()
    ridge = diags_array(np.where(scale > 0, 1e-12 * scale, 1.0))
    weighted = state.weight * derivatives
    shared = np.stack([project(window, state, w) for w in weighted], axis=1)
    taken = splu((information + ridge).tocsc()).solve(shared)
    own = np.einsum("izyx,jzyx->ij", weighted, derivatives)
    direct = np.einsum("izyx,zyx->i", weighted, window.data - state.expected)
    return own - shared.T @ taken, direct - taken.T @ score


def standard_errors(information: Any, state: CrowdIntensity) -> Floats:  # noqa: ANN401 (sparse)
    """Return the standard errors (n, 3) of positions, um; NaN for a sphere without information.

    The information on a sphere, on all spheres whose boxes overlap its own, and on the background
    is inverted; all other spheres count as known.
    """
    n, size = len(state.spots), information.shape[0]
    sigma = np.full((n, 3), np.nan)
    undetermined = information.diagonal() <= 0
    for i in range(n):
        row = slice(*information.indptr[_PER_SPHERE * i : _PER_SPHERE * i + 2])
        near = np.sort(information.indices[row])
        part = np.append(near[near < _PER_SPHERE * n], np.arange(_PER_SPHERE * n, size))
        local = information[part][:, part].toarray() + np.diag(undetermined[part])
        own = np.searchsorted(part, _PER_SPHERE * i + np.arange(3))
        if not undetermined[part[own]].any():
            sigma[i] = np.sqrt(np.diag(np.linalg.inv(local))[own])
    return sigma


def sphere_chi2(window: CrowdWindow, state: CrowdIntensity) -> Floats:
    """Return chi-squared per voxel (n,), averaged over every sphere's own voxels."""
    square = state.weight * (window.data - state.expected) ** 2
    chi2 = np.full(len(state.spots), np.nan)
    for i, spot in enumerate(state.spots):
        used = float(spot.value[window.mask[spot.box]].sum())
        if used > 0:
            chi2[i] = float(np.sum(spot.value * square[spot.box])) / used
    return chi2


def visible_fraction(window: CrowdWindow, state: CrowdIntensity) -> Floats:
    """Return the fraction (n,) of every sphere's intensity that falls on voxels of the fit."""
    volume = np.pi * window.image.diameter**3 / 6 / float(np.prod(window.image.voxel))
    visible = [float(spot.value[window.mask[spot.box]].sum()) for spot in state.spots]
    return np.array(visible) / volume


def detection_chi2(state: CrowdIntensity) -> Floats:
    """Return the chi-squared (n,) of every sphere's intensity, all other parameters known."""
    pairs = zip(state.spots, state.brightness, strict=True)
    chi2 = [b**2 * np.sum(state.weight[spot.box] * spot.value**2) for spot, b in pairs]
    return np.array(chi2, dtype=np.float64)


def residual_maps(
    window: CrowdWindow, state: CrowdIntensity, least: float
) -> tuple[Floats, Floats, Floats, float]:
    """Return the brightness and the gain of one more sphere at every voxel.

    Parameters
    ----------
    window : CrowdWindow
    state : CrowdIntensity
    least : float
        Least visible fraction of a sphere; positions beyond the window are included.

    Returns
    -------
    brightness, gain : ndarray
        Brightness by least squares, and the decrease of chi-squared, in a box larger than the
        window; 0 where less than `least` of the sphere would be visible.
    corner : ndarray, shape (3,)
        Position of the first voxel of that box, um.
    known : float
        Information on the brightness of a sphere that is wholly visible.
    """
    from scipy.signal import fftconvolve

    image, step = window.image, np.array(window.image.voxel)
    half = (np.array(image.reach) / step).astype(int)
    value, _ = image.at(*(h * np.arange(-k, k + 1) for h, k in zip(step, half, strict=True)))
    # The sphere's image is its own mirror image, so that convolution is correlation.
    score = fftconvolve(state.weight * (window.data - state.expected), value)
    known = fftconvolve(state.weight, value**2)
    visible = fftconvolve(window.mask.astype(np.float64), value) > least * value.sum()
    brightness = np.where(visible, score / np.where(visible, known, 1.0), 0.0)
    return brightness, brightness * score, window.origin - half * step, float(known.max())
