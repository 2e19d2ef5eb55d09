"""Motions of dense systems with known truth: caged, hopping, switching and fractional."""

from dataclasses import replace
from functools import cache

import numpy as np

from perrin import Cluster, simulate_motion
from perrin.geometry.rotations import cumulative_product, exp_map

TETRA = Cluster.tetrahedron(1.5)


@cache
def still(n_frames):
    """Return a motion whose poses are to be replaced."""
    return simulate_motion(TETRA, D_R=1e-3, dt=1.0, n_frames=n_frames, rng=0)


def caged(n_frames, rng, *, rms=0.1, relaxation=5.0, hop=0.0, interval=100, noise=4e-4):
    """Return rotation in a cage (rad, frames) that hops by an angle about once in an interval.

    The D_R of long times is hop^2/(6 interval) a frame. `noise` is the variance of one angle.
    """
    from scipy.signal import lfilter

    kept = np.exp(-1 / relaxation)
    drive = rms * np.sqrt(1 - kept**2) * rng.normal(size=(n_frames, 3))
    drive[0] /= np.sqrt(1 - kept**2)
    inside = lfilter([1.0], [1.0, -kept], drive, axis=0)
    axis = rng.normal(size=(n_frames - 1, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    hops = hop * axis * (rng.random(n_frames - 1) < 1 / interval)[:, None]
    error = np.sqrt(noise) * rng.normal(size=(n_frames, 3))
    rotation = cumulative_product(exp_map(hops)) @ exp_map(inside) @ exp_map(error)
    return replace(still(n_frames), rotation=rotation)


def switching_speed(n_steps, rng, *, ratio, dwell):
    """Return the D of every step over its mean: two states with a mean dwell time in steps."""
    state = np.cumsum(rng.random(n_steps) < 1 / dwell) + rng.integers(2)
    return np.where(state % 2 == 0, 2 / (1 + ratio), 2 * ratio / (1 + ratio))


def moving(speed_T, speed_R, rng, *, D=1e-3, snr=5.0):
    """Return translation and rotation with the D of every step over its mean, and noise."""
    n_frames = len(speed_T) + 1
    walk, turn, error_T, error_R = rng.normal(size=(4, n_frames, 3))
    walk[0] = 0.0
    walk[1:] *= np.sqrt(2 * D * speed_T)[:, None]
    turns = np.sqrt(2 * D * speed_R)[:, None] * turn[1:]
    error = np.sqrt(D / snr)
    rotation = cumulative_product(exp_map(turns)) @ exp_map(error * error_R)
    return replace(
        still(n_frames), center=np.cumsum(walk, axis=0) + error * error_T, rotation=rotation
    )


def fractional_walk(n_frames, rng, *, alpha, n_axes=3):
    """Return exact fractional Brownian motion (T, axes) whose MSD is t^alpha (Davies and Harte)."""
    power = np.abs(np.arange(-1.0, n_frames + 1)) ** alpha
    correlation = 0.5 * (power[2:] + power[:-2] - 2 * power[1:-1])
    circle = np.concatenate([correlation, correlation[-2:0:-1]])
    root = np.sqrt(np.maximum(np.fft.fft(circle).real, 0) / len(circle))
    white = rng.normal(size=(2, n_axes, len(circle)))
    steps = np.fft.fft((white[0] + 1j * white[1]) * root).real[:, : n_frames - 1]
    return np.concatenate([np.zeros((1, n_axes)), np.cumsum(steps, axis=1).T])
