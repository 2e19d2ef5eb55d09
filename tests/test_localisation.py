"""Parts of the search for spheres: limits of arguments, frames, groups and crowds by hand."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

import perrin
from perrin.errors import FrameError
from perrin.images import CameraNoise
from perrin.images.optics.ball_image import sphere_image
from perrin.images.optics.crowd_fit import CrowdFit
from perrin.images.optics.samples import UsualImage
from perrin.images.spheres.by_trackpy import Features
from perrin.images.spheres.localisation import (
    NO_SPHERE,
    LocatedFrame,
    Method,
    Search,
    check_search,
    choose_method,
    found_table,
    group_columns,
    groups_to_fit,
    locate,
    sample_frames,
    size_faults,
    with_crowds,
    without_doubles,
)
from perrin.images.spheres.spots import Fading, Spots

pytest.importorskip("trackpy")

VOXEL, PSF = (0.25, 0.2, 0.2), (0.3, 0.15)
OPTICS = perrin.Optics(1.0, PSF, CameraNoise(1.0, 4.0))
SEARCH = Search(1.0, 1.0)
SHAPE = (16, 24, 24)


class Movie:
    """Frames in memory, of which some cannot be read."""

    def __init__(self, frames, voxel=VOXEL, *, broken=()):
        self.frames, self.voxel, self.broken = np.asarray(frames), voxel, broken
        self.shape = self.frames.shape

    def frame(self, i):
        if i in self.broken:
            raise FrameError(f"frame {i} is broken", i)
        return self.frames[i]


def drawn(centers, brightness=None, *, shape=SHAPE, background=20.0):
    """Return the expected frame of spheres."""
    image, frame = sphere_image(diameter=1.0, psf=PSF, voxel=VOXEL), np.full(shape, background)
    brightness = [100.0] * len(centers) if brightness is None else brightness
    for center, bright in zip(centers, brightness, strict=True):
        spot = image.spot(np.asarray(center, float), shape)
        frame[spot.box] += bright * spot.value
    return frame


# ---- arguments ----------------------------------------------------------------------------------


def faults_of(search=SEARCH, refine="model", *, stack=None, optics=None):
    """Return the faults of a search in a stack of 4 x 4.8 x 4.8 um."""
    stack = Movie(np.zeros((1, *SHAPE))) if stack is None else stack
    try:
        check_search(stack, search, refine, optics=optics)
    except ValueError as fault:
        return str(fault)
    return ""


def test_arguments_are_refused_at_their_limits():
    """Each limit by itself, and faults that were found before first."""
    assert faults_of() == ""
    assert faults_of(Search(1.2, 1.0)) == ""
    assert "are the two exchanged" in faults_of(Search(1.21, 1.0))
    assert faults_of(Search(1.0, 1.0, percentile=0.0)) == ""
    for percentile in (-1.0, 100.0):
        assert faults_of(Search(1.0, 1.0, percentile=percentile)).startswith("percentile: ")
    assert faults_of(Search(0.0, 1.0)).startswith("diameter: ")
    for contact in (-1.0, 0.0):
        assert faults_of(Search(1.0, contact)).startswith("contact: ")
    assert faults_of(refine="disc").startswith("refine: ")
    for refine in ("trackpy", None):
        assert faults_of(refine=refine) == ""
    assert "shape (t, z, y, x)" in faults_of(stack=Movie(np.zeros((4, 8, 8))))
    flat = Movie(np.zeros((1, 1, 64, 64)), (np.nan, 0.2, 0.2))
    assert faults_of(Search(1.0, 1.0, circles=True), stack=flat) == ""
    assert faults_of(Search(1.0, 1.0, circles=True), stack=flat, optics=OPTICS).startswith("optics")
    spread = SimpleNamespace()
    measured = Search(1.0, 1.0, psf=spread)
    assert faults_of(measured) == ""
    assert "state one of them" in faults_of(measured, optics=OPTICS)
    for refine in ("trackpy", None):
        assert "leave it out" in faults_of(measured, refine)
    plane = Search(1.0, 1.0, psf=spread, circles=True)
    assert "leave it out" in faults_of(plane, stack=flat)
    with pytest.raises(ValueError, match=r"^minmass: x; diameter: "):
        check_search(flat, Search(-1.0, 1.0), "model", faults=["minmass: x"])


def test_lengths_in_another_unit_are_refused_at_their_limits():
    """The stack is 4 x 4.8 x 4.8 um, its diagonal 7.88 um, half of the largest voxel 0.125 um."""
    stack = Movie(np.zeros((1, *SHAPE)))
    assert size_faults(stack, Search(4.0, 4.0), None) == []
    (text,) = size_faults(stack, Search(4.01, 4.0), None)
    assert text == (
        "diameter 4.01 um does not fit into the stack: the stack is 4 x 4.8 x 4.8 um (z, y, x), "
        "its voxels are 0.25 x 0.2 x 0.2 um; are the lengths in um?"
    )
    assert size_faults(stack, Search(0.126, 1.0), None) == []
    assert "less than half a voxel" in size_faults(stack, Search(0.124, 1.0), None)[0]
    assert size_faults(stack, Search(1.0, 7.87), None) == []
    assert "longer than the stack's diagonal" in size_faults(stack, Search(1.0, 7.89), None)[0]
    wide = perrin.Optics(5.0, (4.5, 0.1), CameraNoise(1.0, 4.0))
    (text,) = size_faults(stack, SEARCH, wide)
    assert text.startswith(
        "optics: diameter 5 um does not fit into the stack, optics: point spread 4.5 um does not"
    )
    assert size_faults(stack, SEARCH, OPTICS) == []
    flat = Movie(np.zeros((1, 1, 10, 20)), (np.nan, 0.2, 0.2))
    (text,) = size_faults(flat, Search(2.1, 2.1), None)
    assert "the stack is 2 x 4 um (y, x), its voxels are 0.2 x 0.2 um" in text


def test_the_search_has_the_options_of_the_spots():
    """In a 2-D movie it is for circles if the model refines."""
    spots = Spots(dark=True, percentile=80.0, minmass=3.0, border=False)
    asked = {"diameter": 1.0, "contact": 1.1, "crowds": True}
    stack = Movie(np.zeros((1, *SHAPE)))
    found = Search.of(stack, spots, refine="model", **asked)
    assert found == Search(1.0, 1.1, True, 80.0, 3.0, False, True, False, None)
    flat = Movie(np.zeros((1, 1, 64, 64)), (np.nan, 0.2, 0.2))
    assert Search.of(flat, spots, refine="model", **asked).circles
    assert not Search.of(flat, spots, refine=None, **asked).circles
    features = Features(np.zeros((3, 3)), np.array([2.9, 3.0, 5.9]))
    assert found.spheres(features).mass.tolist() == [3.0, 5.9]
    assert found.spheres(features, np.array([0.5, 1.0, 2.0])).mass.tolist() == [2.9, 3.0]
    assert SEARCH.spheres(features).mass.size == 3
    bleached = Method(found, fading=Fading((0, 10), (1.0, 0.25)))
    assert bleached.spheres(features, 10).mass.size == 3
    assert Method(found).spheres(features, 10).mass.size == 2


# ---- frames -------------------------------------------------------------------------------------


def test_frames_are_sampled_evenly_as_far_as_they_can_be_read():
    """Five of eleven, first and last among them; an error only if none can be read."""
    frames = np.stack([drawn([[2.0, 2.4, 2.4]]) + k for k in range(11)])
    sample = sample_frames(Movie(frames), SEARCH, range(11))
    assert [s.number for s in sample] == [0, 2, 5, 8, 10]
    np.testing.assert_array_equal(sample[2].frame, frames[5])
    assert len(sample[0].spots.mass) >= 1
    rest = sample_frames(Movie(frames, broken=(0, 5)), SEARCH, range(11))
    assert [s.number for s in rest] == [2, 8, 10]
    assert [s.number for s in sample_frames(Movie(frames), SEARCH, [7, 3])] == [7, 3]
    with pytest.raises(FrameError, match="frame 0 is broken"):
        sample_frames(Movie(frames, broken=range(11)), SEARCH, range(11))
    frames[4, 0, 0, :2] = np.nan, np.inf
    with pytest.raises(FrameError, match="frame 4 has 2 voxels without a number"):
        sample_frames(Movie(frames), SEARCH, [4])


def test_frames_that_cannot_be_read_are_left_out_and_named():
    """The first three by their faults, more by their number."""
    frames = np.stack([drawn([[2.0, 2.4, 2.4]])] * 6)
    asked = {"diameter": 1.0, "contact": 1.0, "refine": None, "minmass": 10.0}
    with pytest.warns(perrin.PrecisionWarning) as caught:
        table = locate(Movie(frames, broken=(1, 2, 4, 5)), **asked)
    assert [str(w.message) for w in caught] == [
        "4 of 6 frames are left out: frame 1 is broken; frame 2 is broken; frame 4 is broken and 1 "
        "more"
    ]
    assert caught[0].filename == __file__
    assert sorted(set(table["frame"])) == [0, 3]
    assert list(table) == ["frame", "x", "y", "z", "mass"]
    with pytest.warns(perrin.PrecisionWarning, match=r"^1 of 2 frames .*: frame 1 is broken$"):
        assert set(locate(Movie(frames, broken=(1,)), frames=[0, 1], **asked)["frame"]) == {0}
    for wrong in ([-1], [6]):
        with pytest.raises(ValueError, match=r"frames: expected 0 to 5, as the stack has 6"):
            locate(Movie(frames), frames=wrong, **asked)
    empty = found_table([])
    assert list(empty) == ["frame", "x", "y", "z", "mass"]
    two = [LocatedFrame({"x": np.array([k, 2.0])}, 2, 0.0, 0.0, "") for k in (0.0, 1.0)]
    assert found_table(two)["x"].tolist() == [0, 2, 1, 2]
    assert found_table(two).index.tolist() == [0, 1, 2, 3]


def test_a_method_learns_only_what_is_not_stated():
    """The mass cut unless it is stated; no optics unless the model refines with learned ones."""
    frame = drawn([[2.0, 2.4, 1.2], [2.0, 2.4, 3.4]])
    sample = sample_frames(Movie([frame] * 2), SEARCH, [0, 1])
    method = choose_method(Movie([frame]), SEARCH, sample, refine=None, optics=OPTICS)
    assert (method.optics, method.refine) == (None, None)
    assert method.search.minmass is not None
    assert len(method.spheres(sample[0].spots, 0).mass) == 2
    stated = Search(1.0, 1.0, minmass=3.0)
    method = choose_method(Movie([frame]), stated, sample, refine="trackpy")
    assert (method.search, method.optics, method.fading) == (stated, None, None)
    method = choose_method(Movie([frame]), stated, sample, optics=OPTICS)
    assert method.optics is OPTICS


def test_trackpy_is_refused_where_most_spheres_are_in_larger_groups():
    """Seventeen in a chain and sixteen in another are refused, with a pair more they are not."""
    long = np.array([[0.0, 0.0, k] for k in range(17)])
    short = np.array([[9.0, 0.0, k] for k in range(16)])
    for more, fine in ((short, False), (np.concatenate([short, short[:2] + 9.0]), True)):
        centers = np.concatenate([long, more])
        sampled = SimpleNamespace(number=0, spots=Features(centers, np.ones(len(centers))))
        search = Search(1.0, 1.0, minmass=0.5)
        if fine:
            assert (
                choose_method(unseen_movie(), search, [sampled], refine="trackpy").search == search
            )
            continue
        with pytest.raises(
            ValueError, match=r"chains of up to 17 in this movie, over its limit of"
        ):
            choose_method(unseen_movie(), search, [sampled], refine="trackpy")
    nothing = SimpleNamespace(number=0, spots=Features(np.empty((0, 3)), np.empty(0)))
    assert choose_method(unseen_movie(), search, [nothing], refine="trackpy").refine == "trackpy"


def unseen_movie():
    """Return a movie whose frames are not looked at."""
    return Movie(np.zeros((1, *SHAPE)))


def test_crowds_that_are_not_refined_need_no_optics():
    """Where most spheres are in crowds; as many in groups as in crowds are learned from."""
    crowd = np.array([[0.0, 0.0, 1.5 * k] for k in range(18)])
    few = np.array([[30.0, 0.0, 5.0 * k] for k in range(17)])
    search = Search(1.0, 1.0, minmass=0.5)
    centers = np.concatenate([crowd, few])
    sampled = SimpleNamespace(number=0, spots=Features(centers, np.ones(35)))
    assert choose_method(unseen_movie(), search, [sampled]).optics is None


# ---- groups -------------------------------------------------------------------------------------


def test_crowds_with_dust_are_divided_into_groups_of_at_most_forty():
    """Spheres that touch; without dust crowds stay."""
    row = np.array([[0.0, 0.0, 1.2 * k] for k in range(40)])
    beside = np.array([[0.0, 1.5, 0.0], [0.0, 1.5, 1.2]])
    centers = np.concatenate([row, beside])
    groups, crowds = groups_to_fit(centers, 1.0, dusty=True)
    assert (sorted(map(len, groups)), crowds) == ([2, 40], [])
    assert np.array_equal(np.sort(np.concatenate(groups)), np.arange(42))
    groups, crowds = groups_to_fit(centers, 1.0, dusty=False)
    assert (groups, [len(c) for c in crowds]) == ([], [42])
    longer = np.concatenate([centers, [[0.0, 0.0, 48.0]]])
    groups, crowds = groups_to_fit(longer, 1.0, dusty=True)
    assert (groups, [len(c) for c in crowds]) == ([], [43])


def columns_of(x, chi2, refined=None):
    """Return columns of spheres along x."""
    count = len(x)
    zero = np.zeros(count)
    refined = np.ones(count, bool) if refined is None else np.array(refined)
    return {
        "x": np.array(x, float), "y": zero, "z": zero, "chi2": np.array(chi2, float),
        "refined": refined, "reason": np.where(refined, "", "dark").astype(object),
    }  # fmt: skip


def test_of_two_spheres_in_one_place_the_better_stays():
    """Nearer than 0.8 contacts, the worst of all first; those that are not refined do not count."""
    found = without_doubles(columns_of([0, 1.59, 9], [3, 2, 1]), contact=2.0)
    assert found["refined"].tolist() == [False, True, True]
    assert found["reason"].tolist()[0].startswith("nearer than 0.8 contact distances")
    assert found["reason"].tolist()[1:] == ["", ""]
    apart = without_doubles(columns_of([0, 1.61, 9], [3, 2, 1]), contact=2.0)
    assert apart["refined"].all()
    # The middle one of three is the worst: without it the others stay.
    three = without_doubles(columns_of([0, 1.5, 3.0], [1, 3, 2]), contact=2.0)
    assert three["refined"].tolist() == [True, False, True]
    # The last is the worst: then the middle one goes for the first.
    three = without_doubles(columns_of([0, 1.5, 3.0], [1, 2, 3]), contact=2.0)
    assert three["refined"].tolist() == [True, False, False]
    one = columns_of([0, 1.0], [1, 2], [True, False])
    assert without_doubles(one, contact=2.0) is one


def test_reasons_for_which_a_sphere_is_not_refined():
    """No light, moved by over half a radius, no voxels, or no optics; others are where they are."""
    places = np.array([[2.0, 2.4, 1.2], [2.0, 2.4, 2.2]])
    frame = drawn(places, [100.0, 80.0])
    spots = Features(places + 0.05, np.array([5.0, 4.0]))
    columns, crowds = group_columns(frame, spots, SEARCH, OPTICS, VOXEL)
    assert (columns["reason"].tolist(), columns["refined"].tolist()) == (["", ""], [True, True])
    x = np.stack([columns[a] for a in "zyx"], axis=1)
    np.testing.assert_allclose(x, places, atol=1e-4)
    assert (crowds, columns["mass"].tolist()) == ([], [5.0, 4.0])
    assert columns["chi2"].max() < 1e-3
    sigma = np.stack([columns[f"sigma_{a}"] for a in "zyx"], axis=1)
    assert np.all((sigma > 0.002) & (sigma < 0.05))
    assert np.all(sigma[1] > sigma[0])
    # Without optics all keep the positions found first.
    plain, _ = group_columns(frame, spots, SEARCH, None, VOXEL)
    assert plain["reason"].tolist() == ["in a crowd"] * 2
    np.testing.assert_array_equal(plain["x"], spots.centers[:, 2])
    assert np.isnan(plain["sigma_x"]).all()
    assert np.isnan(plain["chi2"]).all()
    # A quarter of the diameter, 0.25 um, is the farthest.
    for shift, reason in ((0.24, ""), (0.26, "moved over half a radius")):
        away = Features(places[:1] + shift * np.eye(3)[1], np.ones(1))
        found, _ = group_columns(drawn(places[:1]), away, SEARCH, OPTICS, VOXEL)
        assert found["reason"].tolist() == [reason]
        expected = places[0, 1] if reason == "" else places[0, 1] + shift
        assert found["y"][0] == pytest.approx(expected, abs=1e-3)
        assert np.isnan(found["sigma_y"][0]) == (reason != "")
    # A tenth of the median brightness.
    three = np.array([[2.0, 2.4, 1.2], [2.0, 2.4, 2.2], [2.0, 2.4, 3.2]])
    for bright, reason in (
        (11.0, ""),
        (9.0, "no light of its own"),
        (-50.0, "no light of its own"),
    ):
        dim = drawn(three, [100.0, 100.0, bright])
        found, _ = group_columns(dim, Features(three, np.ones(3)), SEARCH, OPTICS, VOXEL)
        assert found["reason"].tolist() == ["", "", reason]
    dark = drawn(three, [-10.0] * 3)
    found, _ = group_columns(dark, Features(three, np.ones(3)), SEARCH, OPTICS, VOXEL)
    assert found["refined"].all()
    # Too few voxels that no other group has.
    lost = np.full(SHAPE, np.nan)
    lost[7:9, 11:13, 5:7] = frame[7:9, 11:13, 5:7]
    found, _ = group_columns(lost, Features(places[:1], np.ones(1)), SEARCH, OPTICS, VOXEL)
    assert found["reason"].tolist() == ["no voxels of its own"]


def test_an_image_that_is_no_sphere_is_named_and_left_out_of_the_others():
    """By its brightness over the usual one, dimmed where all are, and by its chi-squared."""
    places = np.array([[2.0, 2.4, 1.2], [2.0, 2.4, 2.2]])
    frame = drawn(places, [100.0, 300.0])
    spots = Features(places, np.ones(2))
    usual = UsualImage(1.0, 100.0, 0.1)
    found, _ = group_columns(frame, spots, SEARCH, OPTICS, VOXEL, usual=usual)
    assert found["reason"].tolist()[1] == NO_SPHERE
    assert not found["refined"][1]
    alone = drawn(places[1:], [300.0])
    found, _ = group_columns(
        alone, Features(places[1:], np.ones(1)), SEARCH, OPTICS, VOXEL, usual=usual
    )
    assert found["reason"].tolist() == [NO_SPHERE]
    both, _ = group_columns(
        frame, spots, SEARCH, OPTICS, VOXEL, usual=usual, light=np.array([1.0, 3.0])
    )
    assert both["refined"].all()
    brighter, _ = group_columns(3 * frame, spots, SEARCH, OPTICS, VOXEL, usual=usual, light=3.0)
    assert brighter["reason"].tolist()[1] == NO_SPHERE


def crowd_of(centers, **given):
    """Return a fit of a crowd with these spheres."""
    count = len(centers)
    own = {
        "centers": np.array(centers, float), "sigma": np.full((count, 3), 0.01),
        "chi2": np.ones(count), "converged": np.ones(count, bool), "origin": np.arange(count),
        "window": None, "intensity": None,
    }  # fmt: skip
    return CrowdFit(**(own | given))


def test_rows_of_a_crowd_replace_those_of_its_spots():
    """Fits that did not converge keep their first position or are left out, as are cut spheres."""
    spots = Features(np.array([[2.0, 2, k] for k in (1.0, 2, 3, 4)]), np.arange(4.0))
    columns, _ = group_columns(np.zeros(SHAPE), spots, SEARCH, None, VOXEL)
    places = [[2.0, 2.1, 2.2], [2.0, 2.1, 9.0], [1.5, 1.5, 1.5], [1.0, 1.0, 1.0], [2.0, -0.05, 1.0]]
    crowd = crowd_of(
        places, converged=np.array([True, False, True, False, True]),
        origin=np.array([1, 0, -1, -1, -1]), chi2=np.array([1, 1, 9, 1, 1.0]),
    )  # fmt: skip
    group = np.array([3, 1])
    found = with_crowds(
        columns, np.zeros(SHAPE), spots, SEARCH, VOXEL, crowds=[(group, crowd)],
        usual=UsualImage(1.0, 100.0, 0.1),
    )  # fmt: skip
    # Rows 0 and 2 stay; of the crowd: spot 1 refined, spot 3 as it was, two that were added.
    assert found["x"].tolist() == [1, 3, 2.2, 4, 1.5, 1.0]
    assert found["y"].tolist() == [2, 2, 2.1, 2, 1.5, -0.05]
    np.testing.assert_array_equal(found["mass"], [0, 2, 1, 3, np.nan, np.nan])
    assert found["refined"].tolist() == [False, False, True, False, False, True]
    assert found["reason"].tolist()[2:] == ["", "fit did not settle", NO_SPHERE, ""]
    assert np.isnan(found["sigma_x"]).tolist() == [True, True, False, True, False, False]
    # A sphere without a standard error is not refined; half a voxel beyond the field is outside.
    some = crowd_of([[2.0, 2.1, 2.2], [2.0, -0.11, 1.0]], origin=np.array([0, -1]))
    some.sigma[0, 1] = np.nan
    rest = with_crowds(columns, np.zeros(SHAPE), spots, SEARCH, VOXEL, crowds=[(group[:1], some)])
    assert rest["x"].tolist() == [1, 2, 3, 4]
    assert rest["reason"].tolist()[3] == "fit did not settle"
    # Without border a sphere must be a radius inside: 0.5 um from 0 and from 4.6 um.
    inner = Search(1.0, 1.0, border=False)
    edge = [[2.0, 2.0, 0.49], [2.0, 2.0, 0.51], [2.0, 4.09, 2.0], [2.0, 4.11, 2.0]]
    kept = with_crowds(
        columns, np.zeros(SHAPE), spots, inner, VOXEL,
        crowds=[(group, crowd_of(edge, origin=np.array([0, 1, -1, -1])))],
    )  # fmt: skip
    assert kept["x"].tolist() == [1, 3, 0.51, 2.0]
    same = with_crowds(columns, np.zeros(SHAPE), spots, SEARCH, VOXEL, crowds=[])
    assert same["x"].tolist() == columns["x"].tolist()


def test_a_movie_is_located_with_optics_that_are_stated():
    """Positions and errors of every frame; equal frames have one digest."""
    places = np.array([[2.0, 2.4, 1.2], [2.0, 2.4, 3.4]])
    frame = np.round(drawn(places))
    movie = Movie([frame, frame + 1])
    table = locate(movie, diameter=1.0, contact=1.0, optics=OPTICS, minmass=50.0)
    assert table["frame"].tolist() == [0, 0, 1, 1]
    np.testing.assert_allclose(np.sort(table["x"]), [1.2, 1.2, 3.4, 3.4], atol=0.01)
    np.testing.assert_allclose(table["z"], 2.0, atol=0.01)
    assert table["refined"].all()
    method = Method(Search(1.0, 1.0, minmass=50.0), optics=OPTICS)
    one, two = (method.locate_in(movie, i) for i in (0, 1))
    assert one.columns["frame"].tolist() == [0, 0]
    assert one.spots >= 2
    assert (one.level, two.level) == (np.median(frame), np.median(frame) + 1)
    assert one.digest == method.locate_in(movie, 0).digest != two.digest
    known = sample_frames(movie, SEARCH, [0])[0]._replace(
        spots=Features(places[:1], np.array([99]))
    )
    assert method.locate_in(movie, 0, known=known).columns["x"].size == 1
