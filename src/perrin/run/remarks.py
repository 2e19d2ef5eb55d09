"""Warnings and notes of several clusters, with those of one kind in one line."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

from perrin._text import listed

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence


_NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?:\(\d+\))?|\b(?:nan|inf)\b")


# What a difference in number does to the words around it: lists, plurals, verbs.
_AROUND = (
    (re.compile(r"\bcluster [^\s:,;]+"), "cluster #"),
    (re.compile(r"#(?:, #)*(?: and # more|, \.\.\.)?"), "#"),
    (re.compile(r"(\w)s (?=#)"), r"\1 "),
    (re.compile(r"(?<=# )(\w+)s\b"), r"\1"),
    (re.compile(r"\b(?:has|have)\b"), "have"),
    (re.compile(r"\b(?:is|are)\b"), "are"),
    (re.compile(r"(#[^;()]*)(?:; \1)+"), r"\1"),
)


@dataclass(frozen=True)
class Remark:
    """One warning or note, and the clusters that have it.

    Attributes
    ----------
    text : str
        As the first of the clusters has it.
    names : tuple of str
        The clusters.
    total : int
        Number of clusters that were compared.
    same : bool
        Whether the text is the same, numbers included, for all of `names`.
    """

    text: str
    names: tuple[str, ...]
    total: int
    same: bool = True

    def __str__(self) -> str:
        if self.total == 1:
            return self.text
        where = f"cluster {self.names[0]}" if len(self.names) == 1 else self._count()
        return f"{where}: {self.text}"

    def _count(self) -> str:
        """Return in how many of the clusters, and in which."""
        count = len(self.names)
        if count == self.total:
            where = f"in all {count} clusters"
        else:
            where = f"in {count} of {self.total} clusters ({listed(self.names)})"
        return where if self.same else f"{where}, for example cluster {self.names[0]}"


def grouped(texts: Mapping[str, Sequence[str]]) -> list[Remark]:
    """Return the texts of clusters as remarks; texts that differ in numbers only are one.

    Parameters
    ----------
    texts : mapping of str to sequence of str
        The warnings (or notes) of every cluster by its name; of clusters without any an empty
        sequence, so that they are counted.

    Returns
    -------
    list of Remark
        In the order in which they first occur. Numbers, lists of numbers and the names of the
        clusters do not distinguish texts. Two texts of one cluster are never joined.

    Examples
    --------
    >>> (one,) = grouped({"a": ["12 rows are missing"], "b": ["1 row is missing"], "c": []})
    >>> one.names, one.same
    (('a', 'b'), False)
    """
    found: dict[tuple[str, int], list[tuple[str, str]]] = {}
    for name, own in texts.items():
        kinds: list[str] = []
        for text in own:
            kind = _kind(text.replace(f"cluster {name}", "cluster #"))
            found.setdefault((kind, kinds.count(kind)), []).append((name, text))
            kinds.append(kind)
    return [
        Remark(
            text=pairs[0][1],
            names=tuple(name for name, _ in pairs),
            total=len(texts),
            same=len({text for _, text in pairs}) == 1,
        )
        for pairs in found.values()
    ]


def merged(texts: Mapping[str, Sequence[str]]) -> list[str]:
    """Return the texts of clusters as lines, one line for those that differ in numbers only.

    Parameters
    ----------
    texts : mapping of str to sequence of str
        As in `grouped`.

    Returns
    -------
    list of str

    Examples
    --------
    >>> for line in merged({"0": ["2 rows are missing"], "1": ["3 rows are missing"], "2": []}):
    ...     print(line)
    in 2 of 3 clusters (0, 1), for example cluster 0: 2 rows are missing
    """
    return [str(remark) for remark in grouped(texts)]


def condensed(texts: Iterable[str]) -> list[str]:
    """Return texts about a whole table, one line for those that differ in numbers only.

    Parameters
    ----------
    texts : iterable of str

    Returns
    -------
    list of str
        The first text of each kind, with the number of the others.

    Examples
    --------
    >>> condensed([f"cluster {k} was left out: 2 frames" for k in range(5)])
    ['cluster 0 was left out: 2 frames (and 4 more of this kind)']
    """
    kinds: dict[str, list[str]] = {}
    for text in texts:
        kinds.setdefault(_kind(text), []).append(text)
    return [
        first + (f" (and {len(more)} more of this kind)" if more else "")
        for first, *more in kinds.values()
    ]


def _kind(text: str) -> str:
    """Return a text without its numbers, as far as they show in its words."""
    kind = _NUMBER.sub("#", text)
    for pattern, common in _AROUND:
        kind = pattern.sub(common, kind)
    return kind
