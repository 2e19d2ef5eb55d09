"""
7. Many movies and conditions
=============================

One table or movie is one run. This page runs several, collects their results in one table, and
draws D_R against the condition.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import perrin

# %%
# Three viscosities, two tables each
# ----------------------------------
#
# The name of each file states its condition. In practice these are the tables of your
# experiments.

folder = Path(tempfile.mkdtemp())
body = perrin.Cluster.touching(4, diameter=2.45)
for viscosity in (1.0, 2.0, 4.0):  # mPa s
    fluid = perrin.cluster_mobility(
        body, radius=2.45 / 2, viscosity=1e-3 * viscosity, temperature=295.0
    )
    for movie in (1, 2):
        tables = []
        for k in range(2):
            rng = np.random.default_rng([int(viscosity), movie, k])
            truth = perrin.simulate_motion(fluid, dt=0.5, n_frames=120, rng=rng)
            positions = perrin.add_noise(truth.positions(), sigma=0.03, rng=rng)
            one = perrin.positions_table(positions + np.array((40.0 * k, 0, 0)))
            tables.append(one.assign(cluster=k))
        perrin.write_tracks(pd.concat(tables), folder / f"eta-{viscosity:g}-movie-{movie}.csv")

# %%
# One run for each table
# ----------------------
#
# ``to_frame`` returns all numbers of a report as a tidy table: one row for each cluster and
# quantity.

rows = []
for path in sorted(folder.glob("*.csv")):
    report = perrin.analyze(path, dt=0.5)
    _, viscosity, _, movie = path.stem.split("-")
    rows.append(report.to_frame().assign(viscosity=float(viscosity), movie=int(movie)))
results = pd.concat(rows, ignore_index=True)
single = results[(results["of"] == "cluster") & (results["quantity"] == "D_R")]
print(
    single[["viscosity", "movie", "cluster", "value", "stderr", "verdict"]].to_string(index=False)
)

# %%
# The mean of each condition
# --------------------------
#
# Clusters differ from each other by more than the error of each one where spheres or places
# differ. The scatter between clusters gives an error of the mean that includes this; with few
# clusters it is uncertain itself.

groups = single.groupby("viscosity")["value"]
mean, error = groups.mean(), groups.std() / np.sqrt(groups.size())
for viscosity in mean.index:
    print(f"{viscosity:g} mPa s: D_R = {mean[viscosity]:.5f} +- {error[viscosity]:.5f} rad^2/s")

# %%
# The figure: D_R against 1/viscosity is a line through the origin.

figure, ax = plt.subplots(figsize=(7, 4.6), layout="constrained")
ax.errorbar(1 / single["viscosity"], single["value"], single["stderr"], fmt="o", color="0.6", ms=4,
            label="clusters")  # fmt: skip
ax.errorbar(1 / mean.index, mean, error, fmt="s", color="#c4500c", ms=7, label="means")
line = np.linspace(0, 1.1, 2)
predicted = np.trace(fluid.D_R) / 3 * 4.0  # of the last fluid, 4 mPa s
ax.plot(line, predicted * line, "k--", lw=1, label="predicted")
ax.set(xlabel="1/viscosity (1/(mPa s))", ylabel="$D_R$ (rad²/s)", xlim=(0, 1.1), ylim=(0, None))
ax.legend(frameon=False)
# sphinx_gallery_alt = "D_R of clusters and their means against one over the viscosity, with a line"
plt.show()
