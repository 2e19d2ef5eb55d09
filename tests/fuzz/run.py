"""Fuzz all readers: ``python tests/fuzz/run.py --seconds 3600 --jobs 2``; status 1 for any fault.

Every fault is written to ``tests/fuzz/seeds`` as a file that the suite reads from then on.
"""

from __future__ import annotations

import argparse
import collections
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

from corpus import CORPORA, as_json, whole, write_corpus
from damage import case

_SILENT = 180.0  # s without a line, after which a reader counts as hanging


def batch(place, names, first, *, seconds=1e9, most=10**9, guard):
    """Read damaged files in another process; return the complaints, the last file, and the end."""
    arguments = [place, ",".join(names), first, seconds, most]
    complaints, last, done, end = [], None, 0, "the reader did not start"
    with subprocess.Popen(
        [sys.executable, HERE / "reading.py", *map(str, arguments)],
        stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
        env=os.environ | {"PERRIN_GUARD": guard},
    ) as process:  # fmt: skip
        watch = threading.Timer(_SILENT, process.kill)
        watch.start()
        for line in process.stdout:
            watch.cancel()
            said = json.loads(line)
            if "reading" in said:
                last, done = said["reading"], done + 1
            elif "complaint" in said:
                complaints.append(said["complaint"])
            else:
                end = ""
            watch = threading.Timer(_SILENT, process.kill)
            watch.start()
        watch.cancel()
        status = process.wait()
    if end and last is not None:
        end = "hangs" if status in (-9, -14) else f"ends the process ({status})"
    return complaints, last, done, end


def fuzz(place, names, first, seconds):
    """Read damaged files until the time is over; return faults, the number of files, and of ends.

    A file that ends the process, or hangs, is read once more as users read it: apart.
    """
    faults, total, ends, stop = [], 0, 0, time.monotonic() + seconds
    while (left := stop - time.monotonic()) > 1:
        complaints, last, done, end = batch(place, names, first, seconds=left, guard="off")
        faults += complaints
        total += done
        if not end:
            break
        if last is None:
            raise RuntimeError(end)
        ends += 1
        first = last[1] + 1
        complaints, _, _, again = batch(place, names, last[1], most=1, guard="on")
        faults += complaints + ([[*last, again]] if again else [])
    return faults, total, ends


def kind_of(complaint):
    """Return what complaints of one kind have in common: the error and the last place in perrin."""
    lines = complaint.splitlines()
    places = [line.strip() for line in lines if "/perrin/" in line and "File" in line]
    return lines[0].split(":")[0][:60], places[-1] if places else ""


def main():
    """Fuzz, print a summary, and keep a seed of every kind of fault."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=3600)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--first", type=int, default=0, help="number of the first damage")
    parser.add_argument("--kinds", default=",".join(CORPORA))
    parser.add_argument("--names", default="", help="only files whose names hold this")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="perrin-fuzz-") as folder:
        place = Path(folder)
        made = write_corpus(place, options.kinds.split(","))
        names = [name for name in made if options.names in name]
        contents = {name: whole(place / name) for name in names}
        results = []

        def work(job):
            first = options.first + job * 10**7
            results.append(fuzz(place, names, first, options.seconds))

        threads = [threading.Thread(target=work, args=(k,)) for k in range(options.jobs)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    if len(results) < options.jobs:
        raise SystemExit("a job has failed")
    faults = [fault for found, _, _ in results for fault in found]
    kinds = collections.defaultdict(list)
    for name, number, complaint in faults:
        kinds[name, *kind_of(complaint)].append((number, complaint))
    for (name, *_), cases in kinds.items():
        number, complaint = cases[0]
        text = as_json(case(contents[name], number))
        if len(text) < 20000:
            digest = hashlib.blake2b(text.encode(), digest_size=4).hexdigest()
            (HERE / "seeds" / f"{digest}-{name}.json").write_text(text + "\n")
        print(f"{len(cases)} x {name}, damage {number}: {complaint}\n", flush=True)
    total, ends = (sum(result[k] for result in results) for k in (1, 2))
    print(
        f"{total} damaged files of {len(names)} whole ones: {len(faults)} faults of {len(kinds)} "
        f"kinds; {ends} ended or held up their reader, which costs a frame at most"
    )
    raise SystemExit(bool(faults))


if __name__ == "__main__":
    main()
