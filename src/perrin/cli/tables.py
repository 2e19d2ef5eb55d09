"""Tables that the command line prints."""

from __future__ import annotations

from math import isfinite
from typing import TYPE_CHECKING

from perrin.cli.messages import escape, output_console

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from rich.console import Console
    from rich.table import Table

    from perrin.cli.diagnosis import Check
    from perrin.diffusion.estimate import DiffusionEstimate
    from perrin.diffusion.sampling import SamplingPlan
    from perrin.hydrodynamics.mobility import Mobility
    from perrin.run.predictions import Compared
    from perrin.run.results import BodyKind, ClusterResult, Pooled, Report


_CLUSTERS_SHOWN, _WARNINGS_SHOWN, _NOTES_SHOWN = 5, 20, 10

# Values about the body's axes are shown below this probability of equal axes.
_EQUAL_AXES = 0.05


def show_plan(plan: SamplingPlan) -> None:
    """Print the plan as a short table, and its reasons."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    from perrin._text import percent

    title = f"best: {plan.n_frames} frames every {plan.dt_best:.3g} s"
    names = ("noise:", "estimated (default)", "from residuals")
    table = Table(*names, title=title, title_justify="left", box=SIMPLE_HEAD)
    table.columns[0].no_wrap = True
    errors = percent(plan.expected_error), percent(plan.expected_error_residual)
    table.add_row("expected error of D_R", *errors)
    for share in (0.1, 0.03, 0.01):
        counts = (str(plan.frames_for(share, noise=noise)) for noise in ("joint", "residual"))
        table.add_row(f"frames needed for {100 * share:g} %", *counts)
    table.add_section()
    window = f"{plan.dt_min:.3g} to {plan.dt_max:.3g} s"
    table.add_row("window of dt", "empty" if plan.dt_min > plan.dt_max else window)
    table.add_row("the paper's rules", f"{plan.paper_dt_min:.3g} to {plan.paper_dt_max:.3g} s")
    table.add_row("signal to noise (SNR)", f"{plan.snr:.3g} at the best dt")
    table.add_row("noise floor (Phi^2)", f"{plan.phi2:.3g} rad^2")
    console = output_console()
    console.print(table)
    for reason in plan.reasons:
        console.print(f"- {escape(reason)}", soft_wrap=True)


def show_json(content: object) -> None:
    """Print a result as JSON, indented.

    Examples
    --------
    >>> show_json({"D_R": 0.005})
    {
      "D_R": 0.005
    }
    """
    import json

    from perrin._arrays import to_plain

    print(json.dumps(content, indent=2, allow_nan=False, default=to_plain, ensure_ascii=False))


def show_diagnosis(checks: Sequence[Check]) -> None:
    """Print the lines of a diagnosis, with a mark for each.

    Examples
    --------
    >>> from perrin.cli.diagnosis import Check
    >>> show_diagnosis([Check("numpy", "2.4"), Check("gsd", "not installed", None)])
    ok  numpy: 2.4
    -   gsd: not installed
    """
    marks = {True: "ok ", False: "BAD", None: "-  "}
    for check in checks:
        print(f"{marks[check.good]} {check.subject}: {check.state}")


def show_report(report: Report, output: Path, command: Callable[..., None]) -> None:
    """Print the short tables, the warnings, the notes, and where the run is written."""
    from perrin._text import counted
    from perrin.run.results import perp_text
    from perrin.run.statements import verdict_lines

    console = output_console()
    for result in report.clusters[:_CLUSTERS_SHOWN]:
        kind = report.kind_of(result.cluster) if len(report.kinds) > 1 else None
        console.print(cluster_table(result, kind=kind))
        if result.tensor is not None and result.tensor.p_isotropic < _EQUAL_AXES:
            axes = f"rotation about the body's axes: {result.tensor.summary}\n"
            console.print(escape(axes), soft_wrap=True)
    if len(report.clusters) > _CLUSTERS_SHOWN:
        rest = counted(len(report.clusters) - _CLUSTERS_SHOWN, "more cluster")
        console.print(f"and {rest} in report.html\n")
    for term in terms_of(report):
        console.print(escape(term), style="dim", soft_wrap=True)
    if report.pooled is not None and len(report.clusters) > 1:
        console.print(pooled_table(report.pooled))
    if report.pooled_by_kind:
        console.print(kinds_table(report))
    for rod in report.rods[:_CLUSTERS_SHOWN]:
        console.print(escape(perp_text(rod)))
        if rod.prediction is not None:
            console.print(escape(f"  {rod.prediction}"), soft_wrap=True)
    for texts in verdict_lines(report).values():
        console.print(escape(" ".join(texts)), soft_wrap=True)
    show_remarks(report, command, console)
    pages = "report.html" if report.imaging is None else "report.html, quality.html"
    console.print(f"Written to {escape(str(output))}: {pages}, figures, summary.json, tables.")


def terms_of(report: Report) -> list[str]:
    """Return what the terms in the tables of a report mean, one sentence each.

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> cluster = SimpleNamespace(prediction=None)
    >>> terms_of(SimpleNamespace(clusters=(cluster,), kinds=()))[0][:43]
    'Phi^2, the noise floor: the mean square tur'
    """
    terms = []
    if report.clusters:
        terms.append(
            "Phi^2, the noise floor: the mean square turn that noise alone shows between two frames"
        )
    if any(result.prediction is not None for result in report.clusters):
        terms.append("pull: measured minus predicted, in standard errors")
    if len(report.kinds) > 1:
        terms.append("T_d, D_3h, ...: the symmetry of the shape (its point group)")
    return terms


def show_remarks(report: Report, command: Callable[..., None], console: Console) -> None:
    """Print the warnings, then the notes, with those of several clusters in one line."""
    from perrin._text import counted
    from perrin.cli.messages import in_options, options_of
    from perrin.run.remarks import condensed, merged

    options = options_of(command)
    warnings = [
        *condensed(report.warnings),
        *merged({result.name: result.warnings for result in report.results}),
    ]
    notes = [
        *condensed(report.notes),
        *merged({result.name: result.notes for result in report.results}),
    ]
    for text in warnings[:_WARNINGS_SHOWN]:
        shown = escape(in_options(text, options))
        console.print(f"[bold yellow]! warning:[/] {shown}", soft_wrap=True)
    if len(warnings) > _WARNINGS_SHOWN:
        rest = counted(len(warnings) - _WARNINGS_SHOWN, "more warning")
        console.print(f"and {rest} in summary.json")
    for text in notes[:_NOTES_SHOWN]:
        console.print(f"note: {escape(in_options(text, options))}", style="dim", soft_wrap=True)
    if len(notes) > _NOTES_SHOWN:
        console.print(f"[dim]and {len(notes) - _NOTES_SHOWN} more notes in summary.json[/]")


def cluster_table(result: ClusterResult, *, kind: BodyKind | None = None) -> Table:
    """Return the short table of one cluster: coefficients, noise, sizes.

    Parameters
    ----------
    result : ClusterResult
    kind : BodyKind, optional
        Number of particles and shape for the title, where there are several kinds.
    """
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    from perrin._text import with_error

    # A name is the user's text: square brackets in it are no markup.
    shape = "" if kind is None else f"{kind.name}, "
    title = f"cluster {escape(result.name)}: {shape}{result.motion.fitted.size} frames"
    table = Table("", "value", "68 %", "95 %", title=title, title_justify="left", box=SIMPLE_HEAD)
    table.columns[0].no_wrap = True
    for name, estimate in (("D_R", result.D_R), ("D_T", result.D_T)):
        table.add_row(f"{name} ({estimate.unit})", *_estimate_cells(estimate))
    table.add_row("sigma (nm)", f"{1e3 * result.motion.sigma:.3g}")
    table.add_row("Phi^2 (rad^2)", f"{result.noise.phi2:.3g}", "predicted noise floor")
    measured = with_error(result.phi2_measured, result.phi2_stderr)
    table.add_row("", measured, "measured noise floor")
    sizes, prediction = result.sizes or {}, result.prediction
    for mode, name in (("translation", "D_T"), ("rotation", "D_R"), ("both", "both")):
        if mode in sizes:
            size = sizes[mode]
            table.add_row(f"sphere*, {name} (um)", with_error(size.sphere, size.sphere_stderr))
            if size.viscosity is not None and size.viscosity_stderr is not None:
                shown = with_error(1e3 * size.viscosity, 1e3 * size.viscosity_stderr)
                table.add_row("viscosity (mPa s)", shown, "from both")
    if prediction is not None:
        for name, compared, axes in (
            ("D_R", prediction.D_R, prediction.principal_D_R),
            ("D_T", prediction.D_T, prediction.principal_D_T),
        ):
            if compared is not None:
                shown = f"{compared.predicted:.4g}"
                table.add_row(f"{name}, predicted", shown, _pull_text(compared))
            for k, one in enumerate(axes, start=1):
                shown = f"measured {one.measured:.3g}"
                table.add_row(f"  axis {k}", f"{one.predicted:.4g}", _pull_text(one), shown)
    if result.sizes:
        table.caption = "* diameter, for equal spheres at the measured places"
        table.caption_justify = "left"
    return table


def _pull_text(compared: Compared) -> str:
    return f"pull {compared.pull:+.1f}" if isfinite(compared.pull) else "not resolved"


def show_prediction(body: Mobility, *, name: str) -> None:
    """Print the short table of a prediction."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    from perrin.diffusion.tensors import axes_like

    title = f"{escape(name)}, {len(body.radius)} spheres of {body.sphere_diameter:.4g} um"
    table = Table(
        "", "mean", "principal values", title=title, title_justify="left", box=SIMPLE_HEAD
    )
    table.columns[0].no_wrap = True
    turn, path = body.principal_D_R, body.principal_D_T
    same_axes = axes_like(path.axes, turn.axes)
    for label, values in (
        ("D_T (um^2/s)", path.values[same_axes]),
        ("D_R (rad^2/s)", turn.values),
    ):
        shown = ", ".join(f"{value:.5g}" for value in values)
        table.add_row(label, f"{values.mean():.5g}", shown)
    for mode, diameter, factor in (
        ("D_T", body.diameter_T, body.diameter_factor_T),
        ("D_R", body.diameter_R, body.diameter_factor_R),
    ):
        table.add_row(f"cluster diameter, {mode} (um)", f"{diameter:.4f}")
        table.add_row(f"over the sphere's, {mode}", f"{factor:.4f}")
    place = ", ".join(f"{round(x, 4) + 0.0:.4f}" for x in body.center - body.centroid)
    table.add_row("centre of diffusion* (um)", "", place)
    table.caption = (
        f"* from the centroid of the spheres. Relative error about {body.error:.1g} (degree "
        f"{body.degree})"
    )
    output_console().print(table)


