"""MotionVerdict: whether a motion is diffusion, and if not, what kind of motion it is."""

from __future__ import annotations

import warnings as python_warnings
from collections import Counter
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

import numpy as np

from perrin._arrays import choice_fault, refuse, to_plain
from perrin._display import Shown
from perrin._text import listed, number_text
from perrin.diffusion.anomalous import AnomalousEstimate, anomalous_estimate, find_exponent
from perrin.diffusion.confined import ConfinedEstimate, confined_estimate, find_cage
from perrin.diffusion.estimate import DiffusionEstimate
from perrin.diffusion.estimators import estimate_diffusion, estimate_each
from perrin.diffusion.goodness_of_fit import (
    FEWEST_HALF_PERIODS,
    BrownianSummary,
    BrownianTests,
    FittedSteps,
    Score,
    axis_models,
    brownian_tests_of_each,
    fisher,
    holm,
    largest_share,
    score_p,
    tabulated_p,
    tabulated_statistics,
)
from perrin.diffusion.noise_model import Noise, noise_faults
from perrin.diffusion.steps import Quantity
from perrin.diffusion.switching import SwitchingEstimate, fit_switching_each
from perrin.errors import PrecisionWarning
from perrin.motion.rigid_motion import RigidMotion

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence


Kind = Literal[
    "diffusion",
    "subdiffusion",
    "superdiffusion",
    "confined",
    "drift",
    "spin",
    "changing D",
    "jumps",
    "vibration",
]

LEVEL = 0.05  # of the family of tests, and of the tests that decide between names

# Power 80 % in tests at 5 %: standard errors of one number, and the root of the noncentrality of
# an F test with three degrees of freedom.
_DETECTED, _DETECTED_MEAN = 2.8, 3.3

_RELAXATIONS_SEEN = 12.0  # steps per squared cage radius (in steps) that show a cage

_COARSE_TURN = 0.2  # 4 D_R dt beyond which rotation vectors lose the turns between frames

_SCATTER_DRAWS = 199  # draws that give the scatter of the two scores of a slow change

_SHAPE_TESTS = ("fractional", "cage", "steady")

Model = AnomalousEstimate | ConfinedEstimate | DiffusionEstimate | SwitchingEstimate

# The class of a fitted alternative, by a key that only its dictionary has.
_MODELS: dict[str, type[Model]] = {
    "alpha": AnomalousEstimate,
    "cage": ConfinedEstimate,
    "D_slow": SwitchingEstimate,
    "drift": DiffusionEstimate,
}


