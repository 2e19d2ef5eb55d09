"""The manifest of a study, study.toml: which files, under which conditions, measured how."""

from __future__ import annotations

import glob
import hashlib
import json
import os
import re
import tomllib
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from perrin._arrays import choice_fault, flag_fault, number_fault, refuse, to_plain
from perrin._text import listed
from perrin.errors import ManifestError
from perrin.study.trends import LAWS
from perrin.tracks.formats import READABLE_SUFFIXES

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

Source = Literal["table", "movie"]

# What Python makes of a byte of a file's name that is not UTF-8.
_NO_UTF8 = "[\udc80-\udcff]"

# Options of `analyze` and of `analyze_stack` that a manifest may state, and what each must be.
_COMMON = {
    "dt": "positive", "contact": "positive", "diameter": "positive", "viscosity": "positive",
    "temperature": "positive", "exposure": "number", "noise": "any", "drift": "flag",
    "keep_jumps": "flag", "model": "text", "frames": "slice", "size": "any",
}  # fmt: skip
TABLE_OPTIONS = {**_COMMON, "scale": "any", "columns": "table", "sigma": "any"}
STACK_OPTIONS = {
    "voxel": "any", "plane_time": "number", "planes": "number", "channel": "any", "image": "any",
}  # fmt: skip
MOVIE_OPTIONS = {
    **_COMMON, **STACK_OPTIONS, "refine": "text", "dark": "flag", "minmass": "number",
    "percentile": "number", "border": "flag",
}  # fmt: skip
_OPTIONS = {**TABLE_OPTIONS, **MOVIE_OPTIONS}
_OWN = ("label", "files", "conditions", "replicate", "exclude")
_TOP = ("title", "conditions", "average", "law", "reports", "defaults", "sample")

# Verdicts on the motion whose coefficients may be averaged.
_VERDICTS = (
    "diffusion", "jumps", "drift", "spin", "changing D", "confined", "subdiffusion",
    "superdiffusion", "vibration", "not judged",
)  # fmt: skip

# What is not read as a table is a movie: a stack of images.
_TABLE_SUFFIXES = tuple(suffix + packed for suffix in READABLE_SUFFIXES for packed in ("", ".gz"))


@dataclass(frozen=True)
class Exclusion:
    """A cluster, or a whole file, that is measured but not averaged.

    Attributes
    ----------
    reason : str
        Why.
    file : str or None
        Name of the file; None for every file of the sample.
    cluster : int, str or None
        Number or label of the cluster; None for all of the file.
    """

    reason: str
    file: str | None = None
    cluster: int | str | None = None


@dataclass(frozen=True)
class StudyMovie:
    """One movie or table of a study.

    Attributes
    ----------
    name : str
        Name of its run folder.
    path : str
        File, folder or address of the movie or table.
    source : {"table", "movie"}
    sample : str
        Label of the sample.
    conditions : dict
        Numbers or texts by the name of the condition.
    replicate : str or None
        Sample and independent preparation; movies of one replicate count as one movie in the
        statistics.
    options : dict
        Arguments of `analyze` or of `open_stack` and `analyze_stack`.
    exclusions : tuple of Exclusion
    """

    name: str
    path: str
    source: Source
    sample: str
    conditions: dict[str, float | str] = field(default_factory=dict)
    replicate: str | None = None
    options: dict[str, Any] = field(default_factory=dict)
    exclusions: tuple[Exclusion, ...] = ()

    @property
    def unit(self) -> str:
        """What counts as one independent movie in the statistics."""
        return self.name if self.replicate is None else f"replicate {self.replicate}"

    def excluded_because(self, cluster: int, label: str | None) -> str:
        """Return why a cluster is not averaged by choice; an empty text where it is averaged.

        Parameters
        ----------
        cluster : int
            Number of the cluster.
        label : str or None
            Its label.
        """
        reasons = [e.reason for e in self.exclusions if e.cluster in (None, cluster, label)]
        return f"excluded: {reasons[0]}" if reasons else ""


