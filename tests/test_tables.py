"""Tables of other programs: the same tracks in every format are read as the same table."""

from __future__ import annotations

import io
import zipfile
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from perrin.errors import TrackTableError
from perrin.tracks.files import check_tracks, read_tracks, write_tracks
from perrin.tracks.gdf import gdf_bytes


def planted(n_frames=4, n_particles=3, seed=3):
    """Return tracks in um with few digits, the third particle missing in the second frame."""
    rng = np.random.default_rng(seed)
    frame, particle = np.divmod(np.arange(n_frames * n_particles), n_particles)
    x = np.round(5 + rng.normal(size=(len(frame), 3)), 3)
    table = pd.DataFrame({"frame": frame, "particle": particle, "x": x[:, 0], "y": x[:, 1]})
    return table.assign(z=x[:, 2]).drop(index=5).reset_index(drop=True)


def same(read, table):
    """Compare rows and numbers, in any order."""
    read = read.sort_values(["frame", "particle"]).reset_index(drop=True)
    assert list(read.columns) == list(table.columns)
    np.testing.assert_allclose(read.to_numpy(float), table.to_numpy(float), rtol=1e-12)


def fault(path, **options):
    with pytest.raises(TrackTableError) as caught:
        read_tracks(path, **options)
    return str(caught.value)


def written(tmp_path, name, content):
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode("utf-8"))
    return path


def comma(number):
    return str(number).replace(".", ",")


# ---- the same tracks, as each program writes them -----------------------------------------------


def semicolons(t):
    rows = "\n".join(f"{r.frame};{r.particle};{comma(r.x)};{comma(r.y)};{comma(r.z)}"
                     for r in t.itertuples())  # fmt: skip
    return f"Frame;Particle ID;X [µm];Y [µm];Z [µm]\n{rows}\n"


def excel_unicode(t):
    """Write what Excel in a country with decimal commas calls Unicode text."""
    return semicolons(t).replace(";", "\t").replace("\n", "\r\n").encode("utf-16")


def savetxt(t):
    buffer = io.StringIO()
    names = ["frame", "particle", "x", "y", "z"]
    np.savetxt(buffer, t[names].to_numpy(), fmt="%.10g", header="made today\n" + " ".join(names))
    return buffer.getvalue()


def trackmate_csv(t, unit="micron", scale=1.0):
    head = (
        "LABEL,ID,TRACK_ID,QUALITY,POSITION_X,POSITION_Y,POSITION_Z,POSITION_T,FRAME,RADIUS\n"
        "Label,Spot ID,Track ID,Quality,X,Y,Z,T,Frame,Radius\n"
        "Label,Spot ID,Track ID,Quality,X,Y,Z,T,Frame,R\n"
        f",,,(quality),({unit}),({unit}),({unit}),(sec),,({unit})\n"
    )
    rows = "".join(
        f"ID{i},{i},{r.particle},5.5,{r.x / scale!r},{r.y / scale!r},{r.z / scale!r},"
        f"{0.5 * r.frame},{r.frame},1.2\n"
        for i, r in enumerate(t.itertuples())
    )
    return head + rows + "ID99,99,,5.5,1,1,1,0.0,0,1.2\n"


def trackmate_xml(t):
    spot = (
        '<Spot ID="{i}" name="ID{i}" QUALITY="5" POSITION_T="{t}" FRAME="{r.frame}" VISIBILITY="1" '
        'POSITION_X="{r.x}" POSITION_Y="{r.y}" POSITION_Z="{r.z}" RADIUS="1"/>'
    )
    frames = "".join(
        f'<SpotsInFrame frame="{frame}">'
        + "".join(spot.format(i=r.Index, r=r, t=0.5 * r.frame) for r in rows.itertuples())
        + "</SpotsInFrame>"
        for frame, rows in t.groupby("frame")
    )
    loose = '<SpotsInFrame frame="9"><Spot ID="77" FRAME="9" POSITION_X="0"/></SpotsInFrame>'
    tracks = "".join(
        f'<Track name="Track_{p}" TRACK_ID="{p}">'
        + "".join(
            f'<Edge SPOT_SOURCE_ID="{a}" SPOT_TARGET_ID="{b}" LINK_COST="0.1"/>'
            for a, b in zip(rows.index[:-1], rows.index[1:], strict=True)
        )
        + "</Track>"
        for p, rows in t.groupby("particle")
    )
    kept = "".join(f'<TrackID TRACK_ID="{p}"/>' for p in t["particle"].unique())
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<TrackMate version="7.11.1">'
        '<Model spatialunits="µm" timeunits="sec">'
        f'<AllSpots nspots="{len(t) + 1}">{frames}{loose}</AllSpots>'
        f"<AllTracks>{tracks}</AllTracks><FilteredTracks>{kept}</FilteredTracks>"
        '</Model><Settings><ImageData width="9"/></Settings></TrackMate>'
    )


