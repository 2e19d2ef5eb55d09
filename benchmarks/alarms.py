"""Shares of planted faults that raise their warning, and of clean data that raise any.

Usage: python benchmarks/alarms.py [--repeats 200] [--only NAME] [--jobs 2] [--seed 0] [--quick]
                                   [--images] [--texts]

Every fault and every clean case is simulated with numpy and scipy alone (without
`simulate_motion`), analysed, and its warnings are sorted into KINDS. Printed are, for every fault,
how often it is named, which other warnings its tables have, and, for every clean case, which
warnings appear. Lines that must hold:

* every fault is named in at least 95 % of its tables;
* every kind of warning appears in at most 1 % of the clean tables, all cases taken together;
* at most 3 % of the clean tables have any warning;
* in no single clean case is a kind of warning so frequent that 1 % is excluded (p < 1e-4): one
  bad case among many would not show in the sum.

Notes are not counted. A fault that informs (labels corrected in one frame) must be named in the
notes. A refusal counts as a warning with the text of the error; bodies of other sizes than planted
and warnings of more than 500 characters count as kinds of their own. The exit status is 1 when a
line does not hold. --quick takes 2 tables of every case and calls a line broken where the count
excludes it (p < 0.005).
--only runs the cases whose name contains NAME. --images takes movies instead of tables (5 of each
case unless --repeats is given). --texts prints one text of every kind that should not be
there.
"""

import argparse
import re
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from zlib import crc32

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation
from scipy.stats import binom

import perrin

# What a warning is about, by its words. A text belongs to the first kind that it matches; a fault
# is named when a text matches one of the kinds that it expects, whatever else the text matches.
KINDS = {
    "not diffusion": r"^not diffusion:",
    "common motion": r"^common motion:",
    "velocity": r"mean velocity|\bflow\b|centre moves steadily",
    "spin": r"\bspin|mean turn|turns? steadily|steady (turn|rotation)|rad/s\b",
    "hopping": r"another kind of motion|no Brownian motion|not Brownian",
    "stage": r"^stage jump:",
    "rings": r"^(ring images|contrast|overlap):",
    "no sphere": r"not the image of a sphere",
    "jump": r"\bjumps?\b(?! (of|by) the )|Brownian motion cannot",
    "time": r"column '?time|time column|\btimes?\b.*contradict",
    "stride": r"multiples? of \d|every \d+(th|rd|nd)",
    "repeat": r"particle's previous row",
    "zeros": r"\(0(\.0)?, 0(\.0)?(, 0(\.0)?)?\)|exactly (0|zero|\()",
    "constant": r"(same|one|constant) (point|place|position)|exactly \(|constant point",
    "centred": r"centre (does|of .* does) not move|\bcentred\b|centre .*(removed|subtracted)",
    "far": r"\bfarther\b|\bfar (away|from|off)\b|times (its|the) (own )?(size|radius)",
    "none rigid": r"no (cluster|body) .*rigid|none of the .*rigid|nothing is pooled",
    "bond": r"bond breaks|broken bond",
    "two bodies": r"(two|several|more than one) (rigid )?bod(y|ies)|bodies (under|share|in) one",
    "soft": r"not rigid|\bsoft\b",
    "z scale": r"\bz scale|\bz (is|were) .*(long|stretch)|stretched",
    "floor": r"noise floor",
    "scan": r"\bscan\b|sequential",
    "labels": r"labels? (swap|exchang|correct|are|were)|labels .*(exchanged|corrected)|exchange of",
    "cut": r"in doubt|track is cut",
    "extra": r"no particle of the body|left out at",
    "unsettled": r"no assignment",
    "symmetry": r"too far between frames|sample faster",
    "units": r"\bunits?\b|trackpy|outside [\d.]+ (to|-)|per (pixel|unit)|in nm\b|lengths in um",
    "viscosity": r"viscosity.*(water|Pa s)|viscosity .* (is|over|above)",
    "no cluster": r"^no clusters:|free spheres",
    "aggregate": r"are no cluster: bodies of over",
    "disagreement": r"do not agree|not agree on one",
    "coarse": r"4 D_R dt",
    "noisy": r"signal-to-noise",
    "unresolved": r"not resolved|upper limit",
    "few": r"fewer than \d|too few",
    "pool": r"leave out what is not rigid",
    "left out": r"was left out|belong to no cluster",
    "grouping": r"no cluster column|by the distances that|no two particles keep",
    "rod": r"no D_R: .* one line|on one line",
    "tensor": r"no diffusion tensor",
    "missing": r"\bmissing\b|\bNaN\b|without coordinates|no pose|without a pose",
    "misfit": r"common shape badly",
    "anisotropic": r"anisotrop|unequally|isotropic body",
    "planar": r"z never changes",
    "saturation": r"saturat",
    "fading": r"brightness fell|bleach",
    "frozen": r"identical|same (image|frame)|repeats? an earlier frame",
    "too large": r"(larger|greater|wider|longer|exceeds) .*(stack|frame|image)|does not fit",
}
NAMED, ONE_KIND, ANY_KIND = 0.95, 0.01, 0.03
LONGEST = 500  # characters of a warning that can be read in a terminal
EXCLUDED, QUICKLY_EXCLUDED = 1e-4, 0.005

DT, EDGE, SIGMA = 0.73, 2.45, 0.02
# Rotational and translational D: 4 D_R dt is 0.003, 0.015 and 0.1.
SPEEDS = {"slow": (1e-3, 8e-3), "usual": (5e-3, 0.04), "fast": (0.034, 0.25)}


def centred(points):
    points = np.asarray(points, dtype=np.float64)
    return points - points.mean(axis=0)


