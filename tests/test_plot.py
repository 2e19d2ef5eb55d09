"""Figures of results show the numbers of the results."""

from __future__ import annotations

import re
import zlib
from dataclasses import replace
from io import BytesIO

import numpy as np
import pandas as pd
import pytest
from matplotlib import rcParams
from matplotlib.colors import to_hex, to_rgba
from matplotlib.figure import Figure
from scipy.integrate import trapezoid

import perrin
from left_out import leave_out_tensors, leave_out_verdicts, make_figures_without_rendering
from perrin._text import number_text
from perrin.diffusion.estimate import DiffusionEstimate, bare_text, value_text
from perrin.plot import figure_style, report_figures
from perrin.plot import results as plot


def measured(*, clusters=1, frames=201, planar=False, labels=None, D_R=0.02, gaps=False):
    rng = np.random.default_rng(3)
    square = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.2, 1.1]])
    body = perrin.Cluster.from_positions(square) if planar else perrin.Cluster.tetrahedron(1.5)
    parts = []
    for k in range(clusters):
        truth = perrin.simulate_motion(body, D_R=D_R, D_T=0.04, dt=0.5, n_frames=frames, rng=rng)
        x = perrin.add_noise(truth.positions(), sigma=0.03, rng=rng)
        frame, particle = np.indices(x.shape[:2]).reshape(2, -1)
        part = pd.DataFrame({"frame": frame, "particle": particle + 4 * k})
        part["cluster"] = labels[k] if labels else k
        part[list("xyz")[: x.shape[2]]] = x.reshape(-1, x.shape[2])
        parts.append(part)
    table = pd.concat(parts, ignore_index=True)
    if gaps:
        lost = table["frame"].isin((20, 21, 40)) & (table["particle"] % 4 > 0)
        table = table[~lost & ~((table["frame"] == 50) & (table["particle"] == 2))]
    return perrin.analyze(table, dt=0.5)


@pytest.fixture(scope="module")
def space():
    with pytest.MonkeyPatch.context() as patch:
        leave_out_tensors(patch)
        leave_out_verdicts(patch)
        return measured(gaps=True).clusters[0]


@pytest.fixture(scope="module")
def plane():
    return measured(planar=True).clusters[0]


@pytest.fixture(scope="module")
def three():
    with pytest.MonkeyPatch.context() as patch:
        leave_out_tensors(patch)
        return measured(clusters=3, frames=20, labels=["<b>", "a$_b$", "c"])


def axes(**kwargs):
    return Figure().add_subplot(**kwargs)


def line(ax, start):
    (found,) = [x for x in ax.lines if str(x.get_label()).startswith(start)]
    return found


def drawn(ax):
    ax.figure.canvas.draw()
    return ax


def estimate(**changes):
    usual = DiffusionEstimate(
        value=0.01, ci68=(0.009, 0.011), ci95=(0.008, 0.012), stderr=0.001, offset=1e-4,
        offset_stderr=1e-5, resolution_floor=1e-9, resolved=True, unit="rad^2/s", method="mle",
        n_frames=100, snr=50.0,
    )  # fmt: skip
    return replace(usual, **changes)


def test_lag_curve_shows_curve_fit_pure_diffusion_and_floor(space):
    curve, fit = space.msad, space.D_R
    ax = axes()
    assert plot.plot_lag_curve(curve, ax=ax, estimate=fit, floor=space.noise.phi2) is ax
    sure, faint = line(ax, "MSAD"), line(ax, "beyond")
    x, y = (np.concatenate([a.get_data()[i] for a in (sure, faint)]) for i in (0, 1))
    assert np.array_equal(x, curve.lagtime)
    assert np.array_equal(y, curve.value)
    assert sure.get_xdata().max() <= curve.lagtime[-1] / 4 < faint.get_xdata().min()
    assert faint.get_alpha() < 0.5
    t, fitted = line(ax, "ML fit").get_data()
    assert np.allclose(fitted, 4 * (fit.value * t + fit.offset), rtol=1e-12)
    t, pure = line(ax, "pure diffusion").get_data()
    assert np.allclose(pure, 4 * fit.value * t, rtol=1e-12)
    assert line(ax, "pure diffusion").get_markerfacecolor() == "none"
    assert list(line(ax, "noise floor").get_ydata()) == [space.noise.phi2] * 2
    assert (ax.get_xscale(), ax.get_yscale()) == ("log", "log")
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("lag time (s)", "MSAD (rad²)")
    low, high = ax.get_ylim()
    assert low < space.noise.phi2 < np.nanmax(curve.value) < high


