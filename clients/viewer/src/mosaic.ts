// The images of all cameras in the order of the rig, with what is driven on the large one: time and speed.

import { el, fixed, trustColour } from "./dom";
import type { ImageInfo } from "./messages";
import type { Observation } from "./protocol";
import { rotate } from "./pose";

/** Cameras that look farther to the side than this, in radians, are in the second row. */
const FRONT_RAD = 1.2;
/** Below this width the rows wrap, as the style sheet says. */
const NARROW_PX = 760;
const GAP_PX = 4;
/** The strip below a large front camera takes at most this share of the height. */
const STRIP_SHARE = 0.35;

interface Cell {
  element: HTMLElement;
  canvas: HTMLCanvasElement;
  trust: HTMLElement;
  aspect: number;
  /** Direction of view, in radians to the left of ahead. */
  yaw: number;
}

export class Mosaic {
  readonly element = el("section.mosaic", { ariaLabel: "cameras" });
  private readonly cells = new Map<string, Cell>();
  private shape = "";
  private large: string | undefined;
  /** Called once for each image that has been drawn. */
  private note: (image: ImageInfo) => string = () => "";
  private main: Cell | undefined;
  private readonly hud = el("span.hud", { hidden: true });

  constructor() {
    new ResizeObserver(() => this.layOut()).observe(this.element);
  }

  /** A text to be shown on each image. */
  annotate(note: (image: ImageInfo) => string): void {
    this.note = note;
  }

  /** Shows the time and the speed, in m/s, over the large image. */
  drives(timeUs: number, speed: number): void {
    this.hud.hidden = false;
    this.hud.textContent = `${fixed(timeUs * 1e-6, 1)} s · ${fixed(speed, 1)} m/s · ${fixed(speed * 3.6, 0)} km/h`;
  }

  /** Decodes and draws an observation. Images of cameras without a new frame stay. */
  async show(observation: Observation): Promise<void> {
    const { images } = observation.metadata;
    if (images.length === 0) return;
    const shape = images.map(({ camera, width, height }) => `${camera} ${width} ${height}`).join();
    const isKnown = images.every(({ camera, width, height }) => {
      const canvas = this.cells.get(camera)?.canvas;
      return canvas?.width === width && canvas.height === height;
    });
    if (!isKnown && shape !== this.shape) this.arrange(images, shape);
    const decoded = await Promise.all(images.map((image) => decode(observation, image)));
    images.forEach((image, at) => {
      const cell = this.cells.get(image.camera);
      if (!cell) return;
      const picture = decoded[at]!;
      const context = cell.canvas.getContext("2d")!;
      if (picture instanceof ImageData) context.putImageData(picture, 0, 0);
      else {
        context.drawImage(picture, 0, 0);
        picture.close();
      }
      cell.canvas.dataset.hash = image.hash;
      const note = this.note(image);
      cell.trust.hidden = !image.trust && !note;
      cell.trust.textContent = note || (image.trust ? fixed(image.trust.value, 2) : "");
      cell.trust.style.color = image.trust ? trustColour(image.trust.value) : "";
    });
  }

  private arrange(images: ImageInfo[], shape: string): void {
    this.shape = shape;
    this.cells.clear();
    for (const image of images) this.cells.set(image.camera, this.cell(image));
    this.main = [...this.cells.values()].sort((a, b) => Math.abs(a.yaw) - Math.abs(b.yaw))[0];
    this.main?.element.classList.add("main");
    this.main?.element.append(this.hud);
    if (this.large && !this.cells.has(this.large)) this.enlarge(undefined);
    this.layOut();
  }

