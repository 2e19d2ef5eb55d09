"""Hunter et al. 2011, sections 5 and 6: the experiment (Fig. 5, Table 1) and bulk rotation."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from scipy.constants import Boltzmann
from scipy.spatial.transform import Rotation

from perrin.curves.displacement import msad, msd
from perrin.diffusion.curve_fits import fit_line
from perrin.geometry.shapes import Cluster
from perrin.hydrodynamics.sizes import size_from_rotation, size_from_translation
from perrin.motion.floor import noise_floor
from perrin.motion.simulate import add_noise, simulate_motion
from perrin.motion.tracking import remove_rotation, track_rotation
from perrin.paper.claims import Claim, Item, Study, statistical
from perrin.paper.method import log_lags
from perrin.plot.figure_style import PALETTE

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from perrin.motion.rigid_motion import RigidMotion


_EXPERIMENT = "5 Experimental application"
_CONCLUSION = "6 Conclusion"

# The experiment: one tetrahedron of 2.45 um spheres, "less than 300 timesteps" in 220 s.
# Lengths in um, times in s, Pa s, K.
_DIAMETER, _SIGMA = 2.45, (0.03, 0.03, 0.04)

_DT, _EXPERIMENT_FRAMES, _FIT_LAGS = 0.73, 300, (3.0, 22.0)
_VISCOSITY, _TEMPERATURE = 2.18e-3, 295.0

# Table 1 as printed: coefficient and its error, then sizes with theirs, um.
_D_T, _D_T_ERROR = 3.85e-2, 0.49e-2

_D_R, _D_R_ERROR = 4.93e-3, 0.49e-3

_PRINTED = {
    "translation": {"cluster": (5.15, 0.67), "sphere": (2.79, 0.13)},
    "rotation": {"cluster": (4.94, 0.20), "sphere": (2.68, 0.11)},
}


def figure_5(study: Study) -> Item:
    """Repeat the experiment and the paper's fit on simulated tetrahedra (Eqs. 20 and 24, Fig. 5).

    Parameters
    ----------
    study : Study

    Returns
    -------
    Item
    """
    rng, repeats = study.rng("fig5"), study.repeats(300)
    first = _tracked(study, rng)
    curves = {"rotation": msad(first), "translation": msd(first)}
    fits = {name: fit_line(curve, lag_range=_FIT_LAGS) for name, curve in curves.items()}
    # D_R and D_T of plain straight lines over the paper's lag times.
    slopes = np.empty((repeats, 2))
    for row in slopes:
        motion = _tracked(study, rng)
        for column, curve in enumerate((msad(motion), msd(motion))):
            use = (curve.lagtime >= _FIT_LAGS[0]) & (curve.lagtime <= _FIT_LAGS[1])
            slope = np.polyfit(curve.lagtime[use], curve.value[use], 1)[0]
            row[column] = slope / (2 * curve.dof)
    table = pd.concat(
        [pd.DataFrame({"quantity": name, "lag_s": c.lagtime, "value": c.value, "stderr": c.stderr})
         for name, c in curves.items()], ignore_index=True,
    )  # fmt: skip
    # The fits to one track, with the procedure's own errors, and the first lag.
    body, at_first = Cluster.touching(4, _DIAMETER), {k: c.value[0] for k, c in curves.items()}
    floor = noise_floor(body, sigma=_SIGMA).phi2
    center = 2 * sum(s**2 for s in _SIGMA) / 4
    claims: tuple[Claim, ...] = (
        statistical("one track: D_R of the line from 3 to 22 s over the planted one", "Eq. 20, "
                    "Fig. 5, section 5", expected=1.0,
                    measured=fits["rotation"].value / _D_R,
                    stderr=fits["rotation"].stderr / _D_R),
        statistical("one track: D_T of the line from 3 to 22 s over the planted one", "Eq. 24, "
                    "Fig. 5, section 5", expected=1.0,
                    measured=fits["translation"].value / _D_T,
                    stderr=fits["translation"].stderr / _D_T),
        statistical("MSAD of one frame over 4 D_R dt + Phi^2", "Eqs. 20-23, Fig. 5, section 5",
                    expected=1.0, measured=float(at_first["rotation"] / (4 * _D_R * _DT + floor)),
                    stderr=float(curves["rotation"].stderr[0] / at_first["rotation"])),
        statistical("MSD of one frame over 6 D_T dt and its own offset 2 sum(sigma^2)/n", "Eq. 24, "
                    "Fig. 5, section 5", expected=1.0,
                    measured=float(at_first["translation"] / (6 * _D_T * _DT + center)),
                    stderr=float(curves["translation"].stderr[0] / at_first["translation"])),
    )  # fmt: skip
    # The true scatter of the paper's procedure, and the errors it prints.
    mean, spread = slopes.mean(axis=0), slopes.std(axis=0, ddof=1)
    relative = spread / (_D_R, _D_T)
    # Sizes are proportional to D_T^-1 and D_R^(-1/3) (Eqs. 26 and 27).
    size_errors = relative / (3, 1)
    error = 1 / np.sqrt(2 * repeats)
    claims += (
        statistical("mean D_R of the repeats over the planted one", "Table 1, section 5",
                    expected=1.0, measured=float(mean[0] / _D_R),
                    stderr=float(relative[0] / np.sqrt(repeats))),
        statistical("mean D_T of the repeats over the planted one", "Table 1, section 5",
                    expected=1.0, measured=float(mean[1] / _D_T),
                    stderr=float(relative[1] / np.sqrt(repeats))),
        statistical("relative error of D_R (printed 0.49/4.93)", "Table 1, section 5",
                    expected=_D_R_ERROR / _D_R, measured=float(relative[0]),
                    stderr=float(relative[0] * error),
                    remark=f"D_R of the paper's procedure scatters by {100 * relative[0]:.0f} % "
                           f"({1e3 * spread[0]:.2f}e-3 rad^2/s) over {repeats} repeats, not by the "
                           "printed 10 %."),
        statistical("relative error of D_T (printed 0.49/3.85)", "Table 1, section 5",
                    expected=_D_T_ERROR / _D_T, measured=float(relative[1]),
                    stderr=float(relative[1] * error),
                    remark=f"D_T of the paper's procedure scatters by {100 * relative[1]:.0f} % "
                           f"over {repeats} repeats, not by the printed 13 %."),
        statistical("least squares over all particles explains why the rotational size is the more "
                    "precise one, by a factor 3: relative spread of D_R over that of D_T",
                    "section 5", expected=1 / 3,
                    measured=float(relative[0] / relative[1]),
                    stderr=float(relative[0] / relative[1] * np.sqrt(2) * error),
                    remark=f"D_R and D_T scatter alike (ratio {relative[0] / relative[1]:.2f}): "
                           "the rotational size is the more precise one because d goes as "
                           "D_R^(-1/3) and as D_T^(-1)."),
        statistical("relative error of the rotational size over that of the translational one, "
                    "from Eqs. 26-27", "Eqs. 26-27, section 5", expected=1 / 3,
                    measured=float(size_errors[0] / size_errors[1]),
                    stderr=float(np.sqrt(2) * error / 3)),
    )  # fmt: skip

    def draw(figure: Figure) -> None:
        left, right = figure.subplots(1, 2)
        names = {"translation": ("s", "MSD (µm²)"), "rotation": ("o", "MSAD (rad²)")}
        t = np.array(_FIT_LAGS)
        for color, (kind, (marker, label)) in zip(reversed(_COLORS), names.items(), strict=True):
            curve, fit = curves[kind], fits[kind]
            lags = log_lags(len(curve.lagtime), 50) - 1
            left.loglog(curve.lagtime[lags], curve.value[lags], marker, mfc="none", mec=color,
                        ms=5, label=label)  # fmt: skip
            line = 2 * curve.dof * (fit.value * t + fit.offset)
            left.loglog(t, line, "-", color="#222222", lw=1.8)
        left.plot([], [], "-", color="#222222", label="straight lines, 3-22 s")
        left.set(xlabel="Δt (s)", ylabel="MSD (µm²), MSAD (rad²)")
        left.legend(frameon=False)
        bins = np.linspace(0, 2.2, 34)
        for i, name in ((1, "MSD, $D_T$"), (0, "MSAD, $D_R$")):
            right.hist(slopes[:, i] / (_D_R, _D_T)[i], bins, histtype="step", lw=1.6,
                       color=_COLORS[i], label=name)  # fmt: skip
        right.axvspan(0.9, 1.1, color="#dddddd", lw=0, label="printed error of $D_R$")
        right.set(xlabel="fitted / planted coefficient", ylabel=f"of {len(slopes)} repeats")
        right.legend(frameon=False)

    text = (
        f"A tetrahedron of {_DIAMETER} um spheres under the experiment's conditions "
        f"({_EXPERIMENT_FRAMES} frames every {_DT} s, noise 30, 30 and 40 nm, Table 1's "
        "coefficients planted), by the "
        "product of successive rotations, MSAD over the particles' directions, straight lines from "
        f"3 to 22 s with free offsets; then {repeats} repeats of the same."
    )
    return Item("fig5", _EXPERIMENT, "Fig. 5: MSD and MSAD of a tetrahedral cluster", text, table,
                draw, claims, size=(10.5, 4.8))  # fmt: skip


_COLORS = (PALETTE[1], PALETTE[0])


def _tracked(study: Study, rng: np.random.Generator) -> RigidMotion:
    """Return one simulated experiment, tracked by the product of successive rotations."""
    truth = simulate_motion(Cluster.touching(4, _DIAMETER), D_R=study.planted(_D_R), D_T=_D_T,
                            dt=_DT, n_frames=_EXPERIMENT_FRAMES, rng=rng)  # fmt: skip
    noisy = add_noise(truth.positions(), sigma=_SIGMA, rng=rng)
    return track_rotation(noisy, dt=_DT, reference="previous")


def table_1(study: Study) -> Item:
    """Redo the arithmetic of Table 1 from its printed coefficients (Eqs. 23 and 25-27).

    Parameters
    ----------
    study : Study
        Its random numbers make a track, whose estimates then get the printed values.

    Returns
    -------
    Item
    """
    motion = _tracked(study, study.rng("table1"))
    rotation = fit_line(msad(motion), lag_range=_FIT_LAGS)
    translation = fit_line(msd(motion), lag_range=_FIT_LAGS)
    known = {"viscosity": _VISCOSITY, "temperature": _TEMPERATURE}
    body = Cluster.touching(4, _DIAMETER)
    sizes = {
        "translation": size_from_translation(
            replace(translation, value=_D_T, stderr=_D_T_ERROR),
            cluster=body, factor="hoffmann2009", **known),
        "rotation": size_from_rotation(
            replace(rotation, value=_D_R, stderr=_D_R_ERROR),
            cluster=body, factor="hoffmann2009", **known),
    }  # fmt: skip
    rows = []
    for mode, size in sizes.items():
        for what in ("cluster", "sphere"):
            value, error = _PRINTED[mode][what]
            rows.append({
                "mode": mode, "diameter_of": what, "printed_um": value, "printed_error_um": error,
                "from_D_um": getattr(size, what), "propagated_error_um":
                getattr(size, f"{what}_stderr"),
            })  # fmt: skip
    table = pd.DataFrame(rows)
    claims, source = [], "Table 1, section 5"
    for _, row in table.iterrows():
        name = f"d_{'tetra' if row['diameter_of'] == 'cluster' else 'sphere'}, {row['mode']}"
        printed, error = row["printed_error_um"], row["propagated_error_um"]
        claims += [
            Claim(f"{name} (um)", f"Eqs. 25-27, {source}", row["printed_um"], row["from_D_um"],
                  0.005, "rounding"),
            Claim(f"error of {name} (um)", source, printed, error, 0.005, "rounding",
                  f"From the printed error of D follows ±{error:.2f} um for {name}, not the "
                  f"printed ±{printed:.2f}."),
        ]  # fmt: skip
    thermal = Boltzmann * _TEMPERATURE / (np.pi * _VISCOSITY) * 1e18
    claims += [
        Claim("D_T of the translational d_tetra (um^2/s)", "Eq. 26, section 5", _D_T,
              thermal / (3 * sizes["translation"].cluster), 1e-9, "rounding"),
        Claim("D_R of the rotational d_tetra (rad^2/s)", "Eq. 27, section 5", _D_R,
              thermal / sizes["rotation"].cluster**3, 1e-9, "rounding"),
    ]  # fmt: skip
    trans, rot = sizes["translation"].sphere, sizes["rotation"].sphere
    phi = float(np.sqrt(noise_floor(Cluster.touching(4, _DIAMETER), sigma=_SIGMA).phi2))
    claims += [
        Claim("d_tetra over d_sphere", "Eq. 25, section 5", 1.844,
              sizes["rotation"].cluster / rot, 1e-9, "rounding"),
        Claim("the two sizes agree within 4 %: their difference (%)", "Table 1, section 5", 4.0,
              100 * (trans / rot - 1), 0.5, "rounding"),
        Claim("excess of the rotational d_sphere over 2.45 um (%)", "Table 1, section 5", 9.0,
              100 * (rot / _DIAMETER - 1), 0.5, "rounding"),
        Claim("excess in the earlier analysis, as the translational d_sphere (%)",
              "Table 1, section 5", 14.0, 100 * (trans / _DIAMETER - 1), 0.5, "rounding"),
        Claim("angular resolution Phi of touching 2.45 um spheres, sigma = 30, 30, 40 nm (rad; "
              "printed 0.028)", "Eq. 23, section 5", 0.0275, phi, 6e-4, "0.0006 rad"),
        Claim("the same in degrees", "Eq. 23, section 5", 1.6, float(np.rad2deg(phi)), 0.05,
              "rounding"),
    ]  # fmt: skip

    def draw(figure: Figure) -> None:
        ax = figure.subplots()
        place = np.arange(len(table))
        style: dict[str, Any] = {"fmt": "o", "capsize": 4}
        ax.errorbar(place - 0.1, table["printed_um"], table["printed_error_um"], **style,
                    color=PALETTE[1], label="printed")  # fmt: skip
        ax.errorbar(place + 0.1, table["from_D_um"], table["propagated_error_um"], **style,
                    color=PALETTE[0], label="from the printed D, errors propagated")  # fmt: skip
        ax.axhline(_DIAMETER, color="#222222", ls="--", lw=1, label="2.45 µm (light scattering)")
        names = [f"{m}\n$d_{{\\rm {'tetra' if w == 'cluster' else 'sphere'}}}$"
                 for m, w in zip(table["mode"], table["diameter_of"], strict=True)]  # fmt: skip
        ax.set_xticks(place, names)
        ax.set(ylabel="diameter (µm)", ylim=(2, 6.2))
        ax.legend(frameon=False)

    text = (
        "T = 295 K, viscosity 2.18 mPa s, d_tetra = 1.844 d_sphere. The sizes follow from the "
        "printed D_T = 0.0385(49) um^2/s and D_R = 0.00493(49) rad^2/s."
    )
    return Item("table1", _EXPERIMENT, "Table 1: sizes of the tetrahedral cluster", text, table,
                draw, tuple(claims), size=(7, 4.6))  # fmt: skip


def conclusion(study: Study) -> Item:
    """Remove the bulk rotation of 500 diffusing particles in a turning frame (section 6).

    Parameters
    ----------
    study : Study

    Returns
    -------
    Item
    """
    rng, D = study.rng("conclusion"), 0.01
    frames, turns = 300, 0.01
    start = rng.uniform(-10, 10, (500, 3))
    free = start + np.cumsum(rng.normal(scale=np.sqrt(2 * D), size=(frames, 500, 3)), axis=0)
    turn = Rotation.from_rotvec(turns * np.arange(frames)[:, None] * [0.6, 0.0, 0.8]).as_matrix()
    turning = np.einsum("tij,tnj->tni", turn, free)
    drift = np.arange(frames)[:, None, None] * [0.05, -0.02, 0.03]
    table = pd.DataFrame({"lag_s": np.arange(1.0, frames)})
    claims = []
    for name, seen in (("without drift", turning), ("with drift", turning + drift)):
        still, motion = remove_rotation(seen, dt=1.0)
        raw, clean = msd(seen, dt=1.0), msd(still, dt=1.0)
        table[f"seen {name}"], table[f"removed {name}"] = raw.value, clean.value
        found = fit_line(clean, lag_range=(1, 10)).value
        angle = np.linalg.norm(motion.step_vectors(), axis=1).mean()
        claims += [
            Claim("diffusion of the particles after the bulk rotation is removed, over the "
                  f"planted one, {name}", "section 6", 1.0, found / D, 0.02, "2 %"),
            Claim(f"rotation per frame that was removed (rad), {name}", "section 6", turns,
                  float(angle), 0.02 * turns, "2 %"),
        ]  # fmt: skip

    def draw(figure: Figure) -> None:
        ax = figure.subplots()
        shown = log_lags((len(table) + 1) / 2, 30) - 1
        t = table["lag_s"][shown]
        for color, name in zip(PALETTE, ("without drift", "with drift"), strict=False):
            ax.loglog(t, table[f"seen {name}"][shown], "--", color=color, label=f"seen, {name}")
            ax.loglog(t, table[f"removed {name}"][shown], "-", color=color,
                      label=f"rotation removed, {name}")  # fmt: skip
        ax.loglog(t[::2], 6 * D * t[::2], "o", mfc="none", mec="#222222", label="6 D Δt")
        ax.set(xlabel="Δt (s)", ylabel="MSD (µm²)")
        ax.legend(frameon=False)

    text = (
        "500 independent particles (D = 0.01 um^2/s) in a box of 20 um that turns by 0.01 rad a "
        "frame, without and with a drift: MSD as seen, and after `remove_rotation`."
    )
    return Item("conclusion", _CONCLUSION, "Bulk rotation of a many-body system", text, table, draw,
                tuple(claims), size=(6.5, 4.8))  # fmt: skip
