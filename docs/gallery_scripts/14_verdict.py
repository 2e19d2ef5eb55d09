"""
What kind of motion is it?
==========================

``judge_motion`` compares the steps of a motion with diffusion. The figure of the report shows the
spectrum of the steps with the law of diffusion and that of the motion that was found: here a
cage.
"""

import matplotlib.pyplot as plt

import perrin
from perrin.diffusion import Noise, axis_model
from perrin.plot import plot_step_spectrum

plt.style.use("perrin.plot.perrin")

body = perrin.Cluster.touching(4, diameter=2.45)
figure, axes = plt.subplots(1, 2, figsize=(10, 4.6), layout="constrained")
for ax, dynamics in zip(axes, (None, perrin.Confined(relaxation_time=20.0)), strict=True):
    truth = perrin.simulate_motion(body, D_R=2e-3, dt=1.0, n_frames=800, dynamics=dynamics, rng=6)
    motion = perrin.track_rotation(perrin.add_noise(truth.positions(), sigma=0.02, rng=7), dt=1.0)
    verdict = perrin.judge_motion(motion)
    model, steps = axis_model(motion, "rotation", Noise())
    plot_step_spectrum(model, model.fit(steps), ax=ax, verdict=verdict)
    ax.text(0.95, 0.05, f"verdict: {verdict.kind}", transform=ax.transAxes, ha="right")
plt.show()
