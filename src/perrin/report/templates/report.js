// The page's own script: the table of clusters, one cluster at a time, and its figures.
(() => {
  "use strict";
  const find = (selector, within = document) => within.querySelector(selector);
  const all = (selector, within = document) => [...within.querySelectorAll(selector)];
  document.documentElement.classList.add("scripted");

  // ---- data in the page ------------------------------------------------------------------
  const inflate = async (text) => {
    const bytes = Uint8Array.from(atob(text.trim()), (c) => c.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    return new Response(stream).arrayBuffer();
  };
  const MISSING = 65535;
  const unpack = async (text) => {
    const buffer = await inflate(text);
    const length = new DataView(buffer).getUint32(0, true);
    const entry = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
    entry.column = {};
    let at = 4 + length;
    for (const [name, count, ends] of entry.columns) {
      const size = (ends ? 2 : 4) * count;
      const raw = buffer.slice(at, at + size);
      at += size;
      if (!ends) { entry.column[name] = Array.from(new Float32Array(raw)); continue; }
      const step = (ends[1] - ends[0]) / (MISSING - 1);
      entry.column[name] = Array.from(new Uint16Array(raw), (k) => (k === MISSING ? NaN : ends[0] + k * step));
    }
    return entry;
  };
  const payloads = new Map(all("script.payload").map((s) => [s.dataset.cluster, s]));
  const order = [...payloads.keys()];
  const read = new Map();
  const dataOf = (key) => {
    if (!read.has(key)) {
      if (read.size > 20) read.clear();
      read.set(key, unpack(payloads.get(key).textContent));
    }
    return read.get(key);
  };
  let library = null;
  const plotly = () => {
    library ??= inflate(find("#plotly").textContent).then((buffer) => {
      const script = document.createElement("script");
      script.textContent = new TextDecoder().decode(buffer);
      document.head.append(script);
      return window.Plotly;
    });
    return library;
  };

  // ---- appearance ------------------------------------------------------------------------
  const color = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
  const faint = (name, share) => {
    const hex = color(name);
    const part = (k) => parseInt(hex.length === 4 ? hex[k + 1] + hex[k + 1] : hex.slice(2 * k + 1, 2 * k + 3), 16);
    return `rgba(${part(0)},${part(1)},${part(2)},${share})`;
  };
  const narrow = () => window.innerWidth < 640;
  const SETTINGS = { displaylogo: false, responsive: true, displayModeBar: matchMedia("(hover: hover)").matches ? "hover" : false,
    modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"], toImageButtonOptions: { format: "svg", filename: "perrin" } };
  // Labels are text of users: plotly would read tags in them.
  const literal = (text) => text.replace(/&/g, "&amp;").replace(/</g, "&lt;");
  const layout = (x, y, more = {}) => {
    const axis = (title, given = {}) => ({ title: { text: title, standoff: 6 }, color: color("ink"), gridcolor: color("line"),
      zerolinecolor: color("line"), linecolor: color("soft"), ticklabeloverflow: "allow", exponentformat: "power", ...given });
    return { paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", font: { family: "system-ui, sans-serif", size: 13, color: color("ink") },
      margin: { l: 68, r: 12, t: 8, b: 46 }, legend: { orientation: "h", x: 0, y: 1.02, yanchor: "bottom", font: { size: narrow() ? 11 : 12 } },
      hoverlabel: { bgcolor: color("raised"), font: { color: color("ink") } },
      modebar: { bgcolor: "rgba(0,0,0,0)", color: color("soft"), activecolor: color("ink") },
      ...more, xaxis: axis(x, more.xaxis), yaxis: axis(y, more.yaxis) };
  };
  const draw = async (id, traces, shape, settings = {}) => {
    const Plotly = await plotly();
    await Plotly.react(find(`#${id}`), traces, shape, { ...SETTINGS, ...settings });
  };

  // ---- curves ----------------------------------------------------------------------------
  const CURVES = { msad: { name: "MSAD", symbol: "D<sub>R</sub>" }, msd: { name: "MSD", symbol: "D<sub>T</sub>" } };
  const scale = { msad: "log", msd: "log" };
  const drawCurve = (kind, data) => {
    const line = data.lines[kind], place = `plot-${kind}`;
    const known = data.column[`${kind}_y`].map((v, k) => k).filter((k) => !Number.isNaN(data.column[`${kind}_y`][k]));
    const power = (name) => known.map((k) => 10 ** data.column[`${kind}_${name}`][k]);
    const t = power("t"), y = power("y"), e = known.map((k, i) => data.column[`${kind}_e`][k] * y[i]);
    const slope = 2 * line.dof, ratio = scale[kind] === "ratio" && line.D > 0;
    const pure = (x) => slope * line.D * x;
    const show = (value, k) => (ratio ? value / pure(t[k]) : value);
    const low = y.map((v, k) => show(Math.max(v - e[k], 0.01 * v), k)), high = y.map((v, k) => show(v + e[k], k));
    const { name, symbol } = CURVES[kind];
    const axes = scale[kind] === "linear" ? "linear" : "log";
    const traces = [
      { x: [...t, ...[...t].reverse()], y: [...high, ...low.reverse()], fill: "toself", mode: "lines", line: { width: 0 },
        fillcolor: faint("soft", 0.22), hoverinfo: "skip", name: "± 1 standard error" },
      { x: t, y: y.map(show), mode: "markers", name, marker: { size: 6, color: t.map((x) => (x > line.span / 4 ? faint("ink", 0.3) : color("ink"))) },
        customdata: e.map((v) => v), hovertemplate: `t = %{x:.4g} s<br>%{y:.4g}${ratio ? "" : " " + line.unit}<extra></extra>` },
    ];
    if (line.D !== undefined) {
      const first = t[0], last = t[t.length - 1];
      const grid = Array.from({ length: 121 }, (_, k) => first * (last / first) ** (k / 120));
      const model = grid.map((x) => slope * (line.D * x + line.offset)).map((v, k) => (ratio ? v / pure(grid[k]) : v));
      traces.push({ x: grid, y: model.map((v) => (v > 0 ? v : NaN)), mode: "lines", line: { color: color("blue"), width: 2 }, name: line.text, hoverinfo: "skip" });
      if (line.D > 0) traces.push({ x: grid, y: grid.map((x) => (ratio ? 1 : pure(x))), mode: "lines", line: { color: color("blue"), width: 1.2, dash: "dot" },
        name: `${slope} ${symbol} t`, hoverinfo: "skip" });
      if (line.floor > 0) traces.push({ x: grid, y: grid.map((x) => (ratio ? line.floor / pure(x) : line.floor)), mode: "lines",
        line: { color: color("red"), width: 1.5, dash: "dash" }, name: "noise floor", hoverinfo: "skip" });
    }
    const shown = low.concat(high).concat(y.map(show)).filter((v) => v > 0);
    const points = y.map(show).filter((v) => v > 0);
    const range = axes === "log" ? [Math.log10(Math.min(...points, line.floor > 0 && !ratio ? line.floor : Infinity) / 1.6),
      Math.log10(Math.max(...points) * 1.8)] : [0, Math.max(...points) * 1.1];
    const title = ratio ? `${name}/(${slope} ${symbol} t)` : `${name} (${line.unit})`;
    const bounds = ratio ? { type: "linear", range: [0, Math.min(Math.max(...shown), 4) * 1.05] } : { type: axes, range };
    if (!ratio && axes === "log") bounds.dtick = narrow() ? undefined : 1;
    return draw(place, traces, layout("lag time (s)", title, { xaxis: { type: axes }, yaxis: bounds }));
  };
  const choices = () => {
    for (const tools of all("[data-curve]")) {
      const kind = tools.dataset.curve;
      for (const [value, text] of [["log", "logarithmic"], ["linear", "linear"], ["ratio", "ratio to diffusion"]]) {
        const button = document.createElement("button");
        button.type = "button";
        button.textContent = text;
        button.setAttribute("aria-pressed", String(scale[kind] === value));
        button.addEventListener("click", async () => {
          scale[kind] = value;
          for (const other of all("button", tools)) other.setAttribute("aria-pressed", String(other === button));
          drawCurve(kind, await dataOf(shown));
        });
        tools.append(button);
      }
    }
  };

  // ---- time series and steps ---------------------------------------------------------------
  const HUES = ["blue", "red", "green"];
  const drawSeries = (id, data, names, labels, unit) => {
    const present = names.filter((name) => data.column[name]);
    const from = names[0] === "center0" ? present.map((name) => data.column[name].find((v) => !Number.isNaN(v))) : present.map(() => 0);
    const traces = present.map((name, k) => ({ x: data.column.time, y: data.column[name].map((v) => v - from[k]), mode: "lines",
      line: { width: 1.4, color: color(HUES[k]), dash: ["solid", "dot", "dash"][k] }, name: labels[names.indexOf(name)],
      hovertemplate: `t = %{x:.4g} s<br>%{y:.4g}<extra>%{fullData.name}</extra>` }));
    return draw(id, traces, layout("time (s)", unit));
  };
  const drawSteps = (name, data) => {
    const about = data.steps[name], id = `plot-${name}-steps`;
    const counts = data.column[`${name}_steps`].map(Math.round), width = (2 * about.half) / counts.length, unit = 1 / (about.count * width);
    const p = counts.map((v) => v * unit), e = counts.map((v) => Math.sqrt(v) * unit), kept = counts.map((v, k) => k).filter((k) => counts[k] > 0);
    const x = counts.map((_, k) => -about.half + (k + 0.5) * width), fine = Array.from({ length: 161 }, (_, k) => about.half * (k / 80 - 1));
    const wide = about.variance.filter((v) => v > 0);
    const law = fine.map((v) => wide.reduce((sum, s) => sum + Math.exp((-v * v) / (2 * s)) / Math.sqrt(2 * Math.PI * s), 0) / about.variance.length);
    const least = unit / 4;
    const traces = [
      { x: fine, y: law.map((v) => (v > least / 10 ? v : NaN)), mode: "lines", line: { color: color("blue"), width: 2 }, name: "law of the fit", hoverinfo: "skip" },
      { x: kept.map((k) => x[k]), y: kept.map((k) => p[k]), mode: "markers", name: `${about.count} components`,
        error_y: { type: "data", symmetric: false, array: kept.map((k) => e[k]), arrayminus: kept.map((k) => Math.min(e[k], 0.9 * p[k])), color: faint("ink", 0.6), thickness: 1, width: 0 },
        marker: { color: color("ink"), size: 5 }, hovertemplate: "%{x:.3g}: %{y:.3g}<extra></extra>" },
    ];
    return draw(id, traces, layout(`step (${about.unit})`, `density (1/${about.unit})`, { yaxis: { type: "log", range: [Math.log10(least), Math.log10(Math.max(...p, ...law.filter((v) => v > 0)) * 2)], dtick: 1 } }));
  };
  const drawResidual = (data) => {
    const small = data.expected ? data.expected < 1 : Math.max(...data.column.residual.filter((v) => v > 0), 0) < 1;
    const factor = small ? 1000 : 1, unit = small ? "nm" : "µm", time = data.column.time;
    const traces = [{ x: time, y: data.column.residual.map((v) => v * factor), mode: "lines+markers", marker: { size: 3, color: color("blue") },
      line: { width: 0.8, color: color("blue") }, name: "residual", hovertemplate: "t = %{x:.4g} s<br>%{y:.3g}<extra></extra>" }];
    if (data.expected) traces.push({ x: [time[0], time[time.length - 1]], y: [data.expected * factor, data.expected * factor], mode: "lines",
      line: { color: color("red"), width: 1.6, dash: "dash" }, name: "expected from σ", hoverinfo: "skip" });
    return draw("plot-residual", traces, layout("time (s)", `residual (${unit})`, { yaxis: { rangemode: "tozero" } }));
  };

  // ---- the body in three dimensions -----------------------------------------------------------
  // An icosahedron whose edges are halved a number of times, on the unit sphere.
  const ball = (times) => {
    const g = (1 + Math.sqrt(5)) / 2, points = [];
    for (const a of [-1, 1]) for (const b of [-g, g]) points.push([0, a, b], [a, b, 0], [b, 0, a]);
    const gap = (i, j) => Math.hypot(...points[i].map((v, k) => v - points[j][k]));
    let faces = [];
    for (let i = 0; i < 12; i += 1) for (let j = i + 1; j < 12; j += 1) for (let k = j + 1; k < 12; k += 1) {
      if (Math.max(gap(i, j), gap(j, k), gap(i, k)) > 2.01) continue;
      const [u, v, w] = [points[i], points[j], points[k]];
      const volume = u[0] * (v[1] * w[2] - v[2] * w[1]) + u[1] * (v[2] * w[0] - v[0] * w[2]) + u[2] * (v[0] * w[1] - v[1] * w[0]);
      faces.push(volume > 0 ? [i, j, k] : [i, k, j]);
    }
    for (let n = 0; n < times; n += 1) {
      const middle = new Map();
      const half = (i, j) => {
        const key = i < j ? `${i},${j}` : `${j},${i}`;
        if (!middle.has(key)) { middle.set(key, points.length); points.push(points[i].map((v, k) => v + points[j][k])); }
        return middle.get(key);
      };
      faces = faces.flatMap(([i, j, k]) => { const [a, b, c] = [half(i, j), half(j, k), half(k, i)]; return [[i, a, c], [j, b, a], [k, c, b], [a, b, c]]; });
      for (const [i, p] of points.entries()) { const r = Math.hypot(...p); points[i] = p.map((v) => v / r); }
    }
    return { points, faces };
  };
  const BALLS = [ball(1), ball(2), ball(3)];
  const ballOf = (data) => BALLS[data.template.length <= 8 ? 2 : data.template.length <= 40 ? 1 : 0];
  const SHADES = ["#56b4e9", "#f0904f", "#35c79a", "#e5a5cc", "#f2c14e", "#9ed4f7", "#c4c4c4", "#a99ae0"];
  const SPACE = ["webgl2", "webgl"].some((kind) => document.createElement("canvas").getContext(kind));
  const body = { row: 0, timer: null, view: "centred", data: null };
  const turned = (q, v) => {
    const [w, x, y, z] = q;
    const c = [y * v[2] - z * v[1], z * v[0] - x * v[2], x * v[1] - y * v[0]].map((u) => 2 * u);
    return [v[0] + w * c[0] + y * c[2] - z * c[1], v[1] + w * c[1] + z * c[0] - x * c[2], v[2] + w * c[2] + x * c[1] - y * c[0]];
  };
  // The shortest rotation from x to a rod's direction.
  const along = (u) => {
    const q = [1 + u[0], 0, -u[2], u[1]], n = Math.hypot(...q);
    return n > 1e-6 ? q.map((v) => v / n) : [0, 0, 1, 0];
  };
  const poseAt = (data, row) => {
    const column = (name) => (data.column[name] ? data.column[name][row] : 0);
    const q = data.rod ? along([0, 1, 2].map((k) => column(`u${k}`))) : [0, 1, 2, 3].map((k) => column(`q${k}`));
    const n = Math.hypot(...q);
    return { q: q.map((v) => v / n), center: [0, 1, 2].map((k) => column(`center${k}`)) };
  };
  const solid = (v) => [v[0], v[1], v[2] ?? 0];
  const bodyAt = (data, row) => {
    const pose = poseAt(data, row), inverse = [pose.q[0], -pose.q[1], -pose.q[2], -pose.q[3]];
    const shift = body.view === "lab" ? pose.center : [0, 0, 0];
    const move = (v) => (body.view === "body" ? v : turned(pose.q, v)).map((u, k) => u + shift[k]);
    const radius = data.diameter / 2, mesh = [[], [], []], { points } = ballOf(data);
    for (const center of data.template) {
      const c = move(solid(center));
      for (const p of points) for (let k = 0; k < 3; k += 1) mesh[k].push(c[k] + radius * p[k]);
    }
    const d = data.dimension, n = data.template.length, places = [[], [], []];
    if (data.column.places) for (let i = 0; i < n; i += 1) {
      const at = (row * n + i) * d;
      let v = [0, 1, 2].map((k) => (k < d ? data.column.places[at + k] : 0));
      if (body.view === "body") v = turned(inverse, v);
      for (let k = 0; k < 3; k += 1) places[k].push(v[k] + shift[k]);
    }
    const reach = body.reach, axes = (data.axes ?? []).map((axis, k) => {
      const half = (1.25 * reach * data.principal[k]) / Math.max(...data.principal);
      return [axis.map((u) => -half * u), axis.map((u) => half * u)].map(move);
    });
    return { mesh, places, axes };
  };
  const bodyTraces = (data, row) => {
    const { mesh, places, axes } = bodyAt(data, row), { points, faces: own } = ballOf(data), size = points.length;
    const faces = data.template.flatMap((_, k) => own.map((f) => f.map((v) => v + k * size)));
    const covered = find("#show-places").checked && data.column.places;
    const traces = [{ type: "mesh3d", x: mesh[0], y: mesh[1], z: mesh[2], i: faces.map((f) => f[0]), j: faces.map((f) => f[1]), k: faces.map((f) => f[2]),
      vertexcolor: data.template.flatMap((_, k) => points.map(() => SHADES[k % SHADES.length])), opacity: covered ? 0.4 : 1, flatshading: false,
      lighting: { ambient: 0.55, diffuse: 0.75, specular: 0.25, roughness: 0.4, fresnel: 0.1 }, lightposition: { x: 100, y: 200, z: 120 }, hoverinfo: "skip", showlegend: false, name: "spheres" }];
    traces.push({ type: "scatter3d", mode: "markers", x: places[0], y: places[1], z: places[2], marker: { size: 5, symbol: "diamond", color: color("ink") },
      name: "measured places", visible: Boolean(covered), hovertemplate: "%{x:.3f}, %{y:.3f}, %{z:.3f} µm<extra>measured</extra>" });
    [0, 1, 2].forEach((k) => {
      const ends = axes[k] ?? [[], []];
      traces.push({ type: "scatter3d", mode: "lines", x: ends.map((v) => v[0]), y: ends.map((v) => v[1]), z: ends.map((v) => v[2]), line: { width: 5, color: color(HUES[k]) },
        name: data.principal ? `axis ${k + 1}: ${data.principal[k].toPrecision(3)} rad²/s` : "", visible: Boolean(axes[k]) && find("#show-axes").checked, hoverinfo: "name" });
    });
    const path = body.view === "lab" ? [0, 1, 2].map((k) => (data.column[`center${k}`] ?? data.column.time.map(() => 0)).slice(0)) : [[], [], []];
    traces.push({ type: "scatter3d", mode: "lines", x: path[0], y: path[1], z: path[2], line: { width: 1.5, color: color("soft") }, name: "path of the centre",
      visible: body.view === "lab", hoverinfo: "skip" });
    return traces;
  };
  const bodyLayout = (data) => {
    let middle = [0, 0, 0], half = 1.3 * body.reach;
    if (body.view === "lab") {
      const ends = [0, 1, 2].map((k) => {
        const known = (data.column[`center${k}`] ?? [0]).filter((v) => !Number.isNaN(v));
        return [known.reduce((a, b) => Math.min(a, b)), known.reduce((a, b) => Math.max(a, b))];
      });
      middle = ends.map(([a, b]) => (a + b) / 2);
      half = Math.max(...ends.map(([a, b]) => (b - a) / 2)) + body.reach;
    }
    const axis = (k) => ({ range: [middle[k] - half, middle[k] + half], title: { text: `${"xyz"[k]} (µm)` }, color: color("ink"), gridcolor: color("line"), showbackground: false, zeroline: false, nticks: 5 });
    return { paper_bgcolor: "rgba(0,0,0,0)", font: { family: "system-ui, sans-serif", size: 12, color: color("ink") }, margin: { l: 0, r: 0, t: 0, b: 0 },
      legend: { x: 0, y: 1, bgcolor: "rgba(0,0,0,0)", visible: true }, uirevision: `${body.view}`,
      scene: { aspectmode: "cube", xaxis: axis(0), yaxis: axis(1), zaxis: axis(2), camera: data.dimension === 2 ? { eye: { x: 0, y: 0, z: 1.2 }, up: { x: 0, y: 1, z: 0 } }
        : { eye: { x: 1.1, y: -1.1, z: 0.6 } } } };
  };
  const drawBody = async () => {
    const data = body.data;
    body.reach = Math.max(...data.template.map((v) => Math.hypot(...v))) + data.diameter / 2;
    await draw("plot-body", bodyTraces(data, body.row), bodyLayout(data), { displayModeBar: false });
    showTime();
  };
  const showTime = () => {
    const t = body.data.column.time[body.row];
    find("#time").value = body.row;
    find("#time-text").textContent = Number.isNaN(body.data.column.residual[body.row]) ? `${t.toPrecision(4)} s: no pose` : `${t.toPrecision(4)} s`;
  };
  const moveBody = async () => {
    if (waiting.has("plot-body")) { showTime(); return; }
    const { mesh, places, axes } = bodyAt(body.data, body.row), Plotly = await plotly();
    const parts = [mesh, places, ...[0, 1, 2].map((k) => { const ends = axes[k] ?? [[], []]; return [0, 1, 2].map((c) => ends.map((v) => v[c])); })];
    await Plotly.restyle(find("#plot-body"), { x: parts.map((p) => p[0]), y: parts.map((p) => p[1]), z: parts.map((p) => p[2]) }, [0, 1, 2, 3, 4]);
    showTime();
  };
  const stop = () => {
    clearTimeout(body.timer);
    body.timer = null;
    find("#play").textContent = "play";
    find("#play").setAttribute("aria-pressed", "false");
  };
  const play = () => {
    const step = async () => {
      if (body.timer === null) return;
      const rows = body.data.column.time.length;
      body.row = (body.row + Math.max(1, Math.round(rows / 600))) % rows;
      await moveBody();
      if (body.timer !== null) body.timer = setTimeout(step, 40);
    };
    if (body.timer !== null) { stop(); return; }
    find("#play").textContent = "pause";
    find("#play").setAttribute("aria-pressed", "true");
    body.timer = setTimeout(step, 0);
  };

  // ---- rows of the table of clusters -----------------------------------------------------------
  // A browser lays out all rows that a page has: where there are many, only those near the visible part are in the table.
  const AT_ONCE = 100, BEFORE = 30;
  const list = { table: null, frame: null, rows: [], visible: [], rowOf: new Map(), height: 1, chosen: null };
  const place = (which) => {
    const count = list.visible.length, few = which === "all" || count <= AT_ONCE, rows = list.table.tBodies[0];
    const first = few ? 0 : Math.max(0, Math.min(Math.floor(list.frame.scrollTop / list.height) - BEFORE, count - AT_ONCE));
    const wanted = list.visible.slice(first, few ? count : first + AT_ONCE), kept = new Set(wanted);
    for (const row of [...rows.rows]) if (!kept.has(row)) row.remove();
    let next = rows.firstElementChild;
    for (const [k, row] of wanted.entries()) {  // rows that stay are not moved, so that they keep the focus
      if (row === next) next = next.nextElementSibling; else rows.insertBefore(row, next);
      row.setAttribute("aria-rowindex", first + k + 2);
    }
    list.table.style.marginTop = `${first * list.height}px`;
    list.table.style.marginBottom = `${(count - first - wanted.length) * list.height}px`;
  };
  // Columns keep their widths and rows their mean height, whatever rows are in the table.
  const measure = () => {
    const heads = all("thead th", list.table), rows = list.table.tBodies[0];
    for (const head of heads) head.style.minWidth = "";
    const widths = heads.map((head) => head.getBoundingClientRect().width);
    for (const [k, head] of heads.entries()) head.style.minWidth = `${widths[k]}px`;
    list.height = Math.max(1, rows.offsetHeight / Math.max(1, rows.rows.length));
  };
  const bringIntoView = (row) => {
    if (!row) return;
    const { frame } = list, at = list.visible.indexOf(row) * list.height;
    if (at < frame.scrollTop || at > frame.scrollTop + frame.clientHeight - 3 * list.height) frame.scrollTop = at - frame.clientHeight / 2;
  };

  // ---- one cluster ---------------------------------------------------------------------------
  let shown = order[0], turn = 0;
  // Figures are drawn when the window comes near them, and all of them for print; the old ones are hidden until then.
  const waiting = new Map();
  const drawWaiting = (id) => {
    const one = waiting.get(id);
    if (!one) return null;
    waiting.delete(id);
    near.unobserve(find(`#${id}`));
    find(`#${id}`).classList.remove("stale");
    return one();
  };
  const near = new IntersectionObserver((entries) => {
    for (const entry of entries) if (entry.isIntersecting) drawWaiting(entry.target.id);
  }, { rootMargin: "400px" });
  const drawAll = async () => {
    const key = shown, ticket = (turn += 1), state = find("#plots-state");
    try {
      const data = await dataOf(key);
      if (ticket !== turn) return;
      body.data = data;
      body.row = Math.max(0, data.column.residual.findIndex((v) => !Number.isNaN(v)));
      const slider = find("#time");
      slider.max = data.column.time.length - 1;
      find("#plots").hidden = false;
      find("#curves-caption").hidden = data.rod;
      find("#show-axes").closest("label").hidden = !data.axes;
      find("#show-places").closest("label").hidden = !data.column.places;
      const thinned = data.stride > 1 ? ` One of ${data.stride} frames is shown.` : "";
      find("#body-caption").textContent = `Spheres of ${data.diameter.toPrecision(3)} µm, to scale; diamonds: the places measured in this frame. `
        + `${data.axes ? "Lines: axes of the rotational diffusion tensor, as long as its values. " : ""}Drag to turn, scroll to zoom.${thinned}`;
      if (!library) state.textContent = "Drawing …";
      const axes = ["0", "1", "2"], any = (name) => axes.some((k) => data.column[name + k]);
      const figures = [["plot-body", SPACE, () => drawBody()],
        ["plot-msad", !data.rod && data.lines.msad, () => drawCurve("msad", data)], ["plot-msd", !data.rod && data.lines.msd, () => drawCurve("msd", data)],
        ["plot-turn", any("turn"), () => drawSeries("plot-turn", data, axes.map((k) => `turn${k}`), data.dimension === 2 ? ["φ"] : ["about x", "about y", "about z"], "rotation (rad)")],
        ["plot-center", any("center"), () => drawSeries("plot-center", data, axes.map((k) => `center${k}`), ["x", "y", "z"], "from the first frame (µm)")],
        ["plot-turn-steps", data.steps?.turn, () => drawSteps("turn", data)], ["plot-shift-steps", data.steps?.shift, () => drawSteps("shift", data)],
        ["plot-residual", true, () => drawResidual(data)]];
      if (SPACE) document.documentElement.classList.add("drawn");  // else the still picture is shown instead
      for (const [id, present] of figures) {
        find(`#${id}`).closest("figure").hidden = !present;
        near.unobserve(find(`#${id}`));
      }
      waiting.clear();
      for (const [id, present, one] of figures) if (present) {
        waiting.set(id, one);
        find(`#${id}`).classList.add("stale");
      }
      const seen = (id) => { const box = find(`#${id}`).getBoundingClientRect(); return box.top < window.innerHeight && box.bottom > 0; };
      for (const id of [...waiting.keys()].filter(seen)) {
        await new Promise((done) => setTimeout(done, 0));
        if (ticket !== turn) return;
        await drawWaiting(id);
      }
      for (const id of waiting.keys()) near.observe(find(`#${id}`));
      state.textContent = "";
      document.documentElement.dataset.drawn = key;
      const names = visibleOrder(), at = names.indexOf(key);
      for (const name of [names[at + 1], names[at - 1]]) if (payloads.has(name)) dataOf(name);  // the next ones, ahead
    } catch (error) {
      state.textContent = `The figures could not be drawn: ${error.message}. A browser of 2023 or newer is needed.`;
      throw error;
    }
  };
  const mark = () => {
    for (const [row, chosen] of [[list.chosen, false], [list.rowOf.get(shown), true]]) {
      if (!row) continue;
      row.classList.toggle("chosen", chosen);
      if (chosen) row.setAttribute("aria-current", "true"); else row.removeAttribute("aria-current");
    }
    list.chosen = list.rowOf.get(shown);
  };
  const show = async (key) => {
    if (!payloads.has(key)) return;
    stop();
    shown = key;
    mark();
    const data = await dataOf(key);
    if (shown !== key) return;
    find("#one-name").textContent = data.title;
    for (const part of all(".one-part")) part.innerHTML = data[part.dataset.part];
    find("[data-part=numbers]").id = `cluster-${key}`;
    offerTables(find("#one"));
    await drawAll();
  };
  const visibleOrder = () => (list.visible.length ? list.visible.map((row) => row.dataset.cluster) : order);
  const neighbour = (step) => {
    const rows = visibleOrder().filter((key) => payloads.has(key)), at = rows.indexOf(shown);
    const next = rows[(at + step + rows.length) % rows.length];
    if (next !== undefined && next !== shown) {
      history.replaceState(null, "", `#cluster-${next}`);
      show(next);
      bringIntoView(list.rowOf.get(next));
    }
  };
  const fromHash = () => {
    const asked = location.hash.match(/^#cluster-(-?\d+)$/);
    return asked && payloads.has(asked[1]) ? asked[1] : null;
  };

  // ---- tables --------------------------------------------------------------------------------
  const cellText = (cell) => cell.textContent.replace(/\s+/g, " ").trim();
  const csvOf = (rows) => rows.map((row) => all("th, td", row).map((cell) => {
    const text = cellText(cell).replace(/ [▲▼]$/, "");
    return /[",\n]/.test(text) ? `"${text.replace(/"/g, '""')}"` : text;
  }).join(",")).join("\r\n");
  const download = (name, text) => {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob(["\ufeff", text, "\r\n"], { type: "text/csv" }));
    link.download = name;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  };
  const offerTables = (within) => {
    for (const table of all("table[data-csv]", within)) {
      if (table.id === "clusters" || table.dataset.offered) continue;
      table.dataset.offered = "yes";
      const button = document.createElement("button");
      button.type = "button";
      button.className = "csv";
      button.textContent = "CSV";
      button.setAttribute("aria-label", `download the table ${table.dataset.csv} as CSV`);
      button.addEventListener("click", () => download(`${table.dataset.csv}${within.id === "one" && order.length > 1 ? `-cluster-${shown}` : ""}.csv`, csvOf(all("tr", table))));
      table.parentElement.after(button);
    }
  };
  const numeric = new Intl.Collator(undefined, { numeric: true });
  const sortable = (table) => {
    all("thead th", table).forEach((head, column) => {
      const button = document.createElement("button");
      button.type = "button";
      button.append(...head.childNodes);
      head.append(button);
      button.addEventListener("click", () => {
        const down = head.getAttribute("aria-sort") === "ascending", sign = down ? -1 : 1;
        for (const other of all("thead th", table)) other.removeAttribute("aria-sort");
        head.setAttribute("aria-sort", down ? "descending" : "ascending");
        const value = (row) => { const cell = row.cells[column]; return cell.dataset.v === undefined ? cellText(cell) : Number(cell.dataset.v); };
        const keyed = list.rows.map((row) => [value(row), row]);
        const last = (v) => typeof v === "number" && Number.isNaN(v);
        keyed.sort(([a], [b]) => {
          if (last(a) || last(b)) return last(a) - last(b);
          return sign * (typeof a === "number" && typeof b === "number" ? a - b : numeric.compare(a, b));
        });
        list.rows = keyed.map(([, row]) => row);
        select();
      });
    });
    let texts = null;
    const select = () => {
      const wanted = find("#filter").value.trim().toLowerCase(), warned = find("#only-warned").checked;
      texts ??= new Map(list.rows.map((row) => [row, cellText(row).toLowerCase()]));
      list.visible = list.rows.filter((row) => texts.get(row).includes(wanted) && (!warned || Number(row.lastElementChild.dataset.v) > 0));
      const count = list.visible.length;
      find("#shown").textContent = count === list.rows.length ? `${count} clusters` : `${count} of ${list.rows.length} clusters`;
      list.frame.scrollTop = 0;
      place();
      clearTimeout(table.waiting);
      table.waiting = setTimeout(drawForest, 250);
    };
    find("#filter").addEventListener("input", select);
    find("#only-warned").addEventListener("change", select);
    Object.assign(list, { table, frame: table.parentElement, rows: [...table.tBodies[0].rows] });
    list.rowOf = new Map(list.rows.map((row) => [row.dataset.cluster, row]));
    table.setAttribute("aria-rowcount", list.rows.length + 1);
    measure();
    select();
    list.frame.addEventListener("scroll", place, { passive: true });
    window.addEventListener("resize", () => { measure(); place(); });
    window.addEventListener("beforeprint", () => place("all"));
    window.addEventListener("afterprint", place);
    table.tBodies[0].addEventListener("click", (event) => {
      const row = event.target.closest("tr");
      if (!row || event.target.closest("a")) return;
      location.hash = `#cluster-${row.dataset.cluster}`;
    });
  };
  let overview = null;
  const drawForest = async () => {
    if (!find("#forest")) return;
    overview ??= await unpack(find("#overview").textContent);
    const names = visibleOrder(), at = new Map(overview.keys.map((key, k) => [String(key), k]));
    const rows = names.map((name) => at.get(name)).filter((k) => k !== undefined);
    const Plotly = await plotly();
    for (const [kind, title] of [["turn", "D<sub>R</sub> (rad²/s)"], ["shift", "D<sub>T</sub> (µm²/s)"]]) {
      const c = (name) => rows.map((k) => overview.column[`${kind}_${name}`][k]);
      const value = c("value"), low95 = c("low95"), high95 = c("high95"), low68 = c("low68"), high68 = c("high68"), kept = value.map((_, k) => k).filter((k) => !Number.isNaN(value[k]));
      const many = rows.length > 60;
      const bars = (low, high) => {
        const x = [], line = [];
        for (const k of kept) { x.push(low[k], Number.isFinite(high[k]) ? high[k] : low[k], null); line.push(k, k, null); }
        return { x, y: line };
      };
      const pooled = overview.pooled[kind], shapes = [];
      const named = { text: kept.map((k) => literal(overview.names[rows[k]])), customdata: kept.map((k) => names[k]), hovertemplate: "%{text}: %{x:.4g}<extra></extra>" };
      const traces = [{ x: kept.map((k) => value[k]), y: kept, mode: many ? "none" : "markers", marker: { size: 6, color: color("ink") }, name: "value", ...named }];
      if (many) {
        // A trace has an element for every bar and every marker, a shape has one for all of them.
        const ends = (low, high) => kept.map((k) => `M${low[k]},${k}L${Number.isFinite(high[k]) ? high[k] : low[k]},${k}`).join("");
        const known = (path) => (path.includes("NaN") ? path.replace(/M[^M]*NaN[^M]*/g, "") : path);
        const stroke = (path, width, ink) => shapes.push({ type: "path", path: known(path), line: { width, color: ink } });
        if (kept.length) {
          stroke(ends(low95, high95), 0.7, faint("soft", 0.7));
          stroke(ends(low68, high68), 1.6, color("blue"));
          stroke(kept.map((k) => `M${value[k]},${k - 0.4}L${value[k]},${k + 0.4}`).join(""), 3, color("ink"));
        }
      } else traces.unshift({ ...bars(low95, high95), mode: "lines", line: { width: 1.2, color: color("blue") }, hoverinfo: "skip", name: "95 %" },
        { ...bars(low68, high68), mode: "lines", line: { width: 4, color: color("blue") }, hoverinfo: "skip", name: "68 %" });
      if (pooled) shapes.push(
        { type: "rect", xref: "x", yref: "paper", x0: pooled[1], x1: pooled[2], y0: 0, y1: 1, fillcolor: faint("red", 0.18), line: { width: 0 }, layer: "below" },
        { type: "line", xref: "x", yref: "paper", x0: pooled[0], x1: pooled[0], y0: 0, y1: 1, line: { color: color("red"), width: 1.5 } });
      const ticks = rows.length <= 40 ? { tickvals: rows.map((_, k) => k), ticktext: rows.map((k) => literal(overview.names[k].slice(0, 16))) } : { showticklabels: false };
      const bounds = kept.flatMap((k) => [low95[k], high95[k]]).filter((v) => Number.isFinite(v) && v >= 0).sort((a, b) => a - b);
      const far = kept.map((k) => value[k]).reduce((a, b) => Math.max(a, b), 0) * 3;
      const top = Math.min(bounds[bounds.length - 1] ?? 1, far || Infinity);
      const plot = find(`#plot-forest-${kind}`);
      plot.style.height = `${Math.min(Math.max(150, 64 + 15 * rows.length), 640)}px`;
      await Plotly.react(plot, traces, layout(title, "", { shapes, showlegend: false, hovermode: "closest", xaxis: { range: [(bounds[0] ?? 0) * 0.9, top * 1.05], nticks: 5 },
        yaxis: { range: [rows.length - 0.4, -0.6], zeroline: false, showgrid: false, automargin: true, ...ticks } }), SETTINGS);
      if (!plot.dataset.linked) {
        plot.dataset.linked = "yes";
        plot.on("plotly_click", (event) => { const key = event.points.map((p) => p.customdata).find((k) => k !== undefined); if (key !== undefined) location.hash = `#cluster-${key}`; });
      }
    }
  };

  // ---- beginning -------------------------------------------------------------------------------
  // Text of names and values is escaped in the page; nothing from the address enters as markup.
  offerTables(document.body);
  for (const button of all(".copy")) button.addEventListener("click", async () => {
    const text = find("pre", button.closest(".copyable"));
    try {
      await navigator.clipboard.writeText(text.textContent);
    } catch {
      const range = document.createRange();
      range.selectNodeContents(text);
      getSelection().removeAllRanges();
      getSelection().addRange(range);
      document.execCommand("copy");
    }
    button.textContent = "copied";
    setTimeout(() => { button.textContent = "copy"; }, 1500);
  });
  const table = find("#clusters");
  if (table) {
    sortable(table);
    find("button[data-table=clusters]").addEventListener("click", () => download("clusters.csv", csvOf([...table.tHead.rows, ...list.visible, ...(table.tFoot?.rows ?? [])])));
  }
  if (!order.length) return;
  choices();
  find("#play").addEventListener("click", play);
  find("#time").addEventListener("input", (event) => { stop(); body.row = Number(event.target.value); moveBody(); });
  find("#frame-choice").addEventListener("change", (event) => { body.view = event.target.value; drawBody(); });
  for (const id of ["#show-places", "#show-axes"]) find(id).addEventListener("change", drawBody);
  find("#previous").addEventListener("click", () => neighbour(-1));
  find("#next").addEventListener("click", () => neighbour(1));
  document.addEventListener("keydown", (event) => {
    if (event.target.closest("input, select, textarea, [contenteditable], .js-plotly-plot") || event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key === "ArrowRight") neighbour(1);
    else if (event.key === "ArrowLeft") neighbour(-1);
    else return;
    event.preventDefault();
  });
  window.addEventListener("hashchange", () => {
    const key = fromHash();
    if (key === null) return;
    find("#one").scrollIntoView();  // first, so that the figures are drawn that will be seen
    if (key !== shown) show(key);
  });
  const resized = () => { for (const plot of all(".js-plotly-plot")) window.Plotly.Plots.resize(plot); };
  window.addEventListener("beforeprint", () => { for (const id of [...waiting.keys()]) drawWaiting(id); resized(); });
  window.addEventListener("afterprint", resized);
  const redraw = () => { drawAll(); drawForest(); };
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  const asked = fromHash();
  mark();
  const start = asked !== null && asked !== shown ? show(asked) : drawAll();
  start.then(() => { if (asked !== null) find("#one").scrollIntoView(); return drawForest(); }).then(() => { document.documentElement.dataset.ready = "yes"; });
})();
