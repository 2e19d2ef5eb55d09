"""Pictures of how spheres were seen put them where they are, and count what the tables count."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

import perrin
from perrin import plot_images
from perrin.images.image_fit import CameraNoise
from perrin.images.imaging import Imaging, View
from perrin.images.optics import Optics

VOXEL, BALL = (0.25, 0.2, 0.2), 2.45


def shadow(centers, shape, step):
    """Draw discs of the spheres' size on one projection, rows and columns as in `centers`."""
    rows, columns = (np.arange(n) * s for n, s in zip(shape, step, strict=True))
    light = np.full(shape, 10.0)
    for row, column in centers:
        inside = np.hypot(rows[:, None] - row, columns - column) < BALL / 2
        light[inside] = 100.0
    return light


def views_of(features, shape, voxel, frames):
    z, y, x = voxel
    made = []
    for k in frames:
        here = features[features["frame"] == k]
        sides = {"xy": ("yx", (y, x)), "xz": ("zx", (z, x)), "yz": ("zy", (z, y))}
        size = dict(zip("zyx", shape, strict=True))
        drawn = {
            side: shadow(here[list(axes)].to_numpy(), [size[a] for a in axes], step)
            if np.isfinite(z) or side == "xy"
            else np.zeros((1, 1))
            for side, (axes, step) in sides.items()
        }
        made.append(View(k, **drawn))
    return tuple(made)


def seen(*, clusters=2, frames=40, planar=False, refine="model", size=16.0, seed=3):
    """Return a report of tetrahedra (squares in the plane) seen in a stack, without rendering."""
    rng = np.random.default_rng(seed)
    square = BALL / 2 * np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]])
    body = perrin.Cluster.from_positions(square) if planar else perrin.Cluster.touching(4, BALL)
    side = int(np.ceil(np.sqrt(clusters)))
    parts = []
    for k in range(clusters):
        truth = perrin.simulate_motion(body, D_R=5e-3, D_T=0.01, dt=0.7, n_frames=frames, rng=rng)
        x = perrin.add_noise(truth.positions(), sigma=0.01, rng=rng)
        at = [size / side * (k % side + 0.5), size / side * (k // side + 0.5), 5.0]
        x = x + at[: x.shape[2]]
        frame, particle = np.indices(x.shape[:2]).reshape(2, -1)
        part = pd.DataFrame(
            {"frame": frame, "cluster": k, "particle": particle + 4 * k, "piece": 0}
        )
        part[list("xyz")[: x.shape[2]]] = x.reshape(-1, x.shape[2])
        parts.append(part)
    features = pd.concat(parts, ignore_index=True)
    report = perrin.analyze(features, dt=0.7)
    features["mass"] = rng.normal(2e4, 1e3, len(features))
    optics = None
    if refine == "model":
        features[["sigma_x", "sigma_y", "sigma_z"]] = [0.004, 0.005, 0.006]
        features["chi2"] = rng.normal(1, 0.02, len(features))
        features["refined"], features["reason"] = True, ""
        optics = Optics(2.44, (0.41, 0.152), CameraNoise(3.1, 12.0), (0.002, 0.003, 0.004))
    voxel = (np.nan, *VOXEL[1:]) if planar else VOXEL
    shape = (1 if planar else 40, int(size / 0.2), int(size / 0.2))
    spots = np.concatenate([features["mass"][: 4 * clusters], rng.lognormal(5, 0.7, 300)])
    counts = features.groupby("frame").size().to_numpy()
    imaging = Imaging(
        features=features,
        frames=pd.DataFrame(
            {
                "frame": np.arange(frames),
                "time": 0.7 * np.arange(frames),
                "spots": counts + 300,
                "spheres": counts,
                "level": 10.0,
                "saturated": 0.0,
                "fault": "",
            }
        ),
        spots=pd.DataFrame({"frame": 0, "mass": spots}),
        views=views_of(features, shape, voxel, range(0, frames, max(frames // 8, 1))),
        optics=optics,
        minmass=2345.0,
        voxel=voxel,
        diameter=BALL,
        contact=BALL,
        dark=False,
        refine=refine,
    )
    return replace(report, imaging=imaging)
