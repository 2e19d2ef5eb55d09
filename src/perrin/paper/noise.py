"""Hunter et al. 2011, section 4.1: noise and sampling (Figs. 3 and 4, Eqs. 19 to 23)."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Literal

import numpy as np
import pandas as pd

from perrin.curves.displacement import msad
from perrin.diffusion.bounds import cramer_rao
from perrin.geometry.rotations import kabsch, successive_product
from perrin.geometry.shapes import Cluster
from perrin.motion.floor import noise_floor
from perrin.motion.simulate import add_noise, simulate_motion
from perrin.motion.tracking import track_rotation
from perrin.paper.claims import Claim, Item, Study, statistical
from perrin.paper.method import NOISES, STEPS, R, log_lags
from perrin.plot.figure_style import PALETTE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from perrin._arrays import Floats
    from perrin.curves.displacement import LagCurve
    from perrin.motion.rigid_motion import RigidMotion


_NOISE_SECTION = "4.1 Noise, its subtraction, and sampling"

# Planted D_R of Figs. 3 and 4(b), rad^2 per time step.
_PLANTED = (1e-4, 1e-3)

_BODIES = {"tetrahedron": Cluster.tetrahedron, "pentahedron": Cluster.pentahedron}
_MARKERS = "osD^v"

# Sizes of Fig. 4(a), um: sigma/R is 0.1 at most.
_RADII = (1.0, 1.5, 2.5)

# Phi^2 is quadratic in the direction, so the mean over x, y and z is that over all directions.
_XYZ = np.eye(3)

# Frames of a stationary cluster: the relative error of one Phi^2 is then 0.3 %.
_STATIONARY_FRAMES = 110_000


@lru_cache(maxsize=4)  # Figs. 3 and 4(b) show the same tetrahedra
def _noisy_curves(study: Study, shape: str, D: float) -> tuple[dict[float, LagCurve], ...]:
    """Return the MSADs of one simulated body at every noise level (um), 0.0 included.

    The first dictionary holds those by the product of successive rotations, the second that by the
    fit to a common shape, at the highest noise level.
    """
    rng = study.rng(f"{shape} {D}")
    truth = simulate_motion(_BODIES[shape](R), D_R=study.planted(D), dt=1.0, n_frames=STEPS + 1,
                            scheme="euler", rng=rng)  # fmt: skip
    chain = {0.0: msad(truth)}
    for sigma in NOISES:
        noisy = add_noise(truth.positions(), sigma=sigma, rng=rng)
        chain[sigma] = msad(track_rotation(noisy, dt=1.0, reference="previous"))
    common = {sigma: msad(track_rotation(noisy, dt=1.0))}
    return chain, common


def figure_3(study: Study) -> Item:
    """Show what noise does to the MSAD of diffusing tetrahedra (Eqs. 19-20, Fig. 3).

    Parameters
    ----------
    study : Study

    Returns
    -------
    Item
    """
    curves = {D: _noisy_curves(study, "tetrahedron", D)[0] for D in _PLANTED}
    table = pd.concat(
        [_curve_rows(c, D, sigma) for D, each in curves.items() for sigma, c in each.items()],
        ignore_index=True,
    )
    claims: list[Claim] = []
    for D in _PLANTED:
        each = curves[D]
        pure, noisiest = each[0.0], each[max(NOISES)]
        where, source = f"D_R = {D:g}", "Fig. 3, section 4.1"
        floor = noise_floor(Cluster.tetrahedron(R), sigma=max(NOISES)).phi2
        line = np.log(pure.value[[0, 9, 99]] / pure.lagtime[[0, 9, 99]])
        slope = 1 + float(line[2] - line[0]) / np.log(100)
        late = {s: c.value[999] / (4 * D * 1000) for s, c in each.items()}
        worst = max(late, key=lambda s: abs(late[s] - 1))
        claims += [
            statistical(f"MSAD of one step over 4 D_R dt, no noise, {where}",
                        "Eqs. 19-20, section 4.1", expected=1.0,
                        measured=float(pure.value[0] / (4 * D)),
                        stderr=float(pure.stderr[0] / (4 * D))),
            statistical(f"log-log slope without noise, lags 1 to 100, {where}", f"Eq. 20, {source}",
                        expected=1.0, measured=slope,
                        stderr=float(pure.stderr[99] / pure.value[99] / np.log(100))),
            statistical("plateau: MSAD of one step at sigma = 100 nm over 4 D_R dt + Phi^2, "
                        f"{where}", f"Eq. 22, {source}", expected=1.0,
                        measured=float(noisiest.value[0] / (4 * D + floor)),
                        stderr=float(noisiest.stderr[0] / noisiest.value[0])),
            statistical(f"recovery: MSAD over 4 D_R dt at lag 1000, the worst of the noise levels "
                        f"({1e3 * worst:.0f} nm), {where}", source, expected=1.0,
                        measured=float(late[worst]),
                        stderr=float(each[worst].stderr[999] / each[worst].value[999])),
        ]  # fmt: skip

    def draw(figure: Figure) -> None:
        for ax, D, panel in zip(figure.subplots(1, 2), _PLANTED, "ab", strict=True):
            _draw_noisy(ax, curves[D], D)
            ax.set_title(f"({panel}) $D_R$ = {D:g} rad²/ts", loc="left")
            ax.legend(frameon=False)

    text = (
        f"Tetrahedra with R = {R:.3f} um, 10^4 steps, five noise levels, by the product of "
        "successive rotations."
    )
    return Item("fig3", _NOISE_SECTION, "Fig. 3: MSAD for different noise levels", text, table,
                draw, tuple(claims), size=(10, 4.8))  # fmt: skip


def _curve_rows(curve: LagCurve, D: float, sigma: float) -> pd.DataFrame:
    """Return about 40 lags of a curve, evenly on a logarithmic scale."""
    lags = log_lags(STEPS / 2, 40) - 1
    return pd.DataFrame({
        "D_R": D, "sigma_um": sigma, "lag_ts": curve.lagtime[lags], "msad": curve.value[lags],
        "stderr": curve.stderr[lags], "theory": 4 * D * curve.lagtime[lags],
    })  # fmt: skip


def _draw_noisy(
    ax: Axes, curves: dict[float, LagCurve], D: float, *, floors: dict[float, float] | None = None
) -> None:
    """Draw the MSADs of all noise levels, less their floors where given, and 4 D_R dt."""
    for color, sigma in zip(PALETTE, NOISES, strict=False):
        rows = _curve_rows(curves[sigma], D, sigma)
        value = rows["msad"] - (floors[sigma] if floors else 0.0)
        # Values that the subtraction makes negative have no logarithm.
        ax.loglog(rows["lag_ts"], value.where(value > 0), "-", color=color,
                  label=f"σ = {1e3 * sigma:.0f} nm")  # fmt: skip
    ax.loglog(rows["lag_ts"][::3], rows["theory"][::3], "o", mfc="none", mec="#222222",
              label="$4 D_R Δt$")  # fmt: skip
    ax.set(xlabel="Δt (ts)", ylabel="MSAD (rad²)")


def figure_4(study: Study) -> Item:
    """Measure Phi^2 of stationary clusters, and subtract it from the MSADs (Eqs. 21-23, Fig. 4).

    Parameters
    ----------
    study : Study

    Returns
    -------
    Item
    """
    rng, frames, rows = study.rng("fig4"), study.repeats(_STATIONARY_FRAMES), []
    for shape, make in _BODIES.items():
        for radius in _RADII:
            body = make(radius)
            for sigma in NOISES:
                n = len(body.positions)
                rows.append({
                    "body": shape, "R_um": radius, "sigma_um": sigma,
                    "phi2": measured_floor(body, sigma, frames, rng, directions=_XYZ),
                    "eq_23": 6 * sigma**2 / (n * radius**2),
                    "exact": noise_floor(body, sigma=sigma).phi2,
                })  # fmt: skip
    table = pd.DataFrame(rows).eval("ratio = phi2 / eq_23").assign(stderr=1 / np.sqrt(frames))
    curves = {(s, D): _noisy_curves(study, s, D) for s in _BODIES for D in _PLANTED}
    claims = _floor_claims(table)
    for (shape, D), (chain, common) in curves.items():
        claims += _subtraction_claims(chain, common, shape=shape, D=D)

    def draw(figure: Figure) -> None:
        left, right = figure.subplots(1, 2)
        _draw_floors(left, table)
        floors = {s: noise_floor(Cluster.tetrahedron(R), sigma=s).phi2 for s in NOISES}
        for D in _PLANTED:
            _draw_noisy(right, curves["tetrahedron", D][0], D, floors=floors)
        right.set(ylabel="MSAD − $Φ^2$ (rad²)", ylim=(1e-4, None))
        handles, labels = right.get_legend_handles_labels()
        right.legend(handles[:6], labels[:6], frameon=False)
        left.set_title("(a)", loc="left")
        right.set_title("(b)", loc="left")

    text = (
        f"(a) Phi^2 at lag 1 of {_STATIONARY_FRAMES} frames of stationary clusters, R = 1.0, 1.5 "
        "and 2.5 um, noise 10 to 100 nm (sigma/R at most 0.1), by the product of successive "
        "rotations; filled symbols tetrahedra, open ones pentahedra. (b) The MSADs of Fig. 3 less "
        "the Phi^2 that their sigma predicts."
    )
    return Item("fig4", _NOISE_SECTION, "Fig. 4: the noise floor and its subtraction", text, table,
                draw, tuple(claims), size=(11, 4.8))  # fmt: skip


def product_motion(positions: Floats, body: Cluster) -> RigidMotion:
    """Return the product of successive rotations of a stationary body as a motion (Eq. 13).

    `track_rotation` computes the template, residuals and errors as well, which are not needed here
    and take ten times as long.

    Parameters
    ----------
    positions : array of shape (T, n, 3)
        um.
    body : Cluster
        The body without noise.

    Returns
    -------
    RigidMotion

    Examples
    --------
    >>> body = Cluster.tetrahedron(1.0)
    >>> motion = product_motion(np.broadcast_to(body.positions, (5, 4, 3)), body)
    >>> bool(np.allclose(motion.rotation, np.eye(3)))
    True
    """
    step = kabsch(positions[1:], positions[:-1])
    motion = simulate_motion(body, D_R=0.0, dt=1.0, n_frames=len(positions), rng=0)
    return replace(motion, rotation=successive_product(step).copy())


def measured_floor(
    body: Cluster, sigma: float, frames: int, rng: np.random.Generator, *, directions: Floats
) -> float:
    """Return the MSAD at lag 1 of a simulated stationary body (Eqs. 19 and 21), rad^2.

    Parameters
    ----------
    body : Cluster
    sigma : float
        Localisation error, um.
    frames : int
    rng : numpy.random.Generator
    directions : array of shape (k, 3)
        Directions over which the MSAD is averaged.

    Returns
    -------
    float

    Examples
    --------
    >>> body, rng = Cluster.tetrahedron(1.0), np.random.default_rng(1)
    >>> phi2 = measured_floor(body, 0.05, 4000, rng, directions=np.eye(3))
    >>> abs(phi2 / (6 * 0.05**2 / 4) - 1) < 0.1
    True
    """
    still = np.broadcast_to(body.positions, (frames, *body.positions.shape))
    motion = product_motion(add_noise(still, sigma=sigma, rng=rng), body)
    walk = motion.rotational_displacement(directions)
    return float(np.mean(np.sum(np.diff(walk, axis=0) ** 2, axis=2)))


def _floor_claims(table: pd.DataFrame) -> list[Claim]:
    """Compare Phi^2 with Eq. 23: each value, and the mean where second order is negligible."""
    claims = []
    for shape, part in table.groupby("body", sort=False):
        worst = part.loc[(part["ratio"] - 1).abs().idxmax()]
        quiet = part[part["sigma_um"] / part["R_um"] <= 0.03]
        error = float(quiet["stderr"].iloc[0] / np.sqrt(len(quiet)))
        exact = float((part["exact"] / part["eq_23"]).mean())
        mean = float(quiet["ratio"].mean())
        source, where = "Eqs. 21-23, Fig. 4a, section 4.1", "mean at sigma/R <= 0.03"
        claims += [
            Claim(f"Phi^2 over 6 sigma^2/(n R^2), the worst of {len(part)} {shape} values (R = "
                  f"{worst['R_um']} um, sigma = {1e3 * worst['sigma_um']:.0f} nm)", source, 1.0,
                  worst["ratio"], 0.02, "2 %",
                  f"It is {100 * worst['ratio'] - 100:+.1f} % off: second order in sigma/R."),
            statistical(f"Phi^2 over 6 sigma^2/(n R^2), {shape}, all directions, {where}",
                        source, expected=1.0, measured=mean, stderr=error,
                        remark=f"Over all directions Phi^2 is {100 * mean - 100:+.2f} % off Eq. "
                               f"23, as the exact expression states ({100 * exact - 100:+.2f} %)."),
            statistical(f"Phi^2 over the exact expression, {shape}, all directions, {where}",
                        source, expected=1.0, measured=mean / exact, stderr=error),
        ]  # fmt: skip
    tetra = table[(table["body"] == "tetrahedron") & (table["sigma_um"] == NOISES[0])]
    size = np.log(tetra["R_um"])
    slope = np.polyfit(size, np.log(tetra["phi2"]), 1)[0]
    error = float(tetra["stderr"].iloc[0] / np.sqrt(np.sum((size - size.mean()) ** 2)))
    radius = statistical("exponent of Phi^2 in R, tetrahedra, sigma = 10 nm", "Eq. 23, section 4.1",
                       expected=-2.0, measured=float(slope), stderr=error)  # fmt: skip
    return [*claims, radius]


def _subtraction_claims(
    chain: dict[float, LagCurve], common: dict[float, LagCurve], *, shape: str, D: float
) -> list[Claim]:
    """Compare the subtracted MSADs with 4 D_R dt: by product and by common shape."""
    lags, quiet, noisiest = np.array([1, 2, 5, 10, 20, 50, 100]), NOISES[:-1], NOISES[-1:]
    body = _BODIES[shape](R)
    cases = (
        ("product, sigma = 10 to 70 nm", chain, quiet),
        ("product, sigma = 100 nm", chain, noisiest),
        ("common shape, sigma = 100 nm", common, noisiest),
    )
    claims = []
    for name, curves, noises in cases:
        deviations: list[tuple[float, float]] = []
        for sigma in noises:
            curve, floor = curves[sigma], noise_floor(body, sigma=sigma).phi2
            excess = (curve.value - floor)[lags - 1] - 4 * D * lags
            pulls, shares = excess / curve.stderr[lags - 1], excess / (4 * D * lags)
            deviations += zip(pulls.tolist(), shares.tolist(), strict=True)
        worst, share = max(deviations, key=lambda pair: abs(pair[0]))
        claims.append(
            Claim(
                "MSAD less Phi^2 is 4 D_R dt: worst deviation in standard errors at seven "
                f"lags from 1 to 100, {name}, {shape}, D_R = {D:g}",
                "Eq. 22, Fig. 4b, section 4.1", 0.0, worst, 3.0, "3 standard errors",
                f"The product adds spurious diffusion of second order, (sigma/R)^4: the curve is "
                f"{worst:.1f} standard errors off, {100 * share:+.0f} % of 4 D_R dt.",
            )
        )  # fmt: skip
    return claims


def _draw_floors(ax: Axes, table: pd.DataFrame) -> None:
    """Draw measured against predicted Phi^2: colours are noise levels, symbols sizes."""
    ends = np.array([table["eq_23"].min() / 1.5, table["eq_23"].max() * 1.5])
    ax.loglog(ends, ends, "-", color="#222222", lw=1, label="6 σ²/(n R²)")
    for color, sigma in zip(PALETTE, NOISES, strict=False):
        for marker, radius in zip(_MARKERS, _RADII, strict=False):
            rows = table[(table["sigma_um"] == sigma) & (table["R_um"] == radius)]
            for _, row in rows.iterrows():
                fill = color if row["body"] == "tetrahedron" else "white"
                ax.plot(row["eq_23"], row["phi2"], marker, mfc=fill, mec=color, ms=7)
        ax.plot([], [], "s", color=color, label=f"σ = {1e3 * sigma:.0f} nm")
    for marker, radius in zip(_MARKERS, _RADII, strict=False):
        ax.plot([], [], marker, mfc="none", mec="#222222", label=f"R = {radius} µm")
    ax.set(xlabel="6 σ²/(n R²) (rad²)", ylabel="measured $Φ^2$ (rad²)")
    ax.legend(frameon=False, fontsize="small")


def bodies(study: Study) -> Item:
    """Measure how Phi^2 depends on the body, n = 3 to 7 (Eq. 23 and the conclusion).

    Parameters
    ----------
    study : Study

    Returns
    -------
    Item
    """
    rng, frames, sigma, rows = study.rng("bodies"), study.repeats(_STATIONARY_FRAMES), 0.02, []
    clusters = {f"{n} touching spheres": Cluster.touching(n, 2.0) for n in range(3, 8)}
    clusters["pentahedron (Eq. 15)"] = Cluster.pentahedron(R)
    for name, body in clusters.items():
        n, own = len(body.positions), body.positions
        rows.append({
            "body": name, "n": n, "R_um": body.R,
            "phi2": measured_floor(body, sigma, frames, rng, directions=_XYZ),
            "phi2_particles": measured_floor(body, sigma, frames, rng, directions=own),
            "eq_23": 6 * sigma**2 / (n * body.R**2), "exact": noise_floor(body, sigma=sigma).phi2,
        })  # fmt: skip
    table = pd.DataFrame(rows)
    # Unequal axes make the error larger, by 4 % at most (trimer).
    error = 1.05 / np.sqrt(frames)
    claims, source = [], "Eq. 23, section 4.1"
    for _, row in table.iterrows():
        name, ratio = row["body"], row["phi2"] / row["eq_23"]
        exact = row["exact"] / row["eq_23"]
        claims += [
            Claim(f"Phi^2 over 6 sigma^2/(n R^2), {name}, all directions", source, 1.0, ratio,
                  0.02, "2 %",
                  "Over all directions Eq. 23 is exact for spherical tops only; this body is "
                  f"{100 * ratio - 100:+.1f} % off it (exactly {100 * exact - 100:+.1f} %)."),
            statistical(f"Phi^2 over the exact expression, {name}", source, expected=1.0,
                        measured=row["phi2"] / row["exact"], stderr=error),
        ]  # fmt: skip
    own = table.set_index("body").eval("phi2_particles / eq_23")
    claims += [
        statistical(f"Phi^2 over 6 sigma^2/(n R^2), {name}, the particles' own directions", source,
                    expected=1.0, measured=float(own[name]), stderr=error)
        for name in ("3 touching spheres", "pentahedron (Eq. 15)")
    ]  # fmt: skip
    size = np.log(table["n"] * table["R_um"] ** 2)[:5]
    slope = float(np.polyfit(size, np.log(table["phi2_particles"][:5]), 1)[0])
    claims.append(
        Claim("angular resolution scales with 1/(n R^2): exponent over n = 3 to 7 touching "
              "spheres, the particles' own directions", "Eq. 23, section 6", -1.0, slope, 0.02,
              "0.02")
    )  # fmt: skip

    def draw(figure: Figure) -> None:
        ax = figure.subplots()
        x = table["n"] * table["R_um"] ** 2
        ax.loglog(x, 6 * sigma**2 / x, "-", color="#222222", label="6 σ²/(n R²)")
        ax.loglog(x, table["exact"], "x", color=PALETTE[1], ms=9, label="exact expression")
        ax.loglog(x, table["phi2"], "o", mfc="none", mec=PALETTE[0], ms=9, label="measured")
        for n, place, value in zip(table["n"][:5], x, table["phi2"], strict=False):
            ax.annotate(f"n = {n}", (place, value), (8, 6), textcoords="offset points")
        ax.annotate("Eq. 15", (x.iloc[5], table["phi2"].iloc[5]), (8, 6),
                    textcoords="offset points")  # fmt: skip
        ax.set(xlabel="n R² (µm²)", ylabel="$Φ^2$ (rad²)")
        ax.legend(frameon=False)

    text = (
        "Stationary clusters of 3 to 7 touching spheres of 2 um, and the pentahedron of Eq. 15; "
        "sigma = 20 nm, lag 1. Averaged over the directions of its own particles, the floor of a "
        "body whose particles are all at R is 6 sigma^2/(n R^2) exactly; over all directions this "
        "holds for a spherical top only."
    )
    return Item("bodies", _NOISE_SECTION, "The noise floor of other bodies", text, table, draw,
                tuple(claims), size=(6.5, 4.6))  # fmt: skip


def constancy(study: Study) -> Item:
    """Compute the MSAD of stationary tetrahedra against lag time (Eq. 21).

    Parameters
    ----------
    study : Study

    Returns
    -------
    Item
    """
    rng, ratio = study.rng("constancy"), 0.067
    body = Cluster.tetrahedron(1.0)
    still = np.broadcast_to(body.positions, (5001, 4, 3))
    repeats = {"product": study.repeats(40), "common shape": study.repeats(24)}
    values = {}
    for route, count in repeats.items():
        tracks = (add_noise(still, sigma=ratio, rng=rng) for _ in range(count))
        motions = (
            product_motion(x, body) if route == "product" else track_rotation(x, dt=1.0)
            for x in tracks
        )
        values[route] = np.stack([msad(motion).value[:100] for motion in motions])
    table = pd.DataFrame({"lag_ts": np.arange(1, 101)})
    reasons = {
        "product": "errors of successive rotations do not cancel at second order",
        "common shape": "the orientation does not drift, but phi is a sum of steps, whose noise "
        "does not cancel at second order",
    }
    claims = []
    for route, v in values.items():
        table[route.replace(" ", "_")] = v.mean(axis=0)
        rise = v[:, 99] / v[:, 0].mean()
        claims.append(
            statistical(
                "MSADs of stationary clusters are constant over time: lag 100 over lag 1, "
                f"{route}, sigma/R = {ratio}", "Eq. 21, section 4.1", expected=1.0,
                measured=float(rise.mean()), stderr=float(rise.std(ddof=1) / np.sqrt(len(rise))),
                remark=f"By the {route} the MSAD rises by {100 * (rise.mean() - 1):.0f} % from lag "
                       f"1 to lag 100: {reasons[route]}.")
        )  # fmt: skip
    floor = noise_floor(body, sigma=ratio).phi2

    def draw(figure: Figure) -> None:
        ax = figure.subplots()
        for color, route in zip(PALETTE, values, strict=False):
            ax.plot(table["lag_ts"], table[route.replace(" ", "_")] / floor, color=color,
                    label=route)  # fmt: skip
        ax.axhline(1, color="#222222", lw=1, ls="--", label="$Φ^2$ (Eq. 23)")
        ax.set(xlabel="Δt (ts)", ylabel="MSAD / $Φ^2$", ylim=(0.95, None))
        ax.legend(frameon=False)

    text = (
        f"Stationary tetrahedra, sigma/R = {ratio}, 5000 steps, 40 repeats of the product and 24 "
        "of the fit to one common shape."
    )
    return Item("constancy", _NOISE_SECTION, "Is the noise floor constant over time?", text, table,
                draw, tuple(claims), size=(6.5, 4.2))  # fmt: skip


def sampling(study: Study) -> Item:
    """Check the rules for the time between frames, and what undersampling does (section 4.1).

    Parameters
    ----------
    study : Study

    Returns
    -------
    Item
    """
    rng, steps = study.rng("sampling"), study.repeats(50_000)
    parts = [_undersampled_motion(x, scheme, steps if x < 1 else 10 * steps, study, rng)
             for scheme in ("brownian", "euler") for x in (0.04, 0.1, 0.2, 0.4, 1.0)]  # fmt: skip
    table = pd.DataFrame(parts)
    last = table[table["msad_dt"] == 1.0].set_index("scheme")
    source = "section 4.1"
    shortest = noise_floor(Cluster.tetrahedron(R), sigma=0.1).phi2 / (4 * 1e-4)
    claims = [
        Claim("lower limit Phi^2/(4 D_R) for sigma = 100 nm, D_R = 1e-4, R = 1.225 um: 25 steps",
              f"Eqs. 22-23, {source}", 25.0, shortest, 1e-9, "rounding"),
        statistical("undersampling makes the motion appear slow: MSAD over 4 D_R dt at 4 D_R dt = "
                    "1, Brownian steps", source, expected=0.9131,
                    measured=last.loc["brownian", "factor"],
                    stderr=last.loc["brownian", "stderr"]),
        statistical("the same with the steps of Eq. 16", f"Eq. 16, {source}", expected=0.9126,
                    measured=last.loc["euler", "factor"], stderr=last.loc["euler", "stderr"]),
    ]  # fmt: skip
    for shape in _BODIES:
        lost = float(last.loc["brownian", f"lost_{shape}"])
        claims.append(
            Claim("particles are identified up to 4 D_R dt = 1: share of steps that nearest-"
                  f"neighbour linking gets wrong, {shape}", source, 0.0, lost, 0.01, "1 %",
                  f"Nearest-neighbour linking loses a particle in {100 * lost:.0f} % of the "
                  "steps; 4 D_R dt <= 0.07 is safe.")
        )  # fmt: skip
    # SNR = 4 D_R dt/Phi^2 is 1 at the lower limit and 1/Phi^2, here 100, at the upper one.
    source = f"Eqs. 22-23, {source}"
    lower, upper, best = (cramer_rao(n_frames=300, snr=snr) for snr in (1.0, 100.0, 1e9))
    claims += [
        Claim("Cramer-Rao bound at the lower limit dt = Phi^2/(4 D_R): least relative error of D_R "
              "(%)", source, 10.0, 100 * lower, 0.005, "rounding"),
        Claim("Cramer-Rao bound at the upper limit dt = 1/(4 D_R) for Phi = 0.1 rad (%)", source,
              8.2, 100 * upper, 0.05, "rounding"),
        Claim("the lower limit costs a factor in variance over longer steps", source, 1.5,
              (lower / best) ** 2, 0.05, "rounding"),
    ]  # fmt: skip

    def draw(figure: Figure) -> None:
        left, right = figure.subplots(1, 2)
        for color, (scheme, part) in zip(PALETTE, table.groupby("scheme"), strict=False):
            label = {"brownian": "Brownian steps", "euler": "Eq. 16"}[scheme]
            left.errorbar(part["msad_dt"], part["factor"], part["stderr"], fmt="o-", color=color,
                          label=label)  # fmt: skip
        left.set(xlabel="$4 D_R Δt$ (rad²)", ylabel="MSAD / $4 D_R Δt$")
        left.legend(frameon=False)
        brownian = table[table["scheme"] == "brownian"]
        for color, shape in zip(PALETTE[2:], _BODIES, strict=False):
            right.plot(brownian["msad_dt"], 100 * brownian[f"lost_{shape}"], "o-", color=color,
                       label=shape)  # fmt: skip
        right.set(xlabel="$4 D_R Δt$ (rad²)", ylabel="steps with a particle lost (%)")
        right.legend(frameon=False)

    text = (
        "Noise-free clusters with one step every dt: the apparent diffusion, and how often the "
        "particle nearest to the last position of a particle is another one. Expected at "
        "4 D_R dt = 1: 0.9131 from the heat kernel on SO(3), 0.9126 from the law of Eq. 16 by "
        "quadrature. At the two limits the Cramer-Rao bound for 300 frames is given as well."
    )
    return Item("sampling", _NOISE_SECTION, "Sampling rules", text, table, draw, tuple(claims),
                size=(10, 4.4))  # fmt: skip


def _undersampled_motion(
    x: float,
    scheme: Literal["brownian", "euler"],
    steps: int,
    study: Study,
    rng: np.random.Generator,
) -> dict[str, float | str]:
    """Return MSAD/(4 D_R dt) and the share of wrongly linked steps at 4 D_R dt = x."""
    factors, lost = [], dict.fromkeys(_BODIES, 0.0)
    chunks = 10
    for _ in range(chunks):
        truth = simulate_motion(Cluster.tetrahedron(R), D_R=study.planted(x / 4), dt=1.0,
                                n_frames=steps // chunks + 1, scheme=scheme, rng=rng)  # fmt: skip
        walk = truth.rotational_displacement(truth.template)
        factors.append(float(np.mean(np.sum(np.diff(walk, axis=0) ** 2, axis=2))) / x)
        for shape, make in _BODIES.items():
            lost[shape] += linking_error(truth.rotation, make(R).positions) / chunks
    stderr = float(np.std(factors, ddof=1) / np.sqrt(chunks))
    return {"scheme": scheme, "msad_dt": x, "factor": float(np.mean(factors)), "stderr": stderr,
            **{f"lost_{shape}": share for shape, share in lost.items()}}  # fmt: skip


def linking_error(rotation: Floats, body: Floats) -> float:
    """Return the share of steps in which a particle's nearest successor is another particle.

    Parameters
    ----------
    rotation : array of shape (T, 3, 3)
    body : array of shape (n, 3)
        Positions of the particles, all at the same distance from the centre.

    Returns
    -------
    float

    Examples
    --------
    >>> half_turn = np.stack([np.eye(3), np.diag([-1.0, -1.0, 1.0])])
    >>> linking_error(half_turn, np.array([[1.0, 0, 0], [-1.0, 0, 0]]))
    1.0
    """
    p = rotation @ body.T
    # On a sphere the nearest point has the largest dot product.
    near = np.argmax(np.swapaxes(p[:-1], 1, 2) @ p[1:], axis=2)
    return float(np.mean(np.any(near != np.arange(len(body)), axis=1)))