def pooled_table(pooled: Pooled) -> Table:
    """Return the table of the values pooled over clusters."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    from perrin._text import counted

    count = len(pooled.clusters)
    title = f"{counted(count, 'cluster')} pooled"
    table = Table("", "value", "68 %", "95 %", title=title, title_justify="left", box=SIMPLE_HEAD)
    table.columns[0].no_wrap = True
    same = []
    for name, estimate in (("D_R", pooled.D_R), ("D_T", pooled.D_T)):
        table.add_row(f"{name} ({estimate.unit})", *_estimate_cells(estimate))
        same += [] if estimate.p_same is None else [f"{name} {estimate.p_same:.2g}"]
    if same:
        table.caption = f"chance of such a scatter about one value: {', '.join(same)}"
        table.caption_justify = "left"
    return table


def kinds_table(report: Report) -> Table:
    """Return the table of the pooled values of every kind of clusters, and of single spheres."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    title = "kinds of bodies, each pooled by itself"
    head = ("spheres", "bodies", "", "value", "95 %")
    table = Table(*head, title=title, title_justify="left", box=SIMPLE_HEAD)
    for column in table.columns:
        column.no_wrap = True
    rows = [
        ((f"{kind.size} {kind.point_group}", str(len(kind.clusters))), kind.coefficients)
        for kind in report.kinds
    ]
    if report.singles is not None:
        rows.append((("1", f"{report.singles.n_tracks} tracks"), [("D_T", report.singles.D_T)]))
    for names, coefficients in rows:
        shown = names
        for name, estimate in coefficients:
            value, _, interval = _estimate_cells(estimate)
            table.add_row(*shown, f"{name} ({estimate.unit})", value, interval)
            shown = ("", "")
        if not coefficients:
            table.add_row(*names, "", "not rigid: not pooled")
    return table


def _estimate_cells(estimate: DiffusionEstimate) -> tuple[str, str, str]:
    """Return value and intervals as text; an unresolved value is an upper limit."""
    from perrin._text import interval_text, with_error

    if estimate.absent_because is not None:
        return "none", estimate.absent_because, ""
    value = with_error(estimate.value, estimate.stderr)
    if not estimate.resolved:
        value = f"< {estimate.ci95[1]:.2g} (95 %)"
    return value, interval_text(estimate.ci68), interval_text(estimate.ci95)