def test_lag_curve_band_is_one_standard_error(space):
    ax = axes()
    plot.plot_lag_curve(space.msd, ax=ax)
    corners = ax.collections[0].get_paths()[0].vertices
    t, value, error = (a[:5] for a in (space.msd.lagtime, space.msd.value, space.msd.stderr))
    for x, middle, half in zip(t, value, error, strict=True):
        at = corners[np.isclose(corners[:, 0], x), 1]
        assert at.min() == pytest.approx(middle - half)
        assert at.max() == pytest.approx(middle + half)
    assert ax.get_ylabel() == "MSD (µm²)"


def test_lag_curve_in_the_plane_has_its_own_factors(plane):
    ax, fit = axes(), plane.D_R
    plot.plot_lag_curve(plane.msad, ax=ax, estimate=fit, label="my data")
    t, fitted = line(ax, "ML fit").get_data()
    assert np.allclose(fitted, 2 * (fit.value * t + fit.offset))
    assert "2 $D_R$ t" in line(ax, "pure").get_label()
    assert line(ax, "my data").get_marker() == "."


def test_lag_curve_with_a_negative_offset_has_no_points_without_a_logarithm(space):
    ax = axes()
    plot.plot_lag_curve(space.msad, ax=ax, estimate=estimate(offset=-0.02), floor=0.0)
    t, fitted = line(ax, "ML fit").get_data()
    assert np.array_equal(np.isnan(fitted), 0.01 * t <= 0.02)
    assert not [x for x in ax.lines if str(x.get_label()).startswith("noise")]
    drawn(ax)


def test_an_unresolved_estimate_is_a_limit_without_pure_diffusion(space):
    ax = axes()
    limit = estimate(value=0.0, ci68=(0, 1e-3), ci95=(0, 2.04e-3), resolved=False)
    plot.plot_lag_curve(space.msad, ax=ax, estimate=limit)
    assert "< 0.0020 rad²/s (95 %)" in line(ax, "ML fit").get_label()
    assert not [x for x in ax.lines if str(x.get_label()).startswith("pure")]


@pytest.fixture(scope="module")
def rod():
    """Return the result of a body that rotates ten times faster about its long axis."""
    body = perrin.Cluster.from_positions([[-3, 0, 0], [0, 0.5, 0.3], [0.2, -0.6, 0.4], [3, 0, 0]])
    rng = np.random.default_rng(5)
    truth = perrin.simulate_motion(
        body, D_R=[2e-2, 2e-3, 2e-3], D_T=0.04, dt=0.5, n_frames=600, rng=rng
    )
    x = perrin.add_noise(truth.positions(), sigma=0.06, rng=rng)
    frame, particle = np.indices(x.shape[:2]).reshape(2, -1)
    table = pd.DataFrame({"frame": frame, "particle": particle, "cluster": 0})
    table[["x", "y", "z"]] = x.reshape(-1, 3)
    return perrin.analyze(table, dt=0.5).clusters[0]


