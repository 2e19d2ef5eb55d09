"""Hunter et al. 2011, sections 1 to 3: recovery of a known rotation, and the simulation."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from perrin.errors import DegenerateClusterError
from perrin.geometry.rotations import axis_angle, kabsch, similarity, successive_product
from perrin.geometry.shapes import Cluster, pair_distances
from perrin.motion.simulate import add_noise, simulate_motion
from perrin.motion.tracking import track_rotation
from perrin.paper.claims import Claim, Item, Study, statistical
from perrin.plot.figure_style import PALETTE
from perrin.plot.results import plot_cluster

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from perrin._arrays import Floats, Ints


# Distance of a particle to the centre, um. The paper does not print it; this value is that of
# touching spheres of 2 um, as in its Fig. 1.
R = Cluster.touching(4, 2.0).R

# Localisation errors that the paper simulates, um.
NOISES = (0.01, 0.03, 0.05, 0.07, 0.10)

# Steps of the paper's simulations.
STEPS = 10_000

_CHALLIS = "2.1 Challis' procedure"
_CLUSTERS = "2.2 Application to colloidal clusters"
_TESTS = "3 Tests of the prescribed method"


def challis(study: Study) -> Item:
    """Fit planted transformations, noise-free and noisy, for 3 to 7 points (Eqs. 1-10).

    Parameters
    ----------
    study : Study

    Returns
    -------
    Item
    """
    rng = study.rng("challis")
    table = pd.DataFrame([transformation_errors(n, rng=rng) for n in range(3, 8)])
    angle, rise = cost_rise(rng)
    line = rng.normal(size=(200, 1, 3)) * rng.normal(size=(200, 5, 1))
    pair = rng.normal(size=(200, 2, 3))
    refused = _degenerate_sets(line) + _degenerate_sets(pair)
    worst, section, rounding = table.max(), "section 2.1", "rounding"
    claims = (
        Claim("y = s R x + v: largest error of s, R and v, 1000 noise-free sets of 3 to 7 points",
              f"Eq. 1, {section}", 0.0, worst["similarity"], 1e-12, rounding),
        Claim("y = R x (s = 1, v = 0): largest error of R", f"Eq. 2, {section}", 0.0,
              worst["rotation"], 1e-12, rounding),
        Claim("R R^T = E: largest deviation, noisy sets", f"Eq. 3, {section}", 0.0,
              worst["orthonormal"], 1e-12, rounding),
        Claim("det R = +1: largest deviation, noisy, planar and mirrored sets",
              f"Eq. 4, {section}", 0.0, worst["determinant"], 1e-12, rounding),
        Claim("R minimises the squared distance: share of 25 000 turned rotations that fit better",
              f"Eq. 5, {section}", 0.0, float(np.mean(rise < 0)), 0.0, "exact"),
        Claim("the sum of squares is sum(y.y + x.x) - 2 Tr(R^T C): largest relative difference",
              f"Eqs. 6-8, {section}", 0.0, worst["expansion"], 1e-12, rounding),
        Claim("R = U diag(1, 1, det(U V^T)) V^T of C = U W V^T: largest difference, noisy sets",
              f"Eqs. 9-10, {section}", 0.0, worst["svd"], 1e-9, rounding),
        Claim("all non-collinear sets with n >= 3 are solved: share of 1000", f"{section}", 1.0,
              float(table["solved"].mean()), 0.0, "exact"),
        Claim("collinear sets and pairs are refused: share of 400", f"{section}", 1.0,
              refused / 400, 0.0, "exact"),
    )  # fmt: skip

    def draw(figure: Figure) -> None:
        left, right = figure.subplots(1, 2)
        labels = {
            "similarity": "s, R, v (Eq. 1)",
            "rotation": "R (Eq. 2)",
            "svd": "noisy: R compared with the SVD (Eqs. 9-10)",
        }
        for color, (name, label) in zip(PALETTE, labels.items(), strict=False):
            left.semilogy(table["n"], table[name], "o-", color=color, label=label)
        left.set(xlabel="points n", ylabel="largest error in 200 sets", ylim=(1e-16, 1e-11))
        left.set_xticks(table["n"])
        left.legend(frameon=False)
        right.loglog(np.rad2deg(angle), rise, ".", ms=2, color=PALETTE[0], rasterized=True)
        right.set(xlabel="turned away from R (degrees)")
        right.set_ylabel("rise of the squared distance (relative)")

    text = (
        "Random sets of points are scaled, turned and shifted by known amounts; `similarity` and "
        "`kabsch` find the transformation again. Noisy sets have noise of a tenth of their size; "
        "Eqs. 9-10 are evaluated with numpy's SVD and compared with `kabsch`, which uses none."
    )
    return Item("challis", _CHALLIS, "Rigid transformations", text, table, draw, claims)


def transformation_errors(n: int, *, rng: np.random.Generator) -> dict[str, float]:
    """Return the largest errors of fitted transformations over 200 sets of n points.

    Parameters
    ----------
    n : int
        Number of points in a set.
    rng : numpy.random.Generator

    Returns
    -------
    dict
        The number of points; the largest error of s, R and v of noise-free sets ("similarity"), of
        R alone ("rotation"), and for noisy sets the deviation from an orthogonal matrix of
        determinant 1, from the expanded sum of squares and from Eq. 10; the share of sets that
        were solved.

    Examples
    --------
    >>> errors = transformation_errors(4, rng=np.random.default_rng(1))
    >>> errors["similarity"] < 1e-12, errors["solved"]
    (True, 1.0)
    """
    x = rng.normal(size=(200, n, 3))
    planted = random_rotations(200, rng)
    s, v = rng.uniform(0.5, 2.0, 200), rng.normal(size=(200, 3))
    turned = np.einsum("kij,knj->kni", planted, x)
    found = similarity(s[:, None, None] * turned + v[:, None], x)
    error = max(np.abs(found.s - s).max(), np.abs(found.R - planted).max(),
                np.abs(found.v - v).max())  # fmt: skip
    y = turned + 0.1 * rng.normal(size=x.shape)
    fitted = kabsch(y, x)
    y0, x0 = y - y.mean(1, keepdims=True), x - x.mean(1, keepdims=True)
    dispersion = np.einsum("kni,knj->kij", y0, x0)
    square = np.sum((y0 - np.einsum("kij,knj->kni", fitted, x0)) ** 2, axis=(1, 2))
    sizes = np.sum(y0**2 + x0**2, axis=(1, 2))
    expanded = sizes - 2 * np.einsum("kij,kij->k", fitted, dispersion)
    # A reflection would fit better to planar sets and to mirror images.
    flat, mirrored = x * [1.0, 1.0, 0.0], x * [1.0, 1.0, -1.0]
    special = np.concatenate([fitted, kabsch(flat, y), kabsch(mirrored, x)])
    return {
        "n": n,
        "similarity": float(error),
        "rotation": float(np.abs(kabsch(turned, x) - planted).max()),
        "orthonormal": float(np.abs(fitted @ np.swapaxes(fitted, 1, 2) - np.eye(3)).max()),
        "determinant": float(np.abs(np.linalg.det(special) - 1).max()),
        "expansion": float(np.abs((square - expanded) / sizes).max()),
        "svd": float(np.abs(fitted - svd_rotation(dispersion)).max()),
        "solved": float(np.isfinite(fitted).all(axis=(1, 2)).mean()),
    }


def svd_rotation(dispersion: Floats) -> Floats:
    """Return the rotations of Eq. 10, evaluated as printed.

    Parameters
    ----------
    dispersion : array of shape (k, 3, 3)
        C = sum(y x^T) of each set, points measured from their mean.

    Returns
    -------
    array of shape (k, 3, 3)

    Examples
    --------
    >>> svd_rotation(2.0 * np.eye(3)[None])[0].round(12).tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    u, _, vt = np.linalg.svd(dispersion)
    middle = np.ones((len(u), 3))
    middle[:, 2] = np.linalg.det(u @ vt)
    return np.asarray((u * middle[:, None]) @ vt)


