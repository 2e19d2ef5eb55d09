"""Results as data: a tidy table, equal reports, one line and one table in a notebook, formats."""

from __future__ import annotations

from dataclasses import is_dataclass, replace

import numpy as np
import pandas as pd
import pytest

import perrin
from perrin.geometry import exp_map
from test_plot import measured


@pytest.fixture(scope="module")
def report():
    found = measured(clusters=2, frames=205, labels=["<b>one</b>", "two"])
    compared = perrin.Compared(0.02, found.clusters[0].D_R.value, found.clusters[0].D_R.stderr)
    known = perrin.Prediction(1.0, 1e-5, D_T=compared, D_R=compared)
    first, *others = found.clusters
    return replace(found, clusters=(replace(first, prediction=known), *others))


@pytest.mark.usefixtures("no_pictures")
def test_the_table_has_a_row_for_every_cluster_and_quantity(report, tmp_path):
    """Values and interval ends are those of the results; the file holds the same table."""
    table = report.to_frame()
    assert not table.duplicated(["of", "cluster", "quantity"]).any()
    for result in report.clusters:
        own = table[table["cluster"] == result.cluster].set_index("quantity")
        for name, unit in (("D_R", "rad^2/s"), ("D_T", "um^2/s")):
            one = getattr(result, name)
            ends = own.loc[name, ["ci68_low", "ci68_high", "ci95_low", "ci95_high"]].tolist()
            assert ends == [*one.ci68, *one.ci95]
            assert own.loc[name, ["value", "unit"]].tolist() == [one.value, unit]
        assert own.loc["D_R", "verdict"] == result.verdicts["rotation"].kind
        assert own.loc["sigma", "value"] == result.motion.sigma
        assert (own["label"] == result.label).all()
    pull = report.clusters[0].prediction.D_R.pull
    assert table.loc[table["quantity"] == "D_R", "pull"].iloc[0] == pull
    pooled = table[table["of"] == "pooled"].set_index("quantity")
    assert pooled.loc["D_T", "value"] == report.pooled.D_T.value
    report.save(tmp_path / "run")
    read = pd.read_csv(tmp_path / "run" / "results.csv")
    assert np.allclose(read["value"], table["value"], rtol=1e-12)
    assert read["quantity"].tolist() == table["quantity"].tolist()


@pytest.mark.usefixtures("no_pictures")
def test_a_report_that_is_read_equals_the_written_one(report, tmp_path):
    """Equality compares numbers, texts, settings, positions and motions."""
    perrin.write_run(report, tmp_path / "run")
    again = perrin.load_run(tmp_path / "run")
    assert again == report
    pd.testing.assert_frame_equal(again.to_frame(), report.to_frame())
    moved = report.tracks.assign(x=report.tracks["x"] + 1e-9)
    assert replace(report, tracks=moved) != report
    assert replace(report, warnings=("other",)) != report
    assert report != "report"


def test_every_result_is_one_line_and_a_table(report):
    """No representation spreads arrays over lines; text of users is escaped in tables."""
    result = report.clusters[0]
    shown = [report, report.pooled, report.kinds[0], result, result.motion, result.msad]
    shown += [result.D_R, result.tensor, result.noise, result.quality, result.prediction]
    shown += [*result.verdicts.values(), perrin.Cluster.tetrahedron(1.0)]
    for one in shown:
        assert is_dataclass(one)
        line = repr(one)
        assert line.startswith(f"{type(one).__name__}(")
        assert "\n" not in line
        assert len(line) < 300
        assert "<b>" not in one._repr_html_()
        assert one._repr_html_().startswith("<table>")
    assert "2 clusters" in repr(report)
    assert "&lt;b&gt;one" in report._repr_html_()


def test_an_estimate_formats_as_its_value(report):
    D_R = report.clusters[0].D_R
    assert f"{D_R:.3f}" == f"{D_R.value:.3f}"
    assert f"{D_R}" == str(D_R)
    with pytest.raises(TypeError, match="float"):
        f"{report.clusters[0]:.3f}"


TWO = np.stack([np.eye(3)] * 2)


