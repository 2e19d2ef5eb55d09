"""Track tables: tables read back as written, and every fault is named with its place."""

import gzip
import os
import struct
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from perrin.errors import TrackTableError
from perrin.tracks.files import check_tracks, read_tracks, write_tracks


def tracks(n_frames=3, n_particles=2, axes="xyz", seed=0):
    rng = np.random.default_rng(seed)
    frame, particle = np.divmod(np.arange(n_frames * n_particles), n_particles)
    x = rng.normal(size=(len(frame), len(axes)))
    return pd.DataFrame({"frame": frame, "particle": particle} | dict(zip(axes, x.T, strict=True)))


def gdf(values, order="<", code=5, dims=None, count=None, magic=82991):
    """Return the bytes of a .gdf as IDL writes them, put together by hand."""
    kinds = {1: "u1", 2: "i2", 3: "i4", 4: "f4", 5: "f8"}
    values = np.asarray(values)
    dims = values.shape[::-1] if dims is None else dims
    count = values.size if count is None else count
    header = [magic, len(dims), *dims, code, count]
    body = values.astype(f"{order}{kinds.get(code, 'f8')}").tobytes()
    return struct.pack(f"{order}{len(header)}i", *header) + body


def fault_of(path_or_text, tmp_path=None, name="bad.csv", **options):
    """Return the message with which a file is refused."""
    path = tmp_path / name
    data = path_or_text.encode() if isinstance(path_or_text, str) else path_or_text
    path.write_bytes(data)
    with pytest.raises(TrackTableError) as caught:
        read_tracks(path, **options)
    assert name in str(caught.value)
    assert caught.value.faults
    assert all(fault in str(caught.value) for fault in caught.value.faults)
    return str(caught.value)


def faults_of(table, source="the table"):
    with pytest.raises(TrackTableError) as caught:
        check_tracks(table, source=source)
    assert source in str(caught.value)
    return caught.value.faults


# ---- reading and writing ------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".csv", ".csv.gz", ".parquet", ".gdf"])
@pytest.mark.parametrize("axes", ["xy", "xyz"])
def test_a_table_reads_back_bit_identical(tmp_path, suffix, axes):
    """Every kind of file gives the same bits back, NaN rows included."""
    table = tracks(n_frames=400, axes=axes)
    table.loc[3, list(axes)] = np.nan
    table["x"] *= 10.0 ** np.random.default_rng(1).integers(-12, 12, len(table))
    write_tracks(table, tmp_path / f"t{suffix}")
    pd.testing.assert_frame_equal(read_tracks(tmp_path / f"t{suffix}"), table, check_exact=True)


@settings(max_examples=10, deadline=None)
@given(x=hnp.arrays(np.float64, 20, elements=st.floats(allow_infinity=False)))
def test_csv_keeps_every_bit_of_any_float(tmp_path_factory, x):
    """No float, subnormal or huge, loses a bit in a csv."""
    path = tmp_path_factory.mktemp("bits") / "t.csv"
    table = pd.DataFrame({"frame": range(20), "particle": 0, "x": x, "y": x[::-1]})
    write_tracks(table, path)
    np.testing.assert_array_equal(read_tracks(path)["x"].to_numpy(), x)


@pytest.mark.parametrize("suffix", [".csv", ".csv.gz", ".parquet"])
def test_text_ids_clusters_and_times_read_back(tmp_path, suffix):
    """Text labels, a missing text cluster and the time survive."""
    table = tracks()
    table["particle"] = [f"p{i}" for i in table["particle"]]
    table["cluster"] = ["a", "b", None, "b", "a", "b"]
    table["time"] = table["frame"] * 0.5
    write_tracks(table, tmp_path / f"t{suffix}")
    back = read_tracks(tmp_path / f"t{suffix}")
    assert list(back.columns) == ["frame", "particle", "x", "y", "z", "cluster", "time"]
    assert back["particle"].tolist() == table["particle"].tolist()
    assert back["cluster"].isna().tolist() == [False, False, True, False, False, False]
    assert back["cluster"].dropna().tolist() == ["a", "b", "b", "a", "b"]
    assert back["time"].tolist() == table["time"].tolist()


def test_scale_multiplies_each_axis_and_nothing_else(tmp_path):
    """One number scales all axes, three scale each its own; frame and time stay."""
    table = tracks().assign(time=0.25)
    write_tracks(table, tmp_path / "t.csv")
    one = read_tracks(tmp_path / "t.csv", scale=0.5)
    each = read_tracks(tmp_path / "t.csv", scale=(0.5, 0.5, 2.0))
    np.testing.assert_array_equal(one[["x", "y", "z"]], table[["x", "y", "z"]] * 0.5)
    np.testing.assert_array_equal(each["z"], table["z"] * 2.0)
    pd.testing.assert_frame_equal(each.drop(columns="z"), one.drop(columns="z"))
    np.testing.assert_array_equal(one[["frame", "time"]], table[["frame", "time"]])


