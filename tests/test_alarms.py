"""The benchmark of the warnings: its simulators, its verdicts, and a small form of the trial.

The whole trial is `python benchmarks/alarms.py --quick`; here it runs with --long.
"""

import functools
import itertools
import runpy
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

BENCHMARK = Path(__file__).resolve().parents[1] / "benchmarks" / "alarms.py"


@functools.cache
def benchmark():
    """Return the names of the benchmark, which is loaded by the first test that needs one."""
    return runpy.run_path(str(BENCHMARK))


class Benchmark:
    """The benchmark as a module."""

    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        return benchmark()[name]


NAMES = Benchmark()


def every_case():
    return NAMES.FAULTS + NAMES.CLEAN + NAMES.FILMS


def case_of(name):
    return next(c for c in every_case() if c.name == name)


def tally_of(name, tables, *, named=0, alarmed=0, kinds=()):
    return NAMES.Tally(
        case_of(name), tables=tables, named=named, alarmed=alarmed, kinds=Counter(dict(kinds))
    )


def test_running_products_are_those_of_a_loop():
    turns = np.random.default_rng(1).normal(size=(37, 3, 3)) / 2
    one, loop = np.eye(3), []
    for turn in turns:
        one = one @ turn
        loop.append(one)
    # 37 products of matrices of norm about 1: rounding stays far below this.
    np.testing.assert_allclose(NAMES.products(turns), loop, rtol=0, atol=1e-10)


@pytest.mark.parametrize(("d", "decay"), [(3, 2.0), (2, 1.0)])
def test_simulated_orientations_decay_as_brownian_motion(d, decay):
    """The mean cosine of an axis and itself after t is exp(-2 D t) in space, exp(-D t) in a plane.

    The tolerance is four standard errors of the mean over independent steps.
    """
    rng, D, t = np.random.default_rng(2), 0.1, 0.7
    times = np.arange(4000) * t
    turn = (NAMES.orientations if d == 3 else NAMES.orientations_in_plane)(times, D, rng)
    step = np.swapaxes(turn[:-1], -1, -2) @ turn[1:]
    cosine = np.trace(step, axis1=-2, axis2=-1) / d
    error = cosine.std() / np.sqrt(cosine.size)
    assert cosine.mean() == pytest.approx(np.exp(-decay * D * t), abs=4 * error)
    np.testing.assert_allclose(np.linalg.det(turn), 1.0, atol=1e-10)


def test_uneven_axes_turn_in_the_ratio_of_their_coefficients():
    """Steps about body axis i have variance 2 D_i t; four errors of sqrt(2/3999)."""
    D, t = np.array([1e-3, 2e-3, 4e-3]), 0.5
    turn = NAMES.orientations(np.arange(4000) * t, D, np.random.default_rng(3))
    step = NAMES.Rotation.from_matrix(np.swapaxes(turn[:-1], -1, -2) @ turn[1:]).as_rotvec()
    np.testing.assert_allclose(
        (step**2).mean(axis=0) / (2 * D * t), 1, atol=4 * np.sqrt(2 / len(step))
    )


def test_centres_diffuse_and_bodies_stay_rigid():
    """Steps of the centre have variance 2 D_T t over uneven times too; distances stay."""
    times = NAMES.clock(3001, pauses=20.0)
    x = NAMES.brownian(NAMES.OCTAHEDRON, times, D_R=1e-3, D_T=0.2, rng=np.random.default_rng(4))
    step = np.diff(x.mean(axis=1), axis=0) ** 2 / (2 * 0.2 * np.diff(times)[:, None])
    assert step.mean() == pytest.approx(1, abs=4 * np.sqrt(2 / step.size))
    apart = np.linalg.norm(x[:, :, None] - x[:, None], axis=-1)
    np.testing.assert_allclose(apart - apart[0], 0, atol=1e-9)


def test_smooth_noise_has_the_size_and_memory_that_were_asked_for():
    """Relative errors of size and correlation: about sqrt(memory / samples), 1 %; four of them."""
    noise = NAMES.smooth((500, 400), size=0.3, memory=5.0, rng=np.random.default_rng(5))
    assert noise.std() == pytest.approx(0.3, rel=0.04)
    lagged = (noise[1:] * noise[:-1]).mean() / (noise**2).mean()
    assert lagged == pytest.approx(np.exp(-1 / 5), rel=0.04)


