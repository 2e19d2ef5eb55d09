"""Every public function follows the laws of its arguments: a table of functions against changes.

A change of the laboratory (tests/laboratory.py) turns, shifts, moves and reverses the positions,
names the particles anew, takes other units of length and time and other types of numbers, and
leaves gaps out, all at once. The numbers of a function stay, or change by the powers of their
units. For every function the table names the kinds of change that do not apply to it, and why.
"""

from __future__ import annotations

import functools
import inspect
import tempfile
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import HealthCheck, Phase, given, settings

import perrin
from laboratory import DIAMETER, DT, GRID, KINDS, Change, Data, Laboratory, applied, cases, places
from perrin.diffusion import DiffusionEstimate, Found
from perrin.images import CameraNoise
from perrin.study import Coefficient

if TYPE_CHECKING:
    from collections.abc import Callable

HERE = Path(__file__).parent


@dataclass(frozen=True)
class Law:
    """The numbers of a function in a laboratory, and why some changes do not apply to it.

    Numbers are (value, power of length, power of time). They agree within `rel` of the largest.
    """

    numbers: Callable[[Laboratory], list[tuple[Any, float, float]]]
    without: dict[str, str] = field(default_factory=dict)
    rel: float = 1e-9


# Relative difference at which searches for a maximum end.
SEARCH = 1e-6


# ---- why a change does not apply ----------------------------------------------------------------

TRANSLATION = {"velocity": "a velocity of the whole body is part of the translation"}
FIRST_FRAME = {"backwards": "blocks and trends of time are counted from the first frame"}
BLUR = {"every": "an exposure of up to dt is fitted"}
SPIN = {"backwards": "a mean rotation is removed in the axes at the beginning of a step"}
STATE = {"backwards": "the state of a step is that at its beginning"}
REFERENCE = {"backwards": "the reference orientation is renewed forwards in time"}
NAMED_FIRST = {"backwards": "ids and labels are given in the first frame"}
AT_REST = dict.fromkeys(
    ["velocity", "backwards", "every", "left_out"], "takes one configuration, no times"
)
NO_ROWS = {"every": "takes one row after the other"}
NO_TIME = {"time": "takes no times"}
NO_POSITIONS = dict.fromkeys(
    ["turn", "shift", "velocity", "backwards", "every", "left_out"],
    "takes coefficients, no positions",
)
IN_DOUBLE = {"dtype": "takes results of other functions, which are in double precision"}
NO_LIST = {"order": "takes one value"}
IMAGES = {
    "order": "spheres in images have no labels",
    "velocity": "images of each time are found alone; render_stack moves the spheres",
    "every": "a movie has all of its frames",
    "left_out": "a movie has all of its frames",
}
OF_FILES = {"length": "a voxel of a file must be of 1 nm to 20 um"}
NO_UNITS = dict.fromkeys(["length", "time"], "takes pure numbers")


# ---- functions of a motion ----------------------------------------------------------------------


def curve(found, length=0):
    """Return the numbers of a curve at the lags of its pairs."""
    known = found.n_pairs > 0
    return [
        (found.lagtime[known], 0, 1),
        (found.value[known], length, 0),
        (found.stderr[known], length, 0),
        (found.n_pairs[known], 0, 0),
    ]


def estimate(found, length=0):
    """Return the numbers of a diffusion coefficient."""
    return [(found.value, length, -1), (found.stderr, length, -1), (found.ci95, length, -1)]


def step_of(m):
    """Return the shortest time between poses, of which dt is a part where frames are left out."""
    return np.diff(m.time[m.fitted]).min()


def pose_numbers(lab):
    """Return the path of the centre, and the rotations from the first frame that has a pose."""
    m = lab.motion()
    frames = np.rint(m.time / m.dt).astype(int)
    center, rotation = (x[m.fitted] for x in (m.center, m.rotation))
    first = lab.forwards(rotation)[0]
    turned = lab.matrix.T @ lab.forwards(rotation) @ first.T @ lab.matrix
    return [
        (m.sigma, 1, 0),
        (m.R, 1, 0),
        (step_of(m), 0, 1),
        (np.sort(np.linalg.norm(m.template, axis=1)), 1, 0),
        (lab.before(center, frames[m.fitted]), 0, 0),
        (turned, 0, 0),
    ]


def coupled(m):
    found = perrin.coupled_tensor(m).tensor
    translation, rotation = (np.linalg.eigvalsh(t) for t in (found[:3, :3], found[3:, 3:]))
    return [(translation, 2, -1), (rotation, 0, -1), (np.linalg.norm(found[:3, 3:]), 1, -1)]


def switching(m):
    found = perrin.fit_switching(m)
    return [(found.D_mean.value, 0, -1), (found.bic_gain, 0, 0)]


def anomalous(m):
    found = perrin.fit_anomalous(m)
    return [(found.alpha, 0, 0), (found.msd_at_best_lag, 0, 0), (found.best_lag, 0, 1)]


def confined(m):
    found = perrin.fit_confined(m)
    return [(found.D_short, 0, -1), (found.offset, 0, 0), (found.log_likelihood_gain, 0, 0)]


