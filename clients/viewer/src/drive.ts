// Drive by hand: a session of the viewer's own, with the car model of the server.

import { Client } from "./client";
import { Controls } from "./controls";
import type { DriveInput } from "./controls";
import { count, el, fixed, messageOf, showStatus, showTitle } from "./dom";
import { Facts, forwardSpeed } from "./facts";
import { MapView } from "./map";
import { Mosaic } from "./mosaic";
import type { Page } from "./page";
import { StagePlot } from "./plot";
import { PointsView } from "./points";
import { clamp, rotate } from "./pose";
import type { Camera, Metadata, Opened, TwinInfo } from "./messages";
import type { Observation } from "./protocol";
import { lanesOf, omittedText, scenariosOf } from "./scenarios";
import { Refused } from "./server";
import { drivenSession } from "./session";
import { Settings } from "./settings";

const DT_US = 50_000;
/** Steps that one request may take together, to keep pace with the clock on a slow server. */
const MOST_STEPS = 10;
const ACCELERATION = 3.0;
const BRAKING = 6.0;
/** The car slows by this much by itself, in m/s². */
const DRAG = 0.4;
const MAX_CURVATURE = 0.18;
/** The other cameras are this much smaller than the one that looks ahead, unless all are in full size. */
const OTHERS = 0.4;
const MOST_WIDE = 10_000;
/** Most lateral acceleration that the keys ask for, in m/s². */
const LATERAL = 4.0;

export class DrivePage implements Page {
  readonly element: HTMLElement;
  private readonly mosaic = new Mosaic();
  private readonly map = new MapView();
  private readonly plot = new StagePlot();
  private readonly points = new PointsView();
  /** What the server left out of the map. */
  private readonly omitted = el("p.omitted", { hidden: true });
  private readonly facts = new Facts();
  private readonly settings: Settings;
  private readonly controls = new Controls((code) => this.key(code));
  private readonly pause = el("button", { type: "button", title: "P" }, "Pause");
  private readonly twin: string;
  private client: Client | undefined;
  private opened: Opened | undefined;
  private last: Metadata | undefined;
  private start: Record<string, unknown> = {};
  private resets = false;
  private isPaused = false;
  private ended = false;
  private reopens = false;
  private wake: () => void = () => {};
  /** Smoothed wall time of a request, in ms, and simulated over wall time. */
  private requestMs = 0;
  private pace = 0;

  constructor(twin: string, scenario = "") {
    this.twin = twin;
    this.settings = new Settings(() => void this.reopen(), scenario);
    this.pause.addEventListener("click", () => this.setPaused(!this.isPaused));
    const again = el("button", { type: "button", title: "R" }, "Start again");
    again.addEventListener("click", () => this.reset());
    this.map.onPick = (trajectory, station) => {
      this.start = { start: { trajectory, station_m: station } };
      this.reset();
    };
    const keys = el("p.keys", {}, "W A S D or arrows: drive · Space: stop · P: pause · R: start again · click a camera: enlarge · click the drive on the map: start there");
    this.element = el("div.view", {},
      el("div.left", {}, this.mosaic.element, this.controls.pads),
      el("aside.right", {}, this.map.element, this.omitted, this.points.element, this.facts.element, this.plot.element,
        el("div.buttons", {}, this.pause, again), this.settings.element, keys));
    showTitle(el("b", {}, twin), " · drive");
    void this.run();
  }

  async end(): Promise<void> {
    this.ended = true;
    this.wake();
    this.controls.end();
    await this.client?.end();
  }

  private key(code: string): void {
    if (code === "KeyP") this.setPaused(!this.isPaused);
    if (code === "KeyR") this.reset();
    if (code === "Escape") this.mosaic.enlarge(undefined);
  }

  private setPaused(paused: boolean): void {
    this.isPaused = paused;
    this.pause.textContent = paused ? "Go on" : "Pause";
    this.wake();
  }

  private reset(): void {
    this.resets = true;
    this.setPaused(false);
  }

  private reopen(): void {
    this.reopens = true;
    this.setPaused(false);
  }

  private async run(): Promise<void> {
    try {
      showStatus("connecting");
      this.client = new Client();
      await this.client.connect();
      this.client.onLost = (lost) => showStatus(lost ? "connection lost, resuming" : "resumed", lost ? "bad" : "");
      const { backend, twins, server } = this.client.welcome;
      const twin = twins.find(({ name }) => name === this.twin);
      if (!twin) throw new Error(`there is no twin ${this.twin} on this server`);
      this.settings.suit(backend);
      await this.open(twin);
      showStatus(`${server.name} ${server.version}, ${backend}`, "good");
      await this.drive(twin);
    } catch (error) {
      if (!this.ended) showStatus(messageOf(error), "bad");
    }
  }

  /** Opens the session: once to learn the twin's cameras, and then with images of the wanted size. */
  private async open(twin: TwinInfo): Promise<void> {
    const client = this.client!;
    const { scenario, width, quality } = this.settings;
    const fields: Record<string, unknown> = { twin: twin.name, dt_us: DT_US, ...this.start };
    if (scenario) fields.scenario = scenario;
    const first = await client.open(fields);
    await client.close();
    // A scenario says how fast its drive begins.
    const { model, speed } = first.dynamics;
    fields.dynamics = model === "teleport" ? { model: "dynamic", speed: 0, reverse: true } : { model, speed, reverse: true };
    const images = imageSizes(first.cameras, width);
    const trust = twin.trajectories.length > 0;
    fields.outputs = { encoding: "jpeg", quality, trust, images, ...(scenario ? { actors: true } : {}) };
    this.opened = await client.open({ ...fields, session: drivenSession(twin.name) });
    // The rig may have other LiDARs than before, or none.
    this.points.clear();
    await this.map.load(twin.name, this.opened.version, twin.trajectories.map(({ name }) => name));
    await this.showLanes(twin.name, scenario, this.opened.start.xyz[2]);
    showTitle(el("b", {}, twin.name), ` v${this.opened.version} · ${count(twin.gaussians)} Gaussians · drive`);
    await this.show(await client.observation({ type: "reset", ...this.start }));
  }

