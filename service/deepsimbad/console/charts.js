// The route with what is believed of it, the belief along it, and how that came about. Colours are the page's own.

import { html, useEffect, useRef } from "./preact.js";

const LETTERS = `${Math.round(0.75 * parseFloat(getComputedStyle(document.documentElement).fontSize))}px system-ui, sans-serif`;
const MARGIN = 40; // pixels around a route: room for the names of its ends
const SCALE_HEIGHT = 30; // under it
const MOST_POINTS = 3000; // of a drawn route: more cannot be told apart
const dark = matchMedia("(prefers-color-scheme: dark)");

const colours = new Map(); // of the theme there is
dark.addEventListener("change", () => colours.clear());

export function colour(name) {
  if (!colours.has(name)) colours.set(name, getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim());
  return colours.get(name);
}

function parts(text) {
  const n = parseInt(text.slice(1), 16);
  return [(n >> 16) & 255, (n >> 8) & 255, n & 255];
}

export function between(one, other, share) {
  const [a, b] = [parts(one), parts(other)];
  return `rgb(${a.map((value, i) => Math.round(value + (b[i] - value) * share)).join(" ")})`;
}

// Draws again when its element changes its size, or the page its theme.
export function useDrawing(ref, draw) {
  const latest = useRef(draw);
  latest.current = draw;
  useEffect(() => {
    const again = () => latest.current();
    const observer = new ResizeObserver(again);
    observer.observe(ref.current);
    dark.addEventListener("change", again);
    return () => {
      observer.disconnect();
      dark.removeEventListener("change", again);
    };
  }, []);
  useEffect(() => latest.current());
}

function sized(canvas) {
  const scale = devicePixelRatio || 1;
  const { width, height } = canvas.getBoundingClientRect();
  const [across, down] = [width, height].map((side) => Math.max(1, Math.round(side * scale)));
  if (canvas.width !== across || canvas.height !== down) [canvas.width, canvas.height] = [across, down];
  const context = canvas.getContext("2d");
  context.setTransform(scale, 0, 0, scale, 0, 0);
  context.clearRect(0, 0, width, height);
  return { context, width, height };
}

// A route for drawing: points to scale where x and y are known, else along a line.
export class Route {
  constructor({ route_position_m: at_m, x_m, y_m, chance, closed, length_m }) {
    this.isPlane = Boolean(x_m && y_m && x_m.some((x) => x !== null));
    const step = Math.max(1, Math.ceil(at_m.length / MOST_POINTS));
    this.points = [];
    for (let i = 0; i < at_m.length; i = i === at_m.length - 1 ? i + 1 : Math.min(i + step, at_m.length - 1)) {
      if (this.isPlane && (x_m[i] === null || y_m[i] === null)) continue;
      let low = 1;
      if (chance) for (let j = i; j < Math.min(i + step, at_m.length); j += 1) low = Math.min(low, chance[j]);
      this.points.push({ at_m: at_m[i], x: this.isPlane ? x_m[i] : at_m[i], y: this.isPlane ? y_m[i] : 0, chance: chance ? low : null });
    }
    this.closed = Boolean(closed);
    this.start_m = at_m[0];
    this.end_m = at_m[at_m.length - 1];
    if (this.closed && this.points.length && this.start_m + length_m > this.end_m) { // a loop ends where it began
      this.end_m = this.start_m + length_m;
      this.points.push({ ...this.points[0], at_m: this.end_m, ...(this.isPlane ? {} : { x: this.end_m }) });
    }
    const [xs, ys] = ["x", "y"].map((axis) => this.points.map((point) => point[axis]));
    this.box = [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
  }

  // From metres to pixels of a picture of that size, one scale both ways.
  // Room is left for the names of its ends, and under it for the scale.
  fitted(width, height, margin = MARGIN) {
    const [left, bottom, right, top] = this.box;
    const high = height - (this.isPlane ? SCALE_HEIGHT : 0);
    const scale = Math.min((width - 2 * margin) / Math.max(right - left, 1e-6), this.isPlane ? (high - 2 * margin) / Math.max(top - bottom, 1e-6) : Infinity);
    const x0 = (width - scale * (right - left)) / 2;
    const y0 = (high - scale * (top - bottom)) / 2;
    return { scale, place: ({ x, y }) => [x0 + scale * (x - left), high - y0 - scale * (y - bottom)] };
  }

  // The index of the last point before a position, by halves.
  before(at_m) {
    let [low, high] = [0, this.points.length - 1];
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (this.points[middle].at_m <= at_m) low = middle;
      else high = middle;
    }
    return low;
  }

