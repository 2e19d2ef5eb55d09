"""Options of the command line: their types, groups and help texts, and what their texts mean."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast, get_args

import typer
from typer.core import TyperCommand

from perrin._arrays import require_positive
from perrin.cli.config import take_config

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from perrin.geometry.shapes import Cluster
    from perrin.images.optics.optics import Optics
    from perrin.motion.dynamics import Dynamics as PlantedDynamics
    from perrin.run.experiment import MotionModel


# Number of spheres of the named bodies; the paper's pentahedron is the bipyramid with all five at
# one distance from the centre, where a radius is given.
SHAPES = {
    "dimer": 2, "trimer": 3, "tetrahedron": 4, "pentahedron": 5, "bipyramid": 5, "octahedron": 6,
    "pentagonal-bipyramid": 7,
}  # fmt: skip

PICTURE_SUFFIXES = (".png", ".pdf", ".svg")

# Headings of the options in the help of commands with many of them, in this order.
INPUT, SPHERES = "Input", "Spheres and clusters"
BODY, RECORDING = "Body and motion", "Recording"
ESTIMATES, SIZES, WORK, OUTPUT = (
    "Noise and estimates", "Sizes and predictions", "Work", "Output",
)  # fmt: skip
_GROUPS = (
    INPUT, SPHERES, BODY, RECORDING, ESTIMATES, SIZES, WORK, OUTPUT, "Other options",
)  # fmt: skip


class GroupedCommand(TyperCommand):
    """A command whose help shows its options under headings: their `rich_help_panel`."""

    def format_options(self, ctx: Any, formatter: Any) -> None:  # noqa: ANN401 (click's own types)
        """Write the arguments, and the options group by group."""
        groups: dict[str, list[tuple[str, str]]] = {g: [] for g in ("Arguments", *_GROUPS)}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx)
            if parameter.param_type_name == "argument":
                heading = "Arguments"
            else:
                heading = getattr(parameter, "rich_help_panel", None) or _GROUPS[-1]
            if record is not None:
                groups[heading].append(record)
        for heading, records in groups.items():
            if records:
                with formatter.section(heading):
                    formatter.write_dl(records)

    def format_epilog(self, ctx: Any, formatter: Any) -> None:  # noqa: ANN401, ARG002
        """Write the examples, a line each, as they are."""
        if self.epilog:
            with formatter.section("Examples"):
                for line in self.epilog.splitlines():
                    formatter.write(f"  {line.strip()}\n")


Tracks = Annotated[
    Path,
    typer.Argument(
        help="Track table: .csv, .tsv, .txt, .xlsx, .parquet, .gdf, .xyz, TrackMate, Imaris, ... "
        "(docs/tables.md)."
    ),
]

Interval = Annotated[
    float, typer.Option("--dt", help="Time between frames, s.", rich_help_panel=INPUT)
]

Output = Annotated[
    Path, typer.Option("-o", "--output", help="Folder for the run.", rich_help_panel=OUTPUT)
]

Scale = Annotated[
    str,
    typer.Option(
        help="Length of one unit of the coordinates, um; one number or x,y,z, e.g. 1000 for mm.",
        rich_help_panel=INPUT,
    ),
]

Columns = Annotated[
    str | None,
    typer.Option(
        help="Names or numbers of the file's columns: x=0,y=1,z=2,frame=-2,particle=-1, or time=t "
        "(s) in place of frame.",
        rich_help_panel=INPUT,
    ),
]

Frames = Annotated[
    str | None,
    typer.Option(
        help="A:B uses the frames A <= frame < B; A or B may be left out.", rich_help_panel=INPUT
    ),
]

Overwrite = Annotated[
    bool,
    typer.Option("--overwrite", help="Replace an existing run folder.", rich_help_panel=OUTPUT),
]

OverwriteFile = Annotated[
    bool, typer.Option("--overwrite", help="Replace an existing file.", rich_help_panel=OUTPUT)
]

Workers = Annotated[
    int,
    typer.Option(
        "--workers",
        min=0,
        help="Number of processes of this machine that share the work.",
        rich_help_panel=WORK,
    ),
]

Scheduler = Annotated[
    str | None,
    typer.Option(
        "--scheduler",
        help="Address of a Dask scheduler that does the work: tcp://host:8786.",
        rich_help_panel=WORK,
    ),
]

Json = Annotated[
    bool,
    typer.Option("--json", help="Print the results as JSON, no tables.", rich_help_panel=OUTPUT),
]

Quiet = Annotated[
    bool,
    typer.Option(
        "--quiet", help="Print warnings and errors only, no progress.", rich_help_panel=OUTPUT
    ),
]

Config = Annotated[
    Path | None,
    typer.Option(
        "--config",
        help="TOML file with options by their names, as run.toml of a run folder; those of the "
        "command line outrank it.",
        is_eager=True,
        callback=take_config,
        rich_help_panel=INPUT,
    ),
]

Contact = Annotated[
    float | None,
    typer.Option(
        help="Centre distance of touching particles, um: finds the clusters.",
        rich_help_panel=INPUT,
    ),
]

ClusterSize = Annotated[
    int | None,
    typer.Option(
        help="Number of particles of a cluster: with --contact, finds the particles of a table "
        "without ids.",
        rich_help_panel=INPUT,
    ),
]

Sigma = Annotated[
    str | None,
    typer.Option(
        help="Known localisation error, um, one number or x,y,z: for the predicted noise floor "
        "and the test of rigidity.",
        rich_help_panel=ESTIMATES,
    ),
]

Noise = Annotated[
    str,
    typer.Option(
        help="Noise model: joint (fitted together with D), residual (from the rigid fit; "
        "right only if all particles of a frame are recorded at once), or sigma in um.",
        rich_help_panel=ESTIMATES,
    ),
]

Exposure = Annotated[
    float | None,
    typer.Option(
        help="Open fraction of dt, 0 to 1; unknown if left out.", rich_help_panel=ESTIMATES
    ),
]

Drift = Annotated[
    bool,
    typer.Option(
        "--drift",
        help="Subtract a mean velocity (flow) from D_T and a mean spin from D_R; both are "
        "reported.",
        rich_help_panel=ESTIMATES,
    ),
]

KeepJumps = Annotated[
    bool,
    typer.Option(
        "--keep-jumps",
        help="Keep steps in D that Brownian motion cannot make (stage jumps).",
        rich_help_panel=ESTIMATES,
    ),
]

Model = Annotated[
    str | None,
    typer.Option(
        help="Fit this motion to every cluster, whatever it shows: anomalous (exponent), confined "
        "(cage), switching (two D). By default the motion that the tests find is fitted.",
        rich_help_panel=ESTIMATES,
    ),
]

Viscosity = Annotated[
    float | None,
    typer.Option(
        help="Viscosity, Pa s: with the temperature, sizes and predictions.", rich_help_panel=SIZES
    ),
]

Temperature = Annotated[
    float | None,
    typer.Option(
        help="Temperature, K; alone it gives size and viscosity from D_T and D_R together.",
        rich_help_panel=SIZES,
    ),
]

Dynamics = Annotated[
    str | None,
    typer.Option(
        help="Another motion than Brownian: fractional:ALPHA, confined:RELAXATION_TIME, spin:RATE "
        "or spin:X,Y,Z, switching:RATIO,DWELL, hopping:ANGLE,INTERVAL or "
        "hopping:ANGLE,INTERVAL,RELAXATION_TIME (rad, rad/s, s).",
        rich_help_panel=BODY,
    ),
]

Seed = Annotated[int, typer.Option(help="Seed of the random numbers.", rich_help_panel=RECORDING)]
Shape = Annotated[str | None, typer.Argument(help=f"{', '.join(SHAPES)}; or --positions.")]

Radius = Annotated[
    float | None,
    typer.Option(help="Mean distance of particles to the centre, um.", rich_help_panel=BODY),
]

Diameter = Annotated[
    float | None,
    typer.Option(
        help="Diameter of touching spheres, um, instead of --radius.", rich_help_panel=BODY
    ),
]

Positions = Annotated[
    Path | None,
    typer.Option(
        help="Sphere centres of another body: csv with the columns x,y,z (um) and, if the radii "
        "differ, radius (um).",
        rich_help_panel=BODY,
    ),
]


def read_optics(text: str | None) -> Optics | None:
    """Read diameter, point spread along z and in the plane, gain, floor, tail and spread.

    The tail of the point spread, which may be absent, is its share and its widths along z and in
    the plane; the spread of the diameters, which may be absent too, is the last number.
    """
    from perrin.images.optics.ball_image import PsfTail
    from perrin.images.optics.optics import CameraNoise, Optics

    if text is None:
        return None
    values = read_numbers("--optics", text)
    if not isinstance(values, list) or len(values) not in (5, 6, 8, 9):
        raise ValueError(
            f"--optics: expected diameter,psf_z,psf,gain,floor, for a point spread with a tail "
            f"also share,tail_z,tail, and for unequal spheres also the spread, got {text!r}"
        )
    spread = values.pop() if len(values) in (6, 9) else 0.0
    diameter, psf_z, psf, gain, floor, *wide = values
    tail = PsfTail(wide[0], (wide[1], wide[2])) if wide else None
    return Optics(diameter, (psf_z, psf), CameraNoise(gain, floor), tail=tail, spread=spread)


def spheres_of(
    shape: str | None, *, diameter: float | None, positions: Path | None
) -> tuple[ArrayLike, ArrayLike]:
    """Return centres and radius of a named body of touching spheres, or those of a file."""
    import perrin
    from perrin.tracks.files import read_spheres

    if diameter is not None:
        require_positive(diameter=diameter)
    if positions is None and shape in SHAPES:
        if diameter is None:
            raise ValueError("--diameter: the sphere diameter (um) is needed")
        return perrin.Cluster.touching(SHAPES[shape], diameter).positions, diameter / 2
    if positions is None or shape is not None:
        raise ValueError(
            f"expected one of {', '.join(SHAPES)}, or --positions FILE, got {shape!r}"
            + ("" if positions is None else f" and {positions}")
        )
    centers, radius = read_spheres(positions)
    if radius is not None and diameter is None:
        return centers, radius
    if radius is None and diameter is not None:
        return centers, diameter / 2
    state = "has none" if radius is None else "has one"
    raise ValueError(
        f"the size: expected --diameter or a column radius, one of them; {positions} {state}"
    )


def read_numbers(option: str, text: str) -> float | list[float]:
    """Read one number, or several separated by commas."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        raise ValueError(f"{option}: expected a number or x,y,z, got {text!r}") from None
    return values[0] if len(values) == 1 else values


