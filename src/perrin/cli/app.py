"""The commands: parse, call, print; no physics."""

from __future__ import annotations

import os
import re
import sys
from contextlib import ExitStack
from io import TextIOWrapper
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from perrin._text import counted, printable
from perrin.cli.messages import (
    STOPPED,
    StoppedError,
    claimed_output,
    escape,
    messages_of,
    output_console,
    state_kept_frames,
    status_of,
    stop_in_order,
)
from perrin.cli.options import (
    BODY,
    INPUT,
    OUTPUT,
    PICTURE_SUFFIXES,
    RECORDING,
    SIZES,
    SPHERES,
    ClusterSize,
    Columns,
    Config,
    Contact,
    Diameter,
    Drift,
    Dynamics,
    Exposure,
    Frames,
    GroupedCommand,
    Interval,
    Json,
    KeepJumps,
    Model,
    Noise,
    Output,
    Overwrite,
    OverwriteFile,
    Positions,
    Quiet,
    Radius,
    Scale,
    Scheduler,
    Seed,
    Shape,
    Sigma,
    Temperature,
    Tracks,
    Viscosity,
    Workers,
    body_of,
    read_channels,
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
from perrin.cli.progress import shown_progress
from perrin.cli.study_commands import study_app
from perrin.cli.tables import show_diagnosis, show_json, show_plan, show_prediction, show_report

if TYPE_CHECKING:
    from collections.abc import Callable

    from perrin.images.optics.point_spread import PointSpread
    from perrin.run.results import Report

app = typer.Typer(
    name="perrin",
    help="Measure how rigid clusters of colloidal particles diffuse and turn.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    # Plain help: the formatted one imports a Markdown parser, a third of the time of `--help`.
    rich_markup_mode=None,
)

app.add_typer(study_app, name="study")

# Default folder of the demo, and the files that it writes there, by which it is recognised.
_DEMO_FOLDER = "perrin-demo"

_DEMO_FILES = re.compile(
    r"summary\.json|run\.json|checksums\.json|run\.toml|report\.html|(?:curves|results|demo-tracks)\.csv"
    r"|(?:tracks|motion)\.parquet"
    r"|figures|figures/cluster-0-\w+\.(?:png|pdf)"
)


def main() -> None:
    """Run the command line; the entry point of ``perrin``."""
    for stream in (sys.stdout, sys.stderr):
        # A terminal without µ gets its code, not an error.
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    stop_in_order()
    try:
        app()
    except StoppedError as stop:  # before the command itself began
        print(STOPPED, file=sys.stderr)
        sys.exit(status_of(stop))


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


@app.command(cls=GroupedCommand, epilog="perrin demo")
def demo(
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            help=f"Folder for the run; {_DEMO_FOLDER} if left out, replaced if a demo's.",
            rich_help_panel=OUTPUT,
        ),
    ] = None,
    as_json: Json = False,
    quiet: Quiet = False,
    overwrite: Overwrite = False,
) -> None:
    """Analyse an embedded table: a simulated tetrahedron that diffuses as predicted."""
    import shutil
    import tempfile
    from dataclasses import replace
    from importlib.resources import as_file, files

    import perrin
    from perrin.report.write import run_folder
    from perrin.run.experiment import Experiment
    from perrin.run.folders import check_place

    source = files("perrin") / "data" / "demo_tracks.csv.gz"
    place = output or Path(_DEMO_FOLDER)
    with claimed_output(demo, place), as_file(source) as path:
        if output is None and place.exists() and not overwrite:
            check_demo_folder(place)
            overwrite = True
        check_place(place, overwrite=overwrite)
        with tempfile.TemporaryDirectory(prefix="perrin-") as folder:
            input_table = Path(folder) / "demo-tracks.csv"
            perrin.write_tracks(perrin.read_tracks(path), input_table)
            known = Experiment(dt=0.73, viscosity=2.18e-3, temperature=295.0, diameter=2.45)
            report = perrin.analyze(input_table, experiment=known)
            source = report.settings["input"] | {"path": str(place / input_table.name)}
            report = replace(report, settings=report.settings | {"made": "demo", "input": source})
            with run_folder(report, place, overwrite=overwrite) as stage:
                shutil.copy(input_table, stage)
        show_run(report, place, demo, as_json=as_json, quiet=quiet)
        if not (as_json or quiet):
            planted = "D_R = 0.006727 rad^2/s, D_T = 0.04535 um^2/s"
            print(f"Planted in the simulation, as predicted: {planted}.")
            print(printable(f"The input, as an example of a table: {place / 'demo-tracks.csv'}"))


