"""Texts of all warnings and notes of `analyze`, and how those of one kind are merged."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from perrin._text import counted, frames_text, listed, with_error
from perrin.diffusion.step_tests import JUMP_LEVEL, STAGE_LEVEL
from perrin.tracks.screening import far_sentence

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from perrin._arrays import Bools, Floats, Ints
    from perrin.diffusion.estimate import DiffusionEstimate
    from perrin.diffusion.noise_model import Noise
    from perrin.diffusion.step_tests import Jumps, StageJumps, SteadyMotion
    from perrin.diffusion.steps import Quantity
    from perrin.diffusion.verdict import MotionVerdict
    from perrin.motion.common_motion import CommonMotion


CONSTANT_Z = "z never changes: leave the column out to analyse motion in the plane"
ROD_TESTS = "jumps and a steady motion of a rod are not tested for"
ROD_DRIFT = "drift=True is not applied to rods: D_T and D_perp contain a mean motion"

UNMOVED = (
    "the body does not move at all, its frames are equal: one frame was copied, or its particles "
    "are fixed"
)

TOO_FAST = (
    "identity: the body turns too far between frames for its symmetry; cutting the longest steps "
    "makes D_R too low: sample faster"
)

# A remark on at most this share of the frames is a note.
_SHARE_FOR_NOTE = 0.01

# Jumps whose lengths differ by less than this share are all of one length.
_ONE_LENGTH = 0.3

# A motion that all bodies share is named below this chance and above this share of the mean square
# step: two spheres in a fluid, three radii apart, share a third.
_COMMON_LEVEL, _COMMON_SHARE = 1e-4, 0.35
_AXIS_ERRORS = 3.0  # of the covariance along an axis that is named

# A track is cut too often beyond this share of the frames.
_SHARE_OF_CUTS = 0.02

_ANGLES_SHOWN, _JUMPS_SHOWN = 5, 5

_NOT_DIFFUSION = "not diffusion:"

NOT_JUDGED = "fewer than 20 steps, or no motion"

# What a motion shows, by its kind.
_SHOWN_KINDS = {
    "subdiffusion": "subdiffusion",
    "superdiffusion": "superdiffusion",
    "confined": "confinement",
    "drift": "a drift",
    "spin": "a spin",
    "changing D": "a diffusion coefficient that changes in time",
    "jumps": "jumps",
    "vibration": "a vibration",
}

# At least one of this number of frame numbers occurs; numbers that are times in ms are sparser.
SPARSE = 100


@dataclass(frozen=True)
class Remarks:
    """Warnings and notes on a table as a whole, or on one cluster.

    Attributes
    ----------
    warnings : list of str
        Reasons to doubt the results.
    notes : list of str
        How the table was read, what was left out, and what was corrected.
    """

    warnings: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def __add__(self, other: Remarks) -> Remarks:
        return Remarks([*self.warnings, *other.warnings], [*self.notes, *other.notes])

    def add(self, text: str, *, frames: int, of: int) -> None:
        """Add a remark on some of the frames: a note up to 1 % of them, beyond it a warning."""
        (self.warnings if frames > _SHARE_FOR_NOTE * of else self.notes).append(text)


_NUMBER_TEXT = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?:\(\d+\))?|\b(?:nan|inf)\b")

# Words that change with the number before or after them (lists, plurals, verbs), and what
# replaces them.
_WORDS_BY_NUMBER = (
    (re.compile(r"\bcluster [^\s:,;]+"), "cluster #"),
    (re.compile(r"#(?:, #)*(?: and # more|, \.\.\.)?"), "#"),
    (re.compile(r"(\w)s (?=#)"), r"\1 "),
    (re.compile(r"(?<=# )(\w+)s\b"), r"\1"),
    (re.compile(r"\b(?:has|have)\b"), "have"),
    (re.compile(r"\b(?:is|are)\b"), "are"),
    (re.compile(r"(#[^;()]*)(?:; \1)+"), r"\1"),
)


@dataclass(frozen=True)
class Remark:
    """One warning or note, and the clusters that have it.

    Attributes
    ----------
    text : str
        The remark with the numbers of the first of the clusters.
    names : tuple of str
        Names of the clusters that have the remark.
    total : int
        Number of clusters that were compared.
    same : bool
        Whether the text is the same, numbers included, for all of `names`.
    """

    text: str
    names: tuple[str, ...]
    total: int
    same: bool = True

    def __str__(self) -> str:
        if self.total == 1:
            return self.text
        count = len(self.names)
        if count == 1:
            return f"cluster {self.names[0]}: {self.text}"
        where = f"in all {count} clusters"
        if count < self.total:
            where = f"in {count} of {self.total} clusters ({listed(self.names)})"
        example = "" if self.same else f", for example cluster {self.names[0]}"
        return f"{where}{example}: {self.text}"


def grouped(texts: Mapping[str, Sequence[str]]) -> list[Remark]:
    """Return the texts of clusters as remarks; texts that differ in numbers only are one.

    Parameters
    ----------
    texts : mapping of str to sequence of str
        The warnings (or notes) of every cluster by its name; of clusters without any an empty
        sequence, so that they are counted.

    Returns
    -------
    list of Remark
        In the order in which they first occur. Numbers, lists of numbers and the names of the
        clusters do not distinguish texts. Two texts of one cluster are never joined.

    Examples
    --------
    >>> (one,) = grouped({"a": ["12 rows are missing"], "b": ["1 row is missing"], "c": []})
    >>> one.names, one.same
    (('a', 'b'), False)
    """
    found: dict[tuple[str, int], list[tuple[str, str]]] = {}
    for name, own in texts.items():
        kinds: list[str] = []
        for text in own:
            kind = _text_without_numbers(text.replace(f"cluster {name}", "cluster #"))
            found.setdefault((kind, kinds.count(kind)), []).append((name, text))
            kinds.append(kind)
    return [
        Remark(
            text=pairs[0][1],
            names=tuple(name for name, _ in pairs),
            total=len(texts),
            same=len({text for _, text in pairs}) == 1,
        )
        for pairs in found.values()
    ]


def merged(texts: Mapping[str, Sequence[str]]) -> list[str]:
    """Return the texts of clusters as lines, one line for those that differ in numbers only.

    Parameters
    ----------
    texts : mapping of str to sequence of str
        As in `grouped`.

    Returns
    -------
    list of str

    Examples
    --------
    >>> for line in merged({"0": ["2 rows are missing"], "1": ["3 rows are missing"], "2": []}):
    ...     print(line)
    in 2 of 3 clusters (0, 1), for example cluster 0: 2 rows are missing
    """
    return [str(remark) for remark in grouped(texts)]


def condensed(texts: Iterable[str]) -> list[str]:
    """Return texts about a whole table, one line for those that differ in numbers only.

    Parameters
    ----------
    texts : iterable of str

    Returns
    -------
    list of str
        The first text of each kind, with the number of the others.

    Examples
    --------
    >>> condensed([f"cluster {k} was left out: 2 frames" for k in range(5)])
    ['cluster 0 was left out: 2 frames (and 4 more of this kind)']
    """
    kinds: dict[str, list[str]] = {}
    for text in texts:
        kinds.setdefault(_text_without_numbers(text), []).append(text)
    return [
        first + (f" (and {len(more)} more of this kind)" if more else "")
        for first, *more in kinds.values()
    ]


def _text_without_numbers(text: str) -> str:
    """Return a text without its numbers, as far as they show in its words."""
    kind = _NUMBER_TEXT.sub("#", text)
    for pattern, common in _WORDS_BY_NUMBER:
        kind = pattern.sub(common, kind)
    return kind


# Tables and frames.


def grouping_note(cluster: Ints, *, particles: int) -> str:
    """State which clusters were found without a column and without a contact distance.

    Parameters
    ----------
    cluster : ndarray of int
        Cluster numbers of all rows.
    particles : int
        Number of particles of the table.

    Examples
    --------
    >>> grouping_note(np.array([0, 0, 0]), particles=3)
    'no cluster column and no contact distance: all 3 particles are taken as one cluster'
    """
    start = "no cluster column and no contact distance"
    if (cluster == 0).all():
        return f"{start}: all {particles} particles are taken as one cluster"
    return (
        f"{start}: {int(cluster.max()) + 1} bodies found by the distances that stay the same, "
        f"among {particles} particles"
    )


def loose_particles_note(count: int) -> str:
    """State how many particles belong to no cluster.

    Examples
    --------
    >>> loose_particles_note(3)
    '3 particles belong to no cluster: left out'
    """
    return f"{counted(count, 'particle', 'belong')} to no cluster: left out"


def stretched_pairs_warning(factor: float, pairs: int) -> str:
    """State that distances stay the same with another scale of z.

    Examples
    --------
    >>> stretched_pairs_warning(2.17, 15)[:66]
    'z scale: with z multiplied by 2.17 the distances of 15 pairs of pa'
    """
    return (
        f"z scale: with z multiplied by {factor:.3g} the distances of {pairs} pairs of particles "
        "stay the same, which most are not now: state the scale as three numbers, for x, y and z"
    )


def no_cluster_text(contact: float | None, *, marked: bool) -> str:
    """Return the error of a table without any cluster, with what to do.

    Parameters
    ----------
    contact : float or None
        The stated contact distance, um.
    marked : bool
        Whether the table has a column cluster.

    Examples
    --------
    >>> no_cluster_text(2.0, marked=False)
    'no cluster: every particle is loose at contact = 2.0 um; correct that, or the scale'
    """
    if marked:
        return "no cluster: every particle is marked as loose (-1); correct that, or the scale"
    if contact is not None:
        how = f"loose at contact = {contact} um"
        return f"no cluster: every particle is {how}; correct that, or the scale"
    return (
        "no cluster: no two particles keep their distance (to a tenth, over 8 frames or more): "
        "state the centre distance of touching particles (contact=), or give a column cluster"
    )


def absent_frames_notes(recorded: Ints, stride: Sequence[str], *, first_frame: int) -> list[str]:
    """Note frame numbers that no row has; where they have a stride, that explains them.

    Parameters
    ----------
    recorded : ndarray of int
        Frames that have rows, counted from the first.
    stride : sequence of str
        What `frame_stride` states.
    first_frame : int
        The table's own number of its first frame.

    Examples
    --------
    >>> absent_frames_notes(np.array([0, 1, 3]), (), first_frame=7)[0][:48]
    '1 frame number has no row (the first is 9): a st'
    """
    absent = int(recorded[-1]) + 1 - len(recorded)
    if stride or not absent or absent > SPARSE * len(recorded):
        return list(stride)
    before = recorded[np.flatnonzero(np.diff(recorded) > 1)[:1]]
    count = "1 frame number has" if absent == 1 else f"{absent} frame numbers have"
    return [
        f"{count} no row (the first is {int(before[0]) + 1 + first_frame}): a step across them is "
        "one longer step"
    ]


def sparse_frames_warnings(recorded: Ints) -> list[str]:
    """Warn where fewer than one in 100 of the frame numbers occurs: they are probably times.

    Parameters
    ----------
    recorded : ndarray of int
        Frames that have rows, counted from the first.

    Examples
    --------
    >>> sparse_frames_warnings(np.array([0, 1, 2]))
    []
    >>> sparse_frames_warnings(np.array([0, 500, 1000]))[0][:50]
    'frame numbers: only 3 of the 1001 numbers from the'
    """
    span = int(recorded[-1]) + 1
    if span <= SPARSE * len(recorded) or len(recorded) < 2:
        return []
    return [
        f"frame numbers: only {len(recorded)} of the {span} numbers from the first to the last "
        "occur, and each counts dt; if they are times, number the frames 0, 1, 2, ... and state "
        "the times in a column time"
    ]


def left_out_warnings(failures: Iterable[tuple[str, Exception]]) -> list[str]:
    """Name the clusters that cannot be measured, those with the same reason in one line.

    Examples
    --------
    >>> left_out_warnings([("a", ValueError("1 frame")), ("b", ValueError("1 frame"))])
    ['clusters a, b were left out: 1 frame']
    """
    by_reason: dict[str, list[str]] = {}
    for name, error in failures:
        by_reason.setdefault(str(error), []).append(name)
    return [
        f"cluster{'s' if len(names) > 1 else ''} {listed(names)} "
        f"{'were' if len(names) > 1 else 'was'} left out: {reason}"
        for reason, names in by_reason.items()
    ]


def assumed_exposure_notes(noise: Noise) -> list[str]:
    """State which exposure is assumed where the noise is not fitted and the exposure is unknown.

    Examples
    --------
    >>> from perrin.diffusion.noise_model import Noise
    >>> assumed_exposure_notes(Noise())
    []
    >>> assumed_exposure_notes(Noise("residual"))[0][:57]
    'noise residual: the exposure is not stated and taken as 0'
    """
    if noise.model == "joint" or noise.exposure is not None:
        return []
    return [
        f"noise {noise.model}: the exposure is not stated and taken as 0; a shutter that is "
        "open all the time would make D up to 26 % low"
    ]


# Identity and poses of one cluster.


def far_points_notes(far: Bools, frames: Ints) -> list[str]:
    """State which points were left out because they lie far from the body.

    Parameters
    ----------
    far : ndarray of bool, shape (T, n)
    frames : ndarray of int, shape (T,)
        The table's own frame numbers.
    """
    return [far_sentence(far, frames)] if far.any() else []


def corrected_labels_text(frames: Ints, *, misfit: float, usual: float) -> str:
    """State where labels were corrected.

    Parameters
    ----------
    frames : ndarray of int
        The table's own frame numbers.
    misfit, usual : float
        Largest residual that the labels as they came would have left, um (NaN where unknown), and
        the median residual of all frames, um.

    Examples
    --------
    >>> corrected_labels_text(np.array([7]), misfit=np.nan, usual=0.02)
    'identity: labels change particles at frame 7; corrected'
    """
    residual = ""
    if np.isfinite(misfit):
        residual = f" (residual as labelled up to {misfit:.3g} um against {usual:.3g} median)"
    return f"identity: labels change particles at {frames_text(frames)}; corrected{residual}"


def cut_text(frames: Ints, *, angles: Floats, symmetry: str) -> str:
    """State where the track was cut because the labels are in doubt.

    Parameters
    ----------
    frames : ndarray of int
        The table's own frame numbers.
    angles : ndarray
        Step angles at the cuts where they are known, rad.
    symmetry : str
        Point group of the body.
    """
    turns = ""
    if angles.size:
        shown = ", ".join(f"{a:.0f}" for a in np.rad2deg(angles[:_ANGLES_SHOWN]))
        more = ", ..." if angles.size > _ANGLES_SHOWN else ""
        turns = (
            f" (step angle{'s' if angles.size > 1 else ''} {shown}{more} deg: a jump of the body's "
            f"symmetry, {symmetry}, cannot be distinguished from a real turn)"
        )
    return (
        "identity: which label belongs to which particle is in doubt at "
        f"{frames_text(frames)}; the track is cut there{turns}"
    )


def extra_detection_text(frames: Ints) -> str:
    """State where a detection was left out because it is no particle of the body.

    Examples
    --------
    >>> extra_detection_text(np.array([7]))
    'identity: a detection that is no particle of the body is left out at frame 7'
    """
    return (
        f"identity: a detection that is no particle of the body is left out at "
        f"{frames_text(frames)}"
    )


def unsettled_notes(frames: Ints, *, of: int) -> list[str]:
    """State which of `of` frames fit the common shape in no assignment of labels.

    Examples
    --------
    >>> unsettled_notes(np.array([7]), of=300)[0][:64]
    'identity: 1 of 300 frames fit the common shape in no assignment '
    """
    if not frames.size:
        return []
    return [
        f"identity: {frames.size} of {of} frames fit the common shape in no assignment "
        f"({frames_text(frames)}); they keep their labels"
    ]


def fast_turning_warnings(*, cuts: int, of: int) -> list[str]:
    """Warn where the track is cut in more than 2 % of `of` frames.

    Examples
    --------
    >>> fast_turning_warnings(cuts=6, of=300), len(fast_turning_warnings(cuts=7, of=300))
    ([], 1)
    """
    return [TOO_FAST] if cuts > _SHARE_OF_CUTS * of else []


def no_pose_notes(reasons: Iterable[str], recorded: Bools) -> list[str]:
    """State how many of the recorded frames have no pose, and why.

    Parameters
    ----------
    reasons : iterable of str
        Why a frame has no pose; empty where it has one.
    recorded : ndarray of bool
        Which of these frames were recorded.
    """
    refused = [r for r, seen in zip(reasons, recorded, strict=True) if r and seen]
    if not refused:
        return []
    kinds = {r: refused.count(r) for r in sorted(set(refused))}
    by_kind = "; ".join(f"{count} x {reason}" for reason, count in kinds.items())
    return [f"frames without a pose: {len(refused)} of {np.count_nonzero(recorded)} ({by_kind})"]


def no_rotation_note(particles: int) -> str:
    """State why particles on one line have no D_R."""
    return (
        f"no D_R: {particles} particles on one line have a direction but no full "
        "orientation; D_perp is how fast that direction diffuses"
    )


def exchanged_ends_text(frames: Ints) -> str:
    """State where the labels of a rod's ends were corrected."""
    return f"identity: the ends exchange labels at {frames_text(frames)}; corrected"


