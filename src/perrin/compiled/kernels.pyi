from perrin._arrays import Bools, Floats

def wahba(
    points: Floats,
    reference: Floats,
    rotation: Floats,
    certain: Bools,
    weights: Floats | None,
    /,
) -> None: ...
def spots(
    mask: Bools,
    centers: Floats,
    voxel: Floats,
    reach: Floats,
    spacing: Floats,
    tables: Floats,
    out: Floats,
    /,
) -> None: ...
def curvatures(
    axes: Floats, same: Floats, after: Floats, power: Floats, trace: Floats, out: Floats, /
) -> None: ...
def mode_sums(
    modes: Floats, axes: Floats, share: Floats, weight: Floats, sums: Floats, /
) -> None: ...
def spectrum_sums(
    power: Floats,
    axes: Floats,
    by_D: Floats,
    by_theta: Floats,
    given: Floats,
    D: Floats,
    theta: Floats,
    sums: Floats,
    /,
) -> None: ...
def two_states(
    vectors: Floats,
    noise: Floats,
    clock: Floats,
    sizes: Floats,
    blur: Floats,
    points: Floats,
    pairs: Floats,
    value: Floats,
    /,
) -> None: ...
