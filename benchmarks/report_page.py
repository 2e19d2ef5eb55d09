"""Time that a browser spends on the report page of many clusters (docs/validation.md).

    python benchmarks/report_page.py [--clusters 1000]

needs Chromium and perrin[cluster] (for tornado, the client of the browser's debugging port). Times
are those of the page's own thread, by the browser's counters, so that other programs hardly change
them: the medians of some repeats.
"""

import argparse
import asyncio
import json
import shutil
import statistics
import subprocess
import tempfile
import time
import urllib.request
from pathlib import Path

import pandas as pd
from tornado.websocket import websocket_connect

import perrin
from perrin.report.page import render_html

FLAGS = [
    "--headless", "--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader", "--use-gl=angle",
    "--use-angle=swiftshader", "--disable-background-networking", "--no-first-run",
    "--window-size=1280,900", "--remote-debugging-port=0", "--remote-allow-origins=*",
]  # fmt: skip
READY = "document.documentElement?.dataset?.ready === 'yes'"
PAINTED = "await new Promise((done) => requestAnimationFrame(() => setTimeout(done, 0)));"


def page_of(clusters):
    """Return the page of tetrahedra in 205 frames."""
    body, tables = perrin.Cluster.touching(4, 2.45), []
    for k in range(clusters):
        truth = perrin.simulate_motion(body, D_R=5e-3, D_T=0.04, dt=0.7, n_frames=205, rng=[1, k])
        x = perrin.add_noise(truth.positions(), sigma=0.03, rng=[2, k])
        one = perrin.positions_table(x).assign(cluster=k)
        tables.append(one.assign(particle=one["particle"] + 4 * k))
    return render_html(perrin.analyze(pd.concat(tables, ignore_index=True), dt=0.7), [])


class Page:
    """A page in a browser, through its debugging port."""

    def __init__(self, socket):
        self.socket, self.number = socket, 0

    async def call(self, method, **params):
        """Send a command and return its result."""
        self.number += 1
        await self.socket.write_message(
            json.dumps({"id": self.number, "method": method, "params": params})
        )
        while True:
            answer = json.loads(await self.socket.read_message())
            if answer.get("id") == self.number:
                return answer["result"]

    async def run(self, code):
        """Run lines of JavaScript and return their value."""
        settings = {"awaitPromise": True, "returnByValue": True}
        answer = await self.call(
            "Runtime.evaluate", expression=f"(async () => {{{code}}})()", **settings
        )
        return answer["result"].get("value")

    async def until(self, condition):
        """Wait until a condition holds, and ask rarely."""
        while not await self.run(f"return {condition}"):
            await asyncio.sleep(0.3)

    async def seconds(self, code, condition="true"):
        """Return the time of the page's thread that some lines take."""
        busy = [await self.busy()]
        await self.run(code)
        await self.until(condition)
        busy.append(await self.busy())
        return busy[1] - busy[0]

    async def busy(self):
        """Return the time of the page's thread until now."""
        metrics = (await self.call("Performance.getMetrics"))["metrics"]
        return next(one["value"] for one in metrics if one["name"] == "TaskDuration")


async def measure(address, port):
    """Print a line for what a reader does."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as answer:
        tab = next(one for one in json.load(answer) if one["type"] == "page")
    page = Page(await websocket_connect(tab["webSocketDebuggerUrl"]))
    await page.call("Performance.enable", timeDomain="threadTicks")
    await page.call("Page.navigate", url=address)
    await page.until(READY)
    sort = "document.querySelectorAll('#clusters thead button')[1].click();" + PAINTED
    drawn = "document.documentElement.dataset.drawn === '{}'"
    times = {
        "sort by a column": [],
        "redraw the intervals of all": [],
        "another cluster": [],
        "figures below the window": [],
        "scroll the table": [],
    }
    for k in range(5):
        times["sort by a column"].append(await page.seconds(sort))
        times["redraw the intervals of all"].append(
            await page.seconds("await new Promise((done) => setTimeout(done, 1500));")
        )
        times["another cluster"].append(
            await page.seconds(f"location.hash = '#cluster-{k + 10}';", drawn.format(k + 10))
        )
        times["figures below the window"].append(
            await page.seconds(
                "document.querySelector('#plot-residual').scrollIntoView({behavior: 'instant'});"
                "await new Promise((done) => setTimeout(done, 1500));"
            )
        )
        scroll = f"document.querySelector('.table-window').scrollTop = {4000 * k + 2000};" + PAINTED
        times["scroll the table"].append(await page.seconds(scroll))
    for name, values in times.items():
        print(f"{name}: {statistics.median(values):.3f} s")
    page.socket.close()


def main():
    """Make the page, open it and measure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--clusters", type=int, default=1000)
    parser.add_argument("--page", type=Path, help="a report page that exists")
    options = parser.parse_args()
    program = shutil.which("chromium") or shutil.which("chromium-browser")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name:
        folder = Path(name)
        page = options.page or folder / "report.html"
        if options.page is None:
            page.write_text(page_of(options.clusters), encoding="utf-8")
        print(f"report.html: {page.stat().st_size / 1e6:.1f} MB")
        profile = folder / "profile"
        with subprocess.Popen(
            [program, *FLAGS, f"--user-data-dir={profile}", "about:blank"],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        ) as browser:  # fmt: skip
            port_file = profile / "DevToolsActivePort"
            while not (port_file.exists() and port_file.read_text().strip()):
                time.sleep(0.1)
            try:
                asyncio.run(measure(page.resolve().as_uri(), port_file.read_text().split()[0]))
            finally:
                browser.terminate()


if __name__ == "__main__":
    main()
