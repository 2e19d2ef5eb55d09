"""The report page in a browser: figures, table, choice of a cluster, and no error."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import shutil
import subprocess
from dataclasses import replace

import pytest

from perrin.report.page import render_html
from test_plot import measured

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")

OPTIONS = [
    "--headless", "--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader", "--use-gl=angle",
    "--use-angle=swiftshader", "--disable-background-networking", "--no-first-run",
    "--window-size=800,600", "--virtual-time-budget=30000", "--dump-dom",
]  # fmt: skip

# What a reader does: waits, sorts, filters, goes to the next cluster, and plays.
READER = """
window.faults = [];
addEventListener("error", (e) => faults.push(e.message));
addEventListener("unhandledrejection", (e) => faults.push(String(e.reason)));
addEventListener("securitypolicyviolation", (e) => faults.push(e.violatedDirective));
addEventListener("load", async () => {
  const find = (s) => document.querySelector(s), all = (s) => [...document.querySelectorAll(s)];
  const until = async (done) => {
    for (let k = 0; k < 300 && !done(); k += 1) await new Promise((r) => setTimeout(r, 100));
  };
  const page = document.documentElement;
  await until(() => page.dataset.ready);
  const found = { ready: page.dataset.ready, drawn: page.dataset.drawn };
  found.canvases = all("#plot-body canvas").length;
  found.plots = all("#plots .main-svg, #forest .main-svg").length;
  const shown = () => all("#clusters tbody tr").filter((r) => !r.hidden);
  const rows = () => shown().map((r) => r.dataset.cluster);
  const sorted = all("#clusters thead button")[1];
  sorted.click();
  found.up = rows();
  sorted.click();
  found.down = rows();
  find("#filter").value = "<scr";
  find("#filter").dispatchEvent(new Event("input"));
  found.filtered = rows();
  find("#filter").value = "";
  find("#filter").dispatchEvent(new Event("input"));
  location.hash = "#cluster-1";
  await until(() => page.dataset.drawn === "1");
  found.name = find("#one-name").textContent;
  found.chosen = find("#clusters tr.chosen").dataset.cluster;
  document.body.dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowRight", bubbles: true }));
  await until(() => page.dataset.drawn !== "1");
  found.next = page.dataset.drawn;
  find("#time").value = 5;
  find("#time").dispatchEvent(new Event("input"));
  await until(() => find("#time-text").textContent !== "0.000 s");
  found.time = find("#time-text").textContent;
  found.faults = faults;
  const out = document.createElement("pre");
  out.id = "found";
  out.textContent = JSON.stringify(found);
  document.body.append(out);
});
"""


@pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium")
def test_a_reader_sorts_filters_chooses_and_turns(tmp_path):
    """From a file, with the page's own policy: figures are drawn and nothing is an error."""
    report = measured(clusters=3, frames=20, labels=["a", "<script>alert(1)</script>", "c"])
    policy = base64.b64encode(hashlib.sha256(READER.encode()).digest()).decode()
    html = render_html(report, []).replace("script-src ", f"script-src 'sha256-{policy}' ", 1)
    html = html.replace("<body>", f"<body><script>{READER}</script>", 1)
    page = tmp_path / "report.html"
    page.write_text(html, encoding="utf-8")
    done = subprocess.run(
        [CHROMIUM, *OPTIONS, f"--user-data-dir={tmp_path / 'profile'}", page.as_uri()],
        capture_output=True, text=True, timeout=170, check=True,
    )  # fmt: skip
    text = re.search(r'<pre id="found">(.*?)</pre>', done.stdout)[1]
    found = json.loads(text.replace("&lt;", "<").replace("&gt;", ">").replace("&amp;", "&"))
    assert found["faults"] == []
    assert found["ready"] == "yes"
    assert found["canvases"] > 0
    assert found["plots"] >= 9
    by_value = sorted(report.clusters, key=lambda c: c.D_R.value)
    assert found["up"] == [str(c.cluster) for c in by_value]
    assert found["down"] == found["up"][::-1]
    named = next(c for c in report.clusters if c.name.startswith("<script"))
    assert found["filtered"] == [str(named.cluster)]
    one = next(c for c in report.clusters if c.cluster == 1)
    assert (found["name"], found["chosen"]) == (f"Cluster {one.name}", "1")
    # The next in the order of the table.
    after = found["down"][(found["down"].index("1") + 1) % 3]
    assert found["next"] == after
    assert found["time"] == "2.500 s"


def test_a_page_without_scripting_shows_the_first_cluster():
    """Numbers and a picture of the body are in the page itself, not in its data."""
    report = measured(frames=20)
    html = render_html(replace(report, warnings=("<b>",)), [])
    before = html[: html.index("<script>")]
    assert '<svg class="still"' in before
    assert before.count("<circle") == len(report.clusters[0].motion.template)
    assert "&lt;b&gt;" in before