def doubtful_ends_warning(frames: Ints) -> str:
    """Warn where the ends of a rod cannot be distinguished."""
    return f"identity: the ends may be mistaken at {frames_text(frames)}; the track is cut"


# Coefficients of one cluster.


def jump_warning(jumps: Jumps, frames: Ints, quantity: Quantity, *, kept: bool) -> str:
    """Name the steps that Brownian motion cannot make, with frame and size.

    Parameters
    ----------
    jumps : Jumps
    frames : ndarray of int
        The table's own frame number of each jump.
    quantity : {"rotation", "translation"}
    kept : bool
        Whether the estimate contains the jumps.
    """
    turn = quantity == "rotation"
    name, unit = ("D_R", "deg") if turn else ("D_T", "um")
    what = "the body turns" if turn else "the centre moves"
    length = np.rad2deg(jumps.length) if turn else jumps.length
    wrapped = "" if turn else wrapped_box_text(jumps.size)
    if jumps.many:
        return (
            f"steps: {what} in {len(frames)} of {jumps.n_steps} steps farther than Brownian motion "
            f"can (the longest {length.max():.3g} {unit}, at frame {frames[np.argmax(length)]})"
            f"{wrapped}: this number of jumps usually indicates another kind of motion (hops, a "
            f"changing D, heavy tails), which one {name} does not describe; they are left in"
        )
    done = f"{name} contains them" if kept else f"{name} leaves them out (keep_jumps keeps them)"
    if len(frames) == 1:
        done = done.replace("them", "it")
    shown = listed([f"{one:.3g}" for one in length])
    return (
        f"jump: {what} by {shown} {unit} in one step, at {frames_text(frames)}"
        f"{wrapped}; Brownian motion does so with a probability below "
        f"{JUMP_LEVEL:g} in the whole track; {done}"
    )