@app.command(
    cls=GroupedCommand,
    epilog="""perrin analyze tracks.csv --dt 0.73 -o my-run
    perrin analyze spots.csv --dt 0.5 --scale 0.11 -o my-run          # pixels of 0.11 um
    perrin analyze tracks.gdf --dt 0.5 --columns x=0,y=1,frame=-2,particle=-1 -o my-run
    perrin analyze points.txt --dt 0.5 --contact 2.45 --size 4 -o my-run   # no ids
    perrin analyze many.parquet --dt 0.5 --workers 4 -o my-run        # on four cores
    perrin analyze --config my-run/run.toml                           # once more""",
)
def analyze(
    tracks: Tracks,
    dt: Interval,
    output: Output,
    config: Config = None,  # noqa: ARG001 (its callback has taken it)
    scale: Scale = "1",
    columns: Columns = None,
    frames: Frames = None,
    contact: Contact = None,
    size: ClusterSize = None,
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
    workers: Workers = 0,
    scheduler: Scheduler = None,
    as_json: Json = False,
    quiet: Quiet = False,
    overwrite: Overwrite = False,
) -> None:
    """Measure D_R and D_T of every cluster in a track table."""
    with claimed_output(analyze, output), shown_progress(quiet=quiet) as progress:
        import perrin
        from perrin.run.folders import check_place

        check_place(output, overwrite=overwrite)
        progress(0, 0, "reading the table")
        report = perrin.analyze(
            tracks,
            dt=dt,
            scale=read_numbers("--scale", scale),
            columns=read_columns(columns),
            contact=contact,
            size=size,
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
            workers=workers,
            scheduler=scheduler,
            progress=progress,
        )
        perrin.write_run(report, output, overwrite=overwrite, progress=progress)
    with messages_of(analyze):
        show_run(report, output, analyze, as_json=as_json, quiet=quiet)