def cost_rise(rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Return how the squared distance (Eq. 5) rises around its minimum.

    Parameters
    ----------
    rng : numpy.random.Generator

    Returns
    -------
    angle : array of shape (25000,)
        Angles of 25 000 rotations from the fitted ones, rad.
    rise : array of shape (25000,)
        Their squared distance over that of the fitted rotation, less 1.

    Examples
    --------
    >>> angle, rise = cost_rise(np.random.default_rng(1))
    >>> bool(rise.min() >= 0)
    True
    """
    x = rng.normal(size=(500, 4, 3))
    y = x + 0.1 * rng.normal(size=x.shape)
    y, x = y - y.mean(1, keepdims=True), x - x.mean(1, keepdims=True)
    angle = 10.0 ** rng.uniform(-3, 0, (500, 50))
    axis = unit(rng.normal(size=(500, 50, 3)))
    turn = Rotation.from_rotvec((angle[..., None] * axis).reshape(-1, 3)).as_matrix()
    fitted = kabsch(y, x)
    moved = turn.reshape(500, 50, 3, 3) @ fitted[:, None]
    best = np.sum((y - np.einsum("kij,knj->kni", fitted, x)) ** 2, axis=(1, 2))
    cost = np.sum((y[:, None] - np.einsum("krij,knj->krni", moved, x)) ** 2, axis=(2, 3))
    return angle.ravel(), (cost / best[:, None] - 1).ravel()


def _degenerate_sets(points: Floats) -> int:
    """Return the number of sets whose rotation `kabsch` does not determine."""
    try:
        kabsch(points, points)
    except DegenerateClusterError as error:
        return len(error.indices)
    return 0


def product(study: Study) -> Item:
    """Reconstruct trajectories from successive rotations, without and with noise (Eqs. 11-13).

    Parameters
    ----------
    study : Study

    Returns
    -------
    Item
    """
    rng = study.rng("product")
    truth = simulate_motion(Cluster.tetrahedron(R), D_R=1e-3, D_T=0.01, dt=1.0,
                            n_frames=STEPS + 1, scheme="euler", rng=rng)  # fmt: skip
    x = truth.positions()
    chain = track_rotation(x, dt=1.0, reference="previous")
    common = track_rotation(x, dt=1.0)
    center = float(np.abs(chain.center - x.mean(axis=1)).max())
    template = float(np.abs(common.positions() - x).max())
    previous = float(np.abs(chain.positions() - x).max())
    steps, repeats = log_lags(5000, 30), study.repeats(200)
    drift = [accumulated_error(r, steps, repeats=repeats, rng=rng) for r in (0.02, 0.05)]
    table = pd.concat(drift, ignore_index=True)
    closed = "1e4 noise-free steps (um)"
    claims = [
        Claim(f"the centre of mass is the mean of the particles, {closed}", "Eq. 11, section 2.2",
              0.0, center, 1e-10, "1e-10 um"),
        Claim(f"x_i = R x_i^0, {closed}", "Eq. 12, section 2.2", 0.0, template, 1e-10,
              "1e-10 um"),
        Claim(f"x_i(t) is the product of successive rotations on x_i^0, {closed}",
              "Eq. 13, section 2.2", 0.0, previous, 1e-10, "1e-10 um"),
    ]  # fmt: skip
    expected = ((0.02, 1.72, 2.3, 1.2), (0.05, 4.30, 11.7, 3.0))
    for part, (ratio, one, late, fitted) in zip(drift, expected, strict=True):
        last = part.iloc[-1]
        source, where = "Eq. 13, section 2.2", f"sigma/R = {ratio}"
        # 8 repeats of 1000 frames with 3 angles each, twice.
        growth_error = float(np.sqrt(2 * 2 / (3 * 8000)) / 2)
        claims += [
            Claim(f"noise of one step (degrees), {where}", source, one, last["one_step_deg"],
                  0.08 * one, "8 %"),
            Claim(f"rms error of the product after 5000 steps (degrees), {where}", source, late,
                  last["product_deg"], 0.2 * late, "20 %"),
            Claim("the product reconstructs the entire trajectory: rms error after 5000 steps "
                  f"over that of one, {where}", source, 1.0,
                  last["product_deg"] / last["one_step_deg"], 0.1, "10 %",
                  "The errors of successive rotations do not cancel at second order: after 5000 "
                  f"steps the product is {last['product_deg']:.1f} degrees off, one step "
                  f"{last['one_step_deg']:.2f}."),
            Claim(f"rms error of the fit to a common shape (degrees), {where}", source, fitted,
                  last["common_deg"], 0.05, "rounding"),
            statistical("the common shape's error does not grow: last over first 1000 of 5000 "
                        f"steps, {where}", source, expected=1.0, measured=last["common_growth"],
                        stderr=growth_error),
        ]  # fmt: skip

    def draw(figure: Figure) -> None:
        ax = figure.subplots()
        for color, part in zip(PALETTE, drift, strict=False):
            ratio = part["sigma_over_R"].iloc[0]
            ax.loglog(part["steps"], part["product_deg"], "-", color=color, lw=1.5,
                      label=f"product of rotations, σ/R = {ratio}")  # fmt: skip
            ax.loglog(part["steps"], part["common_deg"], "--", color=color, lw=1.5,
                      label=f"common shape, σ/R = {ratio}")  # fmt: skip
        ax.set(xlabel="steps", ylabel="rms angle to the planted orientation (degrees)")
        ax.set_yticks([1, 2, 5, 10], ["1", "2", "5", "10"])
        ax.set_yticks([], minor=True)
        ax.legend(frameon=False)

    text = (
        "A tetrahedron that diffuses and turns for 10^4 steps (Eq. 16) without noise, by "
        '`track_rotation(reference="previous")`; then a stationary one with noise: rms angle '
        "between fitted and planted orientation (the identity) against the number of steps, 200 "
        "repeats of the product, 8 of the fit to one common shape."
    )
    return Item("product", _CLUSTERS, "The product of successive rotations", text, table, draw,
                tuple(claims), size=(6.5, 4.6))  # fmt: skip


def accumulated_error(
    ratio: float, steps: Ints, *, repeats: int, rng: np.random.Generator
) -> pd.DataFrame:
    """Return the orientation error of a stationary tetrahedron against the number of steps.

    Parameters
    ----------
    ratio : float
        Localisation error over the distance of the particles to the centre.
    steps : array of int
        Numbers of steps; the last is the longest.
    repeats : int
        Number of simulated tracks, at least 8.
    rng : numpy.random.Generator

    Returns
    -------
    pandas.DataFrame
        Rms angles in degrees: of the product of successive rotations after each number of steps,
        of one step, and of the fit to a common shape; and the ratio of the latter in the last 1000
        steps to that in the first 1000.
    """
    body = Cluster.tetrahedron(1.0)
    still = np.broadcast_to(body.positions, (int(steps[-1]) + 1, 4, 3))
    square, one, common = np.zeros(len(steps)), 0.0, []
    for repeat in range(repeats):
        x = add_noise(still, sigma=ratio, rng=rng)
        step = kabsch(x[1:], x[:-1])
        orientation = successive_product(step)
        square += axis_angle(orientation[steps])[1] ** 2 / repeats
        one += float(np.mean(axis_angle(step)[1] ** 2)) / repeats
        if repeat < 8:
            fitted = track_rotation(x, dt=1.0).positions()
            common.append(axis_angle(kabsch(fitted, body.positions))[1])
    angles = np.stack(common)
    parts = [np.mean(part**2) for part in (angles, angles[:, :1000], angles[:, -1000:])]
    table = pd.DataFrame({"sigma_over_R": ratio, "steps": steps})
    table["product_deg"] = np.rad2deg(np.sqrt(square))
    table["one_step_deg"] = np.rad2deg(np.sqrt(one))
    table["common_deg"] = np.rad2deg(np.sqrt(parts[0]))
    table["common_growth"] = np.sqrt(parts[2] / parts[1])
    return table


def localisation(study: Study) -> Item:
    """Evaluate the least localisation error, a pixel over the object's width (section 3).

    Parameters
    ----------
    study : Study
        Not used.

    Returns
    -------
    Item
    """
    del study
    width = np.arange(5, 31)
    table = pd.DataFrame({"width_px": width, "limit_nm": 1e3 * 0.2 / width})
    limit = float(table["limit_nm"][width == 10].iloc[0])
    low, high = 1e3 * min(NOISES), 1e3 * max(NOISES)
    covered = (min(high, 60.0) - max(low, 20.0)) / (60.0 - 20.0)
    claims = (
        Claim("least uncertainty of a 10 pixel object at 0.2 um per pixel (nm)", "section 3",
              20.0, limit, 1e-9, "rounding"),
        Claim("the levels studied (10-100 nm) cover the typical 20-60 nm: share covered",
              "section 3", 1.0, covered, 0.0, "exact"),
    )  # fmt: skip

    def draw(figure: Figure) -> None:
        ax = figure.subplots()
        ax.axhspan(20, 60, color="#dddddd", lw=0, label="typical in experiments")
        ax.plot(table["width_px"], table["limit_nm"], color=PALETTE[0],
                label="(0.2 µm per pixel)/N")  # fmt: skip
        ax.plot(10, limit, "o", mfc="white", mec=PALETTE[0], ms=8, label="the paper's example")
        for sigma in NOISES:
            ax.axhline(1e3 * sigma, color=PALETTE[1], lw=0.8, ls=":")
        ax.plot([], [], ":", color=PALETTE[1], lw=0.8, label="levels simulated")
        ax.set(xlabel="width of the object N (pixels)", ylabel="localisation error (nm)")
        ax.set(ylim=(0, 110), xlim=(5, 30))
        ax.legend(frameon=False, loc="upper right", bbox_to_anchor=(1, 0.9))

    text = "(um per pixel)/N: the rule of thumb that the paper states."
    return Item("localisation", _TESTS, "Localisation error", text, table, draw, claims,
                size=(6.5, 4.2))  # fmt: skip


def simulation(study: Study) -> Item:
    """Check the simulation's bodies, angles and noise (Eqs. 14-16).

    Parameters
    ----------
    study : Study

    Returns
    -------
    Item
    """
    rng, D = study.rng("simulation"), 1e-3
    bodies = {"tetrahedron": Cluster.tetrahedron(R), "pentahedron": Cluster.pentahedron(R)}
    angles = {}
    for name, body in bodies.items():
        truth = simulate_motion(body, D_R=study.planted(D), dt=1.0, n_frames=STEPS + 1,
                                scheme="euler", rng=rng)  # fmt: skip
        step = truth.rotation[1:] @ np.swapaxes(truth.rotation[:-1], 1, 2)
        # Upper-case letters mean rotations about the turned axes: R_x R_y R_z.
        angles[name] = Rotation.from_matrix(step).as_euler("XYZ") / np.sqrt(2 * D)
    table = pd.concat(
        [pd.DataFrame(a, columns=["alpha", "beta", "gamma"]).assign(body=n)
         for n, a in angles.items()], ignore_index=True,
    )  # fmt: skip
    claims = [
        Claim("coordinates of the tetrahedron: largest deviation (um)", "Eq. 14, section 3", 0.0,
              _coordinate_error(bodies["tetrahedron"], _PRINTED_TETRAHEDRON), 1e-12, "rounding"),
        Claim("coordinates of the pentahedron: largest deviation (um)", "Eq. 15, section 3", 0.0,
              _coordinate_error(bodies["pentahedron"], _PRINTED_PENTAHEDRON), 1e-12, "rounding"),
    ]  # fmt: skip
    for name, a in angles.items():
        claims.append(
            statistical(f"standard deviation of the angles of R_x R_y R_z over sqrt(2 D_R), {name}",
                        "Eq. 16, section 3", expected=1.0, measured=float(a.std()),
                        stderr=float(1 / np.sqrt(2 * a.size)))
        )  # fmt: skip
    still = np.broadcast_to(Cluster.tetrahedron(R).positions, (STEPS, 4, 3))
    ratio = [float((add_noise(still, sigma=s, rng=rng) - still).std()) / s for s in NOISES]
    count = still.size * len(NOISES)
    claims.append(
        statistical("standard deviation of the noise added over sigma_x, mean of five levels",
                    "section 3", expected=1.0, measured=float(np.mean(ratio)),
                    stderr=float(1 / np.sqrt(2 * count)))
    )  # fmt: skip

    def draw(figure: Figure) -> None:
        ax = figure.subplots()
        x = np.linspace(-4, 4, 200)
        values = table[["alpha", "beta", "gamma"]].to_numpy()
        ax.hist(values, 60, range=(-4, 4), density=True, histtype="step", color=PALETTE[:3],
                label=["α about x", "β about y", "γ about z"])  # fmt: skip
        ax.plot(x[::8], np.exp(-x[::8] ** 2 / 2) / np.sqrt(2 * np.pi), "o", mfc="none",
                mec="#222222", label="Gaussian")  # fmt: skip
        ax.set(xlabel="angle of a step / $(2 D_R)^{1/2}$", ylabel="probability density")
        ax.legend(frameon=False)

    text = (
        f"Tetrahedra and pentahedra exactly as printed, R = {R:.3f} um (touching spheres of 2 um: "
        "the paper does not print R), 10^4 steps of three Gaussian angles, multiplied as "
        "R_x R_y R_z, and Gaussian noise of 10, 30, 50, 70 and 100 nm."
    )
    return Item("simulation", _TESTS, "The simulation", text, table, draw, tuple(claims),
                size=(6.5, 4.2))  # fmt: skip


_PRINTED_TETRAHEDRON = np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)]) / np.sqrt(3)

_PRINTED_PENTAHEDRON = np.array(
    [(1, 0, 0), (-1 / 2, np.sqrt(3) / 2, 0), (-1 / 2, -np.sqrt(3) / 2, 0), (0, 0, 1), (0, 0, -1)]
)


def _coordinate_error(body: Cluster, printed: Floats) -> float:
    """Return the largest distance (um) of a particle to the nearest printed one, and reverse."""
    distance = np.linalg.norm(body.positions[:, None] - R * printed, axis=2)
    return float(max(distance.min(axis=0).max(), distance.min(axis=1).max()))


def figure_1(study: Study) -> Item:
    """Draw clusters of 4, 5 and 6 touching spheres (Fig. 1).

    Parameters
    ----------
    study : Study
        Not used.

    Returns
    -------
    Item
    """
    del study
    bodies = [Cluster.touching(n, 2.0) for n in (4, 5, 6)]
    parts = [
        pd.DataFrame(b.positions, columns=["x", "y", "z"]).assign(n=len(b.positions))
        for b in bodies
    ]
    pairs = [pair_distances(b.positions) for b in (bodies[1], Cluster.pentahedron(R))]
    spread = [float(distance.max() / distance.min()) for distance in pairs]
    remark = (
        f"The bipyramid of five touching spheres is longer than Eq. 15: its largest distance is "
        f"{spread[0]:.3f} times its smallest, that of Eq. 15 {spread[1]:.3f} times."
    )
    claims = (
        Claim("n = 4 is the simulated tetrahedron: R of touching 2 um spheres (um)",
              "Fig. 1, section 1", R, bodies[0].R, 1e-12, "exact"),
        Claim("n = 5 is accurately the simulated pentahedron: largest over smallest distance "
              "between particles", "Fig. 1, section 1", spread[0], spread[1], 0.02, "2 %", remark),
    )  # fmt: skip

    def draw(figure: Figure) -> None:
        view = Rotation.from_euler("xyz", [-65, 20, 10], degrees=True).as_matrix()
        for ax, body in zip(figure.subplots(1, 3), bodies, strict=True):
            plot_cluster(body, ax=ax, diameter=2.0, view=view)
            ax.set(title=f"n = {len(body.positions)}", xlim=(-3, 3), ylim=(-3, 3))

    text = "Solid spheres of 2 um in place of the paper's confocal micrographs."
    return Item("fig1", "1 Introduction", "Fig. 1: clusters with n = 4, 5 and 6", text,
                pd.concat(parts, ignore_index=True), draw, claims, size=(10, 3.6))  # fmt: skip


def unit(vector: Floats) -> Floats:
    """Return vectors scaled to length 1.

    Parameters
    ----------
    vector : array of shape (..., 3)

    Returns
    -------
    array of shape (..., 3)

    Examples
    --------
    >>> unit(np.array([3.0, 0.0, 4.0])).tolist()
    [0.6, 0.0, 0.8]
    """
    return np.asarray(vector / np.linalg.norm(vector, axis=-1, keepdims=True))


def random_rotations(count: int, rng: np.random.Generator) -> Floats:
    """Return random rotations, uniform over all orientations.

    Parameters
    ----------
    count : int
    rng : numpy.random.Generator

    Returns
    -------
    array of shape (count, 3, 3)

    Examples
    --------
    >>> random_rotations(5, np.random.default_rng(1)).shape
    (5, 3, 3)
    """
    # A normally distributed quaternion has a uniformly distributed direction.
    return np.asarray(Rotation.from_quat(rng.normal(size=(count, 4))).as_matrix())


def log_lags(longest: float, count: int) -> Ints:
    """Return about `count` whole numbers from 1 to `longest`, evenly on a logarithmic scale.

    Parameters
    ----------
    longest : float
    count : int

    Returns
    -------
    array of int

    Examples
    --------
    >>> log_lags(100, 5).tolist()
    [1, 3, 10, 32, 100]
    """
    return np.unique(np.rint(np.geomspace(1, longest, count)).astype(int))
