"""The Cramér-Rao bound: a published table, a dense Fisher matrix, and laws."""

import numpy as np
import pytest

from perrin import cramer_rao

# sd(D)/D in percent, computed independently. Columns: N, SNR, 3 axes with s known, from the
# residuals of 4 particles and unknown; 2 axes known, unknown; 1 axis known, unknown; 3 axes under
# full blur unknown, known.
TABLE = """
100   0.05 29.82 30.24 31.45 36.52 38.52 51.64 54.47 31.32 30.16
100   0.2  20.45 20.94 23.01 25.05 28.18 35.42 39.85 22.69 21.20
100   1    13.26 13.56 17.46 16.24 21.38 22.96 30.24 16.62 14.55
100   5     9.64  9.69 15.12 11.81 18.52 16.70 26.19 13.55 10.62
100   50    8.37  8.37 14.36 10.25 17.58 14.49 24.87 12.25  8.55
300   0.05 16.84 17.07 17.72 20.63 21.70 29.17 30.70 17.65 17.03
300   0.2  11.68 11.96 13.11 14.31 16.06 20.24 22.71 12.93 12.11
300   1     7.62  7.79 10.00  9.33 12.25 13.19 17.32  9.53  8.35
300   5     5.55  5.58  8.68  6.80 10.63  9.61 15.03  7.78  6.11
300   50    4.81  4.82  8.24  5.90 10.09  8.34 14.28  7.04  4.92
1000  0.05  9.16  9.28  9.63 11.22 11.79 15.86 16.67  9.59  9.26
1000  0.2   6.38  6.52  7.15  7.81  8.75 11.04 12.38  7.05  6.60
1000  1     4.16  4.26  5.46  5.10  6.69  7.21  9.46  5.20  4.57
1000  5     3.04  3.05  4.74  3.72  5.81  5.26  8.21  4.26  3.34
1000  50    2.63  2.63  4.51  3.23  5.52  4.56  7.80  3.85  2.69
10000 0.05  2.89  2.93  3.03  3.54  3.72  5.00  5.26  3.02  2.92
10000 0.2   2.01  2.06  2.26  2.47  2.76  3.49  3.91  2.23  2.09
10000 1     1.32  1.35  1.73  1.61  2.11  2.28  2.99  1.64  1.44
10000 5     0.96  0.96  1.50  1.17  1.83  1.66  2.60  1.34  1.06
10000 50    0.83  0.83  1.42  1.02  1.74  1.44  2.47  1.22  0.85
"""
COLUMNS = [
    {"noise": "known"}, {"noise": "residual"}, {},
    {"noise": "known", "axes": 2}, {"axes": 2}, {"noise": "known", "axes": 1}, {"axes": 1},
    {"exposure": 1.0}, {"noise": "known", "exposure": 1.0},
]  # fmt: skip
ROWS = [[float(x) for x in line.split()] for line in TABLE.strip().splitlines()]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row[0]:g}-{row[1]:g}")
def test_the_bound_is_the_published_table(row):
    """The bound in percent equals an independent table to its last digit."""
    n_frames, snr, *expected = row
    bounds = [100 * cramer_rao(n_frames=int(n_frames), snr=snr, **c) for c in COLUMNS]
    assert bounds == pytest.approx(expected, abs=0.00501)  # the rounding of the table


def dense_bound(n_frames, snr, *, axes, noise, exposure, dof):
    """Return the bound from tr(C^-1 dC C^-1 dC)/2 of the covariance itself, C per D dt."""
    steps = n_frames - 1
    second = 2 * np.eye(steps) - np.eye(steps, k=1) - np.eye(steps, k=-1)
    by_D = 2 * np.eye(steps) - exposure / 3 * second
    by_s = second / snr
    inverse = np.linalg.inv(by_D + by_s)
    slopes = [inverse @ by_D, inverse @ by_s]
    fisher = axes * np.array([[np.trace(a @ b) / 2 for a in slopes] for b in slopes])
    if noise == "known":
        return fisher[0, 0] ** -0.5
    fisher[1, 1] += steps * dof / 2 if noise == "residual" else 0
    return np.linalg.inv(fisher)[0, 0] ** 0.5