def stage_jump_warnings(stage: StageJumps, *, first_frame: int, kept: bool) -> list[str]:
    """Name the jumps of the stage, with frame and displacement.

    Parameters
    ----------
    stage : StageJumps
        Common displacements of all bodies, with frames counted from the table's first.
    first_frame : int
        The table's own number of its first frame.
    kept : bool
        Whether the estimates contain the jumps.

    Examples
    --------
    >>> from perrin.diffusion.step_tests import StageJumps
    >>> one = StageJumps(
    ...     np.array([9]), np.array([[1.2, 0.0, 0.1]]), np.full((1, 3), 0.12), np.zeros(1),
    ...     np.array([4]),
    ... )
    >>> stage_jump_warnings(one, first_frame=1, kept=False)[0][:76]
    'stage jump: 4 clusters move together by (1.2, 0, 0.1) +- 0.12 um at frame 10'
    """
    texts = []
    done = "D_T contains it" if kept else "D_T leaves this step out (keep_jumps keeps it)"
    for k in range(min(len(stage.frames), _JUMPS_SHOWN)):
        size = ", ".join(f"{x:.2g}" for x in stage.size[k])
        error = float(np.sqrt(np.mean(stage.stderr[k] ** 2)))
        texts.append(
            f"stage jump: {stage.bodies[k]} clusters move together by ({size}) +- {error:.2g} um "
            f"at frame {stage.frames[k] + first_frame}: the stage or the camera moved; diffusion "
            f"does so with a probability below {STAGE_LEVEL:g}; {done}; D_R is not affected"
        )
    more = len(stage.frames) - _JUMPS_SHOWN
    return [*texts, f"stage jump: {more} more"] if more > 0 else texts