def triangle(a, b, c):
    """Return a triangle with sides a, b, c in the plane z = 0."""
    x = (a * a + b * b - c * c) / (2 * a)
    return centred([[0, 0, 0], [a, 0, 0], [x, np.sqrt(b * b - x * x), 0]])


TETRAHEDRON = EDGE / np.sqrt(8) * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
TRIMER = triangle(EDGE, EDGE, EDGE)
SQUARE = EDGE / 2 * np.array([[1, 1, 0], [1, -1, 0], [-1, -1, 0], [-1, 1, 0]])
BIPYRAMID = np.vstack([TRIMER, np.sqrt(2 / 3) * EDGE * np.array([[0, 0, 1], [0, 0, -1]])])
OCTAHEDRON = EDGE / np.sqrt(2) * np.vstack([np.eye(3), -np.eye(3)])
SCALENE = triangle(2.4, 3.4, 2.9)
BODIES = {
    "trimer": TRIMER,
    "tetrahedron": TETRAHEDRON,
    "bipyramid": BIPYRAMID,
    "octahedron": OCTAHEDRON,
    "square": SQUARE,
    "plane": SCALENE[:, :2],
}


def products(turns):
    """Return the running products turns[0] @ ... @ turns[k] in log2(len(turns)) rounds."""
    out, reach = turns.copy(), 1
    while reach < len(out):
        out[reach:] = out[:-reach] @ out[reach:]
        reach *= 2
    return out


def orientations(times, D_R, rng):
    """Return Brownian rotation matrices (T, 3, 3); D_R is one number or one per body axis."""
    step = np.diff(times)
    parts = max(1, int(np.ceil(4 * np.max(D_R) * step.max() / 0.02)))
    h = np.repeat(step / parts, parts)
    small = rng.normal(size=(h.size, 3)) * np.sqrt(2 * h[:, None] * np.asarray(D_R))
    first = Rotation.random(random_state=rng).as_matrix()
    turns = np.concatenate([first[None], Rotation.from_rotvec(small).as_matrix()])
    return products(turns)[::parts]


def orientations_in_plane(times, D_R, rng):
    """Return Brownian rotation matrices (T, 2, 2)."""
    steps = rng.normal(size=len(times) - 1) * np.sqrt(2 * D_R * np.diff(times))
    angle = np.append(0, steps.cumsum()) + rng.uniform(0, 2 * np.pi)
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)


def brownian(body, times, *, D_R, D_T, rng):
    """Return positions (T, n, d) of a diffusing body: fixed (n, d), or of a changing (T, n, d)."""
    d = body.shape[-1]
    turn = (orientations if d == 3 else orientations_in_plane)(times, D_R, rng)
    steps = rng.normal(size=(len(times) - 1, d)) * np.sqrt(2 * D_T * np.diff(times))[:, None]
    centre = np.vstack([np.zeros(d), steps.cumsum(axis=0)])
    return (
        np.broadcast_to(body, (len(times), *body.shape[-2:])) @ np.swapaxes(turn, -1, -2)
        + centre[:, None]
    )


def smooth(shape, *, size, memory, rng):
    """Return stationary noise (T, ...) of standard deviation `size`, correlated over frames."""
    from scipy.signal import lfilter

    a = np.exp(-1 / memory)
    warm = int(8 * memory)
    white = rng.normal(size=(shape[0] + warm, *shape[1:])) * size * np.sqrt(1 - a * a)
    return lfilter([1.0], [1.0, -a], white, axis=0)[warm:]


def clock(frames, pauses=0.0):
    """Return times of frames, s; every 30th interval is a pause where one is given."""
    step = np.full(frames - 1, DT)
    step[29::30] += pauses
    return np.append(0, step.cumsum())


def recorded(
    rng, *, body=TETRAHEDRON, count=1, frames=300, speed="usual", D_R=None, D_T=None,
    sigma=(SIGMA, SIGMA, 1.5 * SIGMA), pauses=0.0, apart=15.0,
):  # fmt: skip
    """Return the measured positions (T, n, d) of every one of `count` bodies."""
    times, d = clock(frames, pauses), body.shape[-1]
    usual_R, usual_T = SPEEDS[speed]
    one = usual_R if D_R is None else D_R
    speeds = [one] * count if np.ndim(one) == 0 else one
    tracks = []
    for k in range(count):
        x = brownian(body, times, D_R=speeds[k], D_T=usual_T if D_T is None else D_T, rng=rng)
        noise = rng.normal(size=x.shape) * np.broadcast_to(sigma, (3,))[:d]
        tracks.append(x + noise + 20 + apart * k * np.eye(d)[0])
    return tracks


def table_of(tracks):
    """Return a track table with the columns frame, particle, x, y[, z] and cluster."""
    parts, first = [], 0
    for cluster, x in enumerate(tracks):
        frame, particle = np.indices(x.shape[:2])
        columns = {"frame": frame.ravel(), "particle": particle.ravel() + first}
        columns |= dict(zip("xyz", x.reshape(-1, x.shape[2]).T.round(5), strict=False))
        parts.append(pd.DataFrame(columns | {"cluster": cluster}))
        first += x.shape[1]
    return pd.concat(parts, ignore_index=True)


def table(rng, *, tracks=recorded, changes=(), edits=(), **recipe):
    """Return the table of a recipe: simulated tracks, their changes, and edits of the table."""
    found = tracks(rng, **recipe)
    for change in changes:
        found = change(found, rng)
    measured = table_of(found)
    for edit in edits:
        measured = edit(measured, rng)
    return measured


# Simulated tracks that `recorded` cannot make.