@pytest.mark.parametrize("noise", ["joint", "residual", "known"])
@pytest.mark.parametrize(("axes", "exposure", "dof"), [(1, 0.0, 3), (2, 0.4, 6), (3, 1.0, 15)])
def test_the_bound_is_the_inverse_of_a_dense_fisher_matrix(noise, axes, exposure, dof):
    """For 20 frames the sine eigenvalues give what the covariance itself gives."""
    bound = cramer_rao(
        n_frames=20, snr=0.7, axes=axes, noise=noise, exposure=exposure, residual_dof=dof
    )
    dense = dense_bound(20, 0.7, axes=axes, noise=noise, exposure=exposure, dof=dof)
    assert bound == pytest.approx(dense, rel=1e-10)


def test_few_nodes_give_the_whole_sum():
    """For long tracks the sum over all N - 1 eigenvalues is that over a few nodes."""
    n = 50_000
    bend = 1 - np.cos(np.pi * np.arange(1, n) / n)
    for snr in (1e-3, 1.0, 1e3):
        by_D, by_s = 1 / (1 + bend / snr), bend / snr / (1 + bend / snr)
        information = 1.5 * (by_D @ by_D - (by_D @ by_s) ** 2 / (by_s @ by_s))
        assert cramer_rao(n_frames=n, snr=snr) == pytest.approx(information**-0.5, rel=1e-10)


def test_an_unknown_exposure_does_not_raise_the_bound():
    """With the offset o = s - 2BDdt free, the bound is that of no blur with D dt/o as SNR."""
    for exposure, snr in ((0.3, 0.5), (1.0, 2.0)):
        offset = 1 / snr - exposure / 3
        free = cramer_rao(n_frames=200, snr=1 / offset)
        assert cramer_rao(n_frames=200, snr=snr, exposure=exposure) == pytest.approx(free)


def test_the_limits_at_high_snr():
    """N var/D^2 tends to 2/d for known noise and to 6/d for unknown noise."""
    n = 10**7
    for axes in (1, 2, 3):
        for noise, limit in (("known", 2 / axes), ("joint", 6 / axes)):
            bound = cramer_rao(n_frames=n, snr=1e9, axes=axes, noise=noise)
            assert n * bound**2 == pytest.approx(limit, rel=1e-3)


def test_knowledge_of_the_noise_lowers_the_bound():
    """Known noise lowers the bound more than residuals, many residuals more than few."""
    case = {"n_frames": 100, "snr": 0.7}
    residual = [cramer_rao(**case, noise="residual", residual_dof=dof) for dof in (1, 3, 6, 10**9)]
    bounds = [cramer_rao(**case), *residual]
    assert bounds == sorted(bounds, reverse=True)
    assert residual[-1] == pytest.approx(cramer_rao(**case, noise="known"), rel=1e-8)


def test_invalid_arguments_of_the_bound_are_refused():
    """Each value out of range is named, all of them in one message."""
    bad = {
        "n_frames": 2, "snr": 0.0, "axes": 4, "noise": "guessed", "exposure": 1.5,
        "residual_dof": 0,
    }  # fmt: skip
    for name, value in bad.items():
        with pytest.raises(ValueError, match=f"{name}: expected .*{value}"):
            cramer_rao(**({"n_frames": 100, "snr": 1.0} | {name: value}))
    with pytest.raises(ValueError, match=r"n_frames.*snr.*axes.*noise.*exposure.*residual_dof"):
        cramer_rao(**bad)
    for wrong in (100.5, True, np.inf):
        with pytest.raises(ValueError, match="n_frames"):
            cramer_rao(n_frames=wrong, snr=1.0)
