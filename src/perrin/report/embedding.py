"""Data and scripts inside a page: compressed, as text, with the hashes that allow the scripts."""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
from functools import lru_cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from perrin._arrays import Floats

_MISSING = 65535  # the whole number that stands for a missing value


def packed(
    header: Mapping[str, Any], arrays: Mapping[str, Floats], *, exact: Collection[str] = ()
) -> str:
    """Return named values and arrays as text: a JSON header and columns, compressed, in base64.

    Parameters
    ----------
    header : mapping
        Values for JSON.
    arrays : mapping
        Columns; NaN for missing values.
    exact : collection of str
        Names of the columns that are written as 32-bit floats. Others are 16-bit whole numbers
        between the column's ends, with an error of 8e-6 of its range.

    Returns
    -------
    str
        The bytes are the header's length (4, little endian), the header, and the columns; its entry
        "columns" has the name, length and ends (None if exact) of each.

    Examples
    --------
    >>> text = packed({"name": "a"}, {"t": np.array([0.0, 1.0])})
    >>> content = gzip.decompress(base64.b64decode(text))
    >>> content[4 : 4 + content[0]].decode()
    '{"name":"a","columns":[["t",2,[0.0,1.0]]]}'
    """
    columns, parts = [], []
    for name, array in arrays.items():
        values = np.asarray(array, dtype=np.float64).ravel()
        known = values[np.isfinite(values)]
        if name in exact:
            columns.append([name, values.size, None])
            parts.append(values.astype("<f4").tobytes())
            continue
        low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)
        step = (high - low) / (_MISSING - 1) or 1.0
        whole = np.where(np.isfinite(values), np.rint((values - low) / step), _MISSING)
        columns.append([name, values.size, [low, high]])
        parts.append(whole.astype("<u2").tobytes())
    text = json.dumps({**header, "columns": columns}, separators=(",", ":"), allow_nan=False)
    start = text.encode("utf-8")
    content = len(start).to_bytes(4, "little") + start + b"".join(parts)
    return base64.b64encode(gzip.compress(content, 6, mtime=0)).decode("ascii")


def source_hash(script: str) -> str:
    """Return the expression of a Content-Security-Policy that allows one script.

    Examples
    --------
    >>> source_hash("")
    "'sha256-47DEQpj8HBSa+/TImW+5JCeuQeRkm5NMpJWZG3hSuFU='"
    """
    digest = hashlib.sha256(script.encode("utf-8")).digest()
    return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"


@lru_cache(maxsize=1)
def plotly_script() -> tuple[str, str]:
    """Return plotly.js, compressed and in base64, and the hash that allows it.

    Returns
    -------
    tuple of str
        The text of `packed` without a header, and the expression of `source_hash`.
    """
    content = (files("plotly") / "package_data" / "plotly.min.js").read_bytes()
    text = base64.b64encode(gzip.compress(content, 6, mtime=0)).decode("ascii")
    return text, source_hash(content.decode("utf-8"))


def page_script(name: str) -> str:
    """Return a script of the package, which stands in the page as it is.

    Parameters
    ----------
    name : str
        File name without suffix.
    """
    return (files("perrin.report") / "templates" / f"{name}.js").read_text(encoding="utf-8")
