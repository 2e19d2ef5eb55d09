"""Which particle is which: errors for simulated bodies with known labels, and the time taken.

Usage: python benchmarks/identity.py [--seed N] [--clusters N] [--only NAME]
"""

import argparse
import contextlib
import resource
import sys
import time
import warnings

import numpy as np
import pandas as pd

import perrin
from perrin.tracks.clusters import each_cluster

D_R, D_T, DT, SIGMA = 4.9e-3, 3.85e-2, 0.73, (0.03, 0.03, 0.04)
DIAMETER, FRAMES = 2.45, 300
BODY = perrin.Cluster.touching(4, DIAMETER)
BODIES = {
    "trimer": perrin.Cluster.touching(3, DIAMETER).positions,
    "tetrahedron": BODY.positions,
    "square": DIAMETER / 2 * np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0.0]]),
    "bipyramid": perrin.Cluster.touching(5, DIAMETER).positions,
    "octahedron": perrin.Cluster.touching(6, DIAMETER).positions,
}


def positions(rng, *, dt=DT, frames=FRAMES):
    """Return one noisy track (T, 4, 3) about the origin."""
    truth = perrin.simulate_motion(BODY, D_R=D_R, D_T=D_T, dt=dt, n_frames=frames, rng=rng)
    return perrin.add_noise(truth.positions(), sigma=SIGMA, rng=rng)


def labelled(rng, body, *, frames, D_R=D_R, sigma=SIGMA, irregular=0.0, bad=0.0, missing=0.0):
    """Return one labelled track (T, n, 3), its places off by a part of the diameter.

    Of the frames a part `bad` is 3 to 6 times noisier; of the detections a part is missing.
    """
    shape = body + irregular * DIAMETER * rng.normal(size=body.shape)
    truth = perrin.simulate_motion(
        perrin.Cluster.from_positions(shape), D_R=D_R, D_T=D_T, dt=DT, n_frames=frames, rng=rng
    )
    worse = np.where(rng.random(frames) < bad, rng.uniform(3, 6, size=frames), 1.0)
    x = truth.positions()
    x = x + rng.normal(size=x.shape) * sigma * worse[:, None, None]
    x[rng.random(x.shape[:2]) < missing] = np.nan
    return x


