"""The long stages of a run, frame by frame and kept as they go: finding spheres, fitting poses."""

from __future__ import annotations

import hashlib
import json
import warnings
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np

from perrin.errors import FrameError, PrecisionWarning, TooFewFramesError
from perrin.images.optics.optics import Optics
from perrin.images.optics.window_fit import RigidCenters
from perrin.images.spheres.localisation import Method, choose_method, found_table, sample_frames
from perrin.images.spheres.poses import Pose, pose_in, with_poses
from perrin.movie.parts import PartWriter, open_parts, read_parts
from perrin.movie.workers import work_through
from perrin.tracks.writing import written_whole

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence
    from pathlib import Path

    import pandas as pd

    from perrin._arrays import Floats, Ints
    from perrin.images.spheres.localisation import Refine, SampledFrame, Search
    from perrin.images.stack import Stack
    from perrin.motion.rigid_motion import RigidMotion

    Progress = Callable[[int, int, str], None]


S = TypeVar("S")


_METHOD = "method.json"


@dataclass(frozen=True)
class Workplace:
    """Where the work is done and kept.

    Attributes
    ----------
    folder : Path
        Of the finished parts.
    workers : int
        Processes of this machine; 0 is this one.
    scheduler : str or None
        Address of a Dask scheduler.
    progress : callable or None
        Called with (done, total, title).
    """

    folder: Path
    workers: int = 0
    scheduler: str | None = None
    progress: Progress | None = None

    def kept(
        self,
        task: Callable[[S], tuple[pd.DataFrame, dict[str, Any]]],
        items: Mapping[int, S],
        *,
        title: str,
    ) -> tuple[pd.DataFrame, pd.DataFrame, list[str]]:
        """Do what is not done yet, item by item, each known by its frame.

        Returns
        -------
        rows, entries : DataFrame
            What the task made of all items, in the order of the frames.
        remade : list of str
            Which parts had to be made again.
        """
        import pandas as pd

        table, entries, damaged = read_parts(self.folder)
        done = {int(e["frame"]) for e in entries}
        todo = [item for frame, item in items.items() if frame not in done]
        count = len(items) - len(todo)
        self.tell(count, len(items), title)
        if todo:
            with PartWriter(self.folder) as writer:
                for rows, entry in work_through(
                    task, todo, workers=self.workers, scheduler=self.scheduler
                ):
                    writer.add(rows, entry)
                    count += 1
                    self.tell(count, len(items), title)
            table, entries, _ = read_parts(self.folder)
        listed = pd.DataFrame(entries).sort_values("frame", ignore_index=True)
        rows = table.sort_values("frame", kind="stable", ignore_index=True)
        remade = f"{len(damaged)} damaged parts in {self.folder} were made again"
        return rows, listed, [remade] if damaged else []

    def tell(self, done: int, total: int, title: str) -> None:
        """Say how far the work is."""
        if self.progress is not None:
            self.progress(done, total, title)


class Located(NamedTuple):
    """What `locate_frames` found.

    `features` is the table of `locate`, `frames` and `spots` are those of `Imaging`, `told` what
    was doubtful in choosing the method, `remade` which parts had to be made again.
    """

    method: Method
    features: pd.DataFrame
    frames: pd.DataFrame
    spots: pd.DataFrame
    told: list[str]
    remade: list[str]