def verdict(m):
    found = perrin.judge_motion(m)
    return [([p for p in found.p.values() if p is not None], 0, 0), (found.p_family, 0, 0)]


def distribution(m):
    found = perrin.van_hove(m, lag=3 * step_of(m), quantity="angle")
    return [(found.edges, 0, 0), (found.density, 0, 0), (found.alpha2, 0, 0)]


def moduli(m):
    body = mobility(Laboratory(Data(), Change()))
    found = perrin.viscoelastic_moduli(perrin.msad(m), cluster=body, temperature=295.0)
    return [(found.frequency, 0, -1), (found.exponent, 0, 0), (found.modulus, 0, 0)]


def relaxation(m):
    found = perrin.fit_relaxation(perrin.orientation_correlation(m))
    return [(found.tau, 0, 1), (found.beta, 0, 0), (found.ci95, 0, 1)]


def quaternions(m):
    found = perrin.quaternion_covariance(m, n_lags=5)
    return [(np.linalg.eigvalsh(found.covariance), 0, 0), (found.lagtime, 0, 1)]


def threshold(m):
    found = perrin.threshold_displacement(m, threshold=0.5)
    return [(np.linalg.norm(found[m.fitted], axis=1), 0, 0)]


def sampling(m):
    return [(perrin.judge_sampling(perrin.estimate_diffusion(m)).snr, 0, 0)]


def line(m):
    lag_range = 2.5 * step_of(m), 12.5 * step_of(m)
    return estimate(perrin.fit_line(perrin.msad(m), lag_range=lag_range))


def of_motion(numbers, without=None, **options):
    """Return the law of a function of a motion, whose positions all changes apply to."""
    return Law(lambda lab: numbers(lab.motion()), without or {}, **options)


OF_MOTION = {
    "track_rotation": Law(pose_numbers),
    "coupled_tensor": of_motion(coupled, TRANSLATION | BLUR, rel=SEARCH),
    "diffusion_tensor": of_motion(
        lambda m: [(perrin.diffusion_tensor(m).principal_values, 0, -1)], BLUR, rel=SEARCH
    ),
    "estimate_diffusion": of_motion(lambda m: estimate(perrin.estimate_diffusion(m))),
    "estimate_diffusion, of translation": of_motion(
        lambda m: estimate(perrin.estimate_diffusion(m, quantity="translation", drift=True), 2)
    ),
    "fit_anomalous": of_motion(anomalous, rel=SEARCH),
    "fit_confined": of_motion(confined, rel=SEARCH),
    "fit_gls": of_motion(lambda m: estimate(perrin.fit_gls(perrin.msad(m)))),
    "fit_line": of_motion(line),
    "fit_relaxation": of_motion(relaxation, rel=SEARCH),
    "fit_switching": of_motion(switching, STATE, rel=1e-4),  # where its search ends
    "judge_motion": of_motion(verdict, FIRST_FRAME, rel=SEARCH),
    "judge_sampling": of_motion(sampling, rel=SEARCH),
    "long_time_diffusion": of_motion(lambda m: estimate(perrin.long_time_diffusion(m)), REFERENCE),
    "msad": of_motion(lambda m: curve(perrin.msad(m))),
    "msad_axes": of_motion(lambda m: [n for axis in perrin.msad_axes(m) for n in curve(axis)]),
    "msad_vector": of_motion(lambda m: curve(perrin.msad_vector(m))),
    "msd": of_motion(lambda m: curve(perrin.msd(m), 2), TRANSLATION),
    "msd, without drift": of_motion(lambda m: curve(perrin.msd(m, drift=True), 2)),
    "non_gaussian": of_motion(lambda m: curve(perrin.non_gaussian(m))[:2], FIRST_FRAME),
    "orientation_correlation": of_motion(lambda m: curve(perrin.orientation_correlation(m))),
    "quaternion_covariance": of_motion(quaternions),
    "threshold_displacement": of_motion(threshold, REFERENCE),
    "translation_rotation_correlation": of_motion(
        lambda m: [(perrin.translation_rotation_correlation(m).value, 0, 0)], TRANSLATION | STATE
    ),
    "van_hove": of_motion(distribution),
    "viscoelastic_moduli": of_motion(moduli, rel=SEARCH),
}

# ---- functions of positions and of tables -------------------------------------------------------


def rod(lab):
    """Return the motion of the first two particles."""
    x, frames = lab.positions()
    two = lab.arranged(range(lab.data.n))
    two = [two.index(i) for i in (0, 1)]
    return perrin.track_direction(x[:, two], dt=lab.dt, times=frames * lab.dt)


def direction(lab):
    return estimate(perrin.estimate_rod(rod(lab)))


def rod_translation(lab):
    return estimate(perrin.estimate_rod(rod(lab), quantity="translation"), 2)


def quality(lab):
    x, frames = lab.positions()
    return perrin.judge_quality(perrin.track_rotation(x, dt=lab.dt, frames=frames), x)


def rigidity(lab):
    found = quality(lab)
    return [(found.residual_over_R, 0, 0), (found.rigid, 0, 0)]


