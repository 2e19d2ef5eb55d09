"""
A rendered confocal stack
=========================

``render_stack`` simulates what a confocal microscope records of moving clusters: the spheres
convolved with the point spread, photon noise and camera noise. Three sections and a side view of
one frame.
"""

import matplotlib.pyplot as plt

import perrin

plt.style.use("perrin.plot.perrin")

body = perrin.Cluster.touching(4, diameter=2.45)
truth = [
    perrin.simulate_motion(body, D_R=5e-3, D_T=0.01, dt=0.73, n_frames=2, rng=k) for k in (1, 2)
]
movie = perrin.render_stack(
    truth, centers=[(4.4, 4.4, 4.8), (9.6, 9.6, 4.8)], voxel=(0.25, 0.1, 0.1),
    shape=(38, 140, 140), diameter=2.45, psf=(0.4, 0.15, 0.15), photons=40, background=3, gain=3,
    read_noise=2, rng=1,
)  # fmt: skip
frame = movie.frame(0)

figure, axes = plt.subplots(1, 4, figsize=(12, 3.4), layout="constrained")
for ax, plane in zip(axes, (14, 19, 24), strict=False):
    ax.imshow(frame[plane], cmap="gray", vmax=frame.max(), extent=(0, 14, 14, 0))
    ax.set(title=f"z = {0.25 * plane:.1f} µm", xlabel="x (µm)")
axes[0].set_ylabel("y (µm)")
axes[3].imshow(frame[:, 44], cmap="gray", extent=(0, 14, 9.5, 0))
axes[3].set(title="y = 4.4 µm", xlabel="x (µm)", ylabel="z (µm)")
plt.show()
