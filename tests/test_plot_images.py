"""Figures of imaging quality show spheres at their positions and the numbers of the tables."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from scipy.stats import halfnorm, maxwell

import perrin
from left_out import leave_out_tensors, leave_out_verdicts
from perrin.images.imaging import Imaging, View
from perrin.images.optics.optics import CameraNoise, Optics
from perrin.plot import figure_style
from perrin.plot import imaging as plot_images
from perrin.plot.figure_style import series_color

VOXEL, BALL = (0.25, 0.2, 0.2), 2.45


def projection(centers, shape, step):
    """Return one projection with discs of the spheres' size, rows and columns as in `centers`."""
    rows, columns = (np.arange(n) * s for n, s in zip(shape, step, strict=True))
    image = np.full(shape, 10.0)
    for row, column in centers:
        inside = np.hypot(rows[:, None] - row, columns - column) < BALL / 2
        image[inside] = 100.0
    return image


def views_of(features, shape, voxel, frames):
    z, y, x = voxel
    made = []
    for k in frames:
        here = features[features["frame"] == k]
        sides = {"xy": ("yx", (y, x)), "xz": ("zx", (z, x)), "yz": ("zy", (z, y))}
        size = dict(zip("zyx", shape, strict=True))
        drawn = {
            side: projection(here[list(axes)].to_numpy(), [size[a] for a in axes], step)
            if np.isfinite(z) or side == "xy"
            else np.zeros((1, 1))
            for side, (axes, step) in sides.items()
        }
        made.append(View(k, **drawn))
    return tuple(made)