  at(at_m) {
    const i = this.before(at_m);
    const [one, other] = [this.points[i], this.points[Math.min(i + 1, this.points.length - 1)]];
    const share = other.at_m > one.at_m ? Math.min(1, Math.max(0, (at_m - one.at_m) / (other.at_m - one.at_m))) : 0;
    return { x: one.x + (other.x - one.x) * share, y: one.y + (other.y - one.y) * share };
  }

  // A robot's place after a move: round a loop, and never past an end.
  moved(at_m, action_m) {
    const length_m = this.end_m - this.start_m;
    if (!this.closed || length_m <= 0) return Math.min(this.end_m, Math.max(this.start_m, at_m + action_m));
    return this.start_m + ((((at_m + action_m - this.start_m) % length_m) + length_m) % length_m);
  }
}

function drawRoute(canvas, route, isCovered) {
  const { context, width, height } = sized(canvas);
  const { place, scale } = route.fitted(width, height);
  const [rail, low, high] = [colour("rail"), colour("low"), colour("high")];
  context.lineCap = "round";
  for (let i = 0; i + 1 < route.points.length; i += 1) {
    const [one, other] = [route.points[i], route.points[i + 1]];
    context.beginPath();
    context.moveTo(...place(one));
    context.lineTo(...place(other));
    const chance = isCovered ? one.chance : null;
    context.strokeStyle = chance === null ? rail : between(low, high, chance);
    context.lineWidth = chance === null ? 4 : 3 + 5 * (1 - chance); // not by colour alone
    context.stroke();
  }
  context.fillStyle = context.strokeStyle = colour("quiet");
  context.font = LETTERS;
  context.textAlign = "center";
  context.textBaseline = "middle";
  const last = route.points.length - 1;
  const [left, bottom, right, top] = route.box;
  const middle = { x: (left + right) / 2, y: (bottom + top) / 2 };
  const ends = [["start", 0, route.points[Math.min(8, last)]], ["end", last, route.points[Math.max(0, last - 8)]]];
  for (const [name, end, inner] of route.closed && route.isPlane ? [["start", 0, middle]] : ends) {
    const [[x, y], [towards_x, towards_y]] = [place(route.points[end]), place(inner)];
    const away = Math.hypot(x - towards_x, y - towards_y) || 1; // names stand beyond the ends
    context.fillText(name, x + (24 * (x - towards_x)) / away, y + (16 * (y - towards_y)) / away);
  }
  context.textAlign = "start";
  context.textBaseline = "alphabetic";
  if (!route.isPlane) return;
  const ten = 10 ** Math.floor(Math.log10(60 / scale)); // the least of 1, 2, 5, 10 .. that is 60 pixels long
  const metres = ten * [1, 2, 5, 10].find((times) => times * ten * scale >= 60);
  context.lineWidth = 2;
  context.beginPath();
  context.moveTo(14, height - 14);
  context.lineTo(14 + metres * scale, height - 14);
  context.stroke();
  context.fillText(metres >= 1000 ? `${(metres / 1000).toLocaleString()} km` : `${Number(metres.toPrecision(1))} m`, 14, height - 20);
}

// Paths of the histogram's bins along the route; made once a route and size, drawn ten times a second.
function binPaths(route, place, edges_m) {
  const paths = [];
  for (let bin = 0; bin + 1 < edges_m.length; bin += 1) {
    const [from_m, to_m] = [edges_m[bin], edges_m[bin + 1]];
    const path = new Path2D();
    path.moveTo(...place(route.at(from_m)));
    for (let i = route.before(from_m) + 1; i < route.points.length && route.points[i].at_m < to_m; i += 1) path.lineTo(...place(route.points[i]));
    path.lineTo(...place(route.at(to_m)));
    paths.push(path);
  }
  return paths;
}

function dot(context, [x, y], radius, fill, ring) {
  context.beginPath();
  context.arc(x, y, radius, 0, 2 * Math.PI);
  context.fillStyle = fill;
  context.fill();
  context.lineWidth = 2;
  context.strokeStyle = ring;
  context.stroke();
}

