"""A laboratory whose axes, origin, labels, units, clock and types of numbers can be exchanged.

`cases` draws what is measured and a change of the laboratory; a `Laboratory` gives the positions
and the parameters that are measured in it, and takes vectors back to the laboratory before.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import perrin

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from numpy.typing import NDArray

DT, DIAMETER = 0.7, 2.45
# Positions are whole multiples of this, um, which single precision and whole numbers hold exactly.
GRID = 1 / 1024


@dataclass(frozen=True)
class Data:
    """What is measured: spheres that touch, some of them absent in some frames."""

    seed: int = 1
    n: int = 5
    n_frames: int = 64
    gaps: frozenset[int] = frozenset({20})
    absent: int | None = 40


@dataclass(frozen=True)
class Change:
    """A change of the laboratory. As it stands, nothing is changed."""

    turn: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)
    shift: tuple[float, ...] = (0.0, 0.0, 0.0)
    velocity: tuple[float, ...] = (0.0, 0.0, 0.0)
    order: tuple[int, ...] | None = None
    length: float = 1.0
    time: float = 1.0
    backwards: bool = False
    every: int = 1
    left_out: bool = False
    dtype: str = "float64"


# What is changed: rotation (a quaternion, w first), translation (um), velocity (um per frame), the
# permutation of the particles, the units of length and time, reversal of time, whether the frames
# are every second or third of a faster clock, whether gaps are frames that are left out or frames
# of NaN, and the type of the numbers.
KINDS = tuple(field.name for field in fields(Change))


@functools.lru_cache(maxsize=16)
def places(data: Data) -> NDArray[np.float64]:
    """Return noisy positions (T, n, 3), um, with gaps."""
    body = perrin.Cluster.touching(data.n, DIAMETER)
    motion = perrin.simulate_motion(
        body, D_R=0.02, D_T=0.04, dt=DT, n_frames=data.n_frames, rng=data.seed
    )
    found = perrin.add_noise(motion.positions(), sigma=0.02, rng=data.seed + 1)
    found[sorted(data.gaps)] = np.nan
    if data.absent is not None:
        found[data.absent, 2] = np.nan
    return np.rint(found / GRID) * GRID


def applied(data: Data, change: Change, *, without: Collection[str]) -> tuple[Data, Change]:
    """Take out the kinds of change that do not apply; without gaps every frame is full."""
    if "left_out" in without:
        data = replace(data, gaps=frozenset(), absent=None)
        without = {*without, "every"}
    return data, replace(change, **{kind: getattr(Change(), kind) for kind in without})


class Laboratory:
    """One laboratory; `used` are the kinds of change that numbers went through."""

    def __init__(self, data: Data, change: Change) -> None:
        self.data, self.change = data, change
        self.used: set[str] = set()

    def __getattr__(self, kind: str) -> Any:
        """Return one kind of change."""
        if kind not in KINDS:
            raise AttributeError(kind)
        self.used.add(kind)
        return getattr(self.change, kind)

    @property
    def dt(self) -> float:
        """Time between frames, in the unit of this laboratory."""
        return DT * self.time / self.every

    @property
    def matrix(self) -> NDArray[np.float64]:
        """Rotation from the axes before to these; exact where it exchanges axes."""
        matrix = Rotation.from_quat(self.turn, scalar_first=True).as_matrix()
        whole = np.rint(matrix)
        return whole if np.allclose(matrix, whole, atol=1e-9) else matrix

    @property
    def quarters(self) -> int:
        """Quarter turns about z that are nearest to the rotation, for images."""
        w, _, _, z = self.turn
        return int(np.rint(2 * np.arctan2(z, w) / (np.pi / 2))) % 4

    @property
    def voxels(self) -> NDArray[np.int64]:
        """Shift of an image, whole voxels along z, y and x."""
        return np.rint(self.shift).astype(int) % 2

    def typed(self, values: Any) -> Any:
        """Return numbers in the type of this laboratory, which holds them exactly."""
        given = np.asarray(values, dtype=np.float64)
        known = given.astype(self.dtype)
        np.testing.assert_array_equal(known.astype(np.float64), given)
        return known if known.ndim else known[()]

    def arranged(self, items: Sequence[Any]) -> list[Any]:
        """Return any number of things in the order of this laboratory."""
        place = np.argsort(self.order or range(self.data.n))
        return [items[i] for i in sorted(range(len(items)), key=lambda i: place[i % len(place)])]

    def forwards(self, rows: Any) -> Any:
        """Return rows, one per frame, in the order of time before."""
        return rows[::-1] if self.backwards else rows

    def positions(self) -> tuple[Any, NDArray[np.int64]]:
        """Return positions (T, n, 3) and their frames."""
        x = places(self.data)
        frames = np.arange(len(x))
        x = self.forwards(x + frames[:, None, None] * np.array(self.velocity))
        x = self.seen(x)[:, list(self.order or range(x.shape[1]))]
        if self.left_out:
            frames = np.flatnonzero(np.isfinite(x).any(axis=(1, 2)))
            return self.typed(x[frames]), frames * self.every
        rows = np.full((self.every * (len(x) - 1) + 1, *x.shape[1:]), np.nan)
        rows[:: self.every] = x
        return self.typed(rows), np.arange(len(rows))

    def seen(self, points: Any) -> NDArray[np.float64]:
        """Return points at rest in the axes, origin and unit of this laboratory."""
        return (points @ self.matrix.T + self.shift) * self.length

    def before(self, points: Any, frames: NDArray[np.int64]) -> NDArray[np.float64]:
        """Take points (T, ..., 3) of some frames back to the laboratory before, in its order."""
        back = (np.asarray(points) / self.length - self.shift) @ self.matrix
        time = frames / self.every
        if self.backwards:
            time = self.data.n_frames - 1 - time
        away = time[:, None] * np.array(self.velocity)
        return self.forwards(back - away.reshape(-1, *[1] * (back.ndim - 2), 3))

    def motion(self) -> perrin.RigidMotion:
        """Return the rigid motion of the positions."""
        found, used = tracked(self.data, self.change)
        self.used |= used
        return found

    def body(self) -> Any:
        """Return the centres of touching spheres (n, 3), without noise."""
        body = np.rint(perrin.Cluster.touching(self.data.n, DIAMETER).positions / GRID) * GRID
        return self.typed(self.seen(body)[list(self.order or range(self.data.n))])


@functools.lru_cache(maxsize=16)
def tracked(data: Data, change: Change) -> tuple[perrin.RigidMotion, set[str]]:
    """Return the rigid motion seen in a laboratory, and the kinds of change it went through."""
    here = Laboratory(data, change)
    x, frames = here.positions()
    return perrin.track_rotation(x, dt=here.dt, frames=frames), here.used


# ---- drawing ------------------------------------------------------------------------------------

HALF = 0.5**0.5
# The quarter turns and the third turns that generate the rotations which exchange axes.
EXCHANGES = [
    (HALF, 0.0, 0.0, HALF), (HALF, HALF, 0.0, 0.0), (HALF, 0.0, -HALF, 0.0),
    (0.5, 0.5, 0.5, 0.5), (0.5, -0.5, 0.5, 0.5), (0.0, 0.0, 0.0, 1.0), (0.0, HALF, HALF, 0.0),
]  # fmt: skip


def quaternion(seed: int) -> tuple[float, ...]:
    """Return a quaternion uniform over the rotations."""
    q = np.random.default_rng(seed).normal(size=4)
    return tuple((q / np.linalg.norm(q)).tolist())


def away_from_zero(largest: int, first: int) -> st.SearchStrategy[float]:
    """Return multiples of the grid, um; the simplest is not 0."""
    return st.integers(-largest - first, largest - first).map(lambda k: (k + first) * GRID)


@st.composite
def cases(draw: st.DrawFn, dtype: str | None = None) -> tuple[Data, Change]:
    """Draw what is measured and a change; the simplest one already changes everything."""
    dtype = dtype or draw(st.sampled_from(["float64", "float32", "int64"]))
    n = draw(st.sampled_from([5, 4, 6, 3]))
    n_frames = draw(st.sampled_from([64, 72, 81]))
    gaps = draw(st.sets(st.integers(0, n_frames - 1), max_size=4)) ^ {20}
    absent = draw(st.sampled_from([40, None, 1])) if dtype != "int64" else None
    data = Data(draw(st.integers(1, 2**31)), n, n_frames, frozenset(gaps), absent)
    if dtype == "float64":
        turn = draw(st.one_of(st.integers(1, 2**31).map(quaternion), st.sampled_from(EXCHANGES)))
        length = draw(st.sampled_from([25.4, 1e-3, 1e3, 1.0]))
    else:  # so that a change of float32 and whole numbers is exact
        turn = draw(st.sampled_from(EXCHANGES))
        length = draw(st.sampled_from([1024.0, 4096.0] if dtype == "int64" else [8.0, 1 / 64]))
    return data, Change(
        turn=turn,
        shift=tuple(draw(away_from_zero(99_000, first)) for first in (30_001, -7003, 12_007)),
        velocity=tuple(draw(away_from_zero(900, first)) for first in (307, -501, 211)),
        order=tuple(draw(st.permutations(range(n))))[::-1],
        length=length,
        time=draw(st.sampled_from([60.0, 1e-3, 1.0])),
        backwards=draw(st.sampled_from([True, False])),
        every=draw(st.sampled_from([2, 1, 3])),
        left_out=dtype == "int64" or draw(st.sampled_from([True, False])),
        dtype=dtype,
    )
