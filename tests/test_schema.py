"""The JSON schema of `summary.json` describes what is written, and nothing else."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import perrin

fastjsonschema = pytest.importorskip("fastjsonschema")

SCHEMA = Path(__file__).resolve().parents[1] / "docs" / "reference" / "summary.schema.json"


@pytest.fixture(scope="module")
def validate():
    return fastjsonschema.compile(json.loads(SCHEMA.read_text(encoding="utf-8")))


@pytest.fixture(scope="module")
def summary(tmp_path_factory):
    """Return the file of a run on a tetrahedron, a pair and a table with everything stated."""
    tables = []
    for k, n in enumerate((4, 2)):
        truth = perrin.simulate_motion(
            perrin.Cluster.touching(n, 2.0), D_R=0.01, D_T=0.05, dt=0.5, n_frames=60, rng=k
        )
        x = perrin.add_noise(truth.positions(), sigma=0.03, rng=9 + k) + 40.0 * k
        tables.append(perrin.positions_table(x).assign(cluster=k))
    report = perrin.analyze(
        pd.concat(tables), dt=0.5, viscosity=1e-3, temperature=295.0, diameter=2.0, drift=True
    )
    assert len(report.clusters) == len(report.rods) == 1
    folder = tmp_path_factory.mktemp("schema") / "run"
    report.save(folder)
    return json.loads((folder / "summary.json").read_text(encoding="utf-8"))


def test_a_summary_follows_its_schema(validate, summary):
    validate(summary)


def test_a_summary_in_the_plane_follows_its_schema(validate):
    turn = np.cumsum(0.1 * np.random.default_rng(1).normal(size=40))[:, None]
    place = np.arange(3) * 2 * np.pi / 3
    x = np.stack([np.cos(turn + place), np.sin(turn + place)], axis=-1)
    x = perrin.add_noise(x + turn[..., None], sigma=0.02, rng=2)
    report = perrin.analyze(perrin.positions_table(x), dt=1.0)
    validate(json.loads(json.dumps(report.to_dict())))


@pytest.mark.parametrize("change", ["remove", "add", "type"])
def test_the_schema_refuses_another_form(validate, summary, change):
    """A missing key, an unknown key and a text in place of a number are refused."""
    other = json.loads(json.dumps(summary))
    estimate = other["clusters"][0]["D_T"]
    if change == "remove":
        del estimate["ci95"]
    elif change == "add":
        estimate["unknown"] = 1.0
    else:
        estimate["value"] = "0.05"
    with pytest.raises(fastjsonschema.JsonSchemaException):
        validate(other)
