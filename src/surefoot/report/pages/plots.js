// Plots on canvases. `x` gives the share of the width for a time; points are [time, value], value null where unknown.
const $ = id => document.getElementById(id);
function sheet(id) {
  const canvas = $(id), width = canvas.clientWidth, height = canvas.clientHeight;
  if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
  const pen = canvas.getContext("2d"); pen.clearRect(0, 0, width, height); pen.font = "11px system-ui";
  return [pen, width, height];
}
// A text that can be read on top of lines; y is its base line.
function label(pen, text, y, color) {
  pen.fillStyle = "rgba(255, 255, 255, .8)"; pen.fillRect(2, y - 10, pen.measureText(text).width + 2, 13);
  pen.fillStyle = color; pen.fillText(text, 3, y);
}
// Lines of a color; what is plotted reaches from `low` or below to `high` or above. `dash` is a pattern of a line.
function drawLines(id, x, lines, low = 0, high = 0.1) {
  const [pen, width, height] = sheet(id), values = lines.flatMap(line => line.points.map(p => p[1])).filter(v => v !== null);
  low = values.reduce((a, b) => Math.min(a, b), low); high = values.reduce((a, b) => Math.max(a, b), high);
  if (!(high > low)) { high += 0.01; low -= 0.01; }
  const y = v => height - 4 - (height - 8) * (v - low) / (high - low);
  for (const { color, points, dash } of lines) {
    pen.beginPath(); pen.strokeStyle = color; pen.lineWidth = 1.5; pen.setLineDash(dash || []);
    let known = false;
    for (const [time, value] of points) {
      if (value !== null) pen[known ? "lineTo" : "moveTo"](width * x(time), y(value));
      known = value !== null;
    }
    pen.stroke();
  }
  label(pen, high.toFixed(2), 12, "#6b7480"); label(pen, low.toFixed(2), height - 4, "#6b7480");
}
// Rows with a name, filled up to each time whose value is true.
function drawSteps(id, x, rows) {
  const [pen, width, height] = sheet(id), tall = height / rows.length;
  rows.forEach(({ name, color, points }, k) => {
    pen.fillStyle = color;
    points.forEach(([time, on], i) => { if (i && on) pen.fillRect(width * x(points[i - 1][0]), k * tall + 2,
      width * (x(time) - x(points[i - 1][0])) + .5, Math.max(tall - 4, 1)); });
    label(pen, name, (k + .7) * tall, "#22272e");
  });
}
