"""The figure of a verdict shows the numbers of its tests."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure

import perrin
from perrin.diffusion import Noise, axis_model, sine_powers
from perrin.diffusion.verdict import judge_motion
from perrin.geometry.rotations import exp_map
from perrin.plot import (
    alternative_spectrum,
    motion_figure,
    plot_error_distribution,
    plot_prediction_errors,
    plot_step_spectrum,
)

BODY = perrin.Cluster.tetrahedron(1.5)
DT = 0.7


def track(n_frames=400, *, dynamics=None, seed=1, noise=0.02):
    """Return a rotating tetrahedron whose orientations have white noise (rad per axis)."""
    rng = np.random.default_rng(seed)
    chosen = {} if dynamics is None else {"dynamics": dynamics}
    truth = perrin.simulate_motion(
        BODY, D_R=5e-3, D_T=0.04, dt=DT, n_frames=n_frames, rng=rng, **chosen
    )
    return turned(truth, noise * rng.standard_normal((n_frames, 3)))


def turned(motion, vectors):
    return replace(motion, rotation=motion.rotation @ exp_map(vectors))


def fitted(motion, quantity="rotation"):
    model, y = axis_model(motion, quantity, Noise())
    return model, model.fit(y)


def axes():
    return Figure().add_subplot()


def drawn(ax, label):
    return next(line for line in ax.lines if str(line.get_label()).startswith(label)).get_xydata().T


def inside(band, x, y):
    """Return whether points lie in a band."""
    return band.get_paths()[0].contains_points(np.stack([x, y], axis=1))


@pytest.fixture(scope="module")
def free():
    return track()


def test_the_law_of_the_spectrum_is_that_of_the_fit(free):
    """It is D plus o (1 - cos w)/dt, mean over the axes, between 1/(2 T) and 1/(2 dt)."""
    model, fit = fitted(free)
    ax = plot_step_spectrum(model, fit, ax=axes())
    frequency, law = drawn(ax, "diffusion and noise")
    n = model.n_steps
    k = np.arange(1, n + 1)
    np.testing.assert_allclose(frequency, k / (2 * (n + 1) * DT), rtol=1e-9)
    noise = fit.offset.mean() + model.mean_known.mean()
    expected = fit.D.mean() + noise * (1 - np.cos(np.pi * k / (n + 1))) / DT
    np.testing.assert_allclose(law, expected, rtol=1e-9)


def test_bins_of_the_spectrum_contain_every_mode_once(free):
    """With equal axes the bin means, weighted by their numbers, are the mean square of all steps.

    The mean of P/lambda is 1, whatever the bins.
    """
    model, fit = fitted(free)
    ax = plot_step_spectrum(model, fit, ax=axes())
    frequency, power = drawn(ax, "steps, bin means")
    law_frequency, law = drawn(ax, "diffusion and noise")
    corners = ax.collections[0].get_paths()[0].vertices[:, 0]
    ends = np.unique(corners.round(12))
    counts = np.histogram(law_frequency, ends)[0]
    counts = counts[counts > 0]
    assert counts.sum() == model.n_steps
    assert counts.size == frequency.size
    ratio = power / np.interp(np.log(frequency), np.log(law_frequency), law)
    np.testing.assert_allclose(np.sum(counts * ratio) / model.n_steps, 1, rtol=2e-3)
    first = np.mean(sine_powers(fit.y)[0, :, 0] / model.eigenvalues(fit.D, fit.offset)[0, :, 0])
    np.testing.assert_allclose(power[0], first * law[0], rtol=1e-9)


def test_bands_contain_their_share_of_diffusion():
    """68 % and 95 % of the bins and of the means of Brownian motion, of 6 tracks.

    The tolerance is three binomial standard errors; counts are whole numbers, so that more than
    the share lies inside.
    """
    spectrum, squares, distribution = [], [], []
    for seed in range(6):
        motion = track(300, seed=seed)
        model, fit = fitted(motion)
        ax = plot_step_spectrum(model, fit, ax=axes())
        points = drawn(ax, "steps, bin means")
        spectrum.append([inside(band, *points) for band in ax.collections[:2]])
        ax = plot_prediction_errors(motion, model, fit, ax=axes())
        means = ax.patches[-1].get_data().values
        spans = [patch.get_bbox().intervaly for patch in ax.patches[:2]]
        squares.append([(low < means) & (means < high) for low, high in spans])
        ax = plot_error_distribution(model, fit, ax=axes())
        x, y = drawn(ax, f"{fit.y.size} errors")
        distribution.append([inside(band, x + 1e-9, y) for band in ax.collections[:2]])
    for found, most in ((spectrum, 0.0), (squares, 0.0), (distribution, 0.2)):
        wide, narrow = np.concatenate(found, axis=1)
        for share, seen in ((0.95, wide), (0.68, narrow)):
            error = 3 * np.sqrt(share * (1 - share) / seen.size)
            assert share - error < seen.mean() < share + error + most


@pytest.mark.parametrize(
    ("dynamics", "kind"),
    [(perrin.Fractional(0.5), "subdiffusion"), (perrin.Confined(5.0), "confined")],
)
def test_the_spectrum_of_the_alternative_follows_the_steps(dynamics, kind):
    """Where diffusion misses the lowest modes by a factor, the fitted alternative is near them."""
    motion = track(600, dynamics=dynamics)
    verdict = judge_motion(motion)
    assert verdict.kind == kind
    model, fit = fitted(motion)
    ax = plot_step_spectrum(model, fit, ax=axes(), verdict=verdict)
    frequency, power = drawn(ax, "steps, bin means")
    dashed = next(line for line in ax.lines if line.get_linestyle() == "--").get_ydata()
    law = np.interp(frequency, *drawn(ax, "diffusion and noise"))
    # At periods of a tenth of the track and above, about 10 modes on 3 axes: 25 % standard error.
    low = frequency < 10 / (2 * 600 * DT)
    assert power[low].mean() < 0.4 * law[low].mean()
    assert abs(np.log(power[low].mean() / dashed[low].mean())) < 0.75
    # Where there are hundreds of modes both agree.
    np.testing.assert_allclose(dashed[-3:], power[-3:], rtol=0.15)


def test_body_steps_in_a_cage_have_the_power_of_solid_angles():
    """At low frequency D cage^2/2 is left of the confined rotation, not nothing.

    v x dv/2 of a harmonic path with D and variance c^2 is white with variance D c^2 dt on each
    axis. 60 modes on 3 axes of 2 tracks: 7 % standard error.
    """
    D, relaxation = 5e-3, 5.0
    seen, stated = [], []
    for seed in range(2):
        motion = track(1500, dynamics=perrin.Confined(relaxation), seed=seed, noise=0.0)
        model, fit = fitted(motion)
        verdict = judge_motion(motion)
        assert verdict.model.frame == "mean"
        spectrum, _ = alternative_spectrum(model, fit, verdict)
        seen.append(np.mean(sine_powers(fit.y)[0, :, :60] / spectrum[:60]))
        stated.append(spectrum[0] / (2 * DT))
    assert np.mean(seen) == pytest.approx(1, abs=0.2)
    assert np.mean(stated) == pytest.approx(D * (D * relaxation) / 2, rel=0.3)


def test_an_exponent_of_one_and_a_wide_cage_have_the_spectrum_of_diffusion(free):
    """The alternatives contain diffusion: their spectra then are D and noise."""
    model, fit = fitted(free)
    D, offset = 4e-3, 3e-4
    expected = 2 * D * DT + 2 * offset * model.differences
    anomalous = replace(
        perrin.fit_anomalous(free), alpha=1.0, D_alpha=D, offset=offset, exposure=None
    )
    caged = replace(
        perrin.fit_confined(free), relaxation_time=1e9, D_short=D, offset=offset, exposure=None
    )
    verdict = judge_motion(free)
    for found in (anomalous, caged):
        spectrum, _ = alternative_spectrum(model, fit, replace(verdict, model=found))
        np.testing.assert_allclose(spectrum, expected, rtol=1e-5)
    assert alternative_spectrum(model, fit, verdict) is None


def test_a_vibration_stands_out_at_its_frequency(free):
    """One mode has the power N a^2/2 per axis of steps of amplitude a; its period is named."""
    amplitude, period = 0.05, 9.3
    wave = amplitude * np.sin(2 * np.pi * free.time / period)
    motion = turned(free, wave[:, None] * np.ones(3))
    verdict = judge_motion(motion)
    assert verdict.kind == "vibration"
    model, fit = fitted(motion)
    ax = plot_step_spectrum(model, fit, ax=axes(), verdict=verdict)
    (frequency,), (power,) = drawn(ax, "period")
    assert frequency == pytest.approx(1 / period, abs=1 / (model.n_steps * DT))
    step = 2 * amplitude * np.sin(np.pi * DT / period)
    assert power * 2 * DT == pytest.approx(model.n_steps * step**2 / 2, rel=0.5)
    assert power > 10 * np.interp(frequency, *drawn(ax, "diffusion and noise"))


def test_jumps_are_marked_when_they_end(free):
    """A ring at the time of every row of the verdict, and the number of the row."""
    rows = (60, 190, 333)
    vectors = np.zeros((400, 3))
    for row in rows:
        vectors[row:, 0] += 1.2
    motion = turned(free, vectors)
    verdict = judge_motion(motion)
    assert verdict.kind == "jumps"
    assert set(rows) <= set(verdict.frames)
    model, fit = fitted(motion)
    ax = plot_prediction_errors(motion, model, fit, ax=axes(), verdict=verdict)
    time, square = drawn(ax, "jumps")
    np.testing.assert_array_equal(time, motion.time[list(verdict.frames)])
    errors = np.mean(model.prediction_errors(fit)[0] ** 2, axis=0)
    np.testing.assert_array_equal(square, errors[np.array(verdict.frames) - 1])
    assert {f"row {row}" for row in rows} <= {text.get_text() for text in ax.texts}


def test_the_fast_state_is_shaded_and_gaps_have_no_points():
    """The shaded time is that of the steps in the fast state; a gap is one longer step."""
    motion = track(200, dynamics=perrin.Switching(20, dwell=20), seed=2)
    keep = np.ones(200, bool)
    keep[100:120] = False
    nothing = np.where(keep, 1.0, np.nan)
    motion = replace(
        motion,
        rotation=motion.rotation * nothing[:, None, None],
        center=motion.center * nothing[:, None],
    )
    verdict = judge_motion(motion)
    assert verdict.kind == "changing D"
    model, fit = fitted(motion)
    assert not model.even
    ax = plot_prediction_errors(motion, model, fit, ax=axes(), verdict=verdict)
    time, square = drawn(ax, "steps")
    np.testing.assert_array_equal(time, motion.time[keep][1:])
    assert np.log(square).std() > 0
    start, stop = motion.steps()
    fast = verdict.model.states[0][stop] == 1
    area = 0.0
    shaded = next(c for c in ax.collections if c.get_label() == "fast state")
    for path in shaded.get_paths():
        area += np.ptp(path.vertices[:, 0])
    assert area == pytest.approx(np.sum((motion.time[stop] - motion.time[start])[fast]))


def test_every_error_is_counted(free):
    """The density times the width is the share of the errors; those outside are in the legend."""
    model, fit = fitted(turned(free, np.where(np.arange(400)[:, None] < 200, 0.0, 2.5) * [1, 0, 0]))
    ax = plot_error_distribution(model, fit, ax=axes())
    x, density = drawn(ax, f"{fit.y.size} errors")
    width = np.diff(x).min()
    counted = np.sum(density) * width * fit.y.size
    beyond = np.sum(np.abs(model.prediction_errors(fit)) > ax.get_xlim()[1])
    assert beyond >= 1
    assert counted == pytest.approx(fit.y.size - beyond)
    assert f"{beyond} beyond" in ax.get_legend().get_texts()[-1].get_text()
    _, law = drawn(ax, "normal law")
    assert law.max() == pytest.approx(1 / np.sqrt(2 * np.pi), rel=1e-3)


def test_the_figure_has_the_verdict_as_its_title(free):
    """The text of the verdict in lines, in um² where it is a translation."""
    verdict = judge_motion(free, quantity="translation")
    figure = motion_figure(free, quantity="translation", verdict=verdict)
    title = figure.get_suptitle()
    assert title.replace("\n", " ").replace("µm", "um").replace("²", "^2") == verdict.text
    assert "µm²/s" in figure.axes[0].get_ylabel()


def test_a_verdict_on_another_motion_is_refused(free):
    """Both faults are in one message."""
    with pytest.raises(ValueError, match=r"(?s)on the translation.*one on 100"):
        motion_figure(free, quantity="translation", verdict=judge_motion(track(100)))
