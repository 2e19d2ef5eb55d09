"""The kind of every motion in a report: words, frames, intervals, warnings, JSON, command line."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

import perrin
from left_out import leave_out_tensors
from perrin.cli.options import read_model
from perrin.diffusion import Parameter, fit_switching, judge_motion, with_changing_interval
from perrin.report.page import render_html
from perrin.run import is_not_diffusion, verdict_lines

FIRST, JUMP, DT, D_R, RELAXATION = 7, 120, 0.73, 5e-3, 2.0


def cluster(number, *, dynamics=None, jump=0.0):
    """Return the table of one cluster of 220 frames, moved by `jump` from row 120 on."""
    body = perrin.Cluster.touching(4, 2.45)
    truth = perrin.simulate_motion(
        body, D_R=D_R, D_T=0.04, dt=DT, n_frames=220, dynamics=dynamics, rng=number + 1
    )
    x = perrin.add_noise(truth.positions(), sigma=0.01, rng=number + 11)
    x[JUMP:] += jump
    table = perrin.positions_table(x + 20.0 * number)
    return table.assign(
        frame=table["frame"] + FIRST, particle=table["particle"] + 4 * number, cluster=number
    )


@pytest.fixture(scope="module")
def table():
    """Return a cluster whose stage jumps, one in a cage, and one that diffuses."""
    confined = perrin.Confined(RELAXATION)
    return pd.concat([cluster(0, jump=4.0), cluster(1, dynamics=confined), cluster(2)])


@pytest.fixture(scope="module")
def report(table):
    with pytest.MonkeyPatch.context() as patch:
        leave_out_tensors(patch)
        return perrin.analyze(table, dt=DT)


def test_every_cluster_has_the_word_of_what_was_planted(report):
    kinds = [[c.verdicts[q].kind for q in ("rotation", "translation")] for c in report.clusters]
    assert kinds == [["diffusion", "jumps"], ["confined", "confined"], ["diffusion", "diffusion"]]
    for c in report.clusters:
        assert (c.D_R.motion, c.D_T.motion) == (c.verdicts["rotation"].kind, c.D_T.motion)
    cage = report.clusters[1].verdicts["rotation"].model
    # The cage is sqrt(D times the relaxation time); four errors.
    error = (cage.cage_ci68[1] - cage.cage_ci68[0]) / 2
    assert cage.cage == pytest.approx(np.sqrt(D_R * RELAXATION), abs=4 * error)
    assert "is 0 at long times" in report.clusters[1].D_R.time_scale


def test_frames_are_counted_as_jumps_are_and_texts_state_those_of_the_file(report):
    moved = report.clusters[0].verdicts["translation"]
    assert moved.frames == report.clusters[0].jumps["translation"] == (JUMP,)
    assert f"at frame {JUMP + FIRST} " in moved.text
    assert moved.p_family < 1e-6


def test_a_motion_is_warned_of_once(report):
    """A jump has its own warning, a cage has no other."""
    jumped, caged, free = (c.warnings for c in report.clusters)
    assert sum(text.startswith("jump:") for text in jumped) == 1
    assert [is_not_diffusion(text) for text in caged] == [True, True]
    assert not any(map(is_not_diffusion, (*jumped, *free, *report.warnings)))


def test_clusters_are_judged_together_as_each_alone(report):
    """The verdict on one does not depend on the others; the pooled one is that on the list."""
    motions = [c.motion for c in report.clusters]
    alone, together = judge_motion(motions[2]), judge_motion(motions)
    found = report.clusters[2].verdicts["rotation"], report.pooled.verdicts["rotation"]
    for verdict, expected in zip(found, (alone, together), strict=True):
        assert (verdict.kind, verdict.text) == (expected.kind, expected.text)
        # Motions are estimated together, with other roundings than alone.
        assert verdict.p == pytest.approx(expected.p, rel=1e-8)
    assert report.pooled.D_R.motion == together.kind
    assert report.pooled.verdicts["translation"].kind == "jumps"
    assert "in cluster 0 " in report.pooled.verdicts["translation"].text


def test_progress_counts_the_motions_that_are_tested(report):
    """Each of three motions is counted when it has been tested, and again by no other way."""
    motions = [one.motion for one in report.clusters]
    calls = []
    judge_motion(motions, progress=lambda: calls.append(len(calls)))
    assert calls == [0, 1, 2]


def test_the_summary_holds_the_verdicts(report):
    entry = json.loads(json.dumps(report.to_dict()))
    again = perrin.Report.from_dict(
        entry, motions={c.cluster: c.motion for c in report.clusters}, tracks=report.tracks
    )
    assert again.to_dict() == report.to_dict()
    for one in (*entry["clusters"], entry["pooled"]):
        for motion in one["motion"].values():
            assert {
                "kind", "p", "p_family", "text", "detectable", "parameters", "frames",
            } <= set(motion)  # fmt: skip
    for motion in entry["clusters"][1]["motion"].values():
        assert motion["parameters"]["cage"] > 0
    older = [{k: v for k, v in one.items() if k != "motion"} for one in entry["clusters"]]
    one = perrin.Report.from_dict(
        entry | {"clusters": older},
        motions={c.cluster: c.motion for c in report.clusters},
        tracks=report.tracks,
    )
    assert one.clusters[0].verdicts == {}


def test_the_page_opens_with_the_verdict(report):
    page = render_html(report, [])
    lines = verdict_lines(report)
    assert page.index(lines["rotation"][0][:40]) < page.index('class="headline"')
    assert "2 diffusion, 1 confined (1)" in lines["rotation"][-1]


@pytest.fixture(scope="module")
def flowing(table):
    """Analyse the diffusing cluster in a flow of 1 um/s, subtracted, with a model asked for."""
    free = table[table["cluster"] == 2].copy()
    free["x"] += 1.0 * DT * (free["frame"] - FIRST)
    return perrin.analyze(free, dt=DT, drift=True, model="anomalous")


def test_a_drift_that_is_subtracted_is_the_word_and_no_warning(report, flowing):
    (result,) = flowing.clusters
    assert result.verdicts["translation"].kind == "drift"
    assert not result.warnings
    # 219 steps: subtracting a mean from each axis changes D by about 1 part in 219.
    assert result.D_T.value == pytest.approx(report.clusters[2].D_T.value, rel=0.02)


def test_a_model_that_is_asked_for_is_fitted_whatever_the_kind(flowing):
    """To the rest where a drift is subtracted; it comes back from JSON as what it is."""
    (result,) = flowing.clusters
    turn, path = result.verdicts["rotation"], result.verdicts["translation"]
    assert turn.kind == "diffusion"
    for verdict in (turn, path):
        assert verdict.model.alpha == pytest.approx(1.0, abs=4 * verdict.model.stderr)
    again = perrin.Report.from_dict(
        flowing.to_dict(), motions={2: result.motion}, tracks=flowing.tracks
    )
    assert again.clusters[0].verdicts["translation"].model == path.model
    assert flowing.pooled.verdicts["rotation"].model == turn.model


def test_a_model_that_does_not_exist_is_refused(table):
    with pytest.raises(ValueError, match="model: expected 'anomalous', 'confined' or 'switching'"):
        perrin.analyze(table, dt=DT, model="caged")
    with pytest.raises(ValueError, match="--model: expected anomalous, confined, switching"):
        read_model("caged")


def test_a_short_track_has_no_verdict(table):
    short = table[(table["cluster"] == 2) & (table["frame"] < FIRST + 15)]
    result = perrin.analyze(short, dt=DT, model="confined").clusters[0]
    assert result.verdicts == {"rotation": None, "translation": None}
    assert result.D_R.motion is None
    assert result.to_dict()["motion"] == {"rotation": None, "translation": None}
    assert any("no fit of the confined model to the rotation" in text for text in result.notes)


def test_the_interval_of_a_changing_D(report):
    """Blocks of a constant D give its error; states that are better known give theirs.

    The largest of three errors, one of them from four blocks, is up to 2.5 times as large; the
    interval of a logarithm differs from that of the likelihood by less than 1 % here.
    """
    motion, one = report.clusters[2].motion, report.clusters[2].D_R
    body = perrin.Cluster.touching(4, 2.45)
    states = fit_switching(perrin.simulate_motion(body, D_R=D_R, dt=DT, n_frames=40, rng=1))
    unknown = replace(states, D_mean=Parameter.log_normal(one.value, np.inf, one.unit))
    blocks = with_changing_interval(one, motion, unknown)
    assert blocks.method == "mle, error from blocks"
    assert blocks.value == one.value
    assert 0.99 < blocks.stderr / one.stderr < 2.5
    known = replace(states, D_mean=Parameter.log_normal(2 * one.value, 0.3, one.unit))
    wide = with_changing_interval(one, motion, known)
    low, high = wide.ci95
    # The relative error is that of the mean over the states, whatever its value.
    assert np.log(high / one.value) == pytest.approx(1.96 * 0.3, rel=1e-3)
    assert low * high == pytest.approx(one.value**2)