@app.command(
    cls=GroupedCommand,
    epilog="""perrin run movie.ome.tif --diameter 2.45 --contact 2.45 -o my-run
    perrin run movie.tif --voxel 0.2,0.1,0.1 --dt 0.73 --diameter 2.45 --contact 2.45 -o my-run
    perrin run movie.lif --image 3 --diameter 1.8 --contact 2.0 --workers 8 -o my-run""",
)
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
    config: Config = None,  # noqa: ARG001 (its callback has taken it)
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
            help="Number of the channel, from 0. Several are summed: 0,1. With 0:1 each channel "
            "shows spheres of one kind.",
            rich_help_panel=INPUT,
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
    border: Annotated[
        bool,
        typer.Option(
            help="Whether spheres that the border cuts are located too.", rich_help_panel=SPHERES
        ),
    ] = True,
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
            help="Image of a sphere, learned if left out: diameter,psf_z,psf (um), gain,floor "
            "of the noise (variance of a voxel: gain times its intensity plus floor), "
            "share,tail_z,tail (um) of the second Gaussian of a point spread with a tail, and the "
            "relative spread of the diameters.",
            rich_help_panel=SPHERES,
        ),
    ] = None,
    psf: Annotated[
        Path | None,
        typer.Option(
            help="Stack of beads that are smaller than the point spread, which is measured on them "
            "and not learned: beads.tif.",
            rich_help_panel=SPHERES,
        ),
    ] = None,
    bead_diameter: Annotated[
        float, typer.Option(help="Diameter of these beads, um.", rich_help_panel=SPHERES)
    ] = 0.1,
    noise: Noise = "joint",
    exposure: Exposure = None,
    drift: Drift = False,
    keep_jumps: KeepJumps = False,
    model: Model = None,
    viscosity: Viscosity = None,
    temperature: Temperature = None,
    workers: Workers = 0,
    scheduler: Scheduler = None,
    as_json: Json = False,
    quiet: Quiet = False,
    overwrite: Overwrite = False,
) -> None:
    """Measure D_R and D_T of every cluster in a movie of image stacks.

    Finished frames are kept in the output folder: after an interruption the same command resumes.
    """
    import perrin
    from perrin.report.write import complete_run
    from perrin.run.folders import check_resumable

    with claimed_output(run, output), state_kept_frames(output):
        check_resumable(output, parts="located", overwrite=overwrite)
        with ExitStack() as files:
            progress = files.enter_context(shown_progress(quiet=quiet, unit="frames"))
            progress(0, 0, "opening the stack")
            movies = [
                files.enter_context(
                    perrin.open_stack(
                        stack,
                        voxel=None if voxel is None else read_numbers("--voxel", voxel),
                        dt=dt,
                        plane_time=plane_time,
                        planes=planes,
                        channel=one,
                        image=int(image) if image is not None and image.isdecimal() else image,
                    )
                )
                for one in read_channels(channel)
            ]
            report = perrin.analyze_stack(
                movies,
                diameter=diameter,
                contact=contact,
                size=read_whole_numbers("--size", size) or None,
                frames=read_slice(frames),
                exclude=read_whole_numbers("--exclude", exclude),
                refine=read_refine(refine),
                optics=read_optics(optics),
                psf=None if psf is None else measured_psf(psf, bead_diameter),
                dark=dark,
                border=border,
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
            complete_run(report, output, progress=progress)
        show_run(report, output, run, as_json=as_json, quiet=quiet)


def measured_psf(path: Path, diameter: float) -> PointSpread:
    """Return the point spread that a stack of beads shows.

    Parameters
    ----------
    path : Path
        With the voxel size in the file.
    diameter : float
        Diameter of the beads, um.
    """
    import perrin

    # Frames are averaged, so that their interval does not matter.
    with perrin.open_stack(path, dt=1.0) as beads:
        return perrin.measure_point_spread(beads, diameter=diameter)


def show_run(
    report: Report, output: Path, command: Callable[..., None], *, as_json: bool, quiet: bool
) -> None:
    """Print the tables of a run, its summary.json, or nothing.

    Parameters
    ----------
    report : Report
    output : Path
        Its run folder.
    command : callable
        The command that made it.
    as_json, quiet : bool
    """
    if as_json:
        print((output / "summary.json").read_text(encoding="utf-8"), end="")
    elif not quiet:
        show_report(report, output, command)


@app.command(
    cls=GroupedCommand,
    epilog="""perrin simulate tetrahedron --radius 1.5 --d-r 5e-3 --sigma 0.03 --dt 0.73 -o t.csv
    perrin analyze t.csv --dt 0.73 -o my-run""",
)
def simulate(
    d_r: Annotated[float, typer.Option("--d-r", help="D_R, rad^2/s.", rich_help_panel=BODY)],
    dt: Annotated[
        float, typer.Option("--dt", help="Time between frames, s.", rich_help_panel=RECORDING)
    ],
    output: Annotated[
        Path,
        typer.Option(
            "-o",
            "--output",
            help="Track table: .csv, .csv.gz, .parquet, .gdf, .xyz or .napari.csv.",
            rich_help_panel=OUTPUT,
        ),
    ],
    shape: Shape = None,
    radius: Radius = None,
    diameter: Diameter = None,
    positions: Positions = None,
    d_t: Annotated[float, typer.Option("--d-t", help="D_T, um^2/s.", rich_help_panel=BODY)] = 0.0,
    sigma: Annotated[
        str,
        typer.Option(
            help="Localisation error, um, one number or x,y,z.", rich_help_panel=RECORDING
        ),
    ] = "0",
    frames: Annotated[int, typer.Option(help="Number of frames.", rich_help_panel=RECORDING)] = 300,
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
        body = body_of(shape, radius=radius, diameter=diameter, positions=positions)
        rng = np.random.default_rng(seed)
        truth = perrin.simulate_motion(
            body,
            D_R=d_r,
            D_T=d_t,
            dt=dt,
            n_frames=frames,
            dynamics=read_dynamics(dynamics),
            rng=rng,
        )
        x = perrin.add_noise(truth.positions(), sigma=read_numbers("--sigma", sigma), rng=rng)
        table = perrin.positions_table(x)
        # Formats without a cluster column.
        if output.name.lower().endswith((".gdf", ".napari.csv")):
            table = table.drop(columns="cluster")
        perrin.write_tracks(table, output)
        print(printable(f"{frames} frames of one {shape or positions} written to {output}"))


@app.command(
    cls=GroupedCommand,
    epilog="""perrin predict tetrahedron --diameter 2.45 --viscosity 2.18e-3 --temperature 295
    perrin predict --positions spheres.csv --diameter 2.45 --viscosity 1e-3 --temperature 298""",
)
def predict(
    viscosity: Annotated[float, typer.Option(help="Viscosity, Pa s.", rich_help_panel=SIZES)],
    temperature: Annotated[float, typer.Option(help="Temperature, K.", rich_help_panel=SIZES)],
    shape: Shape = None,
    diameter: Annotated[
        float | None, typer.Option(help="Sphere diameter, um.", rich_help_panel=BODY)
    ] = None,
    positions: Positions = None,
    accuracy: Annotated[
        float, typer.Option(help="Largest relative numerical error.", rich_help_panel=SIZES)
    ] = 1e-4,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="JSON file of the results.", rich_help_panel=OUTPUT),
    ] = None,
    as_json: Json = False,
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
        if as_json:
            show_json(body.to_dict())
            return
        show_prediction(body, name=shape or str(positions))
        if output is not None:
            print(printable(f"Written to {output}"))


@app.command(
    cls=GroupedCommand,
    epilog="""perrin plan tetrahedron --diameter 2.45 --d-r 0.005 --sigma 0.03 --frames 300
    perrin plan tetrahedron --diameter 2.45 --d-r 0.005 --sigma 0.03 --time 600 -o plan.png""",
)
def plan(
    d_r: Annotated[
        float, typer.Option("--d-r", help="Expected D_R, rad^2/s.", rich_help_panel=BODY)
    ],
    sigma: Annotated[
        str,
        typer.Option(
            help="Localisation error, um, one number or x,y,z.", rich_help_panel=RECORDING
        ),
    ],
    shape: Shape = None,
    radius: Radius = None,
    diameter: Diameter = None,
    positions: Positions = None,
    d_t: Annotated[
        float | None,
        typer.Option(
            "--d-t",
            help="Expected D_T, um^2/s; displacements between frames then limit dt too.",
            rich_help_panel=BODY,
        ),
    ] = None,
    frames: Annotated[
        int | None, typer.Option(help="Largest number of frames.", rich_help_panel=RECORDING)
    ] = None,
    time: Annotated[
        float | None,
        typer.Option(help="Longest duration of the movie, s.", rich_help_panel=RECORDING),
    ] = None,
    photons: Annotated[
        bool,
        typer.Option(
            "--photons",
            help="The number of photons is fixed: that of --frames frames in --time s with "
            "--sigma. The plan divides them among any number of frames.",
            rich_help_panel=RECORDING,
        ),
    ] = False,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            help="Figure of the error against dt: .png, .pdf or .svg.",
            rich_help_panel=OUTPUT,
        ),
    ] = None,
    as_json: Json = False,
    overwrite: OverwriteFile = False,
) -> None:
    """Recommend the time between frames and their number, and predict the error of D_R."""
    import perrin

    with messages_of(plan):
        if output is not None:
            check_new_file(output, PICTURE_SUFFIXES, overwrite=overwrite)
        found = perrin.plan_sampling(
            body_of(shape, radius=radius, diameter=diameter, positions=positions),
            D_R=d_r,
            sigma=read_numbers("--sigma", sigma),
            D_T=d_t,
            n_frames=frames,
            total_time=time,
            photons=photons,
        )
        if as_json:
            show_json(found.to_dict())
        else:
            show_plan(found)
        if output is not None:
            from perrin.plot.figure_style import column_figure, style
            from perrin.plot.results import plot_plan

            with style():
                figure = column_figure(0.55)
                plot_plan(found, ax=figure.add_subplot())
                figure.savefig(output)
            if not as_json:
                print(printable(f"Written to {output}"))