def test_the_msad_of_an_anisotropic_body_is_compared_with_its_tensor(rod):
    """Line, circles and floor are those of the directions averaged: W = 1 - <p p^T>."""
    left = report_figures.curve_figure(rod).axes[0]
    unit = rod.motion.template / np.linalg.norm(rod.motion.template, axis=1, keepdims=True)
    W = np.eye(3) - unit.T @ unit / len(unit)
    D, noise = np.trace(rod.tensor.tensor @ W), np.trace(rod.tensor.offset @ W)
    t, fitted = line(left, "tensor").get_data()
    np.testing.assert_allclose(fitted, 2 * (D * t + noise), rtol=1e-9)
    t, pure = line(left, "pure diffusion 4").get_data()
    np.testing.assert_allclose(pure, 2 * D * t, rtol=1e-9)
    (floor,) = set(line(left, "noise floor").get_ydata())
    assert floor == pytest.approx(2 * np.trace(rod.noise.covariance @ W), rel=1e-9)
    shown = number_text(*rod.tensor.weighted(W))
    assert shown in line(left, "tensor").get_label()
    assert not [x for x in left.lines if str(x.get_label()).startswith("ML fit")]
    value, stderr = rod.tensor.weighted(W)
    corners = left.collections[-1].get_paths()[0].vertices
    at = corners[np.isclose(corners[:, 0], t[0]), 1]
    assert at.max() == pytest.approx(4 * (value * t[0] + noise / 2 + stderr * t[0]), rel=1e-9)


def test_the_first_points_of_an_anisotropic_body_lie_on_the_tensors_line(rod):
    """At lags 1 and 2 the points are within 2 of their errors; D_R's line is off by more than 3."""
    curve = rod.msad
    D = rod.tensor.weighted(curve.weights)[0]
    noise = np.trace(rod.tensor.offset @ curve.weights)
    pull = (curve.value - 4 * D * curve.lagtime - 2 * noise) / curve.stderr
    assert np.abs(pull[:2]).max() < 2
    mean = 4 * (rod.D_R.value * curve.lagtime + rod.D_R.offset)
    assert np.abs((curve.value - mean) / curve.stderr)[0] > 3


def test_curves_of_uneven_times_are_drawn_at_their_lags():
    """Every lag of a short curve with pauses is a point at its mean time."""
    rng = np.random.default_rng(8)
    interval = np.where(np.arange(59) % 15 == 14, 20.0, 0.7)
    x = perrin.simulate_motion(
        perrin.Cluster.tetrahedron(1.5), D_R=1e-3, D_T=0.02, dt=0.7, n_frames=60, rng=rng
    ).positions()
    motion = perrin.track_rotation(x, dt=0.7, times=np.append(0, interval.cumsum()))
    curve = perrin.msd(motion)
    ax = drawn(plot.plot_lag_curve(curve, ax=axes(), estimate=estimate(unit="um^2/s")))
    t = np.concatenate([line(ax, name).get_xdata() for name in ("MSD", "beyond")])
    np.testing.assert_array_equal(t, curve.lagtime)


def test_long_curves_are_thinned_evenly_on_the_logarithm():
    walk = np.random.default_rng(1).normal(size=(100_000, 1, 3)).cumsum(axis=0)
    curve = perrin.msd(walk, dt=0.1)
    ax = axes()
    plot.plot_lag_curve(curve, ax=ax)
    t = np.concatenate([line(ax, name).get_xdata() for name in ("MSD", "beyond")])
    assert 100 < len(t) <= 200
    assert (t[0], t[-1]) == (curve.lagtime[0], curve.lagtime[-1])
    value = line(ax, "MSD").get_ydata()
    assert value[-1] == curve.value[np.searchsorted(curve.lagtime, line(ax, "MSD").get_xdata()[-1])]


def test_a_curve_of_zeros_can_be_drawn():
    curve = perrin.msd(np.zeros((10, 1, 3)), dt=1.0)
    drawn(plot.plot_lag_curve(curve, ax=axes()))


def test_residuals_presence_and_refused_frames(space):
    motion = space.motion
    ax = axes()
    assert plot.plot_residual(motion, ax=ax) is ax
    t, shown = line(ax, "rms residual").get_data()
    assert np.array_equal(t, motion.time)
    assert np.allclose(shown, 1e3 * motion.residual, equal_nan=True)
    assert ax.get_ylabel() == "residual (nm)"
    assert list(line(ax, "no pose (3 of 201").get_xdata()) == [10.0, 10.5, 20.0]
    expected = line(ax, "expected").get_ydata()
    assert expected[0] == pytest.approx(1e3 * motion.sigma * np.sqrt(6 / 4))
    assert expected[50] == pytest.approx(1e3 * motion.sigma * np.sqrt(3 / 3))
    # The residuals agree with it on average.
    ratio = np.nanmean(motion.residual**2) / np.nanmean((expected / 1e3) ** 2)
    assert ratio == pytest.approx(1, abs=0.1)
    ax = axes()
    assert plot.plot_presence(motion, ax=ax) is ax
    assert np.array_equal(ax.lines[0].get_ydata(), motion.n_present)
    assert list(ax.lines[1].get_ydata()) == [1, 1, 1]
    assert ax.get_xlabel() == "time (s)"


