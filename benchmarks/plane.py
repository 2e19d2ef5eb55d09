"""Movies of a plane by an independent renderer through the pipeline: one kind of image at a time.

The renderer shares no code with perrin. Planar bodies diffuse in a square field, by rejection of
steps that would make spheres overlap. The image of a sphere is a radial function, tabulated finely
and interpolated at the centre of every pixel: a uniform disc or the projection of a ball, both
convolved with a Gaussian by a Fourier transform on a fine grid; a bright spot; a bright-field image
with a dark rim and a bright middle; defocused fringes. The base case: four trimers of touching
spheres of 2.45 um, 128 x 128 pixels of 0.2 um, 120 frames 0.73 s apart, D_R 0.0049 rad^2/s,
D_T 0.0385 um^2/s, point spread 0.15 um, Poisson noise, gain 3, read noise 1 grey level.

Printed for every case: spheres missed and false, the standard deviation of positions, over the
Cramer-Rao bound (profile known, brightness of every sphere and background not) and the stated
error, the relative error of distances in the bodies, planted clusters that were found, false ones,
D minus that of the true positions, in its standard errors, with the ratio of the standard errors,
the noise of the report over that of the places, and processor time per frame.

Usage: python benchmarks/plane.py [--only NAME] [--refine model none trackpy] [--seed 0]
       [--frames 120] [--warnings]
"""

import argparse
import time
import warnings
from dataclasses import dataclass, field

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.distance import cdist

DIAMETER, DT, D_R, D_T = 2.45, 0.73, 0.0049, 0.0385
RADIUS, PIXEL, BLUR = DIAMETER / 2, 0.2, 0.15
GAIN, READ_NOISE = 3.0, 1.0
SHAPES = {
    1: np.zeros((1, 2)),
    2: np.array([[-0.5, 0], [0.5, 0]]),
    3: np.array([[0, 1], [-np.sqrt(3) / 2, -0.5], [np.sqrt(3) / 2, -0.5]]) / np.sqrt(3),
}
TETRAHEDRON = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(8)


