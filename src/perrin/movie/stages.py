"""The two stages of a run that work frame by frame: locating spheres and fitting poses."""

from __future__ import annotations

import hashlib
import shutil
import warnings
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np

from perrin.errors import DamagedFileError, FrameError, PrecisionWarning, TooFewFramesError
from perrin.images.optics.clipping import without_clipped
from perrin.images.optics.optics import Optics
from perrin.images.optics.radial_image import RadialImage
from perrin.images.optics.samples import UsualImage
from perrin.images.optics.window_fit import RigidCenters
from perrin.images.spheres.localisation import Method, choose_method, found_table, sample_frames
from perrin.images.spheres.poses import Pose, pose_in, with_poses
from perrin.images.spheres.spots import Fading
from perrin.movie.checks import Findings, unsettled_poses
from perrin.movie.parts import PartWriter, open_parts, read_parts
from perrin.run.workers import work_through
from perrin.tracks.checksums import read_sealed, write_sealed

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    import pandas as pd

    from perrin._arrays import Floats, Ints
    from perrin.images.spheres.localisation import Refine, Search
    from perrin.images.stack import Stack
    from perrin.motion.rigid_motion import RigidMotion
    from perrin.run.workers import Work

S = TypeVar("S")
_METHOD_FILE = "method.json"


def run_frames(
    task: Callable[[S], tuple[pd.DataFrame, dict[str, Any]]],
    items: Mapping[int, S],
    *,
    folder: Path,
    work: Work,
    title: str,
) -> tuple[pd.DataFrame, pd.DataFrame, list[str]]:
    """Run a task for all frames that have no finished part yet, and read all parts.

    Parameters
    ----------
    task : callable
        ``task(item)`` returns the rows of a frame, and an entry with ``frame`` and other values.
    items : mapping
        Item of each frame.
    folder : Path
        Folder of the parts.
    work : Work
    title : str
        Name of the task for the progress.

    Returns
    -------
    rows, entries : pandas.DataFrame
        Results of the task for all items, in the order of the frames.
    repeated : list of str
        A note if damaged parts had to be computed again.
    """
    import pandas as pd

    table, entries, damaged = read_parts(folder)
    done = {int(e["frame"]) for e in entries}
    remaining = [item for frame, item in items.items() if frame not in done]
    count = len(items) - len(remaining)
    work.report(count, len(items), title)
    if remaining:
        with PartWriter(folder) as writer:
            for rows, entry in work_through(
                task, remaining, workers=work.workers, scheduler=work.scheduler
            ):
                writer.add(rows, entry)
                count += 1
                work.report(count, len(items), title)
        table, entries, _ = read_parts(folder)
    listed = pd.DataFrame(entries).sort_values("frame", ignore_index=True)
    rows = table.sort_values("frame", kind="stable", ignore_index=True)
    note = f"{len(damaged)} damaged parts in {folder} were computed again"
    return rows, listed, [note] if damaged else []


class Located(NamedTuple):
    """Spheres of a movie.

    Attributes
    ----------
    method : Method
        How every frame was processed.
    features : pandas.DataFrame
        Table of the spheres, as `locate` returns it.
    frames : pandas.DataFrame
        Table of the frames, as in `Imaging`.
    spots : pandas.DataFrame
        Spots of a few frames, as in `Imaging`.
    warnings : list of str
        Warnings about the choice of the method.
    notes : list of str
        A note if damaged parts had to be computed again.
    """

    method: Method
    features: pd.DataFrame
    frames: pd.DataFrame
    spots: pd.DataFrame
    warnings: list[str]
    notes: list[str]