function drawBelief(canvas, route, belief, next, kept) {
  const { context, width, height } = sized(canvas);
  if (!belief) return;
  const { place } = route.fitted(width, height);
  const { edges_m, mass } = belief.histogram;
  const of = `${width} ${height} ${edges_m.length} ${edges_m[0]} ${edges_m[edges_m.length - 1]}`;
  if (kept.of !== of || kept.route !== route) Object.assign(kept, { of, route, paths: binPaths(route, place, edges_m) });
  const most = Math.max(...mass);
  context.lineCap = "butt";
  context.strokeStyle = colour("blue");
  kept.paths.forEach((path, bin) => {
    const share = mass[bin] / most;
    if (share < 0.002) return;
    context.globalAlpha = 0.15 + 0.85 * Math.sqrt(share);
    context.lineWidth = 5 + 9 * Math.sqrt(share);
    context.stroke(path);
  });
  context.globalAlpha = 1;
  const card = colour("card");
  if (next && !next.stop) dot(context, place(route.at(route.moved(belief.mode_m, next.action_m))), 5, colour("mark"), card);
  dot(context, place(route.at(belief.mode_m)), 7, colour("blue"), card);
}

export function RouteMap({ route, belief, next, label }) {
  const [below, above, kept] = [useRef(), useRef(), useRef({})];
  const drawn = useRef();
  useDrawing(below, () => {
    const now = `${route.start_m} ${below.current.getBoundingClientRect().width} ${below.current.getBoundingClientRect().height} ${dark.matches}`;
    if (drawn.current?.now !== now || drawn.current.route !== route) drawRoute(below.current, route, !belief);
    drawn.current = { now, route };
    drawBelief(above.current, route, belief, next, kept.current);
  });
  const [left, bottom, right, top] = route.box; // a flat route takes no more room than it needs
  const shape = `${Math.max(right - left, 1e-6)} / ${Math.max(top - bottom, 1e-6)}`;
  return html`<div class=${route.isPlane ? "map" : "map straight"} style=${route.isPlane ? { aspectRatio: shape } : {}} role="img" aria-label=${label}>
    <canvas ref=${below}></canvas><canvas ref=${above}></canvas>
  </div>`;
}

const PADDING = [8, 12, 0, 0]; // pixels: top, right, bottom, left; .history keeps in line with it

// A chart of the library, in the page's colours, as wide as its place.
export function Plot({ series, values, label, axes = [{}, {}], scales = { x: { time: false } }, height = 150, bands = [], hooks = {} }) {
  const [ref, chart] = [useRef(), useRef()];
  const theme = useRef();
  useDrawing(ref, () => {
    const width = Math.max(200, Math.floor(ref.current.getBoundingClientRect().width));
    const [ink, line] = [colour("quiet"), colour("line")];
    const look = `${ink} ${series.length}`;
    if (chart.current && theme.current !== look) chart.current = chart.current.destroy();
    if (!chart.current) {
      theme.current = look;
      const axis = { stroke: ink, grid: { stroke: line, width: 1 }, ticks: { stroke: line, width: 1 }, font: LETTERS, labelFont: LETTERS, size: 56 };
      chart.current = new globalThis.uPlot({
        width, height, scales, bands, hooks, padding: PADDING,
        cursor: { y: false, drag: { x: false, y: false } },
        axes: axes.map((own, i) => ({ ...axis, ...(i ? {} : { size: 34 }), ...own })),
        series: [{}, ...series.map((own) => ({ width: 2, points: { show: (plot) => plot.data[0].length === 1 }, ...own, stroke: colour(own.stroke), fill: own.fill ? `${colour(own.fill)}55` : undefined }))],
      }, values, ref.current);
    } else {
      if (chart.current.width !== width) chart.current.setSize({ width, height });
      chart.current.setData(values);
    }
  });
  useEffect(() => () => chart.current?.destroy(), []);
  return html`<div class="plot" ref=${ref} role="img" aria-label=${label}></div>`;
}

