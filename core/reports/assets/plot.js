"use strict";
// Draws the page's data: a panel per signal; all panels show the same time.
(() => {
  let page = JSON.parse(document.getElementById("data").textContent);
  const $ = (id) => document.getElementById(id);
  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;
  const unpacked = () => page.recordings.map((r) => r.times.map((t) => Array.from(new Float64Array(bytes(t)))));
  let times = unpacked();
  const numbers = (a) => Array.from(new Float32Array(bytes(a.data)), (v) => (Number.isNaN(v) ? null : v + a.offset));
  const placed = (a, count) => { // the few that are there among so many
    const found = new Array(count).fill(null), values = numbers(a);
    new Uint32Array(bytes(a.at)).forEach((place, i) => { found[place] = values[i]; });
    return found;
  };
  const dark = matchMedia("(prefers-color-scheme: dark)");
  let paper = false; // which is white
  const element = (name, text) => Object.assign(document.createElement(name), { textContent: text ?? "" });
  const FIRST = 8; // panels shown at first

  let recording = 0, view = $("view").value, plots = [], busy = false, shown = new Set();

  function colours() {
    const night = dark.matches && !paper, ink = night ? "#e6e6e6" : "#000000";
    return {
      ink, soft: night ? "#a2a9b1" : "#57606a", grid: night ? "#33383e" : "#e6e8ea",
      bounds: "#56B4E9", band: night ? "rgba(86,180,233,.38)" : "rgba(86,180,233,.5)",
      score: night ? "rgba(230,230,230,.6)" : "rgba(0,0,0,.6)", violated: night ? "#ff8a3d" : "#D55E00",
      alarm: night ? "rgba(240,228,66,.22)" : "rgba(240,228,66,.45)", silent: "rgba(140,140,140,.3)",
    };
  }

  const views = () => page.recordings[recording].views;
  const panels = () => [...page.recordings[recording].top, ...(views()[view] ?? []).filter((p) => shown.has(p.title))];
  const number = (v) => (v == null ? "–" : String(Number(v.toPrecision(7))));

  function shade(u, levels, c) {
    const { left, top, width, height } = u.bbox;
    if (levels.length > 1) {
      const [low, high] = levels.map((v) => Math.min(Math.max(u.valToPos(v, "y", true), top), top + height));
      u.ctx.fillStyle = c.band;
      u.ctx.fillRect(left, high, width, low - high);
    }
    const { min, max } = u.scales.x;
    const { alarms, silent } = page.recordings[recording];
    for (const [spans, colour] of [[alarms, c.alarm], [silent, c.silent]]) {
      u.ctx.fillStyle = colour;
      for (const [begin, end] of spans) {
        if (end < min || begin > max) continue;
        const from = Math.max(u.valToPos(begin, "x", true), left);
        const to = Math.min(u.valToPos(end, "x", true), left + width);
        u.ctx.fillRect(from, top, Math.max(to - from, 1), height);
      }
    }
  }

  function columns(panel) {
    const c = colours(), series = [{ label: "time [s]", value: (u, v) => number(v) }];
    const data = [times[recording][panel.time]];
    const bands = [], source = panel.values;
    const add = (label, a, stroke, width, more) => {
      data.push(a.at ? placed(a, data[0].length) : numbers(a));
      series.push({ label, stroke, width, points: { show: false }, value: (u, v) => number(v), ...more });
      return data.length - 1;
    };
    if (source.lower) {
      const lower = add("lower", source.lower, c.bounds, 0.6), upper = add("upper", source.upper, c.bounds, 0.6);
      bands.push({ series: [upper, lower], fill: c.band });
    }
    const held = panel.word === "control" && !source.greatest ? { paths: uPlot.paths.stepped({ align: 1 }) } : {};
    const filled = panel.word === "score" ? { fill: c.score } : {};
    const least = add(source.greatest ? "least" : panel.word, source.least, c.ink, 1, { ...held, ...filled });
    if (source.greatest) bands.push({ series: [add("greatest", source.greatest, c.ink, 1), least], fill: c.ink });
    if (source.marked) {
      add("violated", source.marked, c.violated, 1, {
        paths: () => null, points: { show: true, size: 5, width: 0, fill: c.violated, stroke: c.violated },
      });
    }
    return { series, data, bands };
  }

  function draw(panel, holder) {
    const c = colours(), { series, data, bands } = columns(panel);
    const thin = { stroke: c.grid, width: 1 };
    const axis = { stroke: c.soft, grid: thin, ticks: thin, font: "11px system-ui, sans-serif" };
    const longest = (values) => Math.max(0, ...(values ?? []).map((v) => v.length));
    const room = (self, values) => Math.max(innerWidth < 700 ? 50 : 76, 16 + 6.5 * longest(values));
    const pub = (type) => type === "mousemove" || type === "mouseleave";
    const u = new uPlot({
      width: holder.clientWidth, height: 170, series, bands,
      scales: { x: { time: false }, y: panel.levels.length ? { range: limited(panel) } : {} },
      axes: [{ ...axis, size: 32 }, { ...axis, size: room }],
      cursor: {
        drag: { x: true, y: false, dist: 4 },
        sync: { key: "all", scales: ["x", null], filters: { pub } },
        bind: { mousedown: (self, target, handler) => (e) => (e.shiftKey ? move(self, e) : handler(e)) },
      },
      hooks: {
        drawClear: [(self) => shade(self, panel.levels, c)],
        draw: [(self) => limits(self, panel.levels, c)],
        setScale: [(self, key) => key === "x" && follow(self)],
      },
    }, data, holder);
    u.over.addEventListener("wheel", (e) => { if (e.ctrlKey) wheel(u, e); }, { passive: false });
    touch(u);
    return u;
  }

  const limited = (panel) => (u, low, high) => { // score from 0 on, utilisation around it
    const size = 1.1 * Math.max(Math.abs(low ?? 0), Math.abs(high ?? 0));
    return panel.levels.length > 1 ? [-Math.min(Math.max(1.25, size), 5), Math.min(Math.max(1.25, size), 5)]
      : [0, Math.min(Math.max(1.5, size), 10)];
  };

  function limits(u, levels, c) { // the bounds of a utilisation, the threshold of a score
    u.ctx.save(); // uPlot goes on with the colour that it has set
    u.ctx.strokeStyle = levels.length > 1 ? c.bounds : c.violated;
    u.ctx.lineWidth = devicePixelRatio;
    for (const v of levels) {
      const y = Math.round(u.valToPos(v, "y", true)) + 0.5;
      u.ctx.beginPath();
      u.ctx.moveTo(u.bbox.left, y);
      u.ctx.lineTo(u.bbox.left + u.bbox.width, y);
      u.ctx.stroke();
    }
    u.ctx.restore();
  }

  function span() { // of the whole recording
    const all = times[recording].filter((t) => t.length);
    const low = Math.min(...all.map((t) => t[0])), high = Math.max(...all.map((t) => t[t.length - 1]));
    return all.length ? [low, high > low ? high : low + 1] : [0, 1];
  }

  function show(min, max) {
    const [low, high] = span(), least = (high - low) * 1e-7;
    const width = Math.min(Math.max(max - min, least), high - low);
    const from = Math.min(Math.max(min, low), high - width);
    busy = true;
    for (const u of plots) u.setScale("x", { min: from, max: from + width });
    busy = false;
    $("range").textContent = `${number(from)} to ${number(from + width)} s`;
  }

  function follow(u) { // a drag or a double click in one panel
    if (busy || !plots.includes(u)) return;
    const { min, max } = u.scales.x;
    if (min != null) setTimeout(() => show(min, max));
  }

  function scaled(factor, at) {
    if (!plots.length) return;
    const { min, max } = plots[0].scales.x, centre = at ?? (min + max) / 2;
    show(centre - (centre - min) * factor, centre + (max - centre) * factor);
  }

  function wheel(u, e) {
    e.preventDefault();
    scaled(e.deltaY < 0 ? 0.75 : 1 / 0.75, u.posToVal(e.clientX - u.over.getBoundingClientRect().left, "x"));
  }

  function move(u, e) {
    const { min, max } = u.scales.x, begin = e.clientX, perDot = (max - min) / u.over.clientWidth;
    const go = (event) => show(min - (event.clientX - begin) * perDot, max - (event.clientX - begin) * perDot);
    document.addEventListener("mousemove", go);
    document.addEventListener("mouseup", () => document.removeEventListener("mousemove", go), { once: true });
    return null;
  }

  function touch(u) { // one finger reads, two fingers zoom and move
    let start = null;
    const left = () => u.over.getBoundingClientRect().left;
    const places = (e) => [...e.touches].map((p) => p.clientX - left()).sort((a, b) => a - b);
    u.over.addEventListener("touchstart", (e) => {
      start = e.touches.length === 2 ? places(e).map((p) => u.posToVal(p, "x")) : null;
      read(e);
    }, { passive: true });
    u.over.addEventListener("touchmove", (e) => {
      if (e.touches.length !== 2 || !start) return read(e);
      e.preventDefault();
      const [a, b] = places(e), width = u.over.clientWidth;
      const perDot = (start[1] - start[0]) / Math.max(b - a, 1);
      show(start[0] - a * perDot, start[0] + (width - a) * perDot);
    }, { passive: false });
    const read = (e) => {
      if (e.touches.length !== 1) return;
      const box = u.over.getBoundingClientRect();
      u.setCursor({ left: e.touches[0].clientX - box.left, top: e.touches[0].clientY - box.top }, true, true);
    };
  }

  function jump(step) { // to the next or the previous alarm
    const alarms = page.recordings[recording].alarms;
    if (!alarms.length || !plots.length) return;
    const { min, max } = plots[0].scales.x, [low, high] = span(), width = Math.min(max - min, (high - low) / 20);
    const middle = (min + max) / 2, near = width * 1e-6, whole = max - min > 0.99 * (high - low);
    const begins = alarms.map((a) => a[0]);
    const later = begins.find((b) => whole || b > middle + near) ?? begins[0];
    const earlier = begins.filter((b) => !whole && b < middle - near).pop() ?? begins[begins.length - 1];
    const begin = step > 0 ? later : earlier;
    show(begin - width / 2, begin + width / 2);
  }

  function render(keep) {
    const range = keep && plots.length ? [plots[0].scales.x.min, plots[0].scales.x.max] : span();
    for (const u of plots) u.destroy();
    plots = [];
    const now = page.recordings[recording], holder = $("panels");
    holder.replaceChildren();
    $("note").textContent = now.note;
    panels().forEach((panel) => {
      const box = element("section"), head = element("h3", panel.title + (panel.unit ? ` [${panel.unit}]` : ""));
      head.append(element("small", panel.note));
      box.append(head);
      holder.append(box);
      plots.push(draw(panel, box));
    });
    for (const id of ["before", "after"]) $(id).disabled = !now.alarms.length;
    show(...range);
  }

  function call(title) {
    document.title = document.querySelector("h1").textContent = title;
    document.querySelector("h1").className = title.startsWith("ALARM") ? "bad" : "";
  }

  async function look() { // at what a running monitor has said since; not while something is dragged
    if (document.querySelector(":active")) return;
    const before = Object.values(views()).flat().map((p) => p.title).join(), [low, high] = span();
    const whole = !plots.length || plots[0].scales.x.min <= low && plots[0].scales.x.max >= high;
    try {
      page = await (await fetch("data")).json();
    } catch {
      $("note").textContent = "The program that serves this page has ended.";
      call(`ENDED ${page.recordings[0].name}`);
      return;
    }
    times = unpacked();
    call(page.recordings[0].title);
    const same = Object.values(views()).flat().map((p) => p.title).join() === before;
    if (same) render(!whole); else choose(0);
  }

  function choose(index) {
    recording = index;
    const every = new Map(Object.values(views()).flat().map((p) => [p.title, p.rank]));
    const most = [...every].sort((a, b) => b[1] - a[1]).map(([title]) => title);
    shown = new Set(most.slice(0, FIRST));
    const list = $("signals");
    list.replaceChildren(element("summary", ""));
    const count = () => { list.firstChild.textContent = `signals (${shown.size} of ${every.size} drawn)`; };
    for (const title of every.keys()) {
      const label = element("label"), box = Object.assign(element("input"), { type: "checkbox", checked: shown.has(title) });
      box.addEventListener("change", () => { shown[box.checked ? "add" : "delete"](title); count(); render(true); });
      label.append(box, " " + title);
      list.append(label);
    }
    count();
    render(false);
  }

  page.recordings.forEach((r, i) => $("recording").append(Object.assign(element("option", r.name), { value: i })));
  $("recording").hidden = page.recordings.length < 2;
  $("view").hidden = $("view").options.length < 2;
  const judged = !$("view").hidden || page.every;
  $("keys").hidden = !judged;
  for (const id of ["before", "after"]) $(id).hidden = !judged;
  $("recording").addEventListener("change", () => choose(Number($("recording").value)));
  $("view").addEventListener("change", () => { view = $("view").value; render(true); });
  $("whole").addEventListener("click", () => show(...span()));
  $("in").addEventListener("click", () => scaled(0.5));
  $("out").addEventListener("click", () => scaled(2));
  $("before").addEventListener("click", () => jump(-1));
  $("after").addEventListener("click", () => jump(1));
  dark.addEventListener("change", () => render(true));
  addEventListener("beforeprint", () => { paper = true; render(true); });
  addEventListener("afterprint", () => { paper = false; render(true); });
  let width = innerWidth;
  addEventListener("resize", () => {
    if (innerWidth === width) return;
    width = innerWidth;
    for (const u of plots) u.setSize({ width: u.root.parentNode.clientWidth, height: 170 });
  });
  choose(0);
  if (page.every) { call(page.recordings[0].title); setInterval(look, page.every); }
})();
