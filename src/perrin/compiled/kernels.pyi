from perrin._arrays import Bools, Floats

def wahba(
    points: Floats,
    reference: Floats,
    rotation: Floats,
    certain: Bools,
    weights: Floats | None,
    /,
) -> None: ...