  /** The lanes of the chosen scenario's map; without a scenario, those of all maps. They are not needed to drive. */
  private async showLanes(twin: string, scenario: string, ground: number): Promise<void> {
    const found = await scenariosOf(twin).catch(() => ({ scenarios: [], maps: {}, omitted_maps: [] }));
    const { map } = found.scenarios.find(({ name }) => name === scenario) ?? {};
    const maps = scenario ? [map ?? ""] : Object.keys(found.maps);
    this.map.lanes(lanesOf(found, maps, ground));
    const omitted = omittedText(found.omitted_maps.filter((name) => !scenario || name === map));
    this.omitted.textContent = omitted;
    this.omitted.hidden = omitted === "";
  }

  private async drive(twin: TwinInfo): Promise<void> {
    let due = performance.now();
    while (!this.ended) {
      if (this.isPaused || (this.last?.terminated && !this.resets)) {
        await new Promise<void>((resolve) => (this.wake = resolve));
        due = performance.now();
        continue;
      }
      const begun = performance.now();
      let simulatedMs = 0;
      if (this.reopens) {
        this.reopens = this.resets = false;
        await this.client!.close();
        await this.open(twin);
      } else if (this.resets) {
        this.resets = false;
        await this.show(await this.client!.observation({ type: "reset", ...this.start }));
      } else {
        const steps = this.settings.keepsPace ? clamp(Math.round(this.requestMs / (DT_US / 1000)), 1, MOST_STEPS) : 1;
        const action = this.action(this.controls.read(), steps * DT_US * 1e-6);
        simulatedMs = (steps * DT_US) / 1000;
        await this.show(await this.step({ type: "step", action, until_us: steps * DT_US }));
      }
      const now = performance.now();
      const smooth = (old: number, value: number): number => (old ? old + (value - old) * 0.2 : value);
      this.requestMs = smooth(this.requestMs, now - begun);
      // As fast as the clock, never faster; what was lost is not caught up.
      due = Math.max(due + simulatedMs, now);
      await new Promise((resolve) => setTimeout(resolve, due - now));
      if (simulatedMs > 0) this.pace = smooth(this.pace, simulatedMs / (performance.now() - begun));
      else due = performance.now();
    }
  }

  /** A step; if the episode has ended by a rule, the driver is told instead. */
  private async step(fields: Record<string, unknown>): Promise<Observation> {
    try {
      return await this.client!.observation(fields);
    } catch (error) {
      if (error instanceof Refused && error.code === "deadline_exceeded") return this.step(fields);
      throw error;
    }
  }

  private action({ throttle, steer, stop }: DriveInput, seconds: number): { acceleration: number; curvature: number } {
    const speed = this.last ? forwardSpeed(this.last) : 0;
    const halt = clamp(-speed / seconds, -BRAKING, BRAKING);
    let acceleration = clamp(halt, -DRAG, DRAG);
    if (stop) acceleration = halt;
    else if (throttle > 0) acceleration = throttle * (speed < -0.1 ? BRAKING : ACCELERATION);
    else if (throttle < 0) acceleration = throttle * (speed > 0.1 ? Math.min(BRAKING, speed / seconds + 1) : ACCELERATION);
    const sharpest = Math.min(MAX_CURVATURE, LATERAL / Math.max(1, speed * speed));
    return { acceleration, curvature: steer * sharpest };
  }

  private async show(observation: Observation): Promise<void> {
    const { metadata } = observation;
    this.last = metadata;
    this.map.show(metadata);
    this.points.show(observation);
    this.plot.show(metadata);
    this.facts.show(metadata, [["pace", this.pace ? `${fixed(this.pace, 2)} ×` : "–"]]);
    this.element.dataset.step = String(metadata.step);
    this.element.dataset.x = String(metadata.ego.pose.xyz[0]);
    this.element.dataset.session = metadata.session;
    const end = metadata.events?.find(({ kind }) => kind === "end");
    if (end) showStatus(`the episode ended: ${end.name}. R: start again`, end.name === "route_done" ? "good" : "bad");
    this.mosaic.drives(metadata.time_us, forwardSpeed(metadata));
    await this.mosaic.show(observation);
  }
}

/** The image sizes that make the camera that looks ahead as wide as wanted, and the others small beside it. */
export function imageSizes(cameras: Camera[], width: number): Record<string, { size: [number, number] }> {
  const ahead = ({ camera_to_rig: { q } }: Camera): number => rotate(q, [0, 0, 1])[0];
  const main = [...cameras].sort((a, b) => ahead(b) - ahead(a))[0];
  const sizes: Record<string, { size: [number, number] }> = {};
  for (const camera of cameras) {
    const wanted = camera === main || width > MOST_WIDE ? width : width * OTHERS;
    const scale = Math.min(1, wanted / camera.width);
    const side = (full: number): number => Math.max(1, Math.round(full * scale));
    if (scale < 1) sizes[camera.name] = { size: [side(camera.width), side(camera.height)] };
  }
  return sizes;
}
