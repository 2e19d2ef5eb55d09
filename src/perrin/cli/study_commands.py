"""The commands of a study: new, run, report and plan."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from perrin.cli.messages import messages_of, output_console
from perrin.cli.options import OUTPUT, WORK, GroupedCommand, Json, Quiet
from perrin.cli.progress import shown_progress
from perrin.cli.tables import show_json

if TYPE_CHECKING:
    from perrin.study.study_results import StudyResult

study_app = typer.Typer(
    help="Measure many movies under several conditions, and their means.",
    no_args_is_help=True,
    rich_markup_mode=None,
)


@study_app.command("new", cls=GroupedCommand, epilog="perrin study new data/*.csv -o study.toml")
def new_study(
    files: Annotated[list[str], typer.Argument(help="Movies and track tables.")],
    output: Annotated[
        Path,
        typer.Option("-o", "--output", help="Manifest to write.", rich_help_panel=OUTPUT),
    ] = Path("study.toml"),
    overwrite: Annotated[
        bool,
        typer.Option("--overwrite", help="Replace an existing file.", rich_help_panel=OUTPUT),
    ] = False,
) -> None:
    """Write a manifest that lists the files, to be edited."""
    with messages_of(new_study):
        from perrin.study import manifest_text
        from perrin.tracks.writing import written_whole

        if output.exists() and not overwrite:
            raise FileExistsError(f"{output} exists: choose another name, or overwrite=True")
        text = manifest_text(files, folder=output.absolute().parent)
        with written_whole(output) as part:
            part.write_text(text, encoding="utf-8")
        print(f"{output} lists {len(files)} file{'s' * (len(files) != 1)}. State the conditions of")
        print(f"every sample in it, then: perrin study run {output} -o STUDY")


@study_app.command(
    "run",
    cls=GroupedCommand,
    epilog="""perrin study run study.toml -o STUDY --workers 8
    perrin study run study.toml -o STUDY --scheduler tcp://node7:8786""",
)
def run_study(
    manifest: Annotated[Path, typer.Argument(help="Manifest of the study: study.toml.")],
    output: Annotated[
        Path,
        typer.Option(
            "-o",
            "--output",
            help="Folder of the study; what is finished there is kept.",
            rich_help_panel=OUTPUT,
        ),
    ],
    workers: Annotated[
        int,
        typer.Option(min=0, help="Number of processes of this machine.", rich_help_panel=WORK),
    ] = 0,
    scheduler: Annotated[
        str | None,
        typer.Option(
            help="Address of a Dask scheduler that does the work: tcp://host:8786.",
            rich_help_panel=WORK,
        ),
    ] = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Measure every movie that is new or has changed, and write tables, figures and the page.

    After an interruption, or with more movies in the manifest, the same command does the rest.
    """
    with messages_of(run_study):
        from perrin.study import Study

        study = Study.from_toml(manifest)
        with shown_progress(quiet=quiet, unit="movies") as progress:
            result = study.run(
                output,
                workers=workers,
                scheduler=scheduler,
                progress=progress,
                command=shlex.join(["perrin", *sys.argv[1:]]),
            )
        _show(result, as_json=as_json, quiet=quiet)


@study_app.command("report", cls=GroupedCommand, epilog="perrin study report STUDY")
def report_study(
    folder: Annotated[Path, typer.Argument(help="Folder of a study.")],
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Write tables, figures and the page again from the finished movies, and print the means."""
    with messages_of(report_study):
        from perrin.run.lock import locked
        from perrin.study import StudyResult, write_results

        result = StudyResult.load(folder)
        with locked(folder):
            write_results(result, command=shlex.join(["perrin", *sys.argv[1:]]))
        _show(result, as_json=as_json, quiet=quiet)


@study_app.command(
    "plan",
    cls=GroupedCommand,
    epilog="perrin study plan --half-width 0.1 --clusters 10 --spread-clusters 0.2",
)
def plan_of_study(
    half_width: Annotated[
        float, typer.Option(help="Wanted half width of the 95 % interval over the mean.")
    ],
    clusters: Annotated[int, typer.Option(help="Number of clusters in a movie.")],
    spread_clusters: Annotated[
        float, typer.Option(help="Standard deviation of ln D between clusters: 0.2 for 20 %.")
    ],
    spread_movies: Annotated[
        float, typer.Option(help="Standard deviation of ln D between movies.")
    ] = 0.0,
    snr: Annotated[float, typer.Option(help="Signal-to-noise ratio of a step, D dt/s.")] = 20.0,
    frames: Annotated[int | None, typer.Option(help="Largest number of frames.")] = None,
    as_json: Json = False,
) -> None:
    """Recommend the numbers of movies and frames for the mean of a condition."""
    with messages_of(plan_of_study):
        from perrin.study import plan_study

        found = plan_study(
            half_width,
            n_clusters=clusters,
            spread_clusters=spread_clusters,
            spread_movies=spread_movies,
            snr=snr,
            most_frames=frames,
        )
        if as_json:
            show_json(found.to_dict())
            return
        print(found)
        print("movies, frames of each, half width:")
        for movies, n_frames, width in found.choices:
            print(f"{movies:6d} {n_frames:7d} {100 * width:7.2g} %")


def _show(result: StudyResult, *, as_json: bool, quiet: bool) -> None:
    """Print the means of a study, its summary.json, or nothing."""
    if as_json:
        show_json(result.to_dict())
        return
    if quiet:
        return
    from rich.markup import escape
    from rich.table import Table

    from perrin._text import interval_text

    console = output_console()
    done = len(result.entries) - len(result.failed)
    console.print(
        f"{escape(result.manifest.title)}: {done} of {len(result.manifest.movies)} movies measured"
    )
    table = Table(box=None, pad_edge=False)
    for name in ("bodies", "condition", "quantity", "mean", "95 %", "movies", "clusters"):
        table.add_column(name)
    for one in result.means:
        table.add_row(
            escape(one.body),
            escape(one.label),
            f"{one.quantity} ({one.mean.unit})",
            f"{one.mean.value:.3g}",
            interval_text(one.mean.ci95),
            f"{one.mean.n_movies}{' *' * (one.mean.scope != 'movies')}",
            str(one.mean.n_clusters),
        )
    console.print(table)
    if any(one.mean.scope != "movies" for one in result.means):
        console.print("* one movie: the interval holds for this movie, not for others")
    for entry in result.failed[:20]:
        console.print(f"failed: {escape(entry.name)}: {escape(entry.reason)}", soft_wrap=True)
    console.print(f"Written to {escape(str(result.folder))}: study.html, results.csv, runs/")