def trackmate_exported(t):
    particles = "".join(
        f'<particle nSpots="{len(rows)}">'
        + "".join(
            f'<detection t="{r.frame}" x="{r.x}" y="{r.y}" z="{r.z}"/>' for r in rows.itertuples()
        )
        + "</particle>"
        for _, rows in t.groupby("particle")
    )
    return (
        '<?xml version="1.0"?><Tracks nTracks="3" spaceUnits="micron" frameInterval="0.5" '
        f'timeUnits="sec" from="TrackMate v7">{particles}</Tracks>'
    )


def imaris(t):
    rows = "".join(
        f"{r.x},{r.y},{r.z},um,Spot,Position,{r.frame + 1},{1000000000 + r.particle},{i},\n"
        for i, r in enumerate(t.itertuples())
    )
    return (
        "\ufeff\nPosition\n ==================== \nPosition X,Position Y,Position Z,Unit,Category,"
        f"Collection,Time,TrackID,ID,\n{rows}"
    )


def motive(t):
    """Motive's export with a rigid body before its markers, and a Parent row."""
    names = [f"Top:Marker {p + 1:03}" for p in sorted(t["particle"].unique())]
    types = ["Rigid Body"] * 7 + ["Marker"] * 3 * len(names)
    labels = ["Top"] * 7 + [name for name in names for _ in range(3)]
    parts = ["Rotation"] * 4 + ["Position"] * 3 + ["Position"] * 3 * len(names)
    axes = [*"XYZWXYZ", *"XYZ" * len(names)]
    lines = [
        "Format Version,1.25,Take Name,T 1,Capture Frame Rate,2.000000,Rotation Type,Quaternion,"
        "Length Units,Millimeters,Coordinate Space,Global",
        "",
        ",Type," + ",".join(types),
        ",Name," + ",".join(labels),
        ",ID," + ",".join("9F0" for _ in labels),
        ",Parent," + ",".join("" for _ in labels),
        ",," + ",".join(parts),
        "Frame,Time (Seconds)," + ",".join(axes),
    ]
    at = t.set_index(["frame", "particle"])[["x", "y", "z"]] / 1000
    for frame in sorted(t["frame"].unique()):
        cells = ["0"] * 7
        for p in sorted(t["particle"].unique()):
            cells += (
                [repr(float(v)) for v in at.loc[frame, p]] if (frame, p) in at.index else [""] * 3
            )
        lines.append(f"{frame},{0.5 * frame:.6f}," + ",".join(cells))
    return "\n".join(lines) + "\n"


def xyz_with_ids(t):
    frames = [
        f'{len(rows)}\nLattice="9 0 0 0 9 0 0 0 9" Properties=species:S:1:pos:R:3:id:I:1 '
        f"Time={0.5 * frame} frame={frame}\n"
        + "".join(f"C {r.x} {r.y} {r.z} {r.particle}\n" for r in rows.itertuples())
        for frame, rows in t.groupby("frame")
    ]
    return "".join(frames)