def changes_in_time(lab):
    found = quality(lab)
    return [(found.bond_drift, 0, 0), (found.autocorrelation, 0, 0), (found.fraction, 0, 0)]


def bulk(lab):
    x, frames = lab.positions()
    rest, motion = perrin.remove_rotation(x, dt=lab.dt, frames=frames)
    known = np.isfinite(rest)
    return [
        (np.sort(np.linalg.norm(rest[known].reshape(-1, 3), axis=-1)), 1, 0),
        *estimate(perrin.estimate_diffusion(motion)),
    ]


def displacement(lab):
    """Return the mean square displacement of particles, from their positions."""
    return curve(perrin.msd(lab.positions()[0], dt=lab.dt), 2)


def identity(lab):
    """Return the particles of a track whose labels of two particles are exchanged halfway."""
    x, frames = lab.positions()
    place = np.argsort(lab.order or range(lab.data.n))
    later = frames >= lab.data.n_frames // 2 * lab.every
    x[np.ix_(later, place[[0, 1]])] = x[np.ix_(later, place[[1, 0]])]
    with pytest.warns(perrin.IdentityWarning, match="2 labels pass to another particle"):
        found = perrin.settle_identity(x, times=lab.dt * frames)
    back = found.arranged(x)[:, place]
    full = np.isfinite(back).all(axis=(1, 2))
    return [
        (found.swaps.size, 0, 0),
        (found.piece.max(), 0, 0),
        (lab.before(back[full], frames[full]), 0, 0),
    ]


def table_of(x, frames):
    """Return a table whose coordinates are of the type of the positions, as one from elsewhere."""
    return perrin.positions_table(x, frames=frames).astype(dict.fromkeys("xyz", x.dtype))


def two_bodies(lab):
    """Return the table of two bodies side by side."""
    x, frames = lab.positions()
    both = np.concatenate([x, x + lab.typed(16 * lab.length)], axis=1)
    return table_of(both, frames)


def together(table, lab):
    """Return which particles, in the order before, are in one cluster, and how many rows it has."""
    order = np.argsort(lab.order or range(lab.data.n))
    row = table.groupby("particle")["cluster"].first().to_numpy()
    row = np.concatenate([row[: lab.data.n][order], row[lab.data.n :][order]])
    return [(row[:, None] == row, 0, 0), (np.bincount(table["cluster"]), 0, 0)]


def found_clusters(lab):
    contact = lab.typed(np.rint(1.2 * DIAMETER / GRID) * GRID * lab.length)
    table = perrin.find_clusters(two_bodies(lab), contact=contact, size=lab.data.n)
    return together(table, lab)


def there_and_back(lab):
    """Return the positions that come back from a table."""
    x, frames = lab.positions()
    back, known = perrin.cluster_positions(table_of(x, frames))
    full = np.isfinite(back).all(axis=(1, 2))
    back = back[full][:, np.argsort(lab.order or range(lab.data.n))]
    return [(lab.before(back, known[full]), 0, 0)]


def identified(lab):
    """Return whether detections without ids become particles that last."""
    x, frames = lab.positions()
    table = table_of(x, frames).rename(columns={"particle": "truth"})
    table = table.iloc[lab.arranged(range(len(table)))]
    found = perrin.identify(
        table, contact=lab.typed(np.rint(DIAMETER / GRID) * GRID * lab.length), size=lab.data.n
    )
    known = found[found["cluster"] >= 0]
    pairs = known.groupby(["truth", "particle"]).size()
    return [(len(known), 0, 0), (found["piece"].max(), 0, 0), (np.sort(pairs), 0, 0)]


def from_file(lab):
    """Return what is read from a file in the unit of this laboratory."""
    x, frames = lab.positions()
    table = table_of(x, frames)
    with tempfile.TemporaryDirectory() as folder:
        table.iloc[lab.arranged(range(len(table)))].to_parquet(f"{folder}/a.parquet")
        found = perrin.read_tracks(f"{folder}/a.parquet", scale=1 / lab.length)
        perrin.write_tracks(found, f"{folder}/b.csv")
        pd.testing.assert_frame_equal(perrin.read_tracks(f"{folder}/b.csv"), found)
    back, known = perrin.cluster_positions(found)
    full = np.isfinite(back).all(axis=(1, 2))
    back = lab.length * back[full][:, np.argsort(lab.order or range(lab.data.n))]
    return [(lab.before(back, known[full]), 0, 0)]


@functools.lru_cache(maxsize=4)
def report_of(data, change):
    """Return the report of one cluster, in um whatever the unit of the table."""
    lab = Laboratory(data, change)
    x, frames = lab.positions()
    table = table_of(x, frames)
    table = table.iloc[lab.arranged(range(len(table)))]
    return perrin.analyze(table, dt=lab.dt, scale=1 / lab.length, drift=True), lab.used


def report(lab):
    found, used = report_of(lab.data, lab.change)
    lab.used |= used
    return found


def analysis(lab):
    (one,) = report(lab).clusters
    return [*estimate(one.D_R), *estimate(one.D_T)]


