"""Compare the coverage of a run with its limits: ``coverage json -o - | python THIS``."""

import json
import sys

LIMITS = {"lines": 0.95, "branches": 0.90}


def main() -> int:
    """Print both shares; return 1 if one of them is too small."""
    totals = json.load(sys.stdin)["totals"]
    shares = {
        "lines": totals["covered_lines"] / totals["num_statements"],
        "branches": totals["covered_branches"] / totals["num_branches"],
    }
    for name, share in shares.items():
        print(f"{name}: {share:.1%} covered, at least {LIMITS[name]:.0%} are required")
    return int(any(share < LIMITS[name] for name, share in shares.items()))


if __name__ == "__main__":
    sys.exit(main())
