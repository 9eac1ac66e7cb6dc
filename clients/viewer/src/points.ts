// The points of the LiDARs around the ego, seen from behind and above: drag to turn, wheel to come nearer.

import { Drawing, el } from "./dom";
import { Orbit } from "./orbit";
import { dot, rotate, subtract } from "./pose";
import type { Vector } from "./pose";
import type { Observation } from "./protocol";

/** Heights in the rig's axes between which colours go from blue to red, in metres. */
const LOW_M = -0.3;
const HIGH_M = 5;
const SHADES = 64;
/** Tangent of half the width of the picture. */
const HALF_WIDTH = 0.6;
/** The outline of a car on the ground, around the middle of its rear axle, in metres. */
const CAR: Vector[] = [[-1, -0.95, 0], [3.7, -0.95, 0], [3.7, 0.95, 0], [-1, 0.95, 0], [-1, -0.95, 0]];

export class PointsView {
  readonly element: HTMLElement;
  private readonly drawing = new Drawing((context, width, height) => this.draw(context, width, height));
  private readonly note = el("p.dim");
  private readonly orbit = new Orbit([8, 0, 0], 38);
  private clouds: Float32Array[] = [];

  constructor() {
    const { canvas } = this.drawing;
    canvas.className = "points";
    canvas.setAttribute("role", "img");
    // Nothing is shown, and nothing is drawn, for a rig without LiDAR.
    this.element = el("div.lidar", { hidden: true, title: "drag: turn, wheel: nearer" }, canvas, this.note);
    canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
    canvas.addEventListener("pointermove", (event) => {
      if (!canvas.hasPointerCapture(event.pointerId)) return;
      this.orbit.turn(event.movementX * 0.008, event.movementY * 0.008);
      this.drawing.redraw();
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.orbit.zoom(Math.exp(event.deltaY * 0.0015));
      this.drawing.redraw();
    }, { passive: false });
  }

  /** Shows the sweeps of an observation. Those of the one before stay if it has none. */
  show({ metadata: { sweeps = [] }, tensors }: Observation): void {
    if (sweeps.length === 0) return;
    this.clouds = sweeps.map(({ lidar }) => {
      // A copy: the bytes of the message need not begin at a multiple of 4.
      const { bytes } = tensors.get(`lidar/${lidar}/points`)!;
      return new Float32Array(bytes.slice().buffer);
    });
    const texts = sweeps.map(({ lidar, returns, rows, columns }) => `${lidar}: ${returns} of ${rows} × ${columns} beams`);
    this.note.textContent = texts.join(" · ");
    this.drawing.canvas.setAttribute("aria-label", `points of LiDARs: ${texts.join(", ")}`);
    this.element.hidden = false;
    this.element.dataset.points = String(sweeps.reduce((sum, { returns }) => sum + returns, 0));
    this.drawing.redraw();
  }

  /** Shows nothing until the next sweep. */
  clear(): void {
    this.clouds = [];
    this.element.hidden = true;
    delete this.element.dataset.points;
  }

  private draw(context: CanvasRenderingContext2D, shownWidth: number, shownHeight: number): void {
    const { canvas } = this.drawing;
    const { width, height } = canvas;
    const focal = width / 2 / HALF_WIDTH;
    const { xyz, q } = this.orbit.pose();
    const [forward, left, up] = ([[1, 0, 0], [0, 1, 0], [0, 0, 1]] as Vector[]).map((axis) => rotate(q, axis)) as [Vector, Vector, Vector];
    const pixels = context.createImageData(width, height);
    const colours = new Uint32Array(pixels.data.buffer);
    const nearest = new Float32Array(width * height).fill(Infinity);
    // A point is a pixel of a plain screen, or 3 by 3 of one that is twice as sharp.
    const size = Math.max(1, Math.round(devicePixelRatio * 1.3));
    for (const cloud of this.clouds) {
      for (let at = 0; at < cloud.length; at += 3) {
        const [x, y, z] = [cloud[at]! - xyz[0], cloud[at + 1]! - xyz[1], cloud[at + 2]! - xyz[2]];
        const depth = forward[0] * x + forward[1] * y + forward[2] * z;
        if (depth < 0.1) continue;
        const column = Math.round(width / 2 - (focal * (left[0] * x + left[1] * y + left[2] * z)) / depth);
        const row = Math.round(height / 2 - (focal * (up[0] * x + up[1] * y + up[2] * z)) / depth);
        if (column < 0 || row < 0 || column + size > width || row + size > height) continue;
        const shade = SHADE[Math.min(SHADES - 1, Math.max(0, Math.floor(((cloud[at + 2]! - LOW_M) / (HIGH_M - LOW_M)) * SHADES)))]!;
        for (let down = 0; down < size; down += 1) {
          for (let across = 0; across < size; across += 1) {
            const pixel = (row + down) * width + column + across;
            if (depth >= nearest[pixel]!) continue;
            nearest[pixel] = depth;
            colours[pixel] = shade;
          }
        }
      }
    }
    context.putImageData(pixels, 0, 0);

    context.strokeStyle = "#fff";
    context.lineWidth = 1.5;
    context.beginPath();
    const scale = shownWidth / width;
    for (const [index, corner] of CAR.entries()) {
      const away = subtract(corner, xyz);
      const depth = dot(away, forward);
      if (depth < 0.1) return;
      const place = [shownWidth / 2 - (scale * focal * dot(away, left)) / depth, shownHeight / 2 - (scale * focal * dot(away, up)) / depth] as const;
      if (index === 0) context.moveTo(...place);
      else context.lineTo(...place);
    }
    context.stroke();
  }
}

/** Colours by height, as the bytes of a pixel in little endian: from blue over green to red. */
const SHADE = Uint32Array.from({ length: SHADES }, (_, at) => {
  const hue = 240 * (1 - at / (SHADES - 1));
  const channel = (offset: number): number => {
    const k = (offset + hue / 30) % 12;
    return Math.round(255 * (0.58 - 0.42 * Math.max(-1, Math.min(k - 3, 9 - k, 1))));
  };
  return 0xff000000 + channel(4) * 0x10000 + channel(8) * 0x100 + channel(0);
});
