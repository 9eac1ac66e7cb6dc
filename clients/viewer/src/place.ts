// Placing a drive and a rig with the mouse: the ground, a known distance, a path. Clicks are places of the twin, by the
// depth of the picture; the server makes the version.

import { Client } from "./client";
import { Clicks, scaleOf } from "./clicks";
import type { Scale, Step } from "./clicks";
import { count, el, fixed, messageOf, showStatus, showTitle } from "./dom";
import { axisOf, levelGround, normalOf, toPlane } from "./ground";
import type { Ground } from "./ground";
import { Orbit, RIG_FROM_CAMERA } from "./orbit";
import { Overlay } from "./overlay";
import type { Page } from "./page";
import { add, clamp, dot, length, rotate, scaled, subtract } from "./pose";
import type { Pose, Vector } from "./pose";
import type { Observation } from "./protocol";
import { get, post } from "./server";
import { viewerSession } from "./session";

interface Survey {
  version: number;
  middle: Vector;
  radius: number;
  ground: Ground | null;
}

const FIELD_OF_VIEW = (60 * Math.PI) / 180;
const HELP: Record<Step, string> = {
  ground: "Keep the grid if it lies on the ground. Otherwise click three places on the ground, far apart; or say which axis is up, and click one place.",
  scale: "Click the two ends of something whose size you know, and give the size. Skip it if the twin is in metres.",
  path: "Click places of the ground along the way that the vehicle shall drive, at least two.",
};
/** A path that is shorter than a car is a wrong scale more often than a short drive. */
const CAR_M = 4.6;
/** Pixels that the pointer may move within a click. */
const CLICK_PX = 5;
const SAVE = "Save and drive";

export class PlacePage implements Page {
  readonly element: HTMLElement;
  private readonly canvas = el("canvas");
  private readonly overlay = new Overlay();
  private readonly picture: HTMLElement;
  private readonly tabs: Record<Step, HTMLButtonElement>;
  private readonly help = el("p.help");
  private readonly found = el("p.found");
  private readonly distance = el("input", { type: "number", value: "1", step: "0.1", min: "0", ariaLabel: "distance in metres" });
  private readonly scaleRow: HTMLElement;
  private readonly rig = el("select", { ariaLabel: "rig" });
  private readonly save = el("button.save", { type: "button", disabled: true }, SAVE);
  private readonly abort = new AbortController();
  private readonly twin: string;
  private readonly clicks = new Clicks();
  /** The up axes of the camera before the last two clicks: a third place of the ground changes it. */
  private upsBefore: Vector[] = [];
  /** Whether the user was told that no distance was given. */
  private assumesMetres = false;
  private step: Step = "ground";
  private orbit: Orbit | undefined;
  private proposal: Ground | undefined;
  /** The axis that is up, if it was said. */
  private axis: Vector | undefined;
  private readonly up: HTMLElement;
  private client: Client | undefined;
  private shown: Observation | undefined;
  private shownPose: Pose | undefined;
  private size: [number, number] = [640, 400];
  private version = 0;
  private wake: () => void = () => {};
  private ended = false;

  constructor(twin: string) {
    this.twin = twin;
    const tab = (step: Step, text: string): HTMLButtonElement => {
      const button = el("button.tab", { type: "button" }, text);
      button.dataset.step = step;
      button.addEventListener("click", () => this.turnTo(step));
      return button;
    };
    this.tabs = { ground: tab("ground", "1 Ground"), scale: tab("scale", "2 Scale"), path: tab("path", "3 Path") };
    const button = (text: string, then: () => void, title = ""): HTMLElement => {
      const made = el("button", { type: "button", title }, text);
      made.addEventListener("click", then);
      return made;
    };
    const more = (metres: number) => (): void => {
      this.distance.value = String(Math.max(0, Math.round((Number(this.distance.value) + metres) * 100) / 100));
      this.refresh();
    };
    this.distance.addEventListener("input", () => this.refresh());
    this.scaleRow = el("div.buttons.distance", {}, button("−1", more(-1)), button("−0.1", more(-0.1)), this.distance, "m",
      button("+0.1", more(0.1)), button("+1", more(1)));
    for (const name of ["vehicle6", "vehicle6-lidar", "surround6", "alpamayo1", "alpamayo2"]) this.rig.append(el("option", { value: name }, name));
    this.up = el("div.buttons.up", {}, "Up is", ...(["z", "-z", "y", "-y", "x", "-x"] as const).map((axis) =>
      button(axis.replace("-", "−"), () => this.setAxis(axisOf(axis)))));
    this.save.addEventListener("click", () => this.confirmAndPublish());
    this.picture = el("div.picture", {}, this.canvas, this.overlay.canvas);
    const left = el("div.left.place", {}, this.picture);
    this.element = el("div.view.placing", {}, left, el("aside.right", {},
      el("div.buttons.tabs", {}, ...Object.values(this.tabs)),
      this.help, this.up, this.found, this.scaleRow,
      el("div.buttons", {}, button("Undo", () => this.undo()), button("Clear", () => this.clear()),
        button("Next", () => this.turnTo(this.step === "ground" ? "scale" : "path"))),
      el("div.buttons.rig", {}, "Rig ", this.rig),
      el("div.buttons", {}, this.save),
      el("p.keys", {}, "Drag: turn · right button or two fingers: move · wheel or pinch: nearer · double click: turn about that place")));
    showTitle(el("b", {}, twin), " · place a drive");
    this.listen();
    this.refresh();
    void this.run();
  }