def wrapped_box_text(size: Floats) -> str:
    """Return what jumps (K, d) of one length along one axis each suggest: a periodic box."""
    if len(size) < 2:
        return ""
    lengths = np.sort(np.abs(size), axis=1)
    largest = lengths[:, -1]
    usual = float(np.median(largest))
    alike = np.mean(np.abs(largest - usual) < _ONE_LENGTH * usual)
    if alike < 0.8 or np.mean(lengths[:, -2] < 0.5 * largest) < 0.8:
        return ""
    return f", most of them by about {usual:.3g} um along one axis, as coordinates wrapped in a box"


def common_jump_warnings(jumps: Iterable[tuple[str, Ints, Floats]]) -> list[str]:
    """Name frames at which several clusters jump, with what the displacements suggest.

    Parameters
    ----------
    jumps : iterable of tuple
        Name of a cluster, the table's own frame numbers (K,) of its jumps, and the displacements
        (K, d) of its centre, um.

    Examples
    --------
    >>> one, other = np.array([[3.0, 0.0, 0.0]]), np.array([[3.1, 0.0, 0.0]])
    >>> common_jump_warnings([("a", np.array([9]), one), ("b", np.array([9]), other)])
    ['jump: clusters a, b jump at the same frame 9: the stage or the camera moved']
    """
    at_frame: dict[int, list[tuple[str, Floats]]] = {}
    for name, frames, sizes in jumps:
        for frame, move in zip(frames, sizes, strict=True):
            at_frame.setdefault(int(frame), []).append((name, move))
    warnings = []
    shared = sorted((frame, found) for frame, found in at_frame.items() if len(found) > 1)
    for frame, found in shared[:_JUMPS_SHOWN]:
        moves = np.array([move for _, move in found])
        typical = float(np.mean(np.linalg.norm(moves, axis=1)))
        together = float(np.linalg.norm(moves.mean(axis=0)))
        cause = "labels were exchanged, or the stage turned"
        if together > 0.8 * typical:
            cause = "the stage or the camera moved"
        elif together < 0.2 * typical:
            cause = "their labels were exchanged"
        names = listed(name for name, _ in found)
        warnings.append(f"jump: clusters {names} jump at the same frame {frame}: {cause}")
    return warnings