def xlsx(t):
    """Put a workbook together by hand: an empty sheet, then the table."""

    def cell(value):
        if isinstance(value, str):
            return f'<c t="inlineStr"><is><t>{value}</t></is></c>'
        return f"<c><v>{value!r}</v></c>"

    rows = [list(t.columns), *t.to_numpy(float).tolist()]
    sheet = (
        '<worksheet xmlns="http://schemas.openxmlformats.org/spreadsheetml/2006/main"><sheetData>'
    )
    full = "".join(f"<row>{''.join(map(cell, row))}</row>" for row in rows)
    package = "http://schemas.openxmlformats.org/package/2006"
    office = "http://schemas.openxmlformats.org/officeDocument/2006/relationships"
    kinds = "application/vnd.openxmlformats-officedocument.spreadsheetml"
    files = {
        "[Content_Types].xml": f'<Types xmlns="{package}/content-types"><Default Extension="rels" '
        'ContentType="application/vnd.openxmlformats-package.relationships+xml"/><Override '
        f'PartName="/xl/workbook.xml" ContentType="{kinds}.sheet.main+xml"/><Override '
        f'PartName="/xl/s1.xml" ContentType="{kinds}.worksheet+xml"/><Override '
        f'PartName="/xl/s2.xml" ContentType="{kinds}.worksheet+xml"/></Types>',
        "_rels/.rels": f'<Relationships xmlns="{package}/relationships"><Relationship Id="r1" '
        f'Type="{office}/officeDocument" Target="xl/workbook.xml"/></Relationships>',
        "xl/workbook.xml": '<workbook xmlns="http://schemas.openxmlformats.org/spreadsheetml/2006/'
        f'main" xmlns:r="{office}"><sheets><sheet name="notes" sheetId="1" r:id="r1"/>'
        '<sheet name="tracks" sheetId="2" r:id="r2"/></sheets></workbook>',
        "xl/_rels/workbook.xml.rels": f'<Relationships xmlns="{package}/relationships">'
        f'<Relationship Id="r1" Type="{office}/worksheet" Target="s1.xml"/>'
        f'<Relationship Id="r2" Type="{office}/worksheet" Target="s2.xml"/></Relationships>',
        "xl/s1.xml": f"{sheet}</sheetData></worksheet>",
        "xl/s2.xml": f"{sheet}{full}</sheetData></worksheet>",
    }
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as book:
        for name, text in files.items():
            book.writestr(name, text)
    return buffer.getvalue()


def feature3d(t, peak=True):
    """IDL's track array of 3-D features: brightness, squared radius, peak and share in between."""
    rng = np.random.default_rng(0)
    bright = rng.normal(9000, 500, len(t))
    columns = [t["x"], t["y"], t["z"], bright, rng.uniform(2, 4, len(t))]
    columns += [rng.uniform(200, 250, len(t)), rng.uniform(0.4, 0.6, len(t))] if peak else []
    return gdf_bytes(np.column_stack([*columns, t["frame"], t["particle"]]).astype(float))


def napari(t):
    rows = "".join(f"{r.particle},{r.frame},{r.z},{r.y},{r.x}\n" for r in t.itertuples())
    return f"track_id,t,z,y,x\n{rows}"


@pytest.mark.parametrize(
    ("name", "write", "words", "options", "extra"),
    [
        ("t.csv", semicolons, "semicolons between the columns and decimal commas", {}, []),
        ("t.txt", excel_unicode, "tabs between the columns and decimal commas", {}, []),
        ("t.txt", savetxt, "line 2 has the names of the columns", {}, []),
        ("t.csv", trackmate_csv, "a table of spots of TrackMate", {}, ["time"]),
        ("t.xml", trackmate_xml, "a project of TrackMate", {}, ["time"]),
        ("t.xml", trackmate_exported, "tracks of TrackMate", {}, ["time"]),
        ("t.csv", imaris, "the statistic Position of Imaris", {}, []),
        ("t.xyz", xyz_with_ids, "the periodic box is not used", {}, ["time"]),
        ("t.gdf", feature3d, "a .gdf of 9 columns as of feature3d", {}, []),
        ("t.gdf", lambda t: feature3d(t, peak=False), "a .gdf of 7 columns", {}, []),
        ("t.csv", napari, "tracks as napari takes them", {}, []),
        ("t.xlsx", xlsx, "read from the sheet 'tracks'", {}, []),
    ],
)  # fmt: skip
def test_the_same_tracks_in_every_format_are_the_same_table(
    tmp_path, name, write, words, options, extra
):
    """Frames, ids and coordinates are those planted; one note says what was recognised."""
    if name == "t.xlsx":
        pytest.importorskip("python_calamine")
    table = planted()
    read = read_tracks(written(tmp_path, name, write(table)), **options)
    assert any(words in note for note in read.attrs["notes"]), read.attrs["notes"]
    if write is imaris:  # counts from 1, and has long ids
        read = read.assign(frame=read["frame"] - 1, particle=read["particle"] - 1000000000)
    for column in extra:
        np.testing.assert_allclose(read[column], 0.5 * read["frame"])
    same(read.drop(columns=extra), table)