def locate_frames(
    stack: Stack,
    search: Search,
    *,
    refine: Refine,
    optics: Optics | None,
    frames: Sequence[int],
    settings: Mapping[str, Any],
    place: Workplace,
) -> Located:
    """Find and refine the spheres of many frames, going on where an earlier call stopped.

    Parameters
    ----------
    stack : Stack
    search, refine, optics
        As in `choose_method`; what is open is learned once and kept with the parts.
    frames : sequence of int
    settings : mapping
        All that the answer depends on; parts of other settings are refused.
    place : Workplace

    Raises
    ------
    PartsError
        If the folder holds the parts of another run.
    """
    import pandas as pd

    known = place.folder / _METHOD
    if known.exists():
        open_parts(place.folder, settings)
        learned = json.loads(known.read_text(encoding="utf-8"))
    else:
        place.tell(0, 0, "learning mass cut and optics")
        learned = _learned(stack, search, refine=refine, optics=optics, frames=frames)
        open_parts(place.folder, settings)
        with written_whole(known) as beside:
            beside.write_text(json.dumps(learned), encoding="utf-8")
    found = learned["optics"]
    method = Method(
        replace(search, minmass=learned["minmass"]),
        refine,
        None if found is None else Optics.from_dict(found),
    )
    task = _Locate(_light(stack), method)
    rows, entries, remade = place.kept(task, {i: i for i in frames}, title="locating spheres")
    entries.insert(1, "time", stack.times[entries["frame"].to_numpy()])
    entries["copy_of"] = _first_alike(entries)
    rows = rows[~rows["frame"].isin(entries.loc[entries["copy_of"] >= 0, "frame"])]
    spots = pd.DataFrame(learned["spots"], columns=["frame", "mass"])
    return Located(
        method,
        rows.reset_index(drop=True),
        entries.drop(columns="digest"),
        spots,
        learned["told"],
        remade,
    )


def _first_alike(entries: pd.DataFrame) -> Ints:
    """Return the earlier frame that each frame repeats exactly; -1 where it repeats none.

    Frames without a sphere are empty, whether they are alike or not.
    """
    first = entries.groupby("digest")["frame"].transform("min")
    alike = (entries["digest"] != "") & (entries["spheres"] > 0) & (first < entries["frame"])
    return np.where(alike, first, -1).astype(np.int64)


def _learned(
    stack: Stack,
    search: Search,
    *,
    refine: Refine,
    optics: Optics | None,
    frames: Sequence[int],
) -> dict[str, Any]:
    """Learn from a few frames how all are to be treated; plain values as JSON holds them."""
    sample = sample_frames(stack, search, frames)
    _refuse_still(stack, sample, frames)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", PrecisionWarning)
        method = choose_method(stack, search, sample, refine=refine, optics=optics)
    return {
        "minmass": method.search.minmass,
        "optics": None if method.optics is None else asdict(method.optics),
        "spots": [[seen.number, mass] for seen in sample for mass in seen.spots.mass.tolist()],
        "told": [str(one.message) for one in said],
    }


def _refuse_still(stack: Stack, sample: Sequence[SampledFrame], frames: Sequence[int]) -> None:
    """Refuse a movie all of whose frames are the same image; one without any contrast is not one.

    Raises
    ------
    TooFewFramesError
    """
    first = sample[0].frame
    if first.min() == first.max() or len(frames) < 2:
        return
    if not all(np.array_equal(seen.frame, first) for seen in sample):
        return
    try:
        same = all(np.array_equal(stack.frame(i), first) for i in frames)
    except FrameError:
        return
    if same:
        raise TooFewFramesError(
            f"all {len(frames)} frames are exactly the same image, voxel by voxel: the movie shows "
            f"no motion, one image was written {len(frames)} times",
            1,
        )


@dataclass(frozen=True)
class _Locate:
    """Finds the spheres of one frame."""

    stack: Stack
    method: Method

    def __call__(self, i: int) -> tuple[pd.DataFrame, dict[str, Any]]:
        entry: dict[str, Any] = {"frame": i, "spots": 0, "spheres": 0}
        try:
            found = self.method.locate_in(self.stack, i)
        except FrameError as fault:
            nothing = {"level": np.nan, "saturated": np.nan, "digest": "", "fault": str(fault)}
            return found_table([]), entry | nothing
        entry |= {"spots": found.spots, "spheres": len(found.columns["mass"])}
        entry |= {"level": found.level, "saturated": found.saturated, "digest": found.digest}
        entry["fault"] = ""
        return found_table([found]), entry


def _light(stack: Stack) -> Stack:
    """Return the stack without its times, which workers need not be sent."""
    return replace(stack, times=np.empty(0))


class _Standing(NamedTuple):
    """One frame's bodies (which, centres, rotations) and all its spheres, x, y, z."""

    frame: int
    body: Ints
    center: Floats
    rotation: Floats
    spheres: Floats
    owner: Ints