def soft_bodies(rng, *, count=1, flex=0.15, rigid=0, **recipe):
    """Return bodies whose spheres fluctuate by `flex` um within 5 s, and `rigid` rigid ones."""
    bodies = [
        TETRAHEDRON + smooth((300, 4, 3), size=flex, memory=5 / DT, rng=rng) for _ in range(count)
    ]
    bodies += [TETRAHEDRON] * rigid
    tracks = [recorded(rng, body=body, **recipe)[0] for body in bodies]
    return [x + np.array([15.0 * k, 0, 0]) for k, x in enumerate(tracks)]


def soft_arm(rng, *, swing):
    """Return a tetrahedron with a fifth sphere that swings about the first by `swing` rad."""
    out = TETRAHEDRON[0] / np.linalg.norm(TETRAHEDRON[0])
    angles = smooth((300, 3), size=swing, memory=5 / DT, rng=rng)
    arm = TETRAHEDRON[0] + EDGE * Rotation.from_rotvec(angles).apply(out)
    body = np.concatenate([np.broadcast_to(TETRAHEDRON, (300, 4, 3)), arm[:, None]], axis=1)
    return recorded(rng, body=body)


def broken(rng, *, by=1.2):
    """Return a tetrahedron of which one sphere is `by` um farther out in the second half."""
    body = np.repeat(TETRAHEDRON[None], 300, axis=0)
    body[150:, 3] *= 1 + by / np.linalg.norm(TETRAHEDRON[3])
    return recorded(rng, body=body)


def scanned(rng, *, speed=10.0, parts=20):
    """Return a tetrahedron whose spheres are recorded as a plane passes them at `speed` um/s."""
    times = np.arange(300 * parts) * DT / parts
    x = brownian(TETRAHEDRON, times, D_R=SPEEDS["usual"][0], D_T=SPEEDS["usual"][1], rng=rng)
    start = np.arange(300) * parts
    height = x[start, :, 2] - x[start, :, 2].mean(axis=1, keepdims=True) + 2.0
    later = np.clip(np.rint(height / speed / DT * parts), 0, parts - 1).astype(int)
    seen = x[start[:, None] + later, np.arange(4)]
    return [seen + 20 + rng.normal(size=seen.shape) * SIGMA]


def at_rest(rng, *, count=1, body=TRIMER, size=0.002, memory=50):
    """Return bodies at rest with errors that are smooth in time."""
    return [
        body + smooth((250, *body.shape), size=size, memory=memory, rng=rng) + [20.0 + 9 * k, 0, 0]
        for k in range(count)
    ]


def caged(rng, *, memory=3, angle=0.1, radius=0.3):
    """Return a tetrahedron that relaxes about one place and one orientation within `memory`."""
    turn = smooth((300, 3), size=angle, memory=memory, rng=rng)
    centre = smooth((300, 3), size=radius, memory=memory, rng=rng)
    x = TETRAHEDRON @ np.swapaxes(Rotation.from_rotvec(turn).as_matrix(), -1, -2)
    return [x + centre[:, None] + 20 + rng.normal(size=x.shape) * SIGMA]


def switching(rng, *, ratio=10.0, dwell=30):
    """Return a tetrahedron whose D is `ratio` times larger in every second block of frames."""
    fast = np.arange(299) // dwell % 2 == 1
    times = np.append(0, np.where(fast, DT, DT / ratio).cumsum())
    x = brownian(TETRAHEDRON, times, D_R=SPEEDS["usual"][0], D_T=SPEEDS["usual"][1], rng=rng)
    return [x + 20 + rng.normal(size=x.shape) * SIGMA]


def sliced(rng, *, count=2):
    """Return x and y alone of tetrahedra that tumble in three dimensions."""
    return [x[..., :2] for x in recorded(rng, count=count)]


# Changes of tracks.


def flowing(tracks, rng, *, velocity):
    """Add a velocity, um/s, in a random direction."""
    way = rng.normal(size=tracks[0].shape[2])
    move = velocity * way / np.linalg.norm(way)
    return [x + clock(len(x))[:, None, None] * move for x in tracks]


def turning(tracks, rng, *, rate):
    """Add a steady turn about a random axis of the lab; isotropic bodies stay Brownian on top."""
    axis = rng.normal(size=3)
    turn = Rotation.from_rotvec(np.outer(rate * clock(len(tracks[0])), axis / np.linalg.norm(axis)))
    return [turned(x, turn.as_matrix()) for x in tracks]


def turned(x, turn):
    """Turn every frame of a track about its centre."""
    centre = x.mean(axis=1, keepdims=True)
    return (x - centre) @ np.swapaxes(turn, -1, -2) + centre


def stage_jump(tracks, rng, *, size):
    """Move everything by `size` um from one frame on."""
    d, start = tracks[0].shape[2], middle(tracks, rng)
    way = rng.normal(size=d)
    later = (np.arange(len(tracks[0])) >= start)[:, None, None]
    return [x + later * size * way / np.linalg.norm(way) for x in tracks]


