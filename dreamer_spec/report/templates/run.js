// Shows the values under the pointer. They are read back from the lines, so that they are not in the page twice.
"use strict";
for (const svg of document.querySelectorAll("svg[data-axes]")) {
  const [end, x0, x1, low, high, y0, y1, log] = svg.dataset.axes.split(" ").map(Number);
  const value = y => log ? low * Math.exp((y - y0) / (y1 - y0) * Math.log(high / low)) : low + (y - y0) / (y1 - y0) *
    (high - low);
  const lines = [...svg.querySelectorAll(".line")].map(line => ({
    label: line.dataset.label, color: [...line.classList].find(name => /^c\d$/.test(name)),
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