def test_large_residuals_are_in_um(space):
    big = replace(space.motion, residual=1e3 * space.motion.residual)
    ax = axes()
    plot.plot_residual(big, ax=ax)
    assert ax.get_ylabel() == "residual (µm)"
    assert np.allclose(ax.lines[0].get_ydata(), big.residual, equal_nan=True)


def test_orientations_lie_on_the_sphere_and_end_where_the_motion_ends(space):
    ax = axes(projection="3d")
    assert plot.plot_orientations(space.motion, ax=ax) is ax
    paths = space.motion.orientation(space.motion.template)
    faint = [x for x in ax.lines if x.get_alpha() == 0.35]
    assert len(faint) == 4
    for i, path in enumerate(faint):
        assert np.allclose(np.transpose(path.get_data_3d()), paths[:, i], equal_nan=True)
    ends = [x for x in ax.lines if x.get_marker() == "o" and len(x.get_data_3d()[0])]
    assert np.allclose([np.ravel(x.get_data_3d()) for x in ends], paths[-1])
    assert len({to_rgba(x.get_color()) for x in faint}) == 4
    assert list(ax.get_box_aspect() / ax.get_box_aspect()[0]) == [1, 1, 1]
    drawn(ax)


def test_orientation_in_the_plane_is_the_unbounded_angle(plane):
    ax = axes()
    assert plot.plot_orientations(plane.motion, ax=ax) is ax
    angle = plane.motion.rotational_displacement([1.0, 0.0])[:, 0]
    assert np.array_equal(ax.lines[0].get_ydata(), angle)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("time (s)", "angle φ (rad)")


def segments(ax):
    return [np.array(c.get_segments()) for c in ax.collections if hasattr(c, "get_segments")]


def test_forest_shows_values_intervals_and_the_pooled_band(three):
    report, ax = three, axes()
    assert plot.plot_forest(report.clusters, ax=ax, pooled=report.pooled.D_R) is ax
    wide, narrow = segments(ax)
    for k, result in enumerate(report.clusters):
        assert tuple(wide[k][:, 0]) == result.D_R.ci95
        assert tuple(narrow[k][:, 0]) == result.D_R.ci68
        assert (wide[k][:, 1] == k).all()
    assert list(ax.lines[0].get_xdata()) == [c.D_R.value for c in report.clusters]
    pooled = line(ax, "pooled")
    assert list(pooled.get_xdata()) == [report.pooled.D_R.value] * 2
    bands = [(p.get_x(), p.get_x() + p.get_width()) for p in ax.patches]
    assert np.allclose(bands, [report.pooled.D_R.ci95, report.pooled.D_R.ci68])
    assert [t.get_text() for t in ax.get_yticklabels()] == ["<b>", "a$_b$", "c"]
    assert ax.get_xlabel() == "$D_R$ (rad²/s)"
    drawn(ax)
    plot.plot_forest(report.clusters, ax=ax, quantity="translation")
    assert ax.get_xlabel() == "$D_T$ (µm²/s)"


def test_forest_with_limits_open_ends_and_wide_ranges(space):
    odd = [
        estimate(),
        estimate(value=0.0, ci68=(0, 1e-4), ci95=(0, 2e-4), resolved=False),
        estimate(value=0.0, ci68=(0, np.inf), ci95=(0, np.inf), resolved=False),
        estimate(value=0.02, ci95=(0.001, np.inf)),
        estimate(value=3.0, ci68=(2, 4), ci95=(1, 5)),
    ]
    clusters = [replace(space, D_R=e) for e in odd]
    for some in (clusters, clusters[1:3], clusters[:2], clusters[2:3]):
        ax = axes()
        plot.plot_forest(some, ax=ax, pooled=some[0].D_R)
        assert np.isfinite(ax.get_xlim()).all()
        drawn(ax)
    ax = axes()
    plot.plot_forest(clusters, ax=ax)
    assert ax.get_xscale() == "log"
    limits, beyond = ax.lines[1], ax.lines[2]
    assert limits.get_xdata()[0] == 2e-4
    assert list(limits.get_ydata()) == [1, 2]
    assert list(beyond.get_ydata()) == [3]


