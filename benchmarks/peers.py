"""Speed and memory of perrin against other programs, and against a unit of work: batched svds.

Contenders take turns in one process. Times are processor time of one thread (set
OMP_NUM_THREADS=1), the median of five rounds; slow loops are timed on a part and extrapolated,
which their row states. A row either asks that the peer takes at least so many times as long as
perrin, or that perrin takes at most so many times the peer (a unit of work, a memory). The peers
are installed by `pip install 'perrin[bench]'`; rows of peers that are missing are printed as such.

Usage: OMP_NUM_THREADS=1 python benchmarks/peers.py [--quick] [--only WORD ...] [--strict]

--quick takes smaller jobs, one round, and no row that needs minutes; the demands are those of the
whole jobs, so that it gives no verdicts. --only takes some groups of rows: rotations, mean
squares, correlations, simulation, estimates, images, start, memory. --strict exits with status 1
where a demand is not met.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.metadata
import platform
import resource
import subprocess
import sys
import time
import tracemalloc
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

import perrin
from perrin.compiled import kernels_in_use

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

PEERS = ("trackpy", "tidynamics", "mdtraj", "numba")
UNIT = "1e5 batched svds"


class Row(NamedTuple):
    """One line of the table.

    Attributes
    ----------
    job, peer : str
    theirs, ours : callable or float
        The two contenders, or figures that are known already.
    demand : float
        Least ratio peer/ours, or, if `at_most`, largest ratio ours/peer.
    at_most : bool
    rounds : int
    scale : float
        Factor by which the peer's time is extrapolated.
    unit : str
        "s" or "MB".
    """

    job: str
    peer: str
    theirs: Callable[[], object] | float
    ours: Callable[[], object] | float
    demand: float
    at_most: bool = False
    rounds: int = 5
    scale: float = 1.0
    unit: str = "s"


def optional(name):
    """Return a module, or None where it is not installed."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError:
        return None


# ---- rotations ----------------------------------------------------------------------------------


def noisy_tetrahedron(n_frames, seed=0):
    """Return positions of a noisy tetrahedron, the noise 3 % of its radius."""
    truth = perrin.simulate_motion(
        perrin.Cluster.tetrahedron(1.0), D_R=1e-3, D_T=1e-3, dt=1.0, n_frames=n_frames, rng=seed
    )
    return perrin.add_noise(truth.positions(), sigma=0.03, rng=seed + 1)


def batched_svd(points, reference):
    """Solve Hunter 2011, Eqs. 8-10, with numpy's batched SVD."""
    y = points - points.mean(axis=1, keepdims=True)
    x = reference - reference.mean(axis=1, keepdims=True)
    u, _, vt = np.linalg.svd(np.swapaxes(y, 1, 2) @ x)
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
    return u @ vt


def svd_unit(count=100_000):
    """Return the unit of work: rotations of 1e5 tetrahedra by numpy's batched SVD."""
    x = noisy_tetrahedron(count + 1)
    return lambda: batched_svd(x[1:], x[:-1])


def rotations(quick) -> Iterator[Row | str]:
    count = 10_000 if quick else 100_000
    x = noisy_tetrahedron(count + 1)
    job = f"{count:.0e} rotations, n = 4".replace("e+0", "e")
    yield Row(
        f"{job}, successive frames",
        "numpy batched svd",
        lambda: batched_svd(x[1:], x[:-1]),
        lambda: perrin.kabsch(x[1:], x[:-1]),
        20,
    )
    mdtraj = optional("mdtraj")
    if mdtraj is None:
        yield f"{job}, onto one shape: mdtraj"
        return
    topology = mdtraj.Topology()
    residue = topology.add_residue("CLU", topology.add_chain())
    for _ in range(4):
        topology.add_atom("C", mdtraj.element.carbon, residue)
    shape = np.ascontiguousarray(x[0])
    # superpose moves the coordinates in place: moved again, they cost the same.
    trajectory = mdtraj.Trajectory(x[1:].astype(np.float32), topology)
    reference = mdtraj.Trajectory(shape[None].astype(np.float32), topology)
    yield Row(
        f"{job}, onto one shape",
        "mdtraj superpose (float32)",
        lambda: trajectory.superpose(reference),
        lambda: perrin.kabsch(x[1:], shape),
        3,
    )


# ---- curves -------------------------------------------------------------------------------------


def walk_of(n_frames, seed=0):
    """Return a random walk (T, 1, 3)."""
    rng = np.random.default_rng(seed)
    return np.cumsum(rng.normal(size=(n_frames, 1, 3)), axis=0)


