"""Texts of a report to copy: methods paragraph, BibTeX entries, and what repeats the run."""

from __future__ import annotations

import inspect
import shlex
from typing import TYPE_CHECKING, Any

from perrin._text import interval_text, length_text, number_text, unit_text
from perrin.diffusion.estimate import value_text
from perrin.run.tables import analyze

if TYPE_CHECKING:
    from perrin.diffusion.estimate import DiffusionEstimate
    from perrin.run.results import Report

PAPER_BIBTEX = """@article{Hunter2011,
  author  = {Hunter, Gary L. and Edmond, Kazem V. and Elsesser, Mark T. and Weeks, Eric R.},
  title   = {Tracking rotational diffusion of colloidal clusters},
  journal = {Optics Express},
  volume  = {19},
  number  = {18},
  pages   = {17189--17202},
  year    = {2011},
  doi     = {10.1364/OE.19.017189}
}"""

# Arguments of the command line that are flags, and those of a movie.
_FLAGS = ("drift", "keep_jumps")
_MOVIE_ARGUMENTS = ("diameter", "contact", "exposure", "viscosity", "temperature", "drift")


def software_bibtex(version: str) -> str:
    """Return the BibTeX entry of perrin.

    Parameters
    ----------
    version : str

    Examples
    --------
    >>> software_bibtex("1.2.0").splitlines()[0]
    '@software{perrin,'
    """
    return (
        "@software{perrin,\n"
        "  author  = {{The perrin developers}},\n"
        "  title   = {perrin: rotational diffusion of colloidal clusters},\n"
        f"  version = {{{version}}}\n"
        "}"
    )


def methods_paragraph(report: Report) -> str:
    """Return how the numbers of a run were obtained, with its numbers, for a methods section.

    Parameters
    ----------
    report : Report

    Returns
    -------
    str
        Plain text; empty without a rigid cluster.

    Examples
    --------
    >>> import perrin
    >>> from importlib.resources import files
    >>> report = perrin.analyze(str(files("perrin") / "data" / "demo_tracks.csv.gz"), dt=0.73)
    >>> methods_paragraph(report)[:61]
    'The position and orientation of 1 rigid cluster of 4 particle'
    """
    if not report.clusters:
        return ""
    version = report.settings.get("versions", {}).get("perrin", "")
    sizes = sorted({len(c.motion.template) for c in report.clusters})
    frames = [int(c.motion.fitted.size) for c in report.clusters]
    count = len(report.clusters)
    particles = f"{sizes[0]}" if len(sizes) == 1 else f"{sizes[0]} to {sizes[-1]}"
    taken = f"{min(frames)}" if min(frames) == max(frames) else f"{min(frames)} to {max(frames)}"
    sigma = [c.motion.sigma for c in report.clusters]
    first = report.clusters[0]
    noise = {
        "joint": "with the variance of the noise free",
        "residual": "with the variance of the noise known from the residuals of the fits",
    }.get(first.D_R.settings.text, f"with a known localisation error of {first.D_R.settings.text}")
    named = f"perrin {version}".strip()
    text = (
        f"The position and orientation of {count} rigid cluster{'s' * (count != 1)} of {particles} "
        f"particles were measured in {taken} frames, {first.motion.dt:g} s apart, with {named}, "
        "which follows Hunter et al. (2011): one rigid shape, common to all frames, was fitted to "
        "the particle positions of each frame. The residuals of the fits give a localisation error "
        f"of {length_text(sum(sigma) / count)} per coordinate. Diffusion coefficients are maximum-"
        "likelihood estimates from the rotation vectors in the body frame and the displacements "
        f"between neighbouring frames, {noise}; intervals are those of the profile likelihood."
    )
    source = report.pooled or first
    values = [
        f"{name} = {value_text(one)} (95 % interval {_interval(one)})"
        for name, one in (("D_R", source.D_R), ("D_T", source.D_T))
        if one.absent_because is None and one.resolved
    ]
    if values and report.pooled is not None:
        text += f" The result is {' and '.join(values)}"
        text += f", pooled over {len(report.pooled.clusters)} clusters." if count > 1 else "."
    same = None if report.pooled is None else report.pooled.D_R.p_same
    if same is not None and count > 1:
        text += f" Equal values of D_R would scatter as much with probability {number_text(same)}."
    return text


