"""Simulate the table of the demo: one tetrahedron under the conditions of the paper.

Hunter et al. 2011, section 5: touching spheres of 2.45 um, D_R = 4.93e-3 rad^2/s,
D_T = 3.85e-2 um^2/s, 300 frames 0.73 s apart, localisation errors of 30, 30 and 40 nm. Positions
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
    truth = perrin.simulate_motion(
        perrin.Cluster.touching(4, 2.45),
        D_R=4.93e-3,
        D_T=3.85e-2,
        dt=0.73,
        n_frames=300,
        rng=rng,
    )
    x = perrin.add_noise(truth.positions(), sigma=(0.03, 0.03, 0.04), rng=rng).round(4)
    return perrin.positions_table(x)


if __name__ == "__main__":
    perrin.write_tracks(demo_table(), sys.argv[1])
