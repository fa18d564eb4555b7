// Plots on canvases. `x` maps a time to a fraction of the width; points are [time, value], with value null if unknown.
// Labels are left of the curves, in a column of GUTTER pixels.
const $ = id => document.getElementById(id), GUTTER = 40;
const axisLeft = fraction => `calc(${GUTTER}px + (100% - ${GUTTER}px) * ${fraction})`;
function clearCanvas(id) {
  const canvas = $(id), width = canvas.clientWidth, height = canvas.clientHeight, dense = window.devicePixelRatio || 1;
  const size = [Math.round(width * dense), Math.round(height * dense)];
  if (canvas.width !== size[0] || canvas.height !== size[1]) [canvas.width, canvas.height] = size;
  const pen = canvas.getContext("2d"); pen.setTransform(dense, 0, 0, dense, 0, 0); pen.clearRect(0, 0, width, height);
  pen.font = "11px system-ui, sans-serif"; pen.textBaseline = "middle"; pen.textAlign = "right";
  return [pen, width, height];
}
// A fraction of the width to the right of GUTTER, in pixels.
const across = (width, fraction) => GUTTER + (width - GUTTER) * fraction;
// Tick step of an axis: 1, 2 or 5 times a power of ten, for at most `count` steps.
function tickStep(span, count) {
  const rough = span / count, power = 10 ** Math.floor(Math.log10(rough));
  return [1, 2, 5, 10].find(step => step * power >= rough) * power;
}
// Colored lines; the axis includes at least `low` to `high`. `dash` is the dash pattern of a line.
function drawLines(id, x, lines, low = 0, high = 0.1) {
  const [pen, width, height] = clearCanvas(id);
  for (const { points } of lines) for (const [, value] of points) if (value !== null) { low = Math.min(low, value); high = Math.max(high, value); }
  if (!(high > low)) { high += 0.01; low -= 0.01; }
  const step = tickStep(high - low, 3), y = v => height - 7 - (height - 14) * (v - low) / (high - low);
  low = Math.floor(low / step + 1e-9) * step; high = Math.ceil(high / step - 1e-9) * step;
  const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9)), large = Math.max(Math.abs(low), Math.abs(high)) >= 1e4;
  pen.lineWidth = 1;
  for (let k = Math.round(low / step); k * step <= high + step / 2; ++k) {
    const level = Math.round(y(k * step)) + 0.5;
    pen.strokeStyle = k ? "#e6eaee" : "#b9c1ca"; pen.setLineDash([]); pen.beginPath();
    pen.moveTo(GUTTER, level); pen.lineTo(width, level); pen.stroke();
    pen.fillStyle = "#5d6876"; pen.fillText(large ? (k * step).toExponential(0) : (k * step).toFixed(digits), GUTTER - 5, level);
  }
  pen.save(); pen.beginPath(); pen.rect(GUTTER, 0, width - GUTTER, height); pen.clip();
  for (const { color, points, dash } of lines) {
    pen.beginPath(); pen.strokeStyle = color; pen.lineWidth = 1.6; pen.lineJoin = "round"; pen.setLineDash(dash || []);
    let known = false;
    for (const [time, value] of points) {
      if (value !== null) pen[known ? "lineTo" : "moveTo"](across(width, x(time)), y(value));
      known = value !== null;
    }
    pen.stroke();
  }
  pen.restore();
}
// The rows of a curve, [row, value]; of every `apart` rows those with the least and the greatest value.
function extremes(first, last, apart, value) {
  const list = [];
  for (let i = first; i <= last; i += apart) {
    let low = [i, value(i)], high = low;
    for (let k = i + 1; k < i + apart && k <= last; ++k) {
      const now = value(k);
      if (now === null) continue;
      if (low[1] === null || now < low[1]) low = [k, now];
      if (high[1] === null || now > high[1]) high = [k, now];
    }
    list.push(...(low[0] === high[0] ? [low] : low[0] < high[0] ? [low, high] : [high, low]));
  }
  return list;
}
// The first row, and the last row of every phase in which a state stays the same, [row, state].
function phases(first, last, state) {
  const list = first <= last ? [[first, state(first)]] : [];
  for (let i = first + 1; i <= last; ++i) if (i === last || state(i) !== state(i + 1)) list.push([i, state(i)]);
  return list;
}
// Named rows, filled up to each time whose value is true. A name that is too long is abbreviated to its initials.
function drawSteps(id, x, rows) {
  const [pen, width, height] = clearCanvas(id), tall = height / rows.length;
  rows.forEach(({ name, color, points }, k) => {
    const words = name.split(/[ _]+/), fits = pen.measureText(name).width <= GUTTER - 6;
    pen.fillStyle = "#5d6876";
    pen.fillText(fits ? name : words.length > 1 ? words.map(word => word[0].toUpperCase()).join("") : name.slice(0, 5), GUTTER - 5, (k + 0.5) * tall);
    pen.fillStyle = "#eef1f4"; pen.fillRect(GUTTER, k * tall + 2, width - GUTTER, Math.max(tall - 4, 1));
    pen.save(); pen.beginPath(); pen.rect(GUTTER, 0, width - GUTTER, height); pen.clip(); pen.fillStyle = color;
    points.forEach(([time, on], i) => { if (i && on) pen.fillRect(across(width, x(points[i - 1][0])), k * tall + 2,
      (width - GUTTER) * (x(time) - x(points[i - 1][0])) + 0.5, Math.max(tall - 4, 1)); });
    pen.restore();
  });
}