def test_forest_of_many_clusters_is_ordered_by_value(space):
    values = np.random.default_rng(2).uniform(0.01, 0.02, size=61)
    clusters = [replace(space, D_R=estimate(value=v, ci68=(v, v), ci95=(v, v))) for v in values]
    ax = axes()
    plot.plot_forest(clusters, ax=ax)
    assert list(ax.lines[0].get_xdata()) == sorted(values)
    assert "ordered" in ax.get_ylabel()


def without_layout(figure):
    figure.set_layout_engine("none")
    return figure


@pytest.mark.parametrize("planar", [False, True])
def test_save_figures_names_its_files_and_changes_no_setting(
    tmp_path, planar, monkeypatch, repeats
):
    sheet = None
    if repeats(True, False):
        # The layout of the figures and the subsets of fonts take most of the time.
        sheet = {"savefig.dpi": 30, "pdf.fonttype": 3}
        figure = report_figures.column_figure
        monkeypatch.setattr(
            report_figures,
            "column_figure",
            lambda height, columns=2: without_layout(figure(height, columns=columns)),
        )
        if planar:
            make_figures_without_rendering(monkeypatch)
        else:
            # The fonts of one PDF file are those of all.
            draw = Figure.savefig
            monkeypatch.setattr(
                Figure,
                "savefig",
                lambda figure, to, **how: (
                    to.write_bytes(bytes(2001))
                    if to.name in ("cluster-0-residuals.pdf", "cluster-0-orientations.pdf")
                    else draw(figure, to, **how)
                ),
            )
    before = dict(rcParams)
    report = measured(planar=planar, frames=20)
    seen = []
    files = report_figures.save_figures(
        report, tmp_path, sheet=sheet, progress=lambda *state: seen.append(state)
    )
    assert seen == [(k, 3, "drawing the figures") for k in range(3)]
    kinds = ("curves", "residuals", "orientations")
    names = [f"cluster-0-{kind}.{end}" for kind in kinds for end in ("png", "pdf")]
    assert [f.name for f in files] == names
    assert sorted(f.name for f in tmp_path.iterdir()) == sorted(names)
    assert all(f.stat().st_size > 2000 for f in files)
    assert dict(rcParams) == before


def test_save_figures_draws_the_first_cluster_and_all_in_one(three, tmp_path, monkeypatch):
    monkeypatch.setattr(figure_style, "save_figure", lambda _, stem: [stem])
    files = report_figures.save_figures(three, tmp_path)
    stems = {f.name for f in files}
    assert "clusters" in stems
    assert {s.split("-")[1] for s in stems if "-" in s} == {"0"}
    monkeypatch.setattr(report_figures, "orientation_figure", lambda _, columns: None)
    wanted = report_figures.save_figures(three, tmp_path, clusters=(2,))
    assert {f.name.split("-")[1] for f in wanted if "-" in f.name} == {"2"}


def test_fonts_in_pdf_files_are_glyphs_without_tables_that_place_them(tmp_path):
    """The texts of a PDF have all their glyphs as TrueType outlines, and the option is restored."""
    from fontTools.subset import Options
    from fontTools.ttLib import TTFont

    before = list(Options().drop_tables)
    with figure_style.style():
        figure = figure_style.new_figure(2, 1)
        figure.text(0, 0.5, "AVON σ² 10⁻³")
        content = figure_style.save_figure(figure, tmp_path / "text")[1].read_bytes()
    fonts = []
    for part in re.findall(rb"/Length1 \d+.*?stream\r?\n(.*?)\r?\nendstream", content, re.S):
        fonts.append(TTFont(BytesIO(zlib.decompress(part))))
    outlines = [g for f in fonts for g in f.getGlyphOrder() if f["glyf"][g].numberOfContours > 0]
    assert len(outlines) >= len(set("AVONσ²10⁻³"))
    assert not any(table in font for font in fonts for table in ("GSUB", "GPOS", "GDEF"))
    assert Options().drop_tables == before


