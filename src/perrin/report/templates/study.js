// The script of the page of a study: its three figures and the filter of the movies.
(() => {
  "use strict";
  const find = (selector) => document.querySelector(selector);
  document.documentElement.classList.add("scripted");
  const inflate = async (text) => {
    const bytes = Uint8Array.from(atob(text.trim()), (c) => c.charCodeAt(0));
    return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
  };
  const unpack = async (text) => {
    const buffer = await inflate(text), length = new DataView(buffer).getUint32(0, true);
    const entry = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
    entry.column = {};
    let at = 4 + length;
    for (const [name, count] of entry.columns) {  // all of them 32-bit floats
      entry.column[name] = Array.from(new Float32Array(buffer.slice(at, at + 4 * count)));
      at += 4 * count;
    }
    return entry;
  };
  const color = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
  const HUES = ["blue", "red", "green"];
  const TITLES = { D_R: "D<sub>R</sub>", D_T: "D<sub>T</sub>", "D_T/D_R": "D<sub>T</sub>/D<sub>R</sub>" };
  // Labels are text of users: plotly would read tags in them.
  const literal = (text) => String(text).replace(/&/g, "&amp;").replace(/</g, "&lt;");
  let data = null, library = null;
  const chosen = () => Number(find("#body")?.value ?? 0);
  const draw = async () => {
    const logarithmic = find("#logarithmic").checked, singles = find("#singles").checked;
    const mine = data.panels.filter((panel) => panel.body === data.bodies[chosen()]);
    for (const [k, panel] of mine.entries()) {
      const hue = color(HUES[k]), traces = [], x = data.column[`${panel.key}-x`], y = data.column[`${panel.key}-y`], apart = data.column[`${panel.key}-apart`];
      for (const [name, flag, symbol] of [["clusters", 0, "circle"], ["not averaged", 1, "x-thin-open"]]) {
        const some = x.map((_, i) => i).filter((i) => apart[i] === flag);
        if (singles && some.length) traces.push({ x: some.map((i) => x[i]), y: some.map((i) => y[i]), text: some.map((i) => literal(panel.names[i])), mode: "markers", name,
          marker: { symbol, size: 6, color: hue, opacity: 0.3, line: { color: hue, width: 1.5 } }, hovertemplate: "%{text}<br>%{y:.4g}<extra></extra>" });
      }
      if (panel.line) traces.push({ x: panel.line.x, y: panel.line.y, mode: "lines", name: panel.line.name, line: { color: hue, width: 1.5 }, hoverinfo: "skip" });
      traces.push({ x: panel.x, y: panel.value, text: panel.labels.map(literal), mode: "markers", name: "mean, 95 %", marker: { size: 10, color: color("ink") },
        error_y: { type: "data", symmetric: false, array: panel.high.map((v, i) => (v === null ? 0 : v - panel.value[i])), arrayminus: panel.low.map((v, i) => (v === null ? 0 : panel.value[i] - v)), color: color("ink"), thickness: 1.8 },
        hovertemplate: "%{text}<br>%{y:.4g}<extra></extra>" });
      if (panel.predicted.some((v) => v !== null)) traces.push({ x: panel.x, y: panel.predicted, mode: "markers", name: "predicted", marker: { symbol: "diamond-open", size: 11, color: color("ink") }, hovertemplate: "predicted %{y:.4g}<extra></extra>" });
      // Intervals of one degree of freedom may span decades: the axis cuts those of more than a factor of ten.
      const ends = panel.value.flatMap((v, i) => [panel.low[i], panel.high[i]].filter((end) => end > v / 10 && end < v * 10));
      const shown = [...(singles ? y : []), ...panel.value, ...panel.predicted, ...ends].filter((v) => v > 0);
      const low = Math.min(...shown), high = Math.max(...shown);
      // Plotly labels a logarithmic axis between its powers of ten by single digits.
      const decades = Math.log10(high / low), digits = decades < 0.6 ? [1, 1.5, 2, 3, 4, 5, 6, 8] : decades < 1.2 ? [1, 2, 3, 5] : decades < 4 ? [1, 2, 5] : [1];
      const first = Math.floor(Math.log10(low)) - 1, powers = Array.from({ length: Math.ceil(decades) + 4 }, (_, i) => first + i);
      const tickvals = powers.flatMap((power) => digits.map((digit) => Number(`${digit}e${power}`)));
      const values = logarithmic ? { tickvals, ticktext: tickvals.map(String) } : {};
      const range = logarithmic ? [Math.log10(low / 1.5), Math.log10(high * 1.5)] : [0, high * 1.15];
      const axis = (title, more) => ({ title: { text: title, standoff: 6 }, color: color("ink"), gridcolor: color("line"), zerolinecolor: color("line"), linecolor: color("soft"), automargin: true, exponentformat: "power", ...more });
      const ticks = data.labels.length ? { tickvals: data.labels.map((_, i) => i), ticktext: data.labels.map((t) => literal(t.length > 18 ? `${t.slice(0, 17)}…` : t)), range: [-0.5, data.labels.length - 0.5] } : {};
      await window.Plotly.react(find(`#plot-${k}`), traces, {
        paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", font: { family: "system-ui, sans-serif", size: 13, color: color("ink") }, margin: { l: 60, r: 8, t: 8, b: 44 },
        legend: { orientation: "h", x: 0, y: 1.02, yanchor: "bottom", font: { size: 11 } }, hoverlabel: { bgcolor: color("raised"), font: { color: color("ink") } },
        xaxis: axis(literal(data.axis), ticks), yaxis: axis(`${TITLES[panel.quantity]} (${panel.unit})`, { type: logarithmic ? "log" : "linear", range, nticks: 6, ...values }),
      }, { displaylogo: false, responsive: true, displayModeBar: matchMedia("(hover: hover)").matches ? "hover" : false, modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"], toImageButtonOptions: { format: "svg", filename: "perrin-study" } });
    }
    const thinned = mine.filter((panel) => panel.every > 1);
    find("#state").textContent = thinned.length ? `One of ${thinned[0].every} single clusters is drawn.` : "";
    document.documentElement.dataset.drawn = "yes";
  };
  const start = async () => {
    if (!find("#plot-0")) return;
    const state = find("#state");
    state.textContent = "Drawing …";
    try {
      data = await unpack(find("#data").textContent);
      if (!library) {
        library = document.createElement("script");
        library.textContent = new TextDecoder().decode(await inflate(find("#plotly").textContent));
        document.head.append(library);
      }
      await draw();
      for (const id of ["body", "singles", "logarithmic"]) find(`#${id}`)?.addEventListener("change", draw);
      matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
    } catch (error) {
      state.textContent = `The figures could not be drawn: ${error.message}. A browser of 2023 or newer is needed.`;
      document.documentElement.classList.remove("scripted");
      throw error;
    }
  };
  const filter = find("#filter"), rows = [...document.querySelectorAll("#movies tbody tr")];
  filter?.addEventListener("input", () => {
    const words = filter.value.toLowerCase().split(/\s+/).filter(Boolean);
    let count = 0;
    for (const row of rows) {
      const text = row.textContent.toLowerCase();
      row.hidden = !words.every((word) => text.includes(word));
      count += !row.hidden;
    }
    find("#shown").textContent = words.length ? `${count} of ${rows.length} movies` : "";
  });
  start();
})();