def locate_frames(
    stack: Stack,
    search: Search,
    *,
    refine: Refine,
    optics: Optics | None,
    frames: Sequence[int],
    settings: Mapping[str, Any],
    folder: Path,
    work: Work,
) -> Located:
    """Find and refine the spheres of many frames; finished frames in the folder are kept.

    Parameters
    ----------
    stack : Stack
    search, refine, optics
        As in `choose_method`; missing settings are learned once and kept with the parts.
    frames : sequence of int
    settings : mapping
        All settings that the result depends on; parts of other settings are refused.
    folder : Path
        Folder of the parts.
    work : Work

    Returns
    -------
    Located

    Raises
    ------
    PartsError
        If the folder holds the parts of another run.
    """
    import pandas as pd

    known = folder / _METHOD_FILE
    learned, repeated = None, []
    if known.exists():
        try:
            open_parts(folder, settings)
            learned = read_sealed(known)
        except DamagedFileError as damage:
            # Without its settings a part may be of any run; a method is learned once more.
            if damage.file != str(known):
                shutil.rmtree(folder)
            repeated.append(f"{damage.file} was damaged: what followed from it was computed again")
    if learned is None:
        learned = learn_method(
            stack, search, refine=refine, optics=optics, frames=frames, work=work
        )
        open_parts(folder, settings)
        write_sealed(known, learned)
    found, radial = learned["optics"], learned["radial"]
    method = Method(
        replace(search, minmass=learned["minmass"]),
        refine,
        None if found is None else Optics.from_dict(found),
        None if learned["fading"] is None else Fading.from_dict(learned["fading"]),
        None if learned["usual"] is None else UsualImage.from_dict(learned["usual"]),
        None if radial is None else RadialImage.from_dict(radial),
        None if learned["pattern"] is None else np.array(learned["pattern"]),
    )
    rows, entries, notes = run_frames(
        _LocateTask(_without_times(stack), method),
        {i: i for i in frames},
        folder=folder,
        work=work,
        title="locating spheres",
    )
    entries.insert(1, "time", stack.times[entries["frame"].to_numpy()])
    # A frame with an earlier one's digest is its copy. Frames without a sphere count as empty.
    first = entries.groupby("digest")["frame"].transform("min")
    repeats = (entries["digest"] != "") & (entries["spheres"] > 0) & (first < entries["frame"])
    entries["copy_of"] = np.where(repeats, first, -1).astype(np.int64)
    rows = rows[~rows["frame"].isin(entries.loc[entries["copy_of"] >= 0, "frame"])]
    spots = pd.DataFrame(learned["spots"], columns=["frame", "mass"])
    return Located(
        method,
        rows.reset_index(drop=True),
        entries.drop(columns="digest"),
        spots,
        learned["told"],
        repeated + notes,
    )


def learn_method(
    stack: Stack,
    search: Search,
    *,
    refine: Refine,
    optics: Optics | None,
    frames: Sequence[int],
    work: Work,
) -> dict[str, Any]:
    """Choose mass cut and optics from a few frames.

    Parameters
    ----------
    stack, search, refine, optics
        As in `choose_method`.
    frames : sequence of int
        Frames of the run.
    work : Work
        Whose progress is reported.

    Returns
    -------
    dict
        Values that JSON can hold: ``minmass``, ``optics``, ``fading``, ``usual``, ``radial``,
        ``pattern``, the
        ``spots`` of the sampled frames as (frame, mass), and the warnings under ``told``.

    Raises
    ------
    TooFewFramesError
        If all frames are the same image; images without any contrast are not compared.
    """
    title = "learning mass cut and optics"
    work.report(0, 2, title)
    sample = sample_frames(stack, search, frames)
    work.report(1, 2, title)
    first = sample[0].frame
    equal = (
        len(frames) > 1
        and first.min() < first.max()
        and all(np.array_equal(seen.frame, first) for seen in sample)
    )
    if equal:
        try:
            equal = all(np.array_equal(stack.frame(i), first) for i in frames)
        except FrameError:
            equal = False  # a frame that cannot be read counts as a different image
    if equal:
        raise TooFewFramesError(
            f"all {len(frames)} frames are exactly the same image, voxel by voxel: the movie shows "
            f"no motion, one image was written {len(frames)} times",
            1,
        )
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", PrecisionWarning)
        method = choose_method(stack, search, sample, refine=refine, optics=optics)
    work.report(2, 2, title)
    if method.optics is not None and method.optics.shell:
        z, y, x = (float(h) for h in stack.voxel)
        sample = [
            seen._replace(spots=method.spots(np.asarray(seen.frame, np.float64), (z, y, x)))
            for seen in sample
        ]
    return {
        "minmass": method.search.minmass,
        "optics": None if method.optics is None else method.optics.to_dict(),
        "fading": None if method.fading is None else method.fading.to_dict(),
        "usual": None if method.usual is None else method.usual.to_dict(),
        "radial": None if method.radial is None else method.radial.to_dict(),
        "pattern": None if method.pattern is None else method.pattern.tolist(),
        "spots": [[seen.number, mass] for seen in sample for mass in seen.spots.mass.tolist()],
        "told": [str(warning.message) for warning in caught],
    }


@dataclass(frozen=True)
class _LocateTask:
    """Find the spheres of one frame."""

    stack: Stack
    method: Method

    def __call__(self, i: int) -> tuple[pd.DataFrame, dict[str, Any]]:
        entry: dict[str, Any] = {"frame": i, "spots": 0, "spheres": 0}
        try:
            found = self.method.locate_in(self.stack, i)
        except FrameError as fault:
            missing = {"level": np.nan, "saturated": np.nan, "digest": "", "fault": str(fault)}
            return found_table([]), entry | missing
        entry |= {"spots": found.spots, "spheres": len(found.columns["mass"])}
        entry |= {"level": found.level, "saturated": found.saturated, "digest": found.digest}
        entry["fault"] = ""
        return found_table([found]), entry


def _without_times(stack: Stack) -> Stack:
    """Return the stack without its times, which workers do not need."""
    return replace(stack, times=np.empty(0))


class _FramePoses(NamedTuple):
    """Start of the fits of one frame: poses of its bodies, and all its spheres."""

    frame: int
    body: Ints
    center: Floats
    rotation: Floats
    spheres: Floats
    owner: Ints  # body of each sphere, -1 for none