@pytest.mark.parametrize("scale", [0, -1.0, np.nan, np.inf, (1.0, 2.0), (1, 1, 0), [[1.0]]])
def test_a_scale_that_is_none_is_refused(tmp_path, scale):
    """A scale must be positive, and one number or one per axis."""
    write_tracks(tracks(), tmp_path / "t.csv")
    with pytest.raises(ValueError, match=r"scale: expected one positive number, or 3 of them"):
        read_tracks(tmp_path / "t.csv", scale=scale)


def test_other_columns_are_left_out_and_ours_put_in_order(tmp_path):
    """A trackpy csv with its index column and extra columns gives our columns in our order."""
    (tmp_path / "t.CSV").write_text(",y,x,mass,frame,ep,particle\n0,2,1,9,0,.1,5\n1,4,3,9,1.0,,5\n")
    back = read_tracks(tmp_path / "t.CSV")
    expected = pd.DataFrame({"frame": [0, 1], "particle": 5, "x": [1.0, 3.0], "y": [2.0, 4.0]})
    pd.testing.assert_frame_equal(back, expected)


def test_a_csv_from_a_spreadsheet_reads(tmp_path):
    """A byte order mark, CRLF, spaces after commas and empty last lines do no harm."""
    text = "\ufeffframe, particle, x ,y \r\n0, 1, 0.5, 1\r\n\r\n1, 1, , 2\r\n,,,\r\n\r\n"
    (tmp_path / "t.csv").write_bytes(text.encode())
    back = read_tracks(tmp_path / "t.csv")
    assert back["frame"].tolist() == [0, 1]
    assert back.index.tolist() == [0, 1]
    assert back["x"].isna().tolist() == [False, True]


def test_columns_by_name_and_by_number(tmp_path):
    """The mapping takes names and numbers, also from the end, and may swap columns."""
    (tmp_path / "t.csv").write_text("y,x,POS_Z,t,id\n1,2,3,4,5\n")
    mapping = {"x": "y", "y": 1, "z": "POS_Z", "frame": -2, "particle": -1}
    row = read_tracks(tmp_path / "t.csv", columns=mapping).iloc[0]
    assert row.to_dict() == {"frame": 4, "particle": 5, "x": 1, "y": 2, "z": 3}


def test_a_mapped_column_outranks_one_of_the_same_name(tmp_path):
    """What the user names wins over what the file names; a claimed column is not used twice."""
    (tmp_path / "t.csv").write_text("frame,particle,x,y,z,x_um\n0,1,9,2,3,4\n")
    back = read_tracks(tmp_path / "t.csv", columns={"x": "x_um", "y": "z"})
    assert back.iloc[0].to_dict() == {"frame": 0, "particle": 1, "x": 4, "y": 3}


def test_wrong_columns_are_listed_together(tmp_path):
    """Each wrong entry of the mapping has its line."""
    text = "frame,particle,x,y\n0,1,2,3\n"
    message = fault_of(
        text, tmp_path, columns={"mass": 0, "x": "POS_X", "y": 4, "z": -5, "time": 0}
    )
    assert "4 faults" in message
    assert "unknown name 'mass'" in message
    assert "x should be column 'POS_X', which the file does not have" in message
    assert "y should be column 4" in message
    assert "z should be column -5" in message
    assert "its 4 columns are: frame, particle, x, y" in message


def test_equal_tables_make_equal_gz_files(tmp_path):
    """A csv.gz holds neither the time nor its own name."""
    write_tracks(tracks(), tmp_path / "a.csv.gz")
    os.utime(tmp_path / "a.csv.gz", (0, 0))
    write_tracks(tracks(), tmp_path / "b.csv.gz")
    data = (tmp_path / "a.csv.gz").read_bytes()
    assert data == (tmp_path / "b.csv.gz").read_bytes()
    assert data[4:8] == bytes(4)


def test_writing_leaves_no_other_file_and_replaces_the_old(tmp_path):
    """A second writing replaces the first; no temporary file stays."""
    write_tracks(tracks(), tmp_path / "t.csv")
    write_tracks(tracks(n_frames=5), tmp_path / "t.csv")
    assert [p.name for p in tmp_path.iterdir()] == ["t.csv"]
    assert len(read_tracks(tmp_path / "t.csv")) == 10


def test_a_failed_rename_leaves_the_old_file_and_no_other(tmp_path, monkeypatch):
    """The old file stays until the new one is whole."""
    write_tracks(tracks(), tmp_path / "t.csv")
    before = (tmp_path / "t.csv").read_bytes()

    def fail(self, target):
        raise OSError("disk full")

    monkeypatch.setattr("pathlib.Path.replace", fail)
    with pytest.raises(OSError, match="disk full"):
        write_tracks(tracks(n_frames=9), tmp_path / "t.csv")
    assert [p.name for p in tmp_path.iterdir()] == ["t.csv"]
    assert (tmp_path / "t.csv").read_bytes() == before


