// A free camera through a twin. The server draws it: the same pixels as for agents, and any length of city.

import { Client } from "./client";
import { Controls, hasModifier } from "./controls";
import { count, el, fixed, messageOf, showStatus, showTitle } from "./dom";
import { Facts } from "./facts";
import { MapView } from "./map";
import { Mosaic } from "./mosaic";
import type { Page } from "./page";
import { StagePlot } from "./plot";
import { clamp, heading, looking, rotate } from "./pose";
import type { Pose, Vector } from "./pose";
import { viewerSession } from "./session";

const FIELD_OF_VIEW = (75 * Math.PI) / 180;
const EYE_M = 1.65;
/** Radians per pixel of dragging. */
const DRAG = 0.004;
/** Metres a second, without and with Shift. */
const SPEEDS = [6, 30] as const;

export class FlyPage implements Page {
  readonly element: HTMLElement;
  private readonly mosaic = new Mosaic();
  private readonly map = new MapView();
  private readonly plot = new StagePlot();
  private readonly facts = new Facts();
  private readonly controls = new Controls((code) => {
    if (code === "Escape") this.mosaic.enlarge(undefined);
  });
  private readonly held = new Set<string>();
  private readonly abort = new AbortController();
  private client: Client | undefined;
  private place: Vector = [0, 0, EYE_M];
  private yaw = 0;
  private pitch = 0;
  private ended = false;

  constructor(twin: string) {
    const keys = el("p.keys", {}, "W A S D or arrows: move · Q and E: down and up · Shift: faster · drag: look around · click the drive on the map: go there");
    const left = el("div.left.fly", {}, this.mosaic.element, this.controls.pads);
    this.element = el("div.view", {}, left,
      el("aside.right", {}, this.map.element, this.facts.element, this.plot.element, keys));
    showTitle(el("b", {}, twin), " · free camera");
    this.listen(left);
    void this.run(twin);
  }

  async end(): Promise<void> {
    this.ended = true;
    this.abort.abort();
    this.controls.end();
    await this.client?.end();
  }

  private listen(left: HTMLElement): void {
    const { signal } = this.abort;
    addEventListener("keydown", (event) => {
      if (!hasModifier(event)) this.held.add(event.code);
    }, { signal });
    addEventListener("keyup", ({ code }) => this.held.delete(code), { signal });
    addEventListener("blur", () => this.held.clear(), { signal });
    left.addEventListener("pointermove", (event) => {
      if (event.buttons === 0 || (event.target as Element).closest(".pads")) return;
      this.yaw += event.movementX * DRAG;
      this.pitch = clamp(this.pitch + event.movementY * DRAG, -1.5, 1.5);
    }, { signal });
  }

  private async run(twinName: string): Promise<void> {
    try {
      showStatus("connecting");
      this.client = new Client();
      await this.client.connect();
      const { backend, twins, server } = this.client.welcome;
      const twin = twins.find(({ name }) => name === twinName);
      if (!twin) throw new Error(`there is no twin ${twinName} on this server`);
      const { clientWidth, clientHeight } = this.mosaic.element;
      const aspect = clamp(clientWidth / (clientHeight || clientWidth), 0.6, 2.4);
      const width = backend === "gpu" ? 1280 : 640;
      const height = Math.round(width / aspect);
      const focal = width / 2 / Math.tan(FIELD_OF_VIEW / 2);
      const eye: Pose = { xyz: [0, 0, 0], q: [0.5, -0.5, 0.5, -0.5] };
      const camera = { name: "free", width, height, fx: focal, fy: focal, cx: width / 2, cy: height / 2, camera_to_rig: eye };
      const opened = await this.client.open({
        twin: twinName,
        session: viewerSession("fly"),
        record: false,
        rig: { name: "free", cameras: [camera] },
        outputs: { encoding: "jpeg", quality: 88, trust: twin.trajectories.length > 0 },
      });
      await this.map.load(twinName, opened.version, twin.trajectories.map(({ name }) => name));
      this.go(opened.start);
      this.map.onPose = (pose) => this.go(pose);
      showTitle(el("b", {}, twinName), ` v${opened.version} · ${count(twin.gaussians)} Gaussians · free camera`);
      showStatus(`${server.name} ${server.version}, ${backend}`, "good");
      await this.fly();
    } catch (error) {
      if (!this.ended) showStatus(messageOf(error), "bad");
    }
  }

  private go({ xyz: [x, y, z], q }: Pose): void {
    this.place = [x, y, z + EYE_M];
    this.yaw = heading(q);
    this.pitch = 0;
  }

  /** Asks for an image whenever the camera has moved. */
  private async fly(): Promise<void> {
    let shown = "";
    let before = performance.now();
    while (!this.ended) {
      const now = performance.now();
      this.move(Math.min(0.5, (now - before) / 1000));
      before = now;
      const pose: Pose = { xyz: this.place, q: looking(this.yaw, this.pitch) };
      const key = JSON.stringify(pose);
      if (key === shown) {
        await new Promise((resolve) => requestAnimationFrame(resolve));
        continue;
      }
      shown = key;
      const observation = await this.client!.observation({ type: "observe", poses: [pose] });
      const { metadata } = observation;
      const { timings } = metadata;
      this.map.at({ ...metadata, ego: { ...metadata.ego, pose } });
      this.plot.show(metadata);
      const trust = metadata.images[0]?.trust;
      this.facts.set([
        ["east", `${fixed(pose.xyz[0], 1)} m`], ["north", `${fixed(pose.xyz[1], 1)} m`], ["up", `${fixed(pose.xyz[2], 1)} m`],
        ["image", `${fixed(timings.queue_ms + timings.render_ms + timings.encode_ms, 0)} ms`],
        ["trust", trust ? fixed(trust.value, 2) : "–"],
        ["to a recorded pose", trust ? `${fixed(trust.distance_m, 1)} m` : "–"],
      ]);
      this.element.dataset.step = String(Number(this.element.dataset.step ?? 0) + 1);
      this.element.dataset.x = String(pose.xyz[0]);
      await this.mosaic.show(observation);
    }
  }

  private move(seconds: number): void {
    const { throttle, steer } = this.controls.read();
    const rise = Number(this.held.has("KeyE")) - Number(this.held.has("KeyQ"));
    if (throttle === 0 && steer === 0 && rise === 0) return;
    const isFast = this.held.has("ShiftLeft") || this.held.has("ShiftRight");
    const way = SPEEDS[isFast ? 1 : 0] * seconds;
    const ahead = rotate(looking(this.yaw, this.pitch), [throttle * way, steer * way, 0]);
    const [x, y, z] = this.place;
    this.place = [x + ahead[0], y + ahead[1], z + ahead[2] + rise * way];
  }
}