# ---- text ---------------------------------------------------------------------------------------


def test_decimal_commas_and_points_in_one_file_are_refused(tmp_path):
    """Either mark could be that of thousands: nothing is guessed."""
    head = "frame;particle;x;y\n"
    mixed = fault(written(tmp_path, "a.csv", head + "0;1;2,5;3.5\n"))
    assert "decimal commas (2,5)" in mixed.replace(";", "")
    assert "decimal points" in mixed
    assert "between thousands" in fault(written(tmp_path, "b.csv", head + "0;1;1.234,5;2\n"))


def test_columns_without_names_are_read_by_number(tmp_path):
    """A file of numbers alone needs their meaning; with it, its first line is a row."""
    path = written(tmp_path, "t.dat", "0 7 1,5 2\n1 7 1,75 2,5\n")
    assert "line 1 holds numbers (0 7 1,5 2)" in fault(path)
    read = read_tracks(path, columns={"frame": 0, "particle": 1, "x": 2, "y": -1})
    assert read.to_numpy().tolist() == [[0, 7, 1.5, 2], [1, 7, 1.75, 2.5]]


def test_lines_are_numbered_as_in_the_file(tmp_path):
    """A fault behind TrackMate's header of four lines names the line that an editor shows."""
    text = trackmate_csv(planted()).replace("ID2,2,2,5.5,", "ID2,2,2,5.5,bad")
    assert "line 7" in fault(written(tmp_path, "t.csv", text))
    assert "line 6" in fault(written(tmp_path, "i.csv", imaris(planted()).replace("um,Spot,Position"
        ",1,1000000001,1", "um,Spot,Position,1.5,1000000001,1")))  # fmt: skip


def test_a_repeated_column_counts_once_only_where_it_is_equal(tmp_path):
    """The drift of trackpy leaves frame as index and as column, both of which are written."""
    table = planted().set_index("frame", drop=False)
    path = tmp_path / "t.csv"
    table.to_csv(path)
    same(read_tracks(path), planted())
    table["frame"] = table["frame"] + 1
    table.to_csv(path)
    assert "more than one column is called frame" in fault(path)


def test_quoted_names_and_text_may_hold_the_mark(tmp_path):
    """A comma in a quoted name or label divides no columns."""
    text = 'frame,particle,"x",y,"remark, free"\n0,"a, b",1,2,"1,5"\n1,"a, b",1,2,\n'
    read = read_tracks(written(tmp_path, "t.csv", text))
    assert read["particle"].tolist() == ["a, b", "a, b"]
    assert read.attrs["columns"][-1] == "remark, free"
    assert read["y"].tolist() == [2, 2]


# ---- DataFrames ---------------------------------------------------------------------------------


def test_a_table_of_trackpy_with_its_frames_in_the_index():
    """y, x, mass ... with frame as the index, or (frame, particle), is the same table."""
    table = planted()
    trackpy = table[["y", "x", "z", "particle", "frame"]].assign(mass=9.0, ecc=0.1)
    by_frame = trackpy.set_index("frame")
    both = trackpy.set_index(["frame", "particle"])
    kept = trackpy.set_index("frame", drop=False)
    for one in (trackpy, by_frame, both, kept):
        same(check_tracks(one, source="the table"), table)


def test_a_pivot_table_becomes_rows():
    """Columns (axis, particle) or (particle, axis) and rows of frames: missing points are NaN."""
    table = planted()
    wide = table.pivot_table(index="frame", columns="particle", values=["x", "y", "z"])
    for one in (wide, wide.swaplevel(axis=1)):
        read = check_tracks(one, source="the table")
        assert len(read) == len(table) + 1
        same(read.dropna(), table)