@pytest.mark.parametrize(
    ("low", "high", "texts"), [(0.3, 20, "0.5 1 2 5 10"), (0.3, 2000, "10⁰ 10¹ 10²")]
)
def test_ticks_of_logarithmic_axes_are_few_and_in_plain_text(low, high, texts):
    ax = axes()
    ax.set(yscale="log", ylim=(low, high))
    figure_style.log_ticks(ax.yaxis)
    shown = [t for t in ax.get_yticks() if low <= t <= high]
    written = [ax.yaxis.get_major_formatter()(t) for t in shown]
    assert set(texts.split()) <= set(written)
    assert len(shown) + len([t for t in ax.get_yticks(minor=True) if low <= t <= high]) < 25


@pytest.mark.parametrize("columns", [1, 2])
def test_figures_of_runs_have_the_sizes_of_the_style_sheet(three, columns):
    """Widths are 3.4 and 7.0 inches, or those of another sheet, whose text and colours count."""
    result = three.clusters[0]
    for sheet, widths in ((None, (3.4, 7.0)), ({"figure.figsize": (6.2, 3.0)}, (3.0, 6.2))):
        with figure_style.style(sheet=sheet):
            for draw in (report_figures.curve_figure, report_figures.residual_figure):
                assert draw(result, columns=columns).get_figwidth() == widths[columns - 1]
            figure = report_figures.forest_figure(three.clusters, three.pooled, columns=columns)
            assert figure.get_figwidth() == widths[columns - 1]
    sheet = {"font.size": 13, "lines.linewidth": 4, "axes.prop_cycle": "cycler('color', ['m'])"}
    with figure_style.style(sheet=sheet):
        ax = report_figures.curves(result, ax=axes())
    fit = line(ax, "ML fit")
    assert (fit.get_color(), fit.get_linewidth()) == (to_hex("m"), pytest.approx(0.95 * 4))
    assert ax.xaxis.label.get_size() == 13
    with pytest.raises(ValueError, match="columns: expected"):
        figure_style.column_width(3)
    with pytest.raises(OSError, match="nonsense"), figure_style.style(sheet="nonsense"):
        pass


def test_every_line_and_symbol_of_the_figures_follows_the_sheet(three):
    """A sheet with doubled lines and symbols doubles all of them, in every figure of a run."""
    result, drawn = three.clusters[0], []
    for factor in (1, 2):
        sheet = {"lines.linewidth": 1.0 * factor, "lines.markersize": 4.0 * factor}
        with figure_style.style(sheet=sheet):
            figures = [report_figures.forest_figure(three.clusters, three.pooled)]
            figures += [report_figures.curve_figure(result), report_figures.residual_figure(result)]
        drawn.append([x for f in figures for ax in f.axes for x in ax.lines])
    for thin, thick in zip(*drawn, strict=True):
        assert thick.get_linewidth() == pytest.approx(2 * thin.get_linewidth())
        assert thick.get_markersize() == pytest.approx(2 * thin.get_markersize())