@dataclass(frozen=True)
class Manifest:
    """The content of a manifest, checked.

    Attributes
    ----------
    movies : tuple of StudyMovie
    title : str
    conditions : tuple of str
        Names of the conditions; the first is the abscissa of the figures.
    average : tuple of str
        Verdicts on the motion whose coefficients are averaged.
    law : str or None
        Law that is fitted to the coefficients against the first condition (`fit_trend`).
    reports : bool
        Whether every run folder has figures and a report page.
    text : str
        The manifest as it was read.
    """

    movies: tuple[StudyMovie, ...]
    title: str = "Study"
    conditions: tuple[str, ...] = ()
    average: tuple[str, ...] = ("diffusion", "not judged")
    law: str | None = None
    reports: bool = True
    text: str = ""


def read_manifest(path: str | os.PathLike[str]) -> Manifest:
    r"""Read and check a manifest.

    Parameters
    ----------
    path : path
        A file of TOML; paths of files in it are relative to its folder.

    Returns
    -------
    Manifest

    Raises
    ------
    ManifestError
        All faults of the manifest with their lines.
    OSError
        If the file cannot be read.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = Path(folder, "a.csv").write_text("frame,particle,x,y,z")
    ...     stated = 'conditions = ["phi"]\n[[sample]]\nfiles = ["a.csv"]\ndt = 0.5\nphi = 0.4'
    ...     _ = Path(folder, "study.toml").write_text(stated)
    ...     read_manifest(Path(folder, "study.toml")).movies[0].conditions
    {'phi': 0.4}
    """
    place = Path(path)
    text = place.read_text(encoding="utf-8")
    try:
        stated = tomllib.loads(text)
    except tomllib.TOMLDecodeError as fault:
        raise ManifestError(f"{place}: no TOML: {fault}") from None
    check = _Check(stated, key_lines(text), place.absolute().parent)
    check.head()
    samples = stated.get("sample", [])
    if not samples:
        check.wrong((), "expected at least one [[sample]]")
    movies = [m for number in range(len(samples)) for m in check.sample(number)]
    if check.faults:
        listing = "; ".join(f"line {line}: {text}" for line, text in sorted(check.faults))
        raise ManifestError(f"{place}: {listing}")
    named = []
    for movie in movies:
        # The same file may be measured twice, as two samples; names differ by label and path, and
        # do not depend on other movies.
        parts = [movie.name] if movie.name.startswith(movie.sample) else [movie.sample, movie.name]
        text = re.sub(r"[^\w.-]+", "_", "-".join(parts)).strip("._-") or "movie"
        mark = hashlib.sha256(os.fsencode(f"{movie.sample}\n{movie.path}")).hexdigest()[:6]
        named.append(replace(movie, name=f"{text[:80]}-{mark}"))
    return Manifest(
        movies=tuple(named),
        title=str(stated.get("title", "Study")),
        conditions=tuple(stated.get("conditions", ())),
        average=tuple(stated.get("average", Manifest.average)),
        law=stated.get("law"),
        reports=stated.get("reports", True),
        text=text,
    )


def manifest_text(files: Sequence[str | os.PathLike[str]], *, folder: Path) -> str:
    """Return a manifest to be edited: a sample for each file, and every default as a comment.

    Parameters
    ----------
    files : sequence of path
        Movies and tables.
    folder : Path
        Folder of the manifest, to which paths are made relative where they lie in it.

    Returns
    -------
    str

    Raises
    ------
    ValueError
        If there is no file.

    Examples
    --------
    >>> print(manifest_text(["a.csv"], folder=Path.cwd()).splitlines()[-4])
    label = "a"
    """
    refuse([] if files else ["FILES: expected at least one movie or table"])
    home = folder.absolute()
    sources = {source_of(str(one)) for one in files}
    lines = [
        "# A study: every [[sample]] is one preparation with its files and its conditions.",
        "# Edit it, then: perrin study run study.toml -o STUDY",
        'title = "Study"',
        'conditions = ["phi"]                # names of your own; the first is the abscissa',
        '# average = ["diffusion", "not judged"]   # verdicts on the motion that are averaged',
        '# law = "power"                     # fitted against the first condition',
        "# reports = true                    # a report page and figures for every movie",
        "",
        "[defaults]                          # of every sample, which may state its own",
    ]
    lines += ["dt = 1.0                            # s, time between frames"] * ("table" in sources)
    lines += [
        "# scale = 0.11                      # um per unit of a table",
        "# exposure = 0.5                    # open share of dt",
    ]
    if "movie" in sources:
        lines += [
            "diameter = 2.0                      # um, of the fluorescent sphere",
            "contact = 2.0                       # um, centre distance of touching spheres",
            "# voxel = [0.2, 0.1, 0.1]           # um, z, y, x, where files do not state it",
        ]
    else:
        lines.append("# diameter = 2.45                   # um, for predictions")
    lines += [
        "# viscosity = 1e-3                  # Pa s",
        "# temperature = 295                 # K",
    ]
    for one in files:
        path = Path(one).absolute()
        inside = path.is_relative_to(home)
        name = path.relative_to(home).as_posix() if inside else str(path)
        if "://" in str(one):
            name = str(one)
        if re.search(_NO_UTF8, name):
            # TOML is UTF-8: a name that is not is found by a pattern.
            name = re.sub(_NO_UTF8, "?", glob.escape(name))
        lines += [
            "",
            "[[sample]]",
            f"label = {json.dumps(_stem(name), ensure_ascii=False)}",
            f"files = [{json.dumps(name, ensure_ascii=False)}]",
            "phi = 0.0",
            '# exclude = [{ cluster = 3, reason = "touches the wall" }]',
        ]
    return "\n".join(lines) + "\n"