def test_every_change_plants_what_its_name_states():
    """A jump is one step of its size, a turn keeps the shape, and a flow moves every frame."""
    rng = np.random.default_rng(6)
    tracks = NAMES.recorded(rng)
    (x,) = tracks
    moved = NAMES.stage_jump(tracks, rng, size=3.0)[0] - x
    size = np.linalg.norm(np.diff(moved.mean(axis=1), axis=0), axis=1)
    assert np.sort(size)[-2:] == pytest.approx([0, 3], abs=1e-9)
    (y,) = NAMES.one_turn(tracks, rng, angle=1.0)
    np.testing.assert_allclose(y.mean(axis=1), x.mean(axis=1), atol=1e-9)
    assert np.abs(y[0] - x[0]).max() < 1e-9 < 0.1 < np.abs(y[-1] - x[-1]).max()
    flow = NAMES.flowing(tracks, rng, velocity=1.0)[0] - x
    speed = np.linalg.norm(np.diff(flow[:, 0], axis=0), axis=1) / NAMES.DT
    np.testing.assert_allclose(speed, 1.0, rtol=1e-9)
    np.testing.assert_array_equal(
        np.sort(NAMES.relabelled(tracks, rng, events=3)[0], axis=1), np.sort(x, axis=1)
    )


def test_a_fast_scan_leaves_the_body_rigid_and_a_slow_one_does_not():
    """Distances scatter by sqrt(2) sigma where all spheres are recorded at once."""
    spread = {}
    for speed in (1e9, 10.0):
        (x,) = NAMES.scanned(np.random.default_rng(7), speed=speed)
        apart = np.linalg.norm(x[:, 0] - x[:, 1], axis=1)
        spread[speed] = apart.std() / (np.sqrt(2) * NAMES.SIGMA)
    # 300 distances: four errors of 1/sqrt(600).
    assert spread[1e9] == pytest.approx(1, abs=0.17)
    assert spread[10.0] > 2


def test_all_pairs_of_levels_occur_among_the_clean_cases():
    """Of body, speed, length, error ratio and loss every two levels meet in some case."""
    levels = [
        tuple(c.name.removeprefix("clean: ").split(", "))
        for c in NAMES.clean_design()
        if "plane" not in c.name
    ]
    for a, b in itertools.combinations(range(5), 2):
        met = {(row[a], row[b]) for row in levels}
        assert met == set(itertools.product({r[a] for r in levels}, {r[b] for r in levels}))


def test_cases_name_kinds_that_exist_and_have_names_of_their_own():
    assert len({c.name for c in every_case()}) == len(every_case())
    for case in every_case():
        assert set(case.expected) <= set(NAMES.KINDS)
        assert set(case.allowed) <= {*NAMES.KINDS, "other", "too long"}
        assert case.where in ("warnings", "notes")


def test_texts_are_sorted_by_what_they_are_about():
    kind = NAMES.kind_of
    assert kind("not resolved: D_R < 0.1 rad^2/s") == "unresolved"
    assert kind("the centre jumps by 3.1(2) um between frames 149 and 150") == "jump"
    cut = "in doubt; the track is cut (a jump of the body's symmetry cannot be distinguished)"
    assert kind(cut) == "cut"
    assert kind("signal-to-noise ratio 0.1: the noise is far larger than a step") == "noisy"
    assert kind("something new") == "other"
    assert kind("refused: TrackTableError: something new") == "refused (other)"


def planted(case, report):
    """Return the tally of one table of a case whose measurement returns `report`."""
    fake = NAMES.Case(
        case.name, lambda _: None, case.expected, {}, case.where, case.allowed, case.sizes,
        lambda _: report,
    )  # fmt: skip
    return NAMES.tried(fake, 0, 0)


def test_a_fault_is_named_by_its_kind_in_its_place():
    flow, stride = case_of("flow 1 um/s"), case_of("frames in steps of 5")
    found = planted(flow, NAMES.Texts(("mean velocity 1.0(1) um/s", "labels swap at frame 3")))
    assert (found.named, found.alarmed, dict(found.kinds)) == (1, 1, {"labels": 1})
    found = planted(stride, NAMES.Texts(("frame numbers are multiples of 5",)))
    assert (found.named, found.elsewhere, found.alarmed) == (0, 1, 0)
    found = planted(stride, NAMES.Texts((), ("frame numbers are multiples of 5",)))
    assert (found.named, found.elsewhere) == (1, 0)


def test_what_is_allowed_or_wrong_in_a_clean_table():
    rest = case_of("clean: unnamed, at rest, smooth error")
    found = planted(rest, NAMES.Texts(("not resolved: D_R < 1",), ("labels swap",), (3,)))
    assert found.alarmed == 0
    found = planted(rest, NAMES.Texts(("not resolved" + 600 * ".",), (), (3,)))
    assert dict(found.kinds) == {"too long": 1}
    found = planted(rest, NAMES.Texts((), (), (2,)))
    assert dict(found.kinds) == {"wrong bodies": 1}