def trackpy_table(walk):
    """Return the table that trackpy takes, with the frames that are present."""
    import pandas as pd

    table = pd.DataFrame(walk[:, 0], columns=list("xyz"))
    table["frame"], table["particle"] = np.arange(len(walk)), 0
    return table.dropna(ignore_index=True)


def mean_squares(quick) -> Iterator[Row | str]:
    trackpy, tidynamics = optional("trackpy"), optional("tidynamics")
    for n in (1_000, 10_000) if quick else (10_000, 100_000):
        walk = walk_of(n)
        table, job = trackpy_table(walk), f"MSD, all lags, {n:.0e} frames".replace("e+0", "e")
        ours = lambda walk=walk: perrin.msd(walk, dt=1.0)  # noqa: E731
        if trackpy is None:
            yield f"{job}: trackpy"
        else:
            yield Row(
                job,
                "trackpy.imsd",
                lambda t=table, n=n: trackpy.imsd(t, 1, 1, max_lagtime=n, pos_columns=list("xyz")),
                ours,
                3,
            )
        if tidynamics is None:
            yield f"{job}: tidynamics"
        else:
            yield Row(job, "tidynamics.msd", lambda w=walk: tidynamics.msd(w[:, 0]), ours, 2.5)
    if trackpy is None:
        yield "MSD with 5 % gaps: trackpy"
        return
    n = 300 if quick else 3000
    holes = walk_of(n)
    holes[1:-1][np.random.default_rng(1).random(n - 2) < 0.05] = np.nan
    table = trackpy_table(holes)
    yield Row(
        f"MSD with 5 % gaps, {n} frames",
        "trackpy.imsd",
        lambda: trackpy.imsd(table, 1, 1, max_lagtime=n, pos_columns=list("xyz")),
        lambda: perrin.msd(holes, dt=1.0),
        100,
    )


def correlations(quick) -> Iterator[Row | str]:
    n = 10_000 if quick else 100_000
    motion = perrin.simulate_motion(
        perrin.Cluster.tetrahedron(1.0), D_R=1e-3, dt=1.0, n_frames=n, rng=0
    )
    p = motion.rotation[:, :, 2].copy()
    job = f"C1 and C2 of one direction, all lags, {n:.0e} frames".replace("e+0", "e")
    tidynamics = optional("tidynamics")
    if tidynamics is None:
        yield f"{job}: tidynamics"
    else:
        x, y, z = p.T
        harmonics = np.stack(
            [x * y, y * z, z * x, (x * x - y * y) / 2, (2 * z * z - x * x - y * y) / 12**0.5]
        )
        features = np.ascontiguousarray(np.sqrt(3) * harmonics.T)
        yield Row(
            job,
            "tidynamics.acf, twice",
            lambda: (tidynamics.acf(p), tidynamics.acf(features)),
            lambda: [
                perrin.orientation_correlation(motion, degree=k, directions=[0, 0, 1.0], noise=None)
                for k in (1, 2)
            ],
            3,
        )
    lags, some = n // 10, 10
    yield Row(
        f"quaternion covariance, {n:.0e} frames, {lags} lags".replace("e+0", "e"),
        f"numpy, lag by lag ({some} lags, extrapolated)",
        lambda: covariance_by_lags(motion.rotation, range(1, some + 1)),
        lambda: perrin.quaternion_covariance(motion, n_lags=lags),
        500,
        scale=lags / some,
    )


def covariance_by_lags(rotation, lags):
    """Return the covariance of relative quaternions at each lag, from all pairs of frames."""
    from scipy.spatial.transform import Rotation

    found = []
    for lag in lags:
        relative = np.swapaxes(rotation[:-lag], 1, 2) @ rotation[lag:]
        q = Rotation.from_matrix(relative).as_quat()[:, :3]
        found.append(q.T @ q / len(q))
    return np.array(found)


# ---- simulation and the study of the paper -------------------------------------------------------


def simulate_by_loop(body, D_R, n_frames, rng):
    """Turn a body step by step by three Gaussian Euler angles (Hunter 2011, Eq. 16)."""
    x, frames = body.copy(), np.empty((n_frames, *body.shape))
    for k in range(n_frames):
        frames[k] = x
        a, b, c = rng.normal(scale=np.sqrt(2 * D_R), size=3)
        ca, sa, cb, sb, cc, sc = np.cos(a), np.sin(a), np.cos(b), np.sin(b), np.cos(c), np.sin(c)
        turn_x = np.array([[1, 0, 0], [0, ca, -sa], [0, sa, ca]])
        turn_y = np.array([[cb, 0, sb], [0, 1, 0], [-sb, 0, cb]])
        turn_z = np.array([[cc, -sc, 0], [sc, cc, 0], [0, 0, 1]])
        x = x @ (turn_z @ turn_y @ turn_x).T
    return frames


