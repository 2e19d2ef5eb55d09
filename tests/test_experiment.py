"""Options objects: what they refuse, and that NumPy's numbers become Python's."""

from __future__ import annotations

import json

import numpy as np
import pytest

import perrin
from perrin import Camera, Experiment, Light, Noise, Scan, Spots, Work


@pytest.mark.parametrize(
    ("kind", "given", "words"),
    [
        (Noise, {"model": True}, "noise: expected 'joint', 'residual' or sigma in um, got True"),
        (Noise, {"exposure": True}, "exposure: expected a fraction of dt"),
        (Noise, {"drift": "no"}, "drift: expected True or False, got 'no'"),
        (Experiment, {"keep_jumps": "no"}, "keep_jumps: expected True or False"),
        (Experiment, {"sigma": True}, "sigma: expected one number >= 0 or one per axis"),
        (Experiment, {"sigma": "0.03"}, "sigma: expected one number >= 0 or one per axis"),
        (Experiment, {"noise": "joint"}, r"noise: expected Noise\(...\)"),
        (Spots, {"border": 1}, "border: expected True or False"),
        (Work, {"scheduler": 3}, "scheduler: expected an address"),
        (Work, {"anew": "no", "keep": 3}, "anew: expected True.*; keep: expected the path"),
        (Work, {"progress": 3}, "progress: expected a function"),
        (Light, {"gradient": "steep"}, "gradient: expected three finite numbers"),
        (Scan, {"substeps": 2.5}, "substeps: expected a whole number"),
        (Camera, {"noise": "no"}, "noise: expected True or False"),
    ],
)
def test_options_of_another_kind_are_refused(kind, given, words):
    """A text is no flag, a flag is no number; the message names the option."""
    with pytest.raises(ValueError, match=words):
        kind(**given)


def test_an_experiment_of_another_kind_is_refused():
    """A dictionary is no Experiment."""
    with pytest.raises(TypeError, match=r"experiment: expected Experiment\(...\), got {'dt': 1}"):
        perrin.analyze("none.csv", dt=0.5, experiment={"dt": 1})


def test_numbers_of_numpy_become_numbers_of_json():
    """Every options object of NumPy's numbers equals the one of Python's, and JSON holds it."""
    pairs = [
        (Noise(np.float32(0.5), np.int64(1), np.True_), Noise(0.5, 1, True)),
        (Experiment(dt=np.float32(0.5), keep_jumps=np.False_), Experiment(dt=0.5)),
        (Spots(minmass=np.float32(8.0), dark=np.True_), Spots(minmass=8.0, dark=True)),
        (Light(photons=np.int64(7)), Light(photons=7)),
        (Scan(substeps=np.int64(4)), Scan(substeps=4)),
        (Camera(gain=np.float32(2.0)), Camera(gain=2.0)),
    ]
    for given, plain in pairs:
        assert given == plain
        assert type(given).from_dict(json.loads(json.dumps(given.to_dict()))) == plain
