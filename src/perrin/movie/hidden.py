"""Spheres of a body that were not found: beyond the border, or dim. The images show their light."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from perrin._arrays import frozen
from perrin._text import listed
from perrin.geometry.rotations import kabsch
from perrin.geometry.shapes import pair_distances
from perrin.images.optics.clipping import without_clipped
from perrin.images.optics.window_fit import RigidCenters, cut_window, fit_window
from perrin.movie.checks import Findings
from perrin.run.kinds import matched_particles, shape_numbers

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import pandas as pd

    from perrin._arrays import Bools, Floats, Ints
    from perrin.images.optics.optics import Optics
    from perrin.images.stack import Stack
    from perrin.motion.rigid_motion import RigidMotion

# Two spheres are no nearer than this share of a contact, and touch within this one.
_APART, _TOUCHING = 0.8, 1.15

# A part of a known shape fits it with a root mean square distance below this share of a contact.
_SAME_PLACES = 0.1

# Frames in which a hidden sphere is looked for, and the most that are added to one body.
_FRAMES_TRIED, _MOST_HIDDEN = 5, 4

# A sphere that is not found is beyond the border, or at most this share of its diameter inside.
_INSIDE = 0.15

# Chi-squared falls by over this for every sphere that is added: a chance of 1e-12 for its light.
_LEAST_GAIN = 50.0

# Brightness over that of the spheres that were found, median of the frames: of a sphere of a known
# shape, which may be dim, and of one that only touches three others, which is not.
_BRIGHT_KNOWN, _BRIGHT_TOUCHING = (0.08, 1.6), (0.5, 1.6)

# Places that touch three spheres are tried for bodies of up to this many spheres.
_LARGEST_BODY = 20

# Bodies that a note lists.
_MOST_LISTED = 6

# A sphere shows light in the field if its centre is within this share of its diameter of it.
_SHARE_IN_VIEW = 0.5


@dataclass(frozen=True, eq=False)
class Hidden:
    """Spheres of one body that were not found.

    Attributes
    ----------
    places : ndarray, shape (m, 3)
        Positions in the axes of the body's template, um.
    brightness : ndarray, shape (m,)
        Median brightness over that of the spheres that were found; NaN where out of view.
    beyond : ndarray of bool, shape (m,)
        Whether they are beyond the border in most frames.
    """

    places: Floats
    brightness: Floats
    beyond: Bools

    def __post_init__(self) -> None:
        frozen(self.places, self.brightness, self.beyond)

    def joined(self, more: Hidden) -> Hidden:
        """Return these spheres and others of the same body."""
        return Hidden(
            np.concatenate([self.places, more.places]),
            np.concatenate([self.brightness, more.brightness]),
            np.concatenate([self.beyond, more.beyond]),
        )

    def __str__(self) -> str:
        """Return where they are and how bright, in words."""
        seen = listed(f"{b:.2f}" for b in self.brightness[np.isfinite(self.brightness)])
        where = "beyond the border" if self.beyond.all() else "dim"
        return f"{where}, brightness {seen} of that of the others"


def touching_places(template: Floats, *, contact: float) -> Floats:
    """Return the places at which a sphere would touch three spheres of a body, and overlap none.

    Parameters
    ----------
    template : ndarray, shape (n, 3)
        Positions of the spheres of the body, um.
    contact : float
        Centre distance of touching spheres, um.

    Returns
    -------
    ndarray, shape (m, 3)

    Examples
    --------
    >>> from perrin import Cluster
    >>> trimer = Cluster.touching(3, 2.0).positions
    >>> places = touching_places(trimer, contact=2.0)
    >>> np.linalg.norm(places[:, None] - trimer, axis=2).round(6)
    array([[2., 2., 2.],
           [2., 2., 2.]])
    """
    found = [np.empty((0, 3))]
    for three in combinations(range(len(template)), 3):
        a, b, c = template[list(three)]
        if max(np.linalg.norm(a - b), np.linalg.norm(b - c), np.linalg.norm(c - a)) > 2 * contact:
            continue
        u, v = b - a, c - a
        normal = np.cross(u, v)
        square = float(normal @ normal)
        if square < (0.1 * contact**2) ** 2:
            continue
        # Centre of the circle through the three.
        middle = (np.cross(normal, u) * (v @ v) + np.cross(v, normal) * (u @ u)) / (2 * square)
        height = contact**2 - float(middle @ middle)
        if height > 0:
            up = normal * np.sqrt(height / square)
            found.append(a + middle + np.array([up, -up]))
    places: list[Floats] = []
    for place in np.concatenate(found):
        others = np.concatenate([template, *(p[None] for p in places)])
        if np.linalg.norm(others - place, axis=1).min() > _APART * contact:
            places.append(place)
    return np.array(places).reshape(-1, 3)


def missing_places(template: Floats, whole: Floats) -> list[Floats]:
    """Return where the other spheres of a known shape can be, of which a body is a part.

    Parameters
    ----------
    template : ndarray, shape (m, 3)
        Positions of the spheres that are seen, um.
    whole : ndarray, shape (n, 3)
        Positions of all spheres of the known shape, um.

    Returns
    -------
    list of ndarray, shape (n - m, 3)
        One array for each way in which the body may be a part of the shape, each once.

    Examples
    --------
    >>> from perrin import Cluster
    >>> trimer, tetrahedron = (Cluster.touching(n, 2.0).positions for n in (3, 4))
    >>> [p.shape for p in missing_places(trimer, tetrahedron)]
    [(1, 3), (1, 3)]
    """
    contact = float(pair_distances(template).min())
    found: list[Floats] = []
    for chosen in matched_particles(template, whole):
        rest = np.setdiff1d(np.arange(len(whole)), chosen)
        part = whole[list(chosen)]
        turn = kabsch(template, part)
        off = template - template.mean(axis=0) - (part - part.mean(axis=0)) @ turn.T
        if np.sqrt(np.mean(np.sum(off**2, axis=1))) > _SAME_PLACES * contact:
            continue
        places = (whole[rest] - part.mean(axis=0)) @ turn.T + template.mean(axis=0)
        # Equal sets in another order are one way.
        new = all(
            np.linalg.norm(places[:, None] - other, axis=2).min(axis=1).max() > 0.3 * contact
            for other in found
        )
        if new:
            found.append(places)
    return found


def complete_bodies(
    stack: Stack,
    motions: Mapping[int, tuple[RigidMotion, Ints]],
    *,
    optics: Optics,
    features: pd.DataFrame,
    contact: float,
) -> tuple[dict[int, RigidMotion], Findings]:
    """Add the spheres that were not found to the shapes of the bodies whose images show them.

    Parameters
    ----------
    stack : Stack
    motions : mapping
        Motion of each cluster, and the stack's frame of each of its rows.
    optics : Optics
    features : pandas.DataFrame
        All spheres, with ``cluster``.
    contact : float
        Centre distance of touching spheres, um.

    Returns
    -------
    motions : dict of RigidMotion
        Of the bodies with such spheres: shape and centre are those of the whole body.
    findings : Findings
        Which bodies have them.

    Notes
    -----
    Candidates are the places of the other spheres of larger bodies in the same movie, of which a
    body has the shape of a part, and places beyond the border at which a sphere would touch three
    of the body. In some frames the pose is fitted with and without them to the same voxels; the
    candidate that is chosen lowers chi-squared most, by over 50 a sphere, and has the same
    brightness as the others (or, of a known shape, at least 8 % of it).

    Examples
    --------
    >>> import pandas as pd
    >>> from perrin import Cluster, Optics, render_stack, simulate_motion
    >>> from perrin.images import CameraNoise
    >>> body, optics = Cluster.touching(4, 2.0), Optics(2.0, (0.4, 0.15), CameraNoise(1.0, 0.0))
    >>> truth = simulate_motion(body, D_R=0.01, D_T=0.01, dt=1.0, n_frames=3, rng=1)
    >>> movie = render_stack(
    ...     truth, centers=[[3.0, 3.0, 3.0]], voxel=(0.25, 0.2, 0.2), shape=(25, 30, 30),
    ...     diameter=2.0, psf=(0.4, 0.15, 0.15), rng=1,
    ... )
    >>> none = pd.DataFrame({"frame": [], "cluster": [], "x": [], "y": [], "z": []})
    >>> whole = {0: (truth, np.arange(3))}
    >>> complete_bodies(movie, whole, optics=optics, features=none, contact=2.0)[0]
    {}
    """
    templates = [motion.template for motion, _ in motions.values()]
    _, first = np.unique(shape_numbers(templates), return_index=True)
    shapes = [templates[k] for k in first.tolist()]
    trial = _Trial(stack, optics, features)
    found: dict[int, RigidMotion] = {}
    texts = []
    for cluster, (motion, frames) in motions.items():
        hidden = Hidden(np.empty((0, 3)), np.empty(0), np.empty(0, dtype=np.bool_))
        while len(hidden.places) < _MOST_HIDDEN:
            start = np.concatenate([motion.template, hidden.places])
            more = trial.best_of(cluster, motion, frames, start, shapes, contact=contact)
            if more is None:
                break
            hidden = hidden.joined(more)
        if len(hidden.places):
            found[cluster] = with_spheres(motion, hidden.places)
            texts.append(
                f"cluster {cluster}: {len(hidden.places)} beside {len(motion.template)} that are "
                f"found ({hidden})"
            )
    if not texts:
        return found, Findings()
    text = (
        "spheres that were not found belong to clusters, as their images show: "
        f"{listed(texts, most=_MOST_LISTED)}; shape, centre and pose are those of the whole cluster"
    )
    return found, Findings(notes=(text,))


def with_spheres(motion: RigidMotion, places: Floats) -> RigidMotion:
    """Return a motion whose body has more spheres; its centre is that of all of them.

    Parameters
    ----------
    motion : RigidMotion
    places : ndarray, shape (m, 3)
        Positions of the other spheres in the axes of the template, um.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> four = Cluster.touching(4, 2.0).positions
    >>> part = Cluster.from_positions(four[:3])
    >>> truth = simulate_motion(part, D_R=0.01, dt=1.0, n_frames=3, rng=1)
    >>> place = four[3:] - four[:3].mean(axis=0)
    >>> whole = with_spheres(truth, place)
    >>> bool(np.allclose(whole.positions()[:, :3], truth.positions()))
    True
    """
    template = np.concatenate([motion.template, places])
    middle = template.mean(axis=0)
    # A turn moves the new centre by its cross product with the arm from the old one.
    cross = middle @ middle * np.eye(3) - np.outer(middle, middle)
    variance = motion.center_variance + np.einsum("tij,ij->t", motion.covariance, cross) / 3
    return replace(
        motion,
        template=template - middle,
        center=motion.center + motion.rotation @ middle,
        center_variance=variance,
    )


class _Trial:
    """Fits of poses with and without further spheres, in some frames."""

    def __init__(self, stack: Stack, optics: Optics, features: pd.DataFrame) -> None:
        z, y, x = (float(h) for h in stack.voxel)
        self.stack, self.noise, self.image = stack, optics.noise, optics.image((z, y, x))
        self.diameter = optics.diameter
        size = np.array(stack.shape[:0:-1]) * np.array([x, y, z])
        self.low, self.high = -np.array([x, y, z]) / 2, size - np.array([x, y, z]) / 2
        self.features = features

    def depth(self, x: Floats) -> Floats:
        """Return how far places (..., 3) are beyond the border, um; negative inside."""
        return np.asarray(np.maximum(self.low - x, x - self.high).max(axis=-1))

    def best_of(
        self,
        cluster: int,
        motion: RigidMotion,
        frames: Ints,
        start: Floats,
        shapes: Sequence[Floats],
        *,
        contact: float,
    ) -> Hidden | None:
        """Return the spheres that improve the fit most, beside those of `start`; None for none."""
        rows = motion.fitted
        rows = rows[np.unique(np.linspace(0, len(rows) - 1, _FRAMES_TRIED).round().astype(int))]
        sets = []
        if len(start) == len(motion.template):
            for whole in (s for s in shapes if len(s) - len(start) <= _MOST_HIDDEN):
                sets += [(places, _BRIGHT_KNOWN) for places in missing_places(start, whole)]
        size = float(pair_distances(start).min())
        size = contact if size > _TOUCHING * contact else size
        small = len(start) <= _LARGEST_BODY
        for place in touching_places(start, contact=size) if small else np.empty((0, 3)):
            away = self.depth(motion.center[rows] + motion.rotation[rows] @ place)
            if np.mean(away > -_INSIDE * self.diameter) > 0.5:
                sets.append((place[None], _BRIGHT_TOUCHING))
        best: tuple[float, Hidden | None] = (0.0, None)
        for places, bright in sets:
            gain, hidden = self.tried(cluster, motion, frames, rows, start, places)
            low, high = bright
            usual = (hidden.brightness > low) & (hidden.brightness < high)
            if (
                gain > max(best[0], _LEAST_GAIN * len(places))
                and np.all(usual | np.isnan(hidden.brightness))
                and usual.any()
            ):
                best = gain, hidden
        return best[1]

    def tried(
        self,
        cluster: int,
        motion: RigidMotion,
        frames: Ints,
        rows: Ints,
        start: Floats,
        places: Floats,
    ) -> tuple[float, Hidden]:
        """Return by how much places lower chi-squared in some rows, and the spheres there."""
        whole, gain, bright = np.concatenate([start, places]), 0.0, []
        beyond = []
        for row in rows.tolist():
            centers = motion.center[row] + whole @ motion.rotation[row].T
            away = self.depth(centers)
            shown = away < _SHARE_IN_VIEW * self.diameter
            beyond.append(away[len(start) :] > -_INSIDE * self.diameter)
            ratio = np.full(len(places), np.nan)
            if shown[len(start) :].any():
                frame = without_clipped(np.asarray(self.stack.frame(int(frames[row]))))
                there = self.features[self.features["frame"] == frames[row]]
                others = there.loc[there["cluster"] != cluster, ["x", "y", "z"]].to_numpy(float)
                # What was taken for another sphere at one of the places is this one.
                new = centers[len(start) :]
                near = np.linalg.norm(others[:, None] - new, axis=2).min(axis=1, initial=np.inf)
                others = others[near > self.diameter / 2]
                window = cut_window(frame, self.image, centers[:, ::-1], others=others[:, ::-1])
                fits = []
                for used in (shown & (np.arange(len(whole)) < len(start)), shown):
                    pose = RigidCenters(motion.center[row], motion.rotation[row], whole[used])
                    fits.append(fit_window(window, self.image, self.noise, pose))
                if fits[1].converged:
                    voxels = len(window.data)
                    gain += (fits[0].chi2 - fits[1].chi2) * voxels
                    number = int(shown[: len(start)].sum())
                    usual = np.median(fits[1].brightness[:number])
                    ratio[shown[len(start) :]] = fits[1].brightness[number:] / usual
            bright.append(ratio)
        seen = np.isfinite(bright)
        middle = [
            np.median(b[k]) if k.any() else np.nan
            for b, k in zip(np.transpose(bright), seen.T, strict=True)
        ]
        return gain, Hidden(places, np.array(middle), np.mean(beyond, axis=0) > 0.5)
