"""The commands: parse, call, print; no physics."""

from __future__ import annotations

import os
import re
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from perrin.cli.messages import messages_of, state_kept_frames
from perrin.cli.options import (
    INPUT,
    OUTPUT,
    PICTURE_SUFFIXES,
    SHAPES,
    SIZES,
    SPHERES,
    TOUCHING_SHAPES,
    WORK,
    Columns,
    Drift,
    Dynamics,
    Exposure,
    Frames,
    GroupedCommand,
    Interval,
    KeepJumps,
    Model,
    Noise,
    Output,
    Overwrite,
    OverwriteFile,
    Scale,
    Seed,
    Shape,
    Sigma,
    Temperature,
    Tracks,
    Viscosity,
    body_of,
    read_columns,
    read_dynamics,
    read_model,
    read_noise,
    read_numbers,
    read_optics,
    read_refine,
    read_slice,
    read_whole_numbers,
    spheres_of,
)
from perrin.cli.tables import show_plan, show_prediction, show_report

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rich.progress import TaskID


app = typer.Typer(
    name="perrin",
    help="Measure how rigid clusters of colloidal particles diffuse and turn.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    # Plain help: the formatted one imports a Markdown parser, a third of the time of `--help`.
    rich_markup_mode=None,
)

# Default folder of the demo, and the files that it writes there, by which it is recognised.
_DEMO_FOLDER = "perrin-demo"

_DEMO_NOTE = (
    "the planted D_R and D_T are those that Hunter et al. measured; they are below the prediction "
    "for spheres of 2.45 um, as the sizes that follow from them, 2.9(4) and 2.72(9) um, are above it"
)

_DEMO_FILES = re.compile(
    r"summary\.json|run\.json|report\.html|(?:curves|results|demo-tracks)\.csv"
    r"|(?:tracks|motion)\.parquet"
    r"|figures|figures/cluster-0-\w+\.(?:png|pdf)"
)


def main() -> None:
    """Run the command line; the entry point of ``perrin``."""
    app()


def _print_version(wanted: bool) -> None:
    if wanted:
        from perrin import __version__

        print(__version__)
        raise typer.Exit


@app.callback()
def common_options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", help="Print the version.", callback=_print_version, is_eager=True
        ),
    ] = False,
) -> None:
    """Measure how rigid clusters of colloidal particles diffuse and turn."""


@app.command()
def demo(
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            help=f"Folder for the run; {_DEMO_FOLDER} if left out, replaced if a demo's.",
        ),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Analyse an embedded table: one simulated tetrahedron under the paper's conditions."""
    import gzip
    from dataclasses import replace
    from importlib.resources import as_file, files

    import perrin
    from perrin.run.folders import check_place

    with messages_of(demo), as_file(files("perrin") / "data" / "demo_tracks.csv.gz") as path:
        place = output or Path(_DEMO_FOLDER)
        if output is None and place.exists() and not overwrite:
            check_demo_folder(place)
            overwrite = True
        check_place(place, overwrite=overwrite)
        report = perrin.analyze(path, dt=0.73, viscosity=2.18e-3, temperature=295.0, diameter=2.45)
        report = replace(
            report,
            settings=report.settings | {"made": "demo"},
            notes=(*report.notes, _DEMO_NOTE),
        )
        perrin.write_run(report, place, overwrite=overwrite)
        (place / "demo-tracks.csv").write_bytes(gzip.decompress(path.read_bytes()))
        show_report(report, place, demo)
        print("Planted in the simulation: D_R = 0.00493 rad^2/s, D_T = 0.0385 um^2/s.")