def manifest_dict(manifest: Manifest) -> dict[str, Any]:
    """Return a manifest for JSON.

    Parameters
    ----------
    manifest : Manifest

    Returns
    -------
    dict

    Examples
    --------
    >>> manifest_from(manifest_dict(Manifest(()))) == Manifest(())
    True
    """
    plain: dict[str, Any] = json.loads(json.dumps(to_plain(asdict(manifest))))
    return plain


def manifest_from(entry: Mapping[str, Any]) -> Manifest:
    """Return the manifest that `manifest_dict` wrote.

    Parameters
    ----------
    entry : mapping

    Returns
    -------
    Manifest

    Examples
    --------
    >>> manifest_from(manifest_dict(Manifest((), title="Glass"))).title
    'Glass'
    """
    movies = tuple(
        StudyMovie(**{**one, "exclusions": tuple(Exclusion(**e) for e in one["exclusions"])})
        for one in entry["movies"]
    )
    names = {"conditions": tuple(entry["conditions"]), "average": tuple(entry["average"])}
    return Manifest(**{**entry, **names, "movies": movies})


def source_of(path: str) -> Source:
    """Return whether a file is a table of tracks or a movie, by the end of its name.

    Parameters
    ----------
    path : str

    Returns
    -------
    {"table", "movie"}

    Examples
    --------
    >>> source_of("tracks.CSV.gz"), source_of("a.ome.tif"), source_of("s3://bucket/a.zarr")
    ('table', 'movie', 'movie')
    """
    return "table" if path.lower().endswith(_TABLE_SUFFIXES) else "movie"


def key_lines(text: str) -> dict[tuple[str, ...], int]:
    r"""Return the line of every key of a TOML text, from 1; the standard parser gives none.

    Parameters
    ----------
    text : str

    Returns
    -------
    dict
        Lines by path: ("title",), ("defaults", "dt"), ("sample", "0", "files"); those of tables
        too.

    Examples
    --------
    >>> key_lines("a = 1\n[[sample]]\nfiles = [\n]\n")
    {('a',): 1, ('sample',): 2, ('sample', '0'): 2, ('sample', '0', 'files'): 3}
    """
    lines: dict[tuple[str, ...], int] = {}
    counts: dict[str, int] = {}
    table: tuple[str, ...] = ()
    for number, line in enumerate(text.splitlines(), start=1):
        header = re.match(r"\s*(\[\[?)\s*([\w.\"' -]+?)\s*\]\]?\s*(?:#.*)?$", line)
        if header:
            parts = tuple(part.strip(" \"'") for part in header[2].split("."))
            if header[1] == "[[":
                counts[parts[0]] = counts.get(parts[0], -1) + 1
            if parts[0] in counts:
                lines.setdefault(parts[:1], number)
                parts = (parts[0], str(counts[parts[0]]), *parts[1:])
            table = parts
            lines.setdefault(table, number)
            continue
        key = re.match(r"\s*(?:\"([^\"]+)\"|'([^']+)'|([\w-]+))\s*(?:\.|=)", line)
        if key:
            lines.setdefault((*table, next(k for k in key.groups() if k)), number)
    return lines