  /** Either the front camera large above a strip of the others, or two rows: whichever shows more pixels. */
  private layOut(): void {
    const { main } = this;
    if (!main) return;
    const { clientWidth: width, clientHeight: height } = this.element;
    const cells = [...this.cells.values()];
    const others = cells.filter((cell) => cell !== main);
    const isFront = ({ yaw }: Cell): boolean => Math.abs(yaw) < FRONT_RAD;
    const rows = [cells.filter(isFront), cells.filter((cell) => !isFront(cell))].filter((row) => row.length > 0);
    if (width < NARROW_PX || height === 0) {
      this.place([[main], others], [0, 0]);
      return;
    }

    const stripWidth = Math.min(width, STRIP_SHARE * height * aspectOf(others));
    const stripHeight = others.length ? stripWidth / aspectOf(others) + GAP_PX : 0;
    const mainWidth = Math.min(width, (height - stripHeight) * main.aspect);
    const stripArea = mainWidth ** 2 / main.aspect + stripWidth * stripHeight;

    const tall = rows.reduce((sum, row) => sum + width / aspectOf(row), (rows.length - 1) * GAP_PX);
    const rowWidth = width * Math.min(1, height / tall);
    const rowArea = rowWidth * Math.min(height, tall);
    if (stripArea > rowArea) this.place([[main], others], [mainWidth, stripWidth]);
    else this.place(rows, rows.map(() => rowWidth));
  }

  /** Puts cells into rows; a width of 0 leaves it to the style sheet. */
  private place(rows: Cell[][], widths: number[]): void {
    rows.forEach((cells, at) => {
      const row = (this.element.children[at] ?? this.element.appendChild(el("div.row"))) as HTMLElement;
      row.style.width = widths[at] ? `${widths[at]}px` : "";
      // Moving a cell that stands where it should would take the focus from it.
      const isSame = cells.length === row.children.length && cells.every(({ element }, i) => row.children[i] === element);
      if (!isSame) row.replaceChildren(...cells.map(({ element }) => element));
    });
    while (this.element.children.length > rows.length) this.element.lastElementChild!.remove();
  }

  private cell(image: ImageInfo): Cell {
    const canvas = el("canvas", { width: image.width, height: image.height });
    canvas.dataset.camera = image.camera;
    const trust = el("span.trust", { title: "trust: 1 at a recorded pose, 0 where nothing is known" });
    const name = el("span.name", {}, image.camera.replaceAll("_", " "));
    const element = el("button.cell", { type: "button", title: "Enlarge" }, canvas, name, trust);
    const aspect = image.width / image.height;
    element.style.flexGrow = String(aspect);
    element.addEventListener("click", () => {
      this.enlarge(this.large === image.camera ? undefined : image.camera);
      // Space is the brake.
      element.blur();
    });
    const [x, y] = rotate(image.camera_to_rig.q, [0, 0, 1]);
    return { element, canvas, trust, aspect, yaw: Math.atan2(y, x) };
  }

  /** Shows one camera over the others. */
  enlarge(camera: string | undefined): void {
    this.large = camera;
    this.element.classList.toggle("one", camera !== undefined);
    for (const [name, { element }] of this.cells) element.classList.toggle("large", name === camera);
    (this.cells.get(camera ?? "") ?? this.main)?.element.append(this.hud);
  }
}

const aspectOf = (cells: Cell[]): number => cells.reduce((sum, { aspect }) => sum + aspect, 0);

export async function decode(observation: Observation, image: ImageInfo): Promise<ImageBitmap | ImageData> {
  const bytes = observation.bytes(image);
  if (image.encoding === "raw") {
    const pixels = new ImageData(image.width, image.height);
    for (let from = 0, to = 0; from < bytes.length; from += 3, to += 4) {
      pixels.data[to] = bytes[from]!;
      pixels.data[to + 1] = bytes[from + 1]!;
      pixels.data[to + 2] = bytes[from + 2]!;
      pixels.data[to + 3] = 255;
    }
    return pixels;
  }
  const file = new Blob([bytes], { type: `image/${image.encoding}` });
  const picture = await createImageBitmap(file, { colorSpaceConversion: "none" });
  if (picture.width !== image.width || picture.height !== image.height) {
    throw new Error(`the image of ${image.camera} has another size than it should`);
  }
  return picture;
}