def test_a_faulty_table_is_not_written(tmp_path):
    """Writing checks first."""
    with pytest.raises(TrackTableError, match=r"missing column y"):
        write_tracks(tracks(axes="xz"), tmp_path / "t.csv")
    assert not list(tmp_path.iterdir())


def test_reading_a_file_needs_no_pandas_at_import():
    """Importing the module loads numpy alone."""
    code = (
        "import sys, perrin.tracks.files, perrin.tracks.clusters; "
        "print(sorted({'pandas', 'scipy', 'pyarrow'} & set(sys.modules)))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


# ---- gdf ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("code", [1, 2, 3, 4, 5])
def test_gdf_of_any_type_in_both_byte_orders(tmp_path, order, code):
    """The five IDL types in either byte order, columns x, y, z, frame, particle."""
    rows = [[1, 2, 3, 0, 7], [4, 5, 6, 1, 7], [100, 120, 90, 2, 7]]
    (tmp_path / "t.gdf").write_bytes(gdf(rows, order, code))
    back = read_tracks(tmp_path / "t.gdf")
    assert back[["x", "y", "z", "frame", "particle"]].to_numpy().tolist() == rows
    assert back["x"].dtype == np.float64
    assert back["frame"].dtype == np.int64


@pytest.mark.parametrize("order", ["<", ">"])
def test_gdf_of_four_columns_is_two_dimensional(tmp_path, order):
    """4 columns are x, y, frame, particle."""
    (tmp_path / "t.gdf").write_bytes(gdf([[0.5, 1.5, 3, 8], [0.25, 2.5, 4, 8]], order))
    back = read_tracks(tmp_path / "t.gdf")
    assert back.to_numpy().tolist() == [[3, 8, 0.5, 1.5], [4, 8, 0.25, 2.5]]
    assert list(back.columns) == ["frame", "particle", "x", "y"]


def test_gdf_written_here_has_the_bytes_of_idl(tmp_path):
    """The file is little endian, float64, first dimension fastest."""
    table = tracks()
    write_tracks(table, tmp_path / "t.gdf")
    rows = table[["x", "y", "z", "frame", "particle"]].to_numpy()
    assert (tmp_path / "t.gdf").read_bytes() == gdf(rows, "<", 5)


def test_gdf_of_one_row_has_one_dimension_in_idl(tmp_path):
    """IDL drops a last dimension of 1."""
    (tmp_path / "t.gdf").write_bytes(gdf([0.5, 1.5, 3, 8]))
    assert read_tracks(tmp_path / "t.gdf").to_numpy().tolist() == [[3, 8, 0.5, 1.5]]


@pytest.mark.parametrize("count", [10, 0])
def test_the_ascii_variant_holds_the_same_table(tmp_path, count):
    """As `write_gdf, data, file, /ascii` prints it: header, sizes, elements in wrapped lines."""
    text = (
        f"GDF v. 1.0\n           2\n           5           2           4          {count}\n"
        "     0.500000      1.50000      2.25000      3.00000      8.00000\n     0.250000"
        "      2.50000  1.25000e-03\n      4.00000      8.00000\n"
    )
    (tmp_path / "t.gdf").write_text(text)
    (tmp_path / "b.gdf").write_bytes(gdf([[0.5, 1.5, 2.25, 3, 8], [0.25, 2.5, 1.25e-3, 4, 8]]))
    pd.testing.assert_frame_equal(read_tracks(tmp_path / "t.gdf"), read_tracks(tmp_path / "b.gdf"))


def test_gdf_with_more_columns_asks_for_names(tmp_path):
    """7 columns cannot be guessed: the message shows how to name them, and naming works."""
    rows = np.arange(14.0).reshape(2, 7)
    message = fault_of(gdf(rows), tmp_path, "t.gdf")
    example = 'columns={"x": 0, "y": 1, "z": 2, "frame": -2, "particle": -1}'
    assert "7 columns" in message
    assert example in message
    mapping = {"x": 0, "y": 1, "z": 2, "frame": -2, "particle": -1}
    back = read_tracks(tmp_path / "t.gdf", columns=mapping)
    assert back.iloc[1].to_dict() == {"x": 7, "y": 8, "z": 9, "frame": 12, "particle": 13}
    assert "'POS_X'" in fault_of(gdf(rows), tmp_path, "t.gdf", columns={"x": "POS_X"})


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("length", [0, 3, 4, 8, 10, 16, 20, 23, 24, 25, 64, 103])
def test_a_gdf_cut_anywhere_is_refused(tmp_path, order, length):
    """No beginning of a file passes for a file (this one has 24 + 80 bytes)."""
    data = gdf([[1, 2, 3, 0, 7], [4, 5, 6, 1, 7]], order)
    assert len(data) == 104
    message = fault_of(data[:length], tmp_path, "t.gdf")
    if length < 4:
        assert "82991" in message
    elif length < 24:
        assert f"cut short within its header: it has {length} bytes" in message
    else:
        assert "cut short: 2 rows of 5 columns (float64) take 80 bytes" in message
        assert f"the file has {length - 24};" in message


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (gdf(np.ones((2, 5)), magic=82992), ["not a .gdf", "82991", "30 44 01 00"]),
        (b"GDF v. 1.0\n2\n5", ["cut short", "header"]),
        (b"GDF v. 1.0\n3\n5 1 1 4 5\n1 2 3 4 5\n", ["2 dimensions"]),
        (b"GDF v. 1.0\n2\n5 1 4 5\n1 2 3 4\n", ["1 rows of 5 columns", "4 numbers"]),
        (b"GDF v. 1.0\n2\n4 1 4 4\n1 2 **** 4\n", ["column 2", "'****'", "without /ascii"]),
        (gdf(np.ones((2, 5)), code=7), ["unknown type code 7", "5 float64"]),
        (gdf(np.ones((2, 5)), code=6, count=9), ["type code 6", "5 columns x 2 rows, but 9"]),
        (gdf(np.ones((2, 5)), count=11), ["contradicts", "5 columns x 2 rows", "11 elements"]),
        (gdf(np.ones((2, 5)), dims=(-5, -2)), ["contradicts", "-5 columns x -2 rows"]),
        (gdf(np.ones((2, 5)), dims=(5, 2, 1)), ["2 dimensions (columns, rows), got 3"]),
        (gdf(np.ones((2, 5)), dims=()), ["2 dimensions (columns, rows), got 0"]),
        (gdf(np.ones((2, 5))) + b"x", ["too long", "80 bytes", "the file has 81"]),
    ],
)
def test_a_gdf_that_contradicts_itself_is_refused(tmp_path, data, words):
    """Each kind of broken header is named with its numbers."""
    message = fault_of(data, tmp_path, "t.gdf")
    assert all(word in message for word in words), message


