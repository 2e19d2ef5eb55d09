"""The command line: parse, call, print; no physics."""

from __future__ import annotations

import os
import re
import sys
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from perrin.cli.options import (
    _PICTURES,
    _SHAPES,
    _TOUCHING,
    Columns,
    Drift,
    Exposure,
    Interval,
    KeepJumps,
    Noise,
    Output,
    Overwrite,
    OverwriteFile,
    Scale,
    Tracks,
    _body,
    _columns,
    _frames_kept,
    _noise,
    _numbers,
    _optics,
    _refine,
    _slice,
    _spheres,
    _whole_numbers,
)
from perrin.cli.tables import _show, _show_plan, _show_prediction

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from typing import TextIO

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


# What a run of the demo writes, by which the folder of an earlier one is recognised.
_DEMO = "perrin-demo"


_DEMO_FILES = re.compile(
    r"summary\.json|run\.json|report\.html|curves\.csv|(?:tracks|motion)\.parquet"
    r"|figures|figures/cluster-0-\w+\.(?:png|pdf)"
)


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
def demo(
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", help=f"Folder for the run; {_DEMO} if left out, replaced if a demo's."
        ),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Analyse an embedded table: one simulated tetrahedron under the paper's conditions."""
    from dataclasses import replace
    from importlib.resources import as_file, files

    import perrin
    from perrin.run.folders import check_place

    with _messages(demo), as_file(files("perrin") / "data" / "demo_tracks.csv.gz") as path:
        place = output or Path(_DEMO)
        if output is None and place.exists() and not overwrite:
            _check_demo(place)
            overwrite = True
        check_place(place, overwrite=overwrite)
        report = perrin.analyze(path, dt=0.73, viscosity=2.18e-3, temperature=295.0, diameter=2.45)
        report = replace(report, settings=report.settings | {"made": "demo"})
        perrin.write_run(report, place, overwrite=overwrite)
        _show(report, place, demo)
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
    noise: Noise = "joint",
    exposure: Exposure = None,
    drift: Drift = False,
    keep_jumps: KeepJumps = False,
    viscosity: Annotated[float | None, typer.Option(help="Pa s, for sizes.")] = None,
    temperature: Annotated[
        float | None,
        typer.Option(help="K, for sizes; alone it gives size and viscosity from D_T and D_R."),
    ] = None,
    diameter: Annotated[
        float | None,
        typer.Option(help="Of one sphere, um: predicted D_T and D_R beside the measured ones."),
    ] = None,
    frames: Annotated[
        str | None, typer.Option(help="A:B uses the frames A <= frame < B; A or B may be left out.")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Measure D_R and D_T of every cluster in a track table."""
    import perrin
    from perrin.run.folders import check_place

    with _messages(analyze):
        check_place(output, overwrite=overwrite)
        report = perrin.analyze(
            tracks,
            dt=dt,
            scale=_numbers("--scale", scale),
            columns=_columns(columns),
            contact=contact,
            sigma=None if sigma is None else _numbers("--sigma", sigma),
            noise=_noise(noise),
            exposure=exposure,
            drift=drift,
            keep_jumps=keep_jumps,
            viscosity=viscosity,
            temperature=temperature,
            diameter=diameter,
            frames=_slice(frames),
        )
        perrin.write_run(report, output, overwrite=overwrite)
        _show(report, output, analyze)


@app.command()
def run(
    stack: Annotated[
        Path, typer.Argument(help="Movie of stacks: TIFF, OME-TIFF, .lif, .nd2, .czi, .ims, .zarr.")
    ],
    diameter: Annotated[float, typer.Option(help="Of the ball that is seen, um.")],
    contact: Annotated[float, typer.Option(help="Centre distance of touching spheres, um.")],
    output: Annotated[
        Path,
        typer.Option("-o", "--output", help="Folder for the run; one that was stopped goes on."),
    ],
    voxel: Annotated[
        str | None,
        typer.Option(help="Voxel size z,y,x (y,x in the plane), um, if not in the file."),
    ] = None,
    dt: Annotated[
        float | None, typer.Option("--dt", help="Time between frames, s, if not in the file.")
    ] = None,
    plane_time: Annotated[
        float | None, typer.Option(help="Time from one plane to the next, s.")
    ] = None,
    planes: Annotated[
        int | None, typer.Option(help="Planes of a frame, if not in the file.")
    ] = None,
    channel: Annotated[int | None, typer.Option(help="Channel, from 0.")] = None,
    image: Annotated[
        str | None, typer.Option(help="Image of a file with several, by number or name.")
    ] = None,
    size: Annotated[
        int | None, typer.Option(help="Spheres of a cluster; the most common number if left out.")
    ] = None,
    frames: Annotated[
        str | None, typer.Option(help="A:B uses the frames A <= frame < B; A or B may be left out.")
    ] = None,
    exclude: Annotated[
        str | None, typer.Option(help="Clusters to leave out, by number: 3,7.")
    ] = None,
    refine: Annotated[
        str,
        typer.Option(help="model: fit the image; trackpy: its disc model; none: places as found."),
    ] = "model",
    dark: Annotated[
        bool, typer.Option("--dark", help="Spheres are darker than what surrounds them.")
    ] = False,
    minmass: Annotated[
        float | None, typer.Option(help="Least mass of a sphere; the widest gap if left out.")
    ] = None,
    percentile: Annotated[
        float, typer.Option(help="Of voxels too dim for a sphere's middle; lower in full fields.")
    ] = 95.0,
    optics: Annotated[
        str | None,
        typer.Option(
            help="How a sphere is seen, learned if left out: diameter,psf_z,psf (um), and the "
            "noise's gain,floor (a voxel's variance is gain times its light plus floor)."
        ),
    ] = None,
    noise: Noise = "joint",
    exposure: Exposure = None,
    drift: Drift = False,
    keep_jumps: KeepJumps = False,
    viscosity: Annotated[
        float | None, typer.Option(help="Pa s: with the temperature, sizes and predictions.")
    ] = None,
    temperature: Annotated[float | None, typer.Option(help="K.")] = None,
    workers: Annotated[
        int, typer.Option(min=0, help="Processes of this machine that share the work.")
    ] = 0,
    scheduler: Annotated[
        str | None, typer.Option(help="Dask scheduler that does the work: tcp://host:8786.")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Measure D_R and D_T of every cluster in a movie of image stacks.

    Finished frames are kept in the output folder: after an interruption the same command goes on.
    """
    import perrin
    from perrin.report.write import complete_run
    from perrin.run.folders import check_resumable

    with _messages(run), _frames_kept(output):
        check_resumable(output, parts="located", overwrite=overwrite)
        movie = perrin.open_stack(
            stack,
            voxel=None if voxel is None else _numbers("--voxel", voxel),
            dt=dt,
            plane_time=plane_time,
            planes=planes,
            channel=channel,
            image=int(image) if image is not None and image.isdecimal() else image,
        )
        with movie, _progress() as progress:
            report = perrin.analyze_stack(
                movie,
                diameter=diameter,
                contact=contact,
                size=size,
                frames=_slice(frames),
                exclude=_whole_numbers("--exclude", exclude),
                refine=_refine(refine),
                optics=_optics(optics),
                dark=dark,
                minmass=minmass,
                percentile=percentile,
                noise=_noise(noise),
                exposure=exposure,
                drift=drift,
                keep_jumps=keep_jumps,
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
        _show(report, output, run)


@contextmanager
def _progress() -> Iterator[Callable[[int, int, str], None]]:
    """Give a function that shows how far the work is, how fast, and how long it will take."""
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

        def tell(done: int, total: int, title: str) -> None:
            if title not in tasks:
                for task in bar.tasks:  # what came before is over
                    bar.update(task.id, total=task.total or 1, completed=task.total or 1)
                tasks[title] = bar.add_task(
                    title, total=total or None, completed=done, count="", rate=""
                )
            task = bar.tasks[tasks[title]]
            rate = f"{task.speed:.2g} frames/s" if task.speed else ""
            count = f"{done}/{total}" if total else ""
            bar.update(task.id, completed=done, total=total or None, count=count, rate=rate)

        yield tell


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
    overwrite: OverwriteFile = False,
) -> None:
    """Write the track table of one simulated Brownian cluster with localisation noise."""
    import numpy as np

    import perrin
    from perrin.tracks.files import SUFFIXES

    with _messages(simulate):
        _check_file(output, SUFFIXES, overwrite=overwrite)
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
        if output.suffix.lower() == ".gdf":  # a format without room for a cluster column
            table = table.drop(columns="cluster")
        perrin.write_tracks(table, output)
        print(f"{frames} frames of one {shape} written to {output}")


@app.command()
def predict(
    viscosity: Annotated[float, typer.Option(help="Pa s.")],
    temperature: Annotated[float, typer.Option(help="K.")],
    shape: Annotated[
        str | None, typer.Argument(help=f"Touching spheres: {', '.join(_TOUCHING)}.")
    ] = None,
    diameter: Annotated[float | None, typer.Option(help="Sphere diameter, um.")] = None,
    positions: Annotated[
        Path | None,
        typer.Option(help="Any other body: csv with columns x,y,z (um), perhaps radius."),
    ] = None,
    accuracy: Annotated[float, typer.Option(help="Relative error aimed at.")] = 1e-4,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="JSON file.")] = None,
    overwrite: OverwriteFile = False,
) -> None:
    """Predict how a rigid cluster of spheres diffuses: D_T, D_R, hydrodynamic diameters."""
    import json
    import warnings

    import numpy as np

    import perrin
    from perrin.hydrodynamics.units import length_remarks

    with _messages(predict):
        if output is not None:
            _check_file(output, overwrite=overwrite)
        centers, radius = _spheres(shape, diameter=diameter, positions=positions)
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
            text = json.dumps(body.to_dict(), indent=2, allow_nan=False)
            output.write_text(text + "\n", encoding="utf-8")
        _show_prediction(body, name=shape or str(positions))
        if output is not None:
            print(f"Written to {output}")