@app.command(cls=GroupedCommand, epilog="perrin paper -o paper")
def paper(
    output: Annotated[
        Path,
        typer.Option(
            "-o", "--output", help="Folder for figures and claims.", rich_help_panel=OUTPUT
        ),
    ],
    seed: Seed = 2011,
    overwrite: Overwrite = False,
) -> None:
    """Reproduce all figures, tables and claims of the paper (Hunter 2011)."""
    from perrin.paper.remake import reproduce
    from perrin.run.folders import check_place

    console = output_console()
    with claimed_output(paper, output):
        check_place(output, overwrite=overwrite)
        with shown_progress() as progress:
            claims = reproduce(
                output,
                seed=seed,
                overwrite=overwrite,
                progress=lambda done, total, _: progress(done, total, "figures and claims"),
            )
        failing = [claim for claim in claims if not claim.holds]
        console.print(f"{len(claims)} claims, {len(failing)} of them do not hold:")
        for claim in failing:
            remark = escape(claim.remark or claim.claim)
            console.print(f"- {escape(claim.source)}: {remark}", soft_wrap=True)
        console.print(f"Written to {escape(str(output))}: claims.md, figures, tables.")


@app.command(
    cls=GroupedCommand,
    epilog="""perrin convert tracks.gdf tracks.csv
    perrin convert spots.xml tracks.parquet --scale 0.11
    perrin convert tracks.csv tracks.gdf --drop cluster
    perrin convert points.xyz tracks.csv --contact 2.45 --size 4      # finds the ids""",
)
def convert(
    source: Annotated[Path, typer.Argument(help="Track table to read.")],
    target: Annotated[
        Path,
        typer.Argument(
            help="Track table to write; its suffix states the format: .csv, .csv.gz, .parquet, "
            ".gdf, .xyz or .napari.csv."
        ),
    ],
    scale: Scale = "1",
    columns: Columns = None,
    contact: Contact = None,
    size: ClusterSize = None,
    drop: Annotated[
        str | None,
        typer.Option(help="Columns that are not written: cluster,time.", rich_help_panel=OUTPUT),
    ] = None,
    overwrite: OverwriteFile = False,
) -> None:
    """Convert a track table from any format that is read to one that is written."""
    import perrin
    from perrin.tracks.formats import SUFFIXES

    with messages_of(convert):
        check_new_file(target, SUFFIXES, overwrite=overwrite)
        if (contact is None) != (size is None):
            raise ValueError("contact, size: both are needed to find the particles of a table")
        dropped = [name.strip() for name in (drop or "").split(",") if name.strip()]
        unknown = [name for name in dropped if name not in ("cluster", "time", "z")]
        if unknown:
            raise ValueError(f"--drop: expected cluster, time or z, got {', '.join(unknown)}")
        table = perrin.read_tracks(
            source,
            scale=read_numbers("--scale", scale),
            columns=read_columns(columns),
            detections=size is not None,
        )
        notes = table.attrs.get("notes", ())
        if contact is not None and size is not None:
            table = perrin.identify(table, contact=contact, size=size).drop(columns="piece")
        table = table.drop(columns=dropped, errors="ignore")
        perrin.write_tracks(table, target)
        for note in notes:
            print(printable(f"note: {note}"))
        print(printable(f"{counted(len(table), 'row')} written to {target}"))