@functools.cache
def seen(*, clusters=2, frames=40, planar=False, refine="model", size=16.0, seed=3):
    """Return the report of a movie of tetrahedra (squares in the plane) without rendering it."""
    rng = np.random.default_rng(seed)
    square = BALL / 2 * np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]])
    body = perrin.Cluster.from_positions(square) if planar else perrin.Cluster.touching(4, BALL)
    side = int(np.ceil(np.sqrt(clusters)))
    parts = []
    for k in range(clusters):
        truth = perrin.simulate_motion(body, D_R=5e-3, D_T=0.01, dt=0.7, n_frames=frames, rng=rng)
        x = perrin.add_noise(truth.positions(), sigma=0.01, rng=rng)
        at = [size / side * (k % side + 0.5), size / side * (k // side + 0.5), 5.0]
        x = x + at[: x.shape[2]]
        frame, particle = np.indices(x.shape[:2]).reshape(2, -1)
        part = pd.DataFrame(
            {"frame": frame, "cluster": k, "particle": particle + 4 * k, "piece": 0}
        )
        part[list("xyz")[: x.shape[2]]] = x.reshape(-1, x.shape[2])
        parts.append(part)
    features = pd.concat(parts, ignore_index=True)
    with pytest.MonkeyPatch.context() as patch:
        leave_out_tensors(patch)
        leave_out_verdicts(patch)
        report = perrin.analyze(features, dt=0.7)
    features["mass"] = rng.normal(2e4, 1e3, len(features))
    optics = None
    if refine == "model":
        features[["sigma_x", "sigma_y", "sigma_z"]] = [0.004, 0.005, 0.006]
        features["chi2"] = rng.normal(1, 0.02, len(features))
        features["refined"], features["reason"] = True, ""
        optics = Optics(2.44, (0.41, 0.152), CameraNoise(3.1, 12.0), (0.002, 0.003, 0.004))
    voxel = (np.nan, *VOXEL[1:]) if planar else VOXEL
    shape = (1 if planar else 40, int(size / 0.2), int(size / 0.2))
    spots = np.concatenate([features["mass"][: 4 * clusters], rng.lognormal(5, 0.7, 300)])
    counts = features.groupby("frame").size().to_numpy()
    imaging = Imaging(
        features=features,
        frames=pd.DataFrame(
            {
                "frame": np.arange(frames),
                "time": 0.7 * np.arange(frames),
                "spots": counts + 300,
                "spheres": counts,
                "level": 10.0,
                "saturated": 0.0,
                "fault": "",
            }
        ),
        spots=pd.DataFrame({"frame": 0, "mass": spots}),
        views=views_of(features, shape, voxel, range(0, frames, max(frames // 8, 1))),
        optics=optics,
        minmass=2345.0,
        voxel=voxel,
        diameter=BALL,
        contact=BALL,
        dark=False,
        refine=refine,
    )
    return replace(report, imaging=imaging)


@pytest.fixture(scope="module")
def report():
    return seen()


@pytest.fixture(scope="module")
def plane():
    return seen(planar=True, refine=None)


def axes():
    return Figure(figsize=(6, 6)).add_subplot()


def line(ax, start):
    (found,) = [x for x in ax.lines if str(x.get_label()).startswith(start)]
    return found


def circles(ax):
    """Return the circles of free and of clustered spheres, and the outline of the free ones."""
    halo, loose, clustered = ax.collections
    return loose, clustered, halo


def with_motion(report, **changes):
    first, *rest = report.clusters
    return replace(
        report, clusters=(replace(first, motion=replace(first.motion, **changes)), *rest)
    )


@pytest.mark.parametrize("side", ["xy", "xz", "yz"])
def test_a_circle_lies_on_its_sphere_on_every_side(report, side):
    """The centre of a sphere's pixels is the centre of its circle."""
    imaging = report.imaging
    one = imaging.features.iloc[:1].assign(x=6.2, y=9.6, z=4.5)
    (view,) = views_of(one, (40, 80, 90), VOXEL, [0])
    ax = axes()
    assert plot_images.plot_found(replace(imaging, features=one), view, ax=ax, side=side) is ax
    (image,) = ax.images
    left, right, bottom, top = image.get_extent()
    pixels = np.asarray(image.get_array())
    down, across = (
        np.linspace(a, b, n, endpoint=False) + (b - a) / (2 * n)
        for a, b, n in zip((top, left), (bottom, right), pixels.shape, strict=True)
    )
    rows, columns = np.nonzero(pixels > 50)
    (place,) = circles(ax)[1].get_offsets()
    assert np.allclose(place, (across[columns].mean(), down[rows].mean()), rtol=1e-12)
    far = np.hypot(across[columns] - place[0], down[rows] - place[1]).max()
    assert BALL / 2 - 0.25 < far <= BALL / 2 + 1e-9
    # Rows run down, columns to the right, and the frame ends where its voxels do.
    assert bottom > top
    assert ax.axis() == (left, right, bottom, top)
    assert (ax.get_xlabel()[0], ax.get_ylabel()[0]) == {"yz": ("z", "y")}.get(side, tuple(side))


def test_circles_are_drawn_true_to_scale(report):
    """The outermost coloured pixels are a diameter apart, to within the width of a line."""
    imaging = report.imaging
    one = imaging.features.iloc[:1].assign(x=7.0, y=8.0)
    ax = axes()
    canvas = FigureCanvasAgg(ax.figure)
    plot_images.plot_found(replace(imaging, features=one), imaging.views[0], ax=ax)
    for artist in (*ax.images, *ax.texts, *ax.spines.values(), ax.xaxis, ax.yaxis):
        artist.set_visible(False)
    canvas.draw()
    rows, columns = np.nonzero(np.asarray(canvas.buffer_rgba())[..., :3].sum(axis=2) < 600)
    ends = np.array([[columns.min(), rows.min()], [columns.max() + 1, rows.max() + 1]])
    (left, low), (right, high) = ax.transData.inverted().transform(ends)
    pixel = 1 / ax.transData.get_matrix()[0, 0]
    assert right - left == pytest.approx(BALL, abs=4 * pixel)
    assert abs(high - low) == pytest.approx(BALL, abs=4 * pixel)
    assert (right + left) / 2 == pytest.approx(7.0, abs=2 * pixel)


def test_clusters_have_colours_and_numbers_and_free_spheres_are_dashed(report):
    loose = report.imaging.features["particle"] == 5
    features = report.imaging.features.assign(cluster=lambda t: t["cluster"].mask(loose, -1))
    imaging, ax = replace(report.imaging, features=features), axes()
    plot_images.plot_found(imaging, imaging.views[2], ax=ax)
    frame = features[features["frame"] == imaging.views[2].frame]
    dashed, solid, _ = circles(ax)
    assert np.allclose(dashed.get_offsets(), frame.loc[frame["cluster"] < 0, ["x", "y"]])
    assert np.allclose(solid.get_offsets(), frame.loc[frame["cluster"] >= 0, ["x", "y"]])
    assert dashed.get_linestyles()[0][1] is not None
    assert solid.get_linestyles()[0][1] is None
    assert [to_hex(c) for c in solid.get_edgecolors()] == [
        series_color(k) for k in frame.loc[frame["cluster"] >= 0, "cluster"]
    ]
    assert [t.get_text() for t in ax.texts] == ["0", "1"]


def test_dark_and_bright_spheres_give_the_same_picture(report):
    """The negative of a movie of bright spheres, declared dark, gives the same picture."""
    pictures = []
    for dark in (False, True):
        views = report.imaging.views[:1]
        if dark:
            views = tuple(replace(v, xy=300 - v.xy) for v in views)
        ax = axes()
        plot_images.plot_found(replace(report.imaging, dark=dark), views[0], ax=ax)
        (image,) = ax.images
        pictures.append(image.to_rgba(image.get_array()))
    # 256 shades: the two scales may round a grey differently.
    assert np.allclose(*pictures, atol=1.01 / 255)
    ball, ground = pictures[0][..., 0].min(), np.median(pictures[0][..., 0])
    assert ball < 0.5 < 0.8 < ground


def test_the_histogram_counts_every_spot_on_the_correct_side_of_the_cut(report):
    ax, mass = axes(), report.imaging.spots["mass"].to_numpy()
    cut = report.imaging.minmass
    plot_images.plot_masses(report.imaging, ax=ax)
    rejected, kept = ax.containers
    assert sum(bar.get_height() for bar in rejected) == (mass < cut).sum() == 300
    assert sum(bar.get_height() for bar in kept) == (mass >= cut).sum() == 8
    filled = [b for b in rejected if b.get_height()], [b for b in kept if b.get_height()]
    assert max(b.get_x() + b.get_width() for b in filled[0]) <= cut * (1 + 1e-12)
    assert min(b.get_x() for b in filled[1]) >= cut * (1 - 1e-12)
    assert list(line(ax, "cut at 2340").get_xdata()) == [cut, cut]
    ax = axes()
    plot_images.plot_masses(replace(report.imaging, minmass=0.0), ax=ax)
    assert sum(bar.get_height() for bar in ax.containers[0]) == len(mass)
    assert not ax.lines


def test_misfit_is_that_of_the_table(report):
    features = report.imaging.features.copy()
    features.loc[features["frame"] == 11, "chi2"] = np.nan
    ax = axes()
    plot_images.plot_misfit(replace(report.imaging, features=features), ax=ax)
    chi2 = features.groupby("frame")["chi2"].agg(["min", "median", "max"]).dropna()
    time, median = line(ax, "median").get_data()
    assert np.allclose(time, 0.7 * chi2.index)
    assert np.array_equal(median, chi2["median"])
    corners = ax.collections[0].get_paths()[0].vertices
    assert corners[:, 1].min() == chi2["min"].min()
    assert corners[:, 1].max() == chi2["max"].max()


def test_rigid_residuals_of_all_clusters_are_drawn_in_the_time_of_the_stack(report):
    """Tracks that begin at frame 7 of the stack are drawn 4.9 s later."""
    cut = replace(report, settings={**report.settings, "first_frame": 7})
    ax = axes()
    plot_images.plot_rigidity(cut, ax=ax)
    for cluster in report.clusters:
        time, residual = line(ax, f"cluster {cluster.name}").get_data()
        assert np.allclose(time, cluster.motion.time + 4.9)
        assert np.allclose(residual, 1e3 * cluster.motion.residual)
    worst = max(report.clusters, key=lambda c: c.motion.residual.max()).motion
    frame = worst.residual.argmax() + 7
    assert f"frame {frame})" in line(ax, "largest").get_label()
    assert line(ax, "largest").get_xdata()[0] == pytest.approx(0.7 * frame)


def test_many_residuals_have_their_median(report):
    eight = [replace(c, cluster=k) for k in range(4) for c in report.clusters]
    ax = axes()
    plot_images.plot_rigidity(replace(report, clusters=tuple(eight)), ax=ax)
    pair = np.stack([c.motion.residual for c in report.clusters])
    time, median = line(ax, "median of 8").get_data()
    assert np.allclose(time, 0.7 * np.arange(40))
    assert np.allclose(median, 1e3 * np.median(pair, axis=0))


@pytest.mark.parametrize(("name", "law"), [("report", maxwell), ("plane", halfnorm)])
def test_step_angles_and_their_distribution(name, law, request):
    """The histogram counts every step; the line is Maxwell's law or half a Gaussian."""
    report, ax = request.getfixturevalue(name), axes()
    plot_images.plot_step_angles(report, ax=ax)
    vectors = [c.motion.step_vectors() for c in report.clusters]
    angle = np.rad2deg(np.concatenate([np.linalg.norm(v, axis=1) for v in vectors]))
    bars = [b for b in ax.patches if b.get_height()]
    assert sum(b.get_height() for b in ax.patches) == angle.size == 78
    assert bars[-1].get_x() <= angle.max() <= bars[-1].get_x() + bars[-1].get_width()
    x, drawn = line(ax, "Brownian").get_data()
    pooled = report.pooled.D_R
    scale = np.rad2deg(np.sqrt(2 * (pooled.value * 0.7 + pooled.offset)))
    width = ax.patches[0].get_width()
    assert np.allclose(drawn, angle.size * width * law.pdf(x, scale=scale), rtol=1e-6)
    ticks = line(ax, "largest").get_xdata()
    assert np.allclose(ticks, np.sort(angle)[-10:])
    assert not [x for x in ax.lines if "symmetry rotation" in str(x.get_label())]


def test_an_exchange_of_spheres_is_at_the_symmetry_rotation(report):
    """A rotation by 120 degrees about a threefold axis at frame 20 is marked with its frame."""
    motion = report.clusters[0].motion
    axis = motion.template[0] / np.linalg.norm(motion.template[0])
    turn = perrin.geometry.rotations.exp_map(2 * np.pi / 3 * axis)
    rotation = motion.rotation.copy()
    rotation[20:] = rotation[20:] @ turn
    ax = axes()
    plot_images.plot_step_angles(with_motion(report, rotation=rotation), ax=ax)
    assert list(line(ax, "symmetry rotation, 120°").get_xdata()) == [120, 120]
    assert "(cluster 0, frame 20)" in line(ax, "largest").get_label()
    # The tail of the distribution does not determine the range of the axis.
    assert ax.get_ylim()[1] < 78
    # Brownian motion adds some degrees.
    assert line(ax, "largest").get_xdata()[-1] == pytest.approx(120, abs=15)


@pytest.mark.parametrize(
    ("group", "turn"),
    [("T_d", 120), ("O_h", 90), ("I_h", 72), ("D_5h", 72), ("C_2v", 180), ("S_4", 180),
     ("C_s", np.inf), ("C_i", np.inf), ("C_1", np.inf)],
)  # fmt: skip
def test_least_turns(group, turn):
    assert plot_images.least_turn(group) == turn


def test_in_the_plane_only_turns_in_the_plane_count(plane):
    """A square has a rotation by 90 degrees; that of a kite is out of the plane."""
    assert plot_images.least_turns(plane) == [90]
    kite = [replace(c, quality=replace(c.quality, symmetry="C_2v")) for c in plane.clusters]
    assert plot_images.least_turns(replace(plane, clusters=tuple(kite))) == []


def test_paths_end_at_the_frame_of_the_view(report):
    """Tracks that begin at frame 7 of the stack have their row 13 at its frame 20."""
    cut = replace(report, settings={**report.settings, "first_frame": 7})
    view = next(v for v in report.imaging.views if v.frame == 20)
    ax = axes()
    plot_images.plot_tracks(cut, view, ax=ax)
    for halo, path, cluster in zip(ax.lines[::2], ax.lines[1::2], report.clusters, strict=True):
        assert np.array_equal(path.get_xydata(), cluster.motion.center[:14, :2])
        assert np.array_equal(halo.get_xydata(), path.get_xydata())
        assert path.get_color() == series_color(cluster.cluster)
    here = report.imaging.features[report.imaging.features["frame"] == 20]
    assert np.allclose(circles(ax)[1].get_offsets(), here[["x", "y"]])
    assert ax.get_title() == "frame 20, 14.0 s"


def test_paths_have_a_limited_length(report, monkeypatch):
    monkeypatch.setattr(plot_images, "_PATH_FRAMES", 10)
    view = next(v for v in report.imaging.views if v.frame == 20)
    ax = axes()
    plot_images.plot_tracks(report, view, ax=ax)
    assert np.array_equal(ax.lines[1].get_xydata(), report.clusters[0].motion.center[11:21, :2])


def test_series_of_the_frames_are_those_of_the_table(report):
    frames = report.imaging.frames.assign(
        spheres=np.arange(40), saturated=np.linspace(0, 0.02, 40), level=10 - 0.1 * np.arange(40)
    )
    frames.loc[[4, 9], "fault"] = "cut short"
    features = report.imaging.features.assign(mass=lambda t: 500 - t["frame"])
    imaging = replace(report.imaging, frames=frames, features=features)
    read = np.setdiff1d(np.arange(40), [4, 9])
    expected = {
        "spheres": read,
        "spots": frames["spots"][read],
        "brightness": 100 - read / 5,
        "level": 10 - 0.1 * read,
        "saturated": np.linspace(0, 2, 40)[read],
    }
    for series, values in expected.items():
        ax = axes()
        plot_images.plot_health(imaging, ax=ax, series=series)
        shown, crosses = ax.lines
        assert np.allclose(shown.get_ydata()[read], values)
        assert np.isnan(shown.get_ydata()[[4, 9]]).all()
        assert np.allclose(crosses.get_xdata(), [2.8, 6.3])


def test_empty_figures_have_a_reason(report):
    none = replace(
        report.imaging, features=report.imaging.features[:0], spots=report.imaging.spots[:0]
    )
    empty = replace(report, clusters=(), pooled=None, imaging=none)
    for draw, data, reason in (
        (plot_images.plot_masses, none, "no spots"),
        (plot_images.plot_misfit, none, "no image"),
        (plot_images.plot_rigidity, empty, "no cluster"),
        (plot_images.plot_step_angles, empty, "no step"),
    ):
        ax = axes()
        draw(data, ax=ax)
        assert ax.texts[0].get_text().startswith(reason)
    ax = axes()
    plot_images.plot_found(none, none.views[0], ax=ax)
    assert len(circles(ax)[1].get_offsets()) == 0
    plot_images.plot_health(none, ax=axes(), series="brightness")


def test_a_movie_in_the_plane_has_one_projection_and_no_misfit(
    plane, tmp_path, monkeypatch, repeats
):
    names = ["found", "tracks", "masses", "residuals", "steps", "health"]
    # Eight small views take long to draw, and the other figures are drawn as in space.
    drawn = [f"images-{n}" for n in repeats(["found", "residuals", "steps"], names)]
    figures = {}

    def keep(figure, stem):
        figures[stem.name] = figure
        if repeats(True, False):
            # The layout of the figures takes most of the time.
            figure.set_dpi(30)
            figure.set_layout_engine("none")
        if stem.name in drawn:
            FigureCanvasAgg(figure).draw()
        return [stem]

    monkeypatch.setattr(figure_style, "save_figure", keep)
    files = plot_images.save_image_figures(plane, tmp_path)
    assert [f.name for f in files] == [f"images-{n}" for n in names]
    assert len(figures["images-found"].axes) == 1
    assert len(figures["images-residuals"].axes) == 1
    # Eight views of 8, four in a row.
    assert len(figures["images-tracks"].axes) == 8
    with pytest.raises(ValueError, match="began with a table"):
        plot_images.save_image_figures(replace(plane, imaging=None), tmp_path)