@app.command()
def plan(
    shape: Annotated[str, typer.Argument(help=f"{', '.join(_SHAPES)}.")],
    d_r: Annotated[float, typer.Option("--d-r", help="D_R as far as it is known, rad^2/s.")],
    sigma: Annotated[str, typer.Option(help="Localisation error, um, one number or x,y,z.")],
    radius: Annotated[
        float | None, typer.Option(help="Mean distance of particles to the centre, um.")
    ] = None,
    diameter: Annotated[
        float | None, typer.Option(help="Instead of the radius: diameter of touching spheres, um.")
    ] = None,
    d_t: Annotated[
        float | None, typer.Option("--d-t", help="D_T, um^2/s: travel then counts for linking.")
    ] = None,
    frames: Annotated[int | None, typer.Option(help="The most frames that can be taken.")] = None,
    time: Annotated[float | None, typer.Option(help="The longest movie, s.")] = None,
    photons: Annotated[
        bool,
        typer.Option(
            "--photons",
            help="The light is limited: that of --frames frames in --time s, each with --sigma, "
            "can be divided among any number of frames.",
        ),
    ] = False,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="Picture of error against dt: .png, .pdf or .svg."),
    ] = None,
    overwrite: OverwriteFile = False,
) -> None:
    """Say how often and how many times to look, and how well D_R will be known."""
    import perrin

    with _messages(plan):
        if output is not None:
            _check_file(output, _PICTURES, overwrite=overwrite)
        found = perrin.plan_sampling(
            _body(shape, radius=radius, diameter=diameter),
            D_R=d_r,
            sigma=_numbers("--sigma", sigma),
            D_T=d_t,
            n_frames=frames,
            total_time=time,
            photons=photons,
        )
        _show_plan(found)
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
    seed: Annotated[int, typer.Option(help="Seed of the random numbers.")] = 2011,
    overwrite: Overwrite = False,
) -> None:
    """Remake every figure, table and claim of Hunter et al. 2011."""
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    from perrin.paper.remake import reproduce
    from perrin.run.folders import check_place

    console = Console(highlight=False)
    columns = BarColumn(), TextColumn("{task.completed}/{task.total}"), TimeElapsedColumn()
    bar = Progress(*columns, TextColumn("{task.description}"), console=console)
    with _messages(paper):
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
    target: Annotated[Path, typer.Argument(help="Track table to write, kind by its suffix.")],
    scale: Scale = "1",
    columns: Columns = None,
    overwrite: OverwriteFile = False,
) -> None:
    """Convert a track table between .csv, .csv.gz, .parquet and .gdf."""
    import perrin
    from perrin.tracks.files import SUFFIXES

    with _messages(convert):
        _check_file(target, SUFFIXES, overwrite=overwrite)
        table = perrin.read_tracks(
            source, scale=_numbers("--scale", scale), columns=_columns(columns)
        )
        perrin.write_tracks(table, target)
        for note in table.attrs.get("notes", ()):
            print(f"note: {note}")
        print(f"{len(table)} rows written to {target}")


