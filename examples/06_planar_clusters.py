"""
6. Planar clusters
==================

Clusters in a plane, such as sedimented or two-dimensional ones, rotate about one axis only.
Tables with x and y are analysed in the plane; nothing has to be stated.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import perrin
from perrin.plot import plot_angle

# %%
# A table in two dimensions
# -------------------------
#
# A triangle of discs turns in the plane: 400 frames, 0.2 s apart, positions in um with errors of
# 20 nm.

rng = np.random.default_rng(2)
dt, D_R, D_T, n_frames = 0.2, 0.03, 0.1, 400
triangle = 1.0 * np.array([[0.0, 1.0], [-0.866, -0.5], [0.866, -0.5]])
angle = np.cumsum(np.sqrt(2 * D_R * dt) * rng.normal(size=n_frames))
center = np.cumsum(np.sqrt(2 * D_T * dt) * rng.normal(size=(n_frames, 2)), axis=0)
turn = np.stack([np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)], axis=1).reshape(
    -1, 2, 2
)
positions = center[:, None] + np.einsum("tij,nj->tni", turn, triangle)
positions = perrin.add_noise(positions, sigma=0.02, rng=rng)

table = perrin.positions_table(positions)
print(table.head(3).round(3).to_string(index=False))

# %%
# The analysis
# ------------
#
# In the plane the mean square angle is 2 D_R t, and the mean square displacement 4 D_T t.

report = perrin.analyze(table, dt=dt)
cluster = report.clusters[0]
print(cluster.D_R, " planted:", D_R)
print(cluster.D_T, " planted:", D_T)
print("warnings:", *(cluster.warnings or ["none"]))

# %%
# The angle
# ---------
#
# The angle is followed over full turns: it is not limited to 360 degrees. Steps beyond half a
# turn cannot be seen, so that frames must be close enough.

figure, ax = plt.subplots(figsize=(8, 3.6), layout="constrained")
plot_angle(cluster.motion, ax=ax)
# sphinx_gallery_alt = "Angle of a planar cluster against time"
plt.show()

# %%
# From a movie
# ------------
#
# A 2-D movie is a stack with one plane. ``voxel=(y, x)`` states that it is two-dimensional. Here
# three bright spots in 40 frames:

grid = np.arange(64)
images = np.empty((40, 1, 64, 64))
for frame, spots in enumerate(positions[:40] - center[:40, None]):
    images[frame, 0] = 5.0
    for x, y in spots / 0.1 + 32:
        images[frame, 0] += 60 * np.exp(-((grid - x) ** 2 + (grid[:, None] - y) ** 2) / 8)
movie = perrin.open_stack(rng.poisson(images), voxel=(0.1, 0.1), dt=dt)

found = perrin.locate(movie, diameter=0.9, contact=0.9)
known = perrin.identify(found, contact=2.0, size=3)
motion = perrin.track_rotation(perrin.cluster_positions(known)[0], dt=dt)
print(f"{len(found)} spots, localisation error {1e3 * motion.sigma:.0f} nm")
print(perrin.estimate_diffusion(motion))

folder = Path(tempfile.mkdtemp())
perrin.write_tracks(known.drop(columns="piece"), folder / "tracks.csv")

# %%
# ``analyze_stack`` does all of this in one call where spheres touch. Next: :doc:`/stacks` has the
# limits of two-dimensional movies.
