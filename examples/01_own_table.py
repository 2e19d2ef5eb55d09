"""
1. Your own track table
=======================

From a table of positions, as a tracking program writes it, to D_R and D_T with intervals. The
table of this page is simulated, so that the result can be compared with the truth. To use your
own, replace the name of the file.

**You need** a table with the columns ``frame``, ``particle``, ``x``, ``y`` and, in three
dimensions, ``z``. Tables of trackpy, TrackMate, Imaris, IDL and other programs are read as they
are (:doc:`/tables`).
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import perrin
from perrin.plot import plot_lag_curve

folder = Path(tempfile.mkdtemp())

# %%
# A table as it comes from a tracking program
# -------------------------------------------
#
# Three tetrahedra of touching spheres, 2.45 um in diameter, in a movie of 200 frames, 0.73 s
# apart. The program wrote pixels of 0.11 um and planes of 0.25 um, it lost 3 % of the spheres, and
# it knows nothing about clusters.

body = perrin.Cluster.touching(4, diameter=2.45)
tables = []
for k in range(3):
    truth = perrin.simulate_motion(body, D_R=4.93e-3, D_T=3.85e-2, dt=0.73, n_frames=200, rng=k)
    positions = perrin.add_noise(truth.positions(), sigma=(0.03, 0.03, 0.04), rng=10 + k)
    one = perrin.positions_table(positions + np.array((20.0 + 30 * k, 20.0, 20.0)))
    tables.append(
        one.assign(particle=one["particle"] + 4 * k).drop(columns="cluster", errors="ignore")
    )
table = pd.concat(tables)
table[["x", "y", "z"]] /= [0.11, 0.11, 0.25]
table = table[np.random.default_rng(1).random(len(table)) > 0.03]
table.to_csv(folder / "tracks.csv", index=False)
print(table.head(4).round(2).to_string(index=False))

# %%
# The analysis
# ------------
#
# ``scale`` is the length of one unit of the file in um: here the size of a pixel along x and y,
# and the distance of the planes along z. One number is enough where all three are equal, or in two
# dimensions. ``dt`` is the time between frames in s. ``diameter`` is optional: with it and the
# viscosity the measured coefficients are compared with the predicted ones.
#
# The same on the command line::
#
#     perrin analyze tracks.csv --scale 0.11,0.11,0.25 --dt 0.73 -o my-run

report = perrin.analyze(folder / "tracks.csv", scale=(0.11, 0.11, 0.25), dt=0.73)
report

# %%
# perrin found three clusters of four particles, because the distances between their particles
# stay constant. Each row has D_R and D_T with their intervals of 95 %. The planted values are
# 0.00493 rad²/s and 0.0385 um²/s.
#
# What the report says
# --------------------
#
# Notes state how the table was read, and warnings state reasons to doubt a number. Always read
# both.

for warning in report.warnings:
    print("warning:", warning)
for note in report.notes:
    print("note:", note)

# %%
# All clusters together have a pooled value with a smaller error. ``p_same`` is the probability of
# a scatter as large as the observed one if all clusters have one D; it is small only where they
# differ.

print(report.pooled.D_R)
print(report.pooled.D_T)
print(f"p_same = {report.pooled.D_R.p_same:.2f}")

# %%
# The figure
# ----------
#
# The mean square angular displacement (MSAD) of one cluster with the estimated line. The dashed
# line is the noise floor that the localisation error predicts. Beyond a quarter of the track the
# points are faint: few independent intervals remain.

cluster = report.clusters[0]
figure, ax = plt.subplots(figsize=(7, 4.6), layout="constrained")
plot_lag_curve(perrin.msad(cluster.motion), ax=ax, estimate=cluster.D_R, floor=cluster.noise.phi2)
# sphinx_gallery_alt = "MSAD of cluster 0 against lag time, the estimated line and the noise floor"
plt.show()

# %%
# Keep the result
# ---------------
#
# A run folder holds the report page, the figures, and all numbers as tables
# (:doc:`/reference/files`). ``load_run`` reads it back.

perrin.write_run(report, folder / "my-run")
print(sorted(path.name for path in (folder / "my-run").iterdir()))
again = perrin.load_run(folder / "my-run")
print(
    again.to_frame()[["of", "cluster", "quantity", "value", "stderr", "unit"]].head(3).to_string()
)

# %%
# Next: :doc:`/start/numbers` explains every number, :doc:`/warnings` every warning,
# :doc:`05_tensors` what changes for bodies with unequal axes.