def test_a_gdf_holds_no_text_no_cluster_no_time(tmp_path):
    """What a .gdf cannot hold is refused, not dropped."""
    table = tracks().assign(cluster=0, time=0.0)
    table["particle"] = [f"p{i}" for i in table["particle"]]
    with pytest.raises(TrackTableError) as caught:
        write_tracks(table, tmp_path / "t.gdf")
    assert len(caught.value.faults) == 3
    for words in ("the column cluster", "the column time", "text in particle"):
        assert words in str(caught.value)
    with pytest.raises(TrackTableError, match=r"beyond 2\*\*53"):
        write_tracks(tracks().assign(particle=lambda t: t["particle"] + 2**60), tmp_path / "t.gdf")


# ---- files that are none ------------------------------------------------------------------------


def test_an_unknown_suffix_names_what_can_be_read_and_written(tmp_path):
    """The message lists the formats; a spreadsheet is read, but not written."""
    with pytest.raises(TrackTableError, match=r"t.doc.*\.csv, \.tsv, .*\.parquet, .*\.xlsx"):
        read_tracks(tmp_path / "t.doc")
    with pytest.raises(TrackTableError, match=r"t.xlsx.*\.csv, \.csv\.gz, \.parquet, \.gdf"):
        write_tracks(tracks(), tmp_path / "t.xlsx")


@pytest.mark.parametrize("suffix", [".csv", ".csv.gz", ".parquet", ".gdf"])
def test_a_missing_file_is_a_missing_file(tmp_path, suffix):
    """The error is that of the system."""
    with pytest.raises(FileNotFoundError):
        read_tracks(tmp_path / f"none{suffix}")


GOOD = "frame,particle,x,y\n0,1,2,3\n1,1,2,3\n"


@pytest.mark.parametrize(
    ("data", "name", "words"),
    [
        (b"", "t.csv", ["the file is empty"]),
        (b" \n\n", "t.csv", ["the file is empty"]),
        (b"", "t.csv.gz", ["the file is empty"]),
        (b"frame,particle,x,y\n", "t.csv", ["no rows"]),
        (b"\x89PNG\r\n\x1a\n" + bytes(50), "t.csv", ["not a text file in UTF-8", "line 1"]),
        (b"abc\0\0\0,def", "t.csv", ["binary file"]),
        (b"frame,particle,x,y\n0,1,2,3\n0,1,2,\xb5m\n", "t.csv", ["UTF-8", "line 3"]),
        (b"0,1,2.5,3\n1,1,2,3\n", "t.csv", ["line 1 holds numbers (0,1,2.5,3)", "header line"]),
        (GOOD.encode() + b"1,2,3,4,5\n", "t.csv", ["Expected 4 fields in line 4, saw 5"]),
        (b"frame,particle,x,y\n0,1,2,3,9\n", "t.csv", ["more fields than the header"]),
        (b'frame,particle,x,y\n0,1,2,"3\n', "t.csv", ["not a table", "EOF inside string"]),
        (GOOD.encode(), "t.csv.gz", ["not a whole gzip file"]),
        (gzip.compress(GOOD.encode(), mtime=0)[:-12], "t.csv.gz", ["not a whole gzip file"]),
        (GOOD.encode(), "t.parquet", ["not a parquet file that can be read"]),
        (b"", "t.parquet", ["not a parquet file that can be read"]),
        (b"PAR1" + bytes(40) + b"PAR1", "t.parquet", ["not a parquet file that can be read"]),
        (GOOD.encode(), "t.gdf", ["not a .gdf file"]),
    ],
)
def test_a_file_that_is_no_table_is_refused_in_words(tmp_path, data, name, words):
    """Whatever the bytes, one TrackTableError with the file's name and a plain sentence."""
    message = fault_of(data, tmp_path, name)
    assert all(word in message for word in words), message
    assert "Traceback" not in message