def middle(tracks, rng):
    """Draw a frame of the middle half."""
    return int(rng.integers(len(tracks[0]) // 4, 3 * len(tracks[0]) // 4))


def one_turn(tracks, rng, *, angle):
    """Turn every body by `angle` rad about a random axis, from one frame on."""
    start, axis = middle(tracks, rng), rng.normal(size=3)
    whole = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix()
    turns = np.where((np.arange(len(tracks[0])) >= start)[:, None, None], whole, np.eye(3))
    return [turned(x, turns) for x in tracks]


def exchanged_bodies(tracks, rng):
    """Exchange the numbers of two bodies from one frame on."""
    start = middle(tracks, rng)
    a, b = tracks
    return [np.concatenate([a[:start], b[start:]]), np.concatenate([b[:start], a[start:]])]


def hopping(tracks, rng, *, share, size):
    """Add displacements of `size` um to a share of the steps."""
    out = []
    for x in tracks:
        way = rng.normal(size=(len(x), x.shape[2]))
        way *= size * (rng.random((len(x), 1)) < share) / np.linalg.norm(way, axis=1, keepdims=True)
        out.append(x + way.cumsum(axis=0)[:, None])
    return out


def wrapped(tracks, rng, *, box, whole):
    """Wrap bodies as a whole, or every sphere, into a periodic box; bodies start at its side."""
    out = []
    for x in tracks:
        near = x - x[0].mean(axis=0) + rng.uniform(0, box, x.shape[2])
        near[..., 0] -= near[0, :, 0].mean()
        place = near.mean(axis=1, keepdims=True) if whole else near
        out.append(near - np.floor(place / box) * box)
    return out


def stretched(tracks, _, *, by):
    """Multiply z, errors included."""
    return [x * [1.0, 1.0, by] for x in tracks]


def relabelled(tracks, rng, *, events):
    """Exchange two labels for good, at `events` random frames."""
    out = []
    for given in tracks:
        x = given.copy()
        for start in rng.choice(np.arange(20, len(x) - 20), size=events, replace=False):
            pair = rng.permutation(x.shape[1])[:2]
            x[start:, pair] = x[start:, pair[::-1]]
        out.append(x)
    return out


def noisy_frames(tracks, rng, *, share, factor):
    """Add noise to a share of the frames so that theirs is `factor` times the usual one."""
    more = SIGMA * np.sqrt(factor**2 - 1)
    return [
        x + more * rng.normal(size=x.shape) * (rng.random(len(x)) < share)[:, None, None]
        for x in tracks
    ]


def together(tracks, _):
    """Put all bodies under one cluster number."""
    return [np.concatenate(tracks, axis=1)]


def without_centre(tracks, _):
    """Take the centre of every frame off."""
    return [x - x.mean(axis=1, keepdims=True) for x in tracks]


def last_places(tracks, rng, *, share):
    """Repeat a particle's last place to the last digit, in a share of the rows."""
    out = []
    for x in tracks:
        lost = rng.random(x.shape[:2]) < share
        lost[0] = False
        row = np.maximum.accumulate(np.where(lost, 0, np.arange(len(x))[:, None]), axis=0)
        out.append(x.round(5)[row, np.arange(x.shape[1])])
    return out


def at_point(tracks, rng, *, share, point):
    """Write a share of the rows as one and the same point."""
    return [np.where((rng.random(x.shape[:2]) < share)[..., None], point, x) for x in tracks]


def blank_blocks(tracks, rng, *, length):
    """Make one block of frames of every particle NaN."""
    out = []
    for given in tracks:
        x = given.copy()
        for particle in range(x.shape[1]):
            start = int(rng.integers(1, len(x) - length - 1))
            x[start : start + length, particle] = np.nan
        out.append(x)
    return out


def far_coordinates(tracks, rng, *, count):
    """Put `count` coordinates 100 to 1000 um off."""
    x = tracks[0].copy()
    flat = x.reshape(-1)
    flat[rng.choice(flat.size, size=count, replace=False)] += rng.uniform(100, 1000, count)
    return [x, *tracks[1:]]


# Edits of tables.


def unnamed(measured, _):
    """Leave out which particle belongs to which body."""
    return measured.drop(columns="cluster")


def without_frames(measured, rng, *, share):
    """Leave out a share of the frames."""
    frames = np.unique(measured["frame"])
    lost = frames[1:-1][rng.random(len(frames) - 2) < share]
    return measured[~measured["frame"].isin(lost)].reset_index(drop=True)


def without_rows(measured, rng, *, share):
    """Leave out a share of the particles' places."""
    return measured[rng.random(len(measured)) >= share].reset_index(drop=True)


def in_unit(measured, _, *, factor, axes="xyz"):
    """Multiply coordinates, as another unit does."""
    axes = [a for a in axes if a in measured]
    return measured.assign(**{a: measured[a] * factor for a in axes})


def as_trackpy(measured, rng):
    """Give the table the columns of trackpy in pixels of 0.1 um."""
    mass = rng.uniform(800, 1200, len(measured))
    more = {"mass": mass, "size": 3.0, "ecc": 0.1, "signal": 90.0, "raw_mass": 2 * mass, "ep": 0.05}
    return in_unit(measured, rng, factor=10.0).assign(**more)


def every_fifth(measured, _):
    """Give the frames the numbers 0, 5, 10 and so on."""
    return measured.assign(frame=5 * measured["frame"])


def with_times(measured, _, *, step=DT, pauses=0.0):
    """Add the column time."""
    times = clock(int(measured["frame"].max()) + 1, pauses) * step / DT
    return measured.assign(time=times[measured["frame"]].round(5))


# Measurements, which return the texts of the report.


@dataclass(frozen=True)
class Texts:
    """Warnings, notes and the numbers of spheres of the bodies in a report."""

    warnings: tuple[str, ...]
    notes: tuple[str, ...] = ()
    sizes: tuple[int, ...] | None = None


def report_texts(report):
    """Collect the texts of a report and its clusters."""
    results = report.results
    notes = (getattr(r, "notes", ()) for r in (report, *results))
    rods = (len(r.motion.places) for r in report.rods)
    sizes = sorted([*(len(c.motion.template) for c in report.clusters), *rods])
    texts = (r.warnings for r in (report, *results))
    return Texts(tuple(sum(texts, ())), tuple(sum(notes, ())), tuple(sizes))


def analyzed(data, **arguments):
    return report_texts(perrin.analyze(data, **{"dt": DT} | arguments))


def planned(data, **_):
    """Return the sentences that the command line prints for a plan."""
    from typer.testing import CliRunner

    from perrin.cli.app import app

    printed = " ".join(CliRunner().invoke(app, ["plan", *data]).output.split())
    return Texts(tuple(printed.split(". ")))


def fitted_line(data, **_):
    """Return what a straight line through the MSAD warns of."""
    curve = perrin.msad(perrin.track_rotation(data, dt=DT))
    return Texts(perrin.fit_line(curve).warnings)


def filmed(data, **arguments):
    return report_texts(perrin.analyze_stack(data, **arguments))


@dataclass(frozen=True)
class Case:
    """One planted fault or one clean case.

    Attributes
    ----------
    name : str
    make : callable
        Returns the data, from a random generator.
    expected : tuple of str
        Kinds of which one must appear; none for a clean case.
    arguments : dict
        Arguments of the measurement.
    where : {"warnings", "notes"}
        Where the fault has to be named.
    allowed : tuple of str
        Further kinds that are right here.
    sizes : tuple of int, optional
        Spheres of the bodies that must be found, in ascending order.
    measure : callable
        Returns the `Texts` of the data.
    """

    name: str
    make: Callable
    expected: tuple[str, ...] = ()
    arguments: dict = field(default_factory=dict)
    where: str = "warnings"
    allowed: tuple[str, ...] = ()
    sizes: tuple[int, ...] | None = None
    measure: Callable = analyzed


def fault(name, expected, *, arguments=None, **how):
    """Return the case of a fault; `how` holds fields of Case and the recipe of the table."""
    names = ("where", "allowed", "sizes", "measure", "make")
    fields = {k: how.pop(k) for k in names if k in how}
    fields.setdefault("make", partial(table, **how))
    kinds = (expected,) if isinstance(expected, str) else expected
    return Case(name=name, expected=kinds, arguments=arguments or {}, **fields)


def clean(name, *, arguments=None, **how):
    return fault(f"clean: {name}", (), arguments=arguments, **how)


LOSSES = {
    "all seen": (),
    "frames lost": (partial(without_frames, share=0.1),),
    "particles lost": (partial(without_rows, share=0.05),),
}


def clean_design():
    """Cross bodies, speeds and lengths; error ratios and losses vary so that all pairs occur."""
    cases = []
    for i, (name, body) in enumerate(BODIES.items()):
        for j, (speed, frames) in enumerate(
            [("slow", 60), ("slow", 300), ("fast", 60), ("fast", 300)]
        ):
            ratio = 1 + (i + j) % 3
            loss = list(LOSSES)[(i + 2 * j + i // 3) % 3]
            error = "" if name == "plane" else f", sigma_z {ratio}"
            cases.append(
                clean(
                    f"{name}, {speed}, {frames} frames{error}, {loss}",
                    body=body,
                    speed=speed,
                    frames=frames,
                    sigma=(SIGMA, SIGMA, ratio * SIGMA),
                    edits=LOSSES[loss],
                    sizes=(len(body),),
                )
            )
    return cases


REST = ("noisy", "unresolved")
CLEAN = [
    *clean_design(),
    clean("two clusters", count=2, sizes=(4, 4)),
    clean("unnamed, one body", edits=(unnamed,), sizes=(4,)),
    clean("unnamed, one body, contact", edits=(unnamed,), arguments={"contact": EDGE}, sizes=(4,)),
    clean("unnamed, two bodies", count=2, edits=(unnamed,), sizes=(4, 4)),
    clean(
        "unnamed, two bodies, contact", count=2, edits=(unnamed, *LOSSES["particles lost"]),
        arguments={"contact": EDGE}, sizes=(4, 4),
    ),
    clean("unnamed, plane", body=SCALENE[:, :2], edits=(unnamed,), sizes=(3,)),
    clean("unnamed, at rest, smooth error", tracks=at_rest, edits=(unnamed,), sizes=(3,),
          allowed=REST),
    clean("unnamed, slow, sigma_z 4", body=TRIMER, D_R=1e-5, D_T=1e-4, edits=(unnamed,),
          sigma=(SIGMA, SIGMA, 4 * SIGMA), frames=250, sizes=(3,), allowed=REST),
    clean("stuck, sigma_z 3", D_R=0.0, D_T=0.0, sigma=(SIGMA, SIGMA, 3 * SIGMA), allowed=REST,
          sizes=(4,)),
    clean("trimer, noisy frames", body=triangle(2.40, 2.50, 2.45), frames=600, sizes=(3,),
          sigma=SIGMA, changes=(partial(noisy_frames, share=0.03, factor=4),)),
    clean("tetrahedron, noisy frames", sizes=(4,), sigma=SIGMA,
          changes=(partial(noisy_frames, share=0.03, factor=6),)),
    clean("axes 1:1:4", D_R=[[2.5e-3, 2.5e-3, 1e-2]], body=SQUARE, sizes=(4,)),
    clean("time column", edits=(with_times,), sizes=(4,)),
    clean("time column with pauses", pauses=20.0, edits=(partial(with_times, pauses=20.0),),
          sizes=(4,)),
    clean("flow, drift=True", changes=(partial(flowing, velocity=1.0),),
          arguments={"drift": True}, sizes=(4,)),
    clean("flow, drift=True, 30 % of the frames lost", changes=(partial(flowing, velocity=1.0),),
          edits=(partial(without_frames, share=0.3),), arguments={"drift": True}, sizes=(4,)),
    clean("steady turn, drift=True", changes=(partial(turning, rate=0.2),),
          arguments={"drift": True}, sizes=(4,)),
    clean("line through an MSAD", make=lambda rng: recorded(rng)[0], measure=fitted_line),
    clean("no flow, drift=True", arguments={"drift": True}, sizes=(4,)),
    clean("sizes and predictions", sizes=(4,),
          arguments={"viscosity": 2.18e-3, "temperature": 295.0, "diameter": EDGE}),
]  # fmt: skip

PLAN = ("tetrahedron", "--d-r", "0.005", "--diameter", "2.45", "--sigma", "30")
IDENTITY = ("labels", "cut", "unsettled", "symmetry")
NOT_RIGID = ("soft", "bond", "two bodies")
TRACES = ("floor", "coarse")  # of a motion that is not the assumed one
FAULTS = [
    fault("flow 1 um/s", "velocity", changes=(partial(flowing, velocity=1.0),), allowed=TRACES),
    fault("flow 0.15 um/s", "velocity", changes=(partial(flowing, velocity=0.15),), allowed=TRACES),
    fault("flow 1 um/s, plane", "velocity", body=SCALENE[:, :2], allowed=TRACES,
          changes=(partial(flowing, velocity=1.0),)),
    fault("steady turn 0.2 rad/s", "spin", changes=(partial(turning, rate=0.2),), allowed=TRACES),
    fault("stage jump 3 um", "jump", changes=(partial(stage_jump, size=3.0),)),
    fault("stage jump 50 um", "jump", changes=(partial(stage_jump, size=50.0),)),
    fault("stage jump 3 um, plane", "jump", body=SCALENE[:, :2],
          changes=(partial(stage_jump, size=3.0),)),
    fault("turn by 57 degrees", "jump", changes=(partial(one_turn, angle=1.0),), body=SCALENE),
    fault("two bodies exchanged", "jump", count=2, changes=(exchanged_bodies,),
          allowed=IDENTITY),
    fault("wrapped into a box, bodies", ("jump", "hopping"), allowed=TRACES,
          changes=(partial(wrapped, box=10.0, whole=True),)),
    fault("wrapped into a box, spheres", ("jump", "hopping", *NOT_RIGID, "unsettled"),
          allowed=(*TRACES, *IDENTITY, "extra", "far", "missing"),
          changes=(partial(wrapped, box=10.0, whole=False),)),
    fault("many jumps", "hopping", changes=(partial(hopping, share=0.1, size=2.0),),
          allowed=(*TRACES, "jump")),
    fault("caged", "not diffusion", tracks=caged),
    fault("D switches tenfold", ("not diffusion", "hopping"), tracks=switching),
    fault("time contradicts dt", "time", edits=(partial(with_times, step=0.5),)),
    fault("frames in steps of 5", "stride", edits=(every_fifth,), where="notes"),
    fault("5 % repeat the last place", "repeat", changes=(partial(last_places, share=0.05),),
          allowed=("missing",)),
    fault("5 % at (0, 0, 0)", "zeros", allowed=("constant", "missing"),
          changes=(partial(at_point, share=0.05, point=0.0),)),
    fault("5 % at a constant point", ("constant", "zeros"), allowed=("missing",),
          changes=(partial(at_point, share=0.05, point=[17.0, 19.0, 23.0]),)),
    fault("5 % at (0, 0), plane", "zeros", body=SCALENE[:, :2], allowed=("constant", "missing"),
          changes=(partial(at_point, share=0.05, point=0.0),)),
    fault("centred before", "centred", changes=(without_centre,), allowed=("unresolved",)),
    fault("NaN blocks", "missing", changes=(partial(blank_blocks, length=20),), where="notes"),
    fault("5 % of the rows missing", "missing", edits=LOSSES["particles lost"], where="notes"),
    fault("one far coordinate", "far", changes=(partial(far_coordinates, count=1),),
          where="notes", sizes=(4,)),
    fault("3 far coordinates, unnamed", "far", changes=(partial(far_coordinates, count=3),),
          edits=(unnamed,), where="notes", sizes=(4,)),
    fault("soft arm, 0.2 rad", NOT_RIGID, tracks=partial(soft_arm, swing=0.2),
          allowed=("none rigid", "floor"), sizes=(5,)),
    fault("soft arm, 0.5 rad", NOT_RIGID, tracks=partial(soft_arm, swing=0.5),
          allowed=("none rigid", "floor"), sizes=(5,)),
    fault("soft body among rigid ones", NOT_RIGID, tracks=partial(soft_bodies, rigid=2),
          allowed=("pool", "floor"), sizes=(4, 4, 4)),
    fault("no rigid cluster", "none rigid", tracks=partial(soft_bodies, count=2),
          allowed=(*NOT_RIGID, "floor"), sizes=(4, 4)),
    fault("slices of tumbling bodies", "none rigid", tracks=sliced,
          allowed=(*NOT_RIGID, *IDENTITY, *TRACES, "pool"), sizes=(4, 4)),
    fault("tight body among soft ones, unnamed", NOT_RIGID, sizes=(4, 4, 4),
          tracks=partial(soft_bodies, count=2, rigid=1, flex=0.1, sigma=0.005),
          edits=(unnamed,), allowed=("pool", "floor")),
    fault("broken bond", NOT_RIGID, tracks=broken, allowed=("none rigid",), sizes=(4,)),
    *(fault(f"z {percent:+} %, {frames} frames", "z scale", frames=frames,
            changes=(partial(stretched, by=1 + percent / 100),), allowed=("floor",))
      for percent, frames in [(3, 100), (-3, 100), (5, 100), (10, 100), (20, 100), (20, 300)]),
    fault("z in planes of 0.2 um", ("z scale", *NOT_RIGID, "units"), allowed=("none rigid", "scan"),
          edits=(partial(in_unit, factor=5.0, axes="z"),)),
    fault("sequential scan", "scan", tracks=scanned, allowed=("floor",)),
    *(fault(f"labels exchanged once, {name}", "labels", body=BODIES[name], where="notes",
            changes=(partial(relabelled, events=1),), sizes=(len(BODIES[name]),))
      for name in ("trimer", "tetrahedron", "bipyramid", "octahedron")),
    fault("labels exchanged 15 times", ("labels", "cut"), changes=(partial(relabelled, events=15),),
          allowed=IDENTITY, sizes=(4,)),
    fault("two bodies under one number", (*NOT_RIGID, "none rigid"), count=2, body=TRIMER,
          changes=(together,), allowed=("unsettled", "extra", "floor")),
    fault("unequal D_R", "disagreement", count=3, D_R=[2e-3, 5e-3, 2e-2]),
    fault("line through an anisotropic MSAD", "anisotropic", measure=fitted_line,
          make=lambda rng: recorded(rng, body=SQUARE, D_R=[[1e-3, 1e-3, 1e-2]])[0]),
    fault("undersampled", "coarse", body=SCALENE, D_R=0.14, D_T=0.3, allowed=IDENTITY),
    fault("noise dominates", REST, D_R=1e-5, D_T=0.04, sigma=0.05, allowed=REST),
    fault("20 frames", "few", frames=20, allowed=REST),
    fault("in nm", "units", edits=(partial(in_unit, factor=1e3),)),
    fault("in mm", "units", edits=(partial(in_unit, factor=1e-3),)),
    fault("in pixels, trackpy's columns", "units", edits=(unnamed, as_trackpy)),
    fault("viscosity 2.18 Pa s", "viscosity",
          arguments={"viscosity": 2.18, "temperature": 295.0}),
    fault("plan with sigma in nm", "units", make=lambda _: PLAN, measure=planned,
          allowed=("other", "floor", "too long")),
]  # fmt: skip


# Movies.

MOVIE = {
    "voxel": (0.4, 0.3, 0.3), "shape": (24, 32, 32), "diameter": 2.0, "psf": (0.4, 0.2, 0.2),
    "photons": 200.0, "background": 5.0, "dt": 0.5,
}  # fmt: skip


def movie(rng, *, frames=16, still=False, **optics):
    """Return a movie of one body of three touching spheres of 2 um."""
    times = np.arange(frames) * 0.5
    x = brownian(triangle(2.0, 2.0, 2.0), times, D_R=0.01, D_T=0.01, rng=rng) + 4.5
    if still:
        x = np.repeat(x[:1], frames, axis=0)
    settings = MOVIE | optics
    return perrin.render_stack(x, rng=int(rng.integers(2**31)), **settings)


def film(name, expected=(), *, diameter=2.0, allowed=(), **how):
    kinds = (expected,) if isinstance(expected, str) else expected
    arguments = {"diameter": diameter, "contact": max(diameter, 2.0)}
    return Case(name, partial(movie, **how), kinds, arguments, allowed=("few", *allowed),
                measure=filmed)  # fmt: skip


FILMS = [
    film("clean: movie"),
    film("clean: movie, 8 bits", dtype="uint8", photons=150.0),
    film("saturation", "saturation", photons=400.0, dtype="uint8", allowed=("fading",)),
    film("bleaching", "fading", bleaching=0.6),
    film("identical frames", "frozen", still=True, noise=False, allowed=REST),
    film("diameter larger than the stack", "too large", diameter=12.0),
    film("diameter in nm", ("too large", "units"), diameter=2000.0),
]


# The trial.


@dataclass
class Tally:
    """What was found in the tables of one case (None: a part of a tally)."""

    case: Case | None
    tables: int = 0
    named: int = 0
    elsewhere: int = 0  # named among the notes where a warning is asked for, or the reverse
    alarmed: int = 0
    kinds: Counter = field(default_factory=Counter)
    texts: dict = field(default_factory=dict)

    def add(self, other):
        """Add another tally of the same case."""
        self.tables += other.tables
        self.named += other.named
        self.elsewhere += other.elsewhere
        self.alarmed += other.alarmed
        self.kinds += other.kinds
        self.texts = other.texts | self.texts


def measured(case, rng):
    """Return the warnings and notes of one table; an error counts as a warning."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            report = case.measure(case.make(rng), **case.arguments)
        except Exception as error:
            report = Texts((f"refused: {type(error).__name__}: {error}",))
    more = tuple(str(w.message) for w in caught if w.category.__module__.startswith("perrin"))
    return Texts((*report.warnings, *more), report.notes, report.sizes)


def kind_of(text):
    """Return the first kind that a text matches; refusals are kinds of their own."""
    found = (k for k, pattern in KINDS.items() if re.search(pattern, text, re.IGNORECASE))
    kind = next(found, "other")
    return f"refused ({kind})" if text.startswith("refused") else kind


def matches(texts, kinds):
    """Return those of the texts that match one of the kinds."""
    pattern = "|".join(f"(?:{KINDS[k]})" for k in kinds if k in KINDS)
    return [t for t in texts if pattern and re.search(pattern, t, re.IGNORECASE)]


def tried(case, seed, repeat):
    """Make and measure one table of a case."""
    report = measured(case, np.random.default_rng([seed, crc32(case.name.encode()), repeat]))
    here, there = report.warnings, report.notes
    right = matches(here, case.expected)
    texts = {kind_of(t): t for t in here if t not in right}
    longest = max(here, key=len, default="")
    if len(longest) > LONGEST:
        texts["too long"] = longest
    texts = {k: t for k, t in texts.items() if k not in case.allowed}
    if case.sizes is not None and report.sizes not in (None, case.sizes):
        texts["wrong bodies"] = f"bodies of {report.sizes} spheres, planted {case.sizes}"
    if case.where == "notes":
        here, there = there, here
    return Tally(
        case,
        tables=1,
        named=int(bool(matches(here, case.expected))),
        elsewhere=int(bool(matches(there, case.expected))),
        alarmed=int(bool(texts)),
        kinds=Counter(texts.keys()),
        texts=texts,
    )


def tally(number, films, seed, repeats):
    """Try some repeats of the case of a number; cases themselves cannot be sent to a worker."""
    case = (FILMS if films else FAULTS + CLEAN)[number]
    total = Tally(None)
    for repeat in repeats:
        total.add(tried(case, seed, repeat))
    return number, total


def trial(*, films, only, seed, repeats, jobs):
    """Return the tallies of all cases whose names contain `only`."""
    cases = FILMS if films else FAULTS + CLEAN
    found = {i: Tally(case) for i, case in enumerate(cases) if only in case.name}
    pieces = [range(k, min(k + 10, repeats)) for k in range(0, repeats, 10)]
    tasks = [(i, films, seed, piece) for piece in pieces for i in found]
    if jobs == 1:
        for task in tasks:
            number, part = tally(*task)
            found[number].add(part)
        return list(found.values())
    with ProcessPoolExecutor(jobs) as pool:
        for number, part in pool.map(tally, *zip(*tasks, strict=True)):
            found[number].add(part)
    return list(found.values())


def below(count, tables, line, *, level):
    """Return whether a count misses a least share; with a level, whether it excludes the share."""
    if level is None:
        return count < line * tables
    return bool(binom.cdf(count, tables, line) < level)


def above(count, tables, line, *, level):
    """Return whether a count exceeds a greatest share; with a level, whether it excludes it."""
    if level is None:
        return count > line * tables
    return bool(binom.sf(count - 1, tables, line) < level)


def verdicts(tallies, *, level):
    """Return what does not hold, in words; `level` is that of a small form."""
    faults = [t for t in tallies if t.case.expected]
    quiet = [t for t in tallies if not t.case.expected]
    broken = [
        f"{t.case.name}: named in {t.named} of {t.tables}"
        for t in faults
        if below(t.named, t.tables, NAMED, level=level)
    ]
    tables = sum(t.tables for t in quiet)
    kinds = sum((t.kinds for t in quiet), Counter())
    broken += [
        f"{kind}: in {count} of {tables} clean tables"
        for kind, count in kinds.most_common()
        if above(count, tables, ONE_KIND, level=level)
    ]
    alarmed = sum(t.alarmed for t in quiet)
    if above(alarmed, tables, ANY_KIND, level=level):
        broken.append(f"any warning: in {alarmed} of {tables} clean tables")
    broken += [
        f"{t.case.name}: {kind} in {count} of {t.tables}"
        for t in quiet
        for kind, count in t.kinds.most_common()
        if above(count, t.tables, ONE_KIND, level=EXCLUDED)
    ]
    return broken


def percent(count, tables):
    return f"{100 * count / tables:.1f}".removesuffix(".0") if tables else "-"


def row(t):
    """Return one row of the printed table."""
    others = ", ".join(f"{k} {percent(n, t.tables)}" for k, n in t.kinds.most_common()) or "-"
    if not t.case.expected:
        return (
            f"| {t.case.name.removeprefix('clean: ')} | {percent(t.alarmed, t.tables)} | {others} |"
        )
    asked = " or ".join(t.case.expected[:2]) + (" ..." if len(t.case.expected) > 2 else "")
    asked += " (note)" if t.case.where == "notes" else ""
    named, other = percent(t.named, t.tables), percent(t.elsewhere, t.tables)
    named += f" ({other} as a {'warning' if t.case.where == 'notes' else 'note'})" * bool(
        t.elsewhere
    )
    return f"| {t.case.name} | {asked} | {named} | {others} |"


def show(tallies, *, texts):
    """Print the tables of faults and of clean cases."""
    faults = [t for t in tallies if t.case.expected]
    quiet = [t for t in tallies if not t.case.expected]
    if faults:
        print("| fault | expected | named % | other warnings % |\n| --- | --- | --- | --- |")
        print(*map(row, faults), sep="\n", end="\n\n")
    if quiet:
        print("| clean case | any warning % | warnings % |\n| --- | --- | --- |")
        print(*map(row, quiet), sep="\n")
        kinds = sum((t.kinds for t in quiet), Counter())
        tables, alarmed = sum(t.tables for t in quiet), sum(t.alarmed for t in quiet)
        listed = ", ".join(f"{k} {percent(n, tables)}" for k, n in kinds.most_common()) or "-"
        print(f"| **all {tables} tables** | {percent(alarmed, tables)} | {listed} |\n")
    if texts:
        for t in tallies:
            for kind, text in t.texts.items():
                print(f"{t.case.name} [{kind} {t.kinds[kind]}/{t.tables}]: {text[:300]}")


def main(given=None):
    parser = argparse.ArgumentParser()
    parser.add_argument("--repeats", type=int, help="tables of every case")
    parser.add_argument("--only", default="", help="a part of the names of the cases")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--quick", action="store_true", help="2 tables of every case")
    parser.add_argument("--images", action="store_true", help="movies instead of tables")
    parser.add_argument("--texts", action="store_true", help="print what should not be there")
    chosen = parser.parse_args(given)
    repeats = chosen.repeats or (2 if chosen.quick else 5 if chosen.images else 200)
    start = time.perf_counter()
    tallies = trial(
        films=chosen.images, only=chosen.only, seed=chosen.seed, repeats=repeats, jobs=chosen.jobs
    )
    if not tallies:
        parser.error(f"no case has {chosen.only!r} in its name")
    show(tallies, texts=chosen.texts)
    broken = verdicts(tallies, level=QUICKLY_EXCLUDED if chosen.quick else None)
    count, spent = sum(t.tables for t in tallies), time.perf_counter() - start
    print(f"{count} tables in {spent:.0f} s; {len(broken)} lines do not hold", *broken, sep="\n  ")
    return int(bool(broken))


if __name__ == "__main__":
    sys.exit(main())
