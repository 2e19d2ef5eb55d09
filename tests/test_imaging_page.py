"""The page of imaging quality shows the numbers of its tables, escaped and in one file."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

import perrin
from perrin._text import number_text
from perrin.images import Asymmetry, Pupil
from perrin.plot import figure_style
from perrin.report import write
from perrin.report.imaging_page import render_imaging_quality
from test_plot_images import BALL, seen
from test_report import Page, pictures, save_blank

NAMES = ("found", "tracks", "masses", "residuals", "steps", "health")


@pytest.fixture(scope="module")
def report():
    return seen()


def text_of(report):
    page = Page(render_imaging_quality(report, []))
    assert page.open == []
    return page.text


def test_the_page_holds_the_numbers(report):
    text = text_of(report)
    assert "Frames read 40 of 40 from 0 to 27.3 s" in text
    assert "Spheres in a frame 8 in every frame" in text
    assert "Clusters tracked 2 all spheres belong to one" in text
    assert "4.0, 5.0, 6.0 nm median, along x, y, z" in text
    assert "mass cut 2340 300 of 308 spots" in text
    assert "image misfit 1.00" in text
    assert "not refined 0 of 320 all fits converged" in text
    assert (
        "apparent diameter 2.440(2) µm learned from the images; the expected diameter is 2.45"
        in text
    )
    assert "point spread 0.152(4) µm standard deviation in the plane; 0.410(3) µm along z" in text
    assert "gain 3.10 the variance of a voxel is 3.10 times its signal + 12.0" in text
    assert "smallest symmetry rotation 120°" in text
    assert "saturated voxels none" in text
    assert "0.2 × 0.2 × 0.25 µm" in text
    sigma = np.median([c.motion.sigma for c in report.clusters])
    assert f"error from rigid bodies {number_text(1e3 * sigma, digits=2)} nm" in text
    assert "Warnings" not in text


def test_a_pinhole_is_named_beside_the_diameter(report):
    """The radius of the pinhole stands in a row of its own, the diameter of the spheres stays."""
    optics = replace(report.imaging.optics, pupil=Pupil(lateral=15.0, slope=0.5, pinhole=1.02))
    text = text_of(replace(report, imaging=replace(report.imaging, optics=optics)))
    assert "apparent diameter 2.440(2) µm" in text
    # The first dark ring of the focus is 3.83 over `lateral` from its middle.
    assert "pinhole 1.02 µm radius in the sample, learned; a diameter of 3.99 Airy units" in text


def test_the_shape_of_an_asymmetric_point_spread_is_named(report):
    optics = replace(report.imaging.optics, asymmetry=Asymmetry(zx=0.02, zzz=1e-3))
    other = replace(report, imaging=replace(report.imaging, optics=optics))
    assert "shape of the point spread asymmetric a tilted axis, a difference above" in text_of(
        other
    )
    assert "shape of the point spread" not in text_of(report)


def test_the_distance_of_touching_spheres_is_compared_with_the_contact_distance(report):
    """Bodies stretched by 10 % have touching spheres 10 % beyond contact; all 12 pairs count."""
    wide = [
        replace(c, motion=replace(c.motion, template=1.1 * c.motion.template))
        for c in report.clusters
    ]
    found = re.search(
        r"touching spheres (\S+) µm mean of 12 pairs; contact is 2\.45 µm \(\+(\S+) %\)",
        text_of(replace(report, clusters=tuple(wide))),
    )
    # The template's own error is 10 nm / sqrt(40 frames) a particle.
    assert float(found[1]) == pytest.approx(1.1 * BALL, abs=0.005)
    assert float(found[2]) == pytest.approx(10, abs=0.2)


def test_faults_are_listed_and_escaped(report):
    """Faults with their frames, rejected fits with their reasons, and warnings are plain text."""
    frames = report.imaging.frames.copy()
    frames.loc[[4, 9], "fault"] = "<script>page</script> & more"
    frames.loc[[1, 2, 3], "spheres"] = 0
    frames["saturated"] = np.linspace(0, 0.0123, 40)
    features = report.imaging.features.copy()
    features.loc[:4, "refined"] = False
    features.loc[:2, "reason"] = "did not <settle>"
    features.loc[3, "reason"] = "no sphere"
    features.loc[:31, "cluster"] = -1
    features["mass"] = 1000.0 - 500 * (features["frame"] >= 20)
    imaging = replace(report.imaging, frames=frames, features=features)
    page = Page(
        render_imaging_quality(replace(report, imaging=imaging, warnings=("no <gap> & so",)), [])
    )
    assert "38 of 40 from 0 to 27.3 s; 2 could not be read" in page.text
    assert "8 median; 0 to 8; none in 3 frames" in page.text
    assert "9 6.30 <script>page</script> & more" in page.text
    assert "90 % of the spheres belong to one" in page.text
    text = "not refined 5 of 320 their unrefined positions were kept: did not <settle> (3)"
    assert text in page.text
    assert "no sphere (1)" in page.text
    assert "no reason stated (1)" in page.text
    assert "saturated voxels 1.2 %" in page.text
    assert "brightness 50.0 %" in page.text
    assert "Warnings no <gap> & so" in page.text
    assert not {"script", "settle", "gap"} & set(page.tags)


def test_without_fits_and_without_clusters_there_are_no_empty_values(report):
    bare = seen(planar=True, refine=None, clusters=1)
    text = text_of(bare)
    for absent in (
        "stated error",
        "not refined",
        "apparent diameter",
        "image misfit",
        "nan",
        "None",
    ):
        assert absent not in text, absent
    assert "not: positions are filtered centroids" in text
    assert "voxel, x × y 0.2 × 0.2 µm" in text
    frames = report.imaging.frames.assign(fault="cut short", spheres=0)
    lost = replace(report.imaging, frames=frames, features=report.imaging.features[:0], minmass=0)
    text = text_of(replace(report, clusters=(), pooled=None, imaging=lost))
    assert "0 of 40" in text
    assert "no frame could be read" in text
    assert "no sphere was found" in text
    assert "mass cut none" in text
    assert not re.search(r"\bnan\b|\bNone\b", text)


def test_pictures_are_embedded_and_explained(report, tmp_path):
    files = pictures(tmp_path, *[f"images-{name}" for name in NAMES])
    html = render_imaging_quality(report, [*files, tmp_path / "images-found.pdf"])
    page = Page(html)
    assert page.tags.count("img") == 6
    assert page.text.count("What to look for:") == 6
    assert all(s.startswith("data:image/png;base64,") or s == "report.html" for s in page.sources)
    assert not {"script", "link", "iframe", "object", "base"} & set(page.tags)
    assert not re.search(r"https?:|url\(|@import|javascript:", html)


def test_the_run_folder_has_the_page_for_a_movie_only(report, tmp_path, monkeypatch, repeats):
    """For a movie it is written and linked both ways; read back it is the same page."""
    monkeypatch.setattr(write, "save_figures", lambda *_, **__: [])
    if repeats(True, False):
        monkeypatch.setattr(figure_style, "save_figure", save_blank)
    few = replace(report, imaging=replace(report.imaging, views=report.imaging.views[:1]))
    for name, one in (("images", few), ("table", replace(report, imaging=None))):
        write.write_run(one, tmp_path / name)
    linked = Page((tmp_path / "images" / "report.html").read_text(encoding="utf-8"))
    assert "quality.html" in linked.sources
    page = Page((tmp_path / "images" / "quality.html").read_text(encoding="utf-8"))
    assert "report.html" in page.sources
    assert page.tags.count("img") == 6
    drawn = {f.name for f in (tmp_path / "images" / "figures").iterdir()}
    assert drawn == {f"images-{n}.{suffix}" for n in NAMES for suffix in ("png", "pdf")}
    again = perrin.load_run(tmp_path / "images")
    assert render_imaging_quality(again, []) == render_imaging_quality(few, [])
    unlinked = Page((tmp_path / "table" / "report.html").read_text(encoding="utf-8"))
    assert "quality.html" not in unlinked.sources
    assert not (tmp_path / "table" / "quality.html").exists()
    assert not list((tmp_path / "table" / "figures").iterdir())