@app.command(cls=GroupedCommand)
def analyze(
    tracks: Tracks,
    dt: Interval,
    output: Output,
    scale: Scale = "1",
    columns: Columns = None,
    frames: Frames = None,
    contact: Annotated[
        float | None,
        typer.Option(
            help="Centre distance of touching particles, um: finds the clusters.",
            rich_help_panel=INPUT,
        ),
    ] = None,
    sigma: Sigma = None,
    noise: Noise = "joint",
    exposure: Exposure = None,
    drift: Drift = False,
    keep_jumps: KeepJumps = False,
    model: Model = None,
    viscosity: Viscosity = None,
    temperature: Temperature = None,
    diameter: Annotated[
        float | None,
        typer.Option(
            help="Sphere diameter, um: predicted D_T and D_R, to compare with the measured ones.",
            rich_help_panel=SIZES,
        ),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Measure D_R and D_T of every cluster in a track table."""
    import perrin
    from perrin.run.folders import check_place

    with messages_of(analyze):
        check_place(output, overwrite=overwrite)
        report = perrin.analyze(
            tracks,
            dt=dt,
            scale=read_numbers("--scale", scale),
            columns=read_columns(columns),
            contact=contact,
            sigma=None if sigma is None else read_numbers("--sigma", sigma),
            noise=read_noise(noise),
            exposure=exposure,
            drift=drift,
            keep_jumps=keep_jumps,
            model=read_model(model),
            viscosity=viscosity,
            temperature=temperature,
            diameter=diameter,
            frames=read_slice(frames),
        )
        perrin.write_run(report, output, overwrite=overwrite)
        show_report(report, output, analyze)


@app.command(cls=GroupedCommand)
def run(
    stack: Annotated[
        Path, typer.Argument(help="Movie of stacks: TIFF, OME-TIFF, .lif, .nd2, .czi, .ims, .zarr.")
    ],
    diameter: Annotated[
        float,
        typer.Option(help="Diameter of the fluorescent sphere, um.", rich_help_panel=SPHERES),
    ],
    contact: Annotated[
        float,
        typer.Option(help="Centre distance of touching spheres, um.", rich_help_panel=SPHERES),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "-o",
            "--output",
            help="Folder for the run; a run that was stopped is resumed.",
            rich_help_panel=OUTPUT,
        ),
    ],
    voxel: Annotated[
        str | None,
        typer.Option(
            help="Voxel size z,y,x (y,x in the plane), um, if not in the file.",
            rich_help_panel=INPUT,
        ),
    ] = None,
    dt: Annotated[
        float | None,
        typer.Option(
            "--dt", help="Time between frames, s, if not in the file.", rich_help_panel=INPUT
        ),
    ] = None,
    plane_time: Annotated[
        float | None,
        typer.Option(
            help="Time from one plane to the next, s; negative where the last plane is recorded "
            "first.",
            rich_help_panel=INPUT,
        ),
    ] = None,
    planes: Annotated[
        int | None,
        typer.Option(
            help="Number of planes of a frame, if not in the file.", rich_help_panel=INPUT
        ),
    ] = None,
    channel: Annotated[
        str | None,
        typer.Option(
            help="Number of the channel, from 0; several are summed: 0,1.", rich_help_panel=INPUT
        ),
    ] = None,
    image: Annotated[
        str | None,
        typer.Option(
            help="Image of a file with several, by number or name.", rich_help_panel=INPUT
        ),
    ] = None,
    frames: Frames = None,
    size: Annotated[
        str | None,
        typer.Option(
            help="Number of spheres of the clusters to measure: 4, or 3,4; all if left out.",
            rich_help_panel=SPHERES,
        ),
    ] = None,
    exclude: Annotated[
        str | None,
        typer.Option(help="Clusters to leave out, by number: 3,7.", rich_help_panel=SPHERES),
    ] = None,
    refine: Annotated[
        str,
        typer.Option(
            help="model: fit the image; trackpy: its disc model; none: places as found.",
            rich_help_panel=SPHERES,
        ),
    ] = "model",
    dark: Annotated[
        bool,
        typer.Option(
            "--dark",
            help="Spheres are darker than the background.",
            rich_help_panel=SPHERES,
        ),
    ] = False,
    minmass: Annotated[
        float | None,
        typer.Option(
            help="Least mass of a sphere; in the widest gap of the masses if left out.",
            rich_help_panel=SPHERES,
        ),
    ] = None,
    percentile: Annotated[
        float,
        typer.Option(
            help="Percentage of the voxels that are too dim for the middle of a sphere; lower it "
            "for fields full of spheres.",
            rich_help_panel=SPHERES,
        ),
    ] = 95.0,
    optics: Annotated[
        str | None,
        typer.Option(
            help="Image of a sphere, learned if left out: diameter,psf_z,psf (um), and gain,floor "
            "of the noise (variance of a voxel: gain times its intensity plus floor).",
            rich_help_panel=SPHERES,
        ),
    ] = None,
    noise: Noise = "joint",
    exposure: Exposure = None,
    drift: Drift = False,
    keep_jumps: KeepJumps = False,
    model: Model = None,
    viscosity: Viscosity = None,
    temperature: Temperature = None,
    workers: Annotated[
        int,
        typer.Option(
            min=0,
            help="Number of processes of this machine that share the work.",
            rich_help_panel=WORK,
        ),
    ] = 0,
    scheduler: Annotated[
        str | None,
        typer.Option(
            help="Address of a Dask scheduler that does the work: tcp://host:8786.",
            rich_help_panel=WORK,
        ),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Measure D_R and D_T of every cluster in a movie of image stacks.

    Finished frames are kept in the output folder: after an interruption the same command resumes.
    """
    import perrin
    from perrin.report.write import complete_run
    from perrin.run.folders import check_resumable

    with messages_of(run), state_kept_frames(output):
        check_resumable(output, parts="located", overwrite=overwrite)
        channels = read_whole_numbers("--channel", channel)
        movie = perrin.open_stack(
            stack,
            voxel=None if voxel is None else read_numbers("--voxel", voxel),
            dt=dt,
            plane_time=plane_time,
            planes=planes,
            channel=channels[0] if len(channels) == 1 else channels or None,
            image=int(image) if image is not None and image.isdecimal() else image,
        )
        with movie, progress_bar() as progress:
            report = perrin.analyze_stack(
                movie,
                diameter=diameter,
                contact=contact,
                size=read_whole_numbers("--size", size) or None,
                frames=read_slice(frames),
                exclude=read_whole_numbers("--exclude", exclude),
                refine=read_refine(refine),
                optics=read_optics(optics),
                dark=dark,
                minmass=minmass,
                percentile=percentile,
                noise=read_noise(noise),
                exposure=exposure,
                drift=drift,
                keep_jumps=keep_jumps,
                model=read_model(model),
                viscosity=viscosity,
                temperature=temperature,
                keep=output,
                anew=overwrite,
                workers=workers,
                scheduler=scheduler,
                progress=progress,
            )
            progress(0, 0, "writing the report")
            complete_run(report, output)
        show_report(report, output, run)


@contextmanager
def progress_bar() -> Iterator[Callable[[int, int, str], None]]:
    """Give a function that shows progress, rate and remaining time of the work."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[count]}"),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True, highlight=False)) as bar:
        tasks: dict[str, TaskID] = {}

        def show(done: int, total: int, title: str) -> None:
            if title not in tasks:
                for task in bar.tasks:  # earlier tasks are done
                    bar.update(task.id, total=task.total or 1, completed=task.total or 1)
                tasks[title] = bar.add_task(
                    title, total=total or None, completed=done, count="", rate=""
                )
            task = bar.tasks[tasks[title]]
            rate = f"{task.speed:.2g} frames/s" if task.speed else ""
            count = f"{done}/{total}" if total else ""
            bar.update(task.id, completed=done, total=total or None, count=count, rate=rate)

        yield show


@app.command()
def simulate(
    shape: Shape,
    radius: Annotated[float, typer.Option(help="Mean distance of particles to the centre, um.")],
    d_r: Annotated[float, typer.Option("--d-r", help="D_R, rad^2/s.")],
    dt: Interval,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Track table: .csv, .csv.gz, .parquet or .gdf.")
    ],
    d_t: Annotated[float, typer.Option("--d-t", help="D_T, um^2/s.")] = 0.0,
    sigma: Annotated[str, typer.Option(help="Localisation error, um, one number or x,y,z.")] = "0",
    frames: Annotated[int, typer.Option(help="Number of frames.")] = 300,
    dynamics: Dynamics = None,
    seed: Seed = 0,
    overwrite: OverwriteFile = False,
) -> None:
    """Write the track table of one simulated cluster, Brownian by default, with noise."""
    import numpy as np

    import perrin
    from perrin.tracks.formats import SUFFIXES

    with messages_of(simulate):
        check_new_file(output, SUFFIXES, overwrite=overwrite)
        if shape not in SHAPES:
            raise ValueError(f"shape: expected {', '.join(SHAPES)}, got {shape!r}")
        rng = np.random.default_rng(seed)
        truth = perrin.simulate_motion(
            getattr(perrin.Cluster, shape)(radius),
            D_R=d_r,
            D_T=d_t,
            dt=dt,
            n_frames=frames,
            dynamics=read_dynamics(dynamics),
            rng=rng,
        )
        positions = perrin.add_noise(
            truth.positions(), sigma=read_numbers("--sigma", sigma), rng=rng
        )
        table = perrin.positions_table(positions)
        if output.suffix.lower() == ".gdf":  # a format without a cluster column
            table = table.drop(columns="cluster")
        perrin.write_tracks(table, output)
        print(f"{frames} frames of one {shape} written to {output}")


@app.command()
def predict(
    viscosity: Annotated[float, typer.Option(help="Viscosity, Pa s.")],
    temperature: Annotated[float, typer.Option(help="Temperature, K.")],
    shape: Annotated[
        str | None, typer.Argument(help=f"Touching spheres: {', '.join(TOUCHING_SHAPES)}.")
    ] = None,
    diameter: Annotated[float | None, typer.Option(help="Sphere diameter, um.")] = None,
    positions: Annotated[
        Path | None,
        typer.Option(
            help="Sphere centres of another body: csv with the columns x,y,z (um) and, if the "
            "radii differ, radius (um)."
        ),
    ] = None,
    accuracy: Annotated[float, typer.Option(help="Largest relative numerical error.")] = 1e-4,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="JSON file of the results.")
    ] = None,
    overwrite: OverwriteFile = False,
) -> None:
    """Predict D_T, D_R and hydrodynamic diameters of a rigid cluster of spheres."""
    import warnings

    import numpy as np

    import perrin
    from perrin.hydrodynamics.units import length_remarks
    from perrin.tracks.writing import write_json

    with messages_of(predict):
        if output is not None:
            check_new_file(output, overwrite=overwrite)
        centers, radius = spheres_of(shape, diameter=diameter, positions=positions)
        for remark in length_remarks("the diameter of a sphere", 2 * np.asarray(radius).mean()):
            warnings.warn(remark, perrin.UnitWarning, stacklevel=2)
        body = perrin.cluster_mobility(
            centers,
            radius=radius,
            viscosity=viscosity,
            temperature=temperature,
            accuracy=accuracy,
        )
        if output is not None:
            write_json(output, body.to_dict())
        show_prediction(body, name=shape or str(positions))
        if output is not None:
            print(f"Written to {output}")


@app.command()
def plan(
    shape: Shape,
    d_r: Annotated[float, typer.Option("--d-r", help="Expected D_R, rad^2/s.")],
    sigma: Annotated[str, typer.Option(help="Localisation error, um, one number or x,y,z.")],
    radius: Annotated[
        float | None, typer.Option(help="Mean distance of particles to the centre, um.")
    ] = None,
    diameter: Annotated[
        float | None, typer.Option(help="Diameter of touching spheres, um, instead of --radius.")
    ] = None,
    d_t: Annotated[
        float | None,
        typer.Option(
            "--d-t", help="Expected D_T, um^2/s; displacements between frames then limit dt too."
        ),
    ] = None,
    frames: Annotated[int | None, typer.Option(help="Largest number of frames.")] = None,
    time: Annotated[float | None, typer.Option(help="Longest duration of the movie, s.")] = None,
    photons: Annotated[
        bool,
        typer.Option(
            "--photons",
            help="The number of photons is fixed: that of --frames frames in --time s with "
            "--sigma. The plan divides them among any number of frames.",
        ),
    ] = False,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="Figure of the error against dt: .png, .pdf or .svg."),
    ] = None,
    overwrite: OverwriteFile = False,
) -> None:
    """Recommend the time between frames and their number, and predict the error of D_R."""
    import perrin

    with messages_of(plan):
        if output is not None:
            check_new_file(output, PICTURE_SUFFIXES, overwrite=overwrite)
        found = perrin.plan_sampling(
            body_of(shape, radius=radius, diameter=diameter),
            D_R=d_r,
            sigma=read_numbers("--sigma", sigma),
            D_T=d_t,
            n_frames=frames,
            total_time=time,
            photons=photons,
        )
        show_plan(found)
        if output is not None:
            from perrin.plot.results import plot_plan
            from perrin.plot.style import new_figure

            figure = new_figure(7, 4.6)
            plot_plan(found, ax=figure.add_subplot())
            figure.savefig(output, dpi=150)
            print(f"Written to {output}")


@app.command()
def paper(
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for figures and claims.")],
    seed: Seed = 2011,
    overwrite: Overwrite = False,
) -> None:
    """Reproduce all figures, tables and claims of the paper (Hunter 2011)."""
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    from perrin.paper.remake import reproduce
    from perrin.run.folders import check_place

    console = Console(highlight=False)
    columns = BarColumn(), TextColumn("{task.completed}/{task.total}"), TimeElapsedColumn()
    bar = Progress(*columns, TextColumn("{task.description}"), console=console)
    with messages_of(paper):
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
            remark = escape(claim.remark or claim.claim)
            console.print(f"- {escape(claim.source)}: {remark}", soft_wrap=True)
        console.print(f"Written to {escape(str(output))}: claims.md, figures, tables.")


@app.command()
def convert(
    source: Annotated[Path, typer.Argument(help="Track table to read.")],
    target: Annotated[
        Path, typer.Argument(help="Track table to write; its suffix states the format.")
    ],
    scale: Scale = "1",
    columns: Columns = None,
    overwrite: OverwriteFile = False,
) -> None:
    """Convert a track table between .csv, .csv.gz, .parquet and .gdf."""
    import perrin
    from perrin.tracks.formats import SUFFIXES

    with messages_of(convert):
        check_new_file(target, SUFFIXES, overwrite=overwrite)
        table = perrin.read_tracks(
            source, scale=read_numbers("--scale", scale), columns=read_columns(columns)
        )
        perrin.write_tracks(table, target)
        for note in table.attrs.get("notes", ()):
            print(f"note: {note}")
        print(f"{len(table)} rows written to {target}")


def check_new_file(path: Path, endings: tuple[str, ...] = (), *, overwrite: bool) -> None:
    """Refuse, before any work is done, a file that cannot or must not be written.

    Parameters
    ----------
    path : Path
    endings : tuple of str
        Endings of which the name must have one; none: any name.
    overwrite : bool
        Accept a file that exists.

    Raises
    ------
    ValueError, OSError
    """
    if endings and not path.name.lower().endswith(endings):
        raise ValueError(f"{path}: expected a name that ends in {', '.join(endings)}")
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder: state the name of a file")
    if path.exists() and not overwrite:
        raise FileExistsError(f"{path} exists: choose another name, or overwrite=True")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path}: there is no folder {path.parent}")
    if not os.access(path.parent, os.W_OK):
        raise PermissionError(f"{path}: the folder {path.parent} is not writable")


def check_demo_folder(folder: Path) -> None:
    """Refuse to replace a folder unless it is empty or all in it was written by the demo."""
    import json

    from perrin._text import listed

    found = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))
    foreign = [name for name in found if not _DEMO_FILES.fullmatch(name)]
    try:
        made = json.loads((folder / "run.json").read_text(encoding="utf-8"))["made"] == "demo"
    except (OSError, ValueError, KeyError, TypeError):
        made = False
    if (made and not foreign) or (not found and folder.is_dir()):
        return
    reason = f"it holds {listed(foreign)}" if made else "no run.json in it names the demo"
    raise FileExistsError(
        f"{folder} is not what a demo wrote ({reason}): not overwritten; move it away, or choose "
        "another folder with -o"
    )