def common_motion_remarks(found: CommonMotion | None) -> Remarks:
    """Name a motion that all bodies share: a note where it is random from frame to frame.

    Random common positions are noise of the steps, which the joint fit separates from diffusion; a
    common motion that lasts is in D_T.

    Parameters
    ----------
    found : CommonMotion or None

    Examples
    --------
    >>> from perrin.motion.common_motion import CommonMotion
    >>> one = np.ones(3)
    >>> found = CommonMotion(0.01 * one, 1e-4 * one, 0.02 * one, -0.005 * one, 4, 1e-9)
    >>> common_motion_remarks(found).notes[0][:40]
    'common motion: the 4 bodies move togethe'
    """
    if found is None or found.p > _COMMON_LEVEL or found.share.max() < _COMMON_SHARE:
        return Remarks()
    along = np.flatnonzero(
        (found.share > _COMMON_SHARE / 2) & (found.covariance > _AXIS_ERRORS * found.stderr)
    )
    axes = listed("xyz"[k] for k in along)
    k = int(found.share.argmax())
    share = with_error(100 * found.share[k], 100 * found.stderr[k] / found.variance[k])
    size = 1e3 * float(np.sqrt(found.covariance[k]))
    text = (
        f"common motion: the {found.bodies} bodies move together along {axes}: {share} % of the "
        f"mean square step, {size:.3g} nm a frame"
    )
    if found.following[k] < -found.covariance[k] / 4:
        return Remarks(
            notes=[
                f"{text}, at random from frame to frame, as a stage or a focus that does not "
                "return to its place; joint noise (noise='joint') contains it, D is not affected"
            ]
        )
    return Remarks(
        [
            f"{text}: a drifting stage, a flow, or one fluid around bodies near each other; D_T "
            "contains this motion, D_R does not"
        ]
    )