// The belief along the route: its mass a bin, what the smallest credible set covers, where each move would lead.
export function Strip({ belief, next, route, label }) {
  const { edges_m, mass } = belief.histogram;
  const shown = useRef();
  shown.current = { belief, next };
  const drawn = (plot) => {
    const { belief: now, next: move } = shown.current;
    const { ctx, bbox } = plot;
    const scale = devicePixelRatio || 1;
    const x = (at_m) => plot.valToPos(at_m, "x", true);
    ctx.save();
    ctx.fillStyle = colour("soft");
    for (const [from_m, to_m] of now.credible_95_sets_m) {
      const pieces = from_m <= to_m ? [[from_m, to_m]] : [[edges_m[0], to_m], [from_m, edges_m[edges_m.length - 1]]];
      for (const [one, other] of pieces) ctx.fillRect(x(one) - scale, bbox.top, Math.max(x(other) - x(one), 0) + 2 * scale, bbox.height);
    }
    ctx.fillStyle = colour("mark");
    for (const { action_m } of move?.actions ?? []) {
      const at = x(route.moved(now.mode_m, action_m));
      const isChosen = action_m === move.action_m && !move.stop;
      ctx.fillRect(at - scale, bbox.top, (isChosen ? 3 : 1) * scale, isChosen ? bbox.height : 8 * scale);
    }
    ctx.restore();
  };
  const middles = edges_m.slice(1).map((edge, i) => (edge + edges_m[i]) / 2);
  return html`<${Plot} height=${190} label=${label} values=${[middles, mass.map((share) => 100 * share)]}
    series=${[{ stroke: "blue", fill: "blue", paths: globalThis.uPlot.paths.stepped({ align: 0 }) }]} axes=${[{ label: "metres along the route", labelSize: 20, size: 36 }, { values: (_, ticks) => ticks.map((tick) => `${tick} %`) }]}
    scales=${{ x: { time: false, range: [edges_m[0], edges_m[edges_m.length - 1]] }, y: { range: (_, __, most) => [0, Math.max(most, 0.01) * 1.08] } }}
    hooks=${{ drawAxes: [drawn] }} />`;
}

// A belief as a row of pixels.
function painted(mass, [paper, ink]) {
  const row = new Uint8ClampedArray(4 * mass.length);
  const most = Math.max(...mass);
  mass.forEach((value, bin) => {
    const share = Math.sqrt(value / most);
    for (let part = 0; part < 3; part += 1) row[4 * bin + part] = paper[part] + (ink[part] - paper[part]) * share;
    row[4 * bin + 3] = 255;
  });
  return new ImageData(row, mass.length, 1);
}

const SHEET_ROWS = 4096; // more than events are kept
const PAINTED_AT_ONCE = 100; // so that a long session's history holds no page up

// How the belief came about: a row an event, newest below; a click goes there. Every row is painted once, on a sheet
// that begins anew at its end.
export function History({ events, current, onPick, label }) {
  const [ref, kept] = [useRef(), useRef({})];
  const [first, last] = [events[0].number, events[events.length - 1].number];
  const draw = () => {
    if (!ref.current) return;
    const n_bins = events[0].answer.belief.histogram.mass.length;
    const names = ["soft", "blue"].map(colour);
    if (kept.current.of !== `${names} ${n_bins}`) {
      const paper = Object.assign(document.createElement("canvas"), { width: n_bins, height: SHEET_ROWS });
      kept.current = { of: `${names} ${n_bins}`, numbers: [], paper, pencil: paper.getContext("2d") };
    }
    const { numbers, paper, pencil } = kept.current;
    let n_painted = 0;
    for (let i = events.length - 1; i >= 0 && n_painted < PAINTED_AT_ONCE; i -= 1) {
      const row = events[i].number % SHEET_ROWS;
      if (numbers[row] === events[i].number) continue;
      pencil.putImageData(painted(events[i].answer.belief.histogram.mass, names.map(parts)), 0, row);
      numbers[row] = events[i].number;
      n_painted += 1;
    }
    if (n_painted === PAINTED_AT_ONCE) requestAnimationFrame(draw);
    const { context, width, height } = sized(ref.current);
    const tall = height / (last - first + 1);
    const top = (number) => (number - first) * tall;
    context.imageSmoothingEnabled = tall < 1; // else rows would be left out
    for (let from = 0, i = 1; i <= events.length; i += 1) {
      if (i < events.length && events[i].number === events[i - 1].number + 1 && events[i].number % SHEET_ROWS) continue;
      context.drawImage(paper, 0, events[from].number % SHEET_ROWS, n_bins, i - from, 0, top(events[from].number), width, (i - from) * tall);
      from = i;
    }
    context.strokeStyle = colour("mark");
    context.lineWidth = 2;
    const shown = Math.min(top(events[current].number), height - 4);
    context.strokeRect(1, Math.max(1, shown + 1), width - 2, Math.max(2, tall - 2));
  };
  useDrawing(ref, draw);
  const pick = (event) => {
    const box = ref.current.getBoundingClientRect();
    const number = first + Math.floor(((event.clientY - box.top) / box.height) * (last - first + 1));
    const index = events.findIndex((each) => each.number >= number);
    onPick(index < 0 ? events.length - 1 : index);
  };
  return html`<div class="history"><canvas ref=${ref} role="img" aria-label=${label} onClick=${pick}></canvas></div>`;
}
