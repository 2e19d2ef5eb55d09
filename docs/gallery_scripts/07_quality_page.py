"""
Figures of the imaging quality
==============================

Every run on a movie has a page ``quality.html``. Its figures show what was found: circles on the
projections, masses of the spots with the cut between spheres and noise, and the misfit of the
fitted images.
"""

import matplotlib.pyplot as plt

import perrin
from perrin.plot import plot_found, plot_masses, plot_misfit, plot_step_angles

plt.style.use("perrin.plot.perrin")

body = perrin.Cluster.touching(4, diameter=2.45)
truth = [
    perrin.simulate_motion(body, D_R=5e-3, D_T=0.01, dt=0.73, n_frames=6, rng=k) for k in (1, 2)
]
movie = perrin.render_stack(
    truth, centers=[(4.4, 4.4, 4.8), (9.6, 9.6, 4.8)], voxel=(0.3, 0.24, 0.24), shape=(32, 58, 58),
    diameter=2.45, psf=(0.4, 0.15, 0.15), photons=40, background=3, gain=3, read_noise=2, rng=1,
)  # fmt: skip
report = perrin.analyze_stack(movie, diameter=2.45, contact=2.45)

figure = plt.figure(figsize=(10, 11), layout="constrained")
axes = figure.subplot_mosaic(
    [["found", "masses"], ["misfit", "misfit"], ["steps", "steps"]], height_ratios=[2, 1, 1]
)
plot_found(report.imaging, report.imaging.views[0], ax=axes["found"])
plot_masses(report.imaging, ax=axes["masses"])
plot_misfit(report.imaging, ax=axes["misfit"])
plot_step_angles(report, ax=axes["steps"])
plt.show()