def study_by_script(n_frames, lags):
    """Simulate, add noise, find rotations, and the MSAD of four directions at `lags`."""
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(0)
    body = perrin.Cluster.tetrahedron(1.0).positions
    x = simulate_by_loop(body, 1e-3, n_frames, rng)
    x += rng.normal(scale=0.01, size=x.shape)
    x -= x.mean(axis=1, keepdims=True)
    start = time.process_time()
    p = [body]
    for a, b in zip(x[1:], x[:-1], strict=True):
        p.append(p[-1] @ Rotation.align_vectors(a, b)[0].as_matrix().T)
    p = np.array(p)
    turned = np.zeros_like(p)
    turned[1:] = np.cross(p[:-1], p[1:]).cumsum(axis=0)
    once = time.process_time() - start
    start = time.process_time()
    for lag in lags:
        np.mean(np.sum((turned[lag:] - turned[:-lag]) ** 2, axis=-1))
    return once, time.process_time() - start


def study_by_perrin(n_frames):
    """Do the same with perrin: successive rotations, the mean over the four directions."""
    truth = perrin.simulate_motion(
        perrin.Cluster.tetrahedron(1.0), D_R=1e-3, dt=1.0, n_frames=n_frames, rng=0
    )
    x = perrin.add_noise(truth.positions(), sigma=0.01, rng=1)
    return perrin.msad(perrin.track_rotation(x, dt=1.0, reference="previous"))