  async end(): Promise<void> {
    this.ended = true;
    this.abort.abort();
    this.wake();
    await this.client?.end();
  }

  private async run(): Promise<void> {
    try {
      showStatus("looking for the ground");
      const survey = await get<Survey>(`v1/twins/${encodeURIComponent(this.twin)}/ground`);
      if (this.ended) return;
      this.version = survey.version;
      this.proposal = survey.ground ?? undefined;
      const radius = survey.radius || 1;
      this.orbit = new Orbit(survey.middle, 4 * radius);
      if (this.proposal) this.orbit.up = normalOf(this.proposal);
      const { clientWidth, clientHeight } = this.picture;
      const aspect = clamp(clientWidth / (clientHeight || clientWidth), 0.6, 2.4);
      this.client = new Client();
      await this.client.connect();
      const width = this.client.welcome.backend === "gpu" ? 1280 : 640;
      this.size = [width, Math.round(width / aspect)];
      const [w, h] = this.size;
      const focal = this.focal;
      const camera = { name: "free", width: w, height: h, fx: focal, fy: focal, cx: w / 2, cy: h / 2, camera_to_rig: RIG_FROM_CAMERA };
      await this.client.open({
        twin: this.twin, version: this.version, session: viewerSession("place"), record: false,
        rig: { name: "free", cameras: [camera] }, outputs: { encoding: "jpeg", quality: 88, depth: true },
      });
      this.canvas.width = w;
      this.canvas.height = h;
      showTitle(el("b", {}, this.twin), ` v${this.version} · place a drive`);
      showStatus(this.proposal ? "a ground was found" : "no ground was found: click three places of it", this.proposal ? "good" : "");
      this.refresh();
      await this.draw();
    } catch (error) {
      if (!this.ended) showStatus(messageOf(error), "bad");
    }
  }

  private get focal(): number {
    return this.size[0] / 2 / Math.tan(FIELD_OF_VIEW / 2);
  }

  /** Asks for a picture whenever the camera has moved. */
  private async draw(): Promise<void> {
    let before = "";
    while (!this.ended) {
      const pose = this.orbit!.pose();
      const key = JSON.stringify(pose);
      if (key === before) {
        await new Promise<void>((resolve) => (this.wake = resolve));
        continue;
      }
      before = key;
      const observation = await this.client!.observation({ type: "observe", poses: [pose] });
      const image = observation.metadata.images[0]!;
      const picture = await createImageBitmap(new Blob([observation.bytes(image)], { type: "image/jpeg" }));
      this.canvas.getContext("2d")!.drawImage(picture, 0, 0);
      picture.close();
      this.shown = observation;
      this.shownPose = pose;
      this.element.dataset.step = String(Number(this.element.dataset.step ?? 0) + 1);
      this.drawOverlay();
    }
  }

  private moved(): void {
    this.wake();
  }

