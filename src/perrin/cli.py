"""The command line: parse, call, print; no physics."""

from __future__ import annotations

import os
import sys
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rich.table import Table

    from perrin.diffusion import DiffusionEstimate
    from perrin.results import ClusterResult, Pooled, Report

app = typer.Typer(
    name="perrin",
    help="Measure how rigid clusters of colloidal particles diffuse and turn.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

_SHOWN, _SHOWN_WARNINGS = 5, 20
_SHAPES = ("tetrahedron", "pentahedron", "trimer")

Tracks = Annotated[Path, typer.Argument(help="Track table: .csv, .csv.gz, .parquet or .gdf.")]
Interval = Annotated[float, typer.Option("--dt", help="Time between frames, s.")]
Output = Annotated[Path, typer.Option("-o", "--output", help="Folder for the run.")]
Scale = Annotated[
    str, typer.Option(help="um per unit of the coordinates; one number or x,y,z, e.g. 1000 for mm.")
]
Columns = Annotated[
    str | None,
    typer.Option(help="Names or numbers of the file's columns: x=0,y=1,z=2,frame=-2,particle=-1."),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an existing run folder.")]


def main() -> None:
    """Run the command line; the entry point of ``perrin``."""
    app()


def _version(asked: bool) -> None:
    if asked:
        from perrin import __version__

        print(__version__)
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version.", callback=_version, is_eager=True)
    ] = False,
) -> None:
    pass


@app.command()
def demo(output: Output = Path("perrin-demo")) -> None:
    """Analyse an embedded table: one simulated tetrahedron under the paper's conditions."""
    from importlib.resources import as_file, files

    import perrin
    from perrin.results import check_place

    with _told(), as_file(files("perrin") / "data" / "demo_tracks.csv.gz") as path:
        check_place(output, overwrite=True)
        report = perrin.analyze(path, dt=0.73, viscosity=2.18e-3, temperature=295.0)
        perrin.write_run(report, output, overwrite=True)
        _show(report, output)
        print("Planted in the simulation: D_R = 0.00493 rad^2/s, D_T = 0.0385 um^2/s.")


