"""Write the null laws of the tests of Brownian motion that have no closed form.

Independent normal prediction errors, each axis scaled to a mean square of 1, give the quantiles of
four statistics of perrin.diffusion.goodness_of_fit for 1 to 3 axes and 20 to 10000 steps. They are
kept in the package; run this again after a change of a statistic (about five minutes):

    python benchmarks/brownian_quantiles.py
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from perrin.diffusion import goodness_of_fit

LENGTHS = (20, 30, 50, 75, 100, 150, 200, 300, 500, 1000, 3000, 10000)
UPPER = (0.9, 0.7, 0.5, 0.3, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001)
DRAWS = 100_000
NUMBERS = 3_000_000  # at a time


def quantiles(axes: int, n_steps: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return the upper quantiles of every statistic."""
    draws = DRAWS if n_steps <= 1000 else DRAWS // 3
    batch = max(1, NUMBERS // (axes * n_steps))
    found: dict[str, list[np.ndarray]] = {}
    for start in range(0, draws, batch):
        e = rng.standard_normal((min(batch, draws - start), axes, n_steps))
        e /= np.sqrt(np.mean(e * e, axis=-1, keepdims=True))
        statistics = goodness_of_fit.tabulated_statistics(np.sum(e * e, axis=1), axes)
        for name, values in statistics.items():
            found.setdefault(name, []).append(values)
    return {name: np.quantile(np.concatenate(v), 1 - np.array(UPPER)) for name, v in found.items()}


def main() -> None:
    """Write the table."""
    rng = np.random.default_rng(20261128)
    rows = ["test,axes,steps," + ",".join(f"{p:g}" for p in UPPER)]
    for axes in (1, 2, 3):
        for n_steps in LENGTHS:
            for name, values in quantiles(axes, n_steps, rng).items():
                rows.append(f"{name},{axes},{n_steps}," + ",".join(f"{v:.5g}" for v in values))
            print(rows[-1], flush=True)
    path = Path(goodness_of_fit.__file__).with_name("brownian_quantiles.csv")
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