def test_curves_and_forest_of_a_report_are_those_of_its_results(three):
    """`curves(report, cluster=2)` draws the MSAD of cluster 2; the ratio divides it by 4 D_R t."""
    result = three.clusters[2]
    for quantity, curve, D in (("rotation", result.msad, result.D_R),
                               ("translation", result.msd, result.D_T)):  # fmt: skip
        ax = report_figures.curves(three, cluster=2, quantity=quantity)
        points = np.concatenate([x.get_xydata() for x in ax.lines if x.get_marker() == "."])
        assert np.array_equal(points, np.stack([curve.lagtime, curve.value], axis=1))
        ax = report_figures.curves(three, cluster=2, quantity=quantity, ratio=True)
        points = np.concatenate([x.get_xydata() for x in ax.lines if x.get_marker() == "."])
        pure = 2 * curve.dof * D.value * curve.lagtime
        np.testing.assert_allclose(points[:, 1], curve.value / pure, rtol=1e-12)
        x, y = line(ax, "ML fit").get_data()
        np.testing.assert_allclose(y, 1 + D.offset / (D.value * x), rtol=1e-12)
        corners = ax.collections[0].get_paths()[0].vertices
        first = corners[np.isclose(corners[:, 0], curve.lagtime[0]), 1]
        assert np.ptp(first) == pytest.approx(2 * curve.stderr[0] / pure[0], rel=1e-9)
    ax = report_figures.forest(three)
    assert list(ax.lines[0].get_xdata()) == [c.D_R.value for c in three.clusters]
    assert three.pooled.D_R.value in line(ax, "pooled").get_xdata()
    given = axes()
    assert report_figures.residuals(three, cluster=1, ax=given) is given


def test_trajectories_and_steps_are_those_of_the_motion(three):
    """Paths begin at 0 and end at the whole displacement; steps of all axes are counted once."""
    result = three.clusters[1]
    motion = result.motion
    ax = report_figures.trajectory(three, cluster=1)
    ends = [x.get_ydata()[-1] for x in ax.lines]
    np.testing.assert_allclose(ends, motion.center[-1] - motion.center[0], rtol=1e-12)
    ax = report_figures.trajectory(result, quantity="rotation")
    drawn = np.stack([x.get_ydata() for x in ax.lines], axis=1)
    assert np.array_equal(drawn, motion.accumulated_rotation())
    for quantity, D in (("rotation", result.D_R), ("translation", result.D_T)):
        found = perrin.plot.step_distribution(result, quantity)
        assert found.number.sum() == 3 * (len(motion.time) - 1)
        x = np.linspace(-1, 1, 20001) * 12 * np.sqrt(found.variance.max())
        law = found.density(x)
        assert trapezoid(law, x) == pytest.approx(1, abs=1e-6)
        mean = 2 * (D.value * motion.dt + D.offset)
        assert trapezoid(x**2 * law, x) == pytest.approx(mean, rel=0.02)
        ax = report_figures.steps(three, cluster=1, quantity=quantity)
        (points,) = ax.containers
        width = found.edges[1] - found.edges[0]
        assert points[0].get_ydata().sum() * width == pytest.approx(1, rel=1e-12)
        np.testing.assert_allclose(
            line(ax, "law").get_ydata(), found.density(line(ax, "law").get_xdata())
        )


def test_figures_of_a_report_ask_which_cluster(three):
    """Several clusters need a number that exists; a result needs none."""
    with pytest.raises(ValueError, match="cluster: expected one of 0, 1, 2, got none"):
        report_figures.curves(three)
    with pytest.raises(ValueError, match="got 7"):
        report_figures.steps(three, cluster=7)
    with pytest.raises(ValueError, match="quantity"):
        report_figures.trajectory(three, cluster=0, quantity="msd")


PAPER = {"D_R": 4.93e-3, "sigma": (0.03, 0.03, 0.04)}


def test_a_plan_shows_its_errors_window_and_the_paper_s_rules():
    plan = perrin.plan_sampling(perrin.Cluster.touching(4, 2.45), **PAPER, n_frames=300)
    ax = axes()
    assert plot.plot_plan(plan, ax=ax) is ax
    for name, error in (
        ("noise estimated", plan.error),
        ("noise from the residuals", plan.error_residual),
    ):
        sure = line(ax, name)
        (lost,) = [
            x for x in ax.lines
            if x.get_color() == sure.get_color() and x is not sure and x.get_linestyle() == "--"
        ]  # fmt: skip
        joined = [
            np.append(a[:-1], b) for a, b in zip(sure.get_data(), lost.get_data(), strict=True)
        ]
        assert np.array_equal(joined, [plan.dt, 100 * error])
        assert sure.get_xdata()[-1] <= plan.dt_rigid
    (best,) = [x for x in ax.lines if str(x.get_label()).startswith("best, 0.766 s")]
    assert list(best.get_xydata()[0]) == [plan.dt_best, 100 * plan.expected_error]
    (window,) = ax.patches
    assert (window.get_x(), window.get_x() + window.get_width()) == pytest.approx(
        (plan.dt_min, plan.dt_max)
    )
    (rules,) = segments(ax)
    assert [r[0, 0] for r in rules] == [plan.paper_dt_min, plan.paper_dt_max]
    low, high = ax.get_xlim()
    assert low < plan.paper_dt_min < plan.paper_dt_max < high
    assert (ax.get_xscale(), ax.get_yscale()) == ("log", "log")
    assert ax.get_xlabel() == "time between frames (s)"
    assert ax.get_ylabel() == "expected error of $D_R$ (%)"
    drawn(ax)