def jumps_verdict_text(
    frames: Ints, quantity: Quantity, *, p: float, clusters: Sequence[str] = ()
) -> str:
    """Return the verdict on a motion with steps that Brownian motion does not make.

    Parameters
    ----------
    frames : ndarray of int
        The table's own frame numbers; empty for several clusters.
    quantity : {"rotation", "translation"}
    p : float
        Probability of such steps in Brownian motion.
    clusters : sequence of str
        Names of the clusters with such steps, where the verdict is one on several.

    Examples
    --------
    >>> jumps_verdict_text(np.array([150]), "translation", p=1e-9)
    'The translation has steps too long for diffusion, at frame 150 (p < 1e-6): a motion of the stage, exchanged labels, hops or heavy tails.'
    """  # noqa: E501
    where = ""
    if clusters:
        where = f", in cluster{'s' if len(clusters) > 1 else ''} {listed(clusters)}"
    elif len(frames):
        where = f", at {frames_text(frames)}"
    return (
        f"The {quantity} has steps too long for diffusion{where} ({_p_text(p)}): a motion of the "
        "stage, exchanged labels, hops or heavy tails."
    )


def with_jumps(
    verdict: MotionVerdict,
    frames: Ints,
    *,
    p: float,
    first_frame: int = 0,
    clusters: Sequence[str] = (),
) -> MotionVerdict:
    """Return the verdict "jumps" with its frames, in the words of `jumps_verdict_text`.

    Parameters
    ----------
    verdict : MotionVerdict
        Verdict of `judge_motion`, of whatever kind.
    frames : ndarray of int
        Frames of the jumps, counted from the table's first; empty for several clusters.
    p : float
        Probability of the jumps in Brownian motion; that of the verdict holds where it is smaller.
    first_frame : int
        The table's own number of its first frame.
    clusters : sequence of str
        Names of the clusters that jump, where the verdict is one on several.
    """
    p_family = min(p, verdict.p_family)
    return replace(
        verdict,
        kind="jumps",
        model=None,
        p_family=p_family,
        frames=tuple(int(frame) for frame in frames),
        text=jumps_verdict_text(
            frames + first_frame, verdict.quantity, p=p_family, clusters=clusters
        ),
    )


