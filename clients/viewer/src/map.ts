// The map: recorded drives, route, trail by trust, actors and the ego, over a picture from above, with north up.

import { aerial } from "./aerial";
import type { Aerial } from "./aerial";
import { Drawing, colour, fixed, trustColour } from "./dom";
import { clamp, heading, transform } from "./pose";
import type { Pose, Vector } from "./pose";
import type { Metadata } from "./messages";
import { get } from "./server";

interface DrivePoint {
  station_m: number;
  pose: Pose;
}

interface Drive {
  name: string;
  points: DrivePoint[];
}

/** A dot on the map. */
export interface Mark {
  xyz: Vector;
  colour: string;
}

interface TrailPoint {
  xyz: Vector;
  trust: number | undefined;
}

/** Length and width of the ego on the map, in metres; its origin is the rear axle. */
const EGO_LENGTH_M = 4.6;
const EGO_WIDTH_M = 1.9;
const EGO_REAR_M = -1.0;
const TRAIL_POINTS = 20_000;
/** How far beside a drive a click still means it, in pixels. */
const CLICK_PX = 14;
const MARK_PX = 5;
/** Least scale of a map that the user has not zoomed. */
const PIXELS_PER_M = 4;
/** Of the picture from above, so that what is drawn over it is seen. */
const GROUND_ALPHA = 0.75;
const FIT_SHARE = 0.8;

export class MapView {
  /** Called when a place on a drive is clicked. */
  onPick: ((trajectory: string, stationM: number) => void) | undefined;
  /** The same, with the recorded pose. */
  onPose: ((pose: Pose) => void) | undefined;

  private readonly drawing = new Drawing((context, width, height) => this.draw(context, width, height));
  private drives: Drive[] = [];
  private ground: Aerial | undefined;
  private trail: TrailPoint[] = [];
  private ghosts: { points: Vector[]; colour: string }[] = [];
  private now: Metadata | undefined;
  private other: Pose | undefined;
  private outlines: Vector[][] = [];
  private marks: Mark[] = [];
  /** What the map shows all of, until the user moves it. */
  private fitted: Vector[] | undefined;
  /** Middle of the map: a place, or the ego. */
  private centre: [number, number] | undefined;
  /** None until the user zooms or a place is fitted. */
  private chosenScale: number | undefined;

  get element(): HTMLCanvasElement {
    return this.drawing.canvas;
  }

