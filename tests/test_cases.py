"""Small tables with right values: what a table may hold, and what the answer must then be.

Every table is made here with numpy and scipy alone. The right values are those of a table without
the trait (without the jump, the placeholder) or those that were planted.
"""

import re

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

import perrin
from left_out import make_figures_without_rendering

pytestmark = pytest.mark.usefixtures("no_tensors")

DT = 0.73
D_R = 5e-3
TETRA = 1.5 * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3)
EVEN = np.arange(300) * DT
FEW = 205  # from 200 steps on no test is ranked among draws, which takes most of the time


def remembered(white, share):
    """Return noise of which each frame keeps this share of the one before."""
    from scipy.signal import lfilter

    return lfilter([np.sqrt(1 - share**2)], [1, -share], white, axis=0)


def triangle(a, b, c):
    x = (a * a + b * b - c * c) / (2 * a)
    corners = np.array([[0, 0, 0], [a, 0, 0], [x, np.sqrt(b * b - x * x), 0]])
    return corners - corners.mean(axis=0)


def brownian(body, times, D_T, rng, *, D=D_R):
    """Return the positions (T, n, 3) of a body that turns and moves, without noise."""
    turn, centre, positions = Rotation.identity(), np.zeros(3), [body]
    for step in np.diff(times):
        parts = max(1, int(np.ceil(4 * D * step / 0.02)))
        for _ in range(parts):
            turn *= Rotation.from_rotvec(rng.normal(size=3) * np.sqrt(2 * D * step / parts))
        centre = centre + rng.normal(size=3) * np.sqrt(2 * D_T * step)
        positions.append(turn.apply(body) + centre)
    return np.array(positions)


def table(x, **columns):
    frames, n, _ = x.shape
    numbers = np.indices((frames, n)).reshape(2, -1)
    rows = pd.DataFrame({"frame": numbers[0], "particle": numbers[1]})
    rows[["x", "y", "z"]] = x.reshape(-1, 3).round(5)
    return rows.assign(**{name: np.repeat(values, n) for name, values in columns.items()})


def tetrahedra(seed, D_T, *, times=EVEN, offset=0.0):
    rng = np.random.default_rng(seed)
    x = brownian(TETRA, times, D_T, rng)
    return x + rng.normal(size=x.shape) * 0.03 + offset, rng


def only(report):
    (cluster,) = report.clusters
    return cluster


def texts(report):
    return [*report.warnings, *(w for c in report.clusters for w in c.warnings)]


def notes(report):
    return [*report.notes, *(n for c in report.clusters for n in c.notes)]


def near(estimate, planted, errors=3.5):
    """Return whether a planted value is within 3.5 errors: by chance it is not once in 2000."""
    return abs(estimate.value - planted) < errors * estimate.stderr


def test_right_labels_of_an_irregular_trimer_stay():
    """Sides of 2.40, 2.50, 2.45 um, 3 % of the frames four times as noisy: nothing is exchanged."""
    rng = np.random.default_rng(2)
    x = brownian(triangle(2.40, 2.50, 2.45), np.arange(600) * DT, 0.04, rng)
    noise = rng.normal(size=x.shape) * 0.02
    noise[rng.random(600) < 0.03] *= 4
    report = perrin.analyze(table(x + noise), dt=DT)
    cluster = only(report)
    assert near(cluster.D_R, D_R)
    assert cluster.D_R.stderr < 4e-4
    assert cluster.quality.swaps == ()
    assert cluster.quality.cuts == ()
    assert not texts(report)