class TestFromRotations:
    """A motion from rotations alone diffuses as the motion they come from."""

    truth = perrin.simulate_motion(
        perrin.Cluster.tetrahedron(1.5), D_R=0.02, D_T=0.03, dt=0.5, n_frames=60, rng=5
    )

    def test_matrices_quaternions_and_scipy_agree(self):
        rotation, frames = self.truth.as_scipy()
        assert frames.size == 60
        q = rotation.as_quat()
        given = (
            (self.truth.rotation, {}),
            (rotation, {}),
            (3.0 * q, {"order": "xyzw"}),
            (-np.roll(q, 1, axis=1), {"order": "wxyz"}),
        )
        for rotations, order in given:
            motion = perrin.RigidMotion.from_rotations(
                rotations, self.truth.center, dt=0.5, **order
            )
            assert np.allclose(motion.rotation, self.truth.rotation, atol=1e-12)
            assert np.array_equal(motion.center, self.truth.center)

    def test_the_estimates_are_those_of_the_motion(self):
        motion = perrin.RigidMotion.from_rotations(self.truth.rotation, self.truth.center, dt=0.5)
        for quantity in ("rotation", "translation"):
            both = [perrin.estimate_diffusion(m, quantity=quantity) for m in (motion, self.truth)]
            assert both[0].value == pytest.approx(both[1].value, rel=1e-9)
        assert perrin.diffusion_tensor(motion).symmetry == "C_1"

    @pytest.mark.parametrize("d", [2, 3])
    def test_the_nominal_template_has_the_stated_error(self, d):
        """Its floor is that of an orientation error of sigma about each axis: 4 sigma^2 or 2."""
        angles = np.linspace(0, 1, 5)
        spatial = exp_map(np.outer(angles, [0.0, 0.0, 1.0]))
        motion = perrin.RigidMotion.from_rotations(spatial[:, :d, :d], dt=1.0, sigma=0.02)
        floor = perrin.noise_floor(motion.template, sigma=motion.sigma)
        assert np.allclose(floor.covariance, 0.02**2 * np.eye(len(floor.covariance)), rtol=1e-9)
        assert np.allclose(motion.covariance, floor.covariance)
        assert pytest.approx(1) == motion.R

    def test_lost_frames_and_other_first_axes(self):
        """A NaN is a frame without a pose; body axes are those of the first pose."""
        turn = exp_map([0.3, -0.2, 0.9])
        rotations = self.truth.rotation @ turn
        rotations[[0, 7]] = np.nan
        motion = perrin.RigidMotion.from_rotations(rotations, dt=0.5)
        assert motion.fitted.tolist() == [k for k in range(60) if k not in (0, 7)]
        assert np.allclose(motion.rotation[1], np.eye(3))
        again = perrin.RigidMotion.from_dict(motion.to_dict())
        assert np.array_equal(again.rotation, motion.rotation, equal_nan=True)

    @pytest.mark.parametrize(
        ("rotations", "more", "message"),
        [
            (np.zeros((3, 4)), {"order": "xyzw"}, "quaternion of row 0 is zero"),
            (np.ones((3, 4)), {}, "order of the quaternions"),
            (np.ones((3, 3)), {}, "expected matrices"),
            (np.stack([np.eye(3), -np.eye(3)]), {}, "1 of 2 matrices are no proper rotations"),
            (np.stack([np.eye(3), 2 * np.eye(3)]), {}, "the first is row 1"),
            (np.eye(3)[None], {}, "1 of 1 frames have a rotation"),
            (
                np.stack([np.eye(3)] * 2),
                {"centers": np.zeros((3, 3))},
                "centers: expected the shape",
            ),
            (np.stack([np.eye(3)] * 2), {"sigma": -1.0}, "sigma: expected"),
        ],
    )
    def test_what_is_no_rotation_is_refused(self, rotations, more, message):
        with pytest.raises(ValueError, match=message):
            perrin.RigidMotion.from_rotations(rotations, dt=1.0, **more)


@pytest.mark.usefixtures("no_tensors")
@pytest.mark.usefixtures("no_pictures")
def test_progress_counts_the_clusters_of_every_long_step(tmp_path, monkeypatch):
    """Steps begin at 0 of their total; 20 clusters are estimated in two parts, written singly."""
    monkeypatch.setattr("perrin.report.write.save_figures", lambda *_, **__: [])
    monkeypatch.setattr("perrin.run.measure.clusters_together", lambda *_: 16)
    calls: dict[str, list[tuple[int, int]]] = {}

    def progress(done, total, title):
        calls.setdefault(title, []).append((done, total))

    one = measured(frames=6).tracks
    table = pd.concat(
        [one.assign(cluster=k, particle=one["particle"] + 4 * k) for k in range(20)],
        ignore_index=True,
    )
    report = perrin.analyze(table, dt=0.5, progress=progress)
    perrin.write_run(report, tmp_path / "run", progress=progress)
    assert list(calls) == [
        "finding the clusters", "fitting clusters", "estimating D_R and D_T", "judging the motion",
        "writing the curves", "writing the report",
    ]  # fmt: skip
    for title in ("fitting clusters", "estimating D_R and D_T"):
        assert calls[title] == [(0, 20), (16, 20), (20, 20)]
    # Two verdicts for each cluster; none is possible in 19 steps.
    assert calls["judging the motion"] == [(0, 40), (40, 40)]
    for title in ("writing the curves", "writing the report"):
        assert calls[title] == [(k, 20) for k in range(20)]