def read_dynamics(text: str | None) -> PlantedDynamics | None:
    """Read the name of a motion and its numbers, such as switching:10,14."""
    from perrin import motion

    if text is None:
        return None
    offered = ("fractional", "confined", "spin", "switching", "hopping")
    name, _, numbers = text.partition(":")
    if name not in offered:
        raise ValueError(f"--dynamics: expected {', '.join(offered)} and numbers, got {text!r}")
    values = read_numbers("--dynamics", numbers)
    arguments = [values] if name == "spin" or isinstance(values, float) else values
    try:
        found: PlantedDynamics = getattr(motion, name.capitalize())(*arguments)
    except TypeError:
        raise ValueError(f"--dynamics: wrong number of values for {name}, got {text!r}") from None
    except ValueError as fault:
        raise ValueError(f"--dynamics: {fault}") from None
    return found


def read_noise(text: str) -> Literal["joint", "residual"] | float:
    """Read joint, residual, or a number."""
    if text in ("joint", "residual"):
        return cast('Literal["joint", "residual"]', text)
    try:
        return float(text)
    except ValueError:
        raise ValueError(
            f"--noise: expected joint, residual or sigma in um, got {text!r}"
        ) from None


def read_model(text: str | None) -> MotionModel | None:
    """Read anomalous, confined or switching."""
    from perrin.run.experiment import MotionModel

    if text is not None and text not in get_args(MotionModel):
        offered = ", ".join(get_args(MotionModel))
        raise ValueError(f"--model: expected {offered}, got {text!r}")
    return cast("MotionModel | None", text)


