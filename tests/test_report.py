"""The report page shows the results, escaped and in one file; a run folder is whole or absent."""

from __future__ import annotations

import base64
import gzip
import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

import perrin
from perrin._text import number_text
from perrin.diffusion.estimate import bare_text
from perrin.plot import figure_style
from perrin.report import citations, embedding, figure_data, write
from perrin.report import page as report
from perrin.run import repetition
from perrin.run.results import write_data
from test_plot import estimate, measured

PNG = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAQAAAC1HAwCAAAAC0lEQVR42mNk+M8AAAMBAQDJ/pLvAAAAAElFTkSuQmCC"
)


class Page(HTMLParser):
    """Collects text, tags, and all attributes that could load a resource."""

    def __init__(self, html):
        super().__init__()
        self.words, self.tags, self.sources, self.open = [], [], [], []
        self.feed(html)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.sources += [v for k, v in attrs if k in ("src", "href", "srcset", "data", "action")]
        self.handlers = [k for k, _ in attrs if k.startswith("on")]
        assert not self.handlers
        if tag not in ("meta", "img", "br", "input"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if not {"style", "script", "svg"} & set(self.open):
            self.words.append(data)

    @property
    def text(self):
        return " ".join(" ".join(self.words).replace("\xa0", " ").split())


@pytest.fixture(autouse=True)
def short_library(monkeypatch, request):
    """Leave plotly.js out of the pages, which are then read in a fraction of the time."""
    if "scripts" not in request.node.name:
        monkeypatch.setattr(report, "plotly_script", lambda: ("", "'none'"))


@pytest.fixture(scope="module")
def single():
    found = measured(frames=60)
    settings = {
        "input": {"path": '/data/<my> & "tracks".csv', "sha256": "ab" * 32},
        "arguments": {"dt": 0.5, "sigma": None, "viscosity": 2.18e-3, "temperature": 295.0},
        "versions": {"python": "3.11.7", "perrin": "0.1.0"},
        "created": "2026-01-02T03:04:05+00:00",
    }
    return replace(found, settings=settings)


def pictures(folder, *stems):
    for stem in stems:
        (folder / f"{stem}.png").write_bytes(PNG)
    return [folder / f"{stem}.png" for stem in stems]


def save_blank(_, stem):
    """Write a picture of one pixel in place of a figure, under the names of `save_figure`."""
    files = [stem.with_name(stem.name + suffix) for suffix in (".png", ".pdf")]
    for file in files:
        file.write_bytes(PNG)
    return files


def test_the_page_holds_the_numbers(single):
    page = Page(report.render_html(single, []))
    (found,) = single.clusters
    assert page.open == []
    for one in (found.D_R, found.D_T):
        assert bare_text(one) in page.text
        for end in (*one.ci68, *one.ci95):
            # The ends as print rounds them.
            shown = [float(n) for n in re.findall(r"\d+\.\d+", page.text)]
            assert min(abs(n - end) for n in shown) < 0.02 * one.stderr + 5e-3 * end
    assert number_text(1e3 * found.motion.sigma) + " nm" in page.text
    assert number_text(found.noise.phi2) in page.text
    degrees = np.rad2deg(np.sqrt(found.noise.phi2))
    assert f"Φ = {number_text(degrees)}°" in page.text
    assert "60 of 60" in page.text
    assert "ab" * 32 in page.text
    assert "2026-01-02 03:04 UTC" in page.text
    assert "0.00218 Pa s" in page.text
    assert "sigma not given" in page.text
    assert "Optics Express 19, 17189 (2011)" in page.text
    assert "MSAD = 4" in page.text
    assert "pooled" not in page.text


def test_sizes_and_the_viscosity_they_imply_are_shown(single):
    body = perrin.cluster_mobility(
        perrin.Cluster.touching(4, 2.45), radius=1.225, viscosity=2.18e-3, temperature=295
    )
    D_T, D_R = (3.85e-2, 0.49e-2), (4.93e-3, 0.49e-3)
    known = {"cluster": body, "viscosity": 2.18e-3, "temperature": 295}
    sizes = {
        "translation": perrin.size_from_translation(D_T, **known),
        "rotation": perrin.size_from_rotation(D_R, **known),
        "both": perrin.size_and_viscosity(D_T, D_R, cluster=body, temperature=295),
    }
    with_sizes = replace(single, clusters=(replace(single.clusters[0], sizes=sizes),))
    text = Page(report.render_html(with_sizes, [])).text
    assert "1.844" not in text
    # The values of docs/theory/hydrodynamics.md.
    for shown in ("2.9(4) µm", "2.72(9) µm", "2.6(2) µm", "they imply 2.4(5) mPa s"):
        assert shown in text
    one = replace(single.clusters[0], sizes={"rotation": sizes["rotation"]})
    text = Page(report.render_html(replace(single, clusters=(one,)), [])).text
    assert "2.72(9) µm" in text
    assert "they imply" not in text
    bare = replace(single.clusters[0], sizes=None)
    text = Page(report.render_html(replace(single, clusters=(bare,), settings={}), [])).text
    assert "No hydrodynamic sizes: viscosity and temperature were not given" in text


def test_predictions_are_listed_with_the_measured_values(single):
    """Each coefficient and principal axis has a line; one that is not resolved has no pull."""
    D_R = perrin.Compared(0.00673, 0.0051, 0.0004)
    prediction = perrin.Prediction(
        2.45, 1e-5, D_T=perrin.Compared(0.0453, 0.0, np.nan), D_R=D_R, principal_D_R=(D_R,) * 3
    )
    one = replace(single.clusters[0], prediction=prediction)
    text = Page(report.render_html(replace(single, clusters=(one,)), [])).text
    assert "measured predicted pull" in text
    assert "0.0051(4) rad²/s 0.00673 rad²/s −4.1" in text
    assert "R , axis 3" in text
    assert "not resolved 0.0453 µm²/s –" in text
    assert "spheres of 2.45 µm" in text
    assert "pull" not in Page(report.render_html(single, [])).text


def test_the_page_loads_nothing_from_outside(single, tmp_path):
    files = pictures(tmp_path, "cluster-0-curves", "cluster-0-residuals", "cluster-0-orientations")
    html = report.render_html(single, [*files, tmp_path / "cluster-0-curves.pdf"])
    page = Page(html)
    assert page.tags.count("img") == 3
    pictures_in = [s for s in page.sources if s.startswith("data:image/png;base64,")]
    assert len(pictures_in) == 3
    assert base64.b64decode(pictures_in[0].partition(",")[2]) == PNG
    # Other links are to places of the page and to the files of the folder.
    others = {s for s in page.sources if not s.startswith(("data:", "#"))}
    assert others == {name for name, _ in citations.folder_links(single)}
    assert not {"link", "iframe", "object", "base"} & set(page.tags)
    assert not re.search(r"https?:|@import|javascript:", html)
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', html)[1]
    assert policy.startswith("default-src 'none'; img-src data: blob:")
    assert "unsafe-eval" not in policy
    assert "'unsafe-inline'" not in policy.partition("script-src")[2]


def luminance(color):
    """Return the relative luminance of a colour, as WCAG 2.2 defines it."""
    digits = color if len(color) == 6 else "".join(2 * c for c in color)
    values = np.array([int(digits[k : k + 2], 16) for k in (0, 2, 4)]) / 255
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def test_texts_have_the_contrast_of_wcag_aa(single):
    """Texts differ from their background by a factor 4.5 in light, dark and print."""
    page = report.render_html(single, [])
    schemes = [
        {name: luminance(color) for name, color in re.findall(r"--([\w-]+): #(\w+)", block)}
        for block in re.findall(r":root \{(.*?)\}", page, re.S)
    ]
    assert len(schemes) == 3
    pairs = [(text, "paper") for text in ("ink", "soft", "blue", "red", "green", "violet")]
    pairs += [(text, "raised") for text, _ in pairs] + [("paper", "blue")]
    pairs += [(text, "amber") for text in ("ink", "soft", "blue")]
    for scheme in schemes:
        for text, ground in pairs:
            low, high = sorted((scheme[text] + 0.05, scheme[ground] + 0.05))
            assert high / low > 4.5, (text, ground)


def test_only_the_scripts_of_the_package_may_run(single):
    """The policy has the hashes of the page's own script and of plotly.js, and no other."""
    html = report.render_html(single, [])
    (own,) = re.findall(r"<script>(.*?)</script>", html, re.DOTALL)
    library = re.search(r'id="plotly">([^<]*)<', html)[1]
    code = gzip.decompress(base64.b64decode(library)).decode()
    sources = re.search(r"script-src ([^;]*);", html)[1].split()
    assert sources == [embedding.source_hash(own), embedding.source_hash(code)]
    assert "plotly.js v" in code[:200]
    # All other script elements hold text.
    assert len(re.findall(r"<script\b", html)) == 1 + len(
        re.findall(r'<script type="text/plain"', html)
    )


def html_scripts(page):
    return page.tags.count("script")


def test_text_of_users_is_escaped(single):
    html = report.render_html(single, [])
    assert "<my>" not in html
    assert "&lt;my&gt; &amp; &#34;tracks&#34;.csv" in html
    label = '<script>alert("x")</script> & co'
    named = [replace(single.clusters[0], cluster=k, label=label, warnings=(label,)) for k in (0, 1)]
    for clusters in (named, named[:1]):
        page = Page(
            report.render_html(replace(single, clusters=tuple(clusters), warnings=(label,)), [])
        )
        assert html_scripts(page) == html_scripts(Page(html)) + len(clusters) - 1
        assert label in page.text
        assert page.open == []


def test_warnings_are_in_a_box(single):
    text = "not rigid: it bends"
    one = replace(single.clusters[0], warnings=(text,))
    html = report.render_html(replace(single, clusters=(one,), warnings=("rows are missing",)), [])
    box = html[html.index('<div class="warning"') :]
    assert text in box[: box.index("</div>")]
    assert "rows are missing" in box[: box.index("</div>")]
    assert '<div class="warning"' not in report.render_html(single, [])


def test_limits_open_ends_and_unknown_errors_are_text(single):
    unbounded = estimate(
        value=0.0, ci68=(0, np.inf), ci95=(0, np.inf), stderr=np.inf, resolved=False,
        offset_stderr=np.nan, snr=0.0,
    )  # fmt: skip
    limit = estimate(value=0.0, ci68=(0, 1e-5), ci95=(0, 2e-5), resolved=False, unit="um^2/s")
    odd = replace(single.clusters[0], D_R=unbounded, D_T=limit)
    pooled = replace(single.pooled, D_R=unbounded, D_T=limit)
    for clusters in ((odd,), (odd, single.clusters[0])):
        text = Page(report.render_html(replace(single, clusters=clusters, pooled=pooled), [])).text
        assert "< ∞" in text
        assert "not bounded" in text
        assert "< 2.0 × 10⁻⁵" in text
        assert "(0 to 2.0) × 10⁻⁵" in text
        assert "not resolved, an upper limit" in text
        assert "its error is unknown" in text
        assert not re.search(r"\bnan\b|\binf\b|None", text)
    half = estimate(ci95=(0.004, np.inf), offset=-1e-4, snr=np.inf)
    text = Page(report.render_html(replace(single, clusters=(replace(odd, D_R=half),)), [])).text
    assert "above 0.0040" in text
    assert "(negative: no angle)" in text
    assert "without bound" in text


def test_two_dimensions_have_their_own_text():
    found = measured(planar=True, frames=20)
    text = Page(report.render_html(found, [])).text
    assert "MSAD = 2" in text
    assert "in 2 dimensions" in text
    assert "table in memory" in text


def test_many_clusters_are_listed_and_pooled(single, tmp_path):
    """Every cluster has a row and its data; the page shows the first, and pictures of it alone."""
    one = single.clusters[0]
    many = tuple(replace(one, cluster=k, warnings=("a", "b") if k < 10 else ()) for k in range(20))
    files = pictures(tmp_path, "clusters", *[f"cluster-{k}-curves" for k in range(2)])
    pooled = replace(single.pooled, clusters=tuple(range(19)))
    html = report.render_html(replace(single, clusters=many, pooled=pooled), files)
    page = Page(html)
    assert page.tags.count("img") == 2
    assert "pooled over 19 clusters" in page.text
    assert "The 19 clusters rotate with a common D R =" in page.text
    assert "leaves out 19" in page.text
    assert "In 10 of 20 clusters ( 0 , 1 , 2 , 3 , 4 , 5 , 6 , 7 , 8 , 9 ): a" in page.text
    assert [f"#cluster-{k}" in page.sources for k in range(20)] == [True] * 20
    payloads = dict(re.findall(r'class="payload" data-cluster="(\d+)">([^<]*)<', html))
    assert list(payloads) == [str(k) for k in range(20)]
    assert unpacked(payloads["7"])[0]["title"] == "Cluster 7"


def test_thousands_of_clusters_have_a_bounded_page(single, monkeypatch):
    """All are in the table; details have the first, those with warnings, then the others."""
    one = single.clusters[0]
    many = tuple(replace(one, cluster=k, warnings=("a",) if k in (7, 9) else ()) for k in range(12))
    many = (*many[:11], replace(many[11], notes=("a note",)))
    monkeypatch.setattr("perrin.report.page.cluster_data", lambda *_, **__: "=" * 100)
    monkeypatch.setattr("perrin.report.page._MOST_DETAILS", 450 + 12 * 550)
    html = report.render_html(replace(single, clusters=many), [])
    page = Page(html)
    drawn = [0, 1, 2, 7, 9]
    assert re.findall(r'class="payload" data-cluster="(\d+)"', html) == [str(k) for k in drawn]
    assert [f"#cluster-{k}" in page.sources for k in range(12)] == [k in drawn for k in range(12)]
    assert html.count("<tr data-cluster=") == 12
    assert "Cluster 11: a note" in page.text  # without a link that would lead nowhere
    assert "figures and details of 5 of 12 clusters, those with warnings first" in page.text


def unpacked(text):
    """Return header and columns of a packed text."""
    content = gzip.decompress(base64.b64decode(text))
    length = int.from_bytes(content[:4], "little")
    header, at, columns = json.loads(content[4 : 4 + length]), 4 + length, {}
    for name, count, ends in header["columns"]:
        if ends is None:
            columns[name] = np.frombuffer(content, "<f4", count, at)
            at += 4 * count
            continue
        whole = np.frombuffer(content, "<u2", count, at).astype(float)
        at += 2 * count
        whole[whole == 65535] = np.nan
        columns[name] = ends[0] + whole * (ends[1] - ends[0]) / 65534
    return header, columns


def test_packed_columns_come_back():
    """Rounded columns within 8e-6 of their range, exact ones as 32-bit floats; NaN stays NaN."""
    x = np.random.default_rng(7).normal(size=50)
    x[3] = np.nan
    header, back = unpacked(
        embedding.packed({"a": "µ"}, {"x": x, "y": x, "none": [np.nan], "one": [2.5]}, exact=("y",))
    )
    assert header["a"] == "µ"
    assert np.nanmax(np.abs(back["x"] - x)) < 8e-6 * np.ptp(x[np.isfinite(x)])
    assert np.array_equal(back["y"], x.astype(np.float32), equal_nan=True)
    assert np.isnan(back["x"][3])
    assert np.isnan(back["none"][0])
    assert back["one"] == [2.5]


@pytest.mark.parametrize("planar", [False, True])
def test_the_data_of_the_figures_are_those_of_the_result(single, planar):
    """The drawn poses, places and curves are the motion, the table and the curves of the run."""
    found = measured(planar=planar, frames=20) if planar else single
    (result,) = found.clusters
    rows = figure_data.grouped_tracks(found.tracks)[result.cluster]
    header, column = unpacked(figure_data.cluster_data(result, rows, clusters=1))
    d, motion = result.motion.dimension, result.motion
    center = np.stack([column[f"center{k}"] for k in range(d)], axis=1)
    assert np.allclose(center, motion.center, atol=1e-4)
    places = column["places"].reshape(len(center), -1, d) + center[:, None]
    misfit = np.sqrt(np.mean((places - motion.positions()) ** 2) * d)
    assert misfit == pytest.approx(np.sqrt(np.mean(motion.residual**2)), rel=1e-2)
    assert np.allclose(
        10 ** column["msad_y"], result.msad.value[: len(column["msad_y"])], rtol=1e-3
    )
    assert header["steps"]["turn"]["count"] == np.rint(column["turn_steps"]).sum()
    if not planar:
        q = np.stack([column[f"q{k}"] for k in range(4)], axis=1)
        trace = 4 * q[:, 0] ** 2 - 1
        assert np.allclose(trace, np.trace(motion.rotation, axis1=1, axis2=2), atol=1e-3)


def test_paths_of_many_clusters_are_thinned(single, monkeypatch):
    """A cluster among very many is drawn in the fewest frames, so that the page stays small."""
    monkeypatch.setattr(figure_data, "_FEWEST_DRAWN_FRAMES", 20)
    (result,) = single.clusters
    rows = figure_data.grouped_tracks(single.tracks)[result.cluster]
    header, column = unpacked(figure_data.cluster_data(result, rows, clusters=10**6))
    assert (header["stride"], header["frames"]) == (3, 60)
    assert np.allclose(column["time"], result.motion.time[::3], atol=1e-3)


def test_what_is_copied_repeats_the_run(single, tmp_path):
    """The Python lines and the command have the arguments that are not the defaults."""
    settings = single.settings | {"arguments": {"dt": 0.5, "scale": 1.0, "frames": (2, None)}}
    found = replace(single, settings=settings)
    assert repetition.python_lines(found.settings).splitlines()[2] == (
        "report = perrin.analyze('/data/<my> & \"tracks\".csv', dt=0.5, frames=(2, None))"
    )
    assert repetition.command_line(found.settings) == (
        "perrin analyze '/data/<my> & \"tracks\".csv' --dt 0.5 --frames 2: -o my-run"
    )
    text = citations.methods_paragraph(found)
    assert "60 frames, 0.5 s apart, with perrin 0.1.0" in text
    assert bare_text(found.clusters[0].D_R) in text


def test_the_run_folder_is_complete(single, tmp_path, monkeypatch, repeats):
    if repeats(True, False):
        monkeypatch.setattr(figure_style, "save_figure", save_blank)
    place = tmp_path / "run"
    write.write_run(single, place)
    names = {f.name for f in place.iterdir()}
    assert names == {
        "summary.json", "results.csv", "tracks.parquet", "motion.parquet", "curves.csv", "run.json",
        "run.toml",
        "checksums.json",
        "figures", "report.html",
    }  # fmt: skip
    assert len(list((place / "figures").iterdir())) == 6
    linked = Page((place / "report.html").read_text(encoding="utf-8"))
    assert linked.tags.count("img") == 3
    files = [s for s in linked.sources if not s.startswith(("#", "data:"))]
    assert all((place / name).exists() for name in files)
    assert [p.name for p in tmp_path.iterdir()] == ["run"]
    # The page made from what was read back is the same page.
    again = report.render_html(perrin.load_run(place), [])
    assert again == report.render_html(single, [])


def test_an_existing_folder_is_refused_or_replaced(single, tmp_path, monkeypatch):
    monkeypatch.setattr(write, "save_figures", lambda *_, **__: [])
    place = tmp_path / "run"
    write.write_run(single, place)
    (place / "old").touch()
    with pytest.raises(FileExistsError, match="overwrite"):
        write.write_run(single, place)
    write.write_run(single, place, overwrite=True)
    assert not (place / "old").exists()


@pytest.mark.parametrize("step", ["save_figures", "render_html"])
def test_a_failure_leaves_no_files_and_keeps_an_existing_folder(
    single, tmp_path, monkeypatch, step
):
    place = tmp_path / "run"
    place.mkdir()
    write_data(single, place)

    def fail(*_, **__):
        raise RuntimeError("disk full")

    monkeypatch.setattr(write, "save_figures", lambda *_, **__: [])
    monkeypatch.setattr(write, step, fail)
    for target in (place, tmp_path / "new"):
        with pytest.raises(RuntimeError, match="disk full"):
            write.write_run(single, target, overwrite=True)
    assert [p.name for p in tmp_path.iterdir()] == ["run"]
    assert (place / "summary.json").is_file()


@pytest.mark.parametrize("count", [1, 14])
def test_notes_are_separate_and_not_counted(single, count):
    """Notes are in a separate box after the warnings; the table counts warnings only."""
    one = single.clusters[0]
    many = tuple(
        replace(one, cluster=k, notes=(f"{k + 3} rows are missing",), warnings=("bends",) * (k > 1))
        for k in range(count)
    )
    found = replace(single, clusters=many, notes=("columns recognised: 'Frame' as frame",))
    html = report.render_html(found, [])
    page = Page(html)
    assert page.open == []
    notes = html[html.index('<div class="notes"') :]
    assert "columns recognised" in notes[: notes.index("</div>")]
    assert "columns recognised" not in html[: html.index('<div class="notes"')]
    if count == 1:
        assert '<div class="warning"' not in html
        assert "3 rows are missing" in notes[: notes.index("</div>")]
        return
    assert html.index('<div class="warning"') < html.index('<div class="notes"')
    assert "In 12 of 14 clusters ( 2 , 3 , 4 , 5 , 6 , 7 , 8 , 9 , 10 , 11 and 2 more): bends" in (
        page.text
    )
    assert "In all 14 clusters, for example cluster 0 : 3 rows are missing" in page.text
    counts = re.findall(r'<td data-v="\d+">(\d+|–)</td></tr>', html)
    assert counts == ["–", "–"] + 12 * ["1"]


def test_several_clusters_without_a_pooled_value(single):
    """The headline states that no value is pooled, and the page shows every cluster."""
    many = tuple(replace(single.clusters[0], cluster=k) for k in range(3))
    page = Page(report.render_html(replace(single, clusters=many, pooled=None), []))
    assert "No values are pooled; those of the single clusters follow" in page.text
    assert "There is no pooled value" in page.text
    assert [f"#cluster-{k}" in page.sources for k in range(3)] == [True] * 3


def test_notes_are_kept_and_older_runs_have_none(single, tmp_path):
    """Notes are read back; a run folder without the key is read as one without notes."""
    one = replace(single.clusters[0], notes=("5 rows",))
    found = replace(single, clusters=(one,), notes=("columns recognised",))
    found.save(tmp_path / "run")
    again = perrin.load_run(tmp_path / "run")
    assert (again.notes, again.clusters[0].notes) == (("columns recognised",), ("5 rows",))
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    for entry in (summary, *summary["clusters"]):
        del entry["notes"]
    (tmp_path / "run" / "summary.json").write_text(json.dumps(summary))
    (tmp_path / "run" / "checksums.json").unlink()  # which older runs do not have either
    again = perrin.load_run(tmp_path / "run")
    assert (again.notes, again.clusters[0].notes) == ((), ())