def test_a_selection_of_mdanalysis_is_a_table():
    """A group of atoms follows its trajectory; residues are clusters; the scale is applied."""
    table = planted().query("frame != 1")
    x = table[["x", "y", "z"]].to_numpy().reshape(3, 3, 3)
    atoms = SimpleNamespace(indices=np.arange(3), resindices=np.array([0, 0, 1]))

    class Trajectory:
        def __iter__(self):
            for frame in x:
                atoms.positions = frame.astype(np.float32) * 1e4
                yield frame

    atoms.universe, atoms.atoms = SimpleNamespace(trajectory=Trajectory()), atoms
    read = check_tracks(atoms, source="the table", scale=1e-4)
    np.testing.assert_allclose(read[["x", "y", "z"]], x.reshape(-1, 3), rtol=1e-6)
    assert read["cluster"].tolist() == [0, 0, 1] * 3


# ---- units, ids and times that a format states ---------------------------------------------------


def test_a_unit_in_the_file_must_agree_with_the_scale(tmp_path):
    """Pixels of TrackMate and metres of Motive ask for a scale; with it lengths are right."""
    path = written(tmp_path, "t.csv", trackmate_csv(planted(), unit="pixel", scale=0.25))
    assert "POSITION_X (pixel)" in fault(path)
    same(read_tracks(path, scale=0.25).drop(columns="time"), planted())
    path = written(tmp_path, "m.csv", motive(planted()))
    assert "millimeters" in fault(path)
    read = read_tracks(path, scale=1e3)
    assert read["particle"].unique().tolist() == [f"Top:Marker 00{k}" for k in (1, 2, 3)]
    assert set(read["cluster"]) == {"Top"}
    np.testing.assert_allclose(read["time"], 0.5 * read["frame"])
    known = read.dropna(subset="x").sort_values(["frame", "particle"])
    np.testing.assert_allclose(known[["x", "y", "z"]], planted()[["x", "y", "z"]], rtol=1e-12)
    assert any("left out: points of the kind Rigid Body" in n for n in read.attrs["notes"])


def test_a_movie_of_one_plane_has_no_z(tmp_path):
    """TrackMate writes z = 0 for it: two coordinates remain, and a note says so."""
    read = read_tracks(written(tmp_path, "t.csv", trackmate_csv(planted().assign(z=0.0))))
    assert "z" not in read
    assert "z is 0 throughout: read as two dimensions" in read.attrs["notes"]


def test_what_the_caller_states_outranks_the_format(tmp_path):
    """A named column replaces the one of the format; the others stay."""
    path = written(tmp_path, "t.csv", trackmate_csv(planted()))
    read = read_tracks(path, columns={"x": "POSITION_Y", "y": "POSITION_X"})
    np.testing.assert_allclose(read[["y", "x", "z"]], planted()[["x", "y", "z"]])


def test_xml_with_entities_is_refused(tmp_path):
    """Entities that grow without bound, or that read files, are never expanded."""
    bomb = '<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b "ha"><!ENTITY c "&b;&b;">]><Tracks>&c;'
    assert "DOCTYPE" in fault(written(tmp_path, "t.xml", bomb + "</Tracks>"))
    assert "not a whole XML file" in fault(written(tmp_path, "u.xml", "<Tracks><particle>"))
    assert "root 'html'" in fault(written(tmp_path, "v.xml", "<html/>"))


def test_another_statistic_of_imaris_is_refused(tmp_path):
    """Its header says which one it is, and which is needed."""
    text = (
        "\nSpeed\n ==================== \nSpeed,Unit,Category,Time,TrackID,ID,\n1,um/s,S,1,2,3,\n"
    )
    message = fault(written(tmp_path, "t.csv", text))
    assert "statistic Speed" in message
    assert "Position X" in message