def read_whole_numbers(option: str, text: str | None) -> list[int]:
    """Read whole numbers separated by commas."""
    try:
        return [int(part) for part in (text or "").split(",") if part.strip()]
    except ValueError:
        raise ValueError(f"{option}: expected numbers like 3,7, got {text!r}") from None


def read_channels(text: str | None) -> list[int | list[int] | None]:
    """Read the channels of each kind of sphere: 0, or 0,1 for a sum, or 0:1 for two kinds.

    Examples
    --------
    >>> read_channels(None), read_channels("2"), read_channels("0,1"), read_channels("0,1:2")
    ([None], [2], [[0, 1]], [[0, 1], 2])
    """
    kinds = [read_whole_numbers("--channel", part) for part in (text or "").split(":")]
    if len(kinds) > 1 and not all(kinds):
        raise ValueError(f"--channel: expected a number on each side of a colon, got {text!r}")
    used = [number for kind in kinds for number in kind]
    if len(kinds) > 1 and len(set(used)) < len(used):
        raise ValueError(f"--channel: expected different channels for each kind, got {text!r}")
    return [kind[0] if len(kind) == 1 else kind or None for kind in kinds]


def read_refine(text: str) -> Literal["model", "trackpy"] | None:
    """Read model, trackpy or none."""
    if text not in ("model", "trackpy", "none"):
        raise ValueError(f"--refine: expected model, trackpy or none, got {text!r}")
    return None if text == "none" else cast('Literal["model", "trackpy"]', text)


