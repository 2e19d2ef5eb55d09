"""Simulate the table of the demo: one tetrahedron that diffuses as hydrodynamics predicts.

The conditions are those of Hunter et al. 2011, section 5: touching spheres of 2.45 um at 295 K in a
liquid of 2.18 mPa s, 300 frames 0.73 s apart, localisation errors of 30, 30 and 40 nm. D_R and D_T
are those of `cluster_mobility`, to four digits: 6.727e-3 rad^2/s and 4.535e-2 um^2/s. Positions
are rounded to 0.1 nm. `python examples/make_demo_table.py FILE` writes the table; a test compares
it with the one of the package.
"""

import sys

import numpy as np
import pandas as pd

import perrin


def demo_table() -> pd.DataFrame:
    """Return the table: frame, particle, x, y, z in um, and one cluster, number 0."""
    rng = np.random.default_rng(2011)
    cluster = perrin.Cluster.touching(4, 2.45)
    predicted = perrin.cluster_mobility(
        cluster.positions, radius=1.225, viscosity=2.18e-3, temperature=295.0
    )
    # All three axes of a tetrahedron are equal; four digits do not depend on the machine.
    D_R, D_T = (float(f"{np.trace(tensor) / 3:.4g}") for tensor in (predicted.D_R, predicted.D_T))
    truth = perrin.simulate_motion(cluster, D_R=D_R, D_T=D_T, dt=0.73, n_frames=300, rng=rng)
    x = perrin.add_noise(truth.positions(), sigma=(0.03, 0.03, 0.04), rng=rng).round(4)
    return perrin.positions_table(x)


if __name__ == "__main__":
    perrin.write_tracks(demo_table(), sys.argv[1])
