"""
2. Your own stack
=================

From a movie of confocal stacks to D_R. The movie is rendered here, with two tetrahedra that move
as known, so that every step can be compared with the truth. A movie of a microscope is opened in
the same way (:doc:`/stacks` lists the formats).
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

import perrin
from perrin.plot import plot_found, plot_misfit

folder = Path(tempfile.mkdtemp())

# %%
# A movie
# -------
#
# Ten frames of two tetrahedra of touching spheres, 2.45 um in diameter. A real movie has some
# hundred frames; ten keep this page short.

body = perrin.Cluster.touching(4, diameter=2.45)
truth = [
    perrin.simulate_motion(body, D_R=5e-3, D_T=0.01, dt=0.73, n_frames=10, rng=k) for k in (1, 2)
]
movie = perrin.render_stack(
    truth, centers=[(4.4, 4.4, 4.8), (9.6, 9.6, 4.8)], voxel=(0.3, 0.24, 0.24), shape=(32, 58, 58),
    diameter=2.45, psf=(0.4, 0.15, 0.15), photons=40, background=3, gain=3, read_noise=2, rng=1,
)  # fmt: skip
perrin.write_stack(movie, folder / "movie.ome.tif")

# %%
# Open it
# -------
#
# ``open_stack`` reads the voxel size and the times of the frames from the file. A value that a file
# does not state has to be given, as ``voxel=(0.3, 0.24, 0.24), dt=0.73``; voxel sizes are in the
# order z, y, x.

stack = perrin.open_stack(folder / "movie.ome.tif")
print(stack.shape, "frames, planes, rows, columns;", stack.voxel, "um;", stack.dt, "s")

# %%
# Look at a frame before the analysis: the spheres should be brighter than the background, without
# saturated voxels.

figure, axes = plt.subplots(1, 2, figsize=(9, 3.8), layout="constrained")
frame = stack.frame(0)
axes[0].imshow(frame.max(axis=0), cmap="gray", extent=(0, 13.9, 13.9, 0))
axes[0].set(xlabel="x (µm)", ylabel="y (µm)", title="maximum along z")
axes[1].imshow(frame.max(axis=1), cmap="gray", extent=(0, 13.9, 9.6, 0))
axes[1].set(xlabel="x (µm)", ylabel="z (µm)", title="maximum along y")
# sphinx_gallery_alt = "One frame as maxima along z and along y: two clusters of bright spheres"
plt.show()

# %%
# The analysis
# ------------
#
# Two lengths are needed: ``diameter``, that of the fluorescent sphere, and ``contact``, the
# distance of the centres of touching spheres. They are equal unless only the core of a sphere is
# fluorescent. The same on the command line::
#
#     perrin run movie.ome.tif --diameter 2.45 --contact 2.45 -o my-run
#
# A file that does not state its voxels or times (a TIFF of ImageJ often does not) needs them, with
# ``--voxel 0.3,0.24,0.24 --dt 0.73``.

report = perrin.analyze_stack(stack, diameter=2.45, contact=2.45)
report

# %%
# Ten frames determine D_R with an error of about 40 %. With 300 frames it is 8 %:
# :doc:`03_plan_experiment`.
#
# The imaging quality
# -------------------
#
# Inspect ``quality.html`` of the run folder before you use a number. The circles should coincide
# with the spheres, and the misfit of the images should be near 1 (:doc:`/howto/quality-page`).

figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4.4), layout="constrained")
plot_found(report.imaging, report.imaging.views[0], ax=left)
plot_misfit(report.imaging, ax=right)
# sphinx_gallery_alt = "Circles around the spheres that were found, and the misfit of their images"
plt.show()

# %%
# How good are the positions?
# ---------------------------
#
# The localisation error is measured from the residuals of the rigid fit. Long tracks have it along
# each axis: ``quality.sigma_xyz``.

for cluster in report.clusters:
    print(f"cluster {cluster.cluster}: {1e3 * cluster.motion.sigma:.1f} nm")

# %%
# The learned optics can be stated again in a later run (``optics=``), which saves the learning.

print(report.imaging.optics)

# %%
# Next: :doc:`/run` explains all steps of the analysis, how it is divided among cores and
# machines, and how an interrupted run is resumed.
