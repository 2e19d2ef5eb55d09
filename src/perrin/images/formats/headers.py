"""Voxel sizes and times in the headers of TIFF files: OME, ImageJ, LSM, MetaMorph, NDTiff."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from perrin.images.formats.contents import (
    Layout,
    even_times,
    in_seconds,
    in_um,
)

if TYPE_CHECKING:
    from collections.abc import Sequence
    from xml.etree.ElementTree import Element

    from perrin._arrays import Floats


class HeaderScale(NamedTuple):
    """Lengths and times that the header of a file states.

    Attributes
    ----------
    voxel : ndarray, shape (3,)
        Voxel size (z, y, x), um; NaN where it is not stated.
    times : ndarray, shape (t,), or None
        Times of the frames, s.
    plane_time : float or None
        Time from one plane to the next, s.
    notes : tuple of str
        Values that were completed from others in the header.
    without_times : str
        Why the times of the header cannot be used; empty where they can, or there are none.
    """

    voxel: Floats
    times: Floats | None = None
    plane_time: float | None = None
    notes: tuple[str, ...] = ()
    without_times: str = ""


def tiff_kind(file: Any) -> str:  # noqa: ANN401 (tifffile is untyped here)
    """Return what a TIFF file is, for messages to the user.

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> flags = {"is_ome": False, "is_imagej": True, "is_lsm": False, "is_stk": False}
    >>> tiff_kind(SimpleNamespace(**flags, is_metaseries=False, is_micromanager=False))
    'ImageJ TIFF'
    """
    kinds = {
        "is_ome": "OME-TIFF",
        "is_imagej": "ImageJ TIFF",
        "is_lsm": "Zeiss LSM",
        "is_stk": "MetaMorph STK",
        "is_metaseries": "MetaMorph TIFF",
        "is_micromanager": "Micro-Manager TIFF (NDTiff)",
    }
    return next((name for flag, name in kinds.items() if getattr(file, flag)), "TIFF")


def header_scale(
    file: Any,  # noqa: ANN401
    where: Layout,
    *,
    number: int,
    names: Sequence[str],
    channel: int,
) -> HeaderScale:
    """Read the lengths and times of a TIFF file from the header that its program wrote.

    Parameters
    ----------
    file : tifffile.TiffFile
    where : Layout
        Times and planes of the image.
    number : int
        Number of the image that is read.
    names : sequence of str
        Names of all images of the file.
    channel : int
        Number of the channel, whose times are read.

    Returns
    -------
    HeaderScale
        NaN and None where the file states nothing.
    """
    if file.is_ome:
        images = ome_images(file.ome_metadata)
        pixels = ome_pixels(images, names, number, file_name=file.filename)
        return ome_scale(pixels, where, channel)
    if file.is_imagej:
        return imagej_scale(file, where)
    if file.is_lsm:
        return lsm_scale(file.lsm_metadata, where)
    if file.is_stk:
        return stk_scale(file.stk_metadata, where)
    if file.is_metaseries:
        return metaseries_scale(file, where)
    if file.is_micromanager:
        pixel = in_um(image_header(file.pages.first).get("PixelSizeUm"), "um")
        return HeaderScale(np.array([np.nan, pixel, pixel]), even_times(where.t, np.nan))
    return HeaderScale(np.full(3, np.nan))


def image_header(page: Any) -> dict[str, Any]:  # noqa: ANN401
    """Return what Micro-Manager writes about one image; empty where it wrote nothing.

    Parameters
    ----------
    page : tifffile.TiffPage

    Returns
    -------
    dict
    """
    tag = page.tags.get("MicroManagerMetadata")
    return tag.value if tag is not None and isinstance(tag.value, dict) else {}


def xml_root(text: str | bytes) -> Element:
    """Return the root of a header in XML; one that defines entities of its own is refused.

    Raises
    ------
    ValueError
        If this is no XML, or has a document type.

    Examples
    --------
    >>> xml_root("<OME><Image/></OME>").tag
    'OME'
    >>> xml_root('<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>')
    Traceback (most recent call last):
        ...
    ValueError: has a header with a document type (DOCTYPE), which no microscope writes
    """
    from xml.etree import ElementTree

    found = "<!doctype" in text.lower() if isinstance(text, str) else b"<!doctype" in text.lower()
    if found:
        raise ValueError("has a header with a document type (DOCTYPE), which no microscope writes")
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError as fault:
        raise ValueError(f"has a damaged header: {fault}") from None


def ome_images(xml: str) -> list[Element]:
    """Return the Image elements of an OME header.

    Raises
    ------
    ValueError
        If the header only names another file that has the metadata.

    Examples
    --------
    >>> [image.get("Name") for image in ome_images('<OME xmlns="a"><Image Name="b"/></OME>')]
    ['b']
    """
    root = xml_root(xml)
    images = [e for e in root if e.tag.split("}")[-1] == "Image"]
    elsewhere = [e for e in root if e.tag.split("}")[-1] == "BinaryOnly"]
    if elsewhere and not images:
        raise ValueError(
            f"has images only: its header is in another file, {elsewhere[0].get('MetadataFile')}; "
            "put that file into the same folder"
        )
    return images


def ome_pixels(
    images: Sequence[Element], names: Sequence[str], number: int, *, file_name: str
) -> Element:
    """Return the Pixels element of one image among those of an OME header.

    A file of a set of several positions has the header of the whole set.

    Parameters
    ----------
    images : sequence of Element
        Image elements of the header.
    names : sequence of str
        Names of the images that the file has.
    number : int
        Number of the image among them.
    file_name : str
        Name of the file, by which an image without a name of its own is found.

    Returns
    -------
    Element

    Raises
    ------
    ValueError
        If several images of the header could be the one wanted.

    Examples
    --------
    >>> image = '<Image Name="{0}"><Pixels SizeT="{0}"/></Image>'
    >>> images = ome_images(f"<OME>{image.format(7)}{image.format(9)}</OME>")
    >>> ome_pixels(images, ["9"], 0, file_name="9.ome.tif").get("SizeT")
    '9'
    """

    def part(image: Element) -> Element:
        return next(e for e in image if e.tag.split("}")[-1] == "Pixels")

    named = [image for image in images if image.get("Name") == names[number]]
    if len(named) == 1:
        return part(named[0])
    if len(images) == len(names):
        return part(images[number])
    inside = [
        image for image in images if any(e.get("FileName") == file_name for e in part(image).iter())
    ]
    if len(inside) == 1:
        return part(inside[0])
    raise ValueError(
        f"has a header of {len(images)} images for the {len(names)} in the file, without stating "
        "which is which: put all files of the set into one folder"
    )


def ome_scale(pixels: Element, where: Layout, channel: int) -> HeaderScale:
    """Read the pixel sizes of an OME header, and the times of planes or an interval.

    Parameters
    ----------
    pixels : Element
        The Pixels element of the image.
    where : Layout
        Times and planes of the image.
    channel : int
        Number of the channel, whose times are read.

    Returns
    -------
    HeaderScale
        The measured times of the planes where the header has any, else even ones.

    Examples
    --------
    >>> from perrin.images.formats.contents import Pick, layout
    >>> xml = (
    ...     '<OME xmlns="a"><Image><Pixels PhysicalSizeZ="0.25" PhysicalSizeY="200" '
    ...     'PhysicalSizeYUnit="nm" TimeIncrement="0.5"/></Image></OME>'
    ... )
    >>> pixels = ome_pixels(ome_images(xml), [""], 0, file_name="")
    >>> scale = ome_scale(pixels, layout({"T": 3, "Z": 4}, Pick()), 0)
    >>> scale.voxel, scale.times
    (array([0.25, 0.2 ,  nan]), array([0. , 0.5, 1. ]))
    """
    voxel = np.array(
        [
            in_um(
                pixels.get(f"PhysicalSize{axis}"), pixels.get(f"PhysicalSize{axis}Unit", "\u00b5m")
            )
            for axis in "ZYX"
        ]
    )
    clock = np.full((where.t, where.z), np.nan)
    for e in pixels:
        if e.tag.endswith("Plane") and e.get("DeltaT") and int(e.get("TheC", 0)) == channel:
            t, z = int(e.get("TheT", 0)), int(e.get("TheZ", 0))
            if t < where.t and z < where.z:
                unit = in_seconds(1.0, e.get("DeltaTUnit", "s"))
                clock[t, z] = float(e.get("DeltaT", "nan")) * unit
    if len(np.unique(clock[np.isfinite(clock)])) > 1 or clock.size == 1:
        return clock_scale(voxel, clock)
    interval = in_seconds(pixels.get("TimeIncrement"), pixels.get("TimeIncrementUnit", "s"))
    return HeaderScale(voxel, even_times(where.t, interval))


def clock_scale(voxel: Floats, clock: Floats) -> HeaderScale:
    """Return the times of frames, and from plane to plane, from the times of single planes.

    Parameters
    ----------
    voxel : ndarray, shape (3,)
        Voxel size (z, y, x), um.
    clock : ndarray, shape (t, z)
        Time of every plane, s; NaN where it is not stated.

    Returns
    -------
    HeaderScale
        A frame whose first plane has no time gets it from its other planes, with a note. Where a
        frame has no time at all there are no times, because a mean interval would be a guess.

    Examples
    --------
    >>> scale = clock_scale(np.ones(3), np.array([[0.0, 0.1, 0.2], [np.nan, 0.8, 0.9]]))
    >>> scale.times.round(6), round(scale.plane_time, 6), scale.notes
    (array([0. , 0.7]), 0.1, ('the times of frames 1 come from planes other than the first',))
    """
    steps = np.diff(clock, axis=1)
    steps = steps[np.isfinite(steps)]
    plane_time = float(np.median(steps)) if steps.size else 0.0
    start = clock[:, 0].copy()
    notes: tuple[str, ...] = ()
    unknown = np.flatnonzero(np.isnan(start))
    recovered = []
    for t in unknown if steps.size else ():
        k = np.flatnonzero(np.isfinite(clock[t]))
        if k.size:
            start[t] = np.median(clock[t, k] - k * plane_time)
            recovered.append(int(t))
    if recovered:
        notes = (
            f"the times of frames {', '.join(map(str, recovered))} come from planes other than "
            "the first",
        )
    step = plane_time if plane_time != 0 else None
    if len(start) == 1:
        return HeaderScale(voxel, np.nan_to_num(start), step, notes)
    lost = np.flatnonzero(np.isnan(start))
    if lost.size:
        reason = f"the file lacks those of {lost.size} frames, the first of them {lost[0]}"
        return HeaderScale(voxel, None, step, notes, reason)
    return HeaderScale(voxel, start, step, notes)


def imagej_scale(file: Any, where: Layout) -> HeaderScale:  # noqa: ANN401
    """Read an ImageJ header: units, spacing, interval, and the resolution tags in these units.

    `fps` is not read: it is the speed at which ImageJ plays the movie.

    Parameters
    ----------
    file : tifffile.TiffFile
    where : Layout
        Times and planes of the file.

    Returns
    -------
    HeaderScale
    """
    header = file.imagej_metadata or {}
    unit = header.get("unit")
    tags = file.pages[0].tags

    def pixel_size(tag: str, unit: str | None) -> float:
        if tag not in tags or not all(tags[tag].value):
            return float("nan")
        count, length = tags[tag].value
        return in_um(length / count, unit)

    voxel = np.array(
        [
            in_um(header.get("spacing"), header.get("zunit", unit)),
            pixel_size("YResolution", header.get("yunit", unit)),
            pixel_size("XResolution", unit),
        ]
    )
    interval = in_seconds(header.get("finterval"), str(header.get("tunit", "sec")))
    reason = ""
    if not np.isfinite(interval) and header.get("fps"):
        reason = f"its fps={header['fps']} is the speed of ImageJ's player, not of the microscope"
    return HeaderScale(voxel, even_times(where.t, interval), without_times=reason)


def lsm_scale(header: Any, where: Layout) -> HeaderScale:  # noqa: ANN401
    """Read the header of a Zeiss LSM file: voxel size in m, and time stamps or an interval in s.

    Parameters
    ----------
    header : dict
        CZ_LSMINFO, as tifffile reads it.
    where : Layout
        Times and planes of the file.

    Returns
    -------
    HeaderScale

    Examples
    --------
    >>> from perrin.images.formats.contents import Pick, layout
    >>> header = {"VoxelSizeX": 1e-7, "VoxelSizeY": 1e-7, "VoxelSizeZ": 0.0, "TimeIntervall": 0.5}
    >>> scale = lsm_scale(header, layout({"T": 3}, Pick()))
    >>> scale.voxel.round(9), scale.times
    (array([nan, 0.1, 0.1]), array([0. , 0.5, 1. ]))
    """
    voxel = np.array([in_um(header.get(f"VoxelSize{axis}"), "m") for axis in "ZYX"])
    stamps = np.asarray(header.get("TimeStamps", ()), dtype=np.float64)
    if len(stamps) == where.t > 1:
        return HeaderScale(voxel, stamps)
    return HeaderScale(voxel, even_times(where.t, in_seconds(header.get("TimeIntervall"), "s")))


def stk_scale(header: Any, where: Layout) -> HeaderScale:  # noqa: ANN401
    """Read the header of a MetaMorph STK file: calibration, distance of planes, dates of images.

    Parameters
    ----------
    header : dict
        The UIC tags, as tifffile reads them.
    where : Layout
        Times and planes of the file.

    Returns
    -------
    HeaderScale

    Examples
    --------
    >>> from perrin.images.formats.contents import Pick, layout
    >>> header = {"XCalibration": 0.1, "YCalibration": 0.2, "CalibrationUnits": "um"}
    >>> stk_scale({"SpatialCalibration": 1, **header}, layout({}, Pick())).voxel
    array([nan, 0.2, 0.1])
    """
    unit = str(header.get("CalibrationUnits", "")) if header.get("SpatialCalibration") else None
    distance = np.unique(np.abs(np.atleast_1d(header.get("ZDistance", np.nan))))
    depth = float(distance[0]) if len(distance) == 1 else np.nan
    # MetaMorph states the distance of planes in um, whatever the unit of the pixels.
    voxel = np.array(
        [
            in_um(depth, "um"),
            in_um(header.get("YCalibration"), unit),
            in_um(header.get("XCalibration"), unit),
        ]
    )
    dates = np.atleast_1d(np.asarray(header.get("DatetimeCreated"), dtype="datetime64[ms]"))
    if len(dates) != where.t * where.z or where.t == 1 or np.any(np.isnat(dates)):
        return HeaderScale(voxel, even_times(where.t, np.nan))
    seconds = (dates - dates[0]) / np.timedelta64(1, "s")
    return clock_scale(voxel, seconds.reshape(where.t, where.z))


def metaseries_scale(file: Any, where: Layout) -> HeaderScale:  # noqa: ANN401
    """Read the pixel size in the header of a MetaMorph or MetaXpress TIFF.

    Parameters
    ----------
    file : tifffile.TiffFile
    where : Layout
        Times and planes of the file.

    Returns
    -------
    HeaderScale
    """
    plane = (file.metaseries_metadata or {}).get("PlaneInfo", {})
    unit = (
        plane.get("spatial-calibration-units") if plane.get("spatial-calibration-state") else None
    )
    lengths = [in_um(plane.get(f"spatial-calibration-{axis}"), unit) for axis in "yx"]
    return HeaderScale(np.array([np.nan, *lengths]), even_times(where.t, np.nan))