def blurred(image, blur, *, step=0.025, half=4.0):
    """Return a radial function image(r) convolved with a Gaussian, as a spline of r."""
    n = 2 * round(half / step)
    x = (np.arange(n) - n // 2) * step
    # Each grid point is a mean over 4 x 4 points: edges are sharp.
    sub = (np.arange(4) - 1.5) * step / 4
    fine = np.mean(
        [image(np.hypot(x[:, None] + a, x[None, :] + b)) for a in sub for b in sub], axis=0
    )
    k = 2 * np.pi * np.fft.fftfreq(n, step)
    otf = np.exp(-(k[:, None] ** 2 + k[None, :] ** 2) * blur**2 / 2)
    line = np.fft.ifft2(np.fft.fft2(np.fft.ifftshift(fine)) * otf).real[0, : n // 2]
    return CubicSpline(np.arange(n // 2) * step, line)


def disc(radius=RADIUS, blur=BLUR):
    """Return the image of a uniform disc, 1 inside."""
    return blurred(lambda r: (r < radius).astype(float), blur)


def ball():
    """Return the image of a ball without optical sectioning, 1 at its middle."""
    return blurred(lambda r: np.sqrt(np.clip(1 - (r / RADIUS) ** 2, 0, None)), BLUR)


def spot():
    """Return a bright spot at the middle of the sphere."""
    return blurred(lambda r: np.exp(-((r / 0.45) ** 2) / 2), BLUR)


def ring():
    """Return a bright-field contrast: a dark rim and a bright middle."""
    return blurred(
        lambda r: 0.5 * np.exp(-((r / 0.5) ** 2) / 2) - np.exp(-(((r - RADIUS) / 0.2) ** 2) / 2),
        BLUR,
    )


def rim():
    """Return a bright-field contrast of a dark rim alone."""
    return blurred(lambda r: -np.exp(-(((r - 0.85 * RADIUS) / 0.3) ** 2) / 2), BLUR)


def fringes():
    """Return the contrast of a defocused sphere: fringes that decay."""
    return blurred(
        lambda r: np.cos(2 * np.pi * r / 0.9) * np.exp(-((r / 1.1) ** 2) / 2),
        BLUR,
    )


@dataclass(frozen=True)
class Case:
    """A movie: bodies, the image of a sphere, light, and how it is analysed."""

    image: object = disc
    kinds: tuple = (3, 3, 3, 3)
    photons: float = 40.0
    background: float = 3.0
    spread: float = 0.0  # of the brightness from sphere to sphere
    product: bool = False  # transmissions are multiplied, in place of contrasts added
    pixel_mean: bool = False  # a pixel is the mean over its area, in place of its middle
    slice: bool = False  # a plane through tetrahedra that turn in 3-D
    uneven: float = 0.0  # relative change of the light over the field
    pixels: int = 128
    walls: float = DIAMETER
    options: dict = field(default_factory=dict)


BRIGHT_FIELD = {"photons": 60.0, "background": 100.0, "options": {"dark": True}}
CASES = {
    "discs": Case(),
    "discs, 10 photons": Case(photons=10.0),
    "discs, 200 photons": Case(photons=200.0),
    "balls": Case(ball),
    "spots": Case(spot),
    "rim": Case(rim, **BRIGHT_FIELD),
    "rim without dark": Case(rim, **BRIGHT_FIELD | {"options": {}}),
    "ring": Case(ring, **BRIGHT_FIELD),
    "ring without dark": Case(ring, **BRIGHT_FIELD | {"options": {}}),
    "ring, transmissions": Case(ring, product=True, **BRIGHT_FIELD),
    "fringes": Case(fringes, **BRIGHT_FIELD | {"options": {}}),
    "brightness 30 %": Case(spread=0.3),
    "pixel areas": Case(pixel_mean=True),
    "uneven": Case(uneven=0.5, background=10.0),
    "dimers": Case(kinds=(2, 2, 2, 2, 2)),
    "crowd of dimers": Case(kinds=(2,) * 22, walls=RADIUS),
    "crowd of dimers, ring": Case(ring, kinds=(2,) * 22, walls=RADIUS, **BRIGHT_FIELD),
    "slice": Case(slice=True),
}


def scene(kinds, box, *, rng, walls):
    """Return centres and angles of bodies at random places without overlap."""
    centers, angles, x = [], [], np.empty((0, 2))
    for kind in sorted(kinds, reverse=True):
        for _ in range(100000):
            center, angle = rng.uniform(walls, box - walls, 2), rng.uniform(0, 2 * np.pi)
            new = placed(kind, center, angle)
            inside = np.all((new > walls) & (new < box - walls))
            if inside and (not len(x) or cdist(new, x).min() > 1.001 * DIAMETER):
                centers.append(center)
                angles.append(angle)
                x = np.concatenate([x, new])
                break
        else:
            raise RuntimeError("no space is left for another body")
    return np.array(centers), np.array(angles)


def placed(kind, center, angle):
    """Return the positions (n, 2) of the spheres of a body."""
    c, s = np.cos(angle), np.sin(angle)
    return center + DIAMETER * SHAPES[kind] @ np.array([[c, s], [-s, c]])


def paths(case, n_frames, *, rng, substeps=8):
    """Return the positions (T, n, 2) of each body."""
    box, h = case.pixels * PIXEL, DT / substeps
    kinds = sorted(case.kinds, reverse=True)
    centers, angles = scene(kinds, box, rng=rng, walls=case.walls)
    x = [placed(k, c, a) for k, c, a in zip(kinds, centers, angles, strict=True)]
    out = [[] for _ in kinds]
    for i in range(n_frames):
        for _ in range(substeps if i else 0):
            for b, kind in enumerate(kinds):
                center = centers[b] + rng.normal(0, np.sqrt(2 * D_T * h), 2)
                angle = angles[b] + rng.normal(0, np.sqrt(2 * D_R * h))
                new = placed(kind, center, angle)
                if np.any((new < case.walls) | (new > box - case.walls)):
                    continue
                others = [o for k, o in enumerate(x) if k != b]
                if others and cdist(new, np.concatenate(others)).min() < DIAMETER:
                    continue
                centers[b], angles[b], x[b] = center, angle, new
        for b, new in enumerate(x):
            out[b].append(new)
    return [np.array(path) for path in out]


def layers(case, image, x, bright):
    """Return the images (n, y, x) of the spheres of one frame, and their gradients by x and y."""
    grid = PIXEL * np.arange(case.pixels)
    if case.pixel_mean:
        grid = (grid[:, None] + PIXEL * (np.arange(5) - 2) / 5).ravel()
    dx = grid[None, None, :] - x[:, 0, None, None]
    dy = grid[None, :, None] - x[:, 1, None, None]
    r = np.hypot(dx, dy)
    inside = r < 3.9
    r = np.where(inside, r, 0.0)
    value = bright[:, None, None] * np.where(inside, image(r), 0.0)
    slope = bright[:, None, None] * np.where(inside, image(r, 1), 0.0) / np.maximum(r, 1e-9)
    out = np.stack([value, -slope * dx, -slope * dy], axis=1)
    if case.pixel_mean:
        out = out.reshape(*out.shape[:2], case.pixels, 5, case.pixels, 5).mean(axis=(3, 5))
    return out


def expected(case, parts):
    """Return the mean number of photons of every pixel."""
    if case.product:
        contrast = case.photons / case.background
        mean = case.background * np.prod(1 + contrast * parts[:, 0], axis=0)
    else:
        mean = case.background + case.photons * parts[:, 0].sum(axis=0)
    light = 1 + case.uneven * np.linspace(-0.5, 0.5, case.pixels)
    return np.clip(mean, 0, None) * light


def bound(case, parts):
    """Return the Cramer-Rao bound of one coordinate, um: root mean square over the spheres."""
    mean = expected(case, parts)
    n = len(parts)
    rows = [parts[:, 1:].reshape(2 * n, -1) * case.photons, parts[:, 0].reshape(n, -1)]
    design = np.concatenate([*rows, np.ones((1, case.pixels**2))])
    weight = 1 / (mean.ravel() + (READ_NOISE / GAIN) ** 2 + 1 / 12 / GAIN**2)
    covariance = np.linalg.pinv((design * weight) @ design.T, hermitian=True)
    return np.sqrt(np.mean(np.diag(covariance)[: 2 * n]))


def drawn(case, n_frames, seed):
    """Return the movie (T, 1, y, x), positions of the bodies, and the bound of a coordinate, um."""
    rng = np.random.default_rng(seed)
    if case.slice:
        return sliced(n_frames, case, rng)
    bodies = paths(case, n_frames, rng=rng)
    image = case.image()
    bright = np.exp(case.spread * rng.normal(size=sum(b.shape[1] for b in bodies)))
    movie, bounds = [], []
    for i in range(n_frames):
        parts = layers(case, image, np.concatenate([b[i] for b in bodies]), bright)
        movie.append(grey(expected(case, parts), rng))
        if i % max(n_frames // 4, 1) == 0:
            bounds.append(bound(case, parts))
    return np.array(movie)[:, None], bodies, np.sqrt(np.mean(np.square(bounds)))


def sliced(n_frames, case, rng):
    """Return the movie of one plane through tetrahedra that turn and move in 3-D."""
    from scipy.spatial.transform import Rotation

    radii = np.linspace(0.2, RADIUS, 30)
    images = [disc(radius) for radius in radii]
    places = np.array([[6.0, 6.0], [19.0, 6.0], [6.0, 19.0], [19.0, 19.0]])
    bodies = []
    for place in places:
        turn, center, path = Rotation.random(rng=rng), np.append(place, 0.0), []
        for _ in range(n_frames):
            path.append(center + DIAMETER * turn.apply(TETRAHEDRON))
            turn = Rotation.from_rotvec(rng.normal(0, np.sqrt(2 * D_R * DT), 3)) * turn
            center = center + rng.normal(0, np.sqrt(2 * D_T * DT), 3) * [1, 1, 0.2]
        bodies.append(np.array(path))
    movie = []
    for i in range(n_frames):
        mean = np.full((case.pixels, case.pixels), case.background)
        for x in np.concatenate([b[i] for b in bodies]):
            if abs(x[2]) < RADIUS - 0.1:
                cut = np.sqrt(RADIUS**2 - x[2] ** 2)
                image = images[int(np.abs(radii - cut).argmin())]
                mean += case.photons * layers(case, image, x[None, :2], np.ones(1))[0, 0]
        movie.append(grey(mean, rng))
    return np.array(movie)[:, None], [b[..., :2] for b in bodies], np.nan


def grey(mean, rng):
    """Return grey levels, as the camera writes them."""
    levels = GAIN * rng.poisson(np.clip(mean, 0, None)) + rng.normal(0, READ_NOISE, mean.shape)
    return np.clip(np.round(levels), 0, 65535).astype(np.uint16)


def true_report(bodies):
    """Return the report of the same estimators for the true positions."""
    import pandas as pd

    import perrin

    tables, first = [], 0
    for c, body in enumerate(bodies):
        table = perrin.positions_table(body).assign(cluster=c)
        table["particle"] += first
        first += body.shape[1]
        tables.append(table)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return perrin.analyze(pd.concat(tables, ignore_index=True), dt=DT)


def print_case(report, bodies, limit, *, seconds):
    """Print how a report compares with the truth."""
    features = report.imaging.features
    good = features["refined"] if "refined" in features else np.ones(len(features), dtype=bool)
    error, missed, false, n, stated = [], 0, 0, 0, []
    owner = np.repeat(np.arange(len(bodies)), [b.shape[1] for b in bodies])
    scales = []
    for i in range(len(bodies[0])):
        true = np.concatenate([b[i] for b in bodies])
        part = features[(features["frame"] == i) & good]
        found = part[["x", "y"]].to_numpy()
        n += len(true)
        if not len(found):
            missed += len(true)
            continue
        away = cdist(found, true)
        near = away.min(axis=1) < DIAMETER / 4
        missed += int((away.min(axis=0) > DIAMETER / 4).sum())
        nearest = away.argmin(axis=1)
        taken = np.zeros(len(true), dtype=bool)
        for k in np.flatnonzero(near):
            near[k] &= not taken[nearest[k]]
            taken[nearest[k]] = True
        false += int((~near).sum())
        error.append((found - true[nearest])[near])
        if "sigma_x" in part:
            stated.append(part.loc[near, ["sigma_x", "sigma_y"]].to_numpy())
        x = np.full_like(true, np.nan)
        x[nearest[near]] = found[near]
        for b in range(len(bodies)):
            if (owner == b).sum() > 1:
                rows, columns = np.triu_indices((owner == b).sum(), 1)
                lengths = [
                    np.linalg.norm(p[owner == b][rows] - p[owner == b][columns], axis=1)
                    for p in (x, true)
                ]
                scales += (lengths[0] / lengths[1] - 1)[np.isfinite(lengths[0])].tolist()
    if not len(error) or missed == n:
        print(f"  {n} spheres, all missed; {false} false; {len(report.clusters)} clusters")
        return
    error = np.concatenate(error)
    sd = np.sqrt(np.mean((error - np.median(error, axis=0)) ** 2))
    robust = 1.4826 * np.median(np.abs(error - np.median(error, axis=0)))
    said = np.sqrt(np.nanmean(np.concatenate(stated) ** 2)) if stated else np.nan
    print(f"  {n} spheres: {missed} missed, {false} false; sd {1e3 * sd:.1f} nm", end=" ")
    print(f"(by quantiles {1e3 * robust:.1f}), stated {1e3 * said:.1f}", end=", ")
    print(f"bound {1e3 * limit:.1f}, sd / bound {sd / limit:.2f};", end=" ")
    scale, scale_error = np.mean(scales), np.std(scales) / np.sqrt(len(scales))
    print(f"distances {100 * scale:+.2f}({100 * scale_error:.2f}) %", end="; ")
    print(f"{seconds / len(bodies[0]):.3f} s a frame")
    true = true_report([b for b in bodies if b.shape[1] > 1])
    planted = [b for b in bodies if b.shape[1] > 1]
    pairs, others = matched(report.clusters, planted)
    noise = [r.motion.sigma / sd for r in pairs.values()]
    floor = f", noise {np.mean(noise):.2f} of the places'" if noise else ""
    print(f"  clusters: {len(pairs)} of {len(planted)} found, {len(others)} false{floor}")
    pooled = [r.pooled for r in (report, true)]
    if None not in pooled:
        print("  pooled:", compared(*pooled, names=("D_R", "D_T")))


def compared(found, true, *, names):
    """Return D against the truth in its standard errors, and the ratio of errors."""
    texts = []
    for name in names:
        one, other = getattr(found, name), getattr(true, name)
        if one is not None and other is not None:
            off, ratio = (one.value - other.value) / other.stderr, one.stderr / other.stderr
            texts.append(f"{name} {one.value:.5f} ({off:+.2f} errors, error x {ratio:.2f})")
    return "; ".join(texts)


def matched(results, bodies):
    """Return {planted body: result} and the results that are no planted body."""
    pairs, others = {}, []
    for result in results:
        rows = np.rint(result.motion.time / DT).astype(int)
        center = result.motion.center[:, :2]
        away = [np.nanmedian(np.linalg.norm(b.mean(axis=1)[rows] - center, axis=1)) for b in bodies]
        best = int(np.argmin(away))
        if away[best] < DIAMETER / 4 and best not in pairs:
            pairs[best] = result
        else:
            others.append(result)
    return pairs, others


def main():
    import perrin

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", help="cases whose name contains this")
    parser.add_argument("--refine", nargs="+", default=["model"])
    parser.add_argument("--frames", type=int, default=120)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--warnings", action="store_true", help="print the warnings of each run")
    args = parser.parse_args()
    for name, case in CASES.items():
        if args.only not in name:
            continue
        movie, bodies, limit = drawn(case, args.frames, args.seed)
        for refine in args.refine:
            print(f"{name}, {refine}", flush=True)
            stack = perrin.open_stack(movie, voxel=(PIXEL, PIXEL), dt=DT)
            options = {"contact": DIAMETER, "refine": None if refine == "none" else refine}
            begun = time.process_time()
            try:
                report = perrin.analyze_stack(stack, diameter=DIAMETER, **options | case.options)
            except Exception as fault:  # a refusal is a result here
                print(f"  refused: {type(fault).__name__}: {fault}")
                continue
            print_case(report, bodies, limit, seconds=time.process_time() - begun)
            if args.warnings:
                for text in (*report.warnings, *(f"note: {t}" for t in report.notes)):
                    print("   !", text[:300])


if __name__ == "__main__":
    main()