@dataclass(frozen=True, eq=False, repr=False)
class MotionVerdict(Shown):
    """What kind of motion a track shows, by tests against Brownian motion.

    Attributes
    ----------
    kind : str
        "diffusion" where no test rejects it at 5 % of the family; else "subdiffusion",
        "superdiffusion", "confined", "drift", "spin", "changing D", "jumps" or "vibration".
    p : dict of str to float
        p-value of every test: "fractional" (exponent of the mean squared displacement), "cage"
        (confinement), "steady" (mean velocity or spin), "clustering" and "slow change" (of the step
        lengths), "tails" (of their distribution), "largest" (step) and "line" (one period).
    p_family : float
        Probability, in Brownian motion, of a smallest p-value as small as this (Holm).
    detectable : dict of str to float or None
        What this track could have shown: exponents "alpha_below" and "alpha_above", a "cage" of
        smaller rms radius (rad or um), and a faster "spin" (rad/s) or "drift" (um/s). The test for
        an exponent or a steady motion at its limit rejects in about 80 % of cases at 5 %, that for
        a cage in half of them; the family of tests rejects nearly always at twice the distance. All
        None where the body turns too far between frames.
    model : AnomalousEstimate, ConfinedEstimate, DiffusionEstimate, SwitchingEstimate or None
        Fitted alternative; a `DiffusionEstimate` with its drift where the motion is steady; None
        for diffusion, jumps and vibration, and for several motions whose D changes.
    frames : tuple of int
        Rows of the motion at which jumps end.
    text : str
        The verdict in one sentence.
    quantity : {"rotation", "translation"}
        The motion that was judged.
    n_frames : int
        Frames with a pose.
    each : tuple of MotionVerdict
        Verdict on every motion of a list; empty for one motion.
    """

    kind: Kind
    p: dict[str, float]
    p_family: float
    detectable: dict[str, float | None]
    model: Model | None
    frames: tuple[int, ...]
    text: str
    quantity: Quantity
    n_frames: int
    each: tuple[MotionVerdict, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the verdict for JSON; the fitted alternative is under "parameters"."""
        entry: dict[str, Any] = {
            "kind": self.kind,
            "p": to_plain(self.p),
            "p_family": self.p_family,
            "text": self.text,
            "detectable": to_plain(self.detectable),
            "parameters": None if self.model is None else self.model.to_dict(),
            "frames": [int(row) for row in self.frames],
            "quantity": self.quantity,
            "n_frames": self.n_frames,
        }
        if self.each:
            entry["each"] = [one.to_dict() for one in self.each]
        return entry

    @classmethod
    def from_dict(cls, entry: dict[str, Any]) -> MotionVerdict:
        """Return the verdict that `to_dict` wrote."""
        parameters = entry["parameters"]
        model = None
        if parameters is not None:
            model = next(kind for key, kind in _MODELS.items() if key in parameters).from_dict(
                parameters
            )
        return cls(
            kind=entry["kind"],
            p={name: np.nan if p is None else p for name, p in entry["p"].items()},
            p_family=entry["p_family"],
            detectable=dict(entry["detectable"]),
            model=model,
            frames=tuple(entry["frames"]),
            text=entry["text"],
            quantity=entry["quantity"],
            n_frames=entry["n_frames"],
            each=tuple(cls.from_dict(one) for one in entry.get("each", ())),
        )

    def __str__(self) -> str:
        return self.text


def judge_motion(
    motion: RigidMotion | Sequence[RigidMotion],
    *,
    quantity: Quantity = "rotation",
    noise: Literal["joint", "residual"] | float | Noise = "joint",
    exposure: float | None = None,
    progress: Callable[[], None] | None = None,
) -> MotionVerdict:
    """Judge whether a motion is diffusion, and name what it is if not.

    Parameters
    ----------
    motion : RigidMotion or sequence of RigidMotion
        Motion before any jump is cut; several motions get one verdict.
    quantity : {"rotation", "translation"}
        Steps that are tested: body-frame rotation vectors, or displacements of the centre.
    noise : {"joint", "residual"}, float or Noise
        "joint" fits the noise offset, which hides slow subdiffusion; "residual" takes the noise
        from the rigid-fit residuals, a number is the localisation error sigma (um). A known noise
        halves the error of the exponent, but is right only if all particles of a frame are
        recorded at the same instant.
    exposure : float, optional
        Open fraction of the time between frames, with a known noise; a free offset contains it.
    progress : callable, optional
        Is called after each motion that has been tested.

    Returns
    -------
    MotionVerdict

    Raises
    ------
    TooFewFramesError
        If a motion has fewer than 20 steps.
    ValueError
        For unknown or inconsistent choices, all in one message, or a body that does not move.

    Notes
    -----
    Eight tests, corrected together (Holm 1979) at 5 %, compare the steps with Brownian motion of
    constant D and noise on each axis of the tensor. Fractional motion, a cage and a steady motion
    are told apart by likelihood less half a logarithm of the number of steps for each parameter
    (Schwarz 1978); a variance that changes from a few long steps by testing once more with these
    shortened. "diffusion" means that none of the tests rejects it: `detectable` says what could
    have been seen. docs/theory/motion.md has the laws, the power and the confusion matrix.

    Examples
    --------
    >>> from perrin import Cluster, Spin, simulate_motion
    >>> tetrahedron = Cluster.tetrahedron(1.5)
    >>> free = simulate_motion(tetrahedron, D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> judge_motion(free).kind
    'diffusion'
    >>> spinning = simulate_motion(
    ...     tetrahedron, D_R=5e-3, dt=0.7, n_frames=300, dynamics=Spin(0.1), rng=3
    ... )
    >>> judge_motion(spinning).kind
    'spin'
    """
    motions = [motion] if isinstance(motion, RigidMotion) else list(motion)
    strange = [type(m).__name__ for m in motions if not isinstance(m, RigidMotion)]
    if strange or not motions:
        raise TypeError(
            "motion: expected a RigidMotion or several (track_rotation makes one from positions), "
            f"got {listed(sorted(set(strange))) or 'none'}"
        )
    faults = [
        *choice_fault("quantity", quantity, get_args(Quantity)),
        *noise_faults(noise, exposure),
    ]
    if len({m.dimension for m in motions}) != 1:
        faults.append("motion: expected one or more motions, all in 2 or all in 3 dimensions")
    if isinstance(noise, Noise) and noise.drift:
        faults.append("noise: expected no drift; the verdict tests for a steady motion itself")
    refuse(faults)
    settings = Noise.of(noise, exposure=exposure)
    each = judge_each(motions, quantity=quantity, noise=settings, progress=progress)
    return each[0].verdict if len(each) == 1 else judge_together(motions, each, noise=settings)


class JudgedMotion(NamedTuple):
    """The verdict on one motion, and what its tests contribute to that on several.

    Attributes
    ----------
    verdict : MotionVerdict
    tests : BrownianSummary
    """

    verdict: MotionVerdict
    tests: BrownianSummary


def judge_each(
    motions: Sequence[RigidMotion],
    *,
    quantity: Quantity,
    noise: Noise,
    progress: Callable[[], None] | None = None,
) -> list[JudgedMotion]:
    """Judge several motions, each alone, as `judge_motion`; their tests are computed together.

    Parameters
    ----------
    motions : sequence of RigidMotion
    quantity : {"rotation", "translation"}
    noise : Noise
        Without drift.
    progress : callable, optional
        Is called after each motion that has been tested.

    Raises
    ------
    TooFewFramesError, ValueError
        As in `judge_motion`.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> free = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> [one.verdict.kind for one in judge_each([free, free], quantity="rotation", noise=Noise())]
    ['diffusion', 'diffusion']
    """
    tested = brownian_tests_of_each(axis_models(motions, quantity, noise), progress=progress)

    def verdict_on(motion: RigidMotion, tests: BrownianTests) -> MotionVerdict:
        return _verdict(
            [motion], [tests.summary], lambda: [tests.fitted], quantity=quantity, settings=noise
        )

    verdicts = _with_models(motions, [*map(verdict_on, motions, tested)], noise)
    return [JudgedMotion(v, one.summary) for v, one in zip(verdicts, tested, strict=True)]


def judge_together(
    motions: Sequence[RigidMotion], each: Sequence[JudgedMotion], *, noise: Noise
) -> MotionVerdict:
    """Judge several motions together from the tests of each; the verdicts on each are in it.

    Parameters
    ----------
    motions : sequence of RigidMotion
    each : sequence of JudgedMotion
        Result of `judge_each` for these motions, perhaps in several parts.
    noise : Noise
        As in `judge_each`.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> free = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> each = judge_each([free, free], quantity="rotation", noise=Noise())
    >>> judge_together([free, free], each, noise=Noise()).text[-20:]
    'Singly: 2 diffusion.'
    """
    quantity = each[0].verdict.quantity

    def fitted() -> list[FittedSteps]:
        return [FittedSteps.of(*one) for one in axis_models(motions, quantity, noise)]

    summaries = [one.tests for one in each]
    together = _verdict(motions, summaries, fitted, quantity=quantity, settings=noise)
    verdicts = tuple(one.verdict for one in each)
    counts = Counter(one.kind for one in verdicts).most_common()
    kinds = ", ".join(f"{count} {kind}" for kind, count in counts)
    return replace(together, text=f"{together.text} Singly: {kinds}.", each=verdicts)


def _verdict(
    motions: Sequence[RigidMotion],
    summaries: Sequence[BrownianSummary],
    fitted: Callable[[], Sequence[FittedSteps]],
    *,
    quantity: Quantity,
    settings: Noise,
) -> MotionVerdict:
    """Return the verdict on motions; what names the motion needs their fits, if a test rejects.

    The summaries of the tests are enough for thousands of bodies that diffuse, whose steps and fits
    would take much memory.
    """
    p = combined_p(summaries)
    p_family = holm(np.array(list(p.values())))
    detectable = detectable_by(summaries, quantity)
    text = _diffusion_text(p_family, len(p), detectable, quantity)
    turn = max(4 * one.mean_D * one.mean_tau for one in summaries)
    if quantity == "rotation" and motions[0].dimension == 3 and turn > _COARSE_TURN:
        detectable = dict.fromkeys(detectable)
        text = (
            f"No test rejects diffusion of the rotation (p = {p_family:.2g}), but the body turns "
            f"too far between frames for most of them (4 D_R dt = {turn:.2g}, over "
            f"{_COARSE_TURN}): sample faster."
        )
    verdict = MotionVerdict(
        kind="diffusion",
        p=p,
        p_family=p_family,
        detectable=detectable,
        model=None,
        frames=(),
        text=text,
        quantity=quantity,
        n_frames=sum(m.fitted.size for m in motions),
    )
    if p_family > LEVEL:
        return verdict
    tested, first = fitted(), min(p, key=lambda name: p[name])
    if first == "line":
        peaks = []
        for one in tested:
            modes = np.sum(one.model.mode_ratios(one.fit), axis=1)[0]
            # A vibration of any phase spreads over neighbouring sine modes: their centre of power.
            slowest = FEWEST_HALF_PERIODS - 1
            largest = slowest + int(np.argmax(modes[slowest:]))
            around = np.arange(largest - 2, min(len(modes), largest + 3))
            k = 1 + float(np.average(around, weights=modes[around]))
            period = 2 * (one.model.n_steps + 1) * one.model.mean_tau / k
            peaks.append((float(largest_share(modes, one.fit.D.shape[1])), period))
        period = max(peaks)[1]
        text = f"{_SUBJECT[quantity]} vibrates with a period of {number_text(period)} s"
        return replace(verdict, kind="vibration", text=_with_p(text, p_family))
    if first in _SHAPE_TESTS:
        kind, model = _shape(motions, tested, quantity, settings)
        if model is None:  # of a single motion, which `_with_models` fits
            return replace(verdict, kind=kind)
        text = _model_text(kind, model, quantity)
        return replace(verdict, kind=kind, model=model, text=_with_p(text, p_family))
    return _variance(verdict, motions, tested)


def combined_p(tested: Sequence[BrownianSummary]) -> dict[str, float]:
    """Return the p-values of all motions together.

    Scores and informations of the exponent and of the cage add; the p-values of the other tests are
    combined by Fisher's method.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> from perrin.diffusion import Noise, axis_model, brownian_tests
    >>> tested = [
    ...     brownian_tests(*axis_model(
    ...         simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=seed),
    ...         "rotation", Noise())).summary
    ...     for seed in (3, 4)
    ... ]
    >>> 0 < combined_p(tested)["cage"] < 1
    True
    """
    if len(tested) == 1:
        return dict(tested[0].p)
    p = {name: fisher([one.p[name] for one in tested]) for name in tested[0].p}
    if sum(one.n_steps for one in tested) >= 200:
        for i, name in enumerate(("fractional", "cage")):
            total = Score.total([one.scores[i] for one in tested])
            p[name] = float(score_p(total, one_sided=name == "cage")[0])
    return p


def detectable_by(tested: Sequence[BrownianSummary], quantity: Quantity) -> dict[str, float | None]:
    """Return what these tracks together could have shown.

    An exponent that differs from 1 by 2.8 standard errors; a cage of rms radius r with 12
    (r/step)^2 steps in the longest track; a spin (rad/s) or drift (um/s) of 3.3 standard errors of
    one component.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> from perrin.diffusion import Noise, axis_model, brownian_tests
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> tests = brownian_tests(*axis_model(truth, "rotation", Noise())).summary
    >>> {name: round(x, 2) for name, x in detectable_by([tests], "rotation").items() if x}
    {'alpha_below': 0.77, 'alpha_above': 1.23, 'cage': 0.42, 'spin': 0.02}
    """
    information = sum(float(one.scores[0].information[0]) for one in tested)
    reach = _DETECTED / np.sqrt(information)
    lengths, speeds = [], []
    for one in tested:
        D, tau, n = one.mean_D, one.mean_tau, one.n_steps
        lengths.append(np.sqrt(2 * D * tau * n / _RELAXATIONS_SEEN))
        speeds.append(_DETECTED_MEAN * np.sqrt(2 * D / (n * tau)))
    steady = float(min(speeds))
    return {
        "alpha_below": max(0.0, float(1 - reach)),
        "alpha_above": min(2.0, float(1 + reach)),
        "cage": float(max(lengths)),
        "spin": steady if quantity == "rotation" else None,
        "drift": steady if quantity == "translation" else None,
    }


def _shape(
    motions: Sequence[RigidMotion],
    tested: Sequence[FittedSteps],
    quantity: Quantity,
    settings: Noise,
) -> tuple[Kind, Model | None]:
    """Name what bends the spectrum, by likelihood less half ln N for each parameter.

    A steady motion is also the name where it explains the exponent: likelihood alone calls a spin
    superdiffusion in a quarter of short tracks. That of a single motion is not fitted here.
    """
    penalty = 0.5 * np.log(sum(one.model.n_steps for one in tested))
    # What a steady motion gains, its p, and that of the exponent once it is subtracted.
    kind: Kind
    gain, p_of_each, scores = 0.0, [], []
    for one in tested:
        model, fit = one.model, one.fit
        mean, _, p = model.steady_motion(fit)
        rest = model.fit(fit.y - np.einsum("nap,bp->ban", model.steady, mean), near=fit)
        gain += model.log_likelihood(rest) - model.log_likelihood(fit)
        gain -= penalty * model.steady.shape[2]
        p_of_each.append(float(p[0]))
        scores.append((model.scores(rest) if model.even else model.dense_scores(rest, rest.y))[0])
    p_steady = fisher(p_of_each)
    p_rest = float(score_p(Score.total(scores), one_sided=False)[0])
    if not (p_steady < LEVEL and p_rest > LEVEL):
        peak = find_exponent(motions, quantity, settings)
        slower = peak.best.shape < 1
        cage = find_cage(motions, quantity, settings) if slower else None
        caged = -np.inf if cage is None else cage.gain
        if gain <= max(peak.gain, caged) - penalty:
            if cage is not None and caged > peak.gain:
                return "confined", confined_estimate(cage, motions)
            kind = "subdiffusion" if slower else "superdiffusion"
            return kind, anomalous_estimate(peak, motions)
    kind = "spin" if quantity == "rotation" else "drift"
    if len(motions) == 1:
        return kind, None
    taken = replace(settings, drift=True)
    with python_warnings.catch_warnings():
        python_warnings.simplefilter("ignore", PrecisionWarning)
        return kind, estimate_diffusion(motions, quantity=quantity, noise=taken)


def _variance(
    verdict: MotionVerdict,
    motions: Sequence[RigidMotion],
    tested: Sequence[FittedSteps],
) -> MotionVerdict:
    """Tell a few long steps from a D that changes, and a D that changes from noise that does.

    A test of clustering and of slow change with the longest steps shortened to what one Brownian
    track of this length has decides.
    """
    from scipy.special import chdtri

    quantity, rows = verdict.quantity, []
    shortened: dict[str, list[float]] = {"clustering": [], "slow change": []}
    for m, one in zip(motions, tested, strict=True):
        axes, n = one.fit.D.shape[1], one.model.n_steps
        scale = np.median(one.u) / chdtri(axes, 0.5)
        if not scale > 0:  # most steps are none at all
            return verdict
        u = np.minimum(one.u, scale * chdtri(axes, 1 / n))
        statistics = tabulated_statistics(u * axes / u.mean(), axes)
        for name, p in shortened.items():
            p.append(float(tabulated_p(name, statistics[name], axes=axes, n_steps=n)))
        rows += m.steps()[1][one.u > scale * chdtri(axes, LEVEL / n)].tolist()
    clustering, slow_change = map(fisher, shortened.values())
    if min(clustering, slow_change) > LEVEL:
        return _jumps(verdict, rows if len(motions) == 1 else [])
    if slow_change < clustering and _noise_changes(motions, tested):
        return _changing_noise(verdict)
    # Every body has states of its own: the verdicts on each hold the fits.
    text = f"The diffusion coefficient of the {quantity} changes in time"
    return replace(verdict, kind="changing D", text=_with_p(text, verdict.p_family))


def _with_models(
    motions: Sequence[RigidMotion], verdicts: Sequence[MotionVerdict], settings: Noise
) -> list[MotionVerdict]:
    """Return the verdicts on single motions with the models that are fitted to several at once.

    They are the steady motions, and the two states of each motion whose D changes.
    """
    judged, quantity = list(verdicts), verdicts[0].quantity
    steady = [k for k, one in enumerate(verdicts) if one.kind in ("spin", "drift")]
    estimates = estimate_each(
        [motions[k] for k in steady], quantity=quantity, noise=replace(settings, drift=True)
    )
    for k, estimate in zip(steady, estimates, strict=True):
        if isinstance(estimate, ValueError):
            raise estimate
        verdict = verdicts[k]
        text = _with_p(_model_text(verdict.kind, estimate, quantity), verdict.p_family)
        judged[k] = replace(verdict, model=estimate, text=text)
    changing = [k for k, one in enumerate(verdicts) if one.kind == "changing D"]
    if not changing:
        return judged
    pools = [[motions[k]] for k in changing]
    fits = fit_switching_each(pools, quantity=quantity, noise=settings)
    for k, model in zip(changing, fits, strict=True):
        verdict = replace(verdicts[k], kind="diffusion")
        if isinstance(model, ValueError):
            # The steps are all noise: with D = 0 it is the noise that changes.
            judged[k] = _changing_noise(verdict)
        elif model.dwell_fast.value < motions[k].usual_interval:
            # A state that lasts less than a frame is single long steps.
            judged[k] = _jumps(verdict, np.flatnonzero(model.states[0] == 1).tolist())
        else:
            text = _with_p(_model_text("changing D", model, quantity), verdict.p_family)
            judged[k] = replace(verdict, kind="changing D", model=model, text=text)
    return judged


def _changing_noise(verdict: MotionVerdict) -> MotionVerdict:
    """Return the verdict of diffusion, with a text that its noise changes."""
    text = (
        f"{_SUBJECT[verdict.quantity]} is consistent with diffusion whose measurement noise "
        "changes along the track"
    )
    return replace(verdict, text=_with_p(text, verdict.p_family))


def _jumps(verdict: MotionVerdict, rows: Sequence[int]) -> MotionVerdict:
    """Return the verdict that a few steps are too long, which end at these rows of the motion."""
    where = f" (rows {listed(rows)} of the motion)" if rows else ""
    text = (
        f"A few steps of the {verdict.quantity} are too long for diffusion{where}: exchanged "
        "labels, hops or heavy tails"
    )
    text = _with_p(text, verdict.p_family)
    return replace(verdict, kind="jumps", frames=tuple(rows), text=text)


def _noise_changes(motions: Sequence[RigidMotion], tested: Sequence[FittedSteps]) -> bool:
    """Tell noise that changes linearly along a track from a D that does, by the larger score.

    The residuals of the rigid fits decide where they change beyond three standard errors.
    """
    z_D = z_noise = z_residual = 0.0
    for m, one in zip(motions, tested, strict=True):
        model, fit = one.model, one.fit
        found = model.change_scores(fit)[:, 0]
        drawn = model.draws(fit, count=_SCATTER_DRAWS, rng=np.random.default_rng(model.n_steps))
        scatter = model.change_scores(replace(fit, y=drawn)).std(axis=1)
        z_D += found[0] / scatter[0]
        z_noise += found[1] / scatter[1]
        square = m.residual[m.fitted] ** 2
        if square.size > 2 and square.std() > 0:
            t = np.linspace(-1.0, 1.0, square.size)
            z_residual += float(np.corrcoef(t, square)[0, 1] * np.sqrt(square.size))
    root = np.sqrt(len(tested))
    if abs(z_residual) > 3 * root:
        return bool(z_residual * z_noise > 0)
    return bool(abs(z_noise) > abs(z_D))


def _diffusion_text(
    p_family: float, tests: int, detectable: dict[str, float | None], quantity: Quantity
) -> str:
    """Return the sentence on a track that no test rejects, with what it could have shown."""
    unit = "rad" if quantity == "rotation" else "um"
    steady = "spin" if quantity == "rotation" else "drift"
    low, high = detectable["alpha_below"] or 0.0, detectable["alpha_above"] or 2.0
    ends = [f"below {low:.2f}"] * (low > 0) + [f"above {high:.2f}"] * (high < 2)
    shown = [
        f"an exponent {' or '.join(ends)}" if ends else "an exponent of 0 or 2 at most",
        f"a cage under {number_text(detectable['cage'] or 0.0, digits=2)} {unit}",
        f"a {steady} over {number_text(detectable[steady] or 0.0, digits=2)} {unit}/s",
    ]
    return (
        f"{_SUBJECT[quantity]} is consistent with diffusion (p = {p_family:.2g} over {tests} "
        f"tests); this track could have shown {shown[0]}, {shown[1]}, or {shown[2]}."
    )


def _model_text(kind: Kind, model: Model, quantity: Quantity) -> str:
    """Return the sentence on a fitted alternative, without its end."""
    if isinstance(model, DiffusionEstimate):
        speeds = []
        for steady, errors in zip(model.drift or (), model.drift_stderr or (), strict=True):
            speed = float(np.linalg.norm(steady))
            error = float(np.linalg.norm(np.multiply(steady, errors))) / speed if speed else np.nan
            speeds.append((speed, error))
        verb = "turn" if quantity == "rotation" else "move"
        unit = "rad/s" if quantity == "rotation" else "um/s"
        if len(speeds) == 1:
            return (
                f"The body {verb}s steadily at {number_text(*speeds[0])} {unit} while it diffuses"
            )
        low, high = number_text(*min(speeds)), number_text(*max(speeds))
        return f"The bodies {verb} steadily, at {low} to {high} {unit}, while they diffuse"
    subject = _SUBJECT[quantity]
    words = {
        "subdiffusion": f"{subject} is subdiffusive",
        "superdiffusion": f"{subject} is superdiffusive",
        "confined": f"{subject} is confined",
        "changing D": f"The diffusion coefficient of the {quantity} changes in time",
    }
    if isinstance(model, SwitchingEstimate) and not model.two_states:
        return f"{words[kind]}, not between two values but slowly or in another way"
    return f"{words[kind]}: {model}"


_SUBJECT = {"rotation": "The rotation", "translation": "The translation"}


def _with_p(text: str, p_family: float) -> str:
    """Return a sentence with the probability of the data in diffusion."""
    p = f"p = {p_family:.2g}" if p_family >= 1e-6 else "p < 1e-6"
    return f"{text} ({p} for diffusion with a constant D and noise)."