def layers(lab):
    """Return the points of the layers, in the laboratory before."""
    points, about = perrin.napari_layers(report(lab))[0][:2]
    table = pd.DataFrame(points, columns=["frame", "z", "y", "x"])
    table["frame"] = table["frame"].astype(int)
    back, known = perrin.cluster_positions(table.assign(particle=about["features"]["particle"]))
    full = np.isfinite(back).all(axis=(1, 2))
    back = lab.length * back[full][:, np.argsort(lab.order or range(lab.data.n))]
    return [(lab.before(back, known[full]), 0, 0)]


def noise_added(lab):
    """Return the noise itself, which depends neither on the positions nor on gaps."""
    full = places(replace(lab.data, gaps=frozenset(), absent=None))
    x = lab.typed(
        lab.seen(lab.forwards(full + np.array(lab.velocity)))[:, lab.arranged(range(lab.data.n))]
    )
    gaps = sorted(lab.data.gaps)
    if not lab.left_out and x.dtype.kind == "f":
        x[gaps] = np.nan
    noise = perrin.add_noise(x, sigma=0.02 * lab.length, rng=lab.data.seed) - x
    return [(np.delete(noise, gaps, axis=0), 1, 0)]


def floor(lab):
    sigma = lab.typed(GRID * lab.length)
    return [(perrin.noise_floor(lab.body(), sigma=sigma).phi2, 0, 0)]


def group(lab):
    symbol = perrin.point_group(lab.body(), tolerance=0.1 * DIAMETER * lab.length)
    return [(list(symbol.encode()), 0, 0)]


def rotations(lab):
    found = perrin.rotation_group(lab.body(), tolerance=0.1 * DIAMETER * lab.length)
    return [(np.sort(np.trace(found, axis1=1, axis2=2)), 0, 0)]


def bodies(lab):
    """Return full frames of positions, and the body that they are compared with."""
    x, frames = lab.positions()
    body = places(lab.data)[0][list(lab.order or range(lab.data.n))]
    return x, body, frames


def fitted_rotations(lab):
    x, body, _ = bodies(lab)
    return [(lab.matrix.T @ lab.forwards(perrin.kabsch(x, body)), 0, 0)]


def similarities(lab):
    x, body, frames = bodies(lab)
    found = perrin.similarity(x, body)
    return [
        (lab.matrix.T @ lab.forwards(found.R), 0, 0),
        (lab.forwards(found.s), 1, 0),
        (lab.before(found.v, frames), 0, 0),
    ]


WHOLE = dict.fromkeys(
    ["every", "left_out"], "a frame without particles has no rotation, and is refused"
)

OF_POSITIONS = {
    "add_noise": Law(noise_added, NO_TIME | NO_ROWS),
    "analyze": Law(analysis, SPIN, SEARCH),
    "cluster_positions": Law(there_and_back, NO_TIME),
    "estimate_rod": Law(direction),
    "estimate_rod, of translation": Law(rod_translation, TRANSLATION),
    "find_clusters": Law(found_clusters, NO_TIME | NAMED_FIRST),
    "identify": Law(identified, NO_TIME),
    "judge_quality": Law(rigidity),
    "judge_quality, in time": Law(
        changes_in_time,
        dict.fromkeys(
            ["left_out", "every"], "neighbours, eighths and shares are those of the rows"
        ),
    ),
    "kabsch": Law(fitted_rotations, NO_TIME | WHOLE),
    "msd, of positions": Law(
        displacement, TRANSLATION | {"left_out": "has no numbers of frames: a gap is NaN"} | NO_ROWS
    ),
    "napari_layers": Law(layers, SPIN),
    "noise_floor": Law(floor, NO_TIME | AT_REST),
    "point_group": Law(group, NO_TIME | AT_REST),
    "positions_table": Law(there_and_back, NO_TIME),
    "read_tracks": Law(from_file, NO_TIME),
    "remove_rotation": Law(bulk),
    "rotation_group": Law(rotations, NO_TIME | AT_REST),
    "settle_identity": Law(identity, NAMED_FIRST),
    "similarity": Law(similarities, NO_TIME | WHOLE),
    "track_direction": Law(direction),
    "write_tracks": Law(from_file, NO_TIME),
}

# ---- functions of bodies, coefficients and single numbers ---------------------------------------

ANY_BODY = NO_TIME | AT_REST


@functools.lru_cache(maxsize=8)
def predicted(data, change):
    """Return how a body diffuses: D_T is in length^-1 time^-1 at a temperature in K."""
    lab = Laboratory(data, change)
    found = perrin.cluster_mobility(
        lab.body(), radius=lab.typed(1.125 * lab.length), viscosity=0.002 * lab.time,
        temperature=lab.typed(295), degree=3,
    )  # fmt: skip
    return found, lab.used


def mobility(lab):
    found, used = predicted(lab.data, lab.change)
    lab.used |= used
    return found


def turned_back(lab, tensor):
    """Return a tensor of the axes of a laboratory in those before."""
    return lab.matrix.T @ tensor @ lab.matrix


def mobilities(lab):
    found = mobility(lab)
    return [
        (turned_back(lab, found.D_T), -1, -1),
        (turned_back(lab, found.D_R), -3, -1),
        (DIAMETER + lab.before(found.center[None], np.zeros(1, int)), 0, 0),
    ]


