"""The style and the script of the page."""

STYLE = """
:root { color-scheme: light dark;
  --paper: #fff; --card: #f6f7f9; --ink: #1b1f24; --muted: #59636e; --rule: #d5dae0; --grid: #e6e9ed; --bad: #c0143c;
    --good: #116329;
  --c0: #0072b2; --c1: #d55e00; --c2: #009e73; --c3: #b5529b; --c4: #b58900; --c5: #3d9ad1; --c6: #6e7781;
    --c7: #7a4a1e; }
@media (prefers-color-scheme: dark) { :root {
  --paper: #0f1318; --card: #181d24; --ink: #e6e9ed; --muted: #9aa5b1; --rule: #343b45; --grid: #262c35;
    --bad: #ff6b81; --good: #6fd08c;
  --c0: #4fb0ec; --c1: #ff8c42; --c2: #35d0a0; --c3: #e38fd0; --c4: #f0c54a; --c5: #9ad6fb; --c6: #a3adb8;
    --c7: #c99a6b; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 76rem; padding: 1.5rem clamp(.8rem, 3vw, 2.5rem) 4rem; background: var(--paper);
  color: var(--ink);
  font: 15px/1.5 system-ui, -apple-system, "Segoe UI", "Liberation Sans", Arial, sans-serif;
    font-variant-numeric: tabular-nums; }
h1 { font-size: 1.6rem; line-height: 1.2; margin: 0 0 .2rem; overflow-wrap: anywhere; }
h2 { font-size: 1.2rem; margin: 2rem 0 .5rem; padding-top: .8rem; border-top: 1px solid var(--rule); }
h3 { font-size: 1rem; margin: 1.8rem 0 .2rem; }
p { margin: .3rem 0 .8rem; max-width: 46rem; }
.muted, figcaption, dt { color: var(--muted); }
.small, figcaption { font-size: .85rem; }
code, pre, .mono { font-family: ui-monospace, "SF Mono", Menlo, Consolas, "DejaVu Sans Mono", monospace;
  font-size: .9em; }
pre span { white-space: pre; }
pre { white-space: pre-wrap; overflow-x: auto; background: var(--card); padding: .6rem .8rem; border-radius: 6px;
  margin: .3rem 0 .8rem; }
.cards { display: flex; flex-wrap: wrap; gap: .8rem; margin: 1rem 0; }
.card { background: var(--card); border-radius: 8px; padding: .7rem 1rem; border-left: 4px solid var(--rule);
  flex: 1 1 15rem; max-width: 24rem; }
.card b { display: block; font-size: 1.7rem; line-height: 1.25; font-weight: 600; }
.card b small { font-size: 1rem; font-weight: 400; color: var(--muted); }
.card p { margin: 0; }
.swatch { display: inline-block; width: .8em; height: .8em; border-radius: 50%; margin-right: .45em;
  vertical-align: -.06em; }
.legend { display: flex; flex-wrap: wrap; gap: .2rem 1.2rem; margin: .2rem 0 .6rem; font-size: .9rem; }
.large { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 25rem), 1fr)); gap: 1rem 1.6rem;
  max-width: 66rem; }
.tiles { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 16.5rem), 1fr)); gap: 1.1rem 1.4rem; }
.tiles svg { max-width: 22rem; }
figure { margin: 0; min-width: 0; position: relative; }
figcaption { display: flex; flex-wrap: wrap; gap: 0 .5rem; align-items: baseline; margin-bottom: .1rem; }
figcaption .name { color: var(--ink); font-weight: 600; overflow-wrap: anywhere; }
svg { display: block; width: 100%; height: auto; overflow: visible; touch-action: pan-y; }
svg text { font: 11px system-ui, -apple-system, "Segoe UI", "Liberation Sans", Arial, sans-serif; fill: var(--muted); }
svg .grid { stroke: var(--grid); } svg .axis { stroke: var(--muted); stroke-width: .8; fill: none; }
svg .reference { stroke: var(--muted); stroke-dasharray: 5 4; }
svg .line { fill: none; stroke-width: 1.8; stroke-linejoin: round; stroke-linecap: round; }
  svg .dashed { stroke-dasharray: 6 3; }
svg .band { stroke: none; fill-opacity: .16; } svg .area { stroke: var(--paper); stroke-width: .6; }
svg .points { fill: none; stroke-width: 3; stroke-linecap: round; stroke-opacity: .4; } svg .whisker { fill: none;
  stroke-width: 1.3; }
svg .bad { stroke: var(--bad); stroke-width: 1.6; fill: none; } svg circle { stroke: var(--paper); stroke-width: 1; }
svg .cursor { stroke: var(--muted); stroke-width: .8; }
.tip { position: absolute; top: 1.4rem; z-index: 2; pointer-events: none; background: var(--paper);
  border: 1px solid var(--rule);
  border-radius: 6px; padding: .2rem .5rem; font-size: .8rem; line-height: 1.4; white-space: nowrap; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: .9rem; margin: .4rem 0 1rem; }
th, td { text-align: left; padding: .25rem .9rem .25rem 0; border-bottom: 1px solid var(--grid); vertical-align: top; }
th { font-weight: 600; color: var(--muted); white-space: nowrap; } td.number, th.number { text-align: right;
  white-space: nowrap; }
td.name { white-space: nowrap; padding-right: 1.4rem; }
details { margin: .4rem 0; } summary { cursor: pointer; } figure details { margin: .1rem 0 0; font-size: .85rem; }
figure details summary { color: var(--muted); } figure details p { margin: .2rem 0; }
.run { border: 1px solid var(--rule); border-radius: 8px; padding: .5rem .9rem; } .run > summary { font-weight: 600; }
.pass { color: var(--good); } .fail { color: var(--bad); }
.pictures { display: grid; gap: 1.2rem; } .pictures img { max-width: 100%; height: auto; border-radius: 4px;
  display: block; }
@media print { details:not([open]) > *:not(summary) { display: none; } }
"""
STYLE += "".join(
    f"svg .line.c{color}, svg .points.c{color}, svg .whisker.c{color} {{ stroke: var(--c{color}); }}\n"
    f"svg .band.c{color}, svg .area.c{color}, svg circle.c{color} {{ fill: var(--c{color}); }}\n"
    f".swatch.c{color} {{ background: var(--c{color}); }}\n"
    for color in range(8)
)

