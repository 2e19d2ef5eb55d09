"""
3. Plan an experiment
=====================

How often should frames be recorded, how many, and how large will the error of D_R be?
``plan_sampling`` answers before the experiment, ``judge_sampling`` afterwards.
"""

import matplotlib.pyplot as plt

import perrin
from perrin.plot import plot_plan

# %%
# What is expected
# ----------------
#
# ``cluster_mobility`` predicts the coefficients of a cluster of known spheres in a known fluid:
# here tetrahedra of 2.45 um spheres in a mixture with 2.18 mPa s.

body = perrin.Cluster.touching(4, diameter=2.45)
fluid = perrin.cluster_mobility(body, radius=2.45 / 2, viscosity=2.18e-3, temperature=295.0)
print(fluid)

# %%
# The plan
# --------
#
# ``sigma`` is the localisation error: 30 nm along x and y, 40 nm along z is usual for a confocal
# microscope. With a limit on the duration of the movie, here 220 s, more frames are better until
# noise exceeds the motion between them. The same on the command line::
#
#     perrin plan tetrahedron --diameter 2.45 --d-r 0.0067 --sigma 0.03 --time 220 -o plan.png

D_R, D_T = (float(D.trace() / 3) for D in (fluid.D_R, fluid.D_T))
sigma = (0.03, 0.03, 0.04)
plan = perrin.plan_sampling(body, D_R=D_R, D_T=D_T, sigma=sigma, total_time=220.0, n_frames=2000)
print(plan)
figure, ax = plt.subplots(figsize=(7, 4.6), layout="constrained")
plot_plan(plan, ax=ax)
# sphinx_gallery_alt = "Expected error of D_R against the time between frames, with its minimum"
plt.show()

# %%
# The window is the range of times between frames in which the particles can be told apart and the
# error is near its minimum.
#
# How many frames?
# ----------------
#
# The relative error falls with the root of the number of frames.

fixed = perrin.plan_sampling(body, D_R=D_R, sigma=sigma, n_frames=300)
for error in (0.1, 0.05, 0.02):
    print(f"error {error:.0%}: {fixed.frames_for(error)} frames, {fixed.dt_best:.2f} s apart")

# %%
# Fixed number of photons
# -----------------------
#
# Where bleaching limits the number of photons, more frames are dimmer frames, and sigma rises.
# ``photons=True`` includes this: the photons of 300 frames in 220 s are divided among any number
# of frames.

dim = perrin.plan_sampling(body, D_R=D_R, sigma=sigma, n_frames=300, total_time=220.0, photons=True)
print(f"{dim.n_frames} frames, {dim.dt_best:.2f} s apart, error {dim.expected_error:.1%}")

# %%
# After the experiment
# --------------------
#
# ``judge_sampling`` compares a measurement with the best plan: was it sampled too often or too
# rarely?

truth = perrin.simulate_motion(body, D_R=D_R, D_T=D_T, dt=0.06, n_frames=3000, rng=4)
motion = perrin.track_rotation(perrin.add_noise(truth.positions(), sigma=sigma, rng=5), dt=0.06)
estimate = perrin.estimate_diffusion(motion)
print(estimate)
print(perrin.judge_sampling(estimate).text)

# %%
# Next: :doc:`/theory/sampling` derives the bound and lists what it does not include.