def fit_poses(
    stack: Stack,
    motions: Mapping[int, tuple[RigidMotion, Ints]],
    *,
    optics: Optics,
    features: pd.DataFrame,
    folder: Path,
    work: Work,
) -> tuple[dict[int, RigidMotion], Findings]:
    """Fit the pose of every body in every frame to the images.

    Parameters
    ----------
    stack : Stack
    motions : mapping
        Motion of each cluster, and the stack's frame of each of its rows.
    optics : Optics
    features : pandas.DataFrame
        All spheres, with ``cluster``: the intensity of other spheres is excluded from the fit of a
        body.
    folder : Path
        Folder of the parts. Parts of other bodies are removed.
    work : Work

    Returns
    -------
    motions : dict of RigidMotion
        If a fit does not converge, the pose of the free centres remains.
    findings : Findings
        Number of fits that did not converge, and damaged parts.
    """
    templates = {c: motion.template for c, (motion, _) in motions.items()}
    places = features[["x", "y", "z"]].to_numpy(dtype=np.float64)
    owner = features["cluster"].to_numpy(dtype=np.int64)
    there = features.reset_index(drop=True).groupby("frame").indices
    bodies: dict[int, list[tuple[int, Floats, Floats]]] = {}
    for cluster, (motion, frames) in motions.items():
        for row in motion.fitted.tolist():
            pose = (cluster, motion.center[row], motion.rotation[row])
            bodies.setdefault(int(frames[row]), []).append(pose)
    starts = {
        i: _FramePoses(
            i,
            np.array([cluster for cluster, _, _ in bodies[i]]),
            np.array([center for _, center, _ in bodies[i]]),
            np.array([rotation for _, _, rotation in bodies[i]]),
            places[there[i]],
            owner[there[i]],
        )
        for i in sorted(bodies)
    }
    total = hashlib.sha256()
    for cluster, template in templates.items():
        total.update(np.int64(cluster).tobytes() + template.tobytes())
    for start in starts.values():
        for part in start[1:]:
            total.update(np.ascontiguousarray(part).tobytes())
    settings = {"starts": total.hexdigest(), "optics": optics.to_dict()}
    try:
        open_parts(folder, settings)
    except ValueError:
        # Poses follow from the located spheres; those of other bodies are useless.
        shutil.rmtree(folder)
        open_parts(folder, settings)
    task = _PoseTask(_without_times(stack), optics, templates)
    rows, _, notes = run_frames(task, starts, folder=folder, work=work, title="fitting poses")

    fitted = {}
    for cluster, (motion, frames) in motions.items():
        fits = rows[(rows["cluster"] == cluster) & rows["x"].notna()]
        row_of = {int(frame): k for k, frame in enumerate(frames)}
        number = fits["frame"].to_numpy()
        pose = fits[list(_POSE)].to_numpy(dtype=np.float64)
        spread = fits[list(_SPREAD)].to_numpy(dtype=np.float64)
        poses = {
            row_of[int(i)]: Pose(p[:3], p[3:].reshape(3, 3), s[:9].reshape(3, 3), float(s[9]))
            for i, p, s in zip(number, pose, spread, strict=True)
        }
        fitted[cluster] = with_poses(motion, poses)
    findings = unsettled_poses(int(rows["x"].isna().sum()), len(rows))
    return fitted, findings + Findings(notes=tuple(notes))


# Columns of a pose: centre and rotation matrix.
_POSE = ("x", "y", "z", *(f"r{i}{j}" for i in range(3) for j in range(3)))

# Columns of its error: covariance of the rotation vector, and variance of the centre.
_SPREAD = (*(f"c{i}{j}" for i in range(3) for j in range(3)), "variance")


@dataclass(frozen=True)
class _PoseTask:
    """Fit the poses of one frame."""

    stack: Stack
    optics: Optics
    templates: Mapping[int, Floats]

    def __call__(self, item: _FramePoses) -> tuple[pd.DataFrame, dict[str, Any]]:
        import pandas as pd

        frame = without_clipped(np.asarray(self.stack.frame(item.frame)))
        z, y, x = (float(h) for h in self.stack.voxel)
        image = self.optics.image((z, y, x))
        lines = []
        for body, center, rotation in zip(item.body, item.center, item.rotation, strict=True):
            start = RigidCenters(center, rotation, self.templates[int(body)])
            others = item.spheres[item.owner != body]
            pose = pose_in(frame, start, image, self.optics.noise, others=others)
            if pose is not None:
                spread = [*pose.turn_covariance.ravel(), pose.center_variance]
                lines.append([*pose.center, *pose.rotation.ravel(), *spread])
            else:
                lines.append([np.nan] * len((*_POSE, *_SPREAD)))
        table = pd.DataFrame(np.array(lines), columns=[*_POSE, *_SPREAD])
        table.insert(0, "frame", item.frame)
        table.insert(1, "cluster", item.body)
        return table, {"frame": item.frame}