def test_a_parquet_cut_short_is_refused(tmp_path):
    """Half a parquet file is not read as a smaller one."""
    write_tracks(tracks(n_frames=50), tmp_path / "whole.parquet")
    data = (tmp_path / "whole.parquet").read_bytes()
    for length in (10, len(data) // 2, len(data) - 1):
        assert "not a parquet file" in fault_of(data[:length], tmp_path, "t.parquet")


def test_a_parquet_with_frame_as_its_index_reads(tmp_path):
    """A frame column kept in the index by pandas is found."""
    table = tracks()
    table.set_index("frame").to_parquet(tmp_path / "t.parquet")
    pd.testing.assert_frame_equal(read_tracks(tmp_path / "t.parquet"), table)


# ---- the check ----------------------------------------------------------------------------------


def test_a_good_table_comes_back_as_a_clean_copy():
    """Our columns in our order, rows as they were, fresh index, the input untouched."""
    table = tracks().assign(mass=1.0, cluster=2)[
        ["z", "mass", "cluster", "y", "x", "particle", "frame"]
    ]
    table = table.sample(frac=1, random_state=3)
    before = table.copy()
    clean = check_tracks(table, source="the table")
    assert list(clean.columns) == ["frame", "particle", "x", "y", "z", "cluster"]
    assert clean.index.equals(pd.RangeIndex(6))
    np.testing.assert_array_equal(clean.to_numpy(), table[clean.columns].to_numpy())
    clean.loc[0, "x"] = 99.0
    pd.testing.assert_frame_equal(table, before)


def test_checking_twice_changes_nothing():
    """A clean table is its own clean copy."""
    table = tracks().assign(cluster=["a", None, "b"] * 2)
    once = check_tracks(table, source="the table")
    pd.testing.assert_frame_equal(check_tracks(once, source="the table"), once)


def test_permuted_rows_come_back_permuted():
    """The check does not depend on the order of the rows."""
    table, order = tracks(), [4, 2, 5, 0, 3, 1]
    clean = check_tracks(table, source="t")
    permuted = check_tracks(table.iloc[order], source="t")
    pd.testing.assert_frame_equal(permuted, clean.iloc[order].reset_index(drop=True))


@pytest.mark.parametrize(
    "dtype", ["int8", "uint64", "float32", "float64", "Int64", "Float64", "int64[pyarrow]", object]
)
def test_whole_numbers_of_any_dtype_become_int64(dtype):
    """Frame and ids are int64, coordinates float64, whatever the table holds them as."""
    table = tracks().assign(cluster=1)
    table["x"] = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    for name in ("frame", "particle", "cluster", "x"):
        table[name] = table[name].astype(dtype)
    clean = check_tracks(table, source="the table")
    assert [str(d) for d in clean.dtypes] == ["int64"] * 2 + ["float64"] * 3 + ["int64"]
    assert clean["particle"].tolist() == [0, 1] * 3
    assert clean["x"].tolist() == [1, 2, 3, 4, 5, 6]


def test_long_integer_ids_keep_all_their_digits():
    """Ids beyond 2**53 are not rounded to each other."""
    table = tracks().assign(particle=lambda t: t["particle"] + 2**62)
    assert check_tracks(table, source="t")["particle"].tolist() == table["particle"].tolist()


@pytest.mark.parametrize("dtype", [object, "string", "category"])
def test_text_labels_of_any_dtype_are_kept(dtype):
    """Text ids stay text, also where they consist of digits."""
    for labels in (["p1", "p2"] * 3, ["007", "7"] * 3):
        table = tracks().assign(particle=pd.Series(labels).astype(dtype))
        clean = check_tracks(table, source="t")
        assert clean["particle"].tolist() == labels
        assert all(type(label) is str for label in clean["particle"])


@pytest.mark.parametrize("missing", [np.nan, None, pd.NA])
def test_no_cluster_is_minus_one_among_numbers_and_nan_among_texts(missing):
    """A missing cluster is no fault and has one representation per kind."""
    numbers = tracks().assign(cluster=pd.Series([0, 1, missing] * 2, dtype=object))
    clean = check_tracks(numbers, source="t")["cluster"]
    assert clean.dtype == np.int64
    assert clean.tolist() == [0, 1, -1] * 2
    texts = tracks().assign(cluster=pd.Series(["a", "b", missing] * 2, dtype=object))
    clean = check_tracks(texts, source="t")["cluster"]
    assert clean.isna().tolist() == [False, False, True] * 2
    assert isinstance(clean[2], float)
    nothing = check_tracks(tracks().assign(cluster=missing), source="t")["cluster"]
    assert nothing.tolist() == [-1] * 6


def test_nan_coordinates_are_kept():
    """A NaN coordinate is a missing point, not a fault."""
    table = tracks()
    table.loc[[1, 4], "y"] = np.nan
    clean = check_tracks(table, source="t")
    assert clean["y"].isna().tolist() == [False, True, False, False, True, False]
    assert len(clean) == 6


def test_the_same_id_in_two_clusters_is_no_repeat():
    """With a cluster column the key is (frame, cluster, particle)."""
    table = pd.DataFrame({"frame": 0, "particle": 0, "x": [0.0, 1.0], "y": 0.0})
    assert "2 (" not in faults_of(table)[0]
    assert len(check_tracks(table.assign(cluster=[0, 1]), source="t")) == 2
    assert "cluster 1" in faults_of(table.assign(cluster=[1, 1]))[0]


def csv_with(line_of, tmp_path, n=12):
    """Return the message for a good csv in which some lines are replaced."""
    lines = ["frame,particle,x,y", *(f"{t},1,0.5,1.5" for t in range(n))]
    for number, text in line_of.items():
        lines[number - 1] = text
    return fault_of("\n".join(lines) + "\n", tmp_path)


def test_text_among_numbers_is_named_with_its_line(tmp_path):
    """Column, count, first text, lines."""
    message = csv_with({4: "2,1,0.5,abc", 9: "7,1,0.5,n.d."}, tmp_path)
    assert "y: 2 of 12 entries are text" in message
    assert "first 'abc', in lines 4, 9;" in message
    assert "frame: 1 of 12 entries are text" in csv_with({3: "t1,1,0,0"}, tmp_path)


def test_blank_lines_count_as_lines(tmp_path):
    """The line named is the line an editor shows."""
    message = fault_of("frame,particle,x,y\n\n0,1,0,0\n\n\n1,1,zero,0\n\n", tmp_path)
    assert "x: 1 of 2 entries are text" in message
    assert "first 'zero', in line 6;" in message


def test_infinite_coordinates_are_named(tmp_path):
    """An infinite coordinate is no missing point."""
    message = csv_with({5: "3,1,inf,1", 6: "4,1,-inf,1"}, tmp_path)
    assert "x: 2 infinite values, in lines 5, 6; use NaN" in message


@pytest.mark.parametrize(
    ("cell", "words"),
    [
        ("", "frame: 1 entries are missing or NaN, in line 7"),
        ("nan", "frame: 1 entries are missing or NaN, in line 7"),
        ("inf", "frame: 1 entries are not whole numbers, first inf, in line 7"),
        ("2.5", "frame: 1 entries are not whole numbers, first 2.5, in line 7"),
        ("1e300", "frame: 1 entries are not whole numbers, first 1e+300, in line 7"),
        ("99999999999999999999", "frame: 1 entries are not whole numbers"),
    ],
)
def test_a_frame_that_is_no_whole_number_is_named(tmp_path, cell, words):
    """Frames are whole numbers without exception."""
    assert words in csv_with({7: f"{cell},1,0.5,1.5"}, tmp_path)


@pytest.mark.parametrize(
    ("cell", "words"),
    [
        ("", "particle: 1 entries are missing or NaN, in line 7"),
        ("1.5", "particle: 1 entries are not whole numbers, first 1.5, in line 7"),
        ("p", "particle: 1 entries are text and 11 are numbers, first text 'p', text in line 7"),
    ],
)
def test_a_particle_that_is_no_id_is_named(tmp_path, cell, words):
    """Ids are whole numbers, or text throughout."""
    assert words in csv_with({7: f"5,{cell},0.5,1.5"}, tmp_path)


def test_a_missing_text_id_is_named():
    """Also among text labels every row needs its particle."""
    table = tracks().assign(particle=["a", "b", None, "b", "a", "b"])
    assert faults_of(table)[0].startswith("particle: 1 entries are missing or NaN, in row 2")


def test_clusters_are_ids_too():
    """A mix of numbers and text, a fraction and infinity are refused in cluster."""
    mixed = pd.Series([0, "a", 0, 1, "b", 1], dtype=object)
    assert (
        "cluster: 2 entries are text and 4 are numbers"
        in faults_of(tracks().assign(cluster=mixed))[0]
    )
    broken = [0, 0.5, np.inf, 0, 1, 1]
    assert (
        "cluster: 2 entries are not whole numbers, first 0.5, in rows 1, 2"
        in (faults_of(tracks().assign(cluster=broken))[0])
    )


@pytest.mark.parametrize(
    "column",
    [
        [True, False] * 3,
        pd.date_range("2020", periods=6),
        pd.Series([1j] * 6),
    ],
)
def test_values_that_are_neither_number_nor_text_are_refused(column):
    """Truth values, dates and complex numbers are no coordinates, frames or ids."""
    for name in ("frame", "particle", "x"):
        faults = faults_of(tracks().assign(**{name: column}))
        assert any(f.startswith(f"{name}: 6") and "text" in f for f in faults)


def test_repeats_are_named_with_key_and_row():
    """A particle has one row in a frame."""
    table = pd.concat([tracks(), tracks().iloc[[3, 1]]])
    (fault,) = faults_of(table)
    assert fault.startswith("2 rows repeat the (frame, particle) of an earlier row")
    assert "first frame 1, particle 1, in rows 6, 7;" in fault


def test_rows_without_a_key_repeat_nothing():
    """Two rows of one particle without a frame are missing frames, no repeat."""
    table = tracks().assign(frame=[0, 0, np.nan, 1, np.nan, 2])
    assert [fault[:8] for fault in faults_of(table)] == ["frame: 2"]


def test_many_rows_are_counted_and_a_few_shown():
    """The message stays short however much is wrong."""
    (fault,) = faults_of(tracks(n_frames=500).assign(x=np.inf))
    assert "x: 1000 infinite values, in rows 0, 1, 2, 3, 4 and 995 more;" in fault


def test_missing_columns_are_listed_with_those_found():
    """All at once, with what to do."""
    (fault,) = faults_of(tracks()[["frame", "z"]].rename(columns={"frame": "Frame"}))
    assert "missing columns particle, x, y; found: Frame, z;" in fault
    assert "columns=" in fault


def test_a_doubled_column_is_refused():
    """Which of two columns called x is meant cannot be known."""
    table = tracks()
    table = pd.concat([table, table[["x"]]], axis=1)
    assert "more than one column is called x" in faults_of(table)[0]


def test_an_empty_table_is_refused():
    """No rows, no tracks."""
    assert "no rows" in faults_of(tracks().iloc[:0])[0]
    assert len(faults_of(pd.DataFrame())) == 2


def test_all_faults_are_in_one_message():
    """Seven faults, seven lines."""
    table = tracks(n_frames=5).astype({"frame": float, "particle": float, "x": object})
    table.loc[0, "x"] = "abc"
    table.loc[1, "z"] = np.inf
    table.loc[2, "frame"] = np.nan
    table.loc[3, "frame"] = 0.5
    table.loc[4, "particle"] = np.nan
    table.loc[9, ["frame", "particle"]] = [0.0, 1.0]
    faults = faults_of(table.drop(columns="y"), source="data.parquet")
    starts = ["missing column y", "frame: 1", "frame: 1", "particle: 1", "x: 1", "z: 1", "1 row "]
    assert [fault.startswith(s) for fault, s in zip(faults, starts, strict=True)] == [True] * 7


def test_a_source_that_is_a_csv_counts_lines():
    """Line 2 of a csv is row 0 of its table."""
    table = tracks().assign(x=[0, np.inf, 0, 0, 0, 0])
    assert "in row 1;" in faults_of(table, source="the table")[0]
    assert "in line 3;" in faults_of(table, source="day1.csv")[0]


def test_another_type_than_a_table_is_a_type_error():
    """An array has no columns."""
    with pytest.raises(TypeError, match="expected a pandas DataFrame, got ndarray"):
        check_tracks(np.zeros((3, 4)), source="the table")


# ---- spellings and units ------------------------------------------------------------------------


@pytest.mark.parametrize(
    "names",
    [
        ("Frame", "Particle", "X", "Y", "Z"),
        (" frame ", "particle ", " x", "y ", "z"),
        ("frame", "particle", "x (um)", "y [\u00b5m]", "z (\u03bcm)"),
        ("FRAME", "Particle ID", "x_um", "Y_um", "z [ micron ]"),
        ("Frame Number", "particle_id", "x", "y", "Z (um)"),
    ],
)
def test_spellings_that_differ_in_case_blanks_or_unit_are_read(tmp_path, names):
    """The same table under other names gives the same numbers, and a note of every other name."""
    table = tracks()
    spelt = table.set_axis(list(names), axis=1)
    spelt.to_parquet(tmp_path / "t.parquet")
    for back in (read_tracks(tmp_path / "t.parquet"), check_tracks(spelt, source="the table")):
        pd.testing.assert_frame_equal(back, table)
        (note,) = back.attrs["notes"]
        for theirs, ours in zip(names, table.columns, strict=True):
            assert (f"{theirs!r} as {ours}" in note) == (theirs != ours)
    assert "notes" not in check_tracks(table, source="the table").attrs


def test_exact_names_win_and_the_others_are_noted():
    """Where a column has our name, none of another spelling is read, and a note states that."""
    table = tracks().assign(X=7.0, **{"y (um)": 8.0})
    back = check_tracks(table, source="the table")
    pd.testing.assert_frame_equal(back, tracks())
    assert back.attrs["notes"] == [
        "columns left out, because others have exactly our names: 'X', 'y (um)'"
    ]


def test_of_two_candidates_none_is_chosen(tmp_path):
    """X and x (um) could both be x: a fault with both names and the remedy, which works."""
    table = tracks().rename(columns={"x": "X"}).assign(**{"x (um)": 8.0})
    table.to_csv(tmp_path / "t.csv", index=False)
    with pytest.raises(TrackTableError) as caught:
        read_tracks(tmp_path / "t.csv")
    (fault,) = caught.value.faults
    assert fault == (
        "x: 2 columns could be it, 'X', 'x (um)'; choose one, for example columns={'x': 'X'}"
    )
    back = read_tracks(tmp_path / "t.csv", columns={"x": "X"})
    np.testing.assert_array_equal(back["x"], tracks()["x"])


@pytest.mark.parametrize("name", ["xx", "x (a.u.)", "x (s)", "x1", "mean x", "x_std", "pos_x"])
def test_other_names_are_not_guessed(name):
    """A name with another word or an unknown unit is none of ours."""
    table = tracks().rename(columns={"x": name})
    assert "missing column x" in faults_of(table)[0]


@pytest.mark.parametrize(
    ("unit", "right", "wrong"),
    [
        ("um", 1, (0.1, 1e-3)),
        ("nm", 1e-3, (1, 0.1, 1e3)),
        ("mm", 1e3, (1, 1e-3)),
        ("px", 0.16, (1, (1, 1, 1))),
        ("pixels", (0.1, 0.1, 0.3), (1,)),
    ],
)
@pytest.mark.parametrize("form", ["{} ({})", "{} [{}]", "{}({})"])
def test_a_unit_in_a_name_must_agree_with_the_scale(unit, right, wrong, form):
    """The right scale is read as without the unit; a contradiction is refused with both numbers."""
    table = tracks()
    named = table.rename(columns={axis: form.format(axis, unit) for axis in "xyz"})
    expected = check_tracks(table, source="the table", scale=right)
    pd.testing.assert_frame_equal(
        check_tracks(named, source="the table", scale=right), expected, check_exact=True
    )
    for scale in wrong:
        with pytest.raises(TrackTableError, match=f"in {unit}, but the scale is .*state scale"):
            check_tracks(named, source="the table", scale=scale)


def test_units_of_single_axes_are_judged_by_their_own_scale(tmp_path):
    """X and y in nm, z in um: one number per axis; the message states all three."""
    table = tracks().rename(columns={"x": "x (nm)", "y": "y (nm)", "z": "z (um)"})
    table.to_csv(tmp_path / "t.csv", index=False)
    read_tracks(tmp_path / "t.csv", scale=(1e-3, 1e-3, 1))
    fault = fault_of((tmp_path / "t.csv").read_text(), tmp_path)
    assert "'x (nm)', 'y (nm)' are in nm, but the scale is 1 um per unit" in fault
    assert "state scale=(0.001, 0.001, 1)" in fault


def test_columns_by_name_keep_their_unit_and_by_number_do_not(tmp_path):
    """A mapping by name is checked against the unit; one by number is not."""
    table = tracks().rename(columns={axis: f"POS_{axis} (nm)" for axis in "xyz"})
    table.to_csv(tmp_path / "t.csv", index=False)
    by_name = {axis: f"POS_{axis} (nm)" for axis in "xyz"}
    assert "in nm" in fault_of((tmp_path / "t.csv").read_text(), tmp_path, columns=by_name)
    nm = read_tracks(tmp_path / "t.csv", columns=by_name, scale=1e-3)
    plain = read_tracks(tmp_path / "t.csv", columns={"x": 2, "y": 3, "z": 4})
    np.testing.assert_allclose(nm[["x", "y", "z"]], 1e-3 * plain[["x", "y", "z"]], rtol=1e-15)


@pytest.mark.parametrize(("unit", "seconds"), [("s", 1), ("ms", 1e-3), ("min", 60)])
def test_a_time_in_another_unit_is_converted_and_noted(unit, seconds):
    """No argument can contradict the unit of time, so it holds."""
    table = tracks().assign(time=0.25)
    back = check_tracks(table.rename(columns={"time": f"Time ({unit})"}), source="the table")
    np.testing.assert_allclose(back["time"], 0.25 * seconds, rtol=1e-15)
    converted = any("converted" in note for note in back.attrs["notes"])
    assert converted == (seconds != 1)


def test_lists_of_columns_are_short():
    """A table of 300 strange columns does not fill the screen."""
    table = pd.DataFrame({f"column {k}": [1.0] for k in range(300)})
    fault = faults_of(table)[0]
    assert "column 9 and 290 more;" in fault
    assert len(fault) < 400