def test_an_error_is_a_warning_with_its_text():
    def refuse(_):
        raise ValueError("the mean velocity is not known")

    rng = np.random.default_rng(0)
    report = NAMES.measured(NAMES.Case("none", lambda _: None, measure=refuse), rng)
    assert report.warnings == ("refused: ValueError: the mean velocity is not known",)


def test_lines_break_where_they_should():
    """190 of 200 named is 95 %; 3 of 200 is over 1 %, and 10 of 200 excludes it for one case."""
    clean = "clean: two clusters"
    assert NAMES.verdicts([tally_of("flow 1 um/s", 200, named=190)], level=None) == []
    assert len(NAMES.verdicts([tally_of("flow 1 um/s", 200, named=189)], level=None)) == 1
    few = tally_of(clean, 200, alarmed=2, kinds={"scan": 2})
    assert NAMES.verdicts([few], level=None) == []
    some = tally_of(clean, 200, alarmed=3, kinds={"scan": 3})
    assert NAMES.verdicts([some], level=None) == ["scan: in 3 of 200 clean tables"]
    many = tally_of(clean, 200, alarmed=10, kinds={"scan": 10})
    others = [tally_of(c.name, 200) for c in NAMES.CLEAN if c.name != clean]
    assert NAMES.verdicts([many, *others], level=None) == [f"{clean}: scan in 10 of 200"]
    every = tally_of(clean, 200, alarmed=7, kinds={"scan": 2, "floor": 2, "cut": 2, "labels": 1})
    assert NAMES.verdicts([every], level=None) == ["any warning: in 7 of 200 clean tables"]


def test_a_small_form_allows_for_chance():
    """One of two tables named is compatible with 95 %, none of two is not."""
    level = NAMES.QUICKLY_EXCLUDED
    assert NAMES.verdicts([tally_of("flow 1 um/s", 2, named=1)], level=level) == []
    assert len(NAMES.verdicts([tally_of("flow 1 um/s", 2, named=0)], level=level)) == 1


def test_one_case_by_the_command_line(capsys):
    """A column time that contradicts dt is named in both tables."""
    assert NAMES.main(["--only", "time contradicts dt", "--repeats", "2"]) == 0
    assert "| time contradicts dt | time | 100 |" in capsys.readouterr().out


def test_a_name_of_no_case_is_refused(capsys):
    with pytest.raises(SystemExit):
        NAMES.main(["--only", "no such case"])
    assert "no case has 'no such case' in its name" in capsys.readouterr().err


# Quick cases that together raise every kind of warning that a fault must have; that clusters
# disagree is a law of `test_analysis`.
ONE_CASE_PER_KIND = (
    "flow 0.15 um/s", "steady turn 0.2 rad/s", "stage jump 3 um, plane", "many jumps", "caged",
    "time contradicts dt", "5 % repeat the last place", "5 % at (0, 0), plane", "centred before",
    "soft arm, 0.2 rad", "slices of tumbling bodies", "z +10 %, 100 frames", "sequential scan",
    "labels exchanged 15 times", "line through an anisotropic MSAD", "undersampled",
    "noise dominates", "20 frames", "in mm", "viscosity 2.18 Pa s", "clean: unnamed, plane",
)  # fmt: skip


def test_every_kind_of_fault_is_named(repeats):
    """One table of every case: the fault is named, and no other warning appears."""
    if not repeats(0, 1):
        pytest.skip("benchmarks/alarms.py --quick is run by itself; here with --long")
    tallies = [NAMES.tried(case_of(name), 0, 0) for name in ONE_CASE_PER_KIND]
    for found in tallies:
        assert found.named == int(bool(found.case.expected)), found.case.name
        assert not found.texts, found.case.name
    raised = {kind for found in tallies for kind in found.case.expected}
    faults = [c.expected for c in NAMES.FAULTS if c.where == "warnings"]
    assert {kinds for kinds in faults if not raised & set(kinds)} == {("disagreement",)}


def test_every_fault_is_named_and_clean_data_are_quiet(capsys, repeats):
    """Two tables of every case; a line is broken where the count excludes it."""
    if not repeats(0, 1):
        pytest.skip("benchmarks/alarms.py --quick is run by itself; here with --long")
    status = NAMES.main(["--quick"])
    assert status == 0, capsys.readouterr().out
