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
    "--window-size=800,600", "--virtual-time-budget=600000", "--dump-dom",
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
    // Time is virtual and jumps, but decompression takes real time: each turn computes for a while.
    for (let k = 0; k < 3000 && !done(); k += 1) {
      for (let i = 0; i < 3e6; i += 1) Math.sqrt(i);
      await new Promise((r) => setTimeout(r, 10));
    }
  };
  const page = document.documentElement;
  await until(() => page.dataset.ready);
  const found = { ready: page.dataset.ready, drawn: page.dataset.drawn };
  found.early = all("#plots .stale").length;
  for (const area of all("#plots .area")) {
    area.scrollIntoView();
    await until(() => !area.classList.contains("stale"));
  }
  found.canvases = all("#plot-body canvas").length;
  scrollTo(0, 0);
  found.plots = all("#plots .main-svg, #forest .main-svg").length;
  const rows = () => all("#clusters tbody tr").map((r) => r.dataset.cluster);
  const sorted = all("#clusters thead button")[1];
  const scroller = find(".table-window");
  sorted.click();
  sorted.click();
  found.many = rows();
  found.height = scroller.scrollHeight / find("#clusters tbody tr").offsetHeight;
  scroller.scrollTop = scroller.scrollHeight;
  await until(() => Number(rows().at(-1)) < 100);
  found.last = rows().slice(-3);
  find("#filter").value = " nm";
  find("#filter").dispatchEvent(new Event("input"));
  sorted.click();
  found.up = rows();
  sorted.click();
  found.down = rows();
  find("#filter").value = "<scr";
  find("#filter").dispatchEvent(new Event("input"));
  found.filtered = rows();
  find("#filter").value = " nm";
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
    cells = '<td data-v="{}"></td>' + "<td></td>" * 8
    others = (f'<tr data-cluster="{k}"><th></th>' + cells.format(k) for k in range(100, 400))
    html = html.replace("</tbody>\n<tfoot>", "".join(others) + "</tbody>\n<tfoot>", 1)
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
    assert found["early"] > 0  # figures far below the window are drawn when the reader comes near
    by_value = sorted(report.clusters, key=lambda c: c.D_R.value)
    # Of 303 rows those near the visible part are in the page, and the scroll bar counts all.
    assert found["many"] == [str(k) for k in range(399, 299, -1)]
    assert found["height"] == pytest.approx(303, rel=0.1)
    assert found["last"] == [str(c.cluster) for c in by_value[::-1]]
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
