"""
Many clusters, one coefficient
==============================

D_R of eight clusters with their intervals, and the pooled value. The report tests whether all
clusters agree on one coefficient.
"""

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import perrin
from perrin.plot import plot_forest

plt.style.use("perrin.plot.perrin")

body = perrin.Cluster.touching(4, diameter=2.45)
tables = []
for k in range(8):
    truth = perrin.simulate_motion(body, D_R=4.93e-3, D_T=3.85e-2, dt=0.73, n_frames=100, rng=k)
    positions = perrin.add_noise(truth.positions(), sigma=0.03, rng=100 + k) + np.array(
        (40.0 * k, 0, 0)
    )
    tables.append(perrin.positions_table(positions).assign(cluster=k))
report = perrin.analyze(pd.concat(tables), dt=0.73)

figure, axes = plt.subplots(1, 2, figsize=(10, 4.8), layout="constrained")
plot_forest(report.clusters, ax=axes[0], pooled=report.pooled.D_R)
plot_forest(report.clusters, ax=axes[1], quantity="translation", pooled=report.pooled.D_T)
figure.suptitle(f"one D_R for all clusters: p = {report.pooled.D_R.p_same:.2f}")
plt.show()
