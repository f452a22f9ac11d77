// The last minute of a fan as a small picture: its speed, and the band in which a healthy fan would be.

const SHOWN_S = 60, HOLE_S = 7;
const WIDTH = 120, HEIGHT = 40;
const LEAST_REACH = 0.06;  // of the speed: less than this is noise, and looks small
const SVG = "http://www.w3.org/2000/svg";

function path(kind) {
  const made = document.createElementNS(SVG, "path");
  made.setAttribute("class", kind);
  made.setAttribute("vector-effect", "non-scaling-stroke");
  return made;
}

export class Spark {
  constructor() {
    this.rows = [];  // time, speed, lower and upper end of the band
    this.root = document.createElementNS(SVG, "svg");
    for (const [name, value] of [["viewBox", `0 0 ${WIDTH} ${HEIGHT}`], ["preserveAspectRatio", "none"], ["aria-hidden", "true"], ["class", "spark"]]) {
      this.root.setAttribute(name, value);
    }
    this.band = path("spark-band");
    this.line = path("spark-line");
    this.root.append(this.band, this.line);
  }

  add(t_s, speed, twin, half) {
    const band = twin === null || half === null ? [null, null] : [twin - half, twin + half];
    this.rows.push([t_s, speed, ...band]);
    while (this.rows[0][0] < t_s - SHOWN_S - 2) this.rows.shift();
  }

  draw() {
    const rows = this.rows, newest = rows.at(-1)?.[0];
    const known = rows.flatMap((row) => row.slice(1)).filter((value) => value !== null);
    if (!known.length) return;
    const low = Math.min(...known), high = Math.max(...known);
    const reach = Math.max(high - low, LEAST_REACH * Math.abs(high)) || 1, middle = (low + high) / 2;
    const x = (t_s) => (WIDTH * (1 + (t_s - newest) / SHOWN_S)).toFixed(1);
    const y = (value) => (HEIGHT * (0.5 - 0.9 * (value - middle) / reach)).toFixed(1);
    const parts = (which) => {
      const found = [];
      let last = null;
      for (const row of rows) {
        if (row[which] === null) continue;
        if (last === null || row[0] - last > HOLE_S) found.push([]);
        found.at(-1).push(row);
        last = row[0];
      }
      return found;
    };
    const line = (part, which) => part.map((row) => `${x(row[0])} ${y(row[which])}`);
    this.band.setAttribute("d", parts(3).map((part) => `M${line(part, 3).join("L")}L${line(part, 2).reverse().join("L")}Z`).join(""));
    this.line.setAttribute("d", parts(1).map((part) => `M${line(part, 1).join("L")}`).join(""));
  }
}