def is_not_diffusion(text: str) -> bool:
    """Return whether a warning is one of `not_diffusion_warning`.

    Examples
    --------
    >>> is_not_diffusion("not diffusion: the rotation is confined"), is_not_diffusion("jump: 3 um")
    (True, False)
    """
    return text.startswith(_NOT_DIFFUSION)


def not_diffusion_warning(verdict: MotionVerdict, estimate: DiffusionEstimate) -> str:
    """Warn of a motion that is not diffusion, and state over which time its D holds.

    Parameters
    ----------
    verdict : MotionVerdict
        Its text, with the parameters of the motion, is a result and not repeated.
    estimate : DiffusionEstimate
        Estimate of the same quantity, with the kind of its motion.
    """
    name = "D_R" if estimate.quantity == "rotation" else "D_T"
    return (
        f"{_NOT_DIFFUSION} the {estimate.quantity} shows {_SHOWN_KINDS[verdict.kind]} "
        f"({_p_text(verdict.p_family)}, all tests together); {name} {estimate.time_scale}"
    )


def _p_text(p: float) -> str:
    return f"p = {p:.2g}" if p >= 1e-6 else "p < 1e-6"


def no_model_notes(failures: Iterable[tuple[str, Exception | None]], model: str) -> list[str]:
    """State for which quantities a model that was asked for has no fit.

    Parameters
    ----------
    failures : iterable of tuple
        Quantity, and the error of the fit; None where the motion was not judged.
    model : str

    Examples
    --------
    >>> no_model_notes([("rotation", None)], "confined")
    ['no fit of the confined model to the rotation: fewer than 20 steps, or no motion']
    """
    return [
        f"no fit of the {model} model to the {quantity}: {error or NOT_JUDGED}"
        for quantity, error in failures
    ]


def persistence_warning(gain: float, quantity: Quantity) -> str:
    """Warn of successive steps that are more alike than motion blur can make them.

    Parameters
    ----------
    gain : float
        Likelihood ratio (chi-squared of one degree of freedom).
    quantity : {"rotation", "translation"}
    """
    turn = quantity == "rotation"
    return (
        f"steps: successive {'turns of the body' if turn else 'displacements of the centre'} are "
        "more alike than a shutter that is open all the time makes them (likelihood ratio, "
        f"{np.sqrt(gain):.1f} standard errors): smoothed or interpolated tracks, or a persistent "
        f"motion; {'D_R' if turn else 'D_T'} does not describe it"
    )


def steady_motion_warning(found: SteadyMotion, quantity: Quantity) -> str:
    """Warn of a steady velocity or spin, with its error and the remedy."""
    turn = quantity == "rotation"
    value, error = np.array(found.value), np.array(found.stderr)
    size = float(np.linalg.norm(value))
    stderr = float(np.linalg.norm(value * error) / size)
    unit, name = ("rad/s", "D_R") if turn else ("um/s", "D_T")
    what = "the body turns" if turn else "the centre moves"
    way = ""
    if len(value) > 1:
        along = ", ".join(f"{v:.2f}" for v in value / size)
        way = f" {'about' if turn else 'along'} ({along})"
    return (
        f"steady motion: {what} steadily at {with_error(size, stderr)} {unit}{way} (F test, p = "
        f"{found.p:.1g}), and {name} contains that; drift=True takes it off"
    )


def removed_drift_notes(estimate: DiffusionEstimate, quantity: Quantity) -> list[str]:
    """State which mean velocity or spin the estimate does not contain."""
    if estimate.drift is None or estimate.drift_stderr is None:
        return []
    axes = "xyz" if len(estimate.drift[0]) > 1 else "z"
    parts = zip(axes, estimate.drift[0], estimate.drift_stderr[0], strict=False)
    shown = ", ".join(f"{axis} {with_error(v, e)}" for axis, v, e in parts)
    if quantity == "rotation":
        return [f"D_R is about a mean spin of {shown} rad/s, which was taken off"]
    return [f"D_T is about a mean velocity of {shown} um/s, which was taken off"]


