"""Hunter et al. 2011, section 4.1 and appendix: orientations and rotation vectors."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from perrin.curves.correlation import orientation_correlation
from perrin.curves.displacement import msad, msad_vector
from perrin.geometry.rotations import axis_angle
from perrin.geometry.shapes import Cluster
from perrin.motion.floor import noise_floor
from perrin.motion.simulate import add_noise, simulate_motion
from perrin.motion.tracking import track_rotation
from perrin.paper.claims import Claim, Item, Study, statistical
from perrin.paper.method import STEPS, R, log_lags, random_rotations, unit
from perrin.plot.figure_style import PALETTE
from perrin.plot.results import plot_orientations

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_ORIENTATIONS = "4.1 Rotations via orientations"
_APPENDIX = "Appendix: rotations via the rotation matrix"


def figure_2(study: Study) -> Item:
    """Follow orientations on the sphere and the unbounded angle phi (Eqs. 17-18, Fig. 2).

    Parameters
    ----------
    study : Study

    Returns
    -------
    Item
    """
    body, D = Cluster.tetrahedron(R), 1e-4
    truth = simulate_motion(body, D_R=study.planted(D), dt=1.0, n_frames=STEPS + 1,
                            scheme="euler", rng=study.rng("fig2"))  # fmt: skip
    motion = track_rotation(truth.positions(), dt=1.0, reference="previous")
    phi = motion.rotational_displacement(motion.template)
    p = motion.orientation(motion.template)
    off = float(np.abs(p - truth.positions() / body.R).max())
    step = np.diff(phi, axis=0)
    own = np.mean(np.sum(step**2, axis=2))
    shared = np.mean([np.mean(np.sum(step[:, i] * step[:, j], axis=1))
                      for i, j in zip(*np.triu_indices(4, 1), strict=True)])  # fmt: skip
    # A body with a constant angular velocity about z (Eq. 18).
    omega, count = 1e-3, 5000
    turn = Rotation.from_rotvec(omega * np.arange(count)[:, None] * [0.0, 0.0, 1.0]).as_matrix()
    turning = track_rotation(np.einsum("tij,nj->tni", turn, body.positions), dt=1.0)
    theta = np.deg2rad([15.0, 30.0, 60.0, 75.0])
    tilted = np.stack([np.sin(theta), np.zeros(4), np.cos(theta)], axis=1)
    across = turning.rotational_displacement([1.0, 0.0, 0.0])[-1]
    angle = omega * (count - 1)
    ratio = turning.rotational_displacement(tilted)[-1, :, 2] / (np.sin(theta) ** 2 * angle)
    mean = turning.rotational_displacement(body.positions)[-1, :, 2].mean() / angle
    spinning = "Eq. 18, section 4.1"
    claims = (
        Claim("p(t) is the product of rotations on p^0: largest distance to the particle's own "
              "direction, 1e4 noise-free steps", "Eq. 17, section 4.1", 0.0,
              off, 1e-10, "rounding"),
        Claim("constant omega along z, p perpendicular: phi = (0, 0, omega t), largest deviation "
              "(rad)", spinning, 0.0, float(np.abs(across - [0, 0, angle]).max()), 1e-9,
              "rounding"),
        Claim("p at an angle theta to z: phi_z/(sin^2(theta) omega t), the worst of four", spinning,
              1.0, float(ratio[np.argmax(np.abs(ratio - 1))]), 1e-6, "steps of 1e-3 rad"),
        Claim("average over the particles of a tetrahedron: phi_z/(omega t)", spinning, 2 / 3,
              float(mean), 1e-6, "steps of 1e-3 rad"),
        # Exact for a tetrahedron and small steps, whatever the distribution of the steps is.
        Claim("the particles' trajectories differ: correlation of dphi of two directions, "
              "(1 + cos^2)/2 = 5/9", "Fig. 2, section 4.1", 5 / 9, float(shared / own), 1e-3,
              "finite steps"),
    )  # fmt: skip
    table = pd.DataFrame({"step": np.arange(STEPS + 1)})
    for i in range(4):
        table[[f"p{i}_{a}" for a in "xyz"]] = p[:, i]
        table[[f"phi{i}_{a}" for a in "xyz"]] = phi[:, i]

    def draw(figure: Figure) -> None:
        sphere = plot_orientations(motion, ax=figure.add_subplot(121, projection="3d"))
        ax = figure.add_subplot(122)
        sphere.set_title("(a)", loc="left")
        ax.set_title("(b)", loc="left")
        for i in range(2):
            ax.plot(phi[:, i, 0], phi[:, i, 1], color=PALETTE[i], lw=0.5, rasterized=True)
            ax.plot(*phi[-1, i, :2], "o", ms=9, mfc="white", mec=PALETTE[i], mew=1.6)
        ax.set(xlabel="$φ_x$ (rad)", ylabel="$φ_y$ (rad)")
        ax.set_aspect("equal", adjustable="datalim")

    text = (
        "One tetrahedron, D_R = 1e-4 rad^2/ts, 10^4 steps. (a) The directions of its four "
        "particles on the unit sphere. (b) (phi_x, phi_y) of two of them, from (0, 0) to the open "
        "circles."
    )
    return Item("fig2", _ORIENTATIONS, "Fig. 2: trajectories on the sphere and in rotation space",
                text, table, draw, claims, size=(11, 5.2))  # fmt: skip


def axes(study: Study) -> Item:
    """Compare the MSADs of two directions of an anisotropic body (section 4.1).

    Parameters
    ----------
    study : Study

    Returns
    -------
    Item
    """
    body, D = Cluster.touching(5, 2.0), np.array([1e-3, 1e-3, 2e-3])
    planted = D * (1 + study.planted_error)
    count = study.repeats(100_000)
    motion = simulate_motion(body, D_R=planted, dt=1.0, n_frames=count, rng=study.rng("axes"))
    directions = {"across": [1.0, 0.0, 0.0], "along": [0.0, 0.0, 1.0]}
    curves = {name: msad(motion, directions=p) for name, p in directions.items()}
    slope = {"across": 2 * (D[1] + D[2]), "along": 4 * D[0]}
    lags = log_lags(1000, 25) - 1
    table = pd.DataFrame({"lag_ts": curves["along"].lagtime[lags]})
    for name, curve in curves.items():
        table[f"msad_{name}"] = curve.value[lags]
        table[f"expected_{name}"] = slope[name] * table["lag_ts"]
    apparent, error = float(curves["across"].value[0]) / 4, float(np.sqrt(1 / count))
    source, first = "section 4.1", "at one step over"
    claims = (
        statistical(f"p across the long axis: MSAD {first} 2 (D_perp + D_par) dt", source,
                    expected=1.0, measured=float(curves["across"].value[0] / slope["across"]),
                    stderr=error),
        statistical(f"p along the long axis: MSAD {first} 4 D_perp dt", source,
                    expected=1.0, measured=float(curves["along"].value[0] / slope["along"]),
                    stderr=error),
        Claim("p across the long axis measures the motion about that axis: MSAD/(4 dt) over "
              "D_par",
              source, 1.0, apparent / D[2], 3 * error, "3 standard errors",
              f"It mixes both: MSAD/(4 dt) is (D_perp + D_par)/2 = {apparent:.2e}, not D_par = "
              f"{D[2]:.0e} rad^2/ts."),
    )  # fmt: skip

    def draw(figure: Figure) -> None:
        ax = figure.subplots()
        for color, name in zip(PALETTE, ("across", "along"), strict=False):
            ax.loglog(table["lag_ts"], table[f"msad_{name}"], "-", color=color,
                      label=f"p {name} the long axis")  # fmt: skip
            ax.loglog(table["lag_ts"], table[f"expected_{name}"], "o", mfc="none", mec=color)
        ax.plot([], [], "o", mfc="none", mec="#222222", label="2 (tr D − p·D·p) Δt")
        ax.set(xlabel="Δt (ts)", ylabel="MSAD (rad²)")
        ax.legend(frameon=False)

    text = (
        "Five touching spheres with D_R = (1, 1, 2) x 1e-3 rad^2/ts, the last about the long axis, "
        "no noise. MSAD(p) = 2 (tr D - p.D.p) dt: a rotation about p does not move p."
    )
    return Item("axes", _ORIENTATIONS, "Two chosen directions of an anisotropic body", text, table,
                draw, claims, size=(6.5, 4.6))  # fmt: skip


def correlation(study: Study) -> Item:
    """Read D_R from the decay of the orientational correlation (section 4.1).

    Parameters
    ----------
    study : Study

    Returns
    -------
    Item
    """
    rng, D, count = study.rng("correlation"), 1e-2, 2500
    tracks = [
        simulate_motion(Cluster.tetrahedron(R), D_R=study.planted(D), dt=1.0, n_frames=count,
                        scheme="euler", rng=rng)
        for _ in range(study.repeats(40))
    ]  # fmt: skip
    table = pd.DataFrame({"lag_ts": np.arange(1.0, 101.0)})
    claims = []
    for degree in (1, 2):
        rate = degree * (degree + 1)
        values = np.stack(
            [
                orientation_correlation(track, degree=degree, noise=None).value[:100]
                for track in tracks
            ]
        )
        table[f"degree_{degree}"] = values.mean(axis=0)
        table[f"expected_{degree}"] = np.exp(-rate * D * table["lag_ts"])
        # The slope of the logarithm over the first ten lags, through 1 at lag 0.
        lag = np.arange(1.0, 11.0)
        fitted = -np.log(values[:, :10]) @ lag / (lag @ lag) / rate
        error = float(fitted.std(ddof=1) / np.sqrt(len(fitted)))
        claims.append(
            statistical(
                f"D_R from the decay exp(-{rate} D_R dt) of degree {degree}, lags 1-10, over the "
                "planted one", "section 4.1", expected=1.0, measured=float(fitted.mean()) / D,
                stderr=error / D)
        )  # fmt: skip

    def draw(figure: Figure) -> None:
        ax = figure.subplots()
        for color, degree in zip(PALETTE, (1, 2), strict=False):
            label = f"degree {degree}, $\\exp(-{degree * (degree + 1)} D_R Δt)$"
            ax.semilogy(table["lag_ts"], table[f"degree_{degree}"], "-", color=color, label=label)
            ax.plot(table["lag_ts"][4::8], table[f"expected_{degree}"][4::8], "o", mfc="none",
                    mec=color)  # fmt: skip
        ax.set(xlabel="Δt (ts)", ylabel="orientational correlation")
        ax.legend(frameon=False)

    text = (
        "40 noise-free tetrahedra, D_R = 1e-2 rad^2/ts, 2500 steps each: <p(t + dt).p(t)> and its "
        "second Legendre polynomial."
    )
    return Item("correlation", _ORIENTATIONS, "Orientational correlation", text, table, draw,
                tuple(claims), size=(6.5, 4.6))  # fmt: skip


def appendix(study: Study) -> Item:
    """Check axis and angle of rotations, and the angle by which a direction turns (Eqs. 28-35).

    Parameters
    ----------
    study : Study

    Returns
    -------
    Item
    """
    rotation = random_rotations(2000, study.rng("appendix"))
    axis, angle = axis_angle(rotation)
    w = unit(np.cross(axis, [1.0, 0.0, 0.0]))
    turned = np.einsum("kij,kj->ki", rotation, w)
    sine = np.sin(angle)[:, None] * axis
    section = "appendix"
    # Angles near 0 and near pi, and axes along x.
    hard = np.array([1e-8, 1e-4, 1.0, np.pi - 1e-4, np.pi - 1e-8])
    hard_axis = unit(
        np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [1.0, 1e-9, 0.0]])
    )
    vectors = (hard[:, None, None] * hard_axis).reshape(-1, 3)
    found_axis, found = axis_angle(Rotation.from_rotvec(vectors).as_matrix())
    wanted = np.tile(hard_axis, (len(hard), 1))
    off = np.linalg.norm(np.cross(found_axis, wanted), axis=1) * found
    off = max(np.abs(found - np.repeat(hard, len(hard_axis))).max(), off.max())
    claims = [
        Claim("R u = u: largest error, 2000 random rotations", f"Eq. 28, {section}", 0.0,
              float(np.abs(np.einsum("kij,kj->ki", rotation, axis) - axis).max()), 1e-9,
              "rounding"),
        Claim("w and w' = R w stay perpendicular to u: largest cosine", f"Eqs. 29-30, {section}",
              0.0, float(max(np.abs(np.sum(v * axis, axis=1)).max() for v in (w, turned))), 1e-9,
              "rounding"),
        Claim("sin(dphi) u = w x w': largest error", f"Eq. 31, {section}", 0.0,
              float(np.abs(np.cross(w, turned) - sine).max()), 1e-9, "rounding"),
        Claim("angles near 0, near pi, and axes along x, where Eq. 29 is 0/0: largest error (rad)",
              f"Eqs. 28-31, {section}", 0.0, float(off), 1e-9, "rounding"),
    ]  # fmt: skip
    # By which angle a rotation turns directions at angles theta to its axis.
    parts = []
    for theta in (15.0, 30.0, 60.0, 90.0):
        turn = np.linspace(0.01, np.pi, 100)
        p = np.array([np.sin(np.deg2rad(theta)), 0.0, np.cos(np.deg2rad(theta))])
        moved = Rotation.from_rotvec(turn[:, None] * [0.0, 0.0, 1.0]).apply(p)
        seen = np.arctan2(np.linalg.norm(np.cross(p, moved), axis=1), moved @ p)
        parts.append(pd.DataFrame({"theta_deg": theta, "turn": turn, "seen": seen}))
    table = pd.concat(parts, ignore_index=True)
    square = np.sin(np.deg2rad(table["theta_deg"])) ** 2
    formula = np.arccos(np.clip(square * np.cos(table["turn"]) + 1 - square, -1, 1))
    small = table[table["turn"] == table["turn"].min()]
    ratio = small["seen"] ** 2 / (np.sin(np.deg2rad(small["theta_deg"])) ** 2 * small["turn"] ** 2)
    cosine = float(((1 - np.cos(small["seen"])) / small["seen"] ** 2).mean())
    mu, weight = np.polynomial.legendre.leggauss(20)
    claims += [
        Claim("the angle by which p turns is arccos(sin^2 cos(dphi_u) + cos^2): largest error "
              "(rad)", "Eq. 32, appendix", 0.0, float(np.abs(formula - table["seen"]).max()), 1e-7,
              "rounding of arccos"),
        Claim("1 - dphi^2 approximates cos(dphi): (1 - cos(dphi))/dphi^2", "Eq. 33, appendix", 1.0,
              cosine, 1e-3, "terms of 4th order",
              f"The ratio is {cosine:.4f}: factors 1/2 are left out on both sides of Eq. 33 and "
              "cancel in Eq. 34, which is right."),
        Claim("dphi^2/(sin^2(theta) dphi_u^2) for small angles, mean of four", "Eq. 34, appendix",
              1.0, float(ratio.mean()), 1e-4, "terms of 4th order"),
        Claim("average of sin^2(theta) over the sphere", "Eq. 35, appendix", 2 / 3,
              float(weight @ (1 - mu**2) / 2), 1e-12, "rounding"),
    ]  # fmt: skip

    def draw(figure: Figure) -> None:
        ax = figure.subplots()
        for color, (theta, part) in zip(PALETTE, table.groupby("theta_deg"), strict=False):
            ax.plot(np.rad2deg(part["turn"]), part["seen"] ** 2 / part["turn"] ** 2, color=color,
                    label=f"θ = {theta:.0f}°")  # fmt: skip
            ax.plot(0, np.sin(np.deg2rad(theta)) ** 2, "o", mfc="none", mec=color, clip_on=False)
        ax.plot([], [], "o", mfc="none", mec="#222222", label="$\\sin^2 θ$ (Eq. 34)")
        ax.set(xlabel="rotation $δφ_u$ (degrees)", ylabel="$δφ^2 / δφ_u^2$", xlim=(0, 180))
        ax.set(ylim=(0, 1.05))
        ax.legend(frameon=False, ncols=2)

    text = (
        "`axis_angle` against Eqs. 28-31 evaluated as printed; Eqs. 32-35 against rotated vectors."
    )
    return Item("appendix", _APPENDIX, "Axis and angle, and the angle by which a direction turns",
                text, table, draw, tuple(claims), size=(6.5, 4.6))  # fmt: skip


def figure_6(study: Study) -> Item:
    """Compare the MSAD of rotation vectors with that of directions (appendix, Fig. 6).

    Parameters
    ----------
    study : Study

    Returns
    -------
    Item
    """
    rng, body, sigma = study.rng("fig6"), Cluster.pentahedron(R), 0.05
    lags, floor = log_lags(STEPS / 2, 40) - 1, 1.5 * noise_floor(body, sigma=sigma).phi2
    parts, claims = [], []
    for D in (1e-4, 1e-2):
        truth = simulate_motion(body, D_R=study.planted(D), dt=1.0, n_frames=STEPS + 1,
                                scheme="euler", rng=rng)  # fmt: skip
        noisy = add_noise(truth.positions(), sigma=sigma, rng=rng)
        motion = track_rotation(noisy, dt=1.0, reference="previous")
        pure, vector = msad_vector(truth), msad_vector(motion)
        part = pd.DataFrame({"D_R": D, "lag_ts": vector.lagtime[lags]})
        part["uncorrected"] = vector.value[lags]
        part["corrected"] = 2 / 3 * part["uncorrected"]
        part["direction"] = msad(motion).value[lags]
        part["theory"] = 4 * D * part["lag_ts"]
        parts.append(part)
        turned = np.linalg.norm(motion.step_vectors(), axis=1)
        phi = motion.rotational_displacement(motion.template)
        seen = np.linalg.norm(np.diff(phi, axis=0), axis=2)
        below = float(np.mean(seen > turned[:, None] + 1e-9))
        claims += [
            statistical(f"uncorrected MSAD of one step over 4 D_R dt, no noise, D_R = {D:g}",
                        "Fig. 6, appendix", expected=1.5,
                        measured=float(pure.value[0] / (4 * D)),
                        stderr=float(pure.stderr[0] / (4 * D))),
            statistical(f"MSAD of one step corrected by 2/3, less 2/3 of its noise floor, over 4 "
                        f"D_R dt, sigma = 50 nm, D_R = {D:g}", "Eq. 35, Fig. 6, appendix",
                        expected=1.0, measured=float((vector.value[0] - floor) / (6 * D)),
                        stderr=float(vector.stderr[0] / (6 * D))),
            Claim(f"the angle about the axis is at least that of any direction: share of steps "
                  f"where not, D_R = {D:g}", "Fig. 6, appendix", 0.0, below, 0.0, "exact"),
        ]  # fmt: skip
    table = pd.concat(parts, ignore_index=True)

    def draw(figure: Figure) -> None:
        ax = figure.subplots()
        for color, part in zip(PALETTE, parts, strict=False):
            power = round(np.log10(part["D_R"].iloc[0]))
            label = f"$D_R$ = $10^{{{power}}}$ rad²/ts"
            ax.loglog(part["lag_ts"], part["uncorrected"], "--", color=color)
            ax.loglog(part["lag_ts"], part["corrected"], "-", color=color, label=label)
            ax.loglog(part["lag_ts"][::3], part["theory"][::3], "o", mfc="none", mec="#222222")
        ax.plot([], [], "--", color="#222222", label="uncorrected")
        ax.plot([], [], "-", color="#222222", label="times 2/3")
        ax.plot([], [], "o", mfc="none", mec="#222222", label="$4 D_R Δt$")
        ax.set(xlabel="Δt (ts)", ylabel="MSAD (rad²)")
        ax.legend(frameon=False)

    text = (
        "Pentahedra at D_R = 1e-4 and 1e-2 rad^2/ts, sigma = 50 nm, 10^4 steps: the MSAD from axis "
        "and angle of each rotation, as it is and times 2/3."
    )
    return Item("fig6", _APPENDIX, "Fig. 6: MSAD from rotation vectors", text, table, draw,
                tuple(claims), size=(6.5, 4.8))  # fmt: skip