# Shows the values under the pointer. They are read back from the lines, so that they are not in the page twice.
SCRIPT = """
"use strict";
for (const svg of document.querySelectorAll("svg[data-axes]")) {
  const [end, x0, x1, low, high, y0, y1, log] = svg.dataset.axes.split(" ").map(Number);
  const value = y => log ? low * Math.exp((y - y0) / (y1 - y0) * Math.log(high / low)) : low + (y - y0) / (y1 - y0) *
    (high - low);
  const lines = [...svg.querySelectorAll(".line")].map(line => ({
    label: line.dataset.label, color: [...line.classList].find(name => /^c\\d$/.test(name)),
    points: line.getAttribute("d").slice(1).split("L").map(point => {
      const [x, y] = point.split(",").map(Number);
      return [x - line.dataset.moved, y];
    }) }));
  if (!lines.length) continue;
  const cursor = document.createElementNS("http://www.w3.org/2000/svg", "path");
  const tip = document.createElement("div");
  cursor.setAttribute("class", "cursor"); tip.className = "tip"; tip.hidden = true;
  svg.append(cursor); svg.parentNode.append(tip);
  svg.addEventListener("pointerleave", () => { tip.hidden = true; cursor.removeAttribute("d"); });
  svg.addEventListener("pointermove", event => {
    const box = svg.getBoundingClientRect();
    const pointer = (event.clientX - box.left) / box.width * svg.viewBox.baseVal.width;
    const nearest = (points, x) => points.reduce((best, point) => Math.abs(point[0] - x) < Math.abs(best[0] - x) ?
      point : best);
    const x = nearest(lines.flatMap(line => line.points), pointer)[0];
    cursor.setAttribute("d", `M${x},${Math.min(y0, y1)}V${Math.max(y0, y1)}`);
    const step = Math.round(Math.round((x - x0) / (x1 - x0) * 1000) / 1000 * end);
    tip.replaceChildren(`step ${step.toLocaleString("en")}`);
    for (const { label, color, points } of lines) {
      const near = nearest(points, x);
      if (Math.abs(near[0] - x) > 20) continue;
      const row = document.createElement("div"), swatch = document.createElement("span");
      swatch.className = `swatch ${color}`;
      row.append(swatch, `${label}: ${value(near[1]).toLocaleString("en", { maximumSignificantDigits: 3 })}`);
      tip.append(row);
    }
    tip.hidden = false;
    tip.style.left = x > (x0 + x1) / 2 ? "auto" : `${event.clientX - box.left + 12}px`;
    tip.style.right = x > (x0 + x1) / 2 ? `${box.right - event.clientX + 12}px` : "auto";
  });
}
"""