def at_a_point(lab):
    point = lab.typed(lab.seen(np.array([0.5, 1.0, -0.25])))
    return [(perrin.apparent_translation(mobility(lab), point=point), -1, -1)]


def near_a_wall(lab):
    height = lab.typed(16 * lab.length)
    D_T, D_R = perrin.wall_diffusion(mobility(lab), height=height)
    return [(D_T, -1, -1), (D_R, -3, -1)]


def slowed(lab):
    height = lab.typed(16 * lab.length)
    one = perrin.wall_factor(lab.typed(1.25 * lab.length), height=height)
    near = perrin.wall_factor(mobility(lab), height=height)
    return [
        (value, 0, 0)
        for f in (one, near)
        for value in (f.T_parallel, f.T_perpendicular, f.R_parallel)
    ]


def height_of_fall(lab):
    density = lab.typed(50)
    return [(perrin.gravitational_height(mobility(lab), density_difference=density), -3, 0)]


def falling(lab):
    density = lab.typed(50)
    return [(perrin.settling_velocity(mobility(lab), density_difference=density), 2, -1)]


def sizes(lab):
    """Return the sizes by rotation, by translation, and by both."""
    body, known = mobility(lab), {"viscosity": 0.002 * lab.time, "temperature": 295.0}
    D_T = [part / lab.length / lab.time for part in (0.0385, 0.0049)]
    D_R = [part / lab.length**3 / lab.time for part in (4.93e-3, 0.49e-3)]
    found = [
        perrin.size_from_rotation(D_R, cluster=body, **known),
        perrin.size_from_translation(D_T, cluster=body, **known),
        perrin.size_and_viscosity(D_T, D_R, cluster=body, temperature=295.0),
    ]
    return [
        *((value, 1, 0) for size in found for value in (size.cluster, size.sphere_stderr)),
        (found[2].viscosity, 0, 1),
    ]


def simulated(lab):
    """Return a simulated path, which depends on the shape of the body in nothing."""
    motion = perrin.simulate_motion(
        perrin.Cluster(lab.body()), D_R=0.02 / lab.time, D_T=0.04 * lab.length**2 / lab.time,
        dt=lab.dt, n_frames=5, rng=lab.data.seed,
    )  # fmt: skip
    apart = np.linalg.norm(motion.positions()[0] - motion.center[0], axis=1)
    return [
        (motion.rotation, 0, 0),
        (motion.center, 1, 0),
        (motion.time, 0, 1),
        (apart[np.argsort(lab.order or range(lab.data.n))], 1, 0),
    ]


def plan(lab):
    found = perrin.plan_sampling(
        lab.body(), D_R=0.02 / lab.time, D_T=0.04 * lab.length**2 / lab.time,
        sigma=lab.typed(GRID * 16 * lab.length), n_frames=500,
    )  # fmt: skip
    return [(found.dt_best, 0, 1), (found.dt_link, 0, 1), (found.expected_error, 0, 0)]


