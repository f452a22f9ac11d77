// What is shown of a fan as files: the plots as a picture, the values as a table.

import { element, stamp } from "./dom.js";
import { inFull } from "./names.js";
import { PREFIX } from "./server.js";

const LINE = 20, MARGIN = 12;

export function csvAddress(path, from_s, to_s) {
  return `${PREFIX}${path}/series?${new URLSearchParams({ from: from_s.toFixed(3), to: to_s.toFixed(3), points: 4000, format: "csv" })}`;
}

export function savePicture(tray, fan, stack) {
  const plots = stack.plots.map((plot) => ({ title: plot.about.title, unit: plot.about.unit, canvas: plot.plot.ctx.canvas }));
  const scale = devicePixelRatio, style = getComputedStyle(document.documentElement), of = (name) => style.getPropertyValue(`--${name}`).trim();
  const width = Math.max(...plots.map((plot) => plot.canvas.width));
  const made = element("canvas", { width: width + 2 * MARGIN * scale, height: plots.reduce((sum, plot) => sum + plot.canvas.height + 1.5 * LINE * scale, 2 * (LINE + MARGIN) * scale) });
  const context = made.getContext("2d");
  context.fillStyle = of("background");
  context.fillRect(0, 0, made.width, made.height);
  const write = (text, y, weight) => { context.fillStyle = of("text"); context.font = `${weight} ${14 * scale}px system-ui, sans-serif`; context.fillText(text, MARGIN * scale, y); };
  let y = (LINE + MARGIN / 2) * scale;
  write(`${inFull(tray, fan)}, ${stamp(stack.from_s * 1e9)} to ${stamp(stack.to_s * 1e9)}`, y, 600);
  for (const { title, unit, canvas } of plots) {
    y += 1.4 * LINE * scale;
    write(unit ? `${title}, ${unit}` : title, y, 400);
    context.drawImage(canvas, MARGIN * scale, y + 4 * scale);
    y += canvas.height;
  }
  made.toBlob((blob) => {
    const address = URL.createObjectURL(blob);
    element("a", { href: address, download: `${tray}-fan${fan}-${stamp(stack.to_s * 1e9).replace(/[ :]/g, "-")}.png` }).click();
    setTimeout(() => URL.revokeObjectURL(address), 10000);
  }, "image/png");
}