@contextmanager
def _messages(command: Callable[..., None]) -> Iterator[None]:
    """Print warnings and an error in one line each, in the words of the command line.

    Exit status 1: the data cannot answer; 2: the input or the place of the output is wrong.
    """
    import perrin
    from perrin.cli.messages import in_options, options_of

    no_answer = (
        perrin.DegenerateClusterError,
        perrin.IdentityError,
        perrin.NoSpheresError,
        perrin.TooFewFramesError,
    )

    options = options_of(command)
    try:
        with _warnings_in_one_line(options):
            yield
    except BrokenPipeError:
        # The reader has gone (a pipe into head); the run itself is written. Python's own flush at
        # the end would complain again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (ValueError, OSError, ImportError) as error:
        print(f"perrin: {in_options(_one_line(error), options)}", file=sys.stderr)
        raise typer.Exit(1 if isinstance(error, no_answer) else 2) from None


@contextmanager
def _warnings_in_one_line(options: dict[str, str]) -> Iterator[None]:
    """Print the library's warnings when they are given, each text once."""
    import warnings

    import perrin
    from perrin.cli.messages import in_options

    ours = (perrin.PrecisionWarning, perrin.IdentityWarning)
    printed: set[str] = set()
    with warnings.catch_warnings():
        usual = warnings.showwarning

        def show(
            message: Warning | str,
            category: type[Warning],
            filename: str,
            lineno: int,
            file: TextIO | None = None,
            line: str | None = None,
        ) -> None:
            if not issubclass(category, ours):
                usual(message, category, filename, lineno, file, line)
                return
            text = in_options(" ".join(str(message).split()), options)
            if text not in printed:
                print(f"warning: {text}", file=sys.stderr)
                printed.add(text)

        for category in ours:
            warnings.simplefilter("always", category)
        warnings.showwarning = show
        yield


