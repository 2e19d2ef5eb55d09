"""Texts of a report to copy: methods paragraph, BibTeX entries; links to its files."""

from __future__ import annotations

from typing import TYPE_CHECKING

from perrin._text import interval_text, length_text, number_text, unit_text
from perrin.diffusion.estimate import value_text

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
        ("run.toml", "the options, a configuration that repeats the run"),
        ("figures/", "figures as PNG and PDF"),
    ]
    if report.imaging is not None:
        links.insert(0, ("quality.html", "imaging quality"))
    return links