def _interval(estimate: DiffusionEstimate) -> str:
    """Return the 95 % interval with its unit."""
    return f"{interval_text(estimate.ci95)} {unit_text(estimate.unit)}"


def command_line(report: Report) -> str:
    """Return the command that repeats a run.

    Parameters
    ----------
    report : Report

    Returns
    -------
    str
        A line for a shell; empty if the input was not a file.

    Examples
    --------
    >>> import perrin
    >>> from importlib.resources import files
    >>> report = perrin.analyze(str(files("perrin") / "data" / "demo_tracks.csv.gz"), dt=0.73)
    >>> command_line(report).split()[-4:]
    ['--dt', '0.73', '-o', 'my-run']
    """
    path = report.settings.get("input", {}).get("path")
    if not path:
        return ""
    movie = report.imaging is not None
    words = ["perrin", "run" if movie else "analyze", shlex.quote(str(path))]
    for name, value in _stated(report).items():
        option = f"--{name.replace('_', '-')}"
        if name in _FLAGS:
            words.append(option)
        elif name == "frames":
            words += [option, ":".join("" if end is None else str(end) for end in value)]
        elif name == "columns":
            words += [option, shlex.quote(",".join(f"{k}={v}" for k, v in value.items()))]
        elif isinstance(value, list | tuple):
            words += [option, ",".join(map(str, value))]
        else:
            words += [option, str(value)]
    return " ".join([*words, "-o", "my-run"])


def python_lines(report: Report) -> str:
    """Return the Python lines that repeat a run.

    Parameters
    ----------
    report : Report

    Examples
    --------
    >>> import perrin
    >>> from importlib.resources import files
    >>> report = perrin.analyze(str(files("perrin") / "data" / "demo_tracks.csv.gz"), dt=0.73)
    >>> print(python_lines(report).splitlines()[0])
    import perrin
    """
    path = report.settings.get("input", {}).get("path")
    stated = _stated(report)
    lines = ["import perrin", ""]
    if report.imaging is not None:
        lines.append(f"stack = perrin.open_stack({path!r})")
        source, function = "stack", "analyze_stack"
    else:
        source = "table" if path is None else repr(str(path))
        function = "analyze"
    given = "".join(f", {name}={value!r}" for name, value in stated.items())
    lines.append(f"report = perrin.{function}({source}{given})")
    lines += ["print(report)", 'report.to_frame().to_csv("results.csv")']
    return "\n".join(lines)


def _stated(report: Report) -> dict[str, Any]:
    """Return the arguments of a run that differ from the defaults."""
    defaults = {
        name: parameter.default for name, parameter in inspect.signature(analyze).parameters.items()
    }
    given = report.settings.get("arguments", {})
    names = _MOVIE_ARGUMENTS if report.imaging is not None else tuple(defaults)
    return {
        name: given[name]
        for name in names
        if name in given and given[name] is not None and given[name] != defaults.get(name)
    }


def folder_links(report: Report) -> list[tuple[str, str]]:
    """Return the files of a run folder and what they contain.

    Parameters
    ----------
    report : Report

    Returns
    -------
    list of tuple of str
        Name relative to the folder, and content.

    Examples
    --------
    >>> import perrin
    >>> from importlib.resources import files
    >>> report = perrin.analyze(str(files("perrin") / "data" / "demo_tracks.csv.gz"), dt=0.73)
    >>> folder_links(report)[0][0]
    'results.csv'
    """
    links = [
        ("results.csv", "all numbers, a row for each cluster and quantity"),
        ("curves.csv", "MSD and MSAD of every cluster at every lag time"),
        ("summary.json", "all results, for programs"),
        ("motion.parquet", "position and orientation of every cluster in every frame"),
        ("tracks.parquet", "the particle positions that were used"),
        ("run.json", "arguments, versions and the input's SHA-256"),
        ("figures/", "figures as PNG and PDF"),
    ]
    if report.imaging is not None:
        links.insert(0, ("quality.html", "imaging quality"))
    return links