  private listen(): void {
    const { signal } = this.abort;
    const { picture } = this;
    const fingers = new Map<number, [number, number]>();
    let way = 0;
    let wasMany = false;
    picture.addEventListener("pointerdown", (event) => {
      picture.setPointerCapture(event.pointerId);
      if (fingers.size === 0) {
        way = 0;
        wasMany = event.button === 2;
      }
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
      if (fingers.size > 1) wasMany = true;
    }, { signal });
    picture.addEventListener("pointermove", (event) => {
      const from = fingers.get(event.pointerId);
      if (!from || !this.orbit) return;
      const spread = (): number => {
        const [a, b] = [...fingers.values()];
        return a && b ? Math.hypot(a[0] - b[0], a[1] - b[1]) : 0;
      };
      const before = spread();
      const [dx, dy] = [event.clientX - from[0], event.clientY - from[1]];
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
      way += Math.hypot(dx, dy);
      if (way < CLICK_PX) return;
      const perPixel = 1 / picture.clientWidth;
      if (fingers.size > 1) {
        if (before > 0) this.orbit.zoom(before / spread());
        this.orbit.pan(0.5 * dx * perPixel, 0.5 * dy * perPixel);
      } else if (wasMany) this.orbit.pan(dx * perPixel, dy * perPixel);
      else this.orbit.turn(4 * dx * perPixel, 4 * dy * perPixel);
      this.moved();
    }, { signal });
    const up = (event: PointerEvent): void => {
      const isClick = fingers.size === 1 && way < CLICK_PX && !wasMany && event.type === "pointerup";
      fingers.delete(event.pointerId);
      if (isClick) this.click(event.clientX, event.clientY);
    };
    picture.addEventListener("pointerup", up, { signal });
    picture.addEventListener("pointercancel", up, { signal });
    picture.addEventListener("contextmenu", (event) => event.preventDefault(), { signal });
    picture.addEventListener("dblclick", (event) => {
      if (!this.orbit) return;
      const at = this.placeAt(event.clientX, event.clientY);
      this.clicks.restoreBeforeDoubleClick(this.step);
      this.orbit.up = this.upsBefore[0] ?? this.orbit.up;
      if (at) {
        this.orbit.pivot = at;
        showStatus("");
      }
      this.moved();
      this.refresh();
    }, { signal });
    picture.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.orbit?.zoom(Math.exp(event.deltaY * 0.0015));
      this.moved();
    }, { signal, passive: false });
    new ResizeObserver(() => this.drawOverlay()).observe(picture);
  }

  /** Column and row of the picture at a pixel of the window. */
  private pixelAt(clientX: number, clientY: number): [number, number] | undefined {
    const box = this.shownBox();
    const [w, h] = this.size;
    const column = Math.floor(((clientX - box.left) / box.width) * w);
    const row = Math.floor(((clientY - box.top) / box.height) * h);
    return column >= 0 && row >= 0 && column < w && row < h ? [column, row] : undefined;
  }

  /** The picture within its canvas, which it fills in one direction. */
  private shownBox(): { left: number; top: number; width: number; height: number } {
    const box = this.canvas.getBoundingClientRect();
    const [w, h] = this.size;
    const scale = Math.min(box.width / w, box.height / h);
    const [width, height] = [w * scale, h * scale];
    return { left: box.left + (box.width - width) / 2, top: box.top + (box.height - height) / 2, width, height };
  }

  /** From the camera to what a pixel of the window shows, at a depth of 1. */
  private rayTo(clientX: number, clientY: number): Vector | undefined {
    const pixel = this.pixelAt(clientX, clientY);
    if (!pixel || !this.shownPose) return undefined;
    const [w, h] = this.size;
    const camera: Vector = [(pixel[0] + 0.5 - w / 2) / this.focal, (pixel[1] + 0.5 - h / 2) / this.focal, 1];
    return rotate(this.shownPose.q, rotate(RIG_FROM_CAMERA.q, camera));
  }

  /** The place of the twin that a pixel of the window shows. */
  private placeAt(clientX: number, clientY: number): Vector | undefined {
    const { shownPose } = this;
    const pixel = this.pixelAt(clientX, clientY);
    const ray = this.rayTo(clientX, clientY);
    if (!pixel || !ray || !shownPose) return undefined;
    const depth = this.depths()(...pixel);
    return depth > 0 ? add(shownPose.xyz, scaled(ray, depth)) : undefined;
  }

  /** The depth of the shown picture at a pixel; 0 where there is no surface, and beside the picture. */
  private depths(): (column: number, row: number) => number {
    const tensor = [...(this.shown?.tensors ?? [])].find(([name]) => name.endsWith("depth"))?.[1];
    if (!tensor) return () => 0;
    const depths = new DataView(tensor.bytes.buffer, tensor.bytes.byteOffset, tensor.bytes.byteLength);
    const [w, h] = this.size;
    return (column, row) => (column >= 0 && row >= 0 && column < w && row < h ? depths.getFloat32(4 * (row * w + column), true) : 0);
  }

  private click(x: number, y: number): void {
    if (this.orbit) this.upsBefore = [...this.upsBefore.slice(-1), this.orbit.up];
    // A path is on the ground, also where a bush is before it, and where nothing was captured.
    const { ground } = this;
    const at = this.step === "path" && ground ? this.onGround(ground, x, y) : this.placeAt(x, y);
    const before = this.clicks.of(this.step).length;
    this.clicks.click(this.step, at);
    if (!at) {
      showStatus("there is nothing at that place: click on a surface", "bad");
      return;
    }
    const places = this.clicks.of(this.step).length;
    showStatus(places > before ? "" : "begun again with this place; Undo brings the earlier places back");
    if (this.step === "ground" && places === 3 && this.ground) this.setUp(normalOf(this.ground));
    this.refresh();
  }

  /** The place of the ground that a pixel of the window shows. */
  private onGround(ground: Ground, clientX: number, clientY: number): Vector | undefined {
    const ray = this.rayTo(clientX, clientY);
    if (!ray || !this.shownPose) return undefined;
    const { xyz } = this.shownPose;
    const normal = normalOf(ground);
    const share = dot(subtract(ground.points[0], xyz), normal) / dot(ray, normal);
    // Above the horizon there is no ground, and near it a pixel is half a world.
    return share > 0 && share * length(ray) < 50 * this.orbit!.distance ? add(xyz, scaled(ray, share)) : undefined;
  }

  /** The ground that was clicked, or the one that was found. */
  private get ground(): Ground | undefined {
    const [a, b, c] = this.clicks.of("ground");
    const { axis, proposal } = this;
    if (a && b && c) return { points: [a, b, c], above: this.shownPose?.xyz ?? a };
    if (a && axis) return levelGround(a, axis);
    return proposal && (!axis || dot(normalOf(proposal), axis) > 0.7) ? proposal : undefined;
  }

  private setAxis(axis: Vector): void {
    this.axis = axis;
    this.setUp(axis);
    this.refresh();
  }

  private setUp(up: Vector): void {
    if (!this.orbit) return;
    this.orbit.up = up;
    this.moved();
  }

  private turnTo(step: Step): void {
    this.step = step;
    this.refresh();
  }

  private undo(): void {
    this.clicks.undo(this.step);
    this.refresh();
  }

  private clear(): void {
    this.clicks.clear(this.step);
    this.refresh();
  }

  private get scale(): Scale {
    return scaleOf(this.clicks.of("scale"), Number(this.distance.value));
  }

  private refresh(): void {
    for (const [step, tab] of Object.entries(this.tabs)) tab.ariaPressed = String(step === this.step);
    this.help.textContent = HELP[this.step];
    this.scaleRow.hidden = this.step !== "scale";
    this.up.hidden = this.step !== "ground";
    const { scale } = this;
    const path = this.clicks.of("path");
    let units = 0;
    for (let at = 1; at < path.length; at++) units += length(subtract(path[at]!, path[at - 1]!));
    const scaleText = scale.state === "assumed" ? "no distance: 1 m per unit" : scale.missing || `${fixed(scale.metresPerUnit, 4)} m per unit`;
    const metres = units * scale.metresPerUnit;
    const isShort = path.length > 1 && metres < CAR_M;
    const found = {
      ground: this.groundText(),
      scale: scaleText,
      path: `${count(path.length)} places, ${fixed(metres, 1)} m${isShort ? `, shorter than a car of ${CAR_M} m: is the scale right?` : ""}${
        scale.state === "given" ? "" : ` · ${scaleText}`}`,
    };
    this.found.textContent = found[this.step];
    this.assumesMetres = false;
    this.save.textContent = SAVE;
    this.save.disabled = path.length < 2 || !this.ground || scale.state === "incomplete";
    for (const step of ["ground", "scale", "path"] as const) this.element.dataset[step] = String(this.clicks.of(step).length);
    this.drawOverlay();
  }

  private groundText(): string {
    const clicks = this.clicks.of("ground").length;
    if (clicks === 3) return "the ground is that of the three places";
    if (clicks > 0 && this.axis) return "the ground is level at that place; two more give its tilt";
    if (clicks > 0) return `${clicks} of 3 places`;
    return this.ground ? "using the ground that was found" : "no ground yet";
  }

  private drawOverlay(): void {
    const { shownPose: pose, size, focal } = this;
    this.overlay.draw(pose && { pose, size, focal, box: this.shownBox(), depthAt: this.depths() }, this.clicks, this.ground, this.orbit);
  }

  /** Saves; without a known distance only when the user has read that it is missing, and presses again. */
  private confirmAndPublish(): void {
    if (this.scale.state === "assumed" && !this.assumesMetres) {
      this.assumesMetres = true;
      this.found.textContent = "No distance was given. If the twin is in metres, save; otherwise give one in step 2.";
      this.save.textContent = "Save with 1 m per unit";
      return;
    }
    void this.publish();
  }

  private async publish(): Promise<void> {
    const { ground, clicks } = this;
    if (!ground) return;
    this.save.disabled = true;
    showStatus("saving");
    try {
      const [a, b] = clicks.of("scale");
      const scale = a && b ? { points: [a, b], distance_m: Number(this.distance.value) } : undefined;
      const drive = { name: "path", points: clicks.of("path").map((at) => toPlane(at, ground)), speed: 5 };
      const made = await post<{ version: number }>(`v1/twins/${encodeURIComponent(this.twin)}/edits`,
        { base: this.version, ground, ...(scale && { scale }), drive, rig: this.rig.value });
      showStatus(`version ${made.version}`, "good");
      location.hash = `#/drive/${encodeURIComponent(this.twin)}`;
    } catch (error) {
      showStatus(messageOf(error), "bad");
      this.save.disabled = false;
    }
  }
}
