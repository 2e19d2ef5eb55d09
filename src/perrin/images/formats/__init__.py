"""Image file formats: their contents, axes and units."""

from perrin.images.formats.contents import (
    Contents,
    Layout,
    Pick,
    chosen,
    even_times,
    in_seconds,
    in_um,
    layout,
    needed,
)
from perrin.images.formats.tiff import sequence, sequence_files, tiff
from perrin.images.formats.vendors import czi, ims, lif, nd2, ome_zarr, vendor

__all__ = [
    "Contents",
    "Layout",
    "Pick",
    "chosen",
    "czi",
    "even_times",
    "ims",
    "in_seconds",
    "in_um",
    "layout",
    "lif",
    "nd2",
    "needed",
    "ome_zarr",
    "sequence",
    "sequence_files",
    "tiff",
    "vendor",
]