class _Check:
    """The checks of a manifest, which collect all faults with their lines."""

    def __init__(
        self, stated: Mapping[str, Any], lines: Mapping[tuple[str, ...], int], folder: Path
    ) -> None:
        self.stated, self._lines, self._folder = stated, lines, folder
        self.faults: list[tuple[int, str]] = []
        names = stated.get("conditions", [])
        self._conditions: list[str] = names if _are_texts(names) else []
        defaults = stated.get("defaults", {})
        self._defaults: Mapping[str, Any] = defaults if isinstance(defaults, dict) else {}
        self._labels: set[str] = set()

    def wrong(self, where: tuple[str, ...], message: str) -> None:
        """Collect a fault at the line of a key, or of the nearest table around it."""
        known = (where[:k] for k in range(len(where), 0, -1) if where[:k] in self._lines)
        self.faults.append((self._lines.get(next(known, ()), 1), message))

    def head(self) -> None:
        """Check what is stated once, and the defaults."""
        stated = self.stated
        for key in stated.keys() - set(_TOP):
            self.wrong((key,), f"unknown {key!r}; expected {listed(_TOP)}")
        names = stated.get("conditions", [])
        if not _are_texts(names):
            self.wrong(("conditions",), f"conditions: expected names, got {names!r}")
        reserved = {*_OWN, *_OPTIONS} - {"viscosity", "temperature", "diameter"}
        for name in set(self._conditions) & reserved:
            self.wrong(("conditions",), f"conditions: {name!r} is an option; choose another name")
        average = stated.get("average", [])
        if not _are_texts(average) or set(average) - set(_VERDICTS):
            text = f"average: expected some of {listed(_VERDICTS)}, got {average!r}"
            self.wrong(("average",), text)
        for fault in choice_fault("law", stated.get("law"), (*LAWS, None)):
            self.wrong(("law",), fault)
        for fault in flag_fault("reports", stated.get("reports", True)):
            self.wrong(("reports",), fault)
        for key, value in self._defaults.items():
            if key not in (*_OPTIONS, *self._conditions):
                text = f"defaults: unknown {key!r}; expected {listed(_OPTIONS, most=40)}"
                self.wrong(("defaults", key), text)
            for line in _option_faults(key, value):
                self.wrong(("defaults", key), f"defaults: {line}")

    def sample(self, number: int) -> list[StudyMovie]:
        """Return the movies of one sample, and collect its faults."""
        sample, at = self.stated["sample"][number], ("sample", str(number))
        known = (*_OWN, *self._conditions, *_OPTIONS)
        for key in sample.keys() - set(known):
            self.wrong((*at, key), f"unknown {key!r}; expected {listed(known, most=50)}")
        options = {k: v for k, v in sample.items() if k in _OPTIONS}
        for key, value in options.items():
            for line in _option_faults(key, value):
                self.wrong((*at, key), line)
        files = sample.get("files")
        # Without a label, a sample is called after its first file.
        usual = _stem(files[0]) if _are_texts(files) and files else f"sample {number + 1}"
        label = str(sample.get("label", usual))
        if label in self._labels:
            self.wrong((*at, "label"), f"label {label!r} is that of another sample")
        self._labels.add(label)
        conditions = self._conditions_of(sample, at)
        exclusions = self._exclusions(sample, at)
        paths = self._paths(sample, at)
        for name in {one.file for one in exclusions} - {None} - {Path(p).name for p in paths}:
            self.wrong((*at, "exclude"), f"exclude: {name} is none of the files of the sample")
        replicate = sample.get("replicate")
        return [
            StudyMovie(
                name=_stem(path),
                path=path,
                source=source_of(path),
                sample=label,
                conditions=conditions,
                replicate=None if replicate is None else f"{label}: {replicate}",
                options=self._options_for(path, options, at),
                exclusions=tuple(e for e in exclusions if e.file in (None, Path(path).name)),
            )
            for path in paths
        ]

    def _conditions_of(
        self, sample: Mapping[str, Any], at: tuple[str, ...]
    ) -> dict[str, float | str]:
        """Return the conditions of a sample."""
        own = dict(sample.get("conditions", {}))
        for key in own.keys() - set(self._conditions):
            self.wrong((*at, "conditions"), f"condition {key!r} is not in the list of conditions")
        found: dict[str, float | str] = {}
        for name in self._conditions:
            value = own.get(name, sample.get(name, self._defaults.get(name)))
            if value is None:
                self.wrong(at, f"condition {name!r} is not stated for the sample")
            elif not isinstance(value, int | float | str) or isinstance(value, bool):
                self.wrong((*at, name), f"{name}: expected a number or a text, got {value!r}")
            else:
                found[name] = value
        return found

    def _paths(self, sample: Mapping[str, Any], at: tuple[str, ...]) -> list[str]:
        """Return the files of a sample."""
        stated = sample.get("files")
        if not _are_texts(stated) or not stated:
            text = f"files: expected one or more paths in brackets, got {stated!r}"
            self.wrong((*at, "files"), text)
            return []
        paths: list[str] = []
        for one in stated:
            found = [one] if "://" in one else []
            if not found and (self._folder / one).exists():
                found = [str(self._folder / one)]
            elif not found and re.search(r"[*?\[]", one):
                root = Path(one).anchor
                within = Path(root) if root else self._folder
                found = sorted(map(str, within.glob(str(Path(one).relative_to(root or ".")))))
            if not found:
                self.wrong((*at, "files"), f"files: {one} does not exist")
            paths += found
        return paths

    def _options_for(
        self, path: str, options: Mapping[str, Any], at: tuple[str, ...]
    ) -> dict[str, Any]:
        """Return the options of one file, and collect what it does not know and what it needs."""
        source, name = source_of(path), Path(path).name
        usable = TABLE_OPTIONS if source == "table" else MOVIE_OPTIONS
        for key in options.keys() - usable.keys():
            self.wrong((*at, key), f"{key}: is no option of a {source} ({name})")
        merged = {k: v for k, v in {**self._defaults, **options}.items() if k in usable}
        for key in ("dt",) if source == "table" else ("diameter", "contact"):
            if key not in merged:
                self.wrong((*at, "files"), f"{key}: needed for the {source} {name}")
        return merged

    def _exclusions(self, sample: Mapping[str, Any], at: tuple[str, ...]) -> list[Exclusion]:
        """Return the exclusions of a sample."""
        stated = sample.get("exclude", [])
        found = []
        for entry in stated if isinstance(stated, list) else [stated]:
            known = isinstance(entry, dict) and not entry.keys() - {"file", "cluster", "reason"}
            if known and isinstance(entry.get("reason"), str) and len(entry) > 1:
                found.append(Exclusion(entry["reason"], entry.get("file"), entry.get("cluster")))
                continue
            self.wrong(
                (*at, "exclude"),
                'exclude: expected entries such as { cluster = 3, reason = "touches the wall" }, '
                f'with file = "name" for one file, got {entry!r}',
            )
        return found