def read_columns(text: str | None) -> dict[str, str | int] | None:
    """Read name=column pairs; a column that is a whole number is a position."""
    if text is None:
        return None
    pairs = [part.partition("=") for part in text.split(",")]
    if not all(name and column for name, _, column in pairs):
        raise ValueError(f"--columns: expected pairs like x=0,y=1,frame=-2, got {text!r}")

    def place(column: str) -> str | int:
        return int(column) if column.lstrip("-").isdecimal() else column

    return {name.strip(): place(column.strip()) for name, _, column in pairs}


def body_of(
    shape: str | None, *, radius: float | None, diameter: float | None, positions: Path | None
) -> Cluster:
    """Return the named body of that radius, or of touching spheres, or that of a file."""
    from perrin import Cluster
    from perrin.geometry.symmetry import point_group
    from perrin.tracks.files import read_spheres

    if positions is not None:
        if shape is not None or radius is not None or diameter is not None:
            raise ValueError("--positions: states the body; expected no name, radius or diameter")
        places = read_spheres(positions)[0]
        return Cluster(places, point_group(places))
    faults = []
    if shape not in SHAPES:
        faults.append(f"expected one of {', '.join(SHAPES)}, or --positions FILE, got {shape!r}")
    if (radius is None) == (diameter is None):
        faults.append("expected either --radius or --diameter (touching spheres)")
    if faults or shape is None:
        raise ValueError("; ".join(faults))
    if diameter is not None:
        return Cluster.touching(SHAPES[shape], diameter)
    if shape in ("trimer", "tetrahedron", "pentahedron"):
        body: Cluster = getattr(Cluster, shape)(radius)
        return body
    require_positive(radius=radius or 0.0)
    unit = Cluster.touching(SHAPES[shape], 1.0)
    return Cluster(unit.positions * ((radius or 0.0) / unit.R), unit.symmetry)


def read_slice(text: str | None) -> tuple[int | None, int | None] | None:
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