def test_features_in_two_dimensions_are_recognised_by_their_brightness(tmp_path):
    """x, y, brightness, radius, eccentricity, frame, id: z is not taken for brightness."""
    t, rng = planted(), np.random.default_rng(1)
    n = len(t)
    columns = [
        t["x"],
        t["y"],
        rng.normal(5e3, 100, n),
        rng.uniform(1, 2, n),
        rng.uniform(0, 0.2, n),
    ]
    rows = np.column_stack([*columns, t["frame"], t["particle"]]).astype(float)
    read = read_tracks(written(tmp_path, "t.gdf", gdf_bytes(rows)))
    same(read, t.drop(columns="z"))
    # Without tracks, or without a brightness, nothing is assumed.
    for other in (rows[:, [0, 1, 2, 3, 4, 6, 5]] * 1.1, np.abs(np.sin(rows)) + rows[:, -1:]):
        assert "7 columns is unknown" in fault(written(tmp_path, "u.gdf", gdf_bytes(other)))


@pytest.mark.parametrize("gap", [0.73, 0.0207])
def test_frames_are_numbered_by_times_where_there_are_no_frames(tmp_path, gap):
    """Even times with a gap give frame numbers with the gap; a note states the interval."""
    table = planted().query("frame != 1").reset_index(drop=True)
    text = table.assign(t=np.round(40 + gap * table["frame"], 4)).drop(columns="frame")
    path = tmp_path / "t.csv"
    text.to_csv(path, index=False)
    read = read_tracks(path, columns={"time": "t"})
    same(read.drop(columns="time"), table)
    assert f"3 times, {gap:.4g} s apart" in read.attrs["notes"][0]
    assert "missing column" in fault(path)


def test_times_in_ms_and_uneven_times_number_frames_in_their_order(tmp_path):
    """Uneven times are kept: the frames are their order, and times are in s."""
    table = planted()
    times = np.array([0.0, 100.0, 350.0, 1200.0])[table["frame"]]
    path = tmp_path / "t.csv"
    table.assign(**{"Time (ms)": times}).drop(columns="frame").to_csv(path, index=False)
    read = read_tracks(path)
    same(read.drop(columns="time"), table)
    np.testing.assert_allclose(read["time"], times / 1000)


def test_rows_without_ids_are_detections(tmp_path):
    """They are refused as tracks, with the remedy, and read where the caller expects them."""
    table = planted().drop(columns="particle")
    path = tmp_path / "t.csv"
    table.to_csv(path, index=False)
    assert "where the rows have no ids" in fault(path)
    read = read_tracks(path, detections=True)
    pd.testing.assert_frame_equal(read, table)


# ---- xyz ----------------------------------------------------------------------------------------


def test_plain_xyz_numbers_particles_in_their_order(tmp_path):
    """Elements and comments are skipped; frames of other sizes leave the ids open."""
    text = "2\n\nC 1 2 3\nO 4 5 6\n2\nany words\nC 1.5 2 3\nO 4 5 6.5\n\n"
    read = read_tracks(written(tmp_path, "t.xyz", text))
    assert read["particle"].tolist() == [0, 1, 0, 1]
    assert read["z"].tolist() == [3, 6, 3, 6.5]
    assert any("numbered in their order" in note for note in read.attrs["notes"])
    path = written(tmp_path, "u.xyz", text + "1\n\nC 1 1 1\n")
    assert "missing column particle" in fault(path)
    assert len(read_tracks(path, detections=True)) == 5
    assert "announces 3" in fault(written(tmp_path, "v.xyz", "3\n\nC 1 1 1\n"))


@pytest.mark.parametrize("suffix", [".csv", ".csv.gz", ".parquet", ".gdf", ".xyz", ".napari.csv"])
@pytest.mark.parametrize("axes", [2, 3])
def test_what_is_written_reads_back_bit_identical(tmp_path, suffix, axes):
    """Every format that is written gives every bit back, also of long decimals and of NaN."""
    rng = np.random.default_rng(4)
    table = planted().sort_values(["particle", "frame"] if "napari" in suffix else "frame")
    table = table.reset_index(drop=True)
    table[["x", "y", "z"]] *= rng.normal(size=(len(table), 3)) / 3
    table.loc[2, ["x", "y", "z"]] = np.nan
    table = table.drop(columns=["z"][: 3 - axes])
    write_tracks(table, tmp_path / f"t{suffix}")
    pd.testing.assert_frame_equal(read_tracks(tmp_path / f"t{suffix}"), table, check_exact=True)