def limit_warnings(D_R: DiffusionEstimate, D_T: DiffusionEstimate) -> list[str]:
    """State where an estimate leaves the conditions under which it is exact, each limit once.

    An upper limit is stated as one and needs no remark on its signal-to-noise ratio.
    """
    named: dict[str, list[str]] = {}
    for name, estimate in (("D_R", D_R), ("D_T", D_T)):
        for text in estimate.warnings:
            if estimate.resolved or not text.startswith("signal-to-noise"):
                named.setdefault(text, []).append(name)
    texts = [f"{' and '.join(names)}: {text}" for text, names in named.items()]
    if D_R.value == D_R.stderr == D_T.value == D_T.stderr == 0:
        texts.insert(0, UNMOVED)
    return texts


def noise_floor_warning(measured: float, stderr: float, *, predicted: float, gain: float) -> str:
    """Warn of an offset of the steps that is not the noise which the residuals or sigma predict.

    Parameters
    ----------
    measured, stderr : float
        Noise floor Phi^2 that the steps show and its standard error, rad^2.
    predicted : float
        Phi^2 that the localisation error predicts, rad^2.
    gain : float
        Likelihood ratio (chi-squared of one degree of freedom).
    """
    shown = f"{measured:.3g} +- {stderr:.2g}" if np.isfinite(stderr) else f"{measured:.3g}"
    return (
        f"noise floor: the steps show Phi^2 = {shown} rad^2, the localisation error predicts "
        f"{predicted:.3g} (likelihood ratio, {np.sqrt(gain):.1f} standard errors); motion blur "
        "lowers it, particles recorded one after another or noise that is smooth in time change it"
    )


def is_noise_floor(text: str) -> bool:
    """Return whether a warning is one of `noise_floor_warning`.

    Examples
    --------
    >>> is_noise_floor("noise floor: the steps show"), is_noise_floor("jump: 3 um")
    (True, False)
    """
    return text.startswith("noise floor:")


# Sizes, predictions and pooled values.

NO_BODY = (
    "no spheres keep together longer than diffusion over a contact allows (if there are clusters: "
    "correct contact, the voxel size or the diameter, or take frames faster)"
)
FREE_SPHERES = "these are free spheres, of which only D_T is reported"


def no_prediction_warning(wanted: str, reason: str) -> str:
    """State why sizes or a prediction cannot be computed for a shape."""
    return f"no {wanted}: {reason}"


def unresolved_size_notes(names: Sequence[str], *, others: bool) -> list[str]:
    """State which coefficients give no size because they are upper limits.

    Parameters
    ----------
    names : sequence of str
        The coefficients.
    others : bool
        Whether there are sizes from other coefficients.
    """
    if not names:
        return []
    return [f"no size{' from' if others else 's:'} {' and '.join(names)}: an upper limit only"]


def flow_warnings(messages: Iterable[object]) -> list[str]:
    """Pass on what the solution of the flow around a shape warns of."""
    return [f"predicted flow: {message}" for message in messages]


def unfit_diameter_text(distance: float, diameter: float, *, impossible: bool) -> str:
    """State that spheres of a stated diameter do not touch at the measured places.

    Parameters
    ----------
    distance : float
        Distance of neighbours, um.
    diameter : float
        The stated sphere diameter, um.
    impossible : bool
        Whether no batch of spheres could be like that, so that the unit must be wrong.
    """
    if impossible:
        return (
            f"neighbours are {distance:.3g} um apart, which spheres of {diameter:g} um cannot be; "
            "correct the diameter (um) or the scale"
        )
    would = "would overlap" if diameter > distance else "do not touch"
    return (
        f"neighbours are {distance:.3g} um apart, where spheres of {diameter:g} um {would}; "
        "check the diameter and the scale"
    )


def soft_clusters_warning(names: Sequence[str], *, nothing_else: bool) -> str:
    """State which clusters are not rigid and not pooled, among others or with `nothing_else`."""
    if not nothing_else:
        many = "s" if len(names) > 1 else ""
        return f"the pooled values leave out what is not rigid: cluster{many} {listed(names)}"
    which = "the cluster is" if len(names) == 1 else f"none of the {len(names)} clusters is"
    return (
        f"not rigid: {which}{' not' if len(names) == 1 else ''} a rigid body, and nothing is "
        "pooled; D_R and D_T of what is not rigid describe no body"
    )


def disagreement_warning(name: str, p_same: float) -> str:
    """Warn of clusters whose values of one coefficient differ by more than their errors."""
    return (
        f"the clusters do not agree on one {name}: equal values would scatter as much with "
        f"probability {p_same:.1g}"
    )