def field(rng, clusters, *, dt=DT, frames=FRAMES, apart=150.0):
    """Return raw detections of clusters far apart, with the truth in `body` and `site`."""
    parts = []
    for c in range(clusters):
        x = positions(rng, dt=dt, frames=frames) + apart * np.array(
            [c % 10, c // 10 % 10, c // 100]
        )
        parts.append(table_of(x, c))
    return pd.concat(parts, ignore_index=True)


def table_of(x, body):
    frame, site = np.indices(x.shape[:2])
    columns = {"frame": frame.ravel(), "body": body, "site": site.ravel()}
    return pd.DataFrame(columns | dict(zip("xyz", x.reshape(-1, 3).T, strict=True)))


def wrong_steps(found):
    """Count the steps within a piece in which a particle becomes another."""
    seated = found[found["cluster"] >= 0].sort_values(["particle", "frame"])
    same = (seated[["particle", "piece"]] == seated[["particle", "piece"]].shift()).all(axis=1)
    moved = (seated[["body", "site"]] != seated[["body", "site"]].shift()).any(axis=1)
    return seated.loc[same & moved, ["cluster", "frame"]].drop_duplicates().shape[0]


def cuts_of(found):
    return int(found[found["cluster"] >= 0].groupby("cluster")["piece"].max().sum())


def motions_of(found, dt):
    """Return the motion of every cluster of an identified table."""
    out = []
    for cluster in sorted(set(found["cluster"]) - {-1}):
        x, frames = perrin.cluster_positions(found, cluster=cluster)
        rows = found[found["cluster"] == cluster]
        piece = rows.groupby("frame")["piece"].first().reindex(frames).ffill().to_numpy(np.int64)
        out.append(perrin.track_rotation(x, dt=dt, frames=frames, piece=piece))
    return out


def against(motions, label):
    estimate = perrin.estimate_diffusion(motions)
    deviation = (estimate.value - D_R) / estimate.stderr
    print(f"  {label}: D_R = {estimate.value:.5f} +- {estimate.stderr:.5f} ({deviation:+.1f} sd)")


def shuffled(rng, clusters):
    """Order all detections of every frame at random; no ids at all."""
    for factor in (1, 2, 4, 8):
        raw = field(rng, clusters, dt=factor * DT).sample(
            frac=1, random_state=int(rng.integers(9**9))
        )
        found = perrin.identify(raw.reset_index(drop=True), contact=DIAMETER, size=4)
        steps = clusters * (FRAMES - 1)
        print(
            f"shuffled, {factor} dt: {wrong_steps(found)} wrong of {steps}, {cuts_of(found)} cuts"
        )
        against(motions_of(found, factor * DT), f"{factor} dt")


def lost(rng, clusters):
    """Lose 1 % of the detections, order the rest at random."""
    raw = field(rng, clusters)
    raw = raw[rng.random(len(raw)) >= 0.01].sample(frac=1, random_state=1).reset_index(drop=True)
    found = perrin.identify(raw, contact=DIAMETER, size=4)
    motions = motions_of(found, DT)
    posed = sum(m.fitted.size for m in motions)
    print(
        f"1 % lost: {posed / (clusters * FRAMES):.4%} of the frames have a pose, "
        f"{wrong_steps(found)} wrong, {cuts_of(found)} cuts"
    )
    against(motions, "1 % lost")


def swapped(rng, clusters):
    """Exchange two labels for good with probability 0.01 per frame."""
    found = planted = false = 0
    repaired, raw = [], []
    for _ in range(clusters):
        x = positions(rng)
        rows = np.flatnonzero(rng.random(FRAMES - 1) < 0.01) + 1
        for k in rows:
            pair = rng.permutation(4)[:2]
            x[k:, pair] = x[k:, pair[::-1]]
        identity = perrin.settle_identity(x)
        reported = np.concatenate([identity.swaps, identity.cuts])
        found, planted = found + np.isin(rows, reported).sum(), planted + rows.size
        false += (~np.isin(reported, rows)).sum()
        with contextlib.suppress(perrin.DegenerateClusterError):  # mirrored to a flat mean shape
            raw.append(perrin.track_rotation(x, dt=DT, reference="previous"))
        repaired.append(perrin.track_rotation(identity.arranged(x), dt=DT, piece=identity.piece))
    print(f"pair swaps: {found} of {planted} found, {false} reported that are none")
    against(repaired, "repaired")
    against(raw, "as they come, by successive rotations")


def lasting(rng, clusters):
    """Permute labels of symmetric bodies from some frame on; 3 % of the frames may be bad."""
    for name in ("trimer", "tetrahedron", "bipyramid", "octahedron"):
        for bad in (0.0, 0.03):
            found = cut = other = 0
            for _ in range(clusters):
                x = labelled(rng, BODIES[name], frames=FRAMES, bad=bad)
                row, order = int(rng.integers(5, FRAMES - 5)), exchange(rng, x.shape[1])
                x[row:] = x[row:, order]
                identity = perrin.settle_identity(x)
                found += row in identity.swaps
                cut += row in identity.cuts
                reported = np.concatenate([identity.swaps, identity.cuts, identity.extra])
                other += (reported != row).any()
            print(
                f"lasting exchanges, {name}, {bad:.0%} bad frames: {found} of {clusters} "
                f"corrected, {cut} cut, in {other} tracks something else"
            )


def exchange(rng, n):
    """Return an order of n labels that is not the identity."""
    while (order := rng.permutation(n)).tolist() == list(range(n)):
        pass
    return order


def short(rng, clusters):
    """Permute labels of symmetric bodies during one or five frames."""
    for name in ("trimer", "tetrahedron", "bipyramid", "octahedron"):
        for length in (1, 5):
            found = other = 0
            for _ in range(clusters):
                x = labelled(rng, BODIES[name], frames=FRAMES)
                row, order = int(rng.integers(5, FRAMES - 10)), exchange(rng, x.shape[1])
                ends = row, row + length
                x[ends[0] : ends[1]] = x[ends[0] : ends[1], order]
                identity = perrin.settle_identity(x)
                found += np.isin(ends, identity.swaps).all()
                reported = np.concatenate([identity.swaps, identity.cuts, identity.extra])
                other += (~np.isin(reported, ends)).any()
            print(
                f"exchanges of {length} frames, {name}: {found} of {clusters} corrected, "
                f"in {other} tracks something else"
            )


def undisturbed(rng, clusters):
    """Count the tracks with right labels in which anything is reported.

    sigma_z/sigma_xy is 1 to 3 and 5 % of the detections are missing; half of the bodies are
    irregular by 1 to 2 %. Slow bodies turn as in the paper, fast ones by 26 degrees a frame in each
    component.
    """
    runs = 5 * clusters
    for bad in (0.0, 0.03):
        total = np.zeros(5, dtype=np.int64)
        for name, body in BODIES.items():
            for frames, turning in ((60, D_R), (60, 0.1 / DT), (FRAMES, D_R), (FRAMES, 0.1 / DT)):
                counts = np.zeros(5, dtype=np.int64)
                for _ in range(runs):
                    x = labelled(
                        rng,
                        body,
                        frames=frames,
                        D_R=turning,
                        sigma=np.array([0.03, 0.03, 0.03 * rng.uniform(1, 3)]),
                        irregular=rng.integers(2) * rng.uniform(0.01, 0.02),
                        bad=bad,
                        missing=0.05,
                    )
                    identity = perrin.settle_identity(x)
                    kinds = [identity.swaps, identity.cuts, identity.extra]
                    some = [kind.size > 0 for kind in kinds]
                    counts += [*some, any(some), identity.unsettled.size > 0]
                total += counts
                print(f"  {name}, {frames} frames, D_R {turning:.2g}: {reports(counts)} of {runs}")
        print(f"right labels, {bad:.0%} bad frames: {reports(total)} of {runs * 4 * len(BODIES)}")


def reports(counts):
    swaps, cuts, extra, some, unsettled = counts
    return (
        f"swaps {swaps}, cuts {cuts}, extra {extra}, any {some} (unsettled frames in {unsettled})"
    )


def passing(rng, clusters):
    """Two clusters pass; their nearest sphere centres come to 1.2 diameters."""
    wrong = cuts = split = 0
    for _ in range(clusters):
        first, second = (positions(rng) for _ in range(2))
        first, second = (x - x.mean(axis=1, keepdims=True) for x in (first, second))
        by = np.linspace(-6, 6, FRAMES)[:, None, None] * [0.0, 1.0, 0.0]
        gap = 0.0
        while (
            np.linalg.norm(first[:, :, None] - (second + by + [gap, 0, 0])[:, None], axis=-1).min()
            < 1.2 * DIAMETER
        ):
            gap += 0.01
        both = pd.concat([table_of(first, 0), table_of(second + by + [gap, 0, 0], 1)])
        raw = both.sample(frac=1, random_state=1).reset_index(drop=True)
        found = perrin.identify(raw, contact=DIAMETER, size=4)
        wrong, cuts = wrong + wrong_steps(found), cuts + cuts_of(found)
        split += found.loc[found["cluster"] >= 0, "cluster"].nunique() - 2
    total = 2 * clusters * FRAMES
    print(f"passing: {wrong} wrong, {cuts} cuts and {split} broken links in {total} frames")


def scale(rng, clusters):
    """Time grouping, identity and motion of 1000 labelled clusters, and their memory."""
    count = 25 * clusters
    raw = field(rng, clusters)
    blocks = [
        raw.assign(x=raw["x"] + 2000.0 * k, particle=4 * (raw["body"] + k * clusters))
        for k in range(25)
    ]
    table = pd.concat(blocks, ignore_index=True)
    table["particle"] += table.pop("site")
    table = table[["frame", "particle", "x", "y", "z"]]
    size = table.memory_usage(index=True).sum() / 1e6
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    for contact in (DIAMETER, None):
        times = [time.perf_counter()]
        found = perrin.find_clusters(table, contact=contact)
        times.append(time.perf_counter())
        spent = np.zeros(2)
        for _, x, frames, *_ in each_cluster(found):
            start = time.perf_counter()
            identity = perrin.settle_identity(x, times=frames)
            middle = time.perf_counter()
            perrin.track_rotation(identity.arranged(x), dt=DT, frames=frames, piece=identity.piece)
            spent += middle - start, time.perf_counter() - middle
        times.append(time.perf_counter())
        share = f"identity {spent[0]:.1f} s, motion {spent[1]:.1f} s"
        print(
            f"{count} clusters x {FRAMES} frames, contact {contact}: {len(set(found['cluster']))}"
        )
        print(f"  grouping {times[1] - times[0]:.1f} s, {share}, all {times[2] - times[0]:.1f} s")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    print(f"  table {size:.0f} MB, peak over the start {peak - before:.0f} MB")


def rods(rng, clusters):
    """Dumbbells of two spheres with 30 nm noise: D_perp."""
    values, errors = [], []
    for _ in range(5 * clusters):
        truth = perrin.simulate_motion(
            perrin.Cluster.touching(2, DIAMETER),
            D_R=(0.01, 0.01, 0.02),
            D_T=D_T,
            dt=0.5,
            n_frames=FRAMES,
            rng=rng,
        )
        x = perrin.add_noise(truth.positions(), sigma=0.03, rng=rng)
        estimate = perrin.estimate_rod(perrin.track_direction(x, dt=0.5))
        values.append(estimate.value / 0.01)
        errors.append(
            (estimate.ci68[0] < 0.01 < estimate.ci68[1], estimate.ci95[0] < 0.01 < estimate.ci95[1])
        )
    cover, error = np.mean(errors, axis=0), np.std(values) / np.sqrt(len(values))
    print(
        f"rods: D_perp/planted {np.mean(values):.4f} +- {error:.4f}, "
        f"68 % covers {cover[0]:.3f}, 95 % covers {cover[1]:.3f} ({len(values)} tracks)"
    )


PARTS = (shuffled, lost, swapped, lasting, short, undisturbed, passing, rods, scale)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--clusters", type=int, default=40)
    parser.add_argument("--only", default="")
    chosen = parser.parse_args()
    # Exchanges are planted and counted.
    warnings.simplefilter("ignore", perrin.IdentityWarning)
    for part in PARTS:
        if chosen.only in ("", part.__name__):
            part(np.random.default_rng(chosen.seed), chosen.clusters)
            sys.stdout.flush()


if __name__ == "__main__":
    main()