  constructor() {
    const canvas = this.element;
    canvas.className = "map";
    canvas.setAttribute("aria-label", "map");
    canvas.title = "Wheel: zoom. Drag: move. Double click: follow the ego. Click a drive: start there.";
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(-event.deltaY * 0.0015));
    }, { passive: false });
    canvas.addEventListener("dblclick", () => {
      this.fitted = undefined;
      this.centre = undefined;
      this.drawing.redraw();
    });
    this.listenToPointers(canvas);
    this.drawing.redraw();
  }

  /** Loads the recorded drives of a twin. */
  async load(twin: string, version: number, names: string[]): Promise<void> {
    this.drives = await Promise.all(names.map(async (name) => {
      const path = `v1/twins/${twin}/trajectories/${name}?version=${version}`;
      const { length_m: length } = await get<{ length_m: number }>(`${path}&to_m=0`);
      // An answer has at most 10,000 poses.
      const everyM = Math.max(1, Math.ceil(length / 9_000));
      const { poses } = await get<{ poses: DrivePoint[] }>(`${path}&every_m=${everyM}`);
      return { name, points: poses };
    }));
    this.drawing.redraw();
    void this.loadGround(twin, version);
  }

  /** The map is drawn without a picture until the server has rendered one, and where it does not. */
  private async loadGround(twin: string, version: number): Promise<void> {
    const places = this.drives.flatMap(({ points }) => points.map(({ pose }) => pose.xyz));
    this.ground = await aerial(twin, version, places).catch(() => undefined);
    this.element.dataset.ground = this.ground?.picture.dataset.hash ?? "";
    this.drawing.redraw();
  }

  /** Adds an observation to the trail. */
  show(metadata: Metadata): void {
    const isNew = metadata.step === 0;
    if (isNew) this.trail = [];
    this.now = metadata;
    const trusts = metadata.images.flatMap((image) => (image.trust ? [image.trust.value] : []));
    const last = this.trail.at(-1);
    // Between two decisions there are no images: the last trust holds.
    const trust = trusts.length ? trusts.reduce((a, b) => a + b) / trusts.length : last?.trust;
    this.trail.push({ xyz: metadata.ego.pose.xyz, trust });
    if (this.trail.length > TRAIL_POINTS) this.trail.shift();
    this.drawing.redraw();
  }

  /** Shows a whole episode as the trail. */
  path(points: Vector[], name: string): void {
    this.ghosts.push({ points, colour: name });
    this.drawing.redraw();
  }

  /** Outlines of lanes. */
  lanes(outlines: Vector[][]): void {
    this.outlines = outlines;
    this.element.dataset.lanes = String(outlines.length);
    this.drawing.redraw();
  }

  /** Shows dots, and all of them at first. */
  mark(marks: Mark[]): void {
    if (this.marks.length === 0 && marks.length > 0) this.fitted = marks.map(({ xyz }) => xyz);
    this.marks = marks;
    this.drawing.redraw();
  }

  /** The recorded pose that is nearest to a station of a loaded drive. */
  poseAt(trajectory: string, stationM: number): Pose | undefined {
    const points = this.drives.find(({ name }) => name === trajectory)?.points ?? [];
    const away = (point: DrivePoint): number => Math.abs(point.station_m - stationM);
    return points.reduce<DrivePoint | undefined>((best, point) => (best && away(best) <= away(point) ? best : point), undefined)?.pose;
  }

  /** Moves the ego without a trail; `which` is 1 for the ego of a second episode. */
  at(metadata: Metadata, which = 0): void {
    if (which === 0) this.now = metadata;
    else this.other = metadata.ego.pose;
    this.drawing.redraw();
  }

  /** Lets a map of this size show all of these places, with a margin. */
  private fit(places: Vector[], width: number, height: number): void {
    const range = (axis: 0 | 1): [number, number] => {
      const values = places.map((place) => place[axis]);
      return [Math.min(...values), Math.max(...values)];
    };
    const [west, east] = range(0);
    const [south, north] = range(1);
    this.centre = [(west + east) / 2, (south + north) / 2];
    const pixelsPerM = FIT_SHARE * Math.min(width / (east - west || 1), height / (north - south || 1));
    this.chosenScale = clamp(pixelsPerM, 0.02, 60);
  }

  private zoom(factor: number): void {
    this.fitted = undefined;
    this.chosenScale = clamp(this.pixelsPerM * factor, 0.02, 60);
    this.drawing.redraw();
  }

  private listenToPointers(canvas: HTMLCanvasElement): void {
    const fingers = new Map<number, [number, number]>();
    let moved = 0;
    const spread = (): number => {
      const [a, b] = [...fingers.values()];
      return a && b ? Math.hypot(a[0] - b[0], a[1] - b[1]) : 0;
    };
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, [event.offsetX, event.offsetY]);
      moved = 0;
    });
    canvas.addEventListener("pointermove", (event) => {
      const from = fingers.get(event.pointerId);
      if (!from) return;
      const before = spread();
      fingers.set(event.pointerId, [event.offsetX, event.offsetY]);
      const step: [number, number] = [event.offsetX - from[0], event.offsetY - from[1]];
      moved += Math.hypot(...step);
      if (fingers.size === 2 && before > 0) return this.zoom(spread() / before);
      if (moved < 4) return;
      this.fitted = undefined;
      const [x, y] = this.middle();
      this.centre = [x - step[0] / this.pixelsPerM, y + step[1] / this.pixelsPerM];
      this.drawing.redraw();
    });
    const up = (event: PointerEvent): void => {
      const isClick = fingers.size === 1 && moved < 4;
      if (fingers.delete(event.pointerId) && isClick) this.pick(event.offsetX, event.offsetY);
    };
    canvas.addEventListener("pointerup", up);
    canvas.addEventListener("pointercancel", (event) => fingers.delete(event.pointerId));
  }

  private pick(x: number, y: number): void {
    const toScreen = this.projection(this.element.clientWidth, this.element.clientHeight);
    let best: { distance: number; name: string; point?: DrivePoint } = { distance: CLICK_PX, name: "" };
    for (const { name, points } of this.drives) {
      for (const point of points) {
        const [px, py] = toScreen(point.pose.xyz);
        const distance = Math.hypot(px - x, py - y);
        if (distance < best.distance) best = { distance, name, point };
      }
    }
    if (!best.point) return;
    this.onPick?.(best.name, best.point.station_m);
    this.onPose?.(best.point.pose);
  }

  /** Until the user zooms, a wide map is nearer, so that the picture from above reaches its edges. */
  private get pixelsPerM(): number {
    if (this.chosenScale !== undefined) return this.chosenScale;
    const { clientWidth: width, clientHeight: height } = this.element;
    const cover = this.ground ? Math.max(width / this.ground.widthM, height / this.ground.heightM) : 0;
    return Math.max(PIXELS_PER_M, cover);
  }

  /** The place of the user, or the ego. Near an end of the picture from above the ego is not in the middle: the map would be empty beside it. */
  private middle(): [number, number] {
    if (this.centre) return this.centre;
    const [x, y] = this.now?.ego.pose.xyz ?? this.drives[0]?.points[0]?.pose.xyz ?? [0, 0];
    if (!this.ground) return [x, y];
    const { middle: [east, north], widthM, heightM } = this.ground;
    const within = (value: number, centre: number, picture: number, map: number): number => {
      const spare = Math.max(0, (picture - map / this.pixelsPerM) / 2);
      return clamp(value, centre - spare, centre + spare);
    };
    const { clientWidth: width, clientHeight: height } = this.element;
    const place: [number, number] = [within(x, east, widthM, width), within(y, north, heightM, height)];
    // An ego that leaves the picture takes the map with it.
    const follow = (value: number, centre: number, map: number): number => {
      const reach = (0.45 * map) / this.pixelsPerM;
      return clamp(centre, value - reach, value + reach);
    };
    return [follow(x, place[0], width), follow(y, place[1], height)];
  }

  private projection(width: number, height: number): (point: Vector) => [number, number] {
    const [cx, cy] = this.middle();
    const scale = this.pixelsPerM;
    return ([x, y]) => [width / 2 + (x - cx) * scale, height / 2 - (y - cy) * scale];
  }

  private draw(context: CanvasRenderingContext2D, width: number, height: number): void {
    if (this.fitted) this.fit(this.fitted, width, height);
    const toScreen = this.projection(width, height);
    const line = (points: Vector[], style: string, thickness: number, dash: number[] = []): void => {
      context.beginPath();
      for (const point of points) context.lineTo(...toScreen(point));
      context.strokeStyle = style;
      context.lineWidth = thickness;
      context.setLineDash(dash);
      context.stroke();
      context.setLineDash([]);
    };
    context.lineJoin = "round";
    context.lineCap = "round";
    if (this.ground) this.paint(context, toScreen, this.ground);
    const edges = this.ground ? "#fffc" : colour("dim");
    for (const outline of this.outlines) line([...outline, outline[0]!], edges, this.ground ? 1 : 0.5);
    for (const { points } of this.drives) {
      const path = points.map(({ pose }) => pose.xyz);
      if (!this.ground) line(path, colour("line"), Math.max(5, 3 * this.pixelsPerM));
      line(path, this.ground ? "#fff" : colour("dim"), 1, [5, 5]);
    }
    for (const ghost of this.ghosts) line(ghost.points, colour(ghost.colour), 1.5);
    for (let at = 1; at < this.trail.length; at++) {
      const { xyz, trust } = this.trail[at]!;
      line([this.trail[at - 1]!.xyz, xyz], trust === undefined ? colour("accent") : trustColour(trust), 3);
    }
    for (const { xyz, colour: style } of this.marks) {
      context.beginPath();
      context.arc(...toScreen(xyz), MARK_PX, 0, 2 * Math.PI);
      context.fillStyle = style;
      context.fill();
    }
    const { now } = this;
    if (now) {
      if (now.route) {
        const points = now.route.points.map((point) => transform(now.ego.pose, point));
        line(points, colour("warm"), 2, [2, 5]);
      }
      for (const actor of now.actors ?? []) {
        const [length, breadth] = actor.size;
        this.box(context, toScreen, actor.pose, [-length / 2, length / 2], breadth, colour("warm"));
      }
      const ends: [number, number] = [EGO_REAR_M, EGO_REAR_M + EGO_LENGTH_M];
      if (this.other) this.box(context, toScreen, this.other, ends, EGO_WIDTH_M, colour("warm"));
      this.box(context, toScreen, now.ego.pose, ends, EGO_WIDTH_M, colour("accent"));
    }
    this.scaleBar(context, height);
  }

  private paint(context: CanvasRenderingContext2D, toScreen: (point: Vector) => [number, number], ground: Aerial): void {
    const { picture, middle, widthM, heightM } = ground;
    const [x, y] = toScreen([...middle, 0]);
    const [width, height] = [widthM * this.pixelsPerM, heightM * this.pixelsPerM];
    context.globalAlpha = GROUND_ALPHA;
    context.drawImage(picture, x - width / 2, y - height / 2, width, height);
    context.globalAlpha = 1;
  }

  private box(
    context: CanvasRenderingContext2D,
    toScreen: (point: Vector) => [number, number],
    pose: Pose,
    [back, front]: [number, number],
    breadth: number,
    style: string,
  ): void {
    // Far out, a car is still an arrow of some pixels.
    const grow = Math.max(1, 9 / (this.pixelsPerM * (front - back)));
    const half = (breadth / 2) * grow;
    const corners: Vector[] = [
      [back * grow, half, 0], [front * grow * 0.7, half, 0], [front * grow, 0, 0], [front * grow * 0.7, -half, 0],
      [back * grow, -half, 0],
    ];
    const yaw = heading(pose.q);
    const flat: Pose = { xyz: pose.xyz, q: [Math.cos(yaw / 2), 0, 0, Math.sin(yaw / 2)] };
    context.beginPath();
    for (const corner of corners) context.lineTo(...toScreen(transform(flat, corner)));
    context.closePath();
    context.fillStyle = style;
    context.fill();
    context.lineWidth = 1.5;
    context.strokeStyle = colour("panel");
    context.stroke();
  }

  private scaleBar(context: CanvasRenderingContext2D, height: number): void {
    const wanted = 90 / this.pixelsPerM;
    const decade = 10 ** Math.floor(Math.log10(wanted));
    const metres = [5, 2, 1].map((step) => step * decade).find((step) => step <= wanted) ?? decade;
    context.fillStyle = colour("panel");
    context.fillRect(4, height - 30, metres * this.pixelsPerM + 12, 24);
    context.fillStyle = colour("dim");
    context.fillRect(10, height - 12, metres * this.pixelsPerM, 2);
    context.font = `11px ${colour("font")}`;
    const label = metres >= 1000 ? `${metres / 1000} km` : `${fixed(metres, metres < 1 ? 1 : 0)} m`;
    context.fillText(label, 10, height - 17);
  }
}