def simulation(quick) -> Iterator[Row | str]:
    n = 1_000 if quick else 10_000
    body = perrin.Cluster.tetrahedron(1.0)
    yield Row(
        f"simulation, {n:.0e} steps".replace("e+0", "e"),
        "the paper's scheme, step by step",
        lambda: simulate_by_loop(body.positions, 1e-3, n, np.random.default_rng(0)),
        lambda: perrin.simulate_motion(body, D_R=1e-3, dt=1.0, n_frames=n, rng=0).positions(),
        10,
    )
    lags = list(range(1, n, n // 20))
    start = time.process_time()
    _, squares = study_by_script(n, lags)
    total = time.process_time() - start + squares * (n / len(lags) - 1)
    yield Row(
        f"one case of the paper's study, {n:.0e} steps, all lags".replace("e+0", "e"),
        f"scipy and numpy, step by step ({len(lags)} lags, extrapolated)",
        total,
        lambda: study_by_perrin(n),
        60,
    )


# ---- estimates ----------------------------------------------------------------------------------


def tetrahedra_table(clusters, n_frames, seed=0):
    """Return a table of labelled tetrahedra of touching spheres."""
    import pandas as pd

    body, parts = perrin.Cluster.touching(4, 2.45), []
    for c in range(clusters):
        truth = perrin.simulate_motion(
            body, D_R=4.93e-3, D_T=3.85e-2, dt=0.73, n_frames=n_frames, rng=seed + 2 * c
        )
        x = perrin.add_noise(truth.positions(), sigma=0.03, rng=seed + 2 * c + 1)
        x += 20.0 * np.array([c % 30, c // 30, 0.0])
        frame = np.repeat(np.arange(n_frames), 4)
        particle = np.tile(np.arange(4), n_frames) + 4 * c
        columns = {"frame": frame, "particle": particle, "cluster": c}
        parts.append(pd.DataFrame(columns | dict(zip("xyz", x.reshape(-1, 3).T, strict=True))))
    return pd.concat(parts, ignore_index=True)


def estimates(quick) -> Iterator[Row | str]:
    unit = svd_unit()
    clusters = 10 if quick else 200
    table = tetrahedra_table(clusters, 300)
    yield Row(
        f"analyze, {clusters} labelled tetrahedra x 300 frames",
        UNIT,
        unit,
        lambda: perrin.analyze(table, dt=0.73),
        8 * clusters / 200,
        at_most=True,
        rounds=3,
    )
    n = 3_000 if quick else 100_000
    x = noisy_tetrahedron(n)
    x[np.random.default_rng(2).random(n) < 0.05] = np.nan
    motion = perrin.track_rotation(x, dt=1.0)
    frames = f"{n:.0e} frames with gaps".replace("e+0", "e")

    def with_intervals():
        found = perrin.estimate_diffusion(motion)
        return found.ci68, found.ci95

    yield Row(f"D_R with both intervals, {frames}", UNIT, unit, with_intervals, 1, at_most=True)
    yield Row(
        f"tensor with errors and tests, {frames}",
        UNIT,
        unit,
        lambda: perrin.diffusion_tensor(motion),
        4,
        at_most=True,
        rounds=3,
    )


# ---- images -------------------------------------------------------------------------------------


def position_error(found, truth):
    """Return the rms error of a coordinate, nm, of the spheres that were found."""
    away = found[:, None] - truth.reshape(-1, 3)
    nearest = np.linalg.norm(away, axis=2).argmin(axis=1)
    return 1e3 * np.sqrt(np.mean(away[np.arange(len(found)), nearest] ** 2))


def images(quick) -> Iterator[Row | str]:
    trackpy = optional("trackpy")
    if trackpy is None:
        yield "a field frame, found, refined and posed: trackpy"
        return
    from end_to_end import BODY, DIAMETER, VOXEL, rendered

    from perrin.images.optics.window_fit import RigidCenters
    from perrin.images.spheres.by_trackpy import refine_by_trackpy
    from perrin.images.spheres.localisation import Search, choose_method, sample_frames
    from perrin.images.spheres.poses import pose_in

    small = {"clusters": 3, "shape": (48, 128, 128)} if quick else {}
    stack, truth = rendered(n_frames=2, **small)
    search = Search(diameter=DIAMETER, contact=DIAMETER)
    method = choose_method(stack, search, sample_frames(stack, search, range(2)))
    image, voxel = method.optics.image(tuple(VOXEL)), tuple(float(h) for h in VOXEL)
    frame = np.asarray(stack.frame(0), dtype=np.float64)
    starts = [
        RigidCenters(x.mean(axis=0) + 0.05, perrin.kabsch(x, BODY.positions), BODY.positions)
        for x in truth[:, 0]
    ]

    def ours():
        columns = method.locate_in(stack, 0).columns
        places = np.stack([columns[axis] for axis in "xyz"], axis=1)
        for start in starts:
            others = places[np.linalg.norm(places - start.center, axis=1) > DIAMETER]
            pose_in(frame, start, image, method.optics.noise, others=others)
        return places

    size = tuple(int(n) + 1 - int(n) % 2 for n in np.ceil(DIAMETER / VOXEL))
    separation = tuple(0.7 * DIAMETER / VOXEL)

    def theirs():
        found = trackpy.locate(
            frame, size, separation=separation, minmass=method.search.minmass, characterize=False
        )
        centers = found[["z", "y", "x"]].to_numpy() * VOXEL
        return refine_by_trackpy(frame, centers, diameter=DIAMETER, contact=DIAMETER, voxel=voxel)[
            :, ::-1
        ]

    print(f"errors of positions, nm: trackpy {position_error(theirs(), truth[:, 0]):.1f}, "
          f"perrin {position_error(ours(), truth[:, 0]):.1f}", file=sys.stderr)  # fmt: skip
    yield Row(
        f"a frame of {frame.shape}, {len(truth)} tetrahedra: found, refined, posed",
        "trackpy.locate + refine_leastsq",
        theirs,
        ours,
        4,
        rounds=3,
    )


# ---- start-up and memory ------------------------------------------------------------------------


def seconds_of(*command):
    """Return processor seconds of a process and of those that it starts."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, *command], check=True, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime


def process_of(*command):
    """Return a contender that is a process."""
    return lambda: seconds_of(*command)


def start_up(quick) -> Iterator[Row | str]:
    del quick
    if optional("trackpy") is None:
        yield "import perrin: trackpy"
    else:
        code = ("-c", "import trackpy")
        yield Row(
            "import perrin", "import trackpy", process_of(*code),
            process_of("-c", "import perrin"), 8,
        )  # fmt: skip
    numpy = ("-c", "import numpy")
    yield Row("import perrin", "import numpy", process_of(*numpy),
              process_of("-c", "import perrin"), 1.5, at_most=True)  # fmt: skip
    yield Row("perrin --help", "import numpy", process_of(*numpy),
              process_of("-m", "perrin.cli", "--help"), 5, at_most=True)  # fmt: skip
    code = "import perrin, sys; perrin.analyze(sys.argv[1], dt=0.73)"
    from importlib.resources import files

    demo = str(files("perrin") / "data" / "demo_tracks.csv.gz")
    yield Row("read and analyze 300 frames", "import numpy, pandas",
              process_of("-c", "import numpy, pandas"), process_of("-c", code, demo),
              4, at_most=True)  # fmt: skip


_MEMORY_OF_ANALYZE = """
import re, resource, sys
sys.path.insert(0, sys.argv[1])
from peers import tetrahedra_table
import perrin, perrin.run, scipy.stats, scipy.linalg, scipy.fft, scipy.spatial, scipy.optimize
perrin.analyze(tetrahedra_table(2, 50), dt=0.73)
table = tetrahedra_table(int(sys.argv[2]), 300)
before = int(open("/proc/self/statm").read().split()[1]) * resource.getpagesize()
perrin.analyze(table, dt=0.73)
# ru_maxrss would be that of the process that started this one, where it had more.
peak = int(re.search(r"VmHWM:\\s+(\\d+)", open("/proc/self/status").read())[1]) * 1024
print((peak - before) / 1e6, table.memory_usage(deep=True).sum() / 1e6)
"""


def memory(quick) -> Iterator[Row | str]:
    walk = walk_of(10_000 if quick else 100_000)
    tracemalloc.start()
    perrin.msd(walk, dt=1.0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    yield Row(
        f"memory of an MSD of {len(walk):.0e} frames".replace("e+0", "e"),
        "the track", walk.nbytes / 1e6, peak / 1e6, 6, at_most=True, unit="MB",
    )  # fmt: skip
    if quick:
        return
    command = [sys.executable, "-c", _MEMORY_OF_ANALYZE, sys.path[0], "1000"]
    found = subprocess.run(command, check=True, capture_output=True, text=True)
    more, table = map(float, found.stdout.split())
    yield Row(
        "memory of analyze, 1.2 million rows", "the table", table, more, 8, at_most=True, unit="MB"
    )


# ---- the table ----------------------------------------------------------------------------------

SECTIONS = {
    "rotations": rotations, "mean squares": mean_squares, "correlations": correlations,
    "simulation": simulation, "estimates": estimates, "images": images, "start": start_up,
    "memory": memory,
}  # fmt: skip


def timed(work):
    """Return the seconds of one call; a process returns its own."""
    start = time.process_time()
    own = work()
    return own if isinstance(own, float) else time.process_time() - start


def measured(row, rounds):
    """Return the figures of the peer and of perrin."""
    contenders = {"theirs": row.theirs, "ours": row.ours}
    known = {k: v for k, v in contenders.items() if not callable(v)}
    figures = {k: [] for k in contenders if k not in known}
    for work in [contenders[k] for k in figures] if row.rounds > 3 else []:
        work()  # the first call loads modules and compiles
    for _ in range(min(rounds, row.rounds)):
        for name in figures:
            figures[name].append(timed(contenders[name]))
    known |= {k: float(np.median(v)) for k, v in figures.items()}
    return known["theirs"] * row.scale, known["ours"]


def in_words(value, unit):
    """Return a figure with its unit."""
    if unit == "s":
        return f"{value:.3g} s" if value >= 1 else f"{1e3 * value:.3g} ms"
    return f"{value:.3g} {unit}"


def line_of(row, quick):
    """Return the row's line of the table, and whether its demand is met (in the whole job)."""
    theirs, ours = measured(row, 1 if quick else 5)
    ratio = ours / theirs if row.at_most else theirs / ours
    met = ratio <= row.demand if row.at_most else ratio >= row.demand
    wanted = f"at most {row.demand:.3g}" if row.at_most else f"at least {row.demand:.3g}"
    name = "ours/peer" if row.at_most else "peer/ours"
    verdict = "not judged" if quick else "met" if met else "NOT MET"
    cells = (
        row.job, row.peer, in_words(theirs, row.unit), in_words(ours, row.unit),
        f"{ratio:.3g} ({name})", wanted, verdict,
    )  # fmt: skip
    return f"| {' | '.join(cells)} |", met or quick


def versions():
    """Return what was measured with, in one line."""
    names = ("numpy", "scipy", "pandas", *PEERS)
    found = []
    for name in names:
        try:
            found.append(f"{name} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            found.append(f"{name} missing")
    return f"Python {platform.python_version()}, {', '.join(found)}; kernels {kernels_in_use()}"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--only", nargs="*", default=list(SECTIONS), choices=SECTIONS)
    parser.add_argument("--strict", action="store_true")
    given = parser.parse_args()
    print(versions())
    print("| job | peer | peer takes | perrin takes | ratio | demand | verdict |")
    print("|---|---|---|---|---|---|---|")
    missing, all_met = [], True
    for name, section in SECTIONS.items():
        if name not in given.only:
            continue
        for row in section(given.quick):
            if isinstance(row, str):
                missing.append(row)
                continue
            line, met = line_of(row, given.quick)
            all_met &= met
            print(line, flush=True)
    for row in missing:
        print(f"not measured, its peer is not installed: {row}")
    return int(given.strict and not all_met)


if __name__ == "__main__":
    raise SystemExit(main())