def _one_line(error: Exception) -> str:
    """Return an error's message on one line, the system's with the file first."""
    if isinstance(error, OSError) and error.strerror and error.filename:
        return f"{error.filename}: {error.strerror}"
    return "; ".join(line.strip().removeprefix("- ") for line in str(error).splitlines())


def _check_file(path: Path, endings: tuple[str, ...] = (), *, overwrite: bool) -> None:
    """Refuse, before any work is done, a file that cannot or must not be written."""
    if endings and not path.name.lower().endswith(endings):
        raise ValueError(f"{path}: expected a name that ends in {', '.join(endings)}")
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder: state the name of a file")
    if path.exists() and not overwrite:
        raise FileExistsError(f"{path} exists: choose another name, or --overwrite")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path}: there is no folder {path.parent}")
    if not os.access(path.parent, os.W_OK):
        raise PermissionError(f"{path}: the folder {path.parent} is not writable")


def _check_demo(folder: Path) -> None:
    """Refuse to replace a folder unless it is empty or all in it was written by the demo."""
    import json

    found = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))
    foreign = [name for name in found if not _DEMO_FILES.fullmatch(name)]
    try:
        made = json.loads((folder / "run.json").read_text(encoding="utf-8"))["made"] == "demo"
    except (OSError, ValueError, KeyError, TypeError):
        made = False
    if (made and not foreign) or (not found and folder.is_dir()):
        return
    from perrin._text import listed

    reason = f"it holds {listed(foreign)}" if made else "no run.json in it names the demo"
    raise FileExistsError(
        f"{folder} is not what a demo wrote ({reason}): not overwritten; move it away, or choose "
        "another folder with -o"
    )