@app.command()
def analyze(
    tracks: Tracks,
    dt: Interval,
    output: Output,
    scale: Scale = "1",
    columns: Columns = None,
    contact: Annotated[
        float | None,
        typer.Option(help="Centre distance of touching particles, um: finds the clusters."),
    ] = None,
    sigma: Annotated[
        str | None,
        typer.Option(
            help="Known localisation error, um, one number or x,y,z: for the predicted noise floor "
            "and the test of rigidity."
        ),
    ] = None,
    viscosity: Annotated[float | None, typer.Option(help="Pa s, for sizes.")] = None,
    temperature: Annotated[float | None, typer.Option(help="K, for sizes.")] = None,
    frames: Annotated[
        str | None, typer.Option(help="A:B uses the frames A <= frame < B; A or B may be left out.")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Measure D_R and D_T of every cluster in a track table."""
    import perrin
    from perrin.results import check_place

    with _told():
        check_place(output, overwrite=overwrite)
        report = perrin.analyze(
            tracks,
            dt=dt,
            scale=_numbers("--scale", scale),
            columns=_columns(columns),
            contact=contact,
            sigma=None if sigma is None else _numbers("--sigma", sigma),
            viscosity=viscosity,
            temperature=temperature,
            frames=_slice(frames),
        )
        perrin.write_run(report, output, overwrite=overwrite)
        _show(report, output)


@app.command()
def simulate(
    shape: Annotated[str, typer.Argument(help=f"{', '.join(_SHAPES)}.")],
    radius: Annotated[float, typer.Option(help="Mean distance of particles to the centre, um.")],
    d_r: Annotated[float, typer.Option("--d-r", help="D_R, rad^2/s.")],
    dt: Interval,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Track table: .csv, .csv.gz, .parquet or .gdf.")
    ],
    d_t: Annotated[float, typer.Option("--d-t", help="D_T, um^2/s.")] = 0.0,
    sigma: Annotated[str, typer.Option(help="Localisation error, um, one number or x,y,z.")] = "0",
    frames: Annotated[int, typer.Option(help="Number of frames.")] = 300,
    seed: Annotated[int, typer.Option(help="Seed of the random numbers.")] = 0,
) -> None:
    """Write the track table of one simulated Brownian cluster with localisation noise."""
    import numpy as np

    import perrin

    with _told():
        if shape not in _SHAPES:
            raise ValueError(f"shape: expected {', '.join(_SHAPES)}, got {shape!r}")
        rng = np.random.default_rng(seed)
        truth = perrin.simulate_motion(
            getattr(perrin.Cluster, shape)(radius),
            D_R=d_r,
            D_T=d_t,
            dt=dt,
            n_frames=frames,
            rng=rng,
        )
        positions = perrin.add_noise(truth.positions(), sigma=_numbers("--sigma", sigma), rng=rng)
        table = perrin.positions_table(positions)
        if output.suffix == ".gdf":  # a format without room for a cluster column
            table = table.drop(columns="cluster")
        perrin.write_tracks(table, output)
        print(f"{frames} frames of one {shape} written to {output}")


@app.command()
def paper(
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for figures and claims.")],
    seed: Annotated[int, typer.Option(help="Seed of the random numbers.")] = 2011,
    overwrite: Overwrite = False,
) -> None:
    """Remake every figure, table and claim of Hunter et al. 2011."""
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    from perrin.paper import reproduce
    from perrin.results import check_place

    console = Console(highlight=False)
    columns = BarColumn(), TextColumn("{task.completed}/{task.total}"), TimeElapsedColumn()
    bar = Progress(*columns, TextColumn("{task.description}"), console=console)
    with _told():
        check_place(output, overwrite=overwrite)
        with bar:
            task = bar.add_task("starting", total=None)
            claims = reproduce(
                output,
                seed=seed,
                overwrite=overwrite,
                progress=lambda done, total, title: bar.update(
                    task, completed=done, total=total, description=escape(title)
                ),
            )
        failing = [claim for claim in claims if not claim.holds]
        console.print(f"{len(claims)} claims, {len(failing)} of them do not hold:")
        for claim in failing:
            told = escape(claim.remark or claim.claim)
            console.print(f"- {escape(claim.source)}: {told}", soft_wrap=True)
        console.print(f"Written to {escape(str(output))}: claims.md, figures, tables.")


@app.command()
def convert(
    source: Annotated[Path, typer.Argument(help="Track table to read.")],
    target: Annotated[Path, typer.Argument(help="Track table to write, kind by its suffix.")],
    scale: Scale = "1",
    columns: Columns = None,
) -> None:
    """Convert a track table between .csv, .csv.gz, .parquet and .gdf."""
    import perrin

    with _told():
        table = perrin.read_tracks(
            source, scale=_numbers("--scale", scale), columns=_columns(columns)
        )
        perrin.write_tracks(table, target)
        print(f"{len(table)} rows written to {target}")


@contextmanager
def _told() -> Iterator[None]:
    """Say an error in one line; exit status 1: the data cannot answer, 2: the input is wrong."""
    from perrin import DegenerateClusterError, TooFewFramesError

    try:
        yield
    except BrokenPipeError:
        # The reader has gone (a pipe into head); the run itself is written. Python's own flush at
        # the end would complain again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (ValueError, OSError) as error:
        print(f"perrin: {_one_line(error)}", file=sys.stderr)
        unanswerable = isinstance(error, DegenerateClusterError | TooFewFramesError)
        raise typer.Exit(1 if unanswerable else 2) from None


def _one_line(error: Exception) -> str:
    """Return an error's message on one line, the system's with the file first."""
    if isinstance(error, OSError) and error.strerror and error.filename:
        return f"{error.filename}: {error.strerror}"
    return "; ".join(line.strip().removeprefix("- ") for line in str(error).splitlines())


def _numbers(option: str, text: str) -> float | list[float]:
    """Read one number, or several separated by commas."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        raise ValueError(f"{option}: expected a number or x,y,z, got {text!r}") from None
    return values[0] if len(values) == 1 else values


def _columns(text: str | None) -> dict[str, str | int] | None:
    """Read name=column pairs; a column that is a whole number is a position."""
    if text is None:
        return None
    pairs = [part.partition("=") for part in text.split(",")]
    if not all(name and column for name, _, column in pairs):
        raise ValueError(f"--columns: expected pairs like x=0,y=1,frame=-2, got {text!r}")

    def place(column: str) -> str | int:
        return int(column) if column.lstrip("-").isdecimal() else column

    return {name.strip(): place(column.strip()) for name, _, column in pairs}


def _slice(text: str | None) -> tuple[int | None, int | None] | None:
    """Read A:B."""
    if text is None:
        return None
    first, colon, stop = text.partition(":")
    try:
        ends = [int(end) if end.strip() else None for end in (first, stop)]
    except ValueError:
        ends = []
    if not colon or not ends:
        raise ValueError(f"--frames: expected A:B with whole numbers, got {text!r}")
    return ends[0], ends[1]


def _show(report: Report, output: Path) -> None:
    """Print the short tables, the warnings, and where the rest is."""
    from rich.console import Console
    from rich.markup import escape

    from perrin.results import perp_text

    console = Console(highlight=False)
    for result in report.clusters[:_SHOWN]:
        console.print(_cluster_table(result))
    if report.pooled is not None and len(report.clusters) > 1:
        console.print(_pooled_table(report.pooled))
    for rod in report.rods[:_SHOWN]:
        console.print(escape(perp_text(rod)))
    told = [("", text) for text in report.warnings]
    told += [(f", cluster {r.name}", text) for r in report.results for text in r.warnings]
    for where, text in told[:_SHOWN_WARNINGS]:
        console.print(f"[yellow]warning{escape(where)}:[/] {escape(text)}", soft_wrap=True)
    if len(told) > _SHOWN_WARNINGS:
        console.print(f"and {len(told) - _SHOWN_WARNINGS} more warnings in summary.json")
    console.print(f"Written to {escape(str(output))}: report.html, figures, summary.json, tables.")


def _cluster_table(result: ClusterResult) -> Table:
    """Return the short table of one cluster: coefficients, noise, sizes."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    from perrin.diffusion import with_error

    title = f"cluster {result.name}: {result.motion.fitted.size} frames"
    table = Table("", "value", "68 %", "95 %", title=title, title_justify="left", box=SIMPLE_HEAD)
    table.columns[0].no_wrap = True
    for name, estimate in (("D_R", result.D_R), ("D_T", result.D_T)):
        table.add_row(f"{name} ({estimate.unit})", *_estimate_cells(estimate))
    table.add_row("sigma (nm)", f"{1e3 * result.motion.sigma:.3g}")
    table.add_row("Phi^2 (rad^2)", f"{result.noise.phi2:.3g}", "predicted noise floor")
    measured = with_error(result.phi2_measured, result.phi2_stderr)
    table.add_row("", measured, "measured noise floor")
    for mode, name in (("translation", "D_T"), ("rotation", "D_R")):
        if result.sizes:
            size = result.sizes[mode]
            shown = with_error(size.sphere, size.sphere_stderr)
            table.add_row(f"sphere, {name} (um)*", shown)
    if result.sizes:
        table.caption = "* with the paper's factor 1.844 (Hoffmann 2009)"
    return table


def _pooled_table(pooled: Pooled) -> Table:
    """Return the table of the values pooled over clusters."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    count = len(pooled.clusters)
    title = f"{count} clusters pooled"
    table = Table("", "value", "68 %", "95 %", title=title, title_justify="left", box=SIMPLE_HEAD)
    table.columns[0].no_wrap = True
    for name, estimate in (("D_R", pooled.D_R), ("D_T", pooled.D_T)):
        table.add_row(f"{name} ({estimate.unit})", *_estimate_cells(estimate))
    return table


def _estimate_cells(estimate: DiffusionEstimate) -> tuple[str, str, str]:
    """Return value and intervals as text; an unresolved value is an upper limit."""
    from perrin.diffusion import with_error

    value = with_error(estimate.value, estimate.stderr)
    if not estimate.resolved:
        value = f"< {estimate.ci95[1]:.2g} (95 %)"
    (low68, high68), (low95, high95) = estimate.ci68, estimate.ci95
    return value, f"{low68:.3g} to {high68:.3g}", f"{low95:.3g} to {high95:.3g}"


if __name__ == "__main__":
    main()