def axes_and_angles(lab):
    """Return axes and angles of rotations by a quarter and by a third."""
    known = [
        np.eye(3)[[1, 2, 0]],
        [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
        [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    ]
    rotation = lab.matrix @ np.array(lab.arranged(known)) @ lab.matrix.T
    axis, angle = perrin.axis_angle(lab.typed(rotation))
    order = np.argsort(lab.arranged(range(3)))
    return [(axis[order] @ lab.matrix, 0, 0), (angle[order], 0, 0)]


def brownian(lab):
    order = np.argsort(lab.arranged(range(4)))
    Dt = lab.typed(lab.arranged([1, 2, 3, 5]))
    return [(perrin.brownian_alpha2(Dt)[order], 0, 0)]


def bound(lab):
    return [(perrin.cramer_rao(n_frames=100, snr=lab.typed(4)), 0, 0)]


def estimates(lab, quantity, count=8):
    """Return estimates of some bodies in the units of the laboratory."""
    rng = np.random.default_rng(lab.data.seed)
    unit = (lab.length**2 if quantity == "translation" else 1) / lab.time
    both = rng.normal(size=count)
    D = unit * 0.02 * np.exp(0.5 * both + 0.2 * rng.normal(size=count) * (quantity == "rotation"))
    found = [Found.normal(value, 0.05 * value, 0.0, 0.0) for value in D]
    rest = {"method": "mle", "n_frames": 300, "dt": lab.dt, "noise_variance": 0.0}
    return lab.arranged([DiffusionEstimate.judged(one, quantity=quantity, **rest) for one in found])


def correlation(lab):
    found = perrin.diffusion_correlation(estimates(lab, "translation"), estimates(lab, "rotation"))
    return [(found.value, 0, 0), (found.p, 0, 0)]


def decoupling(lab):
    D_T, D_R = (estimates(lab, quantity, 1)[0] for quantity in ("translation", "rotation"))
    found = perrin.decoupling_ratio(D_T, D_R, mobility=mobility(lab))
    # D_T/D_R of the body is in length^2, as is that of the estimates: the ratio has no unit.
    return [(found.value, 0, 0), (found.ci95, 0, 0)]


def population(lab, *, centre=1.0, seed=0, length=2):
    """Return coefficients of eight clusters in three movies, and the movies."""
    rng = np.random.default_rng([lab.data.seed, seed])
    unit = centre * lab.length**length / lab.time
    D = unit * np.exp(0.3 * rng.normal(size=8))
    found = [Coefficient(d, (0.9 * d, 1.1 * d), (0.81 * d, 1.22 * d)) for d in D]
    return lab.arranged(found), lab.arranged(list("aabbbccc"))


def mean_of(lab, **options):
    coefficients, movies = population(lab, **options)
    return perrin.population_mean(coefficients, movies=movies)


def mean(lab):
    found = mean_of(lab)
    return [(found.value, 2, -1), (found.ci95, 2, -1), (found.spread_clusters, 0, 0)]


def comparison(lab):
    found = perrin.compare_conditions(mean_of(lab), mean_of(lab, seed=1, centre=1.4))
    return [(found.ratio, 0, 0), (found.ci95, 0, 0), (found.p, 0, 0)]


def trend(lab):
    """Return D against a condition in the unit of time: A of D = A/x is in length^2."""
    x = [1.0, 2.0, 4.0]
    means = [mean_of(lab, seed=k, centre=1 / value) for k, value in enumerate(x)]
    x = lab.typed(lab.arranged(x)) * lab.time
    found = perrin.fit_trend(lab.arranged(means), x, law="inverse")
    return [(found.parameters["A"], 2, 0), (found.ci95["A"], 2, 0), (found.p, 0, 0)]


def power(lab):
    D_R, D_T = (
        lab.arranged([mean_of(lab, seed=k, centre=2.0**-k, length=p) for k in range(3)])
        for p in (0, 2)
    )
    found = perrin.fit_power_law(D_R, D_T)
    return [(found.parameters["exponent"], 0, 0), (found.ci95["exponent"], 0, 0)]


def influence(lab):
    coefficients, movies = population(lab)
    found = perrin.leave_one_out(coefficients, movies=movies)
    order = np.argsort(lab.arranged(range(len(found))))
    return [(np.array([(one.change, one.p) for one in found])[order], 0, 0)]


def study(lab):
    found = perrin.plan_study(
        lab.typed(1) / 8, n_clusters=6, spread_clusters=lab.typed(1) / 4, snr=lab.typed(20)
    )
    return [(found.n_movies, 0, 0), (found.n_frames, 0, 0), (found.half_width, 0, 0)]


# The points at which the velocities of a series of degree 3 agree do not turn with the body.
BY_SERIES = 1e-3

OF_NUMBERS = {
    "apparent_translation": Law(at_a_point, AT_REST, BY_SERIES),
    "axis_angle": Law(axes_and_angles, NO_UNITS | AT_REST | {"shift": "takes rotations"}),
    "brownian_alpha2": Law(brownian, NO_UNITS | NO_POSITIONS),
    "cluster_mobility": Law(mobilities, AT_REST, BY_SERIES),
    "compare_conditions": Law(comparison, NO_POSITIONS | IN_DOUBLE),
    "cramer_rao": Law(bound, NO_UNITS | NO_POSITIONS | NO_LIST),
    "decoupling_ratio": Law(decoupling, AT_REST, BY_SERIES),
    "diffusion_correlation": Law(correlation, NO_POSITIONS | IN_DOUBLE),
    "fit_power_law": Law(power, NO_POSITIONS | IN_DOUBLE, SEARCH),
    "fit_trend": Law(trend, NO_POSITIONS),
    "gravitational_height": Law(height_of_fall, AT_REST, BY_SERIES),
    "leave_one_out": Law(influence, NO_POSITIONS | IN_DOUBLE),
    "plan_sampling": Law(plan, AT_REST),
    "plan_study": Law(study, NO_UNITS | NO_POSITIONS | NO_LIST),
    "population_mean": Law(mean, NO_POSITIONS | IN_DOUBLE),
    "settling_velocity": Law(falling, AT_REST, BY_SERIES),
    "simulate_motion": Law(simulated, AT_REST),
    "size_and_viscosity": Law(sizes, AT_REST, BY_SERIES),
    "size_from_rotation": Law(sizes, AT_REST, BY_SERIES),
    "size_from_translation": Law(sizes, AT_REST, BY_SERIES),
    "wall_diffusion": Law(near_a_wall, AT_REST, BY_SERIES),
    "wall_factor": Law(slowed, AT_REST, BY_SERIES),
    "water_viscosity": Law(
        lambda lab: [(perrin.water_viscosity(lab.typed(295)), 0, 0)],
        dict.fromkeys(["length", "time"], "the viscosity is in Pa s, the temperature in K")
        | NO_POSITIONS
        | NO_LIST,
    ),
}

# ---- functions of images ------------------------------------------------------------------------

VOXEL, OPTICS = 0.3125, perrin.Optics(DIAMETER, (0.4, 0.15), CameraNoise(3.0, 4.0))
SHAPE, FRAMES, MIDDLE = (32, 28, 28), 4, (4.2, 4.2, 4.8)


@functools.lru_cache(maxsize=4)
def recorded(seed):
    """Return the voxels of a tetrahedron, (T, z, y, x), and its true positions."""
    truth = perrin.simulate_motion(
        perrin.Cluster.touching(4, DIAMETER), D_R=5e-3, D_T=1e-4, dt=DT, n_frames=FRAMES, rng=seed
    )
    movie = perrin.render_stack(
        truth, centers=[MIDDLE], voxel=[VOXEL] * 3, shape=SHAPE, diameter=DIAMETER,
        psf=(0.4, 0.15, 0.15), photons=75, background=5, gain=3, read_noise=2, offset=5, rng=seed,
    )  # fmt: skip
    return np.stack([movie.frame(i) for i in range(FRAMES)]), truth.positions() + MIDDLE


def moved(lab, frames):
    """Turn images by quarters about z, shift them by whole voxels, and reverse their time."""
    turned = lab.forwards(np.rot90(frames, lab.quarters, axes=(3, 2)))
    return np.roll(turned, lab.voxels, axis=(1, 2, 3))


def moved_points(lab, points):
    """Return points (..., 3) of images as `moved` moves them, in the unit of the laboratory."""
    x, y, z = np.moveaxis(np.asarray(points, dtype=float), -1, 0)
    last = VOXEL * (SHAPE[2] - 1)
    for _ in range(lab.quarters):
        x, y = last - y, x
    return (np.stack([x, y, z], axis=-1) + VOXEL * lab.voxels[::-1]) * lab.length


def movie(lab, n_frames=1):
    """Return a stack of the laboratory, and its optics."""
    dtype = {"int64": "int32"}.get(lab.dtype, lab.dtype)  # no format has images of int64
    stack = perrin.open_stack(
        moved(lab, recorded(lab.data.seed)[0][:n_frames]).astype(dtype),
        voxel=[VOXEL * lab.length] * 3, dt=lab.dt,
    )  # fmt: skip
    psf = tuple(width * lab.length for width in OPTICS.psf)
    return stack, perrin.Optics(DIAMETER * lab.length, psf, OPTICS.noise)


def true_places(lab, n_frames=1):
    """Return the true positions in the images."""
    return moved_points(lab, lab.forwards(recorded(lab.data.seed)[1][:n_frames]))


def located(lab):
    """Return the distances of the positions found from the true ones."""
    stack, optics = movie(lab)
    length = DIAMETER * lab.length
    found = perrin.locate(stack, diameter=length, contact=length, optics=optics)
    away = np.linalg.norm(found[["x", "y", "z"]].to_numpy()[:, None] - true_places(lab), axis=2)
    return [
        (length + away.min(axis=0), 1, 0),
        (length + found["sigma_z"].to_numpy()[away.argmin(axis=0)], 1, 0),
    ]


def posed(lab):
    """Return how far the fitted poses are from the true ones."""
    stack, optics = movie(lab, 2)
    truth = perrin.track_rotation(true_places(lab, 2), dt=lab.dt)
    found = perrin.fit_pose(stack, truth, optics=optics)
    (first, second), (start, end) = truth.rotation, found.rotation
    return [
        (lab.forwards(np.linalg.norm(found.center - truth.center, axis=1)), 1, 0),
        (np.linalg.norm(end @ start.T - second @ first.T), 0, 0),
    ]


def movie_report(lab):
    stack, _ = movie(lab, FRAMES)
    length = DIAMETER * lab.length
    found = perrin.analyze_stack(stack, diameter=length, contact=length, refine=None)
    (one,) = found.clusters
    return [*estimate(one.D_R), *estimate(one.D_T, 2)]


def rendered(lab):
    """Return the images of moved spheres, moved back."""
    centers = lab.typed(np.rint(true_places(lab, 2) / lab.length / GRID) * GRID * lab.length)
    stack = perrin.render_stack(
        centers[:, lab.arranged(range(4))], voxel=[VOXEL * lab.length] * 3, shape=SHAPE, dt=lab.dt,
        diameter=DIAMETER * lab.length, psf=np.array([0.4, 0.15, 0.15]) * lab.length, noise=False,
        dtype="float64", rng=1,
    )  # fmt: skip
    frames = np.roll(np.stack(list(stack)), -lab.voxels, axis=(1, 2, 3))
    return [
        (lab.forwards(np.rot90(frames, -lab.quarters, axes=(3, 2))), 0, 0),
        (stack.times, 0, 1),
    ]


def read_images(lab):
    """Return a stack that is written and read back."""
    stack, _ = movie(lab, 2)
    with tempfile.TemporaryDirectory() as folder:
        perrin.write_stack(stack, f"{folder}/a.ome.tif")
        with perrin.open_stack(f"{folder}/a.ome.tif") as again:
            frames = np.roll(np.stack(list(again)), -lab.voxels, axis=(1, 2, 3))
            back = lab.forwards(np.rot90(frames, -lab.quarters, axes=(3, 2)))
            return [(back, 0, 0), (again.voxel, 1, 0), (again.times, 0, 1)]


@functools.lru_cache(maxsize=4)
def beads(seed):
    """Return the image of a bead."""
    stack = perrin.render_stack(
        [[[2.0, 2.1, 2.7]]], voxel=(0.2, 0.1, 0.1), shape=(28, 42, 42), diameter=0.1,
        dt=1.0, psf=(0.3, 0.12, 0.12), photons=4000, background=2.0, rng=seed,
    )  # fmt: skip
    return stack.frame(0)


def point_spread(lab):
    images = np.rot90(beads(lab.data.seed)[None], lab.quarters, axes=(3, 2))
    dtype = {"int64": "int32"}.get(lab.dtype, lab.dtype)
    stack = perrin.open_stack(
        images.astype(dtype), voxel=np.array([0.2, 0.1, 0.1]) * lab.length, dt=1.0
    )
    found = perrin.measure_point_spread(stack, diameter=0.1 * lab.length)
    return [(found.fwhm, 1, 0)]


OF_IMAGES = {
    "analyze_stack": Law(movie_report, IMAGES, 1e-4),  # images are added up in single precision
    "fit_pose": Law(posed, IMAGES),
    "locate": Law(located, IMAGES, 1e-5),  # the fit ends at steps below 1e-4 of the blur
    "measure_point_spread": Law(
        point_spread, IMAGES | NO_TIME | {"backwards": "frames are averaged"}
        | {"shift": "beads near a border are left out", "length": "its widths are 0.03 to 0.9 um"},
    ),
    "open_stack": Law(read_images, IMAGES | OF_FILES),
    "render_stack": Law(rendered, IMAGES),
    "write_stack": Law(read_images, IMAGES | OF_FILES),
}  # fmt: skip

LAWS = OF_MOTION | OF_POSITIONS | OF_NUMBERS | OF_IMAGES

# What is written and read is the report of `analyze`, whose law is above: it comes back as it is.
REPORTS = dict.fromkeys(
    ["load_run", "write_run"], "test_results.py::test_a_report_that_is_read_equals_the_written_one"
)

# ---- the laws -----------------------------------------------------------------------------------


@functools.lru_cache(maxsize=256)
def measured(numbers, data, change):
    """Return the numbers of some functions, and the kinds of change that they went through."""
    lab = Laboratory(data, change)
    return numbers(lab), lab.used


def holds(law, data, change):
    """Compare the numbers of a function in a changed laboratory with those before."""
    data, change = applied(data, change, without=law.without)
    known, _ = measured(law.numbers, data, Change())
    found, used = measured(law.numbers, data, change)
    for (value, *powers), (before, p, q) in zip(found, known, strict=True):
        assert powers == [p, q]
        expected = np.asarray(before, dtype=float) * change.length**p * change.time**q
        least = law.rel * np.nanmax(np.abs(expected), initial=0)
        np.testing.assert_allclose(value, expected, rtol=law.rel, atol=least)
    return used


@pytest.mark.parametrize("name", LAWS)
@pytest.mark.usefixtures("no_tensors", "no_verdicts")
def test_numbers_follow_every_change_of_the_laboratory(name, repeats):
    """With --long 25 changes are drawn; otherwise the simplest, which changes everything."""
    if name == "analyze_stack" and not repeats(0, 1):
        pytest.skip("--long: two whole movies, of which tests/test_run.py has others")

    @settings(
        max_examples=repeats(1, 25), derandomize=True, database=None, deadline=None,
        phases=[Phase.generate], suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(cases())
    def every_change(case):
        used = holds(LAWS[name], *case)
        # A change that the numbers do not go through stands among those that do not apply.
        assert used | LAWS[name].without.keys() == set(KINDS)

    every_change()


SLOW = {"analyze", "napari_layers"}
# Functions that take arrays or numbers; for slow ones and images types are drawn with --long.
OF_ARRAYS = [
    name
    for name, law in (OF_POSITIONS | OF_NUMBERS).items()
    if "dtype" not in law.without and name not in SLOW
]


@pytest.mark.parametrize("dtype", ["float32", "int64"])
@pytest.mark.parametrize("name", ["track_rotation", *OF_ARRAYS])
def test_single_precision_and_whole_numbers_are_read_as_they_are(name, dtype):
    """The numbers are those of the same positions in double precision."""
    data = Data(n_frames=24, gaps=frozenset(), absent=None)
    # A unit of 2^10 leaves the numbers of a series the same; single precision has an eps of 1e-7.
    holds(replace(LAWS[name], rel=1e-9), data, Change(length=1024.0, dtype=dtype))


def test_every_public_function_has_laws():
    """It is in the tables above, with a reason for every change that does not apply to it."""
    functions = {n for n in perrin.__all__ if inspect.isfunction(getattr(perrin, n))}
    assert {name.partition(",")[0] for name in LAWS} | REPORTS.keys() == functions
    for name, law in LAWS.items():
        assert law.without.keys() <= set(KINDS), name
    for name, place in REPORTS.items():
        file, _, test = place.partition("::")
        text = (HERE / file).read_text(encoding="utf-8").partition(f"def {test}(")[2]
        assert name in text.partition("\ndef ")[0], place