def fit_poses(
    stack: Stack,
    motions: Mapping[int, tuple[RigidMotion, Ints]],
    *,
    optics: Optics,
    features: pd.DataFrame,
    place: Workplace,
) -> tuple[dict[int, RigidMotion], int, int, list[str]]:
    """Fit the pose of every body in every frame to the images.

    Parameters
    ----------
    stack : Stack
    motions : mapping
        Motion of each cluster and the stack's frame of each of its rows.
    optics : Optics
    features : DataFrame
        All spheres, with ``cluster``: light of other spheres is left out of a body's fit.
    place : Workplace

    Returns
    -------
    motions : dict of RigidMotion
        Where a fit does not settle the pose of the free centres stays.
    unsettled, count : int
        How many fits did not settle, of how many.
    remade : list of str
        Which parts had to be made again.
    """
    templates = {c: motion.template for c, (motion, _) in motions.items()}
    items = _standing(motions, features)
    settings = {"starts": _digest(templates, items.values()), "optics": asdict(optics)}
    if place.folder.exists() and not _same(place.folder, settings):
        import shutil

        # Poses follow from what was located: those of other bodies are of no use to anybody.
        shutil.rmtree(place.folder)
    open_parts(place.folder, settings)
    task = _Stand(_light(stack), optics, templates)
    rows, _, remade = place.kept(task, items, title="fitting poses")
    return _reposed(motions, rows), int(rows["x"].isna().sum()), len(rows), remade


def _same(folder: Path, settings: Mapping[str, Any]) -> bool:
    try:
        open_parts(folder, settings)
    except ValueError:
        return False
    return True


def _standing(
    motions: Mapping[int, tuple[RigidMotion, Ints]], features: pd.DataFrame
) -> dict[int, _Standing]:
    """Return for every frame with a body what its fits start from."""
    starts: dict[int, list[tuple[int, Floats, Floats]]] = {}
    for cluster, (motion, frames) in motions.items():
        for row in motion.fitted.tolist():
            start = (cluster, motion.center[row], motion.rotation[row])
            starts.setdefault(int(frames[row]), []).append(start)
    places = features[["x", "y", "z"]].to_numpy(dtype=np.float64)
    owner = features["cluster"].to_numpy(dtype=np.int64)
    rows = features.reset_index(drop=True).groupby("frame").indices
    return {
        i: _Standing(
            i,
            np.array([c for c, _, _ in starts[i]]),
            np.array([x for _, x, _ in starts[i]]),
            np.array([r for _, _, r in starts[i]]),
            places[rows[i]],
            owner[rows[i]],
        )
        for i in sorted(starts)
    }


def _digest(templates: Mapping[int, Floats], items: Iterable[_Standing]) -> str:
    total = hashlib.sha256()
    for cluster, template in templates.items():
        total.update(np.int64(cluster).tobytes() + template.tobytes())
    for item in items:
        for part in item[1:]:
            total.update(np.ascontiguousarray(part).tobytes())
    return total.hexdigest()


_POSE = ("x", "y", "z", *(f"r{i}{j}" for i in range(3) for j in range(3)))


_SPREAD = (*(f"c{i}{j}" for i in range(3) for j in range(3)), "variance")


@dataclass(frozen=True)
class _Stand:
    """Fits the poses of one frame."""

    stack: Stack
    optics: Optics
    templates: Mapping[int, Floats]

    def __call__(self, item: _Standing) -> tuple[pd.DataFrame, dict[str, Any]]:
        import pandas as pd

        frame = np.asarray(self.stack.frame(item.frame), dtype=np.float64)
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


def _reposed(
    motions: Mapping[int, tuple[RigidMotion, Ints]], rows: pd.DataFrame
) -> dict[int, RigidMotion]:
    answer = {}
    for cluster, (motion, frames) in motions.items():
        mine = rows[(rows["cluster"] == cluster) & rows["x"].notna()]
        row_of = {int(frame): k for k, frame in enumerate(frames)}
        number = mine["frame"].to_numpy()
        pose = mine[list(_POSE)].to_numpy(dtype=np.float64)
        spread = mine[list(_SPREAD)].to_numpy(dtype=np.float64)
        poses = {
            row_of[int(i)]: Pose(p[:3], p[3:].reshape(3, 3), s[:9].reshape(3, 3), float(s[9]))
            for i, p, s in zip(number, pose, spread, strict=True)
        }
        answer[cluster] = with_poses(motion, poses)
    return answer