@pytest.mark.parametrize(
    "budget",
    [
        {"total_time": 220},
        {"n_frames": 300, "total_time": 220, "photons": True},
        {"n_frames": 300, "sigma": 0.3},
        {"total_time": 2.0},
    ],
)
def test_every_plan_can_be_drawn(budget):
    plan = perrin.plan_sampling(perrin.Cluster.touching(4, 2.45), **(PAPER | budget))
    ax = axes()
    plot.plot_plan(plan, ax=ax)
    assert len(ax.patches) == (plan.dt_min < plan.dt_max)
    assert np.isfinite(ax.get_xlim()).all()
    drawn(ax)


def test_texts_of_estimates():
    assert value_text(estimate()) == "0.0100(10) rad²/s"
    small = estimate(value=4.7e-7, stderr=5e-8, unit="um^2/s")
    assert value_text(small) == "4.7(5) × 10⁻⁷ µm²/s"
    unbounded = estimate(value=0.0, ci95=(0.0, np.inf), resolved=False)
    assert bare_text(unbounded) == "< ∞"
    assert number_text(5e-5, 9e-4) == "0(9) × 10⁻⁴"
    assert [number_text(v) for v in (0.0, 30, -1843, 2.5e9)] == [
        "0", "30.0", "−1840", "2.50 × 10⁹"
    ]  # fmt: skip


def test_van_hove_shows_the_bins_and_the_gaussian(space):
    """Points at the bins' middles with their density, the Gaussian, and alpha_2."""
    result = perrin.van_hove(space.motion, lag=1.0, bins=9)
    ax = drawn(plot.plot_van_hove(result, ax=axes()))
    (points,) = ax.containers
    full = result.density > 0
    middle = (result.edges[1:] + result.edges[:-1]) / 2
    np.testing.assert_allclose(points.lines[0].get_xdata(), middle[full])
    np.testing.assert_allclose(points.lines[0].get_ydata(), result.density[full])
    np.testing.assert_allclose(line(ax, "Gaussian").get_ydata(), result.gaussian)
    assert "α₂" in points.get_label()
    assert ax.get_xlabel() == "rotation in 1 s (rad)"
    angles = perrin.van_hove(space.motion, lag=1.0, quantity="angle", bins=9)
    ax = drawn(plot.plot_van_hove(angles, ax=axes()))
    np.testing.assert_allclose(line(ax, "Brownian rotation").get_ydata(), angles.brownian)
    assert ax.get_xlabel() == "rotation angle in 1 s (rad)"


def test_the_nearer_sphere_of_a_drawn_cluster_hides_the_other():
    """The middle of the picture has the colour of the sphere in front, seen from either side."""
    pair = perrin.Cluster(np.array([[0.0, 0, 1], [0, 0, -1]]))
    for view, front in ((np.eye(3), 0), (np.diag([1.0, -1, -1]), 1)):
        ax = Figure().subplots()
        plot.plot_cluster(pair, ax=ax, diameter=2.0, view=view)
        image = np.asarray(ax.images[0].get_array())
        middle, corner = image[len(image) // 2, len(image) // 2], image[0, 0]
        color = np.array([int(figure_style.series_color(front)[k : k + 2], 16) for k in (1, 3, 5)])
        np.testing.assert_allclose(middle / middle.max(), color / color.max(), atol=0.02)
        assert (corner == 1).all()