def test_xyz_keeps_clusters_and_times(tmp_path):
    """Text labels, clusters and times are properties of the extended format."""
    table = planted().assign(cluster=["a", "b", "c"][:1] * 11, time=0.1)
    table["particle"] = [f"p{k}" for k in table["particle"]]
    write_tracks(table, tmp_path / "t.xyz")
    pd.testing.assert_frame_equal(read_tracks(tmp_path / "t.xyz"), table)
    with pytest.raises(TrackTableError, match="blanks in particle"):
        write_tracks(table.assign(particle="a b", frame=range(11)), tmp_path / "t.xyz")


# ---- formats that need a package -----------------------------------------------------------------


def test_markers_of_c3d_are_read_in_its_unit(tmp_path):
    """Millimetres ask for a scale; a marker that is marked as missing is NaN; times follow."""
    c3d = pytest.importorskip("c3d")
    table = planted()
    writer = c3d.Writer(point_rate=2.0)
    writer.set_point_labels(["A", "B", "C"])
    at = table.set_index(["frame", "particle"])[["x", "y", "z"]]
    for frame in range(4):
        points = np.zeros((3, 5), dtype=np.float32)
        for k in range(3):
            points[k, 3] = -1 if (frame, k) not in at.index else 0
            points[k, :3] = at.loc[frame, k] if (frame, k) in at.index else 0
        writer.add_frames([(points, np.zeros((0, 1), dtype=np.float32))])
    buffer = io.BytesIO()
    with pytest.warns(UserWarning, match="No analog data"):
        writer.write(buffer)
    path = written(tmp_path, "t.c3d", buffer.getvalue())
    assert "mm" in fault(path)
    read = read_tracks(path, scale=1000)
    assert read["particle"].tolist() == ["A", "B", "C"] * 4
    np.testing.assert_allclose(np.diff(read["time"].to_numpy()[::3]), 0.5)
    known = read.dropna(subset="x")
    expected = 1000 * table[["x", "y", "z"]]
    np.testing.assert_allclose(known[["x", "y", "z"]], expected, rtol=1e-6)
    assert "not a C3D file" in fault(written(tmp_path, "u.c3d", b"no"))


def test_particles_of_gsd_are_unwrapped(tmp_path):
    """A particle that left the periodic box goes on by its image; bodies are clusters."""
    pytest.importorskip("gsd")
    import gsd.hoomd

    x = np.array([[[1.0, 0, 0], [4.5, 0, 0]], [[1.5, 0, 0], [-4.5, 0, 0]]])
    with gsd.hoomd.open(str(tmp_path / "t.gsd"), "w") as file:
        for k in (0, 1):
            frame = gsd.hoomd.Frame()
            frame.configuration.box = [10, 10, 10, 0, 0, 0]
            frame.configuration.step = 100 * k
            frame.particles.N = 2
            frame.particles.position = x[k]
            frame.particles.image = [[0, 0, 0], [k, 0, 0]]
            frame.particles.body = [0, -1]
            file.append(frame)
    read = read_tracks(tmp_path / "t.gsd", scale=2.0)
    np.testing.assert_allclose(read["x"], 2 * np.array([1, 4.5, 1.5, 5.5]), rtol=1e-6)
    assert read["cluster"].tolist() == [0, -1, 0, -1]
    assert read["frame"].tolist() == [0, 0, 1, 1]
    assert "not a GSD file" in fault(written(tmp_path, "u.gsd", b"no"))


@pytest.mark.parametrize(
    ("suffix", "package"), [(".xlsx", "python_calamine"), (".c3d", "c3d"), (".gsd", "gsd")]
)
def test_a_missing_package_is_named_with_its_extra(tmp_path, monkeypatch, suffix, package):
    """Without the optional package the message is how to install it."""
    monkeypatch.setitem(__import__("sys").modules, package, None)
    with pytest.raises(ImportError, match=r"pip install 'perrin\[tables\]'"):
        read_tracks(written(tmp_path, f"t{suffix}", b"x"))