@pytest.mark.usefixtures("no_tensors", "no_verdicts")
def test_a_flow_is_named_and_its_removal_exact():
    """1 um/s: named with its error; with drift=True the answer of the table without it."""
    x, _ = tetrahedra(88, 0.02, times=EVEN[:FEW])
    flow = x + EVEN[:FEW, None, None] * [1.0, 0, 0]
    still = only(perrin.analyze(table(x), dt=DT, drift=True))
    report = perrin.analyze(table(flow), dt=DT)
    assert only(report).D_T.value > 5 * still.D_T.value
    (text,) = texts(report)
    speed, error = re.search(r"the centre moves steadily at ([0-9.]+)\((\d+)\) um/s", text).groups()
    assert abs(float(speed) - 1.0) < 3.5 * 0.01 * int(error)
    off = only(perrin.analyze(table(flow), dt=DT, drift=True))
    # The tables are rounded to 1e-5 um, which makes the last digits of both differ.
    for one, other in ((off.D_T, still.D_T), (off.D_R, still.D_R)):
        assert [one.value, one.stderr, *one.ci95] == pytest.approx(
            [other.value, other.stderr, *other.ci95], rel=1e-4
        )
    np.testing.assert_allclose(off.msd.value, still.msd.value, rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(off.msd.stderr[:20], still.msd.stderr[:20], rtol=1e-3)


@pytest.fixture(scope="module")
def clean():
    """Return the report of a table without any trait."""
    return perrin.analyze(table(tetrahedra(88, 0.02)[0]), dt=DT)


@pytest.mark.usefixtures("no_tensors", "no_verdicts")
def test_a_stage_jump_is_named_and_left_out(clean):
    """3 um between frames 149 and 150: D_T of the table without it but for one step in 299.

    The frames of a jump are the table's own numbers: here they begin at 1000.
    """
    x, _ = tetrahedra(88, 0.02)
    x[150:, :, 0] += 3
    rows = table(x)
    report = perrin.analyze(rows.assign(frame=rows["frame"] + 1000), dt=DT)
    assert only(report).D_T.value == pytest.approx(only(clean).D_T.value, rel=0.01)
    (jump,) = only(report).jumps["translation"]
    assert jump in (150, 1150)
    (text,) = texts(report)
    assert text.startswith("jump: the centre moves by 2.96 um")
    assert "frame 1150" in text
    kept = perrin.analyze(table(x), dt=DT, keep_jumps=True)
    assert only(kept).D_T.value > 1.25 * only(clean).D_T.value
    assert only(kept).jumps == {}
    assert any("jump" in text for text in texts(kept))


def test_the_column_time_is_used():
    """Every 30th interval is a pause of 20 s."""
    gaps = np.full(FEW - 1, DT)
    gaps[29::30] = 20.0
    times = np.append(0, gaps.cumsum())
    x, _ = tetrahedra(5100, 0.02, times=times)
    report = perrin.analyze(table(x, time=times.round(5)), dt=DT)
    cluster = only(report)
    assert near(cluster.D_R, D_R)
    assert near(cluster.D_T, 0.02)
    assert any("column time" in note for note in notes(report))
    np.testing.assert_allclose(cluster.motion.time, times.round(5))
    # Without the column the pauses count as single steps.
    assert only(perrin.analyze(table(x), dt=DT)).D_R.value > 1.5 * cluster.D_R.value
    # Lags are times: the first is the usual interval, and the curve is that of the same D.
    assert cluster.msd.lagtime[0] == pytest.approx(DT, rel=1e-3)
    line = 6 * cluster.D_T.value * cluster.msd.lagtime[:20] + 6 * cluster.D_T.offset
    assert np.all(np.abs(cluster.msd.value[:20] - line) < 4 * cluster.msd.stderr[:20])
    with pytest.raises(perrin.TrackTableError, match=r"0\.73 s a frame, .* dt = 0\.5 s"):
        perrin.analyze(table(x, time=times.round(5)), dt=0.5)


def test_a_body_at_rest_is_one_body():
    """A trimer at rest whose error of 2 nm is smooth in time: one body of 3, sigma right.

    Its 250 frames are worth about 3 independent ones per coordinate of 3 degrees of freedom.
    """
    e = np.random.default_rng(5).normal(size=(250, 3, 3))
    smooth = remembered(e, 0.98)
    cluster = only(perrin.analyze(table(triangle(2.45, 2.45, 2.45) + 0.002 * smooth), dt=DT))
    assert len(cluster.motion.template) == 3
    assert cluster.motion.sigma == pytest.approx(0.0016, rel=0.05)
    assert cluster.quality.rigid


@pytest.mark.usefixtures("no_tensors", "no_verdicts")
def test_lost_particles_however_written():
    """5 % of the particles lost: rows left out, (0, 0, 0), or the last position: one answer."""
    x, rng = tetrahedra(227, 0.04, times=EVEN[:FEW], offset=20.0)
    lost = rng.random((FEW, 4)) < 0.05
    left_out = perrin.analyze(table(x)[~lost.ravel()], dt=DT)
    assert not texts(left_out)
    zeros = perrin.analyze(table(np.where(lost[..., None], 0.0, x)), dt=DT)
    assert any(f"{lost.sum()} rows" in w and "(0, 0, 0)" in w for w in zeros.warnings)
    y = x.round(5)
    for k in range(1, FEW):
        y[k, lost[k]] = y[k - 1, lost[k]]
    last = perrin.analyze(table(y), dt=DT)
    assert any(f"{lost[1:].sum()} rows" in w and "previous" in w for w in last.warnings)
    for cluster in (only(left_out), only(zeros), only(last)):
        assert near(cluster.D_R, D_R)
        # A frame in which the first particle was lost differs between the tables.
        assert cluster.D_R.value == pytest.approx(only(left_out).D_R.value, rel=0.01)
        assert not cluster.warnings


@pytest.fixture(scope="module")
def centred():
    """Return the report of a table from which the centre was subtracted in every frame."""
    x, _ = tetrahedra(227, 0.04)
    return perrin.analyze(table(x - x.mean(axis=1, keepdims=True)), dt=DT)


def test_a_centred_table_has_no_translation(centred):
    """The centre was subtracted in every frame: D_R is right, D_T is none, and this is stated."""
    report, cluster = centred, only(centred)
    assert near(cluster.D_R, D_R)
    assert np.isnan(cluster.D_T.value)
    assert str(cluster.D_T) == "D_T: none (the centre does not move)"
    assert report.to_dict()["clusters"][0]["D_T"]["value"] is None
    (text,) = texts(report)
    assert "the centre does not move" in text


def test_a_report_without_translation_comes_back(centred, tmp_path, monkeypatch, repeats):
    """An absent D_T is read back from a run folder as absent; page and figures are written.

    The quick form makes the figures, but does not render them.
    """
    if not repeats(0, 1):
        make_figures_without_rendering(monkeypatch)
    perrin.write_run(centred, tmp_path / "run")
    back = perrin.load_run(tmp_path / "run")
    assert np.isnan(only(back).D_T.value)
    assert str(only(back).D_T) == str(only(centred).D_T)


def test_frame_numbers_in_steps_of_five(clean):
    """Frames 0, 5, 10, ...: the signal-to-noise ratio is that of the steps of the table."""
    one, rows = clean, table(tetrahedra(88, 0.02)[0])
    five = perrin.analyze(rows.assign(frame=5 * rows["frame"]), dt=DT)
    assert only(five).D_R.snr == pytest.approx(only(one).D_R.snr, rel=1e-9)
    assert 5 * only(five).D_R.value == pytest.approx(only(one).D_R.value, rel=1e-9)
    assert any("multiples of 5" in note for note in five.notes)
    assert not any("multiples" in note for note in one.notes)
    assert not any("no pose" in note for note in notes(five))


def test_a_steady_turn_is_named_and_taken_off():
    """0.2 rad/s about the lab's z beside D_R = 0.005."""
    rng = np.random.default_rng(258)
    turn, positions = Rotation.identity(), [TETRA]
    for _ in range(FEW - 1):
        for _ in range(4):
            turn *= Rotation.from_rotvec(rng.normal(size=3) * np.sqrt(2 * D_R * DT / 4))
            turn = Rotation.from_rotvec([0, 0, 0.2 * DT / 4]) * turn
        positions.append(turn.apply(TETRA))
    x = np.array(positions) + np.cumsum(rng.normal(size=(FEW, 1, 3)) * np.sqrt(0.04 * DT), axis=0)
    rows = table(x + rng.normal(size=x.shape) * 0.03)
    (text,) = texts(perrin.analyze(rows, dt=DT))
    assert "the body turns steadily at 0.20" in text
    assert "rad/s" in text
    report = perrin.analyze(rows, dt=DT, drift=True)
    assert near(only(report).D_R, D_R)
    assert abs(only(report).D_R.drift[0][2] - 0.2) < 4 * only(report).D_R.drift_stderr[0][2]
    assert not texts(report)


def test_a_slow_body_with_worse_z_is_one_body():
    """sigma_z four times sigma_xy on an upright trimer that hardly turns: one body of 3."""
    rng = np.random.default_rng(3)
    body = np.array([[-1.225, 0, 0], [1.225, 0, 0], [0, 0, 2.122]])
    x = brownian(body, np.arange(250) * DT, 1e-4, rng, D=1e-5)
    report = perrin.analyze(table(x + rng.normal(size=x.shape) * [0.02, 0.02, 0.08]), dt=DT)
    assert len(only(report).motion.template) == 3
    assert not report.rods
    assert not any("z scale" in text or "scan" in text for text in texts(report))


def test_a_body_at_rest_has_no_estimate_of_the_scale_of_z():
    """sigma_z three times sigma_xy on a body that does not turn: no z scale, no warning."""
    rng = np.random.default_rng(12)
    report = perrin.analyze(table(TETRA + rng.normal(size=(300, 4, 3)) * [0.02, 0.02, 0.06]), dt=DT)
    assert only(report).quality.z_scale is None
    assert not texts(report)


def test_two_clusters_that_exchange_labels_are_named(repeats):
    """Bodies that exchange numbers from frame 100 on jump there, in opposite directions."""
    times = EVEN[: repeats(FEW, 300)]
    one, _ = tetrahedra(2, 0.02, times=times)
    other, _ = tetrahedra(3, 0.02, times=times, offset=6.0)
    first = np.concatenate([one[:100], other[100:]])
    second = np.concatenate([other[:100], one[100:]])
    rows = pd.concat(
        [table(first).assign(cluster=0), table(second).assign(cluster=1)], ignore_index=True
    )
    rows["particle"] += 10 * rows["cluster"]
    report = perrin.analyze(rows, dt=DT)
    assert any("frame 100: their labels were exchanged" in text for text in report.warnings)
    for cluster in report.clusters:
        assert near(cluster.D_T, 0.02)
        assert near(cluster.D_R, D_R)


def test_nothing_is_pooled_where_no_cluster_is_rigid(repeats):
    """Soft bodies stay in the report, without a pooled value, and that is the first warning."""
    times = EVEN[: repeats(FEW, 300)]
    bodies = []
    for seed in (3, 4):
        x, rng = tetrahedra(seed, 0.02, times=times)
        soft = remembered(rng.normal(size=x.shape), 0.9)
        bodies.append(table(x + 0.3 * soft).assign(cluster=seed))
    rows = pd.concat(bodies, ignore_index=True)
    rows["particle"] += 10 * rows["cluster"]
    report = perrin.analyze(rows, dt=DT)
    assert [c.quality.rigid for c in report.clusters] == [False, False]
    assert report.pooled is None
    assert "none of the 2 clusters is a rigid body" in report.warnings[0]
    rigid = table(tetrahedra(5, 0.02, times=times)[0]).assign(cluster=9)
    rigid["particle"] += 90
    mixed = perrin.analyze(pd.concat([rows[rows["cluster"] == 3], rigid], ignore_index=True), dt=DT)
    assert mixed.pooled.clusters == (9,)