def _option_faults(key: str, value: Any) -> list[str]:  # noqa: ANN401 (whatever TOML holds)
    """Return the faults of the value of an option; `analyze` checks what depends on others."""
    kind = _OPTIONS.get(key, "any")
    if kind == "positive":
        return number_fault(key, value, above=0)
    if kind == "number":
        return number_fault(key, value)
    if kind == "flag":
        return flag_fault(key, value)
    if kind == "text" and not isinstance(value, str):
        return [f"{key}: expected a text, got {value!r}"]
    if kind == "table" and not isinstance(value, dict):
        return [f"{key}: expected a table such as {{ x = 0, y = 1 }}, got {value!r}"]
    pair = isinstance(value, list) and len(value) == 2
    if kind == "slice" and not (pair and all(isinstance(end, int) for end in value)):
        return [f"{key}: expected the first frame and the first that is not used, got {value!r}"]
    return []


def _stem(path: str) -> str:
    """Return the name of a file without folder and ends: "a" for "/data/a.ome.tif"."""
    name = re.split(r"[\\/]", path.rstrip("/\\"))[-1]
    return re.sub(r"(\.(ome|csv|tsv|napari)){0,2}\.\w{1,8}$", "", name) or name


def _are_texts(value: object) -> bool:
    return isinstance(value, list) and all(isinstance(one, str) for one in value)