@app.command(cls=GroupedCommand, epilog="perrin examples my-examples")
def examples(
    folder: Annotated[Path, typer.Argument(help="Folder for the copies.")] = Path(
        "perrin-examples"
    ),
    overwrite: Annotated[
        bool,
        typer.Option("--overwrite", help="Replace files of these names.", rich_help_panel=OUTPUT),
    ] = False,
) -> None:
    """Copy the scripts and notebooks of the tutorials into a folder."""
    import shutil

    with messages_of(examples):
        found = example_files()
        folder.mkdir(parents=True, exist_ok=True)
        present = [path.name for path in found if (folder / path.name).exists()]
        if present and not overwrite:
            raise FileExistsError(
                f"{folder} has {', '.join(present)}: choose another folder, or overwrite=True"
            )
        for path in found:
            shutil.copyfile(path, folder / path.name)
        print(f"{len(found)} examples copied to {folder}: {found[0].name} is the first")


def example_files() -> list[Path]:
    """Return the examples: in the package, or in the repository where this is not installed.

    Raises
    ------
    FileNotFoundError
        If the installation has none.

    Examples
    --------
    >>> example_files()[0].name
    '01_own_table.py'
    """
    package = Path(__file__).parents[1]
    for folder in (package / "data" / "examples", package.parents[1] / "examples"):
        found = sorted(path for path in folder.glob("[0-9]*") if path.suffix in (".py", ".ipynb"))
        if found:
            return found
    raise FileNotFoundError("this installation has no examples: install perrin from a wheel")


@app.command(cls=GroupedCommand, epilog="perrin doctor")
def doctor() -> None:
    """Show versions, optional readers and the font, and measure a simulated cluster as a test."""
    from perrin.cli.diagnosis import figure_font, installed, optional_readers, self_test

    checks = [*installed(), *optional_readers(), figure_font(), *self_test()]
    show_diagnosis(checks)
    if any(check.good is False for check in checks):
        raise typer.Exit(1)


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
